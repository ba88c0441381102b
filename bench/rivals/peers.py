"""The same filter in Python: filterpy, numba, NumPy by hand; each returns x(T|T) of a record."""

from __future__ import annotations

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
        import numba  # noqa: PLC0415 - optional

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            compiled = numba.njit(textbook)
        found["numba, njit"] = lambda y: compiled(*_matrices(spec), y)
    return found


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
