"""The SoC module for foxBMS 2 gives Python's numbers, with stand-ins of its headers."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from untested import export_untested

from cangauge._typing import FloatArray
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.embedded.c_source import CORE_SOURCES
from cangauge.extras.embedded.embedded import drive_with_events
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Estimate, Sample

HERE = Path(__file__).parent / "foxbms"
STRICT = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-ffp-contract=off"]
MODEL = leaf_2012_model_file()
CELLS = 96
BLOCK = "-DCANGAUGE_FRAM_BLOCK=FRAM_BLOCK_ID_CANGAUGE"
Row = tuple[int, int | None, int | None, int | None]
"""Time stamp [ms], current [mA], voltage [mV], temperature [0.1 °C]."""

pytestmark = pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")


def built(folder: Path, model: Model, *defines: str) -> Path:
    export_untested(model, folder, period_s=0.1, platform="foxbms")
    sources = [*CORE_SOURCES, "pack_model.c", str(HERE / "driver.c")]  # it includes foxbms_soc.c
    subprocess.run(
        ["cc", *STRICT, "-DCANGAUGE_CONFIG", *defines, f"-I{HERE}", "-I.", *sources, "-lm",
         "-o", "driver"],
        check=True, cwd=folder, timeout=120,
    )  # fmt: skip
    return folder / "driver"


def run(
    driver: Path, rows: Sequence[Row], reset: int = 0, fram: Path | None = None
) -> tuple[FloatArray, float]:
    """Return average, minimum and maximum after each row [%], and the SoC of a cell at 3.9 V."""
    text = "\n".join(" ".join("x" if each is None else str(each) for each in row) for row in rows)
    done = subprocess.run(
        [driver, str(reset), *([] if fram is None else [fram])], check=True,
        input=text + "\n", capture_output=True, text=True,
        timeout=120,
    )  # fmt: skip
    *lines, cell = done.stdout.splitlines()
    bits = np.array([[int(word, 16) for word in line.split()] for line in lines], dtype=np.uint32)
    return bits.view(np.float32).astype(np.float64), float(cell)


def rounded(samples: Iterator[Sample]) -> list[Row]:
    """Return samples as the database has them."""

    def whole(value: float, per_unit: float) -> int | None:
        return None if math.isnan(value) else round(value * per_unit)

    return [
        (round(each.time_s * 1000.0), whole(each.current_a, 1000.0), whole(each.voltage_v, 1000.0),
         whole(each.temperature_c, 10.0))
        for each in samples
    ]  # fmt: skip


def as_sample(row: Row) -> Sample:
    stamp_ms, *values = row
    signals = (
        math.nan if each is None else each / unit
        for each, unit in zip(values, (1000.0, 1000.0, 10.0), strict=True)
    )
    return Sample(stamp_ms / 1000.0, *signals)


def published(estimates: Iterable[Estimate]) -> FloatArray:
    """Return average, minimum and maximum as the module publishes them, shape (n, 3) [%]."""
    latest = (0.0, 0.0, 0.0)
    found = []
    for now in estimates:
        if not math.isnan(now.soc_pct) and not math.isnan(now.soc_std_pct):
            spread = 2.0 * now.soc_std_pct
            latest = (now.soc_pct, now.soc_pct - spread, now.soc_pct + spread)
        found.append(latest)
    return np.clip(found, 0.0, 100.0).astype(np.float32).astype(np.float64)


def estimated(rows: Sequence[Row], model: Model, settings: EstimatorSettings) -> FloatArray:
    """Return what Python estimates on the rows, as the module publishes it."""
    estimator = Estimator(model, settings)
    return published(estimator.step(as_sample(row)) for row in rows)


def assert_published(found: FloatArray, expected: FloatArray) -> None:
    """Compare within the resolution of a float at 100 %."""
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-5)


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("foxbms"), MODEL)


@pytest.fixture(scope="module")
def keeping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The driver of a module with a block of the FRAM for itself."""
    return built(tmp_path_factory.mktemp("keeping"), MODEL, BLOCK)


@pytest.fixture(scope="module")
def drive() -> list[Row]:
    rows = rounded(drive_with_events(MODEL, 0.1))
    return [(stamp, None if k % 83 == 11 else current, *rest)
            for k, (stamp, current, *rest) in enumerate(rows)]  # fmt: skip


def test_module_publishes_pythons_estimate(driver: Path, drive: list[Row]) -> None:
    found, _ = run(driver, drive)
    assert_published(found, estimated(drive, MODEL, EstimatorSettings()))
    assert np.ptp(found[:, 0]) > 1.0


def test_time_stamps_may_wrap(driver: Path, drive: list[Row]) -> None:
    first = 2**32 - 300_000
    later = [(first + stamp, *values) for stamp, *values in drive]
    wrapped = [(stamp % 2**32, *values) for stamp, *values in later]
    found, _ = run(driver, wrapped)
    assert_published(found, estimated(later, MODEL, EstimatorSettings()))


def from_zero(rows: list[Row]) -> list[Row]:
    """Return the rows with the time stamps of a processor that starts before them."""
    return [(row[0] - rows[0][0] + 100, *row[1:]) for row in rows]


def settings_after(published: FloatArray) -> EstimatorSettings:
    """Return the settings of a start with the SoC that was published last."""
    average, low, high = published
    spread = max(average - low, high - average, 2.0)
    return EstimatorSettings(initial_soc_pct=average, initial_soc_std_pct=spread / 2.0)


def test_reset_continues_from_the_soc_in_fram(driver: Path, drive: list[Row]) -> None:
    reset = 600
    later = from_zero(drive[reset - 1 :])
    found, _ = run(driver, drive[: reset - 1] + later, reset)
    expected = estimated(later, MODEL, settings_after(found[reset - 2]))
    assert_published(found[reset - 1 :], expected)


def test_own_fram_block_keeps_the_whole_state(
    driver: Path, keeping: Path, drive: list[Row]
) -> None:
    """Written every 10 s, without the delay line."""
    reset = 1000
    later = from_zero(drive[reset - 1 :])
    found, _ = run(keeping, drive[: reset - 1] + later, reset)
    np.testing.assert_array_equal(found[: reset - 1], run(driver, drive)[0][: reset - 1])
    before, saved_ms = Estimator(MODEL, EstimatorSettings()), 0
    for row in drive[: reset - 1]:
        before.step(as_sample(row))
        if row[0] - saved_ms >= 10_000:
            saved_ms, state = row[0], before.snapshot()
    after = Estimator(MODEL, EstimatorSettings())
    after.restore(state, math.nan)
    expected = published(after.step(as_sample(row)) for row in later)
    assert_published(found[reset - 1 :], expected)


def test_saved_state_of_another_model_is_not_used(
    keeping: Path, drive: list[Row], tmp_path: Path
) -> None:
    fram = tmp_path / "fram"
    other = MODEL.model_copy(update={"capacity_ah": 0.9 * MODEL.capacity_ah})
    new = built(tmp_path / "new", other, BLOCK)
    before, _ = run(keeping, drive[:1000], fram=fram)
    kept = fram.read_bytes()
    found, _ = run(new, drive, fram=fram)
    assert_published(found, estimated(drive, other, settings_after(before[-1])))
    fram.write_bytes(kept)
    again, _ = run(keeping, drive, fram=fram)
    assert np.any(again != estimated(drive, MODEL, settings_after(before[-1])))


def test_sign_of_the_current_follows_foxbms(driver: Path, drive: list[Row], tmp_path: Path) -> None:
    charging = built(tmp_path, MODEL, "-DBS_POSITIVE_DISCHARGE_CURRENT=(false)")
    negated = [(row[0], None if row[1] is None else -row[1], *row[2:]) for row in drive]
    np.testing.assert_array_equal(run(charging, negated)[0], run(driver, drive)[0])


def test_a_cells_voltage_gives_the_soc_of_its_curve(driver: Path) -> None:
    _, soc_pct = run(driver, [])
    assert MODEL.voltage_model().pseudo_ocv_at(soc_pct)[0] == pytest.approx(3.9 * CELLS, abs=1e-3)
