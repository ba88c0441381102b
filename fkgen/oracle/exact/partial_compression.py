"""The correlated partial error-state compression filter, from the noises its errors are made of.

Every error is coefficients on start, process and measurement noise, every covariance their squares;
no recursion of the paper for P, R and S is used. Steps are in the order that Theorem 3 is exact in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fkgen.oracle.exact.batch import BatchResult
from fkgen.oracle.exact.gaussian import Array, log_density, square_root, whiten
from fkgen.oracle.plants.actuator import LinearSystem

#: A row of Z whose variance is a smaller share of those of e^1 and V says nothing: Z = e^1 + V.
NEGLIGIBLE = 1e-11


@dataclass(frozen=True, eq=False, kw_only=True)
class PartialCompression:
    """What a host and its compression filter agree on."""

    #: Rows of y for the host filter; the others are for the compression filter
    host: tuple[int, ...]
    T: Array  # (n, n): Similarity transformation (38): the compression rows of C are phi [I 0] T
    window: int  # Samples between host updates
    first: int  # Sample of the first host update, which is no update if it is 0
    false_alarm: float | None  # Probability of a false rejection; None rejects nothing
    #: After a host update with gain K, "paper" takes h K z off Z, (44); "optimal" takes off all
    #: of Z that is correlated with the innovation z
    maintenance: Literal["optimal", "paper"]
    #: Rejections in a row from which on the host is inflated by what it rejects
    reacquire: int | None = None

    def is_end(self, k: int) -> bool:
        """Whether sample k is the last of a window."""
        return k > 0 and k >= self.first and (k - self.first) % self.window == 0


@dataclass(frozen=True, eq=False, kw_only=True)
class PartialCompressionResult(BatchResult):
    """Estimates of the host after its update by Z; `nis` and likelihood are of its own rows."""

    test_statistic: Array  # (T,), as the next two: NaN, 0 and 0 where no test is made
    test_dof: Array
    fault_declared: Array
    #: (T, m), (T, m, m): Z and the covariance R of V = Z - e^1 before the host makes use of it;
    #: zeros without one
    compressed_measurement: Array
    compressed_noise: Array
    compressed_cross_covariance: Array  # (T, m, n): S = E[V e']


def partial_compression(
    system: LinearSystem, design: PartialCompression, y: Array, u: Array | None
) -> PartialCompressionResult:
    """Filter a record; y (T, p), u (T, q): Lee & Lee, Theorem 4 and Appendix D."""
    T, back, inputs = design.T, np.linalg.inv(design.T), system.inputs(u)
    transformed = replace(
        system,  # for the state T x, (39)
        A=T @ system.A @ back,
        B=T @ system.B,
        c=system.c @ T.T,
        C=system.C @ back,
        Q=T @ system.Q @ T.T,
        x0=T @ system.x0,
        P0=T @ system.P0 @ T.T,
    )
    run = _Run(transformed, design)
    rows = [
        run.step(k, y[k] - system.D[k] @ inputs[k] - system.d[k], inputs[k]) for k in range(len(y))
    ]
    result = PartialCompressionResult.of(rows)
    ports = {"compressed_cross_covariance": result.compressed_cross_covariance @ back.T}
    for when in ("filtered", "predicted"):
        ports[f"{when}_state"] = getattr(result, f"{when}_state") @ back.T
        ports[f"{when}_covariance"] = back @ getattr(result, f"{when}_covariance") @ back.T
    return replace(result, **ports)


class _Run:
    """Host estimate ``x`` with its error ``e``; ``Z`` with its coefficients, if there is one.

    Errors are rows of coefficients on unit noises: n of the start, then for each sample n of the
    process, p of the measurement and one that stands for an inflation of the host.
    """

    def __init__(self, system: LinearSystem, design: PartialCompression) -> None:
        n, p = system.nx, system.ny
        self.system, self.design = system, design
        self.others = [i for i in range(p) if i not in design.host]
        self.x, self.e = system.x0, np.zeros((n, n + system.length * (n + p + 1)))
        self.e[:, :n] = square_root(system.P0)
        self.rejections = 0
        self._start_anew()

    def _start_anew(self) -> None:
        m = len(self.others)
        self.alive, self.Z, self.coefficients = False, np.zeros(m), np.zeros_like(self.e[:m])

    @property
    def V(self) -> Array:
        """Coefficients of Z - e^1."""
        return self.coefficients - self.e[: self.Z.size]

    def slot(self, k: int) -> int:
        """Where the noises of sample k begin."""
        n, p = self.system.nx, self.system.ny
        return n + k * (n + p + 1)

    def step(self, k: int, y: Array, u: Array) -> dict[str, Array | float]:
        """Sample k, then the propagation to k + 1."""
        given = np.flatnonzero(~np.isnan(y)).tolist()
        everything, innovation = self._innovation(k, y, range(len(y)))
        results: dict[str, Array | float] = {
            "innovation": innovation,
            "innovation_covariance": everything @ everything.T,
            **self._update_host(k, y, [i for i in given if i in self.design.host]),
        }
        self._compress(k, y, [i for i in given if i in self.others])
        results |= {
            "compressed_measurement": self.Z,
            "compressed_noise": self.V @ self.V.T * self.alive,
            "compressed_cross_covariance": self.V @ self.e.T * self.alive,
            **self._end_of_window(k),
            "filtered_state": self.x,
            "filtered_covariance": self.e @ self.e.T,
        }
        self._propagate(k, u)
        return results | {"predicted_state": self.x, "predicted_covariance": self.e @ self.e.T}

    def _innovation(self, k: int, y: Array, rows: Sequence[int]) -> tuple[Array, Array]:
        """Coefficients and values of y - C x for these rows."""
        which, at = list(rows), self.slot(k) + self.system.nx
        C = self.system.C[k][which]
        coefficients = C @ self.e
        coefficients[:, at : at + len(y)] += square_root(self.system.R[k])[which]
        return coefficients, y[which] - C @ self.x

    def _update_host(self, k: int, y: Array, rows: list[int]) -> dict[str, Array | float]:
        if not rows:
            return {"nis": 0.0, "log_likelihood": 0.0}
        known, z = self._innovation(k, y, rows)
        seen = whiten(known)
        gain = self.e @ seen.directions @ seen.weights
        if self.alive and self.design.maintenance == "optimal":
            self.Z = self.Z - self.coefficients @ seen.directions @ (seen.weights @ z)
            self.coefficients = seen.unexplained(self.coefficients)
        elif self.alive:
            first = gain[: self.Z.size]
            self.Z, self.coefficients = self.Z - first @ z, self.coefficients - first @ known
        self.e, self.x = seen.unexplained(self.e), self.x + gain @ z
        nis = float(np.sum((seen.weights @ z) ** 2))
        return {"nis": nis, "log_likelihood": log_density(z, seen)}

    def _compress(self, k: int, y: Array, rows: list[int]) -> None:
        """(42), (46); rows weigh against V as if all of it were unknown; a few start from Z = 0."""
        if not rows:
            return
        m = self.Z.size
        phi, r = self.system.C[k][rows][:, :m], self.system.R[k][np.ix_(rows, rows)]
        if not self.alive and len(rows) == m:
            gain = np.linalg.inv(phi)
        else:
            R = self.V @ self.V.T
            gain = np.linalg.solve(phi @ R @ phi.T + r, phi @ R).T
        coefficients, z = self._innovation(k, y, rows)
        rest = np.eye(m) - gain @ phi
        self.Z = rest @ self.Z + gain @ z
        self.coefficients = rest @ self.coefficients + gain @ coefficients
        self.alive = True

    def _end_of_window(self, k: int) -> dict[str, Array | float]:
        """(50), (51), (47); whatever comes of it, the next compression filter starts anew."""
        from scipy.special import chdtri  # noqa: PLC0415 - slow to import

        verdict: dict[str, Array | float]
        verdict = {"test_statistic": np.nan, "test_dof": 0.0, "fault_declared": 0.0}
        if not self.design.is_end(k) or not self.alive:
            return verdict
        size = np.linalg.norm(np.hstack([self.V, self.e[: self.Z.size]]), axis=1)
        seen = whiten(self.coefficients, negligible=np.sqrt(NEGLIGIBLE) * size)
        correction = self.e @ seen.directions @ (seen.weights @ self.Z)
        statistic, rejected = float(np.sum((seen.weights @ self.Z) ** 2)), False
        if self.design.false_alarm is not None and seen.rank:
            rejected = bool(statistic > chdtri(seen.rank, self.design.false_alarm))
        if not rejected:
            self.e, self.x = seen.unexplained(self.e), self.x + correction
        self.rejections = self.rejections + 1 if rejected else 0
        if self.design.reacquire is not None and self.rejections >= self.design.reacquire:
            self.e[:, self.slot(k + 1) - 1] += correction
        self._start_anew()
        if seen.rank:
            values = (statistic, float(seen.rank), float(rejected))
            verdict = dict(zip(verdict, values, strict=True))
        return verdict

    def _propagate(self, k: int, u: Array) -> None:
        """(28), (43); the noise of the process enters the error of the host alone."""
        A, n, m, at = self.system.A[k], self.system.nx, self.Z.size, self.slot(k)
        self.x = A @ self.x + self.system.B[k] @ u + self.system.c[k]
        self.e = A @ self.e
        self.e[:, at : at + n] += square_root(self.system.Q[k])
        self.Z, self.coefficients = A[:m, :m] @ self.Z, A[:m, :m] @ self.coefficients
