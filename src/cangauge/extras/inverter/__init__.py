"""A battery's frames handed on to an inverter, with the estimated state of charge in them."""
