"""An identified model in the forms of other simulators and of a microcontroller."""
