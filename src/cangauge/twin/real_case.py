"""Cases of the withheld check on recorded logs: faults put into files that were held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cangauge.errors import InputError
from cangauge.logs.log import Log
from cangauge.twin.case import GAP_IN_FLOORS, draw_kinds, shaped_fault
from cangauge.twin.case_files import Case, CaseLogs, extent, fault_truth, write_case_files
from cangauge.twin.inject import Injected, inject, scale_injection
from cangauge.twin.pack import Pack
from cangauge.twin.scaling import Scaled
from cangauge.twin.survey import charge_of, survey_pack
from cangauge.twin.world import rms

_REDRAWS: Final = 12
_GOOD_ENOUGH: Final = 0.9


@dataclass(frozen=True, eq=False)
class RecordedSet:
    """Recorded logs of one healthy pack, parted into what a diagnosis knows and what is held out.

    Parameters
    ----------
    name : str
    training, references, held_out : sequence of Log
        Each with its SoC at the start at least. The references may be empty.
    capacity_ah : float
    cells : int
        In series.
    """

    name: str
    training: Sequence[Log]
    references: Sequence[Log]
    held_out: Sequence[Log]
    capacity_ah: float
    cells: int

    def survey(self) -> Pack:
        """Return the pack that faults are put into, seen from all its logs."""
        return survey_pack(
            [*self.training, *self.references, *self.held_out],
            capacity_ah=self.capacity_ah,
            cells=self.cells,
            name=self.name,
        )


def make_real_case(
    seed: int,
    effects: str | Sequence[str] | None,
    recorded: RecordedSet,
    folder: Path,
    sealed: Path,
    *,
    floor_v: float,
    n_logs: int = 4,
    gap_in_floors: tuple[float, float] = GAP_IN_FLOORS,
    name: str | None = None,
) -> Case:
    """Put a fault into some held-out logs and write the case as for a simulated plant.

    Parameters
    ----------
    seed : int
    effects : str, sequence of str or None
        Ids of the faults, `any`, `outside`, or None for logs as they were recorded.
    recorded : RecordedSet
    folder, sealed : Path
        See `case_files.write_case_files`.
    floor_v : float
        What the gap is counted in [V]: for example how well the same drive repeats.
    n_logs : int
        Held-out logs that share the fault, drawn at random; other ones are drawn when they
        cannot show it.
    gap_in_floors : tuple of float
        Range of the gap, in floors, drawn evenly in its logarithm.
    name : str, optional
        Of the case; `case_SEED` without.

    Raises
    ------
    InputError
        If fewer logs are held out, an effect is unknown, or a folder cannot be written.
    """
    if not 1 <= n_logs <= len(recorded.held_out):
        raise InputError(
            f"{len(recorded.held_out)} logs are held out", field="n_logs", value=n_logs
        )
    rng = np.random.default_rng([seed, 3])
    pack = recorded.survey()
    kinds = draw_kinds(effects, rng)
    low, high = np.log(gap_in_floors)
    wanted = [float(floor_v * np.exp(rng.uniform(low, high))) for _ in kinds]
    signs = [-1.0 if kind.signed and rng.random() < 0.5 else 1.0 for kind in kinds]
    seeds = [int(rng.integers(2**31)) for _ in kinds]
    attempts: list[tuple[float, list[Log], tuple[Scaled, ...]]] = []
    for _ in range(_REDRAWS):
        chosen = rng.choice(len(recorded.held_out), size=n_logs, replace=False)
        logs = [recorded.held_out[index] for index in np.sort(chosen)]
        fullest = max(float(charge_of(log, pack.capacity_ah)[0]) for log in logs)
        shortest = min(log.duration_s for log in logs)
        scaled = tuple(
            scale_injection(
                logs,
                shaped_fault(kind, sign, fault_seed, shortest_s=shortest, fullest=fullest),
                volts,
                pack,
                seed=seed,
            )
            for kind, sign, fault_seed, volts in zip(kinds, signs, seeds, wanted, strict=True)
        )
        reached = min((item.reached_v / item.wanted_v for item in scaled), default=1.0)
        attempts.append((reached, logs, scaled))
        if reached >= _GOOD_ENOUGH or n_logs == len(recorded.held_out):
            break  # good, or there are no other logs to draw
    _, logs, scaled = max(attempts, key=lambda attempt: attempt[0])
    faults = [item.fault for item in scaled]
    changed = [inject(log, faults, pack, seed=seed) for log in logs]
    shown = CaseLogs(
        recorded.training,
        recorded.references,
        [item.log for item in changed],
        recorded.capacity_ah,
    )
    hidden = [
        {
            "time_s": item.log.time_s,
            "true_soc_pct": item.true_soc_pct,
            "gap_v": item.gap_v,
            "recorded_voltage_v": log.voltage_v,
        }
        for item, log in zip(changed, logs, strict=True)
    ]
    truth = {
        "plant": recorded.name,
        "seed": seed,
        "effects": [fault.id for fault in faults],
        "faults": [fault_truth(item) for item in scaled],
        "gap_v": rms(np.concatenate([item.gap_v for item in changed])),
        "floor_sensor_v": floor_v,
        "gap_counted_in_v": floor_v,
        "redraws": len(attempts) - 1,
        "logs": [_about(item, log) for item, log in zip(changed, logs, strict=True)],
    }
    return write_case_files(
        shown, truth, hidden, folder=folder, sealed=sealed, name=name or f"case_{seed:06d}"
    )


def _about(item: Injected, log: Log) -> dict[str, Any]:
    return {
        "name": log.name,
        "hours": log.duration_s / 3600.0,
        "temperature_c": extent(log.temperature_c),
        "soc_pct": extent(item.true_soc_pct),
        "gap_v": rms(item.gap_v),
    }
