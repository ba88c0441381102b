"""The one-step filter in NumPy, right and with slips that one may make in programming it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from section_vi import FACTOR, A, Floats

Slip = Literal["none", "mean", "mean_covariance", "transposed", "gamma_transposed"]
SLIPS: dict[Slip, str] = {
    "none": "as it should be",
    "mean": "(9) with the mean H xhat[k-1]",
    "mean_covariance": "(9) with that mean and H P[k-1] H' + R delta",
    "transposed": "4 x 4 kernel transposed in (10)",
    "gamma_transposed": "chain of gamma alone transposed in (10)",
}
#: Order of the kernel's axes: gamma, delta of the mode at k - 1, gamma, delta of that at k.
_AXES = {"transposed": (2, 3, 0, 1), "gamma_transposed": (2, 1, 0, 3)}
_GAMMA = np.array([[1.0], [1.0], [0.0], [0.0]])
_DELTA = np.array([[1.0], [FACTOR], [1.0], [FACTOR]])


def one_step(y: Floats, kernel: Floats, initial: Floats, slip: Slip) -> tuple[Floats, Floats]:
    """Filter all runs at once, the covariance matched to the moments.

    Parameters
    ----------
    y : (M, T) ndarray
        Measurements.
    kernel, initial : (4, 4), (4,) ndarray
        Law of the modes (1,1) (1,C) (0,1) (0,C) as (gamma, delta).
    slip : str
        One of `SLIPS`.

    Returns
    -------
    state, variance : (M, T) ndarray
    """
    axes = _AXES.get(slip, (0, 1, 2, 3))
    transition = kernel.reshape(2, 2, 2, 2).transpose(axes).reshape(4, 4)
    x, P = np.zeros(len(y)), np.zeros(len(y))
    mean, spread = x, P  # of x in the likelihood (9)
    weight = np.repeat(initial[:, np.newaxis], len(y), axis=1)
    state, variance = np.empty_like(y), np.empty_like(y)
    for k in range(y.shape[1]):
        S = _GAMMA * spread + _DELTA
        surprise = (y[:, k] - _GAMMA * mean) ** 2 / S + np.log(S)
        weight = weight * np.exp(-0.5 * (surprise - surprise.min(axis=0)))
        weight /= weight.sum(axis=0)
        gain = _GAMMA * P / (_GAMMA * P + _DELTA)
        means = x + gain * (y[:, k] - _GAMMA * x)
        x = (weight * means).sum(axis=0)
        P = (weight * ((1.0 - gain * _GAMMA) * P + (means - x) ** 2)).sum(axis=0)
        state[:, k], variance[:, k] = x, P
        after = x, P
        x, P = A * x, A * P * A + 1.0
        mean = after[0] if slip in {"mean", "mean_covariance"} else x
        spread = after[1] if slip == "mean_covariance" else P
        weight = transition.T @ weight
        weight /= weight.sum(axis=0)  # a transposed kernel does not keep the sum
    return state, variance
