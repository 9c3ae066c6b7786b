"""The recorded logs of the shared data: sign, charge, temperature of every file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.errors import InputError
from cangauge.logs.gaps import discharged_ah
from cangauge.logs.sign import sign_of_current
from selection import nightly_except

pytestmark = pytest.mark.real

UNDECIDED = {
    # Slow scripts near empty: voltage relaxes more than it drops, charge hardly moves.
    "A123_DYN_50_P25_s2.csv.gz",
    "A123_OCV_P05_S2.csv.gz",
    "A123_OCV_P25_S2.csv.gz",
    "A123_OCV_P45_S2.csv.gz",
}


FILES = {
    "bmw_i3/*.csv.gz": (30, "pack", 1.0, 60.0),
    "a123_lfp/*.csv.gz": (21, "room", 0.0, 2.25),  # a 2.3 Ah cell
    "leaf_cell_ornl/*HPPC*.csv.gz": (3, "room", 29.0, 33.0),  # a 33.1 Ah cell
    "leaf_module_ornl/*.csv.gz": (4, "cell", 54.3, 55.7),
    "lg_hg2/*.parquet": (32, "cell", 2.2, 3.1),  # a 3 Ah cell
}
"""Number of files, source of the temperature, and least and largest charge [Ah]."""


@pytest.mark.parametrize("every", nightly_except((6,), (6, 1)))
@pytest.mark.parametrize("pattern", FILES)
def test_every_file_has_its_charge_and_sign(shared_data: Path, pattern: str, every: int) -> None:
    count, source, low_ah, high_ah = FILES[pattern]
    paths = sorted(shared_data.glob(pattern))
    assert len(paths) >= count
    for path in paths[::every]:
        log = read_log(path)
        assert log.temperature_source in {source, "unknown"}, path.name
        assert low_ah <= np.ptp(discharged_ah(log.time_s, log.current_a)) < high_ah, path.name
        sign = 0 if path.name in UNDECIDED else 1
        assert sign_of_current(log).sign == sign, path.name
        assert sign_of_current(replace(log, current_a=-log.current_a)).sign == -sign, path.name


def test_values_that_single_files_have(shared_data: Path) -> None:
    for rate, peak in (("1C", 30.6), ("2C", 61.2), ("3C", 91.8)):
        path = shared_data / "leaf_cell_ornl" / f"{rate}-Discharge-Bitrode-data.csv.gz"
        assert read_log(path, temperature_c=24.0).current_a.max() == peak
    for path in sorted((shared_data / "a123_lfp").glob("*.csv.gz"))[::6]:
        log = read_log(path)
        assert log.temperature_c[0] == float(path.name.split("_P")[1][:2])
        if path.name.lower().endswith(("s1.csv.gz", "s3.csv.gz")):  # discharge and charge scripts
            way = 1.0 if "s1" in path.name.lower() else -1.0
            assert 1.9 < way * discharged_ah(log.time_s, log.current_a)[-1] < 2.2
    trip = read_log(shared_data / "bmw_i3" / "TripA01.csv.gz")
    assert trip.soc_pct is not None
    assert trip.soc_pct[0] - np.nanmin(trip.soc_pct) > 2.0
    with pytest.raises(InputError, match="not a known kind of log"):
        read_log(shared_data / "leaf_cell_ornl" / "Temperature-1C-discharge.lvm.gz")


@pytest.mark.nightly
def test_no_wrong_sign_in_pieces_of_the_recorded_logs(shared_data: Path) -> None:
    """Pieces of 20 s to 30 min: often open, never wrong."""
    rng = np.random.default_rng(11)
    paths = sorted(shared_data.glob("*/*.parquet")) + sorted(shared_data.glob("bmw_i3/*.gz"))
    found = {1: 0, 0: 0, -1: 0}
    for path in paths:
        log = read_log(path)
        for length_s in (20.0, 60.0, 300.0, 1800.0):
            for start in log.time_s[0] + rng.random(4) * max(log.duration_s - length_s, 0.0):
                rows = (log.time_s >= start) & (log.time_s <= start + length_s)
                if rows.any():
                    found[sign_of_current(log.rows(rows)).sign] += 1
    assert found[-1] == 0
    assert found[1] > 0.4 * sum(found.values())
