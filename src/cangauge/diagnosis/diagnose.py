"""Diagnosis of the gap between a model and logs: size, place, fault, and what to do."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from threadpoolctl import threadpool_limits

from cangauge._extras import extra
from cangauge.diagnosis import text
from cangauge.diagnosis.as_json import as_json
from cangauge.diagnosis.checks import check_logs
from cangauge.diagnosis.correction import (
    Correction,
    HeldOut,
    errors_of,
    mean_errors,
    model_file,
    soc_errors_pct,
)
from cangauge.diagnosis.evidence import Evidence, analyse, learn
from cangauge.diagnosis.model_check import ModelCheck, check_model
from cangauge.diagnosis.next_step import next_step
from cangauge.diagnosis.pack import Healthy, LogRows, log_rows
from cangauge.diagnosis.posterior import ALARM, Posterior, posterior
from cangauge.diagnosis.rows import Simulated, Trace, trace
from cangauge.diagnosis.simulator import Simulation, simulator_gap
from cangauge.diagnosis.sizes import sized_by_simulation
from cangauge.diagnosis.where import Errors, closed_part, excesses, rms
from cangauge.errors import InputError
from cangauge.identify.starts import start_by_model
from cangauge.logs.log import Log, as_log
from cangauge.model.coulomb_counting import soc_at_first_row
from cangauge.model.extended import ExtendedModel
from cangauge.model.model_file import Model, as_model

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of `diagnose`.

    Errors are RMS errors of the voltage at 1 Hz, where the references cover the SoC, and with a
    correction on rows that did not size it: with two logs or more, on the log left out.

    See Also
    --------
    Diagnosis.summary : The answer in three lines.
    Diagnosis.to_json : All results as one JSON object.
    """

    logs: tuple[Log, ...]
    """Diagnosed logs, as given."""
    references: tuple[Log, ...]
    """Reference logs, as given; empty where they were learned before."""
    model: Model
    """Diagnosed model."""
    healthy: Healthy = field(repr=False)
    """What the references show."""
    rows: tuple[LogRows, ...] = field(repr=False)
    """Of each diagnosed log."""
    evidence: dict[str, Evidence] = field(repr=False)
    """Of every effect."""
    posterior: Posterior
    """Probabilities of `none`, `unknown` and every fault, and what follows from them."""
    model_check: ModelCheck | None = None
    """Whether the model describes the references; None with fewer than two."""
    remarks: tuple[str, ...] = ()
    """What was assumed to diagnose these logs."""
    simulator: str | None = None
    """Of a simulator, where it is off everywhere, "" for nowhere; None: the gap of `model`."""
    correction_path: str | None = None
    """File of the corrected model, as the text names it."""

    @property
    def lacks(self) -> bool:
        """Whether effects are known that the model lacks on the healthy logs."""
        return self.model_check is not None and bool(self.model_check.missed)

    @cached_property
    def _baseline(self) -> Errors:
        """Errors by the model as given."""
        return self._errors_by(self.model.extended_model())

    def _errors_by(self, model: ExtendedModel) -> Errors:
        return errors_of([Simulated(model, log.trace) for log in self.rows], self.rows)

    @cached_property
    def _held_out(self) -> HeldOut:
        """The logs by the model of the healthy logs, to judge corrections."""
        return HeldOut(self._healthy_model, self.healthy, self.rows)

    @cached_property
    def corrections(self) -> dict[str, Correction]:
        """Fault → its best effect, judged on rows that did not size it."""
        return {
            fault: self._held_out.correction(self.best_of(fault)) for fault in self.posterior.faults
        }

    def best_of(self, fault: str) -> Evidence:
        """Return the evidence of the most probable effect of a fault."""
        return self.evidence[next(iter(self.posterior.effects(fault)))]

    @cached_property
    def correction(self) -> Correction | None:
        """The correction by the most probable stated fault that is no worse on left-out rows."""
        for fault in self.posterior.stated:
            found = self.corrections[fault]
            if found.is_better and self._held_out.keeps_soc(found):
                return found
        return None

    @cached_property
    def why_not(self) -> str | None:
        """Why the fault of these logs is not corrected; None where it is."""
        return text.why_not(self)

    @property
    def is_written(self) -> bool:
        """Whether the corrected model differs from the given one."""
        return self.lacks or (self.correction is not None and not self.correction.is_of_log)

    @property
    def is_corrected(self) -> bool:
        """Whether `extended_rmse_v` is of another model or start than the given one."""
        return self.lacks or self.correction is not None

    @cached_property
    def soc_errors_pct(self) -> tuple[float, float] | None:
        """SoC errors of the estimator, initial SoC withheld: as given, and corrected [%].

        None where no diagnosed log has a reference SoC, or its start may be the fault.
        """
        if "start" in self.posterior.stated:
            return None
        after = self._held_out.soc[0]
        before = soc_errors_pct(self.model, self.rows)[0] if self.lacks else after
        if self.correction is not None:
            after = self._held_out.corrected_soc_errors_pct(self.correction)
        means = mean_errors(before, after)
        return None if math.isnan(means[0]) else means

    def soc_mae_pct(self, correction: Correction) -> tuple[float, float]:
        """Return the mean SoC errors of left-out rows without and with a correction [%]."""
        after = self._held_out.corrected_soc_errors_pct(correction)
        return mean_errors(self._held_out.soc[0], after)

    @property
    def errors(self) -> Errors:
        """Errors on the rows that count, by the model as given and by the corrected one."""
        corrected = (self.correction or self._held_out).errors
        return replace(self._baseline, after_v=corrected.after_v)

    @property
    def baseline_rmse_v(self) -> float:
        """Error of the given model [V]."""
        return rms(self._baseline.before_v)

    @property
    def extended_rmse_v(self) -> float:
        """Error of the corrected model on rows that did not size the correction [V]."""
        return rms(self.errors.after_v)

    @property
    def healthy_rmse_v(self) -> float:
        """Error of a left-out reference log; without references, what the model file states [V]."""
        return self.healthy.rmse_v

    @cached_property
    def closed(self) -> tuple[float | None, tuple[float, float] | None]:
        """Closed part of the squared error above a healthy log's, and its 95 % interval.

        None where nothing is corrected, or without a gap above the healthy error.
        """
        if not self.is_corrected:
            return None, None
        return closed_part(self.errors, self.healthy.healthy_v2)

    @cached_property
    def where(self) -> list[dict[str, Any]]:
        """Excess of the given model's error over each axis, as in `gap --json`."""
        return excesses(self._baseline, self.model.capacity_ah)

    @cached_property
    def next_step(self) -> tuple[str, float, float] | None:
        """Stated fault to measure, with P(truth) now and after; None where none is stated."""
        return next_step(self.evidence, self.posterior)

    @property
    def check_first(self) -> str:
        """What to do first, in a sentence."""
        return text.check_first(self)

    def visible_from(self, effect: str) -> tuple[float | None, str]:
        """Return the smallest size of an effect that these logs would have shown, and its unit."""
        of = self.evidence[effect]
        size, unit = of.visible, of.shape.unit
        if effect == "resistance_growth":
            size, unit = size * self.healthy.model.pack.resistance_ohm, "ohm"
        return (size if of.visible <= of.shape.bound else None), unit

    @cached_property
    def extended_model(self) -> Model:
        """The corrected model, ready to save and run; the given one without a correction."""
        best = self.correction
        if best is None or best.is_of_log:
            return self._healthy_model
        return model_file(self.model, best.applied(self._held_out.extended), best.rmse_v)

    @cached_property
    def _healthy_model(self) -> Model:
        """The model that describes the healthy logs: the given one where nothing is missed."""
        check = self.model_check
        if check is None or not check.missed:
            return self.model
        left_v = rms(self._errors_by(check.corrected).before_v)
        return model_file(self.model, check.corrected, left_v)

    @property
    def summary(self) -> str:
        """The answer in three lines: what, how far and where, what to do."""
        return text.answer(self)

    @property
    def caveats(self) -> list[str]:
        """What limits the answer, a sentence each."""
        return text.caveats(self)

    def __repr__(self) -> str:
        """Return the answer, and the logs."""
        names = ", ".join(log.name for log in self.logs)
        return f"<Diagnosis of {names}>\n{self.summary}"

    def plot(self) -> Any:
        """Return the probabilities of the faults as bars, for `bokeh.plotting.show`."""
        return extra("report.diagnosis:diagnosis_figure")(self)

    def _repr_html_(self) -> str:
        """Return the answer for a notebook."""
        return text.html(self)

    def to_json(self) -> dict[str, Any]:
        """Return the object that `cangauge gap --json` prints (schema 4)."""
        return as_json(self)


def diagnose(
    logs: Any,
    model: Any = None,
    references: Any = (),
    *,
    simulation: Simulation | None = None,
    capacity_ah: float | None = None,
    initial_soc_pct: float | None = None,
    alarm: float = ALARM,
) -> Diagnosis:
    """Diagnose the gap between a model and logs.

    Parameters
    ----------
    logs : Log, path or DataFrame, or a sequence of these
        Logs with a gap, which share one fault; at least 5 min each, better half an hour.
    model : Model, path or result of `fit`, optional
        Model of this pack; not needed for a simulation.
    references : sequence of Log, path or DataFrame; or Healthy
        Logs without the fault, at least three for reliable probabilities. For many diagnoses with
        the same references: what `learn_references` returns.
    simulation : function or pybamm.Simulation, optional
        Diagnose the gap of a simulator instead: a function of time [s], current [A], temperature
        [°C] and SoC of the first row [%] that returns the voltage [V].
    capacity_ah : float, optional
        The simulator's charge from 100 to 0 % [Ah]; by default from a log from full to empty.
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
    >>> print(found.summary)  # doctest: +SKIP
    The current reads 3.0 A (2.7–3.3 A) too high. Likelihood: current reading 97 %.
    """
    with threadpool_limits(1):  # systems of a hundred unknowns gain nothing from more threads
        logs, simulator = _as_logs(logs), None
        model = None if model is None else as_model(model)
        own = () if isinstance(references, Healthy) else _as_logs(references)
        if simulation is not None:
            logs, own, model, simulator = simulator_gap(logs, own, simulation, model, capacity_ah)
        if model is None:
            cure = "give a model (--model), or a simulation (--simulated, --simulator)"
            raise InputError("no model", field="model", cure=cure)
        check_logs(logs, own, model)
        _LOG.info("reading the logs")
        traces, remarks = _traces(logs, model, initial_soc_pct)
        if isinstance(references, Healthy):
            healthy = references
        else:
            of_references, more = _traces(own, model)
            remarks += more
            healthy = learn(model, of_references)
        _LOG.info("comparing the effects")
        check = check_model(model, healthy) if len(healthy.references) > 1 else None
        rows = tuple(log_rows(healthy.model, log, healthy.tried, healthy.visited) for log in traces)
        evidence = sized_by_simulation(healthy, rows, analyse(healthy, rows))
        found = Diagnosis(
            logs=logs,
            references=own,
            model=model,
            healthy=healthy,
            rows=rows,
            evidence=evidence,
            posterior=posterior(healthy, rows, evidence, alarm),
            model_check=check,
            remarks=tuple(remarks),
            simulator=simulator,
        )
        _LOG.info("judging on held-out rows")
        found.to_json()  # fills the cached properties while one thread is in use
        return found


def learn_references(references: Sequence[Log], model: Model) -> Healthy:
    """Learn what references, logs without a fault, show, for any number of diagnoses."""
    with threadpool_limits(1):
        check_logs(references, (), model)
        return learn(model, _traces(references, model)[0])


def _as_logs(logs: Any) -> tuple[Log, ...]:
    return tuple(as_log(log) for log in (logs if isinstance(logs, list | tuple) else [logs]))


def _traces(
    logs: Sequence[Log], model: Model, start_pct: float | None = None
) -> tuple[list[Trace], list[str]]:
    """Return the logs at 1 Hz, and a sentence for each start found from the voltage."""
    traces, remarks = [], []
    for log in logs:
        start = soc_at_first_row(log, model.capacity_ah) if start_pct is None else start_pct
        if start is None:
            by_voltage = start_by_model(log, model)
            start, std = by_voltage.soc_pct, by_voltage.std_pct or 0.0
            remarks.append(
                f"{log.name} states no SoC: its start of {start:.1f} ± {std:.1f} % was found from"
                " the voltage. A fault that shifts the voltage as a whole may hide in it;"
                " --initial-soc states the start."
            )
        traces.append(trace(log, start))
    return traces, remarks
