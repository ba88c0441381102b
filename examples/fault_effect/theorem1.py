"""Theorem 1 of the paper is false: every rho(M[k]) < 1, and a pulse grows for ever."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import fkgen
from fkgen.profiles import pulse

SAMPLES, START = 41, 3

#: Optimal filter: two states that nothing measures take turns in feeding each other.
PLANT = {
    "name": "theorem_1",
    "model": {
        "A": [[0.5, "a", 0.3], ["2 - a", 0.5, 0.0], [0.0, 0.0, 0.9]],
        "C": [[0.0, 0.0, 1.0]],
        "Q": 0.1 * np.eye(3),
        "R": [[0.5]],
        "x0": [0.0, 0.0, 0.0],
        "P0": np.eye(3),
    },
    "parameters": {"a": 2.0},
    "filter": {"family": "kf"},
}


@dataclass(frozen=True)
class Growth:
    """What the pulse does.

    Attributes
    ----------
    radius : float
        Largest spectral radius of M[k].
    onset, end : float
        Largest deviation at the pulse and at the last sample.
    """

    radius: float
    onset: float
    end: float


def growth() -> Growth:
    """Run the filter; K[k] = P(k|k) C' R^-1."""
    spec, a = fkgen.Spec.from_dict(PLANT), np.where(np.arange(SAMPLES) % 2, 0.0, 2.0)
    effect = fkgen.fault_effect(spec, pulse(SAMPLES, START, 1.0), params={"a": a})
    run = fkgen.build(spec).run(np.zeros(SAMPLES), params={"a": a})
    C, R = (getattr(spec.model, letter).values() for letter in "CR")
    radii = []
    for k in range(SAMPLES - 1):
        K = run.filtered_covariance[k + 1] @ C.T @ np.linalg.inv(R)
        M = (np.eye(3) - K @ C) @ spec.model.A.values({"a": a[k]})
        radii.append(np.abs(np.linalg.eigvals(M)).max())
    size = np.abs(effect.state_deviation).max(axis=1)
    return Growth(float(max(radii)), float(size[START]), float(size[-1]))
