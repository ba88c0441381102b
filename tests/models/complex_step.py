"""The log-likelihood of a Kalman filter in NumPy, and derivatives by complex steps of 1e-30."""

from __future__ import annotations

import numpy as np

STEP = 1e-30


def terms(matrices, y):
    """(T,): log p(y[k] | y[..k-1]) of matrices by name; complex where a matrix is."""
    A, C, Q, R, x, P = (np.asarray(matrices[name]) for name in ("A", "C", "Q", "R", "x0", "P0"))
    result = []
    for row in y:
        there = np.isfinite(row)
        if there.any():
            H, V = C[there], R[np.ix_(there, there)]
            S = H @ P @ H.T + V
            e = row[there] - H @ x
            solved = np.linalg.solve(S, np.column_stack([e, H @ P]))
            # log of a complex determinant near the real axis: its imaginary part is the derivative
            determinant = np.log(np.linalg.det(S))
            result.append(-0.5 * (e @ solved[:, 0] + determinant + there.sum() * np.log(2 * np.pi)))
            K = solved[:, 1:].T
            x, P = x + K @ e, P - K @ S @ K.T
        else:
            result.append(0.0)
        x, P = A @ x, A @ P @ A.T + Q
    return np.array(result)


def scores(model, theta, y):
    """(T, k): derivatives of the terms by theta, exact to rounding; model(theta) has matrices."""
    steps = np.eye(len(theta)) * 1j * STEP
    return np.stack([terms(model(theta + step), y).imag / STEP for step in steps], axis=1)


def information(model, theta, y, relative=1e-5):
    """(k, k): minus the second derivatives: differences of derivatives that are exact."""
    rows = []
    for j, value in enumerate(theta):
        step = relative * max(abs(value), 1e-3)
        ends = []
        for sign in (1.0, -1.0):
            at = np.array(theta, float)
            at[j] += sign * step
            ends.append(scores(model, at, y).sum(axis=0))
        rows.append((ends[1] - ends[0]) / (2.0 * step))
    return 0.5 * (np.array(rows) + np.array(rows).T)
