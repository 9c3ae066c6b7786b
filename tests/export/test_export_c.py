"""`cangauge export-c`: the exported sources compile cleanly and give the package's numbers."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner
from untested import export_untested

from cangauge.bus.recording import read_log
from cangauge.cli.app import app
from cangauge.errors import InputError
from cangauge.estimation.estimator import Estimator
from cangauge.estimation.offline import run_estimator, samples_of
from cangauge.estimation.settings import EstimatorSettings
from cangauge.extras.embedded.c_source import CORE_HEADERS, CORE_SOURCES, TabulatedModel
from cangauge.extras.embedded.embedded import drive_with_events, export_c, std_at_rest_pct
from cangauge.identify.fit import fit
from cangauge.model.model_file import Model
from cangauge.model.published import leaf_2012_model_file
from cangauge.types import Reason, Sample
from estimation.test_snapshot import EVENTFUL, extended_by
from live import in_process
from selection import nightly_except
from synthetic import synthetic_log

PLAIN = leaf_2012_model_file()
EFFECTS = [
    "current_offset", "voltage_gain", "time_skew", "core_temperature", "resistance_temperature",
    "resistance_soc", "charge_transfer", "slow_diffusion", "hysteresis",
]  # fmt: skip
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-ffp-contract=off"]

needs_make = pytest.mark.skipif(
    not (shutil.which("make") and shutil.which("cc")), reason="no make or no C compiler"
)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Exports of the published model, of it with effects, and of a curve of knots."""
    models = {
        "plain": PLAIN,
        "effects": extended_by(EFFECTS),
        "knots": Model.prior("oxide", 96, 60.0),
    }
    made = {}
    for name, model in models.items():
        made[name] = tmp_path_factory.mktemp(name)
        (export_untested if name == "plain" else export_c)(model, made[name])
    return made


@pytest.fixture
def untested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exports have a short drive of their own tests."""
    monkeypatch.setattr("cangauge.extras.embedded.embedded.GOLDEN_S", 10.0)


def run(folder: Path, *command: str) -> str:
    done = subprocess.run(
        command, check=False, cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@needs_make
@pytest.mark.parametrize(
    ("which", "flags"),
    [("knots", []), ("effects", [f"FLAGS={' '.join(STRICT)} -O0 -DCANGAUGE_CONFIG"])],
)
def test_exported_tests_pass(folders: dict[str, Path], which: str, flags: list[str]) -> None:
    output = run(folders[which], "make", "test", *flags)
    doubles, _, floats = output.partition("./test-float")
    assert doubles.count("PASSED") == floats.count("PASSED") == 1


@needs_make
@pytest.mark.parametrize("real", ["double", "float"])
def test_core_compiles_without_a_warning(folders: dict[str, Path], real: str) -> None:
    for folder, config in ((folders["effects"], "-DCANGAUGE_CONFIG"), (folders["plain"], "-DX")):
        run(
            folder, "cc", *STRICT, config, f"-DCANGAUGE_REAL={real}", "-fsyntax-only", *CORE_SOURCES
        )


@needs_make
@pytest.mark.nightly
def test_sanitizers_find_nothing(folders: dict[str, Path]) -> None:
    flags = [*STRICT, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    own = ["pack_model.c", "frames.c", "test.c"]
    folder = folders["effects"]
    run(folder, "cc", *flags, "-DCANGAUGE_CONFIG", *CORE_SOURCES, *own, "-lm", "-o", "sanitized")
    assert "PASSED" in run(folder, "./sanitized")


@needs_make
@pytest.mark.parametrize(
    ("which", "real"),
    nightly_except([("effects", "double")], [("knots", "float"), ("effects", "double")]),
)
def test_no_sample_leaves_the_language(folders: dict[str, Path], which: str, real: str) -> None:
    sanitize = ["-g", "-fsanitize=address,undefined,float-cast-overflow"]
    flags = [*STRICT[:3], *sanitize, "-fno-sanitize-recover=all", f"-DCANGAUGE_REAL={real}"]
    shutil.copy(Path(__file__).with_name("hostile.c"), folders[which])
    files = [*CORE_SOURCES, "pack_model.c", "hostile.c"]
    program = f"hostile-{real}"
    run(folders[which], "cc", *flags, "-DCANGAUGE_CONFIG", *files, "-lm", "-o", program)
    assert "PASSED" in run(folders[which], f"./{program}")


AT = 400
"""Sample of `EVENTFUL` at which another table is set."""


def switched(folder: Path, first: Model, later: Model, real: str) -> np.ndarray:
    """Return SoC, its deviation, SoC by voltage and by counting, and reasons of `EVENTFUL`."""
    for name, model in (("pack", first), ("later", later)):
        export_untested(model, folder / name, period_s=0.2)
    shutil.copy(folder / "later" / "pack_model.c", folder / "pack" / "later.c")
    shutil.copy(Path(__file__).with_name("table.c"), folder / "pack")
    flags = [*STRICT[:3], "-DCANGAUGE_CONFIG", f"-DCANGAUGE_REAL={real}", STRICT[-1]]
    run(folder / "pack", "cc", *flags, "-Dpack_model=later_model", "-c", "later.c")
    sources = [*CORE_SOURCES, "pack_model.c", "later.o", "table.c"]
    run(folder / "pack", "cc", *flags, *sources, "-lm", "-o", "table")
    done = subprocess.run(
        ["./table", str(AT)], check=True, cwd=folder / "pack", capture_output=True, text=True,
        input="".join(",".join(map(repr, sample)) + "\n" for sample in EVENTFUL), timeout=60,
    )  # fmt: skip
    return np.array([line.split() for line in done.stdout.splitlines()], float)


def short_lined() -> Model:
    data = PLAIN.model_dump()
    data["published"]["delays_s"] = [0.0, 1.0, 2.0, 3.0]
    return Model.model_validate(data)


@needs_make
@pytest.mark.parametrize(
    ("which", "real"),
    nightly_except(
        [("shorter", "double")], [("fitted", "double"), ("shorter", "double"), ("shorter", "float")]
    ),
)
def test_a_later_table_goes_on_as_python_does(which: str, real: str, tmp_path: Path) -> None:
    if which == "fitted":
        log = synthetic_log(hours=0.5, rate_hz=1.0, start_pct=85.0, end_pct=60.0)
        first, later = Model.prior("oxide", 96, 60.0), fit(log, capacity_ah=58.0).model
    else:
        first, later = PLAIN, short_lined()
    found = switched(tmp_path, first, later, real)
    before, after = (Estimator(TabulatedModel.of(model)) for model in (first, later))
    expected = [before.step(sample) for sample in EVENTFUL[:AT]]
    after.take_over(before)
    expected += [after.step(sample) for sample in EVENTFUL[AT:]]
    atol, share = (1e-9, 1.0) if real == "double" else (0.02, 0.99)
    np.testing.assert_allclose(found[:, :4], [each[1:5] for each in expected], rtol=0.0, atol=atol)
    assert np.mean(found[:, 4] == [int(each.reasons) for each in expected]) >= share


@needs_make
def test_a_table_with_longer_delays_fills_its_delay_line(tmp_path: Path) -> None:
    short, long = short_lined(), PLAIN
    reasons = switched(tmp_path, short, long, "double")[:, 4].astype(int)
    is_filling = reasons & int(Reason.DELAY_LINE_FILLING) != 0
    time_s = np.array([sample.time_s for sample in EVENTFUL])
    filled_s = long.voltage_model().loads.delays_s[-1]
    assert not is_filling[AT - 1]
    after = (time_s >= time_s[AT]) & (time_s < time_s[AT] + filled_s - 4.0)
    assert is_filling[after].all()


@pytest.mark.skipif(not shutil.which("cppcheck"), reason="no cppcheck")
def test_cppcheck_finds_nothing(folders: dict[str, Path]) -> None:
    run(
        folders["effects"], "cppcheck", "--std=c99", "--quiet", "--error-exitcode=1",
        "--enable=warning,style,performance,portability",
        *CORE_SOURCES,
    )  # fmt: skip


needs_arm = pytest.mark.skipif(
    not (shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")),
    reason="no gcc-arm-none-eabi or no qemu-system-arm",
)


@needs_arm
@pytest.mark.nightly
def test_all_effects_give_the_numbers_on_a_cortex_m4f(folders: dict[str, Path]) -> None:
    assert "PASSED" in run(folders["effects"], "make", "arm")


@needs_arm
def test_a_cortex_m4f_gives_the_numbers_in_its_budget(folders: dict[str, Path]) -> None:
    output = run(folders["knots"], "make", "arm")
    assert "PASSED" in output
    core = re.findall(r"^ *(\d+).*\scangauge\w*\.o$", output, re.MULTILINE)
    assert len(core) == len(CORE_SOURCES)
    assert sum(map(int, core)) <= 16 * 1024
    steps = re.search(r"a sample, (\d+) where its voltage is used", output)
    assert steps is not None
    assert int(steps[1]) <= 24000
    memory = re.search(r"bytes: state (\d+), delay line (\d+)", output)
    assert memory is not None
    assert int(memory[1]) + int(memory[2]) <= 4096


def test_the_table_is_the_published_equation() -> None:
    curve = PLAIN.voltage_model().curve
    table = TabulatedModel.of(PLAIN).voltage_model().curve
    soc_pct = np.linspace(-5.0, 105.0, 20_001)
    error_v = np.abs(table.values(soc_pct) - curve.values(soc_pct))
    assert (error_v / curve.slopes(soc_pct)).max() < 1e-3  # [% SoC]


@pytest.mark.usefixtures("untested")
def test_a_pack_without_logs_is_exported_with_its_uncertainty(tmp_path: Path) -> None:
    given = ("--chemistry", "lfp", "--cells", "16", "--capacity-ah", "280")
    told = in_process("export-c", *given, "-o", tmp_path / "c", "--json")
    result = json.loads(told.out)
    assert "pack_model.c" in result["files"]
    # Iron phosphate is flat: half a minute of rest tells little.
    assert result["std_at_rest_pct"] > 5.0
    assert in_process("export-c", "--cells", "16", "-o", tmp_path / "d").code == 2


@needs_make
@pytest.mark.parametrize("text", ["", "time,current\n", "0,1,385,23\nlast line\n"])
def test_example_tells_what_is_no_sample(folders: dict[str, Path], text: str) -> None:
    run(folders["plain"], "make", "example")
    done = subprocess.run(
        ["./example"], check=False, cwd=folders["plain"], input=text, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 1
    assert "time,current,voltage,temperature" in done.stderr


@needs_make
def test_example_writes_a_frame_for_each_sample(folders: dict[str, Path]) -> None:
    run(folders["plain"], "make", "example")
    rows = "time_s,current_a,voltage_v,temperature_c\n"
    rows += "".join(f"{k},{10.0},{385.0},{23.0}\n" for k in range(20))
    done = subprocess.run(
        ["./example"], check=True, cwd=folders["plain"], input=rows, capture_output=True, text=True,
        timeout=60,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert len(lines) == 20
    assert all(re.search(r"reasons [0-9a-f]{5},( [0-9A-F]{2}){8}$", line) for line in lines)


@needs_make
@pytest.mark.nightly
@pytest.mark.real
def test_floats_estimate_a_held_out_trip_as_python(shared_data: Path, tmp_path: Path) -> None:
    trips = [read_log(shared_data / "bmw_i3" / f"TripA0{k}.csv.gz") for k in (1, 3, 5, 6)]
    *training, held_out = trips
    model, log = fit(training, capacity_ah=60.0).model, held_out.rows(slice(None, None, 10))
    export_c(model, tmp_path, period_s=1.0)
    run(tmp_path, "make", "example", "CC=cc -DCANGAUGE_REAL=float")
    rows = "".join(",".join(map(repr, sample)) + "\n" for sample in samples_of(log))
    done = subprocess.run(
        ["./example"], check=True, cwd=tmp_path, input=rows, capture_output=True, text=True,
        timeout=60,
    )  # fmt: skip
    found = [float(line.split()[1]) for line in done.stdout.splitlines()]
    expected = run_estimator(log, model, EstimatorSettings()).soc_pct
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_core_calls_nothing_but_mathematics(folders: dict[str, Path]) -> None:
    for name in CORE_HEADERS + CORE_SOURCES:
        text = (folders["plain"] / name).read_text(encoding="utf-8")
        included = set(re.findall(r'#include [<"]([^>"]+)', text))
        assert included <= {
            "math.h", "stdbool.h", "stddef.h", "stdint.h", "cangauge.h", "cangauge_internal.h",
            "cangauge_config.h",
        }  # fmt: skip
        assert not re.search(r"\b(malloc|calloc|free|goto|setjmp)\b", text)


def test_drive_of_the_tests_has_its_events() -> None:
    samples = list(drive_with_events(PLAIN, 0.1))
    steps = [b.time_s - a.time_s for a, b in pairwise(samples)]
    assert min(steps) < 0.2
    assert sum(step > 2.0 for step in steps) == 2
    assert any(sample.voltage_v != sample.voltage_v for sample in samples)
    assert all(isinstance(sample, Sample) for sample in samples)


@pytest.mark.usefixtures("untested")
def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    PLAIN.save(tmp_path / "pack.json")
    (tmp_path / "ecm.py").write_text("kept")
    arguments = ["export-c", "-m", str(tmp_path / "pack.json"), "-o", str(tmp_path / "ecm.py")]
    with pytest.raises(InputError, match="this folder cannot be made: File exists") as error:
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert (error.value.field, error.value.value) == ("--output", arguments[-1])
    assert (tmp_path / "ecm.py").read_text() == "kept"


@pytest.mark.usefixtures("untested")
def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    PLAIN.save(tmp_path / "pack.json")
    arguments = ["export-c", "-m", str(tmp_path / "pack.json"), "-o", str(tmp_path / ("x" * 300))]
    with pytest.raises(InputError, match="too long"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)


@pytest.mark.usefixtures("untested")
def test_own_files_are_kept(tmp_path: Path) -> None:
    (tmp_path / "Makefile").write_text("kept")
    with pytest.raises(InputError, match="not from an export") as error:
        export_c(PLAIN, tmp_path)
    assert error.value.value == ["Makefile"]
    assert [each.name for each in tmp_path.iterdir()] == ["Makefile"]
    assert (tmp_path / "Makefile").read_text() == "kept"


@pytest.mark.usefixtures("untested")
def test_command_renews_an_export_and_names_what_it_wrote(tmp_path: Path) -> None:
    PLAIN.save(tmp_path / "pack.json")
    arguments = ["export-c", "-m", str(tmp_path / "pack.json"), "-o", str(tmp_path / "c"), "--json"]
    for period in ("0.1", "1.0"):
        done = CliRunner().invoke(app, [*arguments, "--period", period])
        assert done.exit_code == 0, done.output
    assert (tmp_path / "c" / "pack_model.c").is_file()
    assert '"delay_line_bytes"' in done.output


def test_period_out_of_range_is_refused(tmp_path: Path) -> None:
    pack = ("--cells", "16", "--capacity-ah", "60")
    told = in_process("export-c", *pack, "-o", tmp_path / "c", "--period", "0")
    assert (told.code, "--period: must lie within 0.001" in told.err) == (2, True)


def test_a_model_with_a_time_skew_states_its_uncertainty_at_rest() -> None:
    assert std_at_rest_pct(extended_by(["time_skew"])) == pytest.approx(std_at_rest_pct(PLAIN))
