"""`cangauge fit`: JSON contract, files, refusals."""

from __future__ import annotations

from pathlib import Path

import pytest

from cangauge.errors import CangaugeError
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from live import in_process, refused, succeeds
from synthetic import synthetic_log

NAMES = ["k0", "k1", "k2", "k3", "k4", "k5", "k6", "k7", "kt", "R1", "R2", "R3", "R4"]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def output(tmp_path: Path) -> tuple[str, Path]:
    """The option of the model to write."""
    return "-o", tmp_path / "m.json"


def test_json_and_model_file_state_the_same(made: Path, output: tuple[str, Path]) -> None:
    # An option for captures does not apply to a log: it is told, and changes nothing.
    ran = succeeds("fit", made / "full.parquet", *output, "--vehicle", "leaf_ze0", "--json")
    assert "do not apply" in ran.err
    found = ran.json
    coefficients = found["coefficients"]
    assert list(coefficients) == NAMES
    assert {item["unit"] for item in coefficients.values()} == {"V", "V/K", "ohm"}
    assert found["capacity_ah"] == pytest.approx(CAPACITY_AH, rel=0.02)
    assert coefficients["R1"]["value"] == pytest.approx(-0.1032, rel=0.02)
    model = Model.load(output[1])
    assert model.coefficients["kt"].value == coefficients["kt"]["value"]
    assert model.capacity_ah == found["capacity_ah"]


def test_the_table_states_error_capacity_and_range(made: Path, output: tuple[str, Path]) -> None:
    ran = succeeds("fit", made / "full.parquet", *output)
    for text in ("voltage error, MAE", " V", " Ah", "identified at temperature"):
        assert text in ran.out
    for text in ("held out", "effects"):  # one log is left out of none
        assert text not in ran.out
    assert ran.err.index("note: Assuming an oxide chemistry") < ran.err.index("model: ")
    assert str(output[1]) in ran.err


def test_options_go_into_the_model_file(made: Path, output: tuple[str, Path]) -> None:
    succeeds(
        "fit", made / "full.parquet", *output, "--capacity-ah", "51", "--equation", "published",
        "--rate-hz", "0.5", "--delays", "0,20", "--epsilon", "0.04", "--t-ref", "25",
        "--initial-soc", "99.5",
    )  # fmt: skip
    model = Model.load(output[1])
    assert (model.capacity_ah, model.rate_hz) == (51.0, 0.5)
    assert model.published is not None
    assert [*model.published.delays_s] == [0.0, 20.0]
    assert (model.published.epsilon, model.published.t_ref_c) == (0.04, 25.0)
    assert model.made.options["initial_soc_pct"] == 99.5


def test_chemistry_and_cells_go_into_the_model_file(made: Path, output: tuple[str, Path]) -> None:
    given = ("fit", made / "full.parquet", *output, "--cells")
    succeeds(*given, "115", "--chemistry", "lfp")
    model = Model.load(output[1])
    assert (model.equation, model.chemistry, model.cells) == ("knots", "lfp", 115)
    found = succeeds(*given, "96", "--json").json
    assert found["chemistry"] == "oxide"
    assert any("V per cell" in text for text in found["remarks"])


def test_several_logs_and_a_report(made: Path, output: tuple[str, Path]) -> None:
    page = output[1].with_name("m.html")
    options = (*output, "--report", page, "--capacity-ah", "from-soc", "--json")
    found = succeeds("fit", made / "full.parquet", made / "part.csv", *options).json
    assert [item["name"] for item in found["logs"]] == ["full", "part"]
    assert found["capacity_ah"] == pytest.approx(CAPACITY_AH, rel=1e-3)
    assert found["held_out"]["voltage_mae_pct"] is None
    assert "too few logs" in found["held_out"]["judged_on"]
    assert found["report"] == str(page)
    text = page.read_text(encoding="utf-8")
    assert text.count("<figure>") > 5
    assert "not measured" in text
    assert files(page.parent) == ["m.html", "m.json"]


def test_effects_go_into_model_json_tables_and_report(made: Path, output: tuple[str, Path]) -> None:
    names = ["resistance_asymmetry", "fast_polarization"]
    page = output[1].with_name("m.html")
    given = ("fit", made / "full.parquet", *output, "--effects", ",".join(names))
    found = succeeds(*given, "--report", page, "--json").json
    by_id = {item["id"]: item["parameters"] for item in found["effects"]}
    assert set(by_id) == set(names)
    assert set(by_id["fast_polarization"]) == {"ohm", "tau_s", "activation_k"}
    assert [step["step"] for step in found["effect_search"]] == ["added", "added"]
    model = Model.load(output[1])
    assert [effect.id for effect, _ in model.extended_model().effects] == names
    assert model.made.options["effects"] == ", ".join(names)
    assert "not proof of a mechanism" in page.read_text(encoding="utf-8")
    assert all(name in succeeds(*given).out for name in names)
    succeeds("estimate", made / "part.csv", "-m", output[1], "-o", page.with_name("e.csv"))


def test_effects_by_left_out_logs_need_three(made: Path, output: tuple[str, Path]) -> None:
    ran = succeeds("fit", made / "full.parquet", *output, "--effects", "auto")
    assert "effects need three logs" in ran.err


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("full.parquet --effects gremlin", ["--effects", "gremlin", "known are", "hysteresis"]),
        ("full.parquet --effects auto,hysteresis", ["--effects", "auto alone"]),
        ("full.parquet --effects voltage_offset", ["--effects", "the curve absorbs it"]),
        ("full.parquet --equation published --effects hysteresis", ["--effects", "hysteresis"]),
        ("full.parquet --delays 0,10,5", ["--delays", "increase", "0,10,5"]),
        ("full.parquet --delays 0,20", ["--delays", "--equation published"]),
        ("full.parquet --delays 0;10", ["--delays", "0;10"]),
        ("full.parquet --chemistry lead", ["--chemistry", "lead"]),
        ("full.parquet --epsilon 0.6", ["--epsilon", "0.6"]),
        ("full.parquet --rate-hz 0", ["--rate-hz"]),
        ("full.parquet --rate-hz nan", ["--rate-hz"]),
        ("full.parquet --capacity-ah many", ["--capacity-ah", "many", "from-soc"]),
        ("full.parquet --capacity-ah -51", ["--capacity-ah", "-51"]),
        ("full.parquet --capacity-ah 0.5", ["charge and SoC contradict each other", "0.5 Ah"]),
        ("full.parquet --capacity-ah 120", ["charge and SoC contradict each other", "120 Ah"]),
        ("full.parquet --initial-soc 120", ["--initial-soc", "120"]),
        ("full.parquet --report no/such/m.html", ["no/such/m.html", "folder"]),
        ("full.parquet --report m.json", ["--report", ".html"]),
        ("full.parquet -o keep.csv", ["--output", "keep.csv", ".json"]),
        ("full.parquet full.parquet", ["same rows as", "give each log once"]),
        ("part.csv -o part.csv", ["part.csv", "suffix"]),
        ("part.csv", ["part.csv", "capacity_ah", "--capacity-ah"]),
        ("none.csv", ["none.csv", "no such file"]),
        ("none.csv --initial-soc 90 --initial-soc auto", ["--initial-soc", "2 values for 1 log"]),
    ],
)
def test_bad_input_gets_one_line_and_writes_nothing(
    made: Path,
    output: tuple[str, Path],
    monkeypatch: pytest.MonkeyPatch,
    given: str,
    words: list[str],
) -> None:
    monkeypatch.chdir(made)
    before = {path: path.read_bytes() for path in made.iterdir()}
    refused(in_process("fit", *output, *given.split()), *words)
    assert {path: path.read_bytes() for path in made.iterdir()} == before
    assert files(output[1].parent) == []


def test_a_row_with_a_missing_value_is_left_out_and_told(
    made: Path, tmp_path: Path, output: tuple[str, Path]
) -> None:
    text = (made / "part.csv").read_text(encoding="utf-8").splitlines()
    cells = text[100].split(",")
    cells[text[0].replace('"', "").split(",").index("voltage_v")] = "nan"
    text[100] = ",".join(cells)
    (tmp_path / "holes.csv").write_text("\n".join(text) + "\n", encoding="utf-8")
    ran = succeeds("fit", tmp_path / "holes.csv", *output, "--capacity-ah", "51")
    assert "1 row" in ran.err
    assert "voltage_v" in ran.err or "missing" in ran.err


def test_a_report_that_fails_leaves_the_model_before(
    made: Path, output: tuple[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_result: object) -> str:
        raise CangaugeError("no ink")

    monkeypatch.setattr("cangauge.extras.report.fit.fit_page", broken)
    output[1].write_text("the model before", encoding="utf-8")
    page = output[1].with_name("m.html")
    ran = in_process("fit", made / "full.parquet", *output, "--report", page)
    assert ran.code == 1
    assert "no ink" in ran.err
    assert files(page.parent) == ["m.json"]
    assert output[1].read_text(encoding="utf-8") == "the model before"


@pytest.mark.real
def test_a_capture_needs_its_vehicle(shared_data: Path, output: tuple[str, Path]) -> None:
    capture = shared_data / "leaf_can" / "ZE0w24kWhstock.log.gz"
    refused(in_process("fit", capture, *output), "CAN capture", "--vehicle")
    # Parked for 78 s: with its vehicle it is read, and holds too little for a model.
    ran = in_process("fit", capture, *output, "--vehicle", "leaf_ze0", "--capacity-ah", "50")
    refused(ran, "only 8 rows can be used, and a fit needs 52")


def test_columns_and_starts_of_a_loggers_tables(tmp_path: Path, output: tuple[str, Path]) -> None:
    paths = []
    for seed, (start, end) in enumerate(((90.0, 30.0), (75.0, 45.0)), start=1):
        log = synthetic_log(hours=0.8, start_pct=start, end_pct=end, noise_v=0.3, seed=seed)
        rows = zip(log.time_s, -1e3 * log.current_a, log.voltage_v, log.temperature_c, strict=True)
        path = tmp_path / f"drive{seed}.csv"
        path.write_text("Stempel;Ibatt x;U [V];T1\n" + "".join(
            f"{t};{i};{u};{c}\n" for t, i, u, c in rows
        ))  # fmt: skip
        paths.append(path)
    columns = (*output, "--columns", "time=Stempel,current=Ibatt x[mA]")

    def fitted(*options: object, logs: list[Path] = paths) -> list[object]:
        starts = [word for start in options for word in ("--initial-soc", start)]
        return ["fit", *logs, *columns, "--capacity-ah", CAPACITY_AH, *starts]

    ran = succeeds(*fitted("90", "auto"), "--json")
    found = ran.json
    assert [item["initial_soc_from"] for item in found["logs"]] == ["given", "estimated"]
    assert found["logs"][1]["initial_soc_pct"] == pytest.approx(75.0, abs=6.0)
    assert list(found["assumed"]) == [str(path) for path in paths]
    assert "positive current charges, found from the data" in found["assumed"][str(paths[0])]
    assert f'{paths[0]}: read as time = "Stempel" [s, assumed], current = "Ibatt x" [mA]' in ran.err
    refused(in_process(*fitted()), "no log states", "--initial-soc")
    refused(in_process(*fitted("90", "120")), "100 %")
    refused(in_process(*fitted("9", "8", logs=paths[:1])), "2 values")


def test_a_count_that_differs_from_the_log_is_told(
    made: Path, tmp_path: Path, output: tuple[str, Path]
) -> None:
    options = ("--capacity-ah", "45", "--initial-soc", "80", "--json")
    remarks = succeeds("fit", made / "part.csv", *output, *options).json["remarks"]
    (told,) = [text for text in remarks if "imply a capacity of" in text]
    assert f"imply a capacity of {CAPACITY_AH:.1f} Ah; 45.0 Ah is used" in told
    ran = in_process("estimate", made / "part.csv", "-m", output[1], "-o", tmp_path / "soc.csv")
    assert "imply a capacity of" in ran.err


@pytest.mark.parametrize(("share", "cells"), [(1.0, 104), (0.5, None)])
def test_columns_of_all_cells_tell_their_number_and_chemistry(
    tmp_path: Path, output: tuple[str, Path], share: float, cells: int | None
) -> None:
    log = synthetic_log(hours=0.3, start_pct=80.0, end_pct=60.0, noise_v=0.5, seed=3)
    names = [f"Cell {number} [V]" for number in range(1, 105)]
    rows = zip(log.time_s, log.current_a, log.voltage_v, log.temperature_c, strict=True)
    lines = [",".join(["Time [s]", "Current [A]", "Voltage [V]", "Temperature [°C]", *names])]
    lines += [",".join(map(str, [*row, *[share * row[2] / 104] * 104])) for row in rows]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    options = (*output, "--capacity-ah", "50", "--initial-soc", "80", "--json")
    ran = in_process("fit", path, *options)
    found = ran.json
    assert found["cells"] == cells
    assert ("V per cell" in " ".join(found["remarks"])) == (cells is not None)
    assert "104 cells: Cell 1 [V] … Cell 104 [V]" in ran.err
