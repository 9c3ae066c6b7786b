"""Array types used throughout."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""Array of float64."""
IntArray = NDArray[np.intp]
"""Array of indices."""
BoolArray = NDArray[np.bool_]
"""Array of bool, such as a mask of rows."""
