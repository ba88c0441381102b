"""The same filter in Python, by what is installed; each returns x(T|T) of a record."""

from __future__ import annotations

import functools
import importlib.util
import warnings
from collections.abc import Callable

import numpy as np
from harness import models

Filter = Callable[[models.Array], models.Array]


def available(spec: models.Spec) -> dict[str, Filter]:
    """All that are installed."""
    found = {"NumPy by hand": lambda y: textbook(*_matrices(spec), y)}
    if importlib.util.find_spec("filterpy"):
        found["filterpy"] = lambda y: _filterpy(spec, y)
    if importlib.util.find_spec("numba"):
        compiled = _numba()
        found["numba, njit"] = lambda y: compiled(*_matrices(spec), y)
    if importlib.util.find_spec("statsmodels"):
        found["statsmodels"] = lambda y: _statsmodels(spec, y)
    if importlib.util.find_spec("simdkalman"):
        found["simdkalman"] = lambda y: _simdkalman(spec, y)
    return found


@functools.cache
def _numba() -> Callable[..., models.Array]:
    """The textbook, compiled once for all models."""
    import numba  # noqa: PLC0415 - optional

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        compiled: Callable[..., models.Array] = numba.njit(textbook)
    return compiled


def whole_records() -> set[str]:
    """Names of those that take a record in one call of compiled code."""
    return {"numba, njit", "statsmodels"}


def _matrices(spec: models.Spec) -> tuple[models.Array, ...]:
    names = ("A", "C", "Q", "R", "P0")
    return tuple(np.array(spec["model"][name], float) for name in names)


def textbook(  # noqa: PLR0917 - numba wants it flat
    A: models.Array,
    C: models.Array,
    Q: models.Array,
    R: models.Array,
    P: models.Array,
    y: models.Array,
) -> models.Array:
    """Kalman filter as it stands in a textbook, with the log-likelihood."""
    x = np.zeros(len(A))
    total = 0.0
    for k in range(len(y)):
        S = C @ P @ C.T + R
        K = np.linalg.solve(S, C @ P).T
        e = y[k] - C @ x
        nis = e @ np.linalg.solve(S, e)
        total += -0.5 * (nis + np.log(np.linalg.det(S)) + len(e) * 1.8378770664093453)
        filtered = x + K @ e
        Pf = P - K @ C @ P
        x = A @ filtered
        P = A @ Pf @ A.T + Q
    return filtered


def _filterpy(spec: models.Spec, y: models.Array) -> models.Array:
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415 - optional

    n, p, _ = models.width(spec)
    f = KalmanFilter(dim_x=n, dim_z=p)
    f.F, f.H, f.Q, f.R, f.P = _matrices(spec)
    f.x = np.zeros(n)
    for row in y:
        f.update(row)
        filtered = f.x
        f.predict()
    return filtered


def _statsmodels(spec: models.Spec, y: models.Array) -> models.Array:
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter  # noqa: PLC0415 - optional

    A, C, Q, R, P = _matrices(spec)
    f = KalmanFilter(k_endog=len(C), k_states=len(A))
    f.bind(y)
    f["transition"], f["design"], f["selection"] = A, C, np.eye(len(A))
    f["state_cov"], f["obs_cov"] = Q, R
    f.initialize_known(np.zeros(len(A)), P)
    filtered: models.Array = f.filter().filtered_state[:, -1]
    return filtered


def _simdkalman(spec: models.Spec, y: models.Array) -> models.Array:
    import simdkalman  # noqa: PLC0415 - optional

    A, C, Q, R, P = _matrices(spec)
    f = simdkalman.KalmanFilter(
        state_transition=A, process_noise=Q, observation_model=C, observation_noise=R
    )
    found = f.compute(
        y[None], 0, initial_value=np.zeros(len(A)), initial_covariance=P, filtered=True,
        smoothed=False,
    )  # fmt: skip
    filtered: models.Array = found.filtered.states.mean[0, -1]
    return filtered
