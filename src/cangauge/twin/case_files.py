"""The files of a case: logs with neutral names in one folder, the truth apart and sealed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cangauge.atomic import write_text_atomic
from cangauge.logs.canonical import write_log, write_table
from cangauge.logs.log import Log
from cangauge.twin.scaling import Scaled

FloatArray = NDArray[np.float64]

SCHEMA: Final = 1


@dataclass(frozen=True)
class Case:
    """Where the files of a case are. Nothing here tells the cause.

    Parameters
    ----------
    name : str
    training, references, logs : tuple of Path
        Canonical logs; `soc_pct` holds the assumed start only.
    capacity_ah : float
        Capacity that the gauge assumes.
    truth : Path
        The sealed file with the cause; for the scorer alone.
    truth_sha256 : str
        Of that file, to be shown before the diagnosis starts.
    """

    name: str
    training: tuple[Path, ...]
    references: tuple[Path, ...]
    logs: tuple[Path, ...]
    capacity_ah: float
    truth: Path
    truth_sha256: str


@dataclass(frozen=True, eq=False)
class CaseLogs:
    """The logs that a diagnosis gets to see."""

    training: Sequence[Log]
    references: Sequence[Log]
    logs: Sequence[Log]
    capacity_ah: float


def write_case_files(
    shown: CaseLogs,
    truth: Mapping[str, Any],
    hidden: Sequence[Mapping[str, FloatArray]],
    *,
    folder: Path,
    sealed: Path,
    name: str,
) -> Case:
    """Write a case.

    Parameters
    ----------
    shown : CaseLogs
    truth : mapping
        For `sealed/NAME.json`; its `logs` gets the name and SHA-256 of each hidden table.
    hidden : sequence of mapping of str to array
        Columns of `sealed/NAME_log_1.parquet` …, one table a diagnosed log.
    folder : Path
        Gets `NAME/training_1.parquet` …, `reference_1.parquet` …, `log_1.parquet` …, `case.json`.
    sealed : Path
    name : str

    Raises
    ------
    InputError
        If a folder cannot be written.
    """
    place = folder / name
    for path in (place, sealed):
        path.mkdir(parents=True, exist_ok=True)
    files = {
        group: _write_logs(place, group, logs)
        for group, logs in (
            ("training", shown.training),
            ("reference", shown.references),
            ("log", shown.logs),
        )
    }
    listing = {
        "schema": SCHEMA,
        "name": name,
        "capacity_ah": shown.capacity_ah,
        "training": [path.name for path in files["training"]],
        "references": [path.name for path in files["reference"]],
        "logs": [path.name for path in files["log"]],
    }
    write_text_atomic(place / "case.json", json.dumps(listing, indent=1) + "\n")
    about_logs = []
    for number, (about, columns) in enumerate(zip(truth["logs"], hidden, strict=True), start=1):
        path = sealed / f"{name}_log_{number}.parquet"
        write_table(columns, path)
        about_logs.append({**about, "file": path.name, "sha256": _sha256(path)})
    sealed_file = sealed / f"{name}.json"
    whole = {"schema": SCHEMA, "name": name, **truth, "logs": about_logs}
    write_text_atomic(sealed_file, json.dumps(whole, indent=1) + "\n")
    return Case(
        name=name,
        training=files["training"],
        references=files["reference"],
        logs=files["log"],
        capacity_ah=shown.capacity_ah,
        truth=sealed_file,
        truth_sha256=_sha256(sealed_file),
    )


def fault_truth(item: Scaled) -> dict[str, Any]:
    """Return what the truth file says of one fault."""
    kind = item.fault.kind
    return {
        "id": kind.id,
        "family": kind.family,
        "parameter": kind.parameter,
        "unit": kind.unit,
        "size": item.fault.size,
        "comparable": kind.physical,
        "shape": item.fault.full_shape(),
        "seed": item.fault.seed,
        "near": list(kind.near),
        "gap_v": item.reached_v,
        "gap_wanted_v": item.wanted_v,
        "limited": item.limited,
    }


def extent(values: FloatArray) -> list[float]:
    """Return the least and the largest value."""
    return [float(np.min(values)), float(np.max(values))]


def _write_logs(place: Path, group: str, logs: Sequence[Log]) -> tuple[Path, ...]:
    paths = tuple(place / f"{group}_{number}.parquet" for number in range(1, len(logs) + 1))
    for path, log in zip(paths, logs, strict=True):
        write_log(log, path)
    return paths


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
