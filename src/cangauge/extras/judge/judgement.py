"""The judgement on a gauge: how far off, since when, why, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from cangauge._text import counted, duration, number
from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.extras.judge.causes import (
    NAMES,
    PRIOR_NONE,
    WINDOW_PCT,
    Explanation,
    Priors,
    Track,
    explain,
)
from cangauge.extras.judge.causes import UNITS as PACK_UNITS
from cangauge.extras.judge.chain import Stretch, stretches_of
from cangauge.extras.judge.weak import WeakestCell, weak_cell
from cangauge.logs.log import Log, as_log
from cangauge.logs.read import CellColumns
from cangauge.model.model_file import PRIOR_MADE_BY, FunctionFields, Model, as_model
from cangauge.model.prior import ChemistryName

__all__ = ["Cause", "Judgement", "judge"]

Verdict = Literal["agrees", "off", "cannot_tell"]

UNITS: Final = {**PACK_UNITS, "weak_cell": "%"}
ALARM: Final = 0.05
"""The gauge is off where the probability that it is right is at most this, as in `gap`."""
NAMED: Final = 0.6
"""A cause is named from this probability among all answers but `none`, as in `gap`."""
USEFUL_PCT: Final = 5.0
"""A gauge agrees only where an error of this size would have been seen [% SoC]."""
JUMP_PCT: Final = 1.0
"""Least jump of the published SoC against the charge that is listed [%]: a dashboard shows it."""
SEVERAL: Final = 6.0
"""A jump is also this many times the usual change against the charge."""
COUNTED_STD_PCT: Final = 10.0
"""Standard deviation of a capacity that only the gauge's own count states [%]."""
SURE: Final = 1.96
"""Half width of an interval of 95 % in standard deviations."""
DAY_S: Final = 86400.0
EPOCH_S: Final = 1e8
"""Stamps from here on are absolute [s since 1970]; smaller ones count from the log's own start."""


class Jump(NamedTuple):
    """A jump of the published SoC that the charge does not explain."""

    log: int
    time_s: float
    since_start_s: float
    size_pct: float


class Size(NamedTuple):
    """Size of a cause with its interval of 95 %."""

    value: float
    ci: tuple[float, float]
    unit: str


class Cause(NamedTuple):
    """The most probable reason of a gauge's error."""

    verdict: str
    """`current_offset`, `count_scale`, `pack_capacity`, `start_or_reset`, `voltage_sensor`,
    `weak_cell`, `none` or `unknown`."""
    probability: float
    size: Size | None = None
    onset: int | None = None
    """Stretch with which it begins."""
    earliest: int | None = None
    latest: int | None = None
    """First and last stretch with which it may have begun (90 %)."""
    inside: bool = False
    """Whether it begins at the step within that stretch, not before it."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """A second opinion on a gauge.

    Attributes
    ----------
    logs : tuple of Log
        In order of time.
    model : Model
    error_pct, error_std_pct : float
        Published SoC minus the SoC that all logs imply, at the end, and its σ [% SoC].
    worst_pct : float
        The largest such difference, relative to its σ [% SoC].
    verdict : {"agrees", "off", "cannot_tell"}
    cause : Cause
    probabilities : dict
        Of `none`, `unknown` and each cause.
    corrected_pct, corrected_std_pct : list of array
        Corrected SoC and its σ at each row of each log [%]; NaN where not known.
    """

    logs: tuple[Log, ...]
    model: Model
    error_pct: float
    error_std_pct: float
    worst_pct: float
    verdict: Verdict
    cause: Cause
    probabilities: dict[str, float]
    corrected_pct: list[FloatArray]
    corrected_std_pct: list[FloatArray]
    chain: list[Stretch]
    explanations: list[Explanation]
    weakest: WeakestCell | None = None

    @property
    def published_pct(self) -> list[FloatArray]:
        """Published SoC at each row of each log [%]; NaN where a log has none."""
        return [
            np.full(len(log), np.nan) if log.soc_pct is None else log.soc_pct for log in self.logs
        ]

    @property
    def jumps(self) -> list[Jump]:
        """Jumps of the published SoC within stretches that the charge does not explain."""
        found = []
        for part in self.chain:
            count = part.published_pct + part.drawn_pct
            known = np.flatnonzero(np.isfinite(count))
            change = np.diff(count[known])
            if not change.size:
                continue
            usual = 1.5 * float(np.median(np.abs(change)))
            least = max(JUMP_PCT, SEVERAL * usual, 2.0 * part.soc_step_pct)
            for k in np.flatnonzero(np.abs(change) >= least):
                time_s = float(part.time_s[known[k + 1]])
                elapsed_s = self.elapsed_s(part.log, time_s)
                found.append(Jump(part.log, time_s, elapsed_s, float(change[k])))
        return found

    @property
    def days(self) -> int:
        """Days with logs: by their stamps, or one for each log."""
        if any(log.time_s[0] < EPOCH_S for log in self.logs):
            return len(self.logs)
        stamps = np.concatenate([log.time_s for log in self.logs])
        return int(np.unique(np.floor(stamps / DAY_S)).size)

    def elapsed_s(self, log: int, time_s: float) -> float:
        """Return the time since the first row of the first log [s].

        Logs without absolute stamps follow one another without a pause.
        """
        if self.logs[0].time_s[0] >= EPOCH_S and self.logs[log].time_s[0] >= EPOCH_S:
            return float(time_s - self.logs[0].time_s[0])
        before = sum(each.duration_s for each in self.logs[:log])
        return float(before + time_s - self.logs[log].time_s[0])

    def moment_s(self, onset: int, *, inside: bool = False) -> tuple[int, float]:
        """Return the log and the stamp [s] at which a stretch, or the step in it, begins."""
        part = self.chain[onset]
        return part.log, float(part.time_s[part.step_at if inside else 0])

    @property
    def since_s(self) -> float | None:
        """Moment from which on the gauge is off, since the first row [s]; None if it is not."""
        cause = self.cause
        if self.verdict != "off" or cause.onset is None:
            return None
        if cause.onset == 0 and not cause.inside:
            return 0.0
        return self.elapsed_s(*self.moment_s(cause.onset, inside=cause.inside))

    def to_dict(self, corrected: str | None = None) -> dict[str, Any]:
        """Return the object of `--json`, schema 1."""
        size = self.cause.size
        return {
            "schema": 1,
            "gauge": {
                "error_pct": self.error_pct,
                "error_std_pct": self.error_std_pct,
                "verdict": self.verdict,
                "since_s": self.since_s,
                "worst_pct": self.worst_pct,
                "jumps": [
                    {
                        "log": self.logs[jump.log].name,
                        "since_s": jump.since_start_s,
                        "size_pct": jump.size_pct,
                    }
                    for jump in self.jumps
                ],
            },
            "cause": {
                "verdict": self.cause.verdict,
                "probability": self.cause.probability,
                "size": None if size is None else size._asdict() | {"ci": list(size.ci)},
            },
            "next_step": self.next_step,
            "days": self.days,
            "corrected": corrected,
        }

    @property
    def headline(self) -> str:
        """The answer in one sentence."""
        error = f"{_signed(self.error_pct)} ± {number(self.error_std_pct, 1)} % SoC"
        if self.verdict == "cannot_tell":
            return (
                f"Cannot tell: the gauge differs by {error} from the SoC that voltage and charge"
                f" imply, and an error of {USEFUL_PCT:g} % would not have been seen."
            )
        if self.verdict == "agrees":
            return f"The gauge agrees with voltage and charge: difference {error} (1σ)."
        high = "too high" if self.error_pct > 0.0 else "too low"
        is_clear = abs(self.error_pct) > 2.0 * self.error_std_pct
        reads = (
            f"reads {number(abs(self.error_pct), 1)} ± {number(self.error_std_pct, 1)} % SoC {high}"
        )
        if self.cause.verdict == "voltage_sensor":
            reads = "and the logged voltage contradict each other"
        elif self.cause.verdict == "weak_cell":
            reads = "holds for the mean cell, not for the weakest"
        elif not is_clear:
            reads = f"is not right, though its SoC at the end may be ({error})"
        return f"The gauge {reads}. {self.reason}"

    @property
    def reason(self) -> str:
        """Cause, size and moment as sentences."""
        cause = self.cause
        percent = number(100.0 * cause.probability, 0, "%")
        if cause.size is None:
            likely = ", ".join(
                f"{_WORDS[name]} {number(100.0 * share, 0, '%')}"
                for name, share in sorted(self.probabilities.items(), key=lambda item: -item[1])
                if name in UNITS and share >= 0.05
            )
            return f"The cause is not known{f' (possible: {likely})' if likely else ''}."
        size, (low, high), unit = cause.size
        digits = 2 if unit == "A" else 1
        words = _WORDS[cause.verdict]
        if cause.verdict == "weak_cell" and self.weakest is not None:
            words = f"weak cell, number {self.weakest.number}"
        text = f"Cause: {words} ({percent}), {_signed(size, digits)} {unit}"
        text += f" ({_signed(low, digits)} … {_signed(high, digits)} {unit}, 95 %)"
        return f"{text}, {self.since}."

    @property
    def since(self) -> str:
        """Since when, with its interval."""
        cause = self.cause
        if cause.onset is None or (cause.onset == 0 and not cause.inside):
            begin = "since before the first log"
        else:
            log, time_s = self.moment_s(cause.onset, inside=cause.inside)
            after = time_s - self.logs[log].time_s[0]
            where = f"{duration(after)} into" if after > 60.0 else "the start of"
            begin = f"since {where} {self.logs[log].name}"
        if cause.earliest is None or cause.latest is None or cause.earliest == cause.latest:
            return begin
        first = self.logs[self.chain[cause.earliest].log].name
        last = self.logs[self.chain[cause.latest].log].name
        return f"{begin} (it may have begun between {first} and {last})"

    @property
    def next_step(self) -> str:
        """What to do next, and what it settles."""
        if self.verdict == "agrees":
            return "Nothing. Judge again after a full charge or a drive of 40 % or more."
        if self.verdict == "cannot_tell":
            flat = self.model.chemistry == "lfp"
            return (
                "Add a log of one full charge until its end: between the knees the voltage of an"
                " LFP cell says nothing, at full it settles the SoC."
                if flat
                else "Add a log with an hour of rest after a drive of 40 % or more, or of one full"
                " charge until its end: it settles the SoC to about 2 %."
            )
        return _NEXT[self.cause.verdict]


_WORDS: Final = {
    "current_offset": "offset of the current",
    "count_scale": "the gauge counts with a wrong scale",
    "pack_capacity": "the pack has another capacity than the gauge counts with",
    "start_or_reset": "wrong start or reset",
    "voltage_sensor": "voltage sensor",
    "weak_cell": "weak cell",
    "unknown": "another cause, or several",
}
_NEXT: Final = {
    "current_offset": "Read the current with contactors open or everything off: what it then shows"
    " is the offset. Log one hour of it: that settles it.",
    "count_scale": "Compare the capacity in the gauge's configuration with the pack's, and the"
    " current with a clamp meter under load. A log of one drive of 40 % settles it.",
    "pack_capacity": "Log one full discharge or charge, or a drive of 40 % or more that ends with"
    " an hour of rest: charge over SoC then gives the capacity.",
    "start_or_reset": "Charge until full once, so that the gauge resets itself, and judge again:"
    " if the error is gone it was the start.",
    "voltage_sensor": "Put a meter on the pack's terminals at rest and compare with the logged"
    " voltage. Until then the published SoC may be the right one.",
    "weak_cell": "Log one full charge and discharge with cell voltages, and balance the pack.",
    "unknown": "Log one hour of rest and one full charge until its end: they settle whether the"
    " SoC, the current or the voltage is wrong.",
}


def _signed(value: float, digits: int = 1) -> str:
    text = number(value, digits)
    return text if value < 0.0 else f"+{text}"


def judge(
    logs: Sequence[Log | Any],
    model: Model | Any = None,
    *,
    chemistry: ChemistryName | None = None,
    cells: int | None = None,
    capacity_ah: float | None = None,
    cell_voltages: Sequence[CellColumns | None] = (),
) -> Judgement:
    """Judge the SoC that a gauge publishes, by logs that carry it.

    Parameters
    ----------
    logs : sequence of Log, path or DataFrame
        In order of time, with the published SoC as `soc_pct`.
    model : Model, path or result of `fit`, optional
        Of the pack.
    chemistry : {"oxide", "lfp"}, optional
    cells : int, optional
        Without a model: chemistry and number of cells in series.
    capacity_ah : float, optional
        Charge from 100 to 0 % that the gauge should count with [Ah]; by default the model's, else
        from the gauge's own count.
    cell_voltages : sequence of CellColumns, optional
        Beside each log; None where it has none.

    Returns
    -------
    Judgement

    Raises
    ------
    InputError
        If no log has a published SoC, or neither model nor chemistry and cells are given.
    """
    chain_logs = tuple(as_log(log) for log in logs)
    if all(log.time_s[0] >= EPOCH_S for log in chain_logs):
        chain_logs = tuple(sorted(chain_logs, key=lambda log: float(log.time_s[0])))
    if not any(
        log.soc_pct is not None and np.isfinite(log.soc_pct).sum() > 1 for log in chain_logs
    ):
        raise InputError(
            "no log has the SoC that the gauge publishes",
            field="soc_pct",
            cure="name its column, such as --columns soc=HEADING",
        )
    pack, capacity_std = _pack(chain_logs, model, chemistry, cells, capacity_ah)
    with threadpool_limits(1):  # small matrices
        chain = stretches_of(chain_logs, pack)
        if not chain or not any(np.isfinite(part.published_pct).any() for part in chain):
            raise InputError(
                "no stretch of samples is long enough",
                cure="give logs of at least 10 minutes, better half an hour with changing load",
            )
        typical = pack.made.by == PRIOR_MADE_BY and pack.chemistry == "oxide"
        zero_std = WINDOW_PCT if typical else Priors.zero_std_pct
        explanations = explain(chain, pack, Priors(pack.capacity_ah, capacity_std, zero_std))
        weak = _weakest(chain_logs, cell_voltages, pack, chain, explanations)
    return _judgement(chain_logs, pack, chain, explanations, weak)


def _weakest(
    logs: Sequence[Log],
    cell_voltages: Sequence[CellColumns | None],
    model: Model,
    chain: Sequence[Stretch],
    explanations: Sequence[Explanation],
) -> WeakestCell | None:
    """Return the weakest cell by the SoC of the likeliest answer."""
    best = max(explanations, key=lambda each: each.log_evidence)
    parts, first = [], 1
    for part, track in zip(chain, best.tracks, strict=True):
        cells = cell_voltages[part.log] if part.log < len(cell_voltages) else None
        if cells is None:
            continue
        rows = np.searchsorted(logs[part.log].time_s, part.time_s)
        slope = model.voltage_model().pseudo_ocv_slope(track.soc_pct) / cells.count
        first = cells.first
        parts.append((cells.voltage_v[rows], track.soc_pct, slope, logs[part.log].current_a[rows]))
    if not parts:
        return None
    volts, soc_pct, slopes, amps = zip(*parts, strict=True)
    return weak_cell(volts, soc_pct, slopes, amps, first)


def _pack(
    logs: Sequence[Log],
    model: Model | Any,
    chemistry: ChemistryName | None,
    cells: int | None,
    capacity_ah: float | None,
) -> tuple[Model, float]:
    """Return the model, and the standard deviation of its capacity [%]."""
    if model is not None:
        pack = as_model(model)
        if capacity_ah is not None:
            pack = pack.model_copy(update={"capacity_ah": capacity_ah})
        return pack, 1.5
    if chemistry is None or cells is None:
        raise InputError(
            "neither a model nor chemistry and cells",
            field="--model",
            cure="give -m MODEL, or --chemistry oxide|lfp and --cells N",
        )
    if capacity_ah is not None:
        return Model.prior(chemistry, cells, capacity_ah), 3.0
    return Model.prior(chemistry, cells, _capacity_ah(logs)), COUNTED_STD_PCT


def _capacity_ah(logs: Sequence[Log]) -> float:
    """Return the charge per 100 % of the gauge's own count [Ah]."""
    covariance = variance = 0.0
    for log in logs:
        known = np.isfinite(log.soc_pct) if log.soc_pct is not None else np.zeros(len(log), bool)
        if known.any() and log.soc_pct is not None:
            steps = 0.5 * (log.current_a[1:] + log.current_a[:-1]) * np.diff(log.time_s) / 3600.0
            drawn = np.concatenate(([0.0], np.cumsum(steps)))[known]
            soc = log.soc_pct[known]
            covariance -= float(np.sum((soc - soc.mean()) * (drawn - drawn.mean())))
            variance += float(np.sum((soc - soc.mean()) ** 2))
    if covariance <= 0.0:
        raise InputError(
            "the capacity does not follow from the logs: the published SoC hardly changes",
            field="--capacity-ah",
            cure="give the pack's capacity",
        )
    return 100.0 * covariance / variance


def _judgement(
    logs: tuple[Log, ...],
    model: Model,
    chain: list[Stretch],
    explanations: list[Explanation],
    weak: WeakestCell | None,
) -> Judgement:
    if weak is not None:
        none = next(each for each in explanations if each.name == "none")
        explanations = [*explanations, _of_weak_cell(none, weak)]
    scores = np.array([each.log_evidence for each in explanations])
    share = np.exp(scores - scores.max())
    share /= share.sum()
    tracks = [_mixture([each.tracks[k] for each in explanations], share) for k in range(len(chain))]
    probabilities = {each.name: float(p) for each, p in zip(explanations, share, strict=True)}
    corrected = [np.full(len(log), np.nan) for log in logs]
    std = [np.full(len(log), np.nan) for log in logs]
    for part, track in zip(chain, tracks, strict=True):
        log = logs[part.log]
        edges = np.searchsorted(log.time_s, part.time_s[[0, -1]] + np.array([-60.0, 60.0]))
        rows = slice(int(edges[0]), int(edges[1]))
        at = log.time_s[rows]
        corrected[part.log][rows] = np.clip(np.interp(at, part.time_s, track.soc_pct), 0.0, 100.0)
        std[part.log][rows] = np.interp(at, part.time_s, track.std_pct)
    error = [part.published_pct - track.soc_pct for part, track in zip(chain, tracks, strict=True)]
    end = max(k for k, each in enumerate(error) if np.isfinite(each).any())
    last = int(np.flatnonzero(np.isfinite(error[end]))[-1])
    error_std = float(tracks[end].std_pct[last])
    all_error = np.concatenate(error)
    all_std = np.concatenate([track.std_pct for track in tracks])
    worst = int(np.nanargmax(np.abs(all_error) / all_std))
    is_off = probabilities["none"] <= ALARM
    verdict: Verdict = (
        "off" if is_off else "agrees" if 2.0 * error_std <= USEFUL_PCT else "cannot_tell"
    )
    return Judgement(
        logs,
        model,
        float(error[end][last]),
        error_std,
        float(all_error[worst]),
        verdict,
        _cause(explanations, share, is_off=is_off),
        probabilities,
        corrected,
        std,
        chain,
        explanations,
        weak,
    )


def _of_weak_cell(none: Explanation, weak: WeakestCell) -> Explanation:
    """Return the answer "weak cell": the pack's signals are as without a fault."""
    prior = np.log((1.0 - PRIOR_NONE) / (len(NAMES) - 1) / PRIOR_NONE)
    return replace(
        none,
        name="weak_cell",
        log_evidence=none.log_evidence + weak.log_factor + float(prior),
        size=np.array([weak.size_pct]),
        std=np.array([weak.std_pct]),
    )


def _mixture(tracks: Sequence[Track], share: FloatArray) -> Track:
    soc = np.array([track.soc_pct for track in tracks])
    var = np.array([track.std_pct for track in tracks]) ** 2
    mean = share @ soc
    return Track(mean, np.sqrt(share @ (var + (soc - mean) ** 2)))


def _cause(explanations: Sequence[Explanation], share: FloatArray, *, is_off: bool) -> Cause:
    """Return the cause to report: the most probable one, if it stands out."""
    by_name = {each.name: (each, float(p)) for each, p in zip(explanations, share, strict=True)}
    none = by_name["none"][1]
    if not is_off:
        return Cause("none", none)
    name = max(UNITS.keys() & by_name.keys(), key=lambda each: by_name[each][1])
    best, probability = by_name[name]
    if probability < NAMED * (1.0 - none):
        return Cause("unknown", by_name["unknown"][1])
    size = float(best.share @ best.size)
    spread = float(best.share @ (best.std**2 + (best.size - size) ** 2)) ** 0.5
    onset = np.zeros(1 + max(each.onset for each in best.signatures))
    for each, p in zip(best.signatures, best.share, strict=True):
        onset[each.onset] += p
    cumulative = np.cumsum(onset)
    top = best.signatures[best.best]
    return Cause(
        name,
        probability,
        Size(size, (size - SURE * spread, size + SURE * spread), UNITS[name]),
        top.onset,
        int(np.searchsorted(cumulative, 0.05)),
        int(np.searchsorted(cumulative, 0.95)),
        top.inside,
    )


def narrowed(judgement: Judgement) -> Model:
    """Return the model with its curve and loads learned from the logs, and their σ."""
    best = max(judgement.explanations, key=lambda each: each.log_evidence)
    model, fields = judgement.model, judgement.model.functions
    curve = np.array(fields.curve_v).T
    loads = np.array(fields.load).T
    root = np.linalg.cholesky(best.covariance + 1e-12 * np.eye(len(best.functions)))
    functions = FunctionFields(
        soc_pct=fields.soc_pct, curve_v=(curve @ root).T.tolist(), load=(loads @ root).T.tolist()
    )
    update: dict[str, Any] = {"functions": functions, "name": f"{model.name}, narrowed"}
    if model.curve is not None and model.loads is not None:
        at_pct = model.curve.soc_pct
        volts = np.array(model.curve.voltage_v)
        volts += np.interp(at_pct, fields.soc_pct, curve @ best.functions)
        rising = np.maximum.accumulate(volts).tolist()
        update["curve"] = model.curve.model_copy(update={"voltage_v": rising})
        kt, *ohm = loads @ best.functions
        known, M = model.loads, len(model.loads.resistance_ohm)
        factor = known.arrhenius.factor + float(ohm[M])
        changed = {
            "kt_v_per_k": known.kt_v_per_k + float(kt),
            "resistance_ohm": (np.array(known.resistance_ohm) + ohm[:M]).tolist(),
            "arrhenius": known.arrhenius.model_copy(update={"factor": factor}),
        }
        update["loads"] = known.model_copy(update=changed)
    return model.model_copy(update=update)


def rows_of(judgement: Judgement) -> list[list[str]]:
    """Return all answers with probability and size, the most probable first, as table rows."""
    rows = []
    for each in sorted(judgement.explanations, key=lambda each: -each.log_evidence):
        size = "–"
        if each.name in UNITS:
            k, digits = each.best, 2 if UNITS[each.name] == "A" else 1
            size = f"{_signed(float(each.size[k]), digits)} ± {number(float(each.std[k]), digits)}"
            size += f" {UNITS[each.name]}"
        share = number(100.0 * judgement.probabilities[each.name], 1, "%")
        words = "the gauge is right" if each.name == "none" else _WORDS[each.name]
        rows.append([words, share, size])
    return rows


def text_of_days(judgement: Judgement) -> str:
    """Return how much was judged."""
    hours = sum(log.duration_s for log in judgement.logs)
    days = counted(judgement.days, "day")
    return f"{counted(len(judgement.logs), 'log')}, {days}, {duration(hours)}"
