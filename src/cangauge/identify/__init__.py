"""Identification: recorded logs → model. See `fit`."""

from cangauge.identify.delays import DelaySearch, search_delays
from cangauge.identify.fit import Identification, fit

__all__ = ["DelaySearch", "Identification", "fit", "search_delays"]
