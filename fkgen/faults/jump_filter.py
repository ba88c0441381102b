"""Whether the second moments of a jumping plant, and the law of its mode, have a limit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fkgen.problem.probability import period, stationary_law

Array = NDArray[np.float64]

#: Radii closer to one than this are not told from one.
MARGIN = 1e-9


def mean_square_radius(transition: Sequence[Sequence[float]], dynamics: Sequence[Array]) -> float:
    """Spectral radius of the operator that moves second moments; below 1: mean-square stable.

    Costa, Fragoso & Marques 2005, Theorem 3.9: block (j, i) is p_ij A_i (x) A_i.
    """
    P = np.asarray(transition, float)
    moved = [np.kron(A, A) for A in dynamics]
    blocks = [[P[i, j] * moved[i] for i in range(len(P))] for j in range(len(P))]
    return float(np.abs(np.linalg.eigvals(np.block(blocks))).max())


def is_ergodic(transition: Sequence[Sequence[float]]) -> bool:
    """Whether the law of the mode converges to one limit, wherever the chain starts."""
    return stationary_law(transition) is not None and period(transition) == 1
