"""`cangauge fit`: JSON contract, files, refusals."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cangauge.bus.recording import read_log
from cangauge.errors import CangaugeError
from cangauge.logs.canonical import write_log
from cangauge.model.model_file import Model
from cangauge.model.published import CAPACITY_AH
from synthetic import synthetic_log

Run = Callable[..., object]

CONTRACT = {
    "voltage_mae_pct",
    "voltage_rmse_v",
    "soc_newton_mae_pct",
    "capacity_ah",
    "slope_ohm",
    "condition_number",
    "coefficients",
    "energy",
}
ENERGY = {"driven_kwh", "regenerated_kwh", "net_kwh", "heat_kwh", "efficiency_pct"}
NAMES = ["k0", "k1", "k2", "k3", "k4", "k5", "k6", "k7", "kt", "R1", "R2", "R3", "R4"]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_json_is_one_object_that_keeps_the_contract(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run("fit", made / "full.parquet", "-o", tmp_path / "m.json", "--json")
    assert ran.code == 0
    found = json.loads(ran.out)
    assert set(found) >= CONTRACT
    assert set(found["energy"]) == ENERGY
    assert list(found["coefficients"]) == NAMES
    assert all(
        set(item) == {"value", "std_error", "unit"} for item in found["coefficients"].values()
    )
    assert {item["unit"] for item in found["coefficients"].values()} == {"V", "V/K", "ohm"}
    assert found["capacity_ah"] == pytest.approx(CAPACITY_AH, rel=0.02)
    assert found["coefficients"]["R1"]["value"] == pytest.approx(-0.1032, rel=0.02)
    model = Model.load(tmp_path / "m.json")
    assert model.coefficients["kt"].value == found["coefficients"]["kt"]["value"]
    assert model.capacity_ah == found["capacity_ah"]


def test_the_table_states_error_capacity_and_range(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run("fit", made / "full.parquet", "-o", tmp_path / "m.json")
    assert ran.code == 0
    for text in ("voltage error, MAE", " V", " Ah", "identified at temperature"):
        assert text in ran.out
    for text in ("held out", "effects"):  # one log is left out of none
        assert text not in ran.out
    assert ran.err.index("note: chemistry taken as oxide") < ran.err.index("model: ")
    assert str(tmp_path / "m.json") in ran.err


def test_options_go_into_the_model_file(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run(
        "fit", made / "full.parquet", "-o", tmp_path / "m.json", "--capacity-ah", "51",
        "--equation", "published", "--rate-hz", "0.5", "--delays", "0,20", "--epsilon", "0.04",
        "--t-ref", "25", "--initial-soc", "99.5",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    model = Model.load(tmp_path / "m.json")
    assert model.capacity_ah == 51.0
    assert model.rate_hz == 0.5
    assert model.published is not None
    assert model.published.delays_s == [0.0, 20.0]
    assert model.published.epsilon == 0.04
    assert model.published.t_ref_c == 25.0
    assert model.made.options["initial_soc_pct"] == 99.5


def test_chemistry_and_cells_go_into_the_model_file(run: Run, made: Path, tmp_path: Path) -> None:
    given = ("fit", made / "full.parquet", "-o", tmp_path / "m.json", "--cells")
    ran = run(*given, "96", "--chemistry", "lfp")
    assert ran.code == 0, ran.err
    model = Model.load(tmp_path / "m.json")
    assert (model.equation, model.chemistry, model.cells) == ("knots", "lfp", 96)
    ran = run(*given, "96", "--json")
    assert json.loads(ran.out)["chemistry"] == "oxide"
    assert any("V per cell" in text for text in json.loads(ran.out)["remarks"])


def test_capacity_from_the_logs_own_soc(run: Run, made: Path, tmp_path: Path) -> None:
    part = made / "part.csv"
    ran = run("fit", part, "-o", tmp_path / "m.json", "--capacity-ah", "from-soc", "--json")
    assert ran.code == 0, ran.err
    assert json.loads(ran.out)["capacity_ah"] == pytest.approx(CAPACITY_AH, rel=1e-3)


def test_several_logs_and_a_report(run: Run, made: Path, tmp_path: Path) -> None:
    logs = (made / "full.parquet", made / "part.csv")
    out = ("-o", tmp_path / "m.json", "--report", tmp_path / "m.html")
    ran = run("fit", *logs, *out, "--capacity-ah", "from-soc", "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert [item["name"] for item in found["logs"]] == ["full", "part"]
    assert found["held_out"]["voltage_mae_pct"] is None
    assert "too few logs" in found["held_out"]["judged_on"]
    assert found["report"] == str(tmp_path / "m.html")
    text = (tmp_path / "m.html").read_text(encoding="utf-8")
    assert text.count("<figure>") > 5
    assert "not measured" in text
    assert files(tmp_path) == ["m.html", "m.json"]


def test_effects_go_into_model_json_tables_and_report(run: Run, made: Path, tmp_path: Path) -> None:
    given = ("fit", made / "full.parquet", "-o", tmp_path / "m.json")
    chosen = ("--effects", "resistance_asymmetry,fast_polarization")
    ran = run(*given, *chosen, "--report", tmp_path / "m.html", "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert set(found) >= CONTRACT
    by_id = {item["id"]: item["parameters"] for item in found["effects"]}
    assert set(by_id) == {"fast_polarization", "resistance_asymmetry"}
    assert set(by_id["fast_polarization"]) == {"ohm", "tau_s", "activation_k"}
    assert [step["step"] for step in found["effect_search"]] == ["added", "added"]
    model = Model.load(tmp_path / "m.json")
    assert [effect.id for effect, _ in model.extended_model().effects] == [
        "resistance_asymmetry", "fast_polarization",
    ]  # fmt: skip
    assert model.made.options["effects"] == "resistance_asymmetry, fast_polarization"
    page = (tmp_path / "m.html").read_text(encoding="utf-8")
    assert "not proof of a mechanism" in page
    ran = run(*given, *chosen)
    assert ran.code == 0, ran.err
    assert "resistance_asymmetry, fast_polarization" in ran.out
    ran = run("estimate", made / "part.csv", "-m", tmp_path / "m.json", "-o", tmp_path / "e.csv")
    assert ran.code == 0, ran.err


def test_effects_by_left_out_logs_need_three(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run("fit", made / "full.parquet", "-o", tmp_path / "m.json", "--effects", "auto")
    assert ran.code == 0
    assert "effects need three logs" in ran.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--effects", "gremlin"], ["--effects", "gremlin", "known are", "hysteresis"]),
        (["--effects", "auto,hysteresis"], ["--effects", "auto alone"]),
        (["--effects", "voltage_offset"], ["--effects", "voltage_offset", "the curve absorbs it"]),
        (["--delays", "0,10,5"], ["--delays", "increase", "0,10,5"]),
        (["--delays", "0,20"], ["--delays", "--equation published"]),
        (["--chemistry", "lead"], ["--chemistry", "lead"]),
        (["--equation", "published", "--effects", "hysteresis"], ["--effects", "hysteresis"]),
        (["--delays", "0;10"], ["--delays", "0;10"]),
        (["--epsilon", "0.6"], ["--epsilon", "0.6"]),
        (["--rate-hz", "0"], ["--rate-hz"]),
        (["--rate-hz", "nan"], ["--rate-hz"]),
        (["--capacity-ah", "many"], ["--capacity-ah", "many", "from-soc"]),
        (["--capacity-ah", "-51"], ["--capacity-ah", "-51"]),
        (["--capacity-ah", "0.5"], ["soc_pct", "--capacity-ah"]),
        (["--initial-soc", "120"], ["--initial-soc", "120"]),
        (["--report", "no/such/folder/m.html"], ["no/such/folder/m.html", "folder"]),
        (["--report", "m.json"], ["--report", ".html"]),
        (["-o", "keep.csv"], ["--output", "keep.csv", ".json"]),
    ],
)
def test_bad_options_get_one_line_and_write_nothing(
    run: Run, made: Path, tmp_path: Path, options: list[str], words: list[str]
) -> None:
    ran = run("fit", made / "full.parquet", "-o", tmp_path / "m.json", *options)
    refused(ran, *words)
    assert files(tmp_path) == []


def refused(ran: object, *words: str) -> None:
    """Assert exit code 2, nothing on stdout, and one line of error that has these words."""
    assert ran.code == 2
    assert ran.out == ""
    errors = [line for line in ran.err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert "Traceback" not in ran.err
    for word in words:
        assert word in errors[0]


def test_no_capacity_names_the_cure(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run("fit", made / "part.csv", "-o", tmp_path / "m.json")
    refused(ran, "part.csv", "capacity_ah", "--capacity-ah")
    assert files(tmp_path) == []


def test_turned_current_is_refused(run: Run, made: Path, tmp_path: Path) -> None:
    log = read_log(made / "full.parquet")
    write_log(replace(log, current_a=-log.current_a), tmp_path / "turned.parquet")
    ran = run("fit", tmp_path / "turned.parquet", "-o", tmp_path / "m.json")
    refused(ran, "turned.parquet", "current_a", "multiply the column by -1")
    assert files(tmp_path) == ["turned.parquet"]


def test_missing_log(run: Run, tmp_path: Path) -> None:
    ran = run("fit", tmp_path / "none.csv", "-o", tmp_path / "m.json")
    refused(ran, "none.csv", "no such file")


def test_row_with_a_missing_value_is_left_out_and_said(
    run: Run, made: Path, tmp_path: Path
) -> None:
    text = (made / "part.csv").read_text(encoding="utf-8").splitlines()
    cells = text[100].split(",")
    cells[text[0].replace('"', "").split(",").index("voltage_v")] = "nan"
    text[100] = ",".join(cells)
    (tmp_path / "holes.csv").write_text("\n".join(text) + "\n", encoding="utf-8")
    ran = run("fit", tmp_path / "holes.csv", "-o", tmp_path / "m.json", "--capacity-ah", "51")
    assert ran.code == 0, ran.err
    assert "1 row" in ran.err
    assert "voltage_v" in ran.err or "missing" in ran.err


def test_the_output_must_be_named(run: Run, made: Path) -> None:
    assert run("fit", made / "full.parquet").code == 2


def test_outputs_must_not_overwrite_input(run: Run, made: Path) -> None:
    log = made / "part.csv"
    before = log.read_bytes()
    refused(run("fit", log, "-o", log), "part.csv", "suffix")
    assert log.read_bytes() == before


def test_a_report_that_fails_leaves_no_model(
    run: Run, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_result: object) -> str:
        raise CangaugeError("no ink")

    monkeypatch.setattr("cangauge.extras.report.fit.fit_page", broken)
    (tmp_path / "m.json").write_text("the model before", encoding="utf-8")
    out = ("-o", tmp_path / "m.json", "--report", tmp_path / "m.html")
    ran = run("fit", made / "full.parquet", *out)
    assert ran.code == 1
    assert "no ink" in ran.err
    assert files(tmp_path) == ["m.json"]
    assert (tmp_path / "m.json").read_text(encoding="utf-8") == "the model before"


@pytest.mark.real
def test_a_capture_needs_its_vehicle(run: Run, shared_data: Path, tmp_path: Path) -> None:
    capture = shared_data / "leaf_can" / "ZE0w24kWhstock.log.gz"
    refused(run("fit", capture, "-o", tmp_path / "m.json"), "CAN capture", "--vehicle")
    # Parked for 78 s: with its vehicle it is read, and holds too little for a model.
    options = ("--vehicle", "leaf_ze0", "--capacity-ah", "50")
    ran = run("fit", capture, "-o", tmp_path / "m.json", *options)
    refused(ran, "only 8 rows can be used, and a fit needs 52")


def test_vehicle_options_do_not_apply_to_a_log(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run(
        "fit", made / "full.parquet", "-o", tmp_path / "m.json", "--vehicle", "leaf_ze0", "--json"
    )
    assert ran.code == 0
    assert "do not apply" in ran.err
    assert np.isfinite(json.loads(ran.out)["voltage_rmse_v"])


def test_columns_and_starts_of_a_logger_s_tables(run: Run, tmp_path: Path) -> None:
    paths = []
    for seed, (start, end) in enumerate(((90.0, 30.0), (75.0, 45.0)), start=1):
        log = synthetic_log(hours=0.8, start_pct=start, end_pct=end, noise_v=0.3, seed=seed)
        rows = zip(log.time_s, -1e3 * log.current_a, log.voltage_v, log.temperature_c, strict=True)
        path = tmp_path / f"drive{seed}.csv"
        path.write_text("Stempel;Ibatt x;U [V];T1\n" + "".join(
            f"{t};{i};{u};{c}\n" for t, i, u, c in rows
        ))  # fmt: skip
        paths.append(path)
    options = ("-o", tmp_path / "m.json", "--columns", "time=Stempel,current=Ibatt x[mA]")
    refused(run("fit", *paths, *options, "--capacity-ah", "51"), "no log states", "--initial-soc")
    starts = ("--capacity-ah", CAPACITY_AH, "--initial-soc", "90", "--initial-soc", "auto")
    ran = run("fit", *paths, *options, *starts, "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert [item["initial_soc_from"] for item in found["logs"]] == ["given", "estimated"]
    assert found["logs"][1]["initial_soc_pct"] == pytest.approx(75.0, abs=6.0)
    assert list(found["assumed"]) == [str(path) for path in paths]
    assert "positive current charges, found from the data" in found["assumed"][str(paths[0])]
    assert f'{paths[0]}: read as time = "Stempel" [s, assumed], current = "Ibatt x" [mA]' in ran.err
    refused(run("fit", *paths, *options, "--initial-soc", "90", "--initial-soc", "120"), "100 %")
    refused(run("fit", paths[0], *options, "--initial-soc", "9", "--initial-soc", "8"), "2 values")


def test_the_same_log_twice_is_refused(run: Run, made: Path, tmp_path: Path) -> None:
    ran = run("fit", made / "full.parquet", made / "full.parquet", "-o", tmp_path / "m.json")
    refused(ran, "same rows as", "give each log once")


def test_a_count_that_differs_from_the_log_is_told(run: Run, made: Path, tmp_path: Path) -> None:
    options = ("--capacity-ah", "45", "--initial-soc", "80", "-o", tmp_path / "m.json", "--json")
    ran = run("fit", made / "part.csv", *options)
    assert ran.code == 0, ran.err
    remarks = json.loads(ran.out)["remarks"]
    told = [text for text in remarks if "imply a capacity of" in text]
    assert len(told) == 1
    assert f"imply a capacity of {CAPACITY_AH:.1f} Ah; 45.0 Ah is used" in told[0]
    out = ("-o", tmp_path / "soc.csv")
    ran = run("estimate", made / "part.csv", "-m", tmp_path / "m.json", *out)
    assert "imply a capacity of" in ran.err


@pytest.mark.parametrize(("share", "cells"), [(1.0, 104), (0.5, None)])
def test_columns_of_all_cells_tell_their_number_and_chemistry(
    run: Run, tmp_path: Path, share: float, cells: int | None
) -> None:
    log = synthetic_log(hours=0.3, start_pct=80.0, end_pct=60.0, noise_v=0.5, seed=3)
    names = [f"Cell {number} [V]" for number in range(1, 105)]
    rows = zip(log.time_s, log.current_a, log.voltage_v, log.temperature_c, strict=True)
    lines = [",".join(["Time [s]", "Current [A]", "Voltage [V]", "Temperature [°C]", *names])]
    lines += [",".join(map(str, [*row, *[share * row[2] / 104] * 104])) for row in rows]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    options = ("--capacity-ah", "50", "--initial-soc", "80", "--json")
    ran = run("fit", path, "-o", tmp_path / "m.json", *options)
    found = json.loads(ran.out)
    assert found["cells"] == cells
    assert ("V per cell" in " ".join(found["remarks"])) == (cells is not None)
    assert "104 cells: Cell 1 [V] … Cell 104 [V]" in ran.err
