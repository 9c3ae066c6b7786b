"""Model files of version 1, which held the published equation alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from cangauge.errors import InputError
from cangauge.model.prior import BLOCK_S
from cangauge.model.voltage_model import KNOTS_PCT

_SAME = (
    "format", "name", "rate_hz", "capacity_ah", "effects", "temperature_source", "range", "made",
)  # fmt: skip


def block_share(fast_time_s: float) -> float:
    """Return the error of a block's mean relative to that of one second [-].

    It holds as many independent values as the correlation time of the error [s] allows.
    """
    return float(min(1.0, (1.0 + 2.0 * fast_time_s) / BLOCK_S) ** 0.5)


def upgraded(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a version-1 file as those of version 2, to be validated.

    Its information is of another kind and left out.

    Raises
    ------
    InputError
        If a field that version 1 requires is missing or of another type.
    """
    try:
        return _upgraded(raw)
    except KeyError as error:
        raise InputError("required field is missing", field=str(error.args[0])) from error
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f"not a model of version 1 ({error})", field="noise") from error


def _upgraded(raw: Mapping[str, Any]) -> dict[str, Any]:
    noise, delays_s = raw["noise"], raw["delays_s"]
    functions, loads = [], []
    zero = [0.0] * len(delays_s)
    curve = noise.get("curve")
    if curve is not None:
        for function in curve["functions_v"]:
            functions.append(np.interp(KNOTS_PCT, curve["soc_pct"], function).tolist())
            loads.append([0.0, *zero])
        std = curve["kt_std_v_per_k"]
        functions.append([std * (raw["t_ref_c"] - curve["temperature_c"])] * KNOTS_PCT.size)
        loads.append([std, *zero])
    return {name: raw[name] for name in _SAME if name in raw} | {
        "version": 2,
        "equation": "published",
        "chemistry": "oxide",
        "published": {
            name: raw[name] for name in ("coefficients", "epsilon", "t_ref_c", "delays_s")
        },
        "functions": {"soc_pct": KNOTS_PCT.tolist(), "curve_v": functions, "load": loads},
        "noise": {
            "level_std_v": noise["lasting_std_v"],
            "fast_std_v": block_share(noise["fast_time_s"]) * noise["fast_std_v"],
            "soc_std_pct": 0.0,
            "cold_exponent": 0.0,
            "residual_std_v": noise["voltage_rmse_v"],
            **{
                name: noise[name]
                for name in (
                    "slow_std_v", "slow_time_s", "voltage_mae_pct", "voltage_rmse_v", "judged_on",
                )
            },
        },
    }  # fmt: skip
