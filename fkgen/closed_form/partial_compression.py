"""The correlated partial error-state compression filter, from the noises its errors are made of.

Every error is written as coefficients on the primitive noises (start, process, measurement), so
that each covariance is a sum of squares of what really happens to that error. None of the paper's
recursions for P, R and S is used: host and compression filter take their gains from the
covariances that come out. Steps are in the order in which Theorem 3 is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from fkgen.closed_form.gaussian import Array, square_root
from fkgen.closed_form.system import LinearSystem

#: A variance below this share of what it was before the rows above it is rounding.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class PartialCompression:
    """What a host and its compression filter agree on.

    Attributes
    ----------
    host : tuple of int
        Rows of y for the host filter; the others are for the compression filter.
    T : (n, n) ndarray
        Similarity transformation (38): the compression rows of C are phi [I 0] T.
    window : int
        Samples between host updates.
    false_alarm : float or None
        Probability of a false rejection; None rejects nothing.
    maintenance : str
        After a host update with gain K, ``"paper"`` takes h K z off Z, (44); ``"optimal"`` takes
        off all of Z that is correlated with the innovation z.
    """

    host: tuple[int, ...]
    T: Array
    window: int
    false_alarm: float | None
    maintenance: Literal["optimal", "paper"]


@dataclass(frozen=True, eq=False, kw_only=True)
class PartialCompressionResult:
    """One record; names and times as the ports of the filter, in the coordinates of the system.

    Attributes
    ----------
    filtered_state, filtered_covariance : (T, n), (T, n, n) ndarray
        Of the host, after its update by the compression filter where there is one.
    predicted_state, predicted_covariance : (T, n), (T, n, n) ndarray
    test_statistic, test_dof : (T,) ndarray
        Zeros where no test is made.
    fault_declared : (T,) ndarray
        1 where the compression filter was rejected.
    compressed_measurement, compressed_noise : (T, m), (T, m, m) ndarray
        Z and the covariance R of V = Z - e^1 before the host makes use of it; zeros without one.
    compressed_cross_covariance : (T, m, n) ndarray
        S = E[V e'].
    """

    filtered_state: Array
    filtered_covariance: Array
    predicted_state: Array
    predicted_covariance: Array
    test_statistic: Array
    test_dof: Array
    fault_declared: Array
    compressed_measurement: Array
    compressed_noise: Array
    compressed_cross_covariance: Array


def partial_compression(
    system: LinearSystem, design: PartialCompression, y: Array, u: Array | None
) -> PartialCompressionResult:
    """Filter a record with host and compression filter.

    Parameters
    ----------
    system : LinearSystem
        T samples of the plant; nothing fails in it.
    design : PartialCompression
    y : (T, p) ndarray
        NaN where a row is missing.
    u : (T, q) ndarray or None

    References
    ----------
    Lee & Lee, compression filters, Theorem 4 and Appendix D.
    """
    run = _Run(_transformed(system, design.T), design)
    inputs = system.inputs(u)
    rows = [run.step(k, y[k], inputs[k]) for k in range(len(y))]
    found = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    back = np.linalg.inv(design.T)
    for when in ("filtered", "predicted"):
        found[f"{when}_state"] = found[f"{when}_state"] @ back.T
        found[f"{when}_covariance"] = back @ found[f"{when}_covariance"] @ back.T
    found["compressed_cross_covariance"] = found["compressed_cross_covariance"] @ back.T
    return PartialCompressionResult(**found)


def _transformed(system: LinearSystem, T: Array) -> LinearSystem:
    """The equivalent system for the state T x, (39)."""
    back = np.linalg.inv(T)
    return replace(
        system,
        A=T @ system.A @ back,
        B=T @ system.B,
        C=system.C @ back,
        Q=T @ system.Q @ T.T,
        x0=T @ system.x0,
        P0=T @ system.P0 @ T.T,
    )


def _inverse(covariance: Array) -> tuple[Array, int]:
    """Pseudo-inverse of a covariance, blind to units, and its rank."""
    deviation = np.sqrt(np.diag(covariance))
    unit = np.where(deviation > 0.0, deviation, 1.0)
    size = np.outer(unit, unit)
    rank = np.linalg.matrix_rank(covariance / size, RANK_TOLERANCE, hermitian=True)
    return np.linalg.pinv(covariance / size, RANK_TOLERANCE, hermitian=True) / size, int(rank)


def _gain(coefficients: Array, known: Array) -> Array:
    """Best linear gain on what the coefficients ``known`` stand for."""
    gain: Array = coefficients @ known.T @ _inverse(known @ known.T)[0]
    return gain


def _threshold(false_alarm: float, dof: int) -> float:
    from scipy.special import chdtri  # noqa: PLC0415 - slow to import

    return float(chdtri(dof, false_alarm))


@dataclass(slots=True)
class _Run:
    """Host estimate ``x`` with its error ``e``; ``Z`` with its coefficients, if there is one."""

    system: LinearSystem
    design: PartialCompression
    x: Array = field(init=False)
    e: Array = field(init=False)
    Z: Array = field(init=False)
    coefficients: Array = field(init=False)
    alive: bool = False

    def __post_init__(self) -> None:
        system = self.system
        n, p = system.nx, system.ny
        self.x = system.x0
        self.e = np.zeros((n, n + system.length * (n + p)))
        self.e[:, :n] = square_root(system.P0)
        m = p - len(self.design.host)
        self.Z, self.coefficients = np.zeros(m), np.zeros((m, self.e.shape[1]))

    @property
    def V(self) -> Array:
        """Coefficients of Z - e^1."""
        return self.coefficients - self.e[: self.Z.size]

    def step(self, k: int, y: Array, u: Array) -> dict[str, Array | float]:
        """Sample k, then the propagation to k + 1."""
        design, system = self.design, self.system
        offset = y - system.D[k] @ u
        given = [i for i in range(system.ny) if not np.isnan(y[i])]
        host = [i for i in given if i in design.host]
        others = [i for i in range(system.ny) if i not in design.host]
        if host:
            self._update_host(*self._innovation(k, offset, host))
        if any(i in given for i in others):
            self._compress(k, offset, others)
        results: dict[str, Array | float] = {
            "compressed_measurement": self.Z,
            "compressed_noise": self.V @ self.V.T if self.alive else np.zeros((self.Z.size,) * 2),
            "compressed_cross_covariance": self.V @ self.e.T * self.alive,
            **self._end_of_window(k),
            "filtered_state": self.x,
            "filtered_covariance": self.e @ self.e.T,
        }
        self._propagate(k, u)
        return results | {
            "predicted_state": self.x,
            "predicted_covariance": self.e @ self.e.T,
        }

    def _innovation(self, k: int, offset: Array, rows: list[int]) -> tuple[Array, Array]:
        """Coefficients and values of y - C x for these rows."""
        C, n, p = self.system.C[k][rows], self.system.nx, self.system.ny
        coefficients = C @ self.e
        at = n + k * (n + p) + n
        coefficients[:, at : at + p] += square_root(self.system.R[k])[rows]
        return coefficients, offset[rows] - C @ self.x

    def _update_host(self, known: Array, z: Array) -> None:
        gain = _gain(self.e, known)
        if self.alive:
            first = gain[: self.Z.size]
            if self.design.maintenance == "optimal":
                first = _gain(self.coefficients, known)
            self.coefficients = self.coefficients - first @ known
            self.Z = self.Z - first @ z
        self.e = self.e - gain @ known
        self.x = self.x + gain @ z

    def _compress(self, k: int, offset: Array, rows: list[int]) -> None:
        """(42), (46); the rows of y that are there weigh against V as if it were all unknown.

        To begin with some of the rows, Z starts as the measurement that tells nothing, Z = 0.
        """
        m = self.Z.size
        phi = self.system.C[k][rows][:, :m]
        given = [i for i, row in enumerate(rows) if not np.isnan(offset[row])]
        coefficients, z = self._innovation(k, offset, [rows[i] for i in given])
        if not self.alive and len(given) == m:
            gain = np.linalg.inv(phi)
        else:
            R = self.V @ self.V.T
            seen = phi[given]
            r = self.system.R[k][np.ix_([rows[i] for i in given], [rows[i] for i in given])]
            gain = np.linalg.solve(seen @ R @ seen.T + r, seen @ R).T
        rest = np.eye(m) - gain @ phi[given]
        self.Z = rest @ self.Z + gain @ z
        self.coefficients = rest @ self.coefficients + gain @ coefficients
        self.alive = True

    def _end_of_window(self, k: int) -> dict[str, Array | float]:
        """(50), (51), (47); whatever comes of it, the next compression filter starts anew."""
        names = ("test_statistic", "test_dof", "fault_declared")
        if k == 0 or k % self.design.window or not self.alive:
            return dict.fromkeys(names, 0.0)
        known, Z = self.coefficients, self.Z
        self.alive, self.Z, self.coefficients = False, np.zeros_like(Z), np.zeros_like(known)
        inverse, dof = _inverse(known @ known.T)
        statistic, rejected = float(Z @ inverse @ Z), False
        if self.design.false_alarm is not None and dof:
            rejected = statistic >= _threshold(self.design.false_alarm, dof)
        if not rejected:
            gain = _gain(self.e, known)
            self.e, self.x = self.e - gain @ known, self.x + gain @ Z
        return dict(zip(names, (statistic, float(dof), float(rejected)), strict=True))

    def _propagate(self, k: int, u: Array) -> None:
        """(28), (43); the noise of the process enters the error of the host alone."""
        A, n, p = self.system.A[k], self.system.nx, self.system.ny
        m = self.Z.size
        self.x = A @ self.x + self.system.B[k] @ u
        self.e = A @ self.e
        at = n + k * (n + p)
        self.e[:, at : at + n] += square_root(self.system.Q[k])
        self.Z, self.coefficients = A[:m, :m] @ self.Z, A[:m, :m] @ self.coefficients
