"""What to do next: the drive or the measurement that tells the likeliest two causes apart.

The two likeliest effects are injected in turn, at the sizes found, into proposed drives of the pack
that the references describe; each drive is diagnosed together with the logs by the same engine. A
measurement is judged by Bayes' rule: what each cause would make it read, and how exactly it reads.
The gain is the increase of the true cause's probability, averaged over the two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cangauge.diagnosis.answer import UNKNOWN, Posterior, answer
from cangauge.diagnosis.columns import Columns
from cangauge.diagnosis.evidence import Evidence, References, analyse, columns
from cangauge.diagnosis.pack_fit import PackFit, Trace, lagged
from cangauge.diagnosis.trials import (
    STEP,
    Trial,
    additive_column,
    healthy_columns,
    residual,
    undone,
)

HELPS: Final = 0.2
"""Gain from which a step is proposed: below it, the answer would read the same."""

DRIVE_S: Final = 1800
"""Length of a proposed drive [s]: as a usual trip."""

LOAD_S, REST_S = 20, 40
"""Load and rest of a pulse [s]: a pulse test's usual 10 to 30 s of load."""

DRIFT_S: Final = 100.0
"""Time over which the error of a healthy log changes [s]: errors last as long as loads do."""

OfPack = Callable[[PackFit], float]


@dataclass(frozen=True)
class Measurement:
    """A reading beside the logs."""

    name: str
    instruction: str
    per_size: Mapping[str, OfPack]
    """Effect → what it makes the measurement read, per unit of its size; 0 for all others."""
    std: OfPack
    """Standard deviation of the reading."""

    def reading(self, pack: PackFit, effect: str, size: float) -> float:
        """Return what an effect of a size makes it read."""
        return self.per_size[effect](pack) * size if effect in self.per_size else 0.0


def _one(_: PackFit) -> float:
    return 1.0


def _volts(pack: PackFit) -> float:
    return pack.volts


def _start_v(pack: PackFit) -> float:
    """Return what a start that is 1 % too high makes the modelled voltage miss [V]."""
    return -float(pack.ocv(np.array([70.0]))[0] - pack.ocv(np.array([30.0]))[0]) / 40.0


MEASUREMENTS: Final = (
    Measurement(
        "a meter on the terminals",
        "Compare the voltage with a meter on the pack's terminals, at rest.",
        {"voltage_offset": _one, "voltage_gain": _volts},
        lambda pack: 1e-3 * pack.volts,  # a handheld meter: 0.1 % of the reading
    ),
    Measurement(
        "the current at open contactors",
        "Read the current sensor while no current can flow.",
        {"current_offset": _one},
        lambda pack: 2e-3 * pack.capacity_ah,  # a healthy sensor's zero, as in `healthy_columns`
    ),
    Measurement(
        "a clamp meter under a steady load",
        "Compare the current with a clamp meter at a steady load of about 0.5 C.",
        {"current_gain": _one, "current_offset": lambda pack: 2.0 / pack.capacity_ah},
        lambda _: 0.015,  # a clamp meter: 1.5 % of the reading
    ),
    Measurement(
        "a full charge before the next drive",
        "Charge fully, and compare the counted SoC with 100 %.",
        {"initial_soc": _one},
        lambda _: 0.7,  # a healthy log's start, as in `healthy_columns`
    ),
    Measurement(
        "a full discharge, counted",
        "Count the charge from full to empty and back.",
        {"capacity": _one, "coulombic_efficiency": _one, "current_gain": _one},
        lambda _: 0.01,  # the ends of charge and discharge: 1 %
    ),
    Measurement(
        "a rest of an hour",
        "Rest for an hour and compare the voltage with the curve at the counted SoC.",
        {
            "voltage_offset": _one, "voltage_gain": _volts, "initial_soc": _start_v,
            "hysteresis": _one,
        },
        lambda pack: 1e-3 * pack.volts,  # offset of a healthy log and what has not relaxed
    ),
    Measurement(
        "the time stamps on a sharp pulse",
        "Compare when current and voltage step on a sharp pulse.",
        {"time_skew": _one},
        lambda _: 0.05,  # frames of 10 Hz
    ),
    Measurement(
        "a second thermometer",
        "Compare the temperature with a second sensor on the cells after a hard drive.",
        {"temperature_lag": lambda _: 0.005, "core_temperature": _one},
        lambda _: 1.0,  # placement of the sensor; a pack warms by about 0.005 K/s in a hard drive
    ),
    Measurement(
        "the cell voltages near empty",
        "Read the voltages of the single cells near empty.",
        {"weak_cell": _one},
        lambda _: 0.02,  # spread of healthy cells near empty
    ),
)  # fmt: skip


@dataclass(frozen=True)
class PlannedStep:
    """A possible next step and what it is expected to bring."""

    name: str
    kind: str
    """`drive` or `measurement`."""
    instruction: str
    after: float
    """Expected probability of the true cause."""
    gain: float


@dataclass(frozen=True)
class Plan:
    """Possible next steps, best first."""

    between: tuple[str, ...]
    """The effects to tell apart; empty if there is nothing to."""
    before: float
    """Probability of the true cause today, averaged over the two."""
    steps: tuple[PlannedStep, ...]

    @property
    def best(self) -> PlannedStep | None:
        """The step that is worth its effort, or None."""
        return self.steps[0] if self.steps and self.steps[0].gain >= HELPS else None

    @property
    def sentence(self) -> str:
        """What to do next, in a sentence or two."""
        if not self.between:
            return "Next step: none; there is no gap whose causes are to be told apart."
        names = " and ".join(self.between)
        if self.best is None:
            return f"Next step: no drive or measurement tells {names} apart."
        text = (
            f"Next step, to tell {names} apart: {self.best.instruction} The true cause's"
            f" probability would rise from {self.before:.2f} to {self.best.after:.2f}."
        )
        drives = [step.gain for step in self.steps if step.kind == "drive"]
        return text if max(drives) >= HELPS else f"{text} No drive does that."

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as JSON."""
        steps = [vars(step) for step in self.steps]
        return {"between": list(self.between), "before": self.before, "steps": steps,
                "helps": self.best is not None}  # fmt: skip


def plan(
    known: References,
    logs: Sequence[Columns],
    evidence: Evidence,
    posterior: Posterior,
    *,
    seed: int = 0,
) -> Plan:
    """Return the steps that would tell the two likeliest effects of these logs apart, best first.

    The errors of a healthy log are drawn from `seed`.
    """
    pair = tuple(posterior.effects)[:2]
    if not posterior.detected or len(pair) < 2:
        return Plan((), 0.0, ())
    p = np.array([posterior.probabilities[name] for name in pair])
    before, steps = float(p @ p / p.sum()), []

    def add(name: str, kind: str, instruction: str, after: list[float]) -> None:
        mean = float(p @ after / p.sum())
        steps.append(PlannedStep(name, kind, instruction, mean, mean - before))

    for name, (instruction, drive) in proposed_drives(known, [log.log for log in logs]).items():
        after = []
        for effect in pair:
            of = evidence.effects[effect]
            both = [*logs, columns(known, driven(known, drive, of.trial, of.size, seed))]
            after.append(answer(known, analyse(known, both)).probabilities[effect])
        add(name, "drive", instruction, after)
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    for one in MEASUREMENTS:
        if not set(pair) & set(one.per_size):
            continue
        after = []
        for effect in pair:
            mean, std = _expected(known.pack, evidence, one, effect)
            readings = [mean + std * float(x) for x in nodes]
            each = [settled(known.pack, evidence, posterior.probabilities, one, reading)[effect]
                    for reading in readings]  # fmt: skip
            after.append(float(weights @ each / weights.sum()))
        add(one.name, "measurement", one.instruction, after)
    return Plan(pair, before, tuple(sorted(steps, key=lambda step: -step.gain)))


def proposed_drives(known: References, logs: Sequence[Trace]) -> dict[str, tuple[str, Trace]]:
    """Return drives within the currents, SoC and temperatures of the references.

    Name → (instruction, signals without a voltage).
    """
    pack, refs, log = known.pack, known.logs, logs[0]
    currents = np.concatenate([ref.current_a for ref in refs])
    in_a, out_a = np.quantile(currents, [0.02, 0.98]).tolist()
    soc = np.concatenate([pack.soc(ref) for ref in refs])
    celsius = np.concatenate([ref.temperature_c for ref in refs])
    low, high, cold, warm = (float(x) for x in (soc.min(), soc.max(), celsius.min(), celsius.max()))
    middle, now = 0.5 * (low + high), float(np.mean(log.temperature_c))
    phase = np.arange(DRIVE_S) % (2 * (LOAD_S + REST_S))
    second = phase - LOAD_S - REST_S
    pulses = np.select([phase < LOAD_S, (second >= 0) & (second < LOAD_S)], [out_a, in_a], 0.0)
    steady_a = min(0.5 * pack.capacity_ah, max(out_a, 1e-3))
    span_as = max(high - low, 1.0) * 36.0 * pack.capacity_ah
    steady = np.full(int(min(span_as / steady_a, 7200.0)) + 1, steady_a)

    def drive(current_a: np.ndarray, start_pct: float, at_c: float) -> Trace:
        n = len(current_a)
        heat = (warm - at_c) * 0.3 * -np.expm1(-np.arange(n) / 1500.0)
        return Trace(current_a, np.zeros(n), at_c + heat, start_pct, np.ones(n, bool))

    again, start = log.current_a[:DRIVE_S], log.start_pct
    return {
        "the same drive again": ("Drive the same again.", drive(again, start, now)),
        "pulses": (
            f"Pulse for {DRIVE_S // 60} min between {in_a:.0f} and {out_a:.0f} A at {middle:.0f} %"
            f" SoC, {LOAD_S} s of load and {REST_S} s of rest.",
            drive(pulses, middle, now),
        ),
        "a long discharge": (
            f"Discharge at {steady_a:.0f} A from {high:.0f} to {low:.0f} % SoC.",
            drive(steady, high, now),
        ),
        "a cold drive": (f"Drive the same at {cold:.0f} °C.", drive(again, start, cold)),
        "a warm drive": (f"Drive the same at {warm:.0f} °C.", drive(again, start, warm)),
    }


def driven(known: References, drive: Trace, trial: Trial, size: float, seed: int) -> Trace:
    """Return the log that the pack of the references would give with an effect.

    The structure is that of the references; the error of a healthy log is drawn: its own
    deviations, and an error of the left-out references' size that lasts `DRIFT_S`.
    """
    pack, rng = known.pack, np.random.default_rng(seed)
    truth = undone(pack, drive, trial, size) if trial.changes_signal else drive
    volts = -residual(pack, replace(truth, voltage_v=np.zeros(len(drive.current_a))))
    own = healthy_columns(pack, drive, residual(pack, drive))
    volts += own @ rng.normal(size=own.shape[1])
    noise = lagged(rng.normal(size=len(volts)), DRIFT_S)
    volts += noise * (known.healthy_v2**0.5 / max(float(np.std(noise)), 1e-9)) * 0.5
    if trial.effect == "voltage_offset":
        volts += size
    elif trial.effect == "voltage_gain":
        volts *= 1.0 + size
    elif not trial.changes_signal:
        placed = replace(trial, shape=0.0) if trial.effect == STEP.effect else trial
        volts += size * additive_column(pack, drive, placed)
    return replace(drive, voltage_v=volts)


def settled(
    pack: PackFit,
    evidence: Evidence,
    probabilities: Mapping[str, float],
    measurement: Measurement,
    reading: float,
) -> dict[str, float]:
    """Return the probabilities after a measurement, by Bayes' rule; they sum to 1."""

    def density(name: str) -> float:
        mean, std = _expected(pack, evidence, measurement, name)
        stds = (std, 10.0 * std) if name == UNKNOWN else (std,)  # unknown may read anything
        each = [np.exp(-0.5 * ((reading - mean) / wide) ** 2) / wide for wide in stds]
        return max(float(np.mean(each)), 1e-300)

    after = {name: p * density(name) for name, p in probabilities.items()}
    total = sum(after.values())
    return {name: p / total for name, p in after.items()}


def _expected(
    pack: PackFit, evidence: Evidence, measurement: Measurement, name: str
) -> tuple[float, float]:
    """Return mean and deviation of what a measurement reads with an answer."""
    std = measurement.std(pack)
    if name not in measurement.per_size:
        return 0.0, std
    found = evidence.effects[name]
    spread = measurement.reading(pack, name, found.std)
    return measurement.reading(pack, name, found.size), float(np.hypot(std, spread))
