"""Effects that add a voltage: resistance, dynamics beyond the delay line, open-circuit voltage."""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np

from cangauge._typing import FloatArray
from cangauge.logs.gaps import BRIDGE_S
from cangauge.model.effects.base import (
    DELAYED,
    Context,
    CoreForm,
    Effect,
    Inputs,
    Memories,
    Pack,
    Parameter,
    Values,
    core_values,
)
from cangauge.model.first_order import First, Lag, Turned
from cangauge.model.voltage_model import PLAUSIBLE_C, VoltageModel, inverse_k

REFERENCE_C: Final = 25.0
"""Temperature at which Arrhenius factors are 1 [°C]."""

ACTIVATION: Final = Parameter("activation_k", "K", 0.0, 6000.0, grid=(0.0, 3000.0))
"""Arrhenius activation of an RC element's resistance, which is stated at 25 °C."""

MEAN_SLOPE_PCT: Final = (10.0, 90.0)
"""SoC between which the mean slope of the open-circuit voltage is taken [%]."""
STEEPNESS_AT_MOST: Final = 5.0
"""Upper limit of the slope, relative to the mean."""

ACTIVATION_K: Final = 5000.0
"""Usual activation of the exchange current [K], about 42 kJ/mol; `exchange_a` holds at 25 °C."""


# --- resistance


def arrhenius(temperature_c: FloatArray, activation_k: float) -> FloatArray:
    """Return exp(B·(1/T − 1/T₂₅)), shape (n,): greater than 1 below 25 °C."""
    return np.asarray(np.exp(activation_k * (inverse_k(temperature_c) - inverse_k(REFERENCE_C))))


def drop(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return the drop over the resistance, the whole or the present current's (`DELAYED`)."""
    delayed, now_v = values["delayed"], -at.pack.resistance_ohm * inputs.current_a
    return np.asarray(delayed * inputs.drop_v + (1.0 - delayed) * now_v)


def grown_drop(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return a share of the drop."""
    return values["share"] * drop(inputs, values, at)


def colder_drop(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return the drop's growth in the cold."""
    colder = inverse_k(inputs.temperature_c) - inverse_k(values["reference_c"])
    return grown_drop(inputs, values, at) * np.expm1(values["activation_k"] * colder)


def colder_form(values: Values, _: VoltageModel, pack: Pack) -> CoreForm:
    """Return the growth in the C core, which takes 1/T₀."""
    reference = float(inverse_k(values["reference_c"]))
    constants = values["share"], values["activation_k"], values["delayed"], reference
    return CoreForm("resistance_temperature", (*constants, pack.resistance_ohm))


def ends_of_soc(soc_pct: FloatArray, values: Values, _: VoltageModel) -> FloatArray:
    """Return the decay from empty and from full."""
    soc, width = np.clip(soc_pct, 0.0, 100.0), values["width_pct"]
    rise = values["at_empty"] * np.exp(-soc / width)
    return np.asarray(rise + values["at_full"] * np.exp((soc - 100.0) / width))


def drop_while_charging(inputs: Inputs, values: Values, _: Context) -> FloatArray:
    """Return the drop of charging current over a resistance."""
    return -values["charging_ohm"] * np.minimum(inputs.current_a, 0.0)


def first_time(*_: object) -> Memories:
    """Return the time of the first sample."""
    return (First(),)


def drop_after_step(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return the drop over a resistance that is added at a moment."""
    after = inputs.time_s - at.memory[0].of(inputs.time_s) >= values["start_s"]
    return np.where(after, -values["step_ohm"] * inputs.current_a, 0.0)


# --- dynamics


def bend(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return the bent part of charge transfer."""
    per_a = 0.5 / values["exchange_a"] * arrhenius(inputs.temperature_c, values["activation_k"])
    zero_a = at.pack.capacity_ah
    slope = values["bend_only"] * np.arcsinh(zero_a * per_a) / zero_a
    bent = np.arcsinh(inputs.current_a * per_a) - slope * inputs.current_a
    return np.asarray(-values["scale_v"] * bent)


def bend_form(values: Values, _: VoltageModel, pack: Pack) -> CoreForm:
    """Return charge transfer in the C core."""
    rest = values["bend_only"], values["activation_k"], pack.capacity_ah
    return CoreForm("charge_transfer", (values["scale_v"], 0.5 / values["exchange_a"], *rest))


def rc_memory(values: Values, _: Pack) -> Memories:
    """Return the current through the resistance, at rest before the first sample."""
    return (Lag(values["tau_s"], 0.0, rest_s=BRIDGE_S),)


def rc_voltage(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return the voltage of an RC element."""
    volts = -values["ohm"] * at.memory[0].step(inputs.time_s, inputs.current_a)
    return np.asarray(volts * arrhenius(inputs.temperature_c, values["activation_k"]))


def rc_form(values: Values, model: VoltageModel, _: Pack) -> CoreForm:
    """Return an RC element in the C core."""
    by_slope = values.get("by_slope", 0.0)
    slope = mean_slope(model) if by_slope else 1.0
    constants = (values["activation_k"], by_slope, slope, values["ohm"])
    return CoreForm("rc", constants, (values["tau_s"],))


def mean_slope(model: VoltageModel) -> float:
    """Return the mean slope of the pseudo-OCV [V per % SoC], positive."""
    low, high = MEAN_SLOPE_PCT
    rise_v = model.pseudo_ocv_at(high)[0] - model.pseudo_ocv_at(low)[0]
    return rise_v / (high - low)


def steepness(soc_pct: FloatArray, values: Values, model: VoltageModel) -> FloatArray | float:
    """Return the slope of the pseudo-OCV relative to its mean, as far as the effect follows it."""
    if not values["by_slope"]:
        return 1.0
    relative = model.pseudo_ocv_slope(soc_pct) / mean_slope(model)
    limited = np.clip(relative, 0.0, STEEPNESS_AT_MOST)
    return np.asarray(1.0 + values["by_slope"] * (limited - 1.0))


# --- open-circuit voltage


def travel_as(values: Values, pack: Pack) -> float:
    """Return the charge that turns the hysteresis [As]."""
    return 36.0 * pack.capacity_ah * values["travel_pct"]


def hysteresis_memory(values: Values, pack: Pack) -> Memories:
    """Return the state between −1 and 1, which charge turns."""
    return (Turned(travel_as(values, pack)),)


def hysteresis_voltage(inputs: Inputs, values: Values, at: Context) -> FloatArray:
    """Return the half width times the state."""
    return np.asarray(values["half_width_v"] * at.memory[0].step(inputs.time_s, inputs.current_a))


def hysteresis_form(values: Values, _: VoltageModel, pack: Pack) -> CoreForm:
    """Return the hysteresis in the C core."""
    return CoreForm("hysteresis", (values["half_width_v"], travel_as(values, pack)))


def warmer_k(inputs: Inputs, _: Values, at: Context) -> FloatArray:
    """Return the temperature above T_r [K]."""
    return np.asarray(np.clip(inputs.temperature_c, *PLAUSIBLE_C) - at.model.loads.t_ref_c)


def entropic_v_per_k(soc_pct: FloatArray, values: Values, _: VoltageModel) -> FloatArray:
    """Return the entropic coefficient over SoC [V/K]: Legendre polynomials."""
    x = np.clip(soc_pct, 0.0, 100.0) / 50.0 - 1.0
    shape = values["level_v_per_k"] + values["slope_v_per_k"] * x
    return np.asarray(shape + values["curve_v_per_k"] * (1.5 * x * x - 0.5))


def fraction(inputs: Inputs, values: Values, _: Context) -> FloatArray:
    """Return the fraction of weak cells, at every row."""
    return np.full_like(inputs.current_a, values["fraction"])


def ahead(values: Values) -> float:
    """Return how much faster the SoC of weak cells falls."""
    return 1.0 / (1.0 - values["deficit_pct"] / 100.0)


def weak_less_healthy(soc_pct: FloatArray, values: Values, model: VoltageModel) -> FloatArray:
    """Return the pseudo-OCV of a pack of weak cells minus that of healthy ones [V]."""
    weak = 100.0 - (100.0 - soc_pct) * ahead(values)
    return model.pseudo_ocv(weak) - model.pseudo_ocv(soc_pct)


def weak_form(values: Values, *_: object) -> CoreForm:
    """Return the weak cells in the C core."""
    return CoreForm("weak_cell", (values["fraction"], ahead(values)))


VOLTAGES: Final = (
    # Every resistance by one factor (ageing), or the present current's alone (a contact).
    Effect(
        id="resistance_growth",
        fault="resistance",
        parameters=(Parameter("share", "1", -0.8, 3.0, healthy_std=0.0125), DELAYED),
        about="""
            **Signature.** the drop over the resistance, larger from the first row on

            **Separated by** the same pulse, warm and cold: a thermometer that reads too high grows
            both

            **Source.** definition
            """,
        equation="ΔU = a·ΣRj·I(t − dj); or a·ΣRj·I in its place",
        scales_drop=True,
        drive=grown_drop,
        core_form=partial(core_values, "resistance_growth", ("share", "delayed", "resistance_ohm")),
    ),
    # Zero at `reference_c`, the middle of the identified temperature range when the effect was
    # added.
    Effect(
        id="resistance_temperature",
        fault="resistance",
        parameters=(
            Parameter("share", "1", 0.0, 3.0),
            Parameter("activation_k", "K", 100.0, 8000.0, grid=(1000.0, 2500.0, 4500.0)),
            DELAYED,
            Parameter("reference_c", "°C", *PLAUSIBLE_C, grid=(1.0,)),
        ),
        about="""
            **Signature.** the drop over the resistance, growing with (T₀ − T)

            **Separated by** the same SoC at two temperatures (a second day): where temperature and
            SoC move together it is not separable from resistance_soc

            **Source.** Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885
            """,
        equation=(
            "ΔU = a·ΣRj·I(t − dj)·(exp(B·(1/T − 1/T₀)) − 1), T₀ = reference_c;"
            " or ΣRj·I in place of ΣRj·I(t − dj)"
        ),
        scales_drop=True,
        drive=colder_drop,
        core_form=colder_form,
    ),
    # Decays exponentially from empty and from full.
    Effect(
        id="resistance_soc",
        fault="resistance",
        parameters=(
            Parameter("at_empty", "1", -0.4, 3.0),
            Parameter("at_full", "1", -0.4, 1.5),
            Parameter("width_pct", "%", 3.0, 60.0, grid=(5.0, 10.0, 20.0, 40.0)),
            DELAYED,
        ),
        about="""
            **Signature.** I·f(S): the drop over the resistance, larger near empty

            **Separated by** the same SoC at two temperatures: in one discharge SoC and temperature
            move together and it is not separable from resistance_temperature

            **Source.** Waag, Käbitz, Sauer, Applied Energy 102 (2013) 885
            """,
        equation="ΔU = ΣRj·I(t − dj)·(a·exp(−S/w) + b·exp(−(100 − S)/w)); or ΣRj·I in its place",
        scales_drop=True,
        drive=drop,
        over_soc=ends_of_soc,
        core_form=partial(
            core_values,
            "resistance_soc",
            ("at_empty", "at_full", "width_pct", "delayed", "resistance_ohm"),
        ),
    ),
    # Additional (or missing) resistance to charging current.
    Effect(
        id="resistance_asymmetry",
        fault="resistance",
        parameters=(Parameter("charging_ohm", "ohm", -0.6, 1.5),),
        about="""
            **Signature.** min(I, 0): only while charging, in step with the current

            **Separated by** charging and discharging pulses of several sizes: charge_transfer bends
            with the size of the current, equally in both directions

            **Source.** Hu, Li, Peng, J. Power Sources 198 (2012) 359
            """,
        equation="ΔU = −r·min(I, 0)",
        drive=drop_while_charging,
        core_form=partial(core_values, "resistance_asymmetry", ("charging_ohm",)),
    ),
    # A contact works loose, or is repaired. The time counts from the log's first sample, online
    # from the service's first sample. A step that has happened persists, so a model for later
    # drives has `start_s` = 0.
    Effect(
        id="resistance_step",
        fault="resistance",
        parameters=(
            Parameter("step_ohm", "ohm", -0.4, 2.0),
            Parameter("start_s", "s", 0.0, 1e7, grid=(1800.0,)),
        ),
        about="""
            **Signature.** I·1(t > t₀): the drop over the resistance changes in a step and stays
            changed

            **Separated by** the same load before and after at the same SoC and temperature:
            resistance_temperature and resistance_soc revert, a step does not

            **Source.** definition
            """,
        equation="ΔU = −r·I for t − t_first ≥ t₀, else 0",
        memory=first_time,
        drive=drop_after_step,
        core_form=partial(core_values, "resistance_step", ("step_ohm", "start_s")),
    ),
    # Butler–Volmer. With `bend_only` the line through 0 and ±1 C is subtracted: a model identified
    # on logs of the same pack has the mean slope over the currents of a drive already. `scale_v` is
    # 2RT/F per electrode (51 mV at 25 °C) times the cells in series; the bound allows two.
    Effect(
        id="charge_transfer",
        fault="resistance",
        parameters=(
            Parameter("scale_v", "V", 0.0, 0.03),
            Parameter(
                "exchange_a",
                "A",
                0.01,
                2.0,
                grid=(0.02, 0.05, 0.12, 0.3, 0.8),
            ),
            Parameter("bend_only", "1", 0.0, 1.0, grid=(1.0, 0.0)),
            Parameter("activation_k", "K", 0.0, 10000.0, grid=(ACTIVATION_K,)),
        ),
        about="""
            **Signature.** I − c·asinh(I/2I₀): too much drop at small currents, too little at large
            ones

            **Separated by** pulses of several sizes in both directions; resistance_asymmetry is
            straight on each side of zero

            **Source.** Newman, Thomas-Alyea, Electrochemical Systems, 3rd ed., Wiley 2004, ch. 8
            """,
        equation=(
            "ΔU = −v·(asinh(I/2I₀) − b·(I/I₁)·asinh(I₁/2I₀)), I₁ = 1 C, I₀ after Arrhenius (B)"
        ),
        drive=bend,
        core_form=bend_form,
    ),
    # Double layer and charge transfer, faster than the model's first delay.
    Effect(
        id="fast_polarization",
        fault="resistance",
        parameters=(
            Parameter("ohm", "ohm", 0.0, 1.0),
            Parameter("tau_s", "s", 0.3, 9.0, grid=(0.5, 1.0, 2.0, 3.5, 6.0, 9.0)),
            ACTIVATION,
        ),
        about="""
            **Signature.** a tail of seconds after every change of load

            **Separated by** a log at 10 Hz or faster with sharp pulses: time_skew gives spikes
            without tails

            **Source.** Hu, Li, Peng, J. Power Sources 198 (2012) 359
            """,
        equation="ΔU = −R·y·exp(B·(1/T − 1/T₂₅)), τ·dy/dt = I − y",
        memory=rc_memory,
        drive=rc_voltage,
        core_form=rc_form,
        is_rc=True,
    ),
    # In the particles charge diffuses, and its voltage follows the slope of the open-circuit
    # voltage (`by_slope` 1); diffusion in the electrolyte is the same at every SoC (0).
    Effect(
        id="slow_diffusion",
        fault="slow_voltage",
        parameters=(
            Parameter("ohm", "ohm", 0.0, 1.5),
            Parameter(
                "tau_s",
                "s",
                70.0,
                2500.0,
                grid=(80.0, 130.0, 220.0, 400.0, 750.0, 1400.0, 2400.0),
            ),
            ACTIVATION,
            Parameter("by_slope", "1", 0.0, 1.0, grid=(0.0,)),
        ),
        about="""
            **Signature.** low-passed current over 70–2500 s: it decays through a rest after a drive

            **Separated by** a rest of an hour after a drive: hysteresis persists, this decays;
            core_temperature is even in the current

            **Source.** Plett, Battery Management Systems vol. I, Artech House 2015, ch. 2
            """,
        equation=(
            "ΔU = −R·f(S)·y·exp(B·(1/T − 1/T₂₅)), τ·dy/dt = I − y;"
            " f = 1 − b + b·U₀′(S)/mean U₀′, b = by_slope"
        ),
        over_soc=steepness,
        memory=rc_memory,
        drive=rc_voltage,
        core_form=rc_form,
        is_rc=True,
    ),
    # The state starts at 0, since the charge before a log is unknown, and persists through any
    # rest.
    Effect(
        id="hysteresis",
        fault="slow_voltage",
        parameters=(
            Parameter("half_width_v", "V", 0.0, 0.01),
            Parameter("travel_pct", "%", 0.5, 12.0, grid=(1.0, 2.0, 4.0, 7.0, 11.0)),
        ),
        about="""
            **Signature.** memory of sign(I) over Ah: reverses with lasting charge or discharge,
            persists at rest

            **Separated by** rests of an hour after a discharge and after a charge to the same SoC:
            slow_diffusion decays, this persists

            **Source.** one-state model, Plett, J. Power Sources 134 (2004) 262
            """,
        equation="ΔU = M·h, dh/dt = |I|/(γ·C)·(−sign(I) − h)",
        memory=hysteresis_memory,
        drive=hysteresis_voltage,
        core_form=hysteresis_form,
    ),
    # In addition to the model's kt. The bounds are ±0.4 mV/K per cell.
    Effect(
        id="entropic_coefficient",
        fault="temperature",
        parameters=(
            Parameter("level_v_per_k", "V/K", -1.1e-4, 1.1e-4),
            Parameter("slope_v_per_k", "V/K", -1.1e-4, 1.1e-4),
            Parameter("curve_v_per_k", "V/K", -1.1e-4, 1.1e-4),
        ),
        about="""
            **Signature.** (T − T_r)·f(S), at any current

            **Separated by** the same SoC, rested, at two temperatures; at one temperature it is not
            separable from any other change of the OCV with SoC

            **Source.** Reynier, Yazami, Fultz, J. Power Sources 119–121 (2003) 850
            """,
        equation="ΔU = (T − T_r)·(c + a·x + b·(3x² − 1)/2), x = S/50 − 1",
        drive=warmer_k,
        over_soc=entropic_v_per_k,
        core_form=partial(
            core_values,
            "entropic",
            ("level_v_per_k", "slope_v_per_k", "curve_v_per_k", "t_ref_c"),
        ),
    ),
    # From full the SoC of the weak cells falls faster. Below empty they follow the model's linear
    # extrapolation. A reversed cell falls faster, but a pack is switched off before that.
    Effect(
        id="weak_cell",
        fault="weak_cell",
        parameters=(
            Parameter("fraction", "1", 0.0, 0.06),
            Parameter(
                "deficit_pct",
                "%",
                2.0,
                65.0,
                grid=(4.0, 7.0, 11.0, 16.0, 23.0, 33.0, 48.0),
            ),
        ),
        about="""
            **Signature.** the knee near empty comes early, by the fraction of weak cells

            **Separated by** a discharge to below 10 %: a lost capacity of all cells brings the
            whole knee forward, weak cells a small one; or the cells' own voltages

            **Source.** Dubarry, Vuillaume, Liaw, Int. J. Energy Res. 34 (2010) 216
            """,
        equation="ΔU = (n/N)·(OCV(S_w) − OCV(S)), 1 − S_w = (1 − S)/(1 − d)",
        drive=fraction,
        over_soc=weak_less_healthy,
        core_form=weak_form,
    ),
)
