"""Linear Gaussian model: y = X·θ + ε with ε ~ N(0, Σ) and a Gaussian prior of θ.

The rows are kept whitened and triangular, as in a square-root information filter (Bierman,
*Factorization Methods for Discrete Sequential Estimation*, 1977, ch. V): `reduced` rows stand for
any number of rows, and a prior is rows like any others. One QR factorisation of

    [ X₁ X₂ y ]  →  [ R₁₁ R₁₂ r₁ ]
                    [  0  R₂₂ r₂ ]

gives the posterior of θ₁ (R₁₁, r₁), the log evidence (R₁₁, r₂), and what is left for further
columns (R₂₂, r₂).

    posterior = (Rows.of(X, y, std) + Rows.prior(prior_std)).posterior()

Columns that many hypotheses add are weighed together:

    rows = Rows.of(np.c_[X, candidates], y, std) + Rows.prior(prior_std, others=k)
    rows.added(X.shape[1], candidate_std).log_factor
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from cangauge._typing import FloatArray, IntArray

LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class GaussianPosterior:
    """Posterior of θ: a normal distribution.

    Parameters
    ----------
    mean : array of shape (p,)
    root : array of shape (p, p)
        A root of the covariance: root·rootᵀ.
    """

    mean: FloatArray
    root: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance, shape (p, p)."""
        return np.asarray(self.root @ self.root.T)


@dataclass(frozen=True, eq=False)
class Added:
    """What one more column of a model gives, for each of some columns; arrays of shape (k,).

    Parameters
    ----------
    log_evidence : float
        Of the model without any of them.
    log_factor : array
        Gain of log evidence (log Bayes factor against that model).
    mean : array
        Posterior mean of its coefficient.
    """

    log_evidence: float
    log_factor: FloatArray
    mean: FloatArray


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened rows of a linear Gaussian model.

    Parameters
    ----------
    table : array of shape (n, p + 1)
        Columns of θ, then y; each row has unit noise.
    log_norm : float
        Log of the normalisation of the rows' noise: −½·(n·ln 2π + ln |Σ|).
    """

    table: FloatArray
    log_norm: float

    @classmethod
    def of(cls, X: FloatArray, y: FloatArray, std: FloatArray | float) -> Rows:
        """Return rows of independent noise.

        Parameters
        ----------
        X : array of shape (n, p)
        y : array of shape (n,)
        std : array of shape (n,), or float
            Standard deviation of the noise.
        """
        table = np.column_stack([X, y])
        std = np.broadcast_to(np.asarray(std, dtype=np.float64), (len(table),))
        log_norm = -0.5 * len(table) * LOG_2PI - float(np.log(std).sum())
        return cls(table / std[:, None], log_norm).reduced()

    @classmethod
    def correlated(cls, X: FloatArray, y: FloatArray, root: FloatArray) -> Rows:
        """Return rows of correlated noise.

        Parameters
        ----------
        X : array of shape (n, p)
        y : array of shape (n,)
        root : array of shape (n, n)
            Lower Cholesky factor of the noise's covariance.
        """
        table = solve_triangular(root, np.column_stack([X, y]), lower=True)
        log_norm = -0.5 * len(table) * LOG_2PI - float(np.log(np.diag(root)).sum())
        return cls(table, log_norm).reduced()

    @classmethod
    def prior(cls, std: FloatArray, others: int = 0) -> Rows:
        """Return the rows of a prior of independent coefficients of mean 0.

        Parameters
        ----------
        std : array of shape (p,)
            Standard deviations.
        others : int
            Coefficients after them on which it says nothing.
        """
        return cls.of(np.eye(len(std), len(std) + others), np.zeros(len(std)), std)

    def __add__(self, other: Rows) -> Rows:
        """Return both as one."""
        table = np.concatenate([self.table, other.table])
        return Rows(table, self.log_norm + other.log_norm).reduced()

    def reduced(self) -> Rows:
        """Return at most p + 1 triangular rows that stand for these."""
        if len(self.table) <= self.table.shape[1]:
            return self
        return replace(self, table=_triangular(self.table))

    def with_columns(self, columns: Sequence[int] | IntArray) -> Rows:
        """Return the rows of a model with some of the coefficients only, in the order given."""
        return replace(self, table=self.table[:, [*columns, -1]])

    def eliminated(self, columns: int) -> Rows:
        """Return the rows with the first coefficients integrated out.

        Each of them needs a prior, or rows that determine it.
        """
        table = _triangular(self.table)
        log_norm = self.log_norm + 0.5 * columns * LOG_2PI
        log_norm -= float(np.log(np.abs(np.diag(table)[:columns])).sum())
        return Rows(table[columns:, columns:], log_norm)

    def posterior(self) -> GaussianPosterior:
        """Return the posterior; each coefficient needs a prior, or rows."""
        p = self.table.shape[1] - 1
        table = _triangular(self.table)
        root = solve_triangular(table[:p, :p], np.eye(p))
        return GaussianPosterior(root @ table[:p, -1], root)

    def added(self, columns: int, std: FloatArray) -> Added:
        """Return what each column after the first gives to the model of the first ones.

        Parameters
        ----------
        columns : int
            Columns of the model; each needs a prior, or data.
        std : array of shape (k,)
            Prior standard deviations of the coefficients of the others, each of mean 0.
        """
        left = self.eliminated(columns)
        table = left.table
        X, y = table[:, :-1], table[:, -1]
        precision = np.sum(X**2, axis=0) + std**-2.0
        mean = y @ X / precision
        log_factor = 0.5 * (mean**2 * precision - np.log(precision * std**2))
        log_evidence = left.log_norm - 0.5 * float(y @ y)
        return Added(log_evidence, log_factor, mean)


def _triangular(table: FloatArray) -> FloatArray:
    """Return R of a table's QR factorisation."""
    return np.asarray(np.linalg.qr(table, mode="r"), dtype=np.float64)
