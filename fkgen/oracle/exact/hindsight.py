"""Estimates of past samples from one joint distribution."""

from __future__ import annotations

import numpy as np

from fkgen.oracle.exact.batch import Joint, past_of
from fkgen.oracle.exact.gaussian import Array


def given_all(joint: Joint, y: Array) -> tuple[Array, Array]:
    """Mean (T, n) and covariance (T, n, n) of every state of a record, given all of y (T, p)."""
    past, z = past_of(joint, y)
    roots = [past.unexplained(root) for root in joint.state_root[: len(y)]]
    state = joint.state_mean[: len(y)] + joint.state_root[: len(y)] @ z
    return state, np.array([root @ root.T for root in roots])


def given_so_far(joint: Joint, y: Array, lag: int) -> tuple[Array, Array]:
    """The same of x[k - lag], or of x[0] before there is one, given y[0..k], for every k."""
    found = [given_all(joint, y[: k + 1]) for k in range(len(y))]
    at = [max(k - lag, 0) for k in range(len(y))]
    states, covariances = (
        [each[of][i] for each, i in zip(found, at, strict=True)] for of in (0, 1)
    )
    return np.array(states), np.array(covariances)
