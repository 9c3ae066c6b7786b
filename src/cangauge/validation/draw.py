"""Drawing cases: logs and model in a folder of their own, the cause in another.

What is made here belongs to the side that knows the cause. The diagnosis gets copies of the logs
and the model, and never a path of this.
"""

from __future__ import annotations

import json
import os
import traceback
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge._io import write_text_atomic
from cangauge.logs.canonical import write_log
from cangauge.validation.cases import (
    CAUSES,
    Group,
    Planned,
    identify,
    label_of,
    missed_v,
    physical_case,
    recorded_set,
)
from cangauge.validation.score import LEAST_GAP
from cangauge.validation.twin.case import Case, CaseOptions, draw_case, write_case, write_case_files
from cangauge.validation.twin.recorded import make_real_case
from cangauge.validation.twin.world import World, record_day

MODEL: Final = "model.json"

OPTIONS: Final[Mapping[str, CaseOptions]] = {
    "simulated": CaseOptions(),
    "outside": CaseOptions(),
    "two-effects": CaseOptions(),
    "equation": CaseOptions(plant_name="equation"),
    "published": CaseOptions(plant_name="published"),
    "pybamm": CaseOptions(plant_name="pybamm", n_logs=3, hours=0.75, draws=3),
}
"""One log against three reference days; on the PyBaMM plant three logs share the effect, and a day
takes seconds to simulate, so few are tried."""

REAL_LOGS: Final = 4
_CLEAN_DAYS: Final = 3
_TRIES: Final = 4
_OTHER_SEED: Final = 2**40
"""Even, so that another try of a case for development stays one for development."""

Label = dict[str, Any]


def draw_group(group: Group, folder: Path, sealed: Path, data: Path | None) -> list[Label]:
    """Draw and write the cases of a group.

    Parameters
    ----------
    group : Group
    folder : Path
        Gets `NAME/` with logs, `case.json` and `model.json`.
    sealed : Path
        Gets the truth.
    data : Path, optional
        Folder of the recorded logs.

    Returns
    -------
    list of dict
        The label of each case, for the sealed file.
    """
    try:
        if group.protocol in OPTIONS:
            return _simulated(group, folder, sealed)
        if group.protocol in CAUSES:
            return [_physical(group.protocol, case, folder, sealed, data) for case in group.cases]
        return _real(group, folder, sealed, data)
    except Exception as error:  # noqa: BLE001 - what cannot be drawn is listed, never dropped
        reason = f"{type(error).__name__}: {error}"
        where = traceback.format_exc(limit=-3)
        return [_failed(group.protocol, case, reason, where) for case in group.cases]


def _simulated(group: Group, folder: Path, sealed: Path) -> list[Label]:
    options = OPTIONS[group.protocol]
    world = options.draw_world(group.world_seed)
    capacity = world.pack.capacity_ah
    training = [recording.log for recording in world.training]
    references = [recording.log for recording in world.references]
    model = identify(training, capacity).model.to_json()
    known = identify([*training, *references], capacity)
    clean = [recording.log for recording in _clean_days(world, options)]
    floor_v = missed_v(known, clean)
    options = replace(options, floor_v=floor_v)
    labels: list[Label] = []
    first: Path | None = None
    for case in group.cases:
        for attempt in range(_TRIES):
            seed = case.seed + attempt * _OTHER_SEED
            drawn = draw_case(seed, case.effects or None, options=options, world=world)
            if not case.effects or drawn.gap_v >= LEAST_GAP * floor_v:
                break  # else physics allows too little on these days: draw others
        written = write_case(drawn, folder, sealed, case.name)
        write_text_atomic(folder / case.name / MODEL, model)
        healthy = [record_day(world.plant, day, ()).log for day in drawn.days]
        labels.append(_label(group.protocol, case, written, missed_v(known, healthy)))
        first = _share(folder / case.name, first)
    return labels


def _clean_days(world: World, options: CaseOptions) -> list[Any]:
    rng = np.random.default_rng([world.seed, 5])
    days = world.draw_days(rng, _CLEAN_DAYS, options.hours)
    return [record_day(world.plant, day, ()) for day in days]


def _real(group: Group, folder: Path, sealed: Path, data: Path | None) -> list[Label]:
    recorded = recorded_set(group.protocol.removeprefix("real-"), data, group.world_seed)
    model = identify(recorded.training, recorded.capacity_ah).model.to_json()
    own = {log.name for log in recorded.training}
    further = [log for log in recorded.references if log.name not in own]
    known = identify([*recorded.training, *further], recorded.capacity_ah)
    floor_v = missed_v(known, recorded.held_out)
    labels: list[Label] = []
    first: Path | None = None
    for case in group.cases:
        for attempt in range(_TRIES):
            written = make_real_case(
                case.seed + attempt * _OTHER_SEED,
                case.effects or None,
                recorded,
                folder,
                sealed,
                floor_v=floor_v,
                n_logs=REAL_LOGS,
                name=case.name,
            )
            if not case.effects or _truth(written)["gap_v"] >= LEAST_GAP * floor_v:
                break
        write_text_atomic(folder / case.name / MODEL, model)
        chosen = {about["name"] for about in _truth(written)["logs"]}
        healthy = [log for log in recorded.held_out if log.name in chosen]
        labels.append(_label(group.protocol, case, written, missed_v(known, healthy)))
        first = _share(folder / case.name, first)
    return labels


def _physical(protocol: str, case: Planned, folder: Path, sealed: Path, data: Path | None) -> Label:
    found = physical_case(protocol, case.seed, data)
    hidden = [{"time_s": log.time_s} for log in found.shown.logs]
    written = write_case_files(
        found.shown,
        label_of(found, protocol, case.seed),
        hidden,
        folder=folder,
        sealed=sealed,
        name=case.name,
    )
    write_text_atomic(folder / case.name / MODEL, found.model)
    label = _label(protocol, case, written, found.floor_v)
    judged_on: dict[str, list[dict[str, str]]] = {}
    for group, logs in found.judged_on.items():
        for log in logs:
            name = f"{case.name}_{log.name}.parquet"
            write_log(log, sealed / name)
            judged_on.setdefault(group, []).append({"log": log.name, "file": name})
    return label | ({"judged_on": judged_on} if judged_on else {})


def _label(protocol: str, case: Planned, written: Case, clean_v: float) -> Label:
    truth = _truth(written)
    for path in written.truth.parent.glob(f"{case.name}_log_*.parquet"):
        path.unlink()  # the figures below say all that is scored
    logs = [{k: v for k, v in about.items() if k not in {"file", "sha256"}}
            for about in truth.pop("logs")]  # fmt: skip
    written.truth.unlink()
    return {
        **truth,
        "protocol": protocol,
        "logs": logs,
        "floor_v": truth["gap_counted_in_v"],
        "floor_clean_v": clean_v,
        "floor_sensor_v": truth["floor_sensor_v"] if protocol in OPTIONS else None,
    }


def _truth(written: Case) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(written.truth.read_text(encoding="utf-8"))
    return found


def _failed(protocol: str, case: Planned, reason: str, where: str) -> Label:
    return {
        "name": case.name,
        "protocol": protocol,
        "seed": case.seed,
        "effects": list(case.effects),
        "faults": [],
        "failed": reason,
        "where": where,
    }


def _share(place: Path, first: Path | None) -> Path:
    """Keep equal files of a group once on the disk; return the folder that others share with."""
    if first is None:
        return place
    for path in (*place.glob("training_*"), *place.glob("reference_*"), place / MODEL):
        original = first / path.name
        path.unlink()
        try:
            os.link(original, path)
        except OSError:  # a file system without hard links
            path.write_bytes(original.read_bytes())
    return first
