"""How large an input may be: every bound that a reader of files keeps, in one place.

They stand far above what real files need and far below what hurts the machine. What exceeds one
is refused by an `InputError`, before the time or the memory is spent.
"""

from __future__ import annotations

from typing import Final

MIB: Final = 1 << 20

# --- all packed files (gzip, zip) ---------------------------------------------------------------
UNPACK_FREE_BYTES: Final = 16 * MIB
"""Whatever unpacks to no more than this may do so at any ratio."""
UNPACK_RATIO: Final = 250
"""Beyond it, a file may unpack to so many times its size (real recordings: up to 43 times)."""

# --- logs ---------------------------------------------------------------------------------------
MAX_LOG_BYTES: Final = 1024 * MIB
"""Of a log, packed or unpacked: it is read whole."""
MAX_LOG_ROWS: Final = 20_000_000
"""Rows of a log, samples of a capture: 23 days at 10 Hz, 0.8 GB of numbers."""
MAX_LOG_COLUMNS: Final = 10_000
MAX_LOG_SPAN_S: Final = 366 * 86400.0
"""From the first row to the last [s]: where a clock was set within a log, decades seem to pass."""
MAX_HEADING: Final = 200
"""A column's heading that is longer is none that is known [characters]."""
MAX_ODD_ROWS: Final = 100
"""Rows with a wrong number of cells that are kept for the message."""
MAX_PARQUET_NAMES: Final = 16 * MIB
"""Longest text, and longest list, in a Parquet file's footer [bytes, items]."""

# --- captures -----------------------------------------------------------------------------------
MAX_CAPTURE_BYTES: Final = 64 * 1024 * MIB
"""Of a capture, unpacked: it is read as a stream."""
MAX_LINE: Final = 16 * 1024
"""No capture has longer lines; what is longer is not text, or hostile [characters]."""
MAX_IDLE_LINES: Final = 1_000_000
"""So many lines in a row without a frame are no capture."""
MAX_BLF_OBJECT: Final = 16 * MIB
"""Of one object of a BLF file, packed or unpacked (its writers fill 128 KiB)."""
MAX_MF4_MEMORY: Final = 4096 * MIB
"""Of the process that reads an MF4 file."""
MF4_SILENCE_S: Final = 60.0
MF4_SILENCE_S_PER_MIB: Final = 0.5
"""It may give no frame for so long [s], longer with the file's size."""
MAX_BUSES: Final = 64
"""Buses in one capture: each is decoded for itself."""
MAX_STAMP_S: Final = 1e11
"""Largest time stamp of a frame or a row [s]: the year 5138, if it counts from 1970."""

# --- DBC ----------------------------------------------------------------------------------------
MAX_DBC_BYTES: Final = 4 * MIB
"""Reading takes 1–6 s a megabyte; the largest files in use are smaller than this."""

# --- configurations, maps, model files ----------------------------------------------------------
MAX_TOML_BYTES: Final = 64 * 1024
MAX_TOML_KEY: Final = 32
"""Parts of a dotted key: reading takes time and memory with their square."""
MAX_MODEL_BYTES: Final = 4 * MIB
"""A model of 64 delays has 0.2 MB."""
MAX_MODEL_COLUMNS: Final = 256
"""Columns that the information in a model file may have."""
MAX_MODEL_ITEMS: Final = 4096
"""Effects, source logs, coefficients in a model file, each."""
MAX_SPEED_TRACE_BYTES: Final = 64 * MIB
