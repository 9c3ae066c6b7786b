"""A true fault in the terms of the diagnosis: which parameter, which value.

Only faults whose size is a quantity that a diagnosis can state. The twin and the library of
effects name and sign them each in their own way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

_Values = Callable[[float, Mapping[str, float]], dict[str, float]]

_EXPECTED: Final[Mapping[str, _Values]] = {
    "current_offset": lambda size, _shape: {"offset_a": size},
    "current_gain": lambda size, _shape: {"gain_pct": 100.0 * size},
    "voltage_offset": lambda size, _shape: {"offset_v": size},
    "voltage_gain": lambda size, _shape: {"gain_pct": 100.0 * size},
    "time_skew": lambda size, _shape: {"skew_s": size},
    "capacity": lambda size, _shape: {"change_pct": -100.0 * size},
    "initial_soc": lambda size, _shape: {"offset_pct": size},
    "coulombic_efficiency": lambda size, _shape: {"efficiency": 1.0 - size},
    "resistance_asymmetry": lambda size, _shape: {"charging_ohm": size},
    "resistance_step": lambda size, shape: {"step_ohm": size, "start_s": shape["at_s"]},
}

COMPARABLE: Final = tuple(_EXPECTED)


def expected_parameters(fault: Mapping[str, Any]) -> dict[str, float]:
    """Return the parameters that a perfect diagnosis of a fault would state.

    Parameters
    ----------
    fault : mapping
        As in a label: `id`, `size`, `shape`.

    Returns
    -------
    dict of str to float
        Parameter of the effect → value in its unit; empty where the size cannot be compared.
    """
    rule = _EXPECTED.get(fault["id"])
    return {} if rule is None else rule(float(fault["size"]), fault["shape"])
