"""Simulated truth: packs, drives and faults whose cause is known.

Kept apart from `cangauge.model` and `cangauge.gap` on purpose: nothing of them is imported here,
and no equation is taken from them, so that a diagnosis is judged on physics that it does not own.
"""

from __future__ import annotations
