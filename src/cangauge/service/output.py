"""The seam between the service and whatever shows, stores or sends its results."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import can

    from cangauge.service.status_client import Snapshot
    from cangauge.types import Estimate, Sample


class Output:
    """Takes the results of a service: recording, status, page, MQTT, metrics.

    `trouble` is a sentence for the user, shown in the status; "" while nothing is wrong. The
    methods are called in the thread of the receive loop and must return at once. One that raises
    is logged and called no more until `close`; the estimate continues.
    """

    trouble = ""

    def on_frame(self, message: can.Message) -> None:
        """Take a received frame that is input, before the estimator; its stamp may be rounded."""

    def on_sample(self, sample: Sample, estimate: Estimate) -> None:
        """Take a sample and the estimate after it."""

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Take the state of the service, four times a second; ten times with the live page."""

    def close(self) -> None:
        """Complete what was written, within a limited time."""
