"""A whole service in a thread, on a virtual bus on which a drive is played."""

from __future__ import annotations

import secrets
import socket
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, Self
from urllib.error import HTTPError
from urllib.request import urlopen

import can

from cangauge._resources import shared_file
from cangauge.bus.vehicle import Vehicle
from cangauge.estimation.offline import samples_of
from cangauge.replay.encoder import FrameEncoder
from cangauge.service.run import Service
from cangauge.types import Sample
from cells_bus import ALL_CELLS, CAR, CELLS_DBC, CELLS_ON_BUS, all_cell_frames
from live import leaf_model_path, short_log, virtual_port, waits

SAMPLE_S = 0.05


def free_port() -> int:
    """Return a port below those of outgoing connections, which could take it before it is used."""
    while True:
        port = 10_000 + secrets.randbelow(20_000)
        with socket.socket() as found, suppress(OSError):
            found.bind(("127.0.0.1", port))
            return port


class RunningService:
    """`cangauge run` in a thread, and a sender of frames.

    Parameters
    ----------
    folder : Path
        For its configuration.
    text : str
        Further lines of the configuration.
    port : int, optional
        Of HTTP.
    with_cells : bool
        A car that gives the voltages of 96 cells, the 40th of them lower.
    steady : Sample, optional
        Sent all the time, in place of a drive.
    """

    def __init__(
        self,
        folder: Path,
        text: str = "",
        port: int | None = None,
        *,
        with_cells: bool = False,
        steady: Sample | None = None,
    ) -> None:
        self.port = port or free_port()
        self._channel = folder.name
        self._with_cells, self._steady = with_cells, steady
        if with_cells:
            (folder / "cells.dbc").write_text(CELLS_DBC)
            (folder / "car.toml").write_text(CAR + ALL_CELLS)
            text = f'dbc = "{shared_file("dbc", "generic_pack.dbc")}"\nmap = "car.toml"\n{text}'
        path = folder / "run.toml"
        path.write_text(
            f'model = "{leaf_model_path()}"\ninterface = "virtual"\nchannel = "{folder.name}"\n'
            f'initial_soc = 80\nhttp = "127.0.0.1:{self.port}"\n'
            f'status_socket = "{folder}/s.sock"\n{text}'
        )
        self.service = Service(path)
        self.silent = threading.Event()
        self.summary: dict[str, Any] | None = None
        self._done = threading.Event()
        self._threads = [threading.Thread(target=each) for each in (self._serve, self._play)]

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        assert waits(lambda: self.service.pipeline.samples > 5)
        assert waits(self._is_served)
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self.service.stop()
        for thread in self._threads:
            thread.join()

    def _is_served(self) -> bool:
        try:
            urlopen(f"{self.endpoint}/status").close()  # noqa: S310 - http
        except HTTPError as error:
            return error.code == 401
        except OSError:
            return False
        return True

    def _serve(self) -> None:
        self.summary = self.service.run()

    def _play(self) -> None:
        encoder = FrameEncoder(Vehicle.load("generic"))
        samples: Iterable[Sample] = samples_of(short_log(300.0, 1.0 / SAMPLE_S))
        if self._steady is not None:
            samples = (self._steady._replace(time_s=SAMPLE_S * row) for row in count())
        bus = virtual_port(self._channel)
        due_s = time.monotonic()
        for sample in samples:
            if self._done.wait(max(due_s - time.monotonic(), 0.0)):
                break
            due_s += SAMPLE_S
            if not self.silent.is_set():
                for frame in [*self._cells(sample.voltage_v), *encoder.encode(sample)]:
                    frame.timestamp = time.time()
                    bus.send(frame)
        with suppress(Exception):
            bus.close()

    def _cells(self, voltage_v: float) -> list[can.Message]:
        if not self._with_cells:
            return []
        cells_v = [voltage_v / CELLS_ON_BUS] * CELLS_ON_BUS
        cells_v[39] -= 0.02
        return all_cell_frames(cells_v)
