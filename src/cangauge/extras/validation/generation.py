"""Case generation: the files that the diagnosis gets, and the labels that the scorer gets.

A case folder holds `training_1.parquet` …, `reference_1.parquet` …, `log_1.parquet` …, `case.json`
and `model.json`; its names reveal nothing of the cause. Labels stay in memory until all cases are
drawn (see `check`).
"""

from __future__ import annotations

import json
import os
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge._io import write_text_atomic
from cangauge.extras.validation.cases import (
    CaseOptions,
    DrawnCase,
    Scenario,
    draw_case,
    draw_recorded_case,
)
from cangauge.extras.validation.plan import Group, PlannedCase
from cangauge.extras.validation.recordings import (
    LABORATORY_CAUSES,
    laboratory_case,
    model_rmse_v,
    recorded_set,
)
from cangauge.extras.validation.score import LEAST_GAP
from cangauge.extras.validation.twin.recording import record_drive
from cangauge.identify.fit import Identification, fit
from cangauge.logs.canonical import write_log
from cangauge.logs.log import Log
from cangauge.model.model_file import Model

MODEL: Final = "model.json"
SCHEMA: Final = 1

_SIMULATED: Final[Mapping[str, CaseOptions]] = {
    "simulated": CaseOptions(),
    "outside": CaseOptions(),
    "two-effects": CaseOptions(),
    "equation": CaseOptions(plant_name="equation"),
    "published": CaseOptions(plant_name="published"),
    "pybamm": CaseOptions(plant_name="pybamm", n_logs=3, hours=0.75, max_draws=3),
}
"""One log against three references; with PyBaMM three logs share the effect, and few draws are made
because a drive takes seconds to simulate."""

_RECORDED_LOGS: Final = 4
_CLEAN_DRIVES: Final = 3
_MAX_SEEDS: Final = 4
"""Seeds that are tried until the gap is in range."""
_NEXT_SEED: Final = 2**40
"""Even, so that the next seed of a development case is one for development."""

Label = dict[str, Any]


def draw_group(group: Group, folder: Path, withheld: Path, data: Path | None) -> list[Label]:
    """Draw the cases of a group and write their files.

    Parameters
    ----------
    group : Group
    folder : Path
        Parent of the case folders.
    withheld : Path
        Folder of the held-out logs of laboratory cases.
    data : Path, optional
        Folder of the recorded logs.

    Returns
    -------
    list of dict
        Labels; a case that cannot be drawn has the reason under `failed`.
    """
    try:
        if group.protocol in _SIMULATED:
            return _draw_simulated(group, folder)
        if group.protocol in LABORATORY_CAUSES:
            return [
                _write_laboratory(group.protocol, case, folder, withheld, data)
                for case in group.cases
            ]
        return _draw_recorded(group, folder, data)
    except Exception as error:  # noqa: BLE001 - reported as a crashed case, never dropped
        failed = f"{type(error).__name__}: {error}"
        where = traceback.format_exc(limit=-3)
        return [
            {
                "name": case.name,
                "protocol": group.protocol,
                "seed": case.seed,
                "effects": list(case.effects),
                "faults": [],
                "failed": failed,
                "where": where,
            }
            for case in group.cases
        ]


def _draw_simulated(group: Group, folder: Path) -> list[Label]:
    options = _SIMULATED[group.protocol]
    scenario = options.draw_scenario(group.scenario_seed)
    capacity_ah = scenario.pack.capacity_ah
    training = [recording.log for recording in scenario.training]
    references = [recording.log for recording in scenario.references]
    model = fit(training, capacity_ah=capacity_ah).model
    known = fit([*training, *references], capacity_ah=capacity_ah)
    floor_v = model_rmse_v(known, _clean_logs(scenario, options))
    options = replace(options, floor_v=floor_v)
    writer = _CaseWriter(folder, training, references, model)
    labels: list[Label] = []
    for case in group.cases:
        for attempt in range(_MAX_SEEDS):
            seed = case.seed + attempt * _NEXT_SEED
            drawn = draw_case(seed, case.effects, scenario, options)
            if not case.effects or drawn.gap_v >= LEAST_GAP * floor_v:
                break  # otherwise the physical limits allow only a smaller gap on these drives
        writer.write(case.name, drawn.logs, capacity_ah)
        labels.append(_label(group.protocol, case, drawn, known))
    return labels


def _clean_logs(scenario: Scenario, options: CaseOptions) -> list[Log]:
    rng = np.random.default_rng([scenario.seed, 5])
    drives = scenario.draw_drives(rng, _CLEAN_DRIVES, options.hours)
    return [record_drive(scenario.plant, drive, ()).log for drive in drives]


def _draw_recorded(group: Group, folder: Path, data: Path | None) -> list[Label]:
    recorded = recorded_set(group.protocol.removeprefix("real-"), data, group.scenario_seed)
    model = fit(recorded.training, capacity_ah=recorded.capacity_ah).model
    own = {log.name for log in recorded.training}
    further = [log for log in recorded.references if log.name not in own]
    known = fit([*recorded.training, *further], capacity_ah=recorded.capacity_ah)
    floor_v = model_rmse_v(known, recorded.held_out)
    pack = recorded.fit_surrogate_pack()
    writer = _CaseWriter(folder, recorded.training, recorded.references, model)
    labels: list[Label] = []
    for case in group.cases:
        for attempt in range(_MAX_SEEDS):
            drawn = draw_recorded_case(
                case.seed + attempt * _NEXT_SEED,
                case.effects,
                recorded.held_out,
                pack,
                floor_v=floor_v,
                n_logs=_RECORDED_LOGS,
                plant_name=recorded.name,
            )
            if not case.effects or drawn.gap_v >= LEAST_GAP * floor_v:
                break
        writer.write(case.name, drawn.logs, recorded.capacity_ah)
        labels.append(_label(group.protocol, case, drawn, known))
    return labels


def _label(protocol: str, case: PlannedCase, drawn: DrawnCase, known: Identification) -> Label:
    truth = dict(drawn.truth)
    logs = truth.pop("logs")
    return {
        "schema": SCHEMA,
        "name": case.name,
        **truth,
        "protocol": protocol,
        "logs": logs,
        "floor_v": truth["gap_counted_in_v"],
        "floor_clean_v": model_rmse_v(known, drawn.healthy_logs),
        "floor_sensor_v": truth["floor_sensor_v"] if protocol in _SIMULATED else None,
    }


def _write_laboratory(
    protocol: str, case: PlannedCase, folder: Path, withheld: Path, data: Path | None
) -> Label:
    found = laboratory_case(protocol, case.seed, data)
    writer = _CaseWriter(folder, (), found.references, found.model)
    writer.write(case.name, found.logs, found.capacity_ah)
    label: Label = {
        "schema": SCHEMA,
        "name": case.name,
        "plant": protocol.partition("-")[2],
        "seed": case.seed,
        "effects": [LABORATORY_CAUSES[protocol][0]],
        "faults": [],
        "floor_sensor_v": None,
        "gap_counted_in_v": found.floor_v,
        "protocol": protocol,
        "logs": [{"name": log.name, "hours": log.duration_s / 3600.0} for log in found.logs],
        "floor_v": found.floor_v,
        "floor_clean_v": found.floor_v,
    }
    held_out: dict[str, list[dict[str, str]]] = {}
    for group, logs in found.held_out.items():
        for log in logs:
            name = f"{case.name}_{log.name}.parquet"
            write_log(log, withheld / name)
            held_out.setdefault(group, []).append({"log": log.name, "file": name})
    return label | ({"judged_on": held_out} if held_out else {})


class _CaseWriter:
    """Writes case folders that share model, training logs and references (hard links)."""

    def __init__(
        self, folder: Path, training: Sequence[Log], references: Sequence[Log], model: Model
    ) -> None:
        self._folder = folder
        self._shared = {"training": training, "reference": references}
        self._model = model.to_json()
        self._first: Path | None = None

    def write(self, name: str, logs: Sequence[Log], capacity_ah: float) -> None:
        """Write the folder of one case."""
        place = self._folder / name
        place.mkdir(parents=True)
        files = {group: _numbered(group, items) for group, items in self._shared.items()}
        files["log"] = _numbered("log", logs)
        for group, items in self._shared.items():
            for file, log in zip(files[group], items, strict=True):
                if not self._linked(place / file):
                    write_log(log, place / file)
        for file, log in zip(files["log"], logs, strict=True):
            write_log(log, place / file)
        if not self._linked(place / MODEL):
            write_text_atomic(place / MODEL, self._model)
        listing = {
            "schema": SCHEMA,
            "name": name,
            "capacity_ah": capacity_ah,
            "training": files["training"],
            "references": files["reference"],
            "logs": files["log"],
        }
        write_text_atomic(place / "case.json", json.dumps(listing, indent=1) + "\n")
        self._first = self._first or place

    def _linked(self, path: Path) -> bool:
        """Link a file of the first case; return False where it has to be written."""
        if self._first is None:
            return False
        try:
            os.link(self._first / path.name, path)
        except OSError:  # no hard links on this file system
            return False
        return True


def _numbered(group: str, logs: Sequence[Log]) -> list[str]:
    return [f"{group}_{number}.parquet" for number in range(1, len(logs) + 1)]
