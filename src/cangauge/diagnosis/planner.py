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

from cangauge.diagnosis.answer import NONE, UNKNOWN, Posterior, answer
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

PULSE_S: Final = (20, 40)
"""Load and rest of a pulse [s]: a pulse test's usual 10 to 30 s of load."""

DRIFT_S: Final = 100.0
"""Time over which the error of a healthy log changes [s]: errors last as long as loads do."""


@dataclass(frozen=True)
class Measurement:
    """A reading beside the logs.

    Parameters
    ----------
    name, instruction : str
    unit : str
        Of the reading.
    readings : mapping of str to callable
        Effect → (pack, size) → what it makes the measurement read; 0 for all other effects.
    std : callable
        Pack → standard deviation of the reading.
    """

    name: str
    instruction: str
    unit: str
    readings: Mapping[str, Callable[[PackFit, float], float]]
    std: Callable[[PackFit], float]


def _size(_: PackFit, a: float) -> float:
    return a


MEASUREMENTS: Final = (
    Measurement(
        "a meter on the terminals",
        "Compare the voltage with a meter on the pack's terminals, at rest.",
        "V",
        {"voltage_offset": _size, "voltage_gain": lambda pack, a: a * pack.volts},
        lambda pack: 1e-3 * pack.volts,  # a handheld meter: 0.1 % of the reading
    ),
    Measurement(
        "the current at open contactors",
        "Read the current sensor while no current can flow.",
        "A",
        {"current_offset": _size},
        lambda pack: 2e-3 * pack.capacity_ah,  # a healthy sensor's zero, as in `healthy_columns`
    ),
    Measurement(
        "a clamp meter under a steady load",
        "Compare the current with a clamp meter at a steady load of about 0.5 C.",
        "1",
        {
            "current_gain": _size,
            "current_offset": lambda pack, a: a / (0.5 * pack.capacity_ah),
        },
        lambda _: 0.015,  # a clamp meter: 1.5 % of the reading
    ),
    Measurement(
        "a full charge before the next drive",
        "Charge fully, and compare the counted SoC with 100 %.",
        "%",
        {"initial_soc": _size},
        lambda _: 0.7,  # a healthy log's start, as in `healthy_columns`
    ),
    Measurement(
        "a full discharge, counted",
        "Count the charge from full to empty and back.",
        "1",
        {"capacity": _size, "coulombic_efficiency": _size, "current_gain": _size},
        lambda _: 0.01,  # the ends of charge and discharge: 1 %
    ),
    Measurement(
        "a rest of an hour",
        "Rest for an hour and compare the voltage with the curve at the counted SoC.",
        "V",
        {
            "voltage_offset": _size,
            "voltage_gain": lambda pack, a: a * pack.volts,
            "initial_soc": lambda pack, a: -a * _slope_v(pack),
            "hysteresis": lambda _, a: abs(a),
        },
        lambda pack: 1e-3 * pack.volts,  # offset of a healthy log and what has not relaxed
    ),
    Measurement(
        "the time stamps on a sharp pulse",
        "Compare when current and voltage step on a sharp pulse.",
        "s",
        {"time_skew": _size},
        lambda _: 0.05,  # frames of 10 Hz
    ),
    Measurement(
        "a second thermometer",
        "Compare the temperature with a second sensor on the cells after a hard drive.",
        "K",
        {"temperature_lag": lambda _, a: a * 0.005, "core_temperature": _size},
        lambda _: 1.0,  # placement of the sensor; a pack warms by about 0.005 K/s in a hard drive
    ),
    Measurement(
        "the cell voltages near empty",
        "Read the voltages of the single cells near empty.",
        "V",
        {"weak_cell": _size},
        lambda _: 0.02,  # spread of healthy cells near empty
    ),
)


def _slope_v(pack: PackFit) -> float:
    """Return the OCV's usual slope [V/%]."""
    return float(pack.ocv(np.array([70.0]))[0] - pack.ocv(np.array([30.0]))[0]) / 40.0


@dataclass(frozen=True)
class Step:
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
    steps: tuple[Step, ...]

    @property
    def best(self) -> Step | None:
        """The step that is worth its effort, or None."""
        first = self.steps[0] if self.steps else None
        return first if first is not None and first.gain >= HELPS else None

    @property
    def sentence(self) -> str:
        """What to do next, in a sentence or two."""
        if not self.between:
            return "Next step: none; there is no gap whose causes are to be told apart."
        names = " and ".join(self.between)
        if self.best is None:
            return f"Next step: no drive or measurement tells {names} apart."
        drives = [step for step in self.steps if step.kind == "drive"]
        text = (
            f"Next step, to tell {names} apart: {self.best.instruction} The true cause's"
            f" probability would rise from {self.before:.2f} to {self.best.after:.2f}."
        )
        if self.best.kind == "measurement" and drives and drives[0].gain < HELPS:
            text += " No drive does that."
        return text

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as JSON."""
        return {
            "between": list(self.between),
            "before": self.before,
            "steps": [vars(step) for step in self.steps],
            "helps": self.best is not None,
        }


def plan(
    known: References,
    logs: Sequence[Columns],
    evidence: Evidence,
    posterior: Posterior,
    *,
    seed: int = 0,
) -> Plan:
    """Return the steps that would tell the two likeliest effects apart, best first.

    Parameters
    ----------
    known : References
    logs : sequence of Columns
        The diagnosed logs.
    evidence : Evidence
        Of these logs.
    posterior : Posterior
        Of these logs.
    seed : int
        Of the simulated errors of a healthy log.
    """
    pair = tuple(list(posterior.effects)[:2])
    if not posterior.detected or len(pair) < 2:
        return Plan((), 0.0, ())
    p = posterior.probabilities
    weight = np.array([p[name] for name in pair]) / sum(p[name] for name in pair)
    before = float(weight @ [p[name] for name in pair])
    steps = []
    for name, (instruction, drive) in proposed_drives(known, [log.log for log in logs]).items():
        after = []
        for effect in pair:
            made = driven(
                known, drive, evidence.effects[effect].trial, evidence.effects[effect].size, seed
            )
            both = [*logs, columns(known, made)]
            after.append(answer(known, analyse(known, both)).probabilities[effect])
        steps.append(
            Step(name, "drive", instruction, float(weight @ after), float(weight @ after) - before)
        )
    for one in MEASUREMENTS:
        if not set(pair) & set(one.readings):
            continue
        after = [expected(known.pack, evidence, p, one, effect) for effect in pair]
        steps.append(
            Step(
                one.name,
                "measurement",
                one.instruction,
                float(weight @ after),
                float(weight @ after) - before,
            )
        )
    return Plan(pair, before, tuple(sorted(steps, key=lambda step: -step.gain)))


def proposed_drives(known: References, logs: Sequence[Trace]) -> dict[str, tuple[str, Trace]]:
    """Return drives within the currents, SoC and temperatures of the references.

    Returns
    -------
    dict
        Name → (instruction, signals without a voltage). The first drives the diagnosed log again.
    """
    pack, refs = known.pack, known.logs
    currents = np.concatenate([log.current_a for log in refs])
    out_a, in_a = float(np.quantile(currents, 0.98)), float(np.quantile(currents, 0.02))
    socs = [pack.soc(log) for log in refs]
    high, low = max(float(s.max()) for s in socs), min(float(s.min()) for s in socs)
    celsius = np.concatenate([log.temperature_c for log in refs])
    cold, warm = float(celsius.min()), float(celsius.max())
    middle, now = 0.5 * (low + high), float(np.mean(logs[0].temperature_c))
    n = np.arange(DRIVE_S)
    again = logs[0].current_a[:DRIVE_S]
    load_s, rest_s = PULSE_S
    phase = n % (2 * (load_s + rest_s))
    pulses = np.where(phase < load_s, out_a, 0.0) + np.where(
        (phase >= load_s + rest_s) & (phase < 2 * load_s + rest_s), in_a, 0.0
    )
    span_as = max(high - low, 1.0) / 100.0 * pack.capacity_ah * 3600.0
    steady_a = min(0.5 * pack.capacity_ah, max(out_a, 1e-3))
    steady = np.full(int(min(span_as / steady_a, 2 * 3600.0)) + 1, steady_a)

    def drive(current_a: np.ndarray, start_pct: float, at_c: float) -> Trace:
        ones = np.ones(len(current_a), bool)
        heat = (warm - at_c) * 0.3 * -np.expm1(-np.arange(len(current_a)) / 1500.0)
        return Trace(current_a, np.zeros(len(current_a)), at_c + heat, start_pct, ones)

    return {
        "the same drive again": ("Drive the same again.", drive(again, logs[0].start_pct, now)),
        "pulses": (
            f"Pulse for {DRIVE_S // 60} min between {in_a:.0f} and {out_a:.0f} A at {middle:.0f} %"
            f" SoC, {load_s} s of load and {rest_s} s of rest.",
            drive(pulses, middle, now),
        ),
        "a long discharge": (
            f"Discharge at {steady_a:.0f} A from {high:.0f} to {low:.0f} % SoC.",
            drive(steady, high, now),
        ),
        "a cold drive": (
            f"Drive the same at {cold:.0f} °C.", drive(again, logs[0].start_pct, cold)
        ),
        "a warm drive": (
            f"Drive the same at {warm:.0f} °C.", drive(again, logs[0].start_pct, warm)
        ),
    }  # fmt: skip


def driven(known: References, drive: Trace, trial: Trial, size: float, seed: int) -> Trace:
    """Return the log that the pack of the references would give with an effect.

    The structure is that of the references; the error of a healthy log is drawn: its own
    deviations, and an error of the left-out references' size that lasts `DRIFT_S`.

    Parameters
    ----------
    known : References
    drive : Trace
        Signals as measured; the voltage is ignored.
    trial : Trial
        The effect at its shape.
    size : float
        In the trial's unit.
    seed : int
    """
    pack, rng = known.pack, np.random.default_rng(seed)
    truth = undone(pack, drive, trial, size) if trial.changes_signal else drive
    model_v = -residual(pack, replace(truth, voltage_v=np.zeros(len(drive.current_a))))
    own = healthy_columns(pack, drive, residual(pack, drive))
    volts = model_v + own @ rng.normal(size=own.shape[1])
    noise = lagged(rng.normal(size=len(volts)), DRIFT_S)
    volts = volts + noise * (known.healthy_v2**0.5 / max(float(np.std(noise)), 1e-9)) * 0.5
    if trial.effect == "voltage_offset":
        volts = volts + size
    elif trial.effect == "voltage_gain":
        volts = volts * (1.0 + size)
    elif not trial.changes_signal:
        placed = replace(trial, shape=0.0) if trial.effect == STEP.effect else trial
        volts = volts + size * additive_column(pack, drive, placed)
    return replace(drive, voltage_v=volts)


def settled(
    pack: PackFit,
    evidence: Evidence,
    probabilities: Mapping[str, float],
    measurement: Measurement,
    reading: float,
) -> dict[str, float]:
    """Return the probabilities after a measurement, by Bayes' rule; they sum to 1.

    Parameters
    ----------
    pack : PackFit
    evidence : Evidence
        Sizes of the effects with their deviations.
    probabilities : mapping
        Before it.
    measurement : Measurement
    reading : float
    """
    after = {}
    for name, p in probabilities.items():
        mean, std = _reading(pack, evidence, measurement, name)
        if name == UNKNOWN:  # may read anything: as often nothing as a ten times wider reading
            wide = 10.0 * std
            likelihood = 0.5 * _normal(reading, std) + 0.5 * _normal(reading, wide)
        else:
            likelihood = _normal(reading - mean, std)
        after[name] = p * max(likelihood, 1e-300)
    total = sum(after.values())
    return {name: p / total for name, p in after.items()}


def expected(
    pack: PackFit,
    evidence: Evidence,
    probabilities: Mapping[str, float],
    measurement: Measurement,
    effect: str,
) -> float:
    """Return the expected probability of an effect after a measurement, were it the cause."""
    mean, std = _reading(pack, evidence, measurement, effect)
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    p = [
        settled(pack, evidence, probabilities, measurement, mean + std * float(x))[effect]
        for x in nodes
    ]
    return float(weights @ p / weights.sum())


def _reading(
    pack: PackFit, evidence: Evidence, measurement: Measurement, name: str
) -> tuple[float, float]:
    """Return mean and deviation of what a measurement reads with an answer."""
    std = measurement.std(pack)
    if name in {NONE, UNKNOWN} or name not in measurement.readings:
        return 0.0, std
    found, read = evidence.effects[name], measurement.readings[name]
    unit = abs(read(pack, 1.0))
    return read(pack, found.size), float(np.hypot(std, unit * found.std))


def _normal(x: float, std: float) -> float:
    return float(np.exp(-0.5 * (x / std) ** 2) / std)
