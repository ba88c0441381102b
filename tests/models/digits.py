"""The Kalman filter in 60 digits, row by row present: no code of fkgen, no rounding to speak of."""

from __future__ import annotations

from decimal import Decimal, getcontext

import numpy as np

DIGITS = 60


def exact(values):
    """An array of decimals that hold the numbers given, every bit of them."""
    getcontext().prec = DIGITS
    return np.vectorize(Decimal, otypes=[object])(np.asarray(values, float))


def solved(S, B):
    """S^-1 B for a positive definite S, by elimination."""
    p, left = len(S), np.hstack([S, B])
    for j in range(p):
        left[j] = left[j] / left[j, j]
        for i in range(p):
            if i != j:
                left[i] = left[i] - left[i, j] * left[j]
    return left[:, p:]


def corrected(x, P, C, R, y):
    """Mean, covariance, and S of all rows, after the rows of y that are present."""
    whole = C @ P @ C.T + R
    rows = np.flatnonzero(~np.isnan(y))
    if len(rows):
        c, S = C[rows], whole[np.ix_(rows, rows)]
        K = solved(S, c @ P).T
        x, P = x + K @ (exact(y[rows]) - c @ x), P - K @ (c @ P)
    return x, P, whole


def kalman(model, y, u=None):
    """x(k|k), P(k|k) and S of a record, of a model of constant matrices, as doubles."""
    A, C, Q, R, P, x = (exact(model[name]) for name in ("A", "C", "Q", "R", "P0", "x0"))
    B = exact(model["B"]) if u is not None else None
    states, covariances, variances = [], [], []
    for k, now in enumerate(np.asarray(y, float)):
        x, P, S = corrected(x, P, C, R, now)
        for kept, value in ((states, x), (covariances, P), (variances, S)):
            kept.append(value.astype(float))
        x, P = moved(x, P, A, Q)
        if B is not None:
            x = x + B @ exact(u[k])
    return np.array(states), np.array(covariances), np.array(variances)


def moved(x, P, A, Q):
    """Mean and covariance of the next sample."""
    P = A @ P @ A.T + Q
    return A @ x, (P + P.T) / 2


def windows(model, y, host, window):
    """The same of a host of some rows that takes over all of them where k mod window = 0, k > 0."""
    A, C, Q, R, P, x = (exact(model[name]) for name in ("A", "C", "Q", "R", "P0", "x0"))
    y, own, found = np.asarray(y, float), np.full_like(y, np.nan), []
    own[:, host] = y[:, host]
    one = every = x, P
    for k in range(len(y)):
        *one, S = corrected(*one, C, R, own[k])
        *every, _ = corrected(*every, C, R, y[k])
        one = every if k and k % window == 0 else one
        found.append([each.astype(float) for each in (*one, S)])
        one, every = moved(*one, A, Q), moved(*every, A, Q)
    return tuple(map(np.array, zip(*found, strict=True)))


def lower_root(P):
    """Cholesky's factor of a positive definite matrix."""
    L = P * 0
    for j in range(len(P)):
        left = P[j:, j] - L[j:, :j] @ L[j, :j]
        L[j:, j] = left / left[0].sqrt()
    return L


def unscented(model, y, f, h, kappa=0):
    """The same of points of equal weights, and a centre, through an f and an h of decimals."""
    Q, R, P, x = (exact(model[name]) for name in ("Q", "R", "P0", "x0"))
    found = []
    for now in np.asarray(y, float):
        rows = np.flatnonzero(~np.isnan(now))
        errors, weights = _points(P, kappa)
        seen = np.array([h(x + each) for each in errors])
        mean = weights @ seen
        apart = seen - mean
        S, shared = (each.T @ (weights[:, None] * apart) for each in (apart, errors))
        S = S + R
        if len(rows):
            K = solved(S[np.ix_(rows, rows)], shared[:, rows].T).T
            x, P = x + K @ (exact(now[rows]) - mean[rows]), P - K @ shared[:, rows].T
            P = (P + P.T) / 2
        found.append([each.astype(float) for each in (x, P, S)])
        errors, weights = _points(P, kappa)
        moved = np.array([f(x + each) for each in errors])
        x = weights @ moved
        P = (moved - x).T @ (weights[:, None] * (moved - x)) + Q
    return tuple(map(np.array, zip(*found, strict=True)))


def _points(P, kappa):
    """Errors of an estimate, and their weights."""
    n, kappa = len(P), Decimal(kappa)
    columns = ((n + kappa).sqrt() * lower_root(P)).T
    weights = [1 / (2 * (n + kappa))] * (2 * n)
    centre = [kappa / (n + kappa)] if kappa else []
    return np.vstack([*([P[:1] * 0] if kappa else []), columns, -columns]), np.array(
        centre + weights
    )


def shortfall(run, expected, C):
    """How far a float run is from 60 digits, by what is promised of it, largest over all samples.

    Relative errors of standard deviations, of C P C' and of S; states in standard deviations,
    beyond two units in the last place of the state.
    """
    states, P, S = expected
    found = run.filtered_covariance.astype(float)
    sd, own = (np.sqrt(np.diagonal(each, axis1=1, axis2=2)) for each in (P, found))
    seen, measured = (np.einsum("ij,kjl,il->ki", C, each, C) for each in (P, found))
    grain = np.einsum("ij,kj->ki", np.abs(C), sd) ** 2 * 2.0**-22  # what rounding P does to it
    variance = np.diagonal(run.innovation_covariance.astype(float), axis1=1, axis2=2)
    whole = np.diagonal(S, axis1=1, axis2=2)
    ulp = np.spacing(np.abs(states).astype(np.float32)).astype(float)
    return {
        "refused": int(run.refused.sum()),
        "least": float(np.diagonal(found, axis1=1, axis2=2).min()),
        "deviation": float((np.abs(own - sd) / sd).max()),
        "seen": float(((np.abs(measured - seen) - grain).clip(0.0) / seen).max()),
        "variance": float((np.abs(variance - whole) / whole).max()),
        "state": float(((np.abs(run.filtered_state - states) - 2.0 * ulp).clip(0.0) / sd).max()),
    }
