"""Actuators that fail now and then: the covariance of their states and their enumeration.

``gamma`` in {0, 1}^q says which actuators work in a sample; its mean is the success rate, eq. (3).
"""

from __future__ import annotations

from itertools import product

import numpy as np

from fkgen.closed_form.gaussian import Array


def fault_covariance(dependence: str, rate: Array, given: Array | None = None) -> Array:
    """Covariance of ``gamma`` in one sample.

    Parameters
    ----------
    dependence : {"common", "independent", "covariance"}
        One coin for all inputs, one coin per input, or the covariance as given.
    rate : (q,) ndarray
        Success rate of each input.
    given : (q, q) ndarray, optional
        The covariance, where the dependence is ``"covariance"``.

    Returns
    -------
    (q, q) ndarray
    """
    if given is not None and dependence == "covariance":
        return given
    variance = rate * (1.0 - rate)
    if dependence == "common":
        return np.full((rate.size, rate.size), variance[0] if rate.size else 0.0)
    return np.diag(variance)


def is_common(rate: Array, covariance: Array) -> bool:
    """Whether one coin decides for all inputs; true also if equal rates leave nothing to chance."""
    return bool(np.all(rate == rate[:1]) and np.all(covariance == covariance[:1, :1]))


def is_independent(covariance: Array) -> bool:
    """Whether the inputs fail independently: no covariance off the diagonal."""
    return bool(np.all(covariance == np.diag(np.diagonal(covariance))))


def common_patterns(rate: Array) -> tuple[Array, Array]:
    """Both states of inputs that fail together.

    Parameters
    ----------
    rate : (q,) ndarray
        q equal success rates, q > 0.

    Returns
    -------
    patterns : (2, q) ndarray
    probabilities : (2,) ndarray
    """
    return np.array([np.zeros(rate.size), np.ones(rate.size)]), np.array([1.0 - rate[0], rate[0]])


def independent_patterns(rate: Array) -> tuple[Array, Array]:
    """All states of inputs that fail independently.

    Parameters
    ----------
    rate : (q,) ndarray
        Success rates.

    Returns
    -------
    patterns : (2**q, q) ndarray
    probabilities : (2**q,) ndarray
    """
    patterns = np.array(list(product((0.0, 1.0), repeat=rate.size))).reshape(-1, rate.size)
    return patterns, np.prod(np.where(patterns > 0.0, rate, 1.0 - rate), axis=1)


def pair_patterns(rate: Array, covariance: Array) -> tuple[Array, Array]:
    """Enumerate two correlated inputs: Pr(both work) = Cov_12 + xi_1 xi_2.

    Parameters
    ----------
    rate : (2,) ndarray
        Success rates.
    covariance : (2, 2) ndarray
        Covariance of ``gamma``.

    Returns
    -------
    patterns : (4, 2) ndarray
    probabilities : (4,) ndarray
    """
    both = covariance[0, 1] + rate[0] * rate[1]
    patterns = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    probabilities = np.array([1.0 - rate.sum() + both, rate[1] - both, rate[0] - both, both])
    # A boundary case (say both = xi_1) may round to -1e-17, which is no probability.
    return patterns, np.clip(probabilities, 0.0, 1.0)
