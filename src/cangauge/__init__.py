"""cangauge: state of charge from CAN frames by an identified voltage model.

Data flows one way: frames → samples → estimate → frames, and log → model.
Positive current discharges, everywhere.
"""

__version__ = "0.1.0"
