"""Frames ↔ samples and estimates: buses, captures, DBC mapping, protection, publishing."""

import logging

# python-can also logs the errors that it raises, and a line for each unknown object of a file. A
# program that sets up logging still sees them.
logging.getLogger("can").addHandler(logging.NullHandler())
