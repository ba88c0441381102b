"""The four models of Song & Hu, eqs. (27)-(30), and the faults that are put into them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import fkgen
from fkgen.profiles import pulse, step

HERE = Path(__file__).parent
Floats = NDArray[np.float64]

CHAIN = ((0.99, 0.1, 0.0), (0.0, 0.99, -0.1), (0.0, 0.0, 0.99))
BOTH, SECOND = ((0.9, 0.0, -0.9), (0.0, 0.05, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.05, 0.0))
INTO_3, INTO_2 = ((0.0,), (0.0,), (1.0,)), ((0.0,), (1.0,), (0.0,))
APART = tuple(tuple(0.99 * float(i == j) for j in range(3)) for i in range(3))

#: A, B, C and what the paper says of them.
MODELS = {
    "A": (CHAIN, INTO_3, BOTH, "controllable and observable"),
    "B": (CHAIN, INTO_3, SECOND, "controllable, not observable"),
    "C": (CHAIN, INTO_2, BOTH, "not controllable, observable"),
    "D": (APART, INTO_2, BOTH, "not controllable, not observable"),
}
START, LAST = 50, 299
"""First and last faulty sample of the figures, as the paper counts; a pulse is at the first."""
HORIZON = 1000
RESTED = 1500
"""Samples after which a filter has come to rest: 0.99 to the power of twice that is 1e-13."""
AFTER = 2500
"""Samples that are looked at from there."""


@dataclass(frozen=True)
class Peak:
    """Largest deviation of one state, and when it is over.

    Attributes
    ----------
    size : float
    at, over : int
        Samples after the onset: of the peak, and the first from which on |dX| is below 1 % of it.
    """

    size: float
    at: int
    over: int


def spec(name: str) -> fkgen.Spec:
    """Model A from its file, with A, B and C of the model of this name; cov X[0] = I."""
    table = fkgen.load(HERE / "model_a.toml").to_dict()
    A, B, C, _ = MODELS[name]
    model = table["model"]
    P0 = np.array(A) @ np.array(A).T + np.array(model["Q"])
    table["model"] = {**model, "A": A, "B": B, "C": C, "P0": P0}
    return fkgen.Spec.from_dict({**table, "name": f"fault_effect_{name.lower()}"})


def sensor_fault(name: str, size: Floats, *, lasting: bool) -> Floats:
    """Deviation of x(k|k) under a fault in y of a filter that is at rest, (AFTER, 3)."""
    fault = (step if lasting else pulse)(RESTED + AFTER, RESTED, size)
    return fkgen.fault_effect(spec(name), fault).state_deviation[RESTED:]


def input_anomaly(name: str, *, lasting: bool, mode: str = "both") -> Floats:
    """Deviation of x(k|k) under a unit anomaly of u, (AFTER, 3).

    U[k+1] of the paper acts on X[k+1] and is u[k] here: index 0 of the result is the onset in x.
    """
    fault = (step if lasting else pulse)(RESTED + AFTER, RESTED - 1, [1.0])
    effect = fkgen.fault_effect(spec(name), input=fault, mode=mode)
    return effect.state_deviation[RESTED:]


def peak(deviation: Floats) -> Peak:
    """Say how large a deviation (T,) gets, and when it is over."""
    size = np.abs(deviation)
    at = int(np.argmax(size))
    last = np.flatnonzero(size > 0.01 * size[at])
    return Peak(float(size[at]), at, int(last[-1]) + 1 if last.size else 0)


def settling(deviation: Floats, end: float) -> int:
    """First sample from which on a deviation (T,) is within 1 % of its end."""
    last = np.flatnonzero(np.abs(deviation - end) > 0.01 * abs(end))
    return int(last[-1]) + 1 if last.size else 0
