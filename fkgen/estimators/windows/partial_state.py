"""How Z = T1 e + V moves with the error e of the host: Lee & Lee, Theorem 4, as one linear system.

V is carried like further states: its covariance R and its cross-covariance S with e are blocks of
one joint covariance, which is symmetric and positive by construction. The transformation (38) never
leaves the coordinates of the user, because e^1 = T1 e and F12 e^2 = (T1 F - F11 T1) e.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.gaussian.sequential import Form
from fkgen.estimators.lmmse.kalman import by_rows, from_rows
from fkgen.faults import SoftFaults
from fkgen.faults.partial_state import measured_states, similarity, typical_deviation
from fkgen.problem import Spec
from fkgen.symbolic.linalg import pack, sparse, unpack
from fkgen.symbolic.plant import Plant


@dataclass(frozen=True, slots=True)
class Compressed:
    """Z = T1 e + V, with Cov(V) = R and E[V e'] = S."""

    measurement: ca.SX  # (m,), Z
    noise: ca.SX  # R, packed
    cross: ca.SX  # (m, n), S

    def joint(self, covariance: ca.SX) -> ca.SX:
        """Covariance (n + m, n + m) of (e, V); ``covariance`` is that of e, packed."""
        m, n = self.cross.shape
        return ca.blockcat(unpack(covariance, n), self.cross.T, self.cross, unpack(self.noise, m))

    def ports(self, prefix: str = "") -> dict[str, ca.SX]:
        """What the ports (or variables) of this prefix hold of it."""
        return {
            f"{prefix}compressed_measurement": self.measurement,
            f"{prefix}compressed_noise": self.noise,
            f"{prefix}compressed_cross_covariance": by_rows(self.cross),
        }


def parts(joint: ca.SX, n: int, m: int) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Covariance of e (packed), S, and R (packed) of a packed joint covariance of (e, V)."""
    whole = unpack(joint, n + m)
    return pack(whole[:n, :n]), whole[n:, :n], pack(whole[n:, n:])


@dataclass(frozen=True, slots=True)
class PartialState:
    """The part T1 x of the state that rows of y measure as phi T1 x, (37)."""

    rows: tuple[int, ...]  # the compression group
    T1: ca.SX  # (m, n)
    first: ca.SX  # (n, m), the first columns of the inverse of T, (38)
    rest: ca.SX  # (n, n), what e^2 contributes to e: identity minus ``first`` T1
    phi: ca.SX  # (m, m)

    @property
    def size(self) -> int:
        """Number m of rows."""
        return len(self.rows)

    def transition(self, plant: Plant) -> ca.SX:
        """Of (e, V) in one sample: V+ = F11 V - F12 e^2 - G1 w, eq. (D2)."""
        moved = self.T1 @ plant.A
        return sparse(
            ca.blockcat(
                plant.A,
                ca.SX(plant.nx, self.size),
                -(moved @ self.rest),
                moved @ self.first,
            )
        )

    def advance(self, plant: Plant) -> ca.SX:
        """F11 of (39)."""
        return sparse(self.T1 @ plant.A @ self.first)

    def noise(self, plant: Plant) -> ca.SX:
        """Covariance that the process noise adds to (e, V)."""
        entering = self.T1 @ plant.Q
        return ca.blockcat(plant.Q, -entering.T, -entering, entering @ self.T1.T)

    def measures(self) -> ca.SX:
        """What Z is of (e, V): [T1 I]."""
        return ca.horzcat(self.T1, ca.SX.eye(self.size))


def partial_state(spec: Spec, plant: Plant, rows: tuple[int, ...]) -> PartialState:
    """Find T1, phi and T for the compression group of a spec, (37)-(39)."""
    n, m, which = plant.nx, len(rows), list(rows)
    stated = spec.model.C.values(spec.defaults)[which]
    deviation = typical_deviation(spec.model, spec.defaults)
    measured = list(measured_states(stated, deviation))
    T1 = similarity(stated, deviation)[:m]
    inverse = np.linalg.inv(T1[:, measured])
    first, rest = np.zeros((n, m)), np.eye(n)
    first[measured] = inverse
    rest[measured] -= inverse @ T1
    rest[:, measured] = 0.0
    C1 = plant.C[which, :]
    phi = ca.SX.eye(m)
    if not (np.array_equal(T1, stated) and C1.is_constant()):
        phi = sparse(C1[:, measured] @ lifted(inverse))
    return PartialState(rows, lifted(T1), lifted(first), lifted(rest), phi)


def lifted(values: NDArray[np.floating]) -> ca.SX:
    """A constant matrix whose zeros are structural."""
    return sparse(ca.SX(ca.DM(values)))


@dataclass(frozen=True, slots=True, kw_only=True)
class PartialFilter:
    """What the phases are written from."""

    spec: Spec
    faults: SoftFaults
    plant: Plant
    symbols: dict[str, ca.SX]
    form: Form
    partial: PartialState

    @property
    def active(self) -> ca.SX:
        """1 if there was a Z before this sample, else 0."""
        return self.symbols["predicted_collecting"]

    @property
    def rows(self) -> tuple[int, ...]:
        """The compression group."""
        return self.faults.compressed

    def compressed(self, prefix: str = "") -> Compressed:
        """Z, R and S as ports hold them."""
        symbols, m = self.symbols, len(self.rows)
        return Compressed(
            symbols[f"{prefix}compressed_measurement"],
            symbols[f"{prefix}compressed_noise"],
            from_rows(symbols[f"{prefix}compressed_cross_covariance"], m),
        )
