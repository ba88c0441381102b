"""Which inputs work together: a joint law of several inputs from rates and covariances."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Error of a probability that a linear program may leave.
TOLERANCE = 1e-9


def pattern_law(rates: ArrayLike, covariance: ArrayLike) -> NDArray[np.float64] | None:
    """Probabilities of all patterns of q inputs that work (1) or fail (0).

    For more than two inputs the moments leave the law open; this is the one with the smallest total
    distance from independent inputs.

    Parameters
    ----------
    rates : (q,) array_like
        Pr(input i works).
    covariance : (q, q) array_like
        Cov(gamma).

    Returns
    -------
    (2**q,) ndarray or None
        In the order of ``itertools.product((1, 0), repeat=q)``; None if no law has these moments.
    """
    from scipy.optimize import linprog  # noqa: PLC0415 - slow to import

    rate, moments = np.asarray(rates, float), np.asarray(covariance, float)
    q = rate.size
    patterns = np.array(list(product((1.0, 0.0), repeat=q)))
    pairs = [(i, j) for i in range(q) for j in range(i)]
    rows = [np.ones(2**q), *patterns.T, *(patterns[:, i] * patterns[:, j] for i, j in pairs)]
    sides = [1.0, *rate, *(moments[i, j] + rate[i] * rate[j] for i, j in pairs)]
    independent = np.prod(np.where(patterns > 0.0, rate, 1.0 - rate), axis=1)
    one = np.eye(2**q)
    found = linprog(  # p, then |p - independent|
        np.repeat([0.0, 1.0], 2**q),
        A_ub=np.block([[one, -one], [-one, -one]]),
        b_ub=np.concatenate([independent, -independent]),
        A_eq=np.hstack([np.array(rows), np.zeros((len(rows), 2**q))]),
        b_eq=sides,
    )
    if not found.success:
        return None
    law = np.maximum(found.x[: 2**q], 0.0)
    return np.asarray(law / law.sum())
