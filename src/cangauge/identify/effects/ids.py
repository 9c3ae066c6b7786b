"""Which effects a fit may look for, and what a user may name."""

from __future__ import annotations

from collections.abc import Sequence

from cangauge.errors import InputError
from cangauge.model.effects.library import LIBRARY, effect_of

AUTO = "auto"

CLEAN = (
    "resistance_temperature", "resistance_soc", "resistance_asymmetry", "charge_transfer",
    "fast_polarization", "slow_diffusion", "hysteresis", "entropic_coefficient",
    "temperature_lag", "core_temperature",
)  # fmt: skip
"""Structure that a clean pack may well have and the coefficients lack: what `auto` tries."""

REFUSED = {
    "initial_soc": "it belongs to one log: give --initial-soc",
    "resistance_step": "it belongs to one log: a clean pack has none",
    "capacity": "give --capacity-ah; the curve over SoC follows it",
    "current_gain": "resistances and capacity hold it: give --capacity-ah",
    "voltage_offset": "k0 holds it",
    "voltage_gain": "the coefficients hold it",
}
"""Effects that a fit cannot tell from its own numbers, and why."""

TWICE = 2
"""So often one effect may be taken, with different shapes: a chain of RC elements."""


def parse_ids(given: Sequence[str]) -> tuple[str, ...]:
    """Return effect ids from options that may hold several, separated by commas.

    Raises
    ------
    InputError
        If an id is unknown, cannot be told from the coefficients, is there too often, or stands
        beside `auto`.
    """
    ids = [part.strip() for text in given for part in text.split(",")]
    if ids == [AUTO]:
        return (AUTO,)
    if AUTO in ids:
        raise InputError(
            "auto chooses by itself", field="--effects", value=", ".join(ids),
            cure="give auto alone, or ids alone",
        )  # fmt: skip
    for effect_id in ids:
        effect_of(effect_id, "--effects")
        if effect_id in REFUSED:
            raise InputError(
                "a fit on clean logs cannot find it",
                field="--effects",
                value=effect_id,
                cure=REFUSED[effect_id],
            )
        often = TWICE if LIBRARY[effect_id].shapes and LIBRARY[effect_id].amplitudes else 1
        if ids.count(effect_id) > often:
            raise InputError(
                f"may be there {'twice' if often == TWICE else 'once'}",
                field="--effects",
                value=", ".join(ids),
            )
    return tuple(ids)
