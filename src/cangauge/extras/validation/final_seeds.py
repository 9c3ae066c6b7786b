"""Seeds of the published figures of the withheld check.

They are frozen: never redraw them, and never evaluate them while a method is being changed.
"""

from __future__ import annotations

from typing import Final

FINAL_SEED: Final = 8
"""Seed of the plan; the cases that it draws have odd seeds (see `plan`)."""
