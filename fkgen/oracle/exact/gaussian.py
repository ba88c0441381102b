"""Gaussian vectors given by a square root of their covariance: roots, projections, densities.

A vector is ``mean + root @ z`` with uncorrelated ``z`` of unit variance: to condition is to project
in the space of ``z``, and small posterior variances keep all digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

#: A singular value of unit rows below this is rounding: some hundred times the unit round-off.
RANK_TOLERANCE = 1e-13


def units(covariance: Array) -> Array:
    """Standard deviations (..., n), with 1 in place of 0."""
    deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    return np.where(deviation > 0.0, deviation, 1.0)


def square_root(covariance: Array) -> Array:
    """Square roots of positive semidefinite matrices (..., n, n), exact in rank, blind to units."""
    unit = units(covariance)
    eigenvalues, vectors = np.linalg.eigh(covariance / (unit[..., :, None] * unit[..., None, :]))
    # A correlation matrix has trace n: below n units of round-off is the zero of a singular one.
    size = covariance.shape[-1]
    eigenvalues = np.where(eigenvalues > 4.0 * size * np.finfo(float).eps, eigenvalues, 0.0)
    root: Array = unit[..., :, None] * vectors * np.sqrt(eigenvalues)[..., None, :]
    return root


@dataclass(frozen=True, eq=False, kw_only=True)
class Whitening:
    """The directions that a vector ``y = mean + root @ z`` reveals about ``z``."""

    directions: Array  # (d, r): Orthonormal basis of the row space of root
    weights: Array  # (r, m): weights @ (y - mean) are the coordinates of z along the directions
    #: log det(root @ root.T), over the regular directions only where that is singular
    log_determinant: float

    @property
    def rank(self) -> int:
        """Number of regular directions."""
        return int(self.directions.shape[1])

    def unexplained(self, root: Array) -> Array:
        """Root of another vector's covariance when ``y`` is known, (a, d) from (a, d)."""
        remainder: Array = root - (root @ self.directions) @ self.directions.T
        # A second pass removes what rounding left of a long vector along the directions.
        return remainder - (remainder @ self.directions) @ self.directions.T


def whiten(root: Array, *, negligible: Array | float = 0.0) -> Whitening:
    """Find what a vector reveals, the rank decided on unit rows; root (m, d), negligible (m,)."""
    norms = np.linalg.norm(root, axis=1)
    alive = norms > negligible
    scale = norms[alive]
    left, singular, right = np.linalg.svd(root[alive] / scale[:, None], full_matrices=False)
    regular = singular > RANK_TOLERANCE * max(1.0, *singular) if singular.size else singular > 0.0
    weights = np.zeros((int(regular.sum()), root.shape[0]))
    weights[:, alive] = (left[:, regular] / singular[regular]).T / scale
    log_determinant = 2.0 * float(np.log(singular[regular]).sum() + np.log(scale).sum())
    return Whitening(directions=right[regular].T, weights=weights, log_determinant=log_determinant)


def log_density(residual: Array, whitening: Whitening) -> float:
    """Log of the Gaussian density of ``y`` at a distance ``residual`` from its mean, eq. (15)."""
    coordinates = whitening.weights @ residual
    constant = whitening.rank * np.log(2.0 * np.pi) + whitening.log_determinant
    return -0.5 * float(constant + coordinates @ coordinates)


def mixture(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance of mixtures (..., N), the latter with the spread of the means."""
    mean = weights @ means
    spread = means - mean[..., None, :]
    within = np.einsum("...i,ijk->...jk", weights, covariances)
    return mean, within + np.einsum("...i,...ij,...ik->...jk", weights, spread, spread)
