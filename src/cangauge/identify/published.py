"""The published equation by plain least squares: k0 … k7, kt and R1 … Rn, from one factor a log.

Least squares needs of a log only the triangular factor R of the QR decomposition of its rows
[columns, voltage]. The factor of several logs is that of their factors stacked, and has the
condition of the rows, not its square as normal equations have (Golub, Van Loan, Matrix
Computations, 4th ed., §5.3); the powers of 1/s need that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cangauge._typing import FloatArray
from cangauge.errors import InputError
from cangauge.identify.held_out import comparable, stated_error
from cangauge.identify.least_squares import LOGS_AT_LEAST, SECONDS_PER_DATUM
from cangauge.identify.rows import ROWS_PER_COEFFICIENT, SOC_SPAN_AT_LEAST_PCT, FitRows
from cangauge.model.curve import BASIS_NAMES, KNOTS_PCT, PublishedCurve, extended_basis, ocv_basis
from cangauge.model.model_file import Coefficient, Model, Published, coefficient_names
from cangauge.model.noise import Noise
from cangauge.model.prior import principal_functions
from cangauge.model.voltage_model import DELAYS_S, REFERENCE_C

SINGULAR = 1e-9
"""Singular value relative to the largest, of columns of equal norm, below which a combination of
coefficients is not identified [-]: voltages are known to 1e-4, and trips over a fifth of the SoC
reach 1e-10, from full to empty 1e-6."""


@dataclass(frozen=True)
class PublishedEquation:
    """What is chosen of the published equation.

    Parameters
    ----------
    epsilon : float
        Margin ε of the scaled SoC.
    t_ref_c : float
        Reference temperature T_r [°C].
    delay_s : sequence of float
        Delays of the current [s].
    """

    epsilon: float = PublishedCurve.epsilon
    t_ref_c: float = REFERENCE_C
    delay_s: Sequence[float] = DELAYS_S

    def __post_init__(self) -> None:
        if not 0.0 < self.epsilon < 0.5:
            raise InputError(
                "must lie between 0 and 0.5, or the logarithms diverge",
                field="epsilon",
                value=self.epsilon,
                cure="the published value is 0.05",
            )

    def columns(self, rows: FitRows) -> FloatArray:
        """Return the columns of k0 … k7, kt, R1 … Rn, shape (m, p)."""
        warmer = rows.dequantized_c - self.t_ref_c
        currents_a = rows.current_columns_a[:, : len(self.delay_s)]
        return np.column_stack([ocv_basis(rows.soc_pct, self.epsilon), warmer, currents_a])

    def root(self, rows: FitRows) -> FloatArray:
        """Return the triangular factor of a log's [columns, voltage], shape (p + 1, p + 1)."""
        root = np.zeros((len(BASIS_NAMES) + 2 + len(self.delay_s),) * 2)
        for _, chunk in rows.chunks():
            table = np.column_stack([self.columns(chunk), chunk.voltage_v])
            root = np.linalg.qr(np.vstack([root, table])).R
        return root

    def fit(self, rows: Sequence[FitRows], roots: Sequence[FloatArray]) -> PublishedFit:
        """Return the least-squares coefficients; of several solutions the one of least norm.

        Parameters
        ----------
        rows : sequence of FitRows
        roots : sequence of array of shape (p + 1, p + 1)
            Factor of each log.
        """
        root, number = np.linalg.qr(np.vstack(roots)).R, sum(map(len, rows))
        p = len(root) - 1
        norm = np.linalg.norm(root[:, :p], axis=0)
        norm[norm == 0.0] = 1.0
        columns, volts = root[:, :p] / norm, root[:, p]
        left, singular, right = np.linalg.svd(columns, full_matrices=False)
        kept = singular > SINGULAR * singular[0]
        inverse = np.where(kept, 1.0 / np.where(kept, singular, 1.0), 0.0)
        scaled = right.T @ (inverse * (left.T @ volts))
        residual2 = float(np.sum((volts - columns @ scaled) ** 2)) / number
        row_s = sum(len(item) * item.row_s for item in rows) / number
        datum = max(1.0, SECONDS_PER_DATUM / max(row_s, 1e-9))
        covariance = (right.T * (inverse**2 * residual2 * datum)) @ right / np.outer(norm, norm)
        coefficients = scaled / norm
        low = min(float(item.soc_pct.min()) for item in rows)
        high = max(float(item.soc_pct.max()) for item in rows)
        identified = bool(kept.all()) and number >= ROWS_PER_COEFFICIENT * p
        if identified := identified and high - low >= SOC_SPAN_AT_LEAST_PCT:
            try:
                PublishedCurve(tuple(coefficients[: len(BASIS_NAMES)]), self.epsilon, (low, high))
            except InputError:
                identified = False
        return PublishedFit(
            self,
            coefficients,
            covariance,
            residual2**0.5,
            float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf"),
            identified,
            (low, high),
        )


@dataclass(frozen=True, eq=False)
class PublishedFit:
    """Coefficients of the published equation.

    Parameters
    ----------
    equation : PublishedEquation
    coefficients : array of shape (p,)
        k0 … k7 [V], kt [V/K], R1 … Rn [Ω].
    covariance : array of shape (p, p)
        Of the coefficients; 60 s of rows count together as one.
    residual_v : float
        Rms residual [V].
    condition_number : float
        Of the columns, scaled to equal norm.
    identified : bool
        Whether the logs determine every coefficient.
    soc_range_pct : pair of float
    """

    equation: PublishedEquation
    coefficients: FloatArray
    covariance: FloatArray
    residual_v: float
    condition_number: float
    identified: bool
    soc_range_pct: tuple[float, float]

    def fields(self) -> Published:
        """Return the equation for a model file."""
        equation, std = self.equation, np.sqrt(np.diag(self.covariance)).tolist()
        names = coefficient_names(equation.delay_s)
        coefficients = {
            name: Coefficient(
                value=value,
                std_error=error,
                unit="V/K" if name == "kt" else "ohm" if name.startswith("R") else "V",
            )
            for name, value, error in zip(names, self.coefficients.tolist(), std, strict=True)
        }
        return Published(
            coefficients=coefficients,
            epsilon=equation.epsilon,
            t_ref_c=equation.t_ref_c,
            delays_s=tuple(equation.delay_s),
        )

    def jacobian(self) -> FloatArray:
        """Return d(curve at the knots, kt, R1 … Rn)/d(coefficients)."""
        n, p = len(BASIS_NAMES), self.coefficients.size
        jacobian = np.zeros((KNOTS_PCT.size + p - n, p))
        epsilon, soc_range_pct = self.equation.epsilon, self.soc_range_pct
        jacobian[: KNOTS_PCT.size, :n] = extended_basis(KNOTS_PCT, epsilon, soc_range_pct)
        jacobian[KNOTS_PCT.size :, n:] = np.eye(p - n)
        return jacobian


def fit_published(
    rows: Sequence[FitRows], equation: PublishedEquation, fields: dict[str, Any]
) -> tuple[Model, PublishedFit, tuple[FloatArray, ...]]:
    """Fit the published equation; return model, fit and errors of left-out logs [V].

    Parameters
    ----------
    rows : sequence of FitRows
        Of each log.
    equation : PublishedEquation
    fields : dict
        Fields of the model file that are known before the fit.

    Raises
    ------
    InputError
        If the logs do not identify it.
    """
    roots = [equation.root(item) for item in rows]
    published = equation.fit(rows, roots)
    if not published.identified:
        raise InputError(
            "the logs do not identify the published equation: too little SoC, too few rows, or a"
            " pseudo-OCV that falls with SoC",
            field="equation",
            value="published",
            cure="leave out --equation published, or give logs over more SoC",
        )
    errors_v = []
    for number, item in enumerate(rows if len(rows) >= LOGS_AT_LEAST else ()):
        others = [place for place in range(len(rows)) if place != number]
        without = equation.fit([rows[k] for k in others], [roots[k] for k in others])
        errors_v.append(item.voltage_v - item.product(equation.columns, without.coefficients))
    errors = comparable(rows, errors_v)
    mean_v = sum(float(item.voltage_v.sum()) for item in rows) / sum(map(len, rows))
    judged = stated_error(errors, rows, published.residual_v, mean_v)
    jacobian, found = published.jacobian(), published.fields()
    covariance = jacobian @ published.covariance @ jacobian.T
    model = Model(
        equation="published",
        published=found,
        functions=principal_functions(
            fields["chemistry"], covariance, found.loads, fields["capacity_ah"]
        ),
        noise=Noise.of(fields["chemistry"], mean_v, published.residual_v, judged),
        **fields,
    )
    return model, published, errors
