"""The withheld check: causes are drawn and sealed, diagnosed from the logs alone, then scored."""

from __future__ import annotations
