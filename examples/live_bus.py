"""A live bus in twenty lines: a service, frames of a log sent to it, and the SoC that comes back.

python examples/live_bus.py
"""

from __future__ import annotations

import threading
import time

import can

import cangauge
from cangauge.bus.encoder import FrameEncoder
from cangauge.bus.publish import SocEstimate, SocReader
from cangauge.estimation.offline import samples_of

BUS = {"interface": "virtual", "channel": "example"}


def main() -> None:
    """Send a drive at 50 samples a second, and print what the service publishes."""
    log = cangauge.simulate(seed=7, drive=1, discharge=True).log
    cangauge.fit([log]).model.save("pack.json")
    service = cangauge.Service(model="pack.json", initial_soc=100.0, **BUS)
    thread = threading.Thread(target=service.run)
    encoder, reader, latest = FrameEncoder(cangauge.Vehicle.load("generic")), SocReader(), None
    with can.Bus(**BUS) as bus:
        thread.start()
        for sample in list(samples_of(log))[:150]:
            for frame in encoder.encode(sample):
                bus.send(frame)
            time.sleep(0.02)
            while (message := bus.recv(0.0)) is not None:
                if isinstance(published := reader.read(message), SocEstimate):
                    latest = published
    service.stop()
    thread.join()
    print(latest)


if __name__ == "__main__":
    main()
