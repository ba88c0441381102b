"""Interacting multiple models for sensor faults in Python: NumPy by hand and filterpy.

Each returns, after the last sample of a record, the filtered state, the lower triangle of its
covariance and the probabilities of the modes. A row of NaN is a missing sample.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from harness import models

Filter = Callable[[models.Array], models.Array]


@dataclass(frozen=True)
class Switching:
    """A plant and the law of its sensor in numbers, made from the spec without fkgen.

    Attributes
    ----------
    signal, noise : (4,) array
        gamma and delta of every condition (1,1) (1,C) (0,1) (0,C).
    mode : (4,) array of int
        Mode that a condition belongs to.
    share : (4,) array
        Probability of a condition given its mode.
    kernel, initial : (N, N), (N,) array
    """

    A: models.Array
    C: models.Array
    Q: models.Array
    R: models.Array
    P0: models.Array
    signal: models.Array
    noise: models.Array
    mode: models.Array
    share: models.Array
    kernel: models.Array
    initial: models.Array


def switching(spec: models.Spec) -> Switching:
    """Read a spec of problem 3 (delta independent from sample to sample) or 4."""
    sensor, modes = spec["faults"]["sensor"], spec["filter"]["modes"]
    if sensor["problem"] == 3:
        signal = np.array(sensor["gamma_chain"])[::-1, ::-1]  # to the order (1, 0)
        kernel = np.kron(signal, sensor["delta_chain"])
    else:
        kernel = np.array(sensor["kernel"])
    initial, share = np.array(sensor["initial"]), np.ones(4)
    if modes == 3:
        share[2:] = sensor["delta_chain"][0]
        kernel = np.column_stack([kernel[:3, :2], kernel[:3, 2:].sum(axis=1)])
        initial = np.array([*initial[:2], initial[2:].sum()])
    return Switching(
        *(np.array(spec["model"][name], float) for name in ("A", "C", "Q", "R", "P0")),
        signal=np.array([1.0, 1.0, 0.0, 0.0]),
        noise=np.array([1.0, sensor["noise_factor"]] * 2),
        mode=np.minimum(np.arange(4), modes - 1),
        share=share,
        kernel=kernel,
        initial=initial,
    )


def available(spec: models.Spec) -> dict[str, Filter]:
    """All that are installed and can express the modes."""
    model = switching(spec)
    found: dict[str, Filter] = {"NumPy by hand": lambda y: textbook(model, y)}
    if importlib.util.find_spec("filterpy") and len(model.initial) == 4:
        found["filterpy"] = lambda y: _filterpy(model, y)
    return found


def textbook(model: Switching, y: models.Array) -> models.Array:
    """Correct, weigh, combine, mix, predict: all modes at once as stacked arrays."""
    A, C, Q, kernel = model.A, model.C, model.Q, model.kernel
    N = len(kernel)
    H, R = model.signal[:, None, None] * C, model.noise[:, None, None] * model.R
    Ht = H.transpose(0, 2, 1)
    x, P, c = np.zeros((N, len(A))), np.broadcast_to(model.P0, (N, *A.shape)), model.initial
    for row in y:
        likelihood = np.ones(N)
        if not np.isnan(row).any():
            prior, W = x[model.mode], P[model.mode] @ Ht
            e, S = row - np.einsum("crn,cn->cr", H, prior), H @ W + R
            inverse = np.linalg.inv(S)
            nis = np.einsum("cr,crs,cs->c", e, inverse, e)
            density = np.exp(-0.5 * nis) / np.sqrt(np.linalg.det(2.0 * np.pi * S))
            likelihood = np.bincount(model.mode, model.share * density)
            K = (W @ inverse)[:N]
            x = prior[:N] + np.einsum("cnr,cr->cn", K, e[:N])
            P = P - K @ H[:N] @ P
        mu = c * likelihood
        mu /= mu.sum()
        filtered = mu @ x
        d = x - filtered
        Pf = np.tensordot(mu, P + d[:, :, None] * d[:, None, :], 1)
        c = mu @ kernel
        w = kernel * mu[:, None] / c  # w[i, j]: mode i before, j after
        mixed = w.T @ x
        d = x[:, None, :] - mixed
        spread = np.einsum("ij,ija,ijb->jab", w, d, d)
        x = mixed @ A.T
        P = A @ (np.tensordot(w.T, P, 1) + spread) @ A.T + Q
    return _outputs(filtered, Pf, mu)


def _filterpy(model: Switching, y: models.Array) -> models.Array:
    from filterpy.kalman import IMMEstimator, KalmanFilter  # noqa: PLC0415 - optional

    filters = []
    for signal, noise in zip(model.signal, model.noise, strict=True):
        f = KalmanFilter(dim_x=len(model.A), dim_z=len(model.C))
        f.F, f.H, f.Q, f.R = model.A, signal * model.C, model.Q, noise * model.R
        f.x, f.P = np.zeros(len(model.A)), model.P0.copy()
        filters.append(f)
    bank = IMMEstimator(filters, model.initial, model.kernel)
    bank.cbar = model.initial.copy()  # sample 0 corrects the prior; nothing is predicted before it
    for row in y:
        bank.update(None if np.isnan(row).any() else row)
        outputs = _outputs(bank.x, bank.P, bank.mu)
        bank.predict()
    return outputs


def _outputs(x: models.Array, P: models.Array, mu: models.Array) -> models.Array:
    return np.concatenate([x, P[np.tril_indices(len(x))], mu])


def after_missing(model: Switching, first: models.Array) -> dict[str, models.Array]:
    """Probabilities of four modes after one sample and a missing one, by hand.

    ``right``: nothing was measured, so Bayes' rule leaves the predicted ones. ``filterpy``: its
    ``update(None)`` sets the innovations to zero and leaves the covariances S of the sample before,
    and the modes are weighed by N(0; 0, S_j) as if that had been measured.
    """
    S = [
        gamma * model.C @ model.P0 @ model.C.T + delta * model.R
        for gamma, delta in zip(model.signal, model.noise, strict=True)
    ]
    peak = np.array([1.0 / np.sqrt(np.linalg.det(2.0 * np.pi * each)) for each in S])
    nis = np.array([first @ np.linalg.solve(each, first) for each in S])
    known = model.initial * peak * np.exp(-0.5 * nis)
    right = known / known.sum() @ model.kernel
    return {"right": right, "filterpy": right * peak / (right @ peak)}
