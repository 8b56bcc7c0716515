"""A surrogate of an expensive function: a Gaussian process through what has been seen (Rasmussen
and Williams 2006, chapters 2 and 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHORTEST, LONGEST = 0.05, 5.0
"""Length scales, of a range."""
NOISE = 1e-3
"""Variance that no length scale explains, of the variance of values: episodes change by jumps."""


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """Conditioned on points.

    Attributes:
        scales: [D] length scales of the kernel (Matern 5/2).
        points: [N, D].
        factor: [N, N] Cholesky factor of their covariance.
        weights: [N].
        mean, spread: of the values.
    """

    scales: Array
    points: Array
    factor: Array
    weights: Array
    mean: float
    spread: float

    @classmethod
    def fitted(
        cls, points: Array, values: Array, *, scales: Array | None = None
    ) -> GaussianProcess:
        """Through points [N, D] in the unit cube and values [N].

        Args:
            points, values: seen; at least two.
            scales: length scales; None finds the likeliest.
        """
        mean, spread = float(values.mean()), max(float(values.std()), 1e-9)
        unit = (values - mean) / spread
        found = _likeliest(points, unit) if scales is None else scales
        factor = _factor(points, found)
        return cls(found, points, factor, _solved(factor, unit), mean, spread)

    def at(self, points: Array) -> tuple[Array, Array]:
        """Means and standard deviations [M] at points [M, D]."""
        from scipy.linalg import solve_triangular

        between = _covariance(points, self.points, self.scales)
        half = solve_triangular(self.factor, between.T, lower=True, check_finite=False)
        left = np.maximum(1.0 - (half * half).sum(axis=0), 1e-12)
        return self.mean + self.spread * (between @ self.weights), self.spread * np.sqrt(left)


def _covariance(a: Array, b: Array, scales: Array) -> Array:
    """[A, B] Matern 5/2 of variance 1."""
    from scipy.spatial.distance import cdist

    r = np.sqrt(5.0) * cdist(a / scales, b / scales)
    found: Array = (1.0 + r + r * r / 3.0) * np.exp(-r)
    return found


def _factor(points: Array, scales: Array) -> Array:
    noisy = _covariance(points, points, scales) + NOISE * np.eye(len(points))
    return np.asarray(np.linalg.cholesky(noisy), np.float64)


def _solved(factor: Array, values: Array) -> Array:
    from scipy.linalg import cho_solve

    found: Array = cho_solve((factor, True), values, check_finite=False)
    return found


def _likeliest(points: Array, unit: Array) -> Array:
    """Length scales by the marginal likelihood, with a weak preference for about half a range."""
    from scipy.optimize import minimize

    def cost(logs: Array) -> float:
        scales = np.exp(logs)
        factor = _factor(points, scales)
        fit = 0.5 * float(unit.dot(_solved(factor, unit))) + np.log(np.diag(factor)).sum()
        return float(fit + 0.5 * ((logs - np.log(0.5)) ** 2).sum())

    bounds = [(np.log(SHORTEST), np.log(LONGEST))] * points.shape[1]
    options: Any = {"maxiter": 20}
    start = np.full(points.shape[1], np.log(0.5))
    found = minimize(cost, start, method="L-BFGS-B", bounds=bounds, options=options)
    # Rounded, so that sums of other threads lead to the same.
    scales: Array = np.round(np.exp(found.x), 3)
    return scales
