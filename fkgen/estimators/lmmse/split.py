"""The state split by mode, y^j = x 1{mode = j}: which modes, what is stored, how it starts."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.gaussian.sequential import Form
from fkgen.estimators.lmmse.lemma2 import FaultLaw
from fkgen.faults import SensorFaults
from fkgen.faults.sensor import EQUAL
from fkgen.problem import Spec
from fkgen.problem.probability import visited
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import prior_of

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """The split state: N modes with the signal indicator of each, and its sizes."""

    spec: Spec
    plant: Plant
    law: FaultLaw
    symbols: dict[str, ca.SX]
    form: Form
    kernel: Array
    signal: tuple[int, ...]
    members: tuple[tuple[int, ...], ...]

    @property
    def count(self) -> int:
        """Number N of modes."""
        return len(self.signal)

    @property
    def width(self) -> int:
        """Length of (x, 1), or of x if nothing depends on an indicator alone."""
        return self.plant.nx + (1 if self.plant.nu else 0)

    def mode_law(self, law: ca.SX) -> list[ca.SX]:
        """Probability of each mode of the split from that of the four."""
        return [sum((law[i] for i in each[1:]), start=law[each[0]]) for each in self.members]


def split_modes(faults: SensorFaults) -> tuple[Array, tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Kernel, gamma and members of the modes: two if gamma alone is Markov, else four."""
    P = np.array(faults.kernel)
    signal_next = P[:, :2].sum(axis=1)
    reached = visited(P, faults.initial)
    groups = [[i for i in pair if reached[i]] for pair in ((0, 1), (2, 3))]
    if any(len(g) > 1 and np.ptp(signal_next[g]) > EQUAL for g in groups):
        return P, (1, 1, 0, 0), ((0,), (1,), (2,), (3,))
    rates = [float(signal_next[g[0]]) if g else 0.0 for g in groups]
    gamma = np.array([[rate, 1.0 - rate] for rate in rates])
    return gamma, (1, 0), ((0, 1), (2, 3))


def split_ports(plant: Plant, count: int, width: int) -> tuple[Port, ...]:
    """Estimate and second moments of the split state."""
    n, size = plant.nx, count * width
    what = "(x, 1) 1{mode}" if plant.nu else "x 1{mode}"
    return (
        Port(
            name="augmented_state",
            shape=(size,),
            role=Role.STATE,
            meaning=f"estimate of {what} at k+1 given y[0..k], mode by mode",
        ),
        Port(
            name="augmented_covariance",
            shape=(size, size),
            role=Role.STATE,
            symmetric=True,
            meaning="its error covariance",
        ),
        Port(
            name="augmented_filtered_state",
            shape=(size,),
            role=Role.STATE,
            meaning="the same at k given y[0..k]",
        ),
        Port(
            name="augmented_filtered_covariance",
            shape=(size, size),
            role=Role.STATE,
            symmetric=True,
            meaning="its error covariance",
        ),
        *(
            Port(
                name=f"{prefix}mode_second_moment",
                shape=(count, width, width),
                role=Role.STATE,
                symmetric=True,
                meaning=f"second moment of {what} at {k}, unconditional",
            )
            for prefix, k in (("", "k"), ("predicted_", "k+1"))
        ),
        Port(
            name="state_second_moment",
            unit="xx",
            shape=(n, n),
            role=Role.OUTPUT,
            symmetric=True,
            meaning="E[x[k] x[k]'], unconditional",
        ),
    )


def split_start(split: Split) -> dict[str, tuple[float, ...]]:
    """Second moments of the prior, split by the law of the mode, and what the mean leaves."""
    x0, packed = prior_of(split.spec)
    P0, n, w = split.spec.model.P0.values(), split.plant.nx, split.width
    mean = np.append(x0, 1.0)[:w]
    second = np.outer(mean, mean)
    second[:n, :n] += P0
    law = np.array([sum(split.law.faults.initial[i] for i in each) for each in split.members])
    center = np.kron(law, mean)
    covariance: Array = np.kron(np.diag(law), second) - np.outer(center, center)
    state = tuple(center.tolist())
    lower = tuple(float(covariance[i, j]) for i, j in triangle(len(covariance)))
    moments = tuple(float(p * second[i, j]) for p in law for i, j in triangle(w))
    return {
        **{f"{of}_state": x0 for of in ("predicted", "filtered")},
        **{f"{of}_covariance": packed for of in ("predicted", "filtered")},
        **{f"augmented_{of}state": state for of in ("", "filtered_")},
        **{f"augmented_{of}covariance": lower for of in ("", "filtered_")},
        "predicted_mode_second_moment": moments,
        **split.law.law_start(),
    }
