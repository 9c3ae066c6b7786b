"""Events: log records with a stable name, for whoever searches or counts them.

Modules log through the standard library and name their event::

    _LOG = logging.getLogger(__name__)
    emit(_LOG.warning, "bus.lost", "socketcan can0 is down", retry_s=1.0)

Names (`area.what_happened`) are stable; texts may change. Callers log every occurrence: whoever
writes the records limits their rate (`service.events`).
"""

from __future__ import annotations

from collections.abc import Callable


def emit(
    log: Callable[..., None], event: str, text: str, *, limit: str | None = None, **fields: object
) -> None:
    """Log one event by a method of a logger: its stable name, and one line for people.

    Events with the same `limit` share one rate limit, as they supersede each other (the states of
    a bus). `fields` are further keys of the JSON object, with units in their names.
    """
    log("%s", text, extra={"event": event, "limit": limit or event, "fields": fields})
