"""Diagnosis of the gap between a model and logs: size, place, cause, and what to do."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from cangauge._extras import extra
from cangauge._files import file_sha256, text_sha256
from cangauge.diagnosis import sentences
from cangauge.diagnosis.answer import ALARM, GROUP_OF, NONE, UNKNOWN, Posterior, answer
from cangauge.diagnosis.checks import check_logs
from cangauge.diagnosis.columns import Columns
from cangauge.diagnosis.evidence import Evidence, References, analyse, columns, learn
from cangauge.diagnosis.extended import Extension, Quantity, residual_v
from cangauge.diagnosis.pack_fit import Trace, trace
from cangauge.diagnosis.simulator import Simulation, SimulatorGap, simulator_gap
from cangauge.diagnosis.where import LogErrors, closed_part, error_shares, rms
from cangauge.errors import InputError
from cangauge.estimation.offline import estimate
from cangauge.identify.starts import start_by_model
from cangauge.logs.log import Log, as_log
from cangauge.model.model_file import Model, as_model

_LOG = logging.getLogger(__name__)

CROSS_VALIDATED = 5
"""Number of effects, the most probable ones, whose errors are found on held-out rows."""

WORSE_SOC_PCT = 0.25
"""A cause is rejected if the SoC error of these logs grows by more with it [%]: on healthy trips of
one car it scatters by as much."""

PROVED_BY_SOC = 0.5
"""A cause that does not stand out is accepted if it leaves at most this part of the SoC error."""

SETTLING_S = 300.0
"""Start of a log, with withheld initial SoC, that the SoC error leaves out [s]."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of `diagnose`.

    Errors are RMS errors of the voltage at 1 Hz, on rows that did not size the cause, where the
    references cover the SoC; with a cause, on the rows among them that it can change.

    See Also
    --------
    Diagnosis.summary : The answer in a few lines.
    Diagnosis.to_json : All results as one JSON object.
    """

    logs: tuple[Log, ...]
    """Diagnosed logs, as given."""
    references: tuple[Log, ...]
    """Reference logs, as given; empty where they were learned before."""
    model: Model
    """Diagnosed model."""
    known: References = field(repr=False)
    """What the references show."""
    columns: tuple[Columns, ...] = field(repr=False)
    """Of each diagnosed log."""
    evidence: Evidence = field(repr=False)
    """Of every effect."""
    posterior: Posterior
    """Probabilities of `none`, `unknown` and every effect, and what follows from them."""
    remarks: tuple[str, ...] = ()
    """What was assumed to diagnose these logs."""
    has_references: bool = True
    simulator: SimulatorGap | None = None
    """The simulator whose gap it is; None: the gap of `model`."""

    @cached_property
    def _extensions(self) -> dict[str, Extension]:
        """The given model with each effect."""
        model, before = self.model.extended_model(), [log.before_v for log in self._without]
        return {
            name: Extension(model, self.known, self.columns, before, self.evidence.effects[name])
            for name in self.posterior.effects
        }

    @cached_property
    def _without(self) -> list[LogErrors]:
        """Errors of each log without a cause."""
        errors, model = [], self.model.extended_model()
        for log, of in zip(self.logs, self.columns, strict=True):
            at, signals, every = of.rows, of.log, np.ones(len(of.rows), dtype=bool)
            before_v, soc_pct = residual_v(model, signals)[at], self.known.pack.soc(signals)[at]
            inputs = at.astype(np.float64), signals.current_a[at], signals.temperature_c[at]
            errors.append(LogErrors(log.name, *inputs, soc_pct, before_v, before_v, every))
        return errors

    @cached_property
    def _with(self) -> dict[str, list[LogErrors]]:
        """Errors of each log with each of the most probable effects."""
        found = {}
        for name in {*list(self.posterior.effects)[:CROSS_VALIDATED], self.posterior.members[0]}:
            judged = zip(self._without, *self._extensions[name].judge(), strict=True)
            found[name] = [replace(log, after_v=after, judged=at) for log, after, at in judged]
        return found

    @cached_property
    def likeliest(self) -> str | None:
        """The effect that explains the gap best and makes held-out voltages better; or None.

        A gap is reported, its cause is likelier in the library than outside, and with the effect
        the error of held-out rows is smaller: of those that it can change, and of all.
        """
        if not self.posterior.detected or self.posterior.leading_group == UNKNOWN:
            return None
        errors = self._with[effect := self.posterior.members[0]]
        every = [replace(log, judged=np.ones_like(log.judged)) for log in errors]
        better = all(rms(some, after=True) < rms(some) for some in (errors, every))
        return effect if better else None

    @property
    def start_is_suspect(self) -> bool:
        """Whether a gap is reported that a wrong start of these logs may explain."""
        return self.posterior.detected and "initial_soc" in self.posterior.credible_set

    @cached_property
    def soc_errors_pct(self) -> tuple[float, float] | None:
        """SoC errors of the estimator, initial SoC withheld: as given, and with `likeliest` [%].

        None where no diagnosed log has a reference SoC, or its start may be the cause.
        """
        if self.start_is_suspect:
            return None
        if (before := self._soc_error_pct(self.model)) is None:
            return None
        if self.likeliest is None:
            return before, before
        after = self._soc_error_pct(self._extended(self.likeliest))
        return before, math.inf if after is None else after

    @cached_property
    def accepted(self) -> str | None:
        """The effect that the extended model has; None without one.

        It is `likeliest` if it stands out in its group and the SoC error of these logs grows by no
        more than its scatter with it, or if it leaves at most `PROVED_BY_SOC` of that error.
        """
        stands_out = self.posterior.name is not None
        if self.soc_errors_pct is None:
            return self.likeliest if stands_out else None
        before, after = self.soc_errors_pct
        most = before + WORSE_SOC_PCT if stands_out else PROVED_BY_SOC * before
        return self.likeliest if after <= most else None

    @property
    def log_errors(self) -> list[LogErrors]:
        """Errors of each diagnosed log at 1 Hz, before and after."""
        return self._without if self.accepted is None else self._with[self.accepted]

    @property
    def baseline_rmse_v(self) -> float:
        """Error of the given model [V]."""
        return rms(self.log_errors)

    @property
    def extended_rmse_v(self) -> float:
        """Error of the extended model on held-out rows [V]."""
        return rms(self.log_errors, after=True)

    @property
    def healthy_rmse_v(self) -> float:
        """Error of a left-out reference log; without references, what the model file states [V]."""
        return self.known.healthy_rmse_v

    @property
    def closed_fraction(self) -> float | None:
        """Closed part of the squared error above a healthy log's.

        None without a cause, or without a gap above the healthy error.
        """
        return None if self.accepted is None else self._closed(self.accepted)[0]

    @property
    def closed_fraction_ci(self) -> tuple[float, float] | None:
        """95 % interval of the closed fraction."""
        return None if self.accepted is None else self._closed(self.accepted)[1]

    def _closed(self, effect: str) -> tuple[float | None, tuple[float, float] | None]:
        return closed_part(self._with[effect], self.known.healthy_v2)

    @cached_property
    def where(self) -> list[dict[str, Any]]:
        """Shares of the given model's squared error over each axis, as in `gap --json`."""
        return error_shares(self.log_errors, self.known.pack.capacity_ah)

    @cached_property
    def candidates(self) -> list[dict[str, Any]]:
        """Every effect, most probable first, as in `gap --json`; error of the likeliest few."""
        found = []
        for name, p in self.posterior.effects.items():
            rmse_v, closed, ci = None, None, None
            if name in self._with:
                rmse_v, (closed, ci) = rms(self._with[name], after=True), self._closed(name)
            found.append({
                "effect": name, "group": GROUP_OF[name], "probability": p, "rmse_v": rmse_v,
                "closed_fraction": closed, "ci": ci and list(ci),
                "parameters": {k: vars(item) for k, item in self.parameters[name].items()},
            })  # fmt: skip
        return found

    @cached_property
    def parameters(self) -> dict[str, dict[str, Quantity]]:
        """Parameters of each effect with 95 % intervals."""
        return {name: item.parameters for name, item in self._extensions.items()}

    @cached_property
    def visible_from(self) -> list[dict[str, Any]]:
        """Smallest size of each effect that these logs would have shown; size None: none."""
        sizes: list[dict[str, Any]] = []
        for name, least in self.posterior.visible_from.items():
            unit = self.evidence.effects[name].trial.unit
            unit, factor = ("%", 100.0) if unit == "1" else (unit, 1.0)
            sizes.append({"effect": name, "size": least and factor * least, "unit": unit})
        return sizes

    @cached_property
    def extended_model(self) -> Model:
        """The model with the accepted cause, ready to save and run; the given one without."""
        return self.model if self.accepted is None else self._extended(self.accepted)

    def _extended(self, effect: str) -> Model:
        return self._extensions[effect].model_file(self.model, rms(self._with[effect], after=True))

    def _soc_error_pct(self, model: Model) -> float | None:
        """Return the mean absolute SoC error at 1 Hz of logs with reference SoC [%]; or None.

        After a step of resistance, if that is the cause: the extended model has it throughout.
        """
        errors = [np.zeros(0)]
        places: tuple[float | None, ...] = (0.0,) * len(self.logs)
        if self.likeliest is not None:
            places = self.evidence.effects[self.likeliest].in_logs or places
        for log, of, place in zip(self.logs, self.columns, places, strict=True):
            if place is None or log.soc_pct is None or np.isfinite(log.soc_pct).mean() < 0.5:
                continue
            signals, finite = of.log, np.isfinite(log.soc_pct)
            time_s = np.arange(len(signals.current_a), dtype=np.float64)
            first = round(place * len(time_s))
            at_1_hz = Log(time_s, signals.current_a, signals.voltage_v, signals.temperature_c)
            table = estimate(at_1_hz.rows(slice(first, None)), model, initial_soc_pct="auto")
            own = np.interp(table.time_s, log.time_s[finite] - log.time_s[0], log.soc_pct[finite])
            kept = np.isfinite(table.soc_pct) & (table.time_s - first >= SETTLING_S)
            errors.append(np.abs(table.soc_pct - own)[kept & signals.measured[first:]])
        together = np.concatenate(errors)
        return float(together.mean()) if together.size else None

    @property
    def headline(self) -> str:
        """Size, place and cause of the gap in one sentence."""
        return sentences.headline(self)

    @property
    def summary(self) -> str:
        """The answer in a few lines: what it is, how large, what to do, what is left open."""
        return sentences.summary(self)

    @property
    def caveats(self) -> list[str]:
        """What limits the answer, a sentence each."""
        return sentences.caveats(self)

    def __repr__(self) -> str:
        """Return the answer, and the logs."""
        names = ", ".join(log.name for log in self.logs)
        return f"<Diagnosis of {names}>\n{self.summary}"

    def plot(self) -> Any:
        """Return the probabilities of the causes as bars, for `bokeh.plotting.show`."""
        return extra("report.diagnosis:diagnosis_figure")(self)

    def _repr_html_(self) -> str:
        """Return the answer for a notebook."""
        return sentences.diagnosis_html(self)

    def to_json(self, extended_model: str | None = None) -> dict[str, Any]:
        """Return the object that `cangauge gap --json` prints (schema 3).

        Parameters
        ----------
        extended_model : str, optional
            Path of the extended model's file, to be reported.
        """
        found, closed, ci = self.posterior, self.closed_fraction, self.closed_fraction_ci
        before_pct, after_pct = self.soc_errors_pct or (None, None)
        accepted = []
        if self.accepted is not None:
            values = {name: item.value for name, item in self.parameters[self.accepted].items()}
            accepted = [{"effect": self.accepted, "parameters": values, "closed_fraction": closed}]
        return {
            "schema": 3,
            "gap": {
                "baseline_rmse_v": self.baseline_rmse_v,
                "extended_rmse_v": self.extended_rmse_v,
                "healthy_rmse_v": self.healthy_rmse_v,
                "closed_fraction": closed,
                "closed_fraction_ci": ci and list(ci),
                "baseline_soc_mae_pct": before_pct,
                "extended_soc_mae_pct": before_pct if self.accepted is None else after_pct,
            },
            "where": self.where,
            "cause": {
                "detected": found.detected,
                "probability_none": found.probabilities[NONE],
                "probability_unknown": found.probabilities[UNKNOWN],
                "groups": [{"group": g, "probability": p} for g, p in found.groups.items()],
                "check_first": found.check_first,
                "named": found.named,
                "verdict": found.verdict,
                "probability": found.probability,
                "credible_set": list(found.credible_set),
                "ambiguous_with": list(found.ambiguous_with),
                "accepted": accepted,
                "candidates": self.candidates,
                "left_over": found.left_over,
            },
            "visible_from": self.visible_from,
            "summary": self.summary,
            "limits": self.caveats,
            "inputs": {
                "model": {"name": self.model.name, "sha256": text_sha256(self.model.to_json())},
                "logs": _files(self.logs),
                "references": _files(self.references),
            },
            "extended_model": extended_model,
        }


def _files(logs: Sequence[Log]) -> list[dict[str, Any]]:
    return [{"name": log.name, "sha256": file_sha256(log.source)} for log in logs]


def diagnose(
    logs: Any,
    model: Any = None,
    references: Any = (),
    *,
    simulation: Simulation | None = None,
    capacity_ah: float | None = None,
    without: Collection[str] = (),
    initial_soc_pct: float | None = None,
    alarm: float = ALARM,
) -> Diagnosis:
    """Diagnose the gap between a model and logs.

    Parameters
    ----------
    logs : Log, path or DataFrame, or a sequence of these
        Logs with a gap, which share one cause; at least 5 min each, better half an hour.
    model : Model, path or result of `fit`, optional
        Model of this pack; not needed for a simulation.
    references : sequence of Log, path or DataFrame; or References
        Logs without the fault, at least three for reliable probabilities. For many diagnoses with
        the same references: what `learn_references` returns.
    simulation : function or pybamm.Simulation, optional
        Diagnose the gap of a simulator instead: a function of time [s], current [A], temperature
        [°C] and SoC of the first row [%] that returns the voltage [V].
    capacity_ah : float, optional
        The simulator's charge from 100 to 0 % [Ah]; by default from a log from full to empty.
    without : collection of str
        Effects taken out of the library.
    initial_soc_pct : float, optional
        SoC at the first row of each diagnosed log, instead of the log's own [%]; where neither is
        known it is found from the voltage.
    alarm : float
        A gap is reported where `none` is at most this probable (0–1).

    Raises
    ------
    InputError
        If a log is too short, of another pack, given twice, has a dead channel, or if no SoC within
        the pack's range explains it.

    Examples
    --------
    >>> from cangauge import diagnose
    >>> found = diagnose(
    ...     logs=["monday.csv"],
    ...     model="pack.json",
    ...     references=["reference1.csv", "reference2.csv", "reference3.csv"],
    ... )  # doctest: +SKIP
    >>> print(found.headline)  # doctest: +SKIP
    The current reads 3.0 A (2.7 … 3.3) too high (current_offset, 71 %).
    """
    with threadpool_limits(1):  # systems of fifty unknowns gain nothing from more threads
        logs, simulator = _as_logs(logs), None
        model = None if model is None else as_model(model)
        own = () if isinstance(references, References) else _as_logs(references)
        if simulation is not None:
            simulator = simulator_gap(logs, own, simulation, model, capacity_ah)
            logs, own, model = simulator.logs, simulator.references, simulator.model
        if model is None:
            raise InputError("no model", field="model", cure="give a model, or a simulation")
        check_logs(logs, own, model)
        _LOG.info("reading the logs")
        traces, remarks = _traces(logs, model, initial_soc_pct)
        known = references
        if not isinstance(references, References):
            healthy, more = _traces(own, model)
            remarks += more
            known = _learn(healthy or [_of_model(model, log) for log in traces], model)
        _LOG.info("comparing the effects")
        of_logs = tuple(columns(known, log) for log in traces)
        evidence = analyse(known, of_logs)
        found = Diagnosis(
            logs=logs,
            references=own,
            model=model,
            known=known,
            columns=of_logs,
            evidence=evidence,
            posterior=answer(known, evidence, without=without, alarm=alarm),
            remarks=tuple(remarks),
            has_references=bool(own) or known is references,
            simulator=simulator,
        )
        _LOG.info("judging on held-out rows")
        found.candidates  # noqa: B018 - computed here, on one thread
        return found


def learn_references(references: Sequence[Log], model: Model) -> References:
    """Learn what references, logs without a fault, show, for any number of diagnoses."""
    with threadpool_limits(1):
        check_logs(references, (), model)
        return _learn(_traces(references, model)[0], model)


def _learn(healthy: Sequence[Trace], model: Model) -> References:
    return learn(healthy, model.capacity_ah, model.noise.voltage_rmse_v)


def _of_model(model: Model, log: Trace) -> Trace:
    """Return a log with the model's voltage: the reference where none is given."""
    return replace(log, voltage_v=log.voltage_v - residual_v(model.extended_model(), log))


def _as_logs(logs: Any) -> tuple[Log, ...]:
    return tuple(as_log(log) for log in (logs if isinstance(logs, list | tuple) else [logs]))


def _traces(
    logs: Sequence[Log], model: Model, start_pct: float | None = None
) -> tuple[list[Trace], list[str]]:
    """Return the logs at 1 Hz, and a sentence for each start found from the voltage."""
    traces, remarks = [], []
    for log in logs:
        start = start_pct
        if start is None and log.first_soc() is None:
            by_voltage = start_by_model(log, model)
            start = by_voltage.soc_pct
            remarks.append(
                f"{log.name} states no SoC: its start of {start:.1f} ±"
                f" {by_voltage.std_pct or 0.0:.1f} % was found from the voltage. A cause that"
                " shifts the voltage as a whole may hide in it; --initial-soc states the start."
            )
        traces.append(trace(log, model.capacity_ah, start))
    return traces, remarks
