"""The filter with the gain (4) as the paper prints it: without Q."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from song_hu import spec

SAMPLES = 1000


@dataclass(frozen=True)
class Printed:
    """What (3) and (4) do over SAMPLES samples from P = I.

    Attributes
    ----------
    gain : float
        Largest entry of K.
    eigenvalue : float
        Smallest eigenvalue of P, which is a covariance.
    radius : float
        Largest spectral radius of M[k].
    """

    gain: float
    eigenvalue: float
    radius: float


def as_printed(name: str) -> Printed:
    """Run (3) and (4) as they stand."""
    A, C, Q, R = (getattr(spec(name).model, letter).values() for letter in "ACQR")
    P, identity = np.eye(3), np.eye(3)
    gain, eigenvalue, radius = 0.0, np.inf, 0.0
    for _ in range(SAMPLES):
        spread = A @ P @ A.T
        K = spread @ C.T @ np.linalg.inv(C @ spread @ C.T + R)
        P = (identity - K @ C) @ (spread + Q)
        M = (identity - K @ C) @ A
        gain = max(gain, float(np.abs(K).max()))
        eigenvalue = min(eigenvalue, float(np.linalg.eigvalsh(0.5 * (P + P.T))[0]))
        radius = max(radius, float(np.abs(np.linalg.eigvals(M)).max()))
    return Printed(gain, eigenvalue, radius)
