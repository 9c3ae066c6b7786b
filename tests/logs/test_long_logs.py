"""A log that is read in pieces is the log that is read at once."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from cangauge.logs import canonical, file_content
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.logs.read import read_log

ROWS = 500


def long_log() -> Log:
    rng = np.random.default_rng(0)
    soc = np.full(ROWS, np.nan)
    soc[0] = 90.0
    return Log(
        np.arange(float(ROWS)), rng.normal(0.0, 20.0, ROWS), rng.normal(380.0, 2.0, ROWS),
        rng.normal(21.0, 1.0, ROWS), soc,
    )  # fmt: skip


@pytest.mark.parametrize("suffix", ["csv", "csv.gz", "parquet"])
def test_pieces_of_a_file_give_the_same_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    monkeypatch.setattr(file_content, "_PIECE_BYTES", 1000)
    monkeypatch.setattr(canonical, "read_columns", None)  # the text is not held
    log, path = long_log(), tmp_path / f"log.{suffix.removesuffix('.gz')}"
    write_log(log, path)
    if suffix.endswith(".gz"):
        packed = tmp_path / f"log.{suffix}"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        path = packed
    found = read_log(path)
    for name in ("time_s", "current_a", "voltage_v", "temperature_c", "soc_pct"):
        np.testing.assert_array_equal(getattr(found, name), getattr(log, name))


@pytest.mark.parametrize(
    ("cell", "number"), [("-", np.nan), ("N/A", np.nan), (" 7.25 ", 7.25), ("1e1", 10.0)]
)
def test_odd_cells_mean_the_same_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cell: str, number: float
) -> None:
    path = tmp_path / "log.csv"
    text = "time_s,current_a,voltage_v,temperature_c,soc_pct\n"
    text += "".join(f"{k},{k % 7},{380 - k % 7},21,{cell if k == 40 else 50}\n" for k in range(90))
    path.write_text(text)
    monkeypatch.setattr(file_content, "_PIECE_BYTES", 300)
    in_pieces = read_log(path)
    monkeypatch.setattr(canonical, "read_plain_numbers", lambda *_, **__: None)
    whole = read_log(path)
    assert in_pieces.soc_pct is not None
    assert whole.soc_pct is not None
    np.testing.assert_array_equal(in_pieces.soc_pct, whole.soc_pct)
    np.testing.assert_equal(in_pieces.soc_pct[40], number)


def test_logs_share_columns_that_nobody_can_change() -> None:
    log = long_log()
    assert Log(log.time_s, log.current_a, log.voltage_v, log.temperature_c).time_s is log.time_s
    own = np.arange(3.0)
    other = Log(own, own, own, own)
    own[:] = 7.0
    assert other.time_s.tolist() == [0.0, 1.0, 2.0]
