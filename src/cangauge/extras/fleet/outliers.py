"""What lies far from the others of a fleet: values, and logs that the common model does not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cangauge._text import NONE_KNOWN, number, significant
from cangauge._typing import FloatArray
from cangauge.extras.fleet.sources import short_names
from cangauge.model.model_file import Noise

OUTLIER_Z: Final = 3.5
"""Robust z from which a value is an outlier (Iglewicz, Hoaglin, How to Detect and Handle Outliers,
1993)."""
VALUES_AT_LEAST: Final = 5
"""Vehicles, or logs, from which the spread of a fleet is known."""
_MAD_TO_STD: Final = 1.4826
"""Standard deviation over median absolute deviation, of a normal distribution."""


def robust_z(values: FloatArray, std: FloatArray) -> FloatArray:
    """Return z = (x − median)/√(s² + σ²), with s the scaled median absolute deviation.

    Parameters
    ----------
    values : array of shape (n,)
    std : array of shape (n,)
        Own standard deviation σ of each value: one that is badly known is no outlier.
    """
    apart = values - np.median(values)
    scale = np.hypot(_MAD_TO_STD * float(np.median(np.abs(apart))), std)
    return np.asarray(np.divide(apart, scale, out=np.zeros_like(apart), where=scale > 0.0))


@dataclass(frozen=True, eq=False)
class ErrorsByLog:
    """Mean error of the voltage of each log under the model of all logs.

    The mean is what a wrong sensor, unit, temperature or SoC at the start leaves; a harder drive
    has a larger error, but not a larger mean. A log that alone covers a range of SoC shapes the
    model there, and so fits it.

    Parameters
    ----------
    logs, vehicles : sequence of n str
    mean_v, rmse_v : array of shape (n,)
        Mean and root mean square of measured minus modelled voltage [V].
    seconds : array of shape (n,)
        Weight of each log [s].
    noise : Noise
        Error model, which gives the standard deviation of a mean by its fast and slow parts.
    """

    logs: Sequence[str]
    vehicles: Sequence[str]
    mean_v: FloatArray
    rmse_v: FloatArray
    seconds: FloatArray
    noise: Noise

    @property
    def is_known(self) -> bool:
        """Whether there are enough logs to show which one does not fit the others."""
        return len(self.logs) >= VALUES_AT_LEAST

    @property
    def z(self) -> FloatArray:
        """Robust z of the mean error among the logs; 0 if their spread is not known."""
        if not self.is_known:
            return np.zeros(len(self.logs))
        seconds = np.maximum(self.seconds, self.noise.block_s)
        variance_v2 = self.noise.fast_std_v**2 * self.noise.block_s / seconds
        stretches = seconds / (2.0 * self.noise.slow_time_s)
        variance_v2 += self.noise.slow_std_v**2 / np.maximum(1.0, stretches)
        return robust_z(self.mean_v, np.sqrt(variance_v2))

    @property
    def order(self) -> list[int]:
        """The logs, the farthest from the others first."""
        return [int(k) for k in np.argsort(-np.abs(self.z), kind="stable")]

    @property
    def misfits(self) -> list[int]:
        """The logs that do not fit the others, the farthest first."""
        z = np.abs(self.z)
        return [k for k in self.order if z[k] >= OUTLIER_Z]

    @property
    def count_text(self) -> str:
        """The number of logs that do not fit, or a dash."""
        return f"{len(self.misfits)} of {len(self.logs)}" if self.is_known else NONE_KNOWN

    @property
    def rule_text(self) -> str:
        """Which logs do not fit the others, and what to do with them, in sentences."""
        if not self.is_known:
            return (
                f"Fewer than {VALUES_AT_LEAST} logs do not show which one does not fit the others."
            )
        rule = (
            "A log does not fit the others where its mean error is an outlier among theirs (robust"
            f" |z| from {OUTLIER_Z}, with the deviation that the error model states for a mean)."
        )
        if not self.misfits:
            return rule
        return (
            f"{rule} Check it (sensor, unit, temperature, SoC at its start), and fit again"
            f" without {self.logs[self.misfits[0]]}. The farthest first, since it also distorts the"
            " errors of the others."
        )

    def misfit_rows(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows of the table of the logs that do not fit the others."""
        z, misfits = self.z, self.misfits
        names = short_names([self.logs[k] for k in misfits])
        rows = [
            [
                self.vehicles[k],
                name,
                significant(self.mean_v[k], 3),
                significant(self.rmse_v[k], 3),
                number(z[k], 1),
            ]
            for name, k in zip(names, misfits, strict=True)
        ]
        return ["vehicle", "log", "mean error [V]", "RMSE [V]", "robust z"], rows

    def to_dict(self) -> dict[str, Any]:
        """Return the logs that do not fit as JSON; None if that is not known."""
        numbers = {"mean_v": self.mean_v, "rmse_v": self.rmse_v, "z": self.z}
        misfits = [
            {
                "log": self.logs[k],
                "vehicle": self.vehicles[k],
                **{name: float(values[k]) for name, values in numbers.items()},
            }
            for k in self.misfits
        ]
        return {"misfits": misfits if self.is_known else None}
