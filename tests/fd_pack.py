"""A pack whose current and voltage are beyond byte 8 of 64-byte CAN FD frames."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import can
import pytest

from cangauge.bus.connection import BusConnection
from cangauge.bus.open import BusAddress, open_bus
from cangauge.bus.vehicle import Vehicle
from cangauge.service.offline import estimate_capture
from cangauge.service.pipeline import Pipeline, PipelineSettings
from cangauge.service.record import Recorder
from live import Service, leaf_model, loop_config, waits

DBC = """VERSION "1"
NS_ :
BS_:
BU_: V
BO_ 801 PACK_FD: 64 V
 SG_ Current : 407|16@0- (0.05,0) [0|0] "A" V
 SG_ Voltage : 496|16@1+ (0.01,0) [0|0] "V" V
"""
MAP = '[current]\nsignal = "Current"\n[voltage]\nsignal = "Voltage"\n[temperature]\nfixed_c = 20\n'


def fd_vehicle(folder: Path) -> Vehicle:
    (folder / "fd.dbc").write_text(DBC)
    (folder / "fd.toml").write_text(MAP)
    return Vehicle.load(dbc=folder / "fd.dbc", map=folder / "fd.toml")


def fd_frame(current_a: float, voltage_v: float) -> can.Message:
    data = bytearray(range(64))
    data[50:52] = round(current_a / 0.05).to_bytes(2, "big", signed=True)
    data[62:64] = round(voltage_v / 0.01).to_bytes(2, "little")
    return can.Message(
        arbitration_id=801, is_extended_id=False, is_fd=True, bitrate_switch=True, data=data
    )


def estimates_from_64_bytes(address: BusAddress, folder: Path) -> None:
    """Send 64-byte frames to a service; its samples and its recording have them all."""
    car, path = fd_vehicle(folder), folder / "fd.log"
    pipeline = Pipeline(car, leaf_model(), PipelineSettings())
    with (
        closing(Recorder(path)) as recorder,
        BusConnection(open_bus(address, pipeline.filters), address) as port,
        Service(port, pipeline, loop_config(), recorder) as live,
        open_bus(address, []) as sender,
    ):
        for step in range(100):
            sender.send(fd_frame(20.0 - 0.4 * step, 370.0 + 0.03 * step))
            assert waits(lambda step=step: live.pipeline.samples > step)  # type: ignore[misc]
        sample = live.pipeline.latest_sample
    assert sample is not None
    assert (sample.current_a, sample.voltage_v) == pytest.approx((-19.6, 372.97))
    assert live.pipeline.counts["lost"] == 0
    recorded = estimate_capture(path, car, leaf_model(), PipelineSettings().estimator)
    # The filter knows no SoC before its first block: the inverse of each row is compared.
    newton_pct = [estimate.soc_newton_pct for _, estimate in live.rows]
    assert recorded.table.soc_newton_pct.tolist() == newton_pct
