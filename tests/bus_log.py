"""Log of a bus as a service writes it, with repeats limited."""

from __future__ import annotations

import io
import json
from typing import Any, Self

from cangauge.service.events import logging_to


class BusLog:
    """Collects the events logged in a `with` block."""

    def __init__(self) -> None:
        self._stream = io.StringIO()

    def __enter__(self) -> Self:
        self._logging = logging_to("json", stream=self._stream)
        self._logging.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._logging.__exit__(None, None, None)

    @property
    def records(self) -> list[dict[str, Any]]:
        """The records of `cangauge.bus` so far."""
        records = [json.loads(line) for line in self._stream.getvalue().splitlines()]
        return [each for each in records if each["logger"].startswith("cangauge.bus")]

    @property
    def events(self) -> list[str]:
        """Their names."""
        return [each["event"] for each in self.records]

    @property
    def lines(self) -> list[str]:
        """Their messages."""
        return [each["message"] for each in self.records]
