"""The recorded logs of the shared data: sign, charge, temperature of every file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cangauge.errors import InputError
from cangauge.logs.read import read_log
from cangauge.logs.sign import charge_ah

pytestmark = pytest.mark.real


def test_every_i3_trip(shared_data: Path) -> None:
    paths = sorted((shared_data / "bmw_i3").glob("*.csv.gz"))
    assert len(paths) == 30
    for path in paths:
        log = read_log(path)
        assert log.temperature_source == "pack"
        assert 325.0 <= log.voltage_v.min() < log.voltage_v.max() <= 395.0
        assert np.median(np.diff(log.time_s)) == pytest.approx(0.1)
        assert charge_ah(log)[-1] > 1.0  # every trip takes charge out
        assert log.soc_pct is not None
        assert log.soc_pct[0] - np.nanmin(log.soc_pct) > 2.0


def test_every_a123_script(shared_data: Path) -> None:
    paths = sorted((shared_data / "a123_lfp").glob("*.csv.gz"))
    assert len(paths) == 21
    for path in paths:
        log = read_log(path)
        assert log.temperature_source == "room"
        assert log.temperature_c[0] == float(path.name.split("_P")[1][:2])
        charge = charge_ah(log)
        if "_S1" in path.name or "_s1" in path.name:  # discharge scripts of a 2.3 Ah cell
            assert 1.9 < charge[-1] < 2.2
        if "_S3" in path.name or "_s3" in path.name:  # charge scripts
            assert -2.2 < charge[-1] < -1.9


def test_every_ornl_export(shared_data: Path) -> None:
    for path in sorted((shared_data / "leaf_cell_ornl").glob("*HPPC*.csv.gz")):
        log = read_log(path)
        assert log.temperature_c[0] in {10.0, 25.0, 40.0}
        assert np.ptp(charge_ah(log)) == pytest.approx(31.0, abs=2.0)  # a 33.1 Ah cell
    for rate, peak in (("1C", 30.6), ("2C", 61.2), ("3C", 91.8)):
        path = shared_data / "leaf_cell_ornl" / f"{rate}-Discharge-Bitrode-data.csv.gz"
        assert read_log(path, temperature_c=24.0).current_a.max() == peak
    for path in sorted((shared_data / "leaf_module_ornl").glob("*.csv.gz")):
        log = read_log(path)
        assert log.temperature_source == "cell"
        assert charge_ah(log)[-1] == pytest.approx(55.0, abs=0.7)
    with pytest.raises(InputError, match="not a known kind of log"):
        read_log(shared_data / "leaf_cell_ornl" / "Temperature-1C-discharge.lvm.gz")


def test_every_lg_hg2_drive(shared_data: Path) -> None:
    paths = sorted((shared_data / "lg_hg2").glob("*.parquet"))
    assert len(paths) == 32
    for path in paths:
        log = read_log(path)
        assert 2.2 < np.ptp(charge_ah(log)) < 3.1  # a 3 Ah cell
        assert log.remarks == ()
