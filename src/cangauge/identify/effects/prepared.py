"""A log as the extended model sees it: its residual, and how that moves with an effect.

The residual is U_corrected − U_model. An effect's column is minus the derivative of the residual
by its amplitude, taken by a finite difference through the effect's own offline code, so what is
weighed is what the extended model does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cangauge.identify.options import FitOptions
from cangauge.identify.rows import FitRows
from cangauge.identify.voltage_fit import prepare
from cangauge.logs.log import Log
from cangauge.model.charge import discharged_ah
from cangauge.model.effects.candidate import Candidate
from cangauge.model.effects.pack_state import PackState, Signals
from cangauge.model.extended import ExtendedModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """A log with the rows that the diagnosis uses."""

    log: Log
    rows: FitRows
    at: NDArray[np.intp]
    """Index of the rows in the log, shape (m,)."""
    initial_soc_pct: float
    """SoC at the log's first sample [%]."""
    signals: Signals
    """The log's signals at its own rate."""

    def remembering(self) -> Prepared:
        """Return the same, with the current's history kept as long as it: quicker, and larger."""
        return replace(self, signals=self.signals.remembering())


def prepare_log(log: Log, options: FitOptions) -> Prepared:
    """Return a log with its rows and its count.

    Parameters
    ----------
    log : Log
    options : FitOptions
        The model's capacity, rate and delays; the initial SoC if one was given.

    Raises
    ------
    InputError
        If the log gives no rows, or its count leaves 0–100 %.
    """
    rows = prepare([log], options)[0]
    at = np.searchsorted(log.time_s, rows.time_s)
    out_ah = discharged_ah(log.time_s, log.current_a)
    first = float(rows.soc_pct[0] + 100.0 * out_ah[at[0]] / (options.capacity_ah or np.nan))
    signals = Signals(log.time_s, log.current_a, log.voltage_v, log.temperature_c)
    return Prepared(log, rows, at, first, signals)


def residual(prepared: Prepared, model: ExtendedModel) -> FloatArray:
    """Return U_corrected − U_model on the rows, shape (m,) [V]."""
    prediction = model.predict(prepared.signals, prepared.initial_soc_pct, prepared.at)
    return prediction.residual_v


def state_of(prepared: Prepared, model: ExtendedModel) -> PackState:
    """Return what extra voltages depend on, for all of the log's rows."""
    corrected = model.corrected(prepared.signals)
    return model.state(corrected, model.counted_soc(corrected, prepared.initial_soc_pct))


def effect_columns(
    prepared: Prepared,
    model: ExtendedModel,
    candidate: Candidate,
    here: FloatArray,
    state: PackState | None = None,
) -> FloatArray:
    """Return minus the residual's change per unit of each amplitude, shape (m, k).

    Parameters
    ----------
    prepared : Prepared
        With the model's voltage in place of the measured one: an effect in proportion to the
        voltage would else follow its noise.
    model : ExtendedModel
        Without the candidate.
    candidate : Candidate
    here : array of shape (m,)
        Residual without it [V].
    state : PackState, optional
        From `state_of`: an effect that only adds a voltage needs nothing else, and is quicker.
    """
    columns = np.empty((here.size, len(candidate.amplitudes)))
    for k, step in enumerate(candidate.steps):
        moved = np.zeros(len(candidate.amplitudes))
        moved[k] = step
        values = candidate.values(moved)
        if state is not None and candidate.effect.adds_voltage_only:
            extra = candidate.effect.extra_voltage(state, values, model.model, model.pack)
            columns[:, k] = 0.0 if extra is None else extra[prepared.at] / step
            continue
        with_it = model.with_effect(candidate.effect, values)
        columns[:, k] = (here - residual(prepared, with_it)) / step
    return columns


def as_modelled(prepared: Prepared, model: ExtendedModel) -> Prepared:
    """Return the log's signals with the model's voltage in place of the measured one."""
    signals = prepared.signals
    everywhere = np.arange(signals.time_s.size)
    prediction = model.predict(signals, prepared.initial_soc_pct, everywhere)
    volts = signals.voltage_v - prediction.residual_v
    return replace(prepared, signals=replace(signals, voltage_v=volts))
