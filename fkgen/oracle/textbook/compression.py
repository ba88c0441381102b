"""The de-correlated compression filter as the paper prints it, its misprints corrected.

(Z, H, R) with Z = H e + v, e = x - xhat and regular F, P, R. Each line is a method of its own, so
that a mistake can be put into one of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fkgen.faults import SoftFaults
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import LinearSystem

#: Singular values of whitened rows below this, relative to the largest, are none.
NO_ROW = 1e-10


@dataclass(slots=True, kw_only=True)
class PrintedCompression:
    """Host filter and compression filter, stepped sample by sample: Lee & Lee, Theorem 3."""

    system: LinearSystem  # The plant over T samples, without inputs; A regular
    soft: SoftFaults  # One group
    x: Array  # x, P: (n,), (n, n): A priori at first, a posteriori after `step`
    P: Array
    Z: Array  # Z, H, R: (m,), (m, n), (m, m): The compressed measurement; m = 0 before there is one
    H: Array
    R: Array

    @classmethod
    def start(cls, system: LinearSystem, soft: SoftFaults) -> PrintedCompression:
        """Begin with the prediction for sample 0 (17)."""
        empty = {"Z": np.zeros(0), "H": np.zeros((0, system.nx)), "R": np.zeros((0, 0))}
        return cls(system=system, soft=soft, x=system.x0.copy(), P=system.P0.copy(), **empty)

    def step(self, k: int, y: Array) -> None:
        """One sample: propagate, de-correlate, update and maintain, then take in y^c."""
        if k:
            self.propagate(k - 1)
            self.decorrelate(self.system.Q[k - 1], self.P)
        before = self.x
        self.maintain(*self.update(k, y))
        self.take(k, y, before)

    def propagate(self, k: int) -> None:
        """To k + 1: (28), (31)."""
        F, Q = self.system.A[k], self.system.Q[k]
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q
        carried = self.H @ np.linalg.inv(F)
        through = self.noise_map(self.H, carried)
        self.H, self.R = carried, self.R + through @ Q @ through.T

    def noise_map(self, _before: Array, after: Array) -> Array:
        """What process noise is measured by: Hhat of k + 1."""
        return after

    def decorrelate(self, Q: Array, P: Array) -> None:
        """Make the noise of Z uncorrelated with the error of the host: (32), P a priori."""
        gain = Q @ np.linalg.inv(P)
        self.R = self.R - self.H @ gain @ Q @ self.H.T
        self.H = self.H @ (np.eye(len(P)) - gain)

    def update(self, k: int, y: Array) -> tuple[Array, Array]:
        """The host with its rows (29); returns gain and innovation."""
        rows = [row for row in self.soft.host if np.isfinite(y[row])]
        h, r = self.system.C[k][rows], self.system.R[k][np.ix_(rows, rows)]
        K = np.linalg.solve(h @ self.P @ h.T + r, h @ self.P).T
        z = y[rows] - h @ self.x
        A = np.eye(len(self.x)) - K @ h
        self.x, self.P = self.x + K @ z, A @ self.P @ A.T + K @ r @ K.T
        return K, z

    def maintain(self, K: Array, z: Array) -> None:
        """Follow the correction of the host (33)."""
        self.Z = self.Z - self.H @ K @ z

    def take(self, k: int, y: Array, prior: Array) -> None:
        """Stack y^c (35), compress when there are more rows than states (36)."""
        rows = [row for row in self.soft.compressed if np.isfinite(y[row])]
        h, r = self.system.C[k][rows], self.system.R[k][np.ix_(rows, rows)]
        z = y[rows] - h @ self.reference(self.x, prior)
        m = len(self.Z)
        R = np.zeros((m + len(rows),) * 2)
        R[:m, :m], R[m:, m:] = self.R, r
        self.Z, self.H, self.R = np.append(self.Z, z), np.vstack([self.H, h]), R
        if len(self.Z) > len(self.x):
            self.compress()

    def reference(self, posterior: Array, _prior: Array) -> Array:
        """What new rows are compared with: the host a posteriori (34)."""
        return posterior

    def compress(self) -> None:
        """Rank-revealing (36): whiten, keep the rows that tell of the state."""
        root = np.linalg.cholesky((self.R + self.R.T) / 2)
        H, Z = np.linalg.solve(root, self.H), np.linalg.solve(root, self.Z)
        left, singular, right = np.linalg.svd(H, full_matrices=False)
        kept = singular > NO_ROW * singular.max(initial=0.0)
        self.Z, self.H = left.T[kept] @ Z, singular[kept, None] * right[kept]
        self.R = np.eye(int(kept.sum()))

    def close(self) -> tuple[float, int]:
        """Take Z over into the host (25); the statistic (50) of the compressed rows and its dof."""
        self.compress()
        W = self.H @ self.P @ self.H.T + self.R
        statistic = float(self.Z @ np.linalg.solve(W, self.Z))
        K = np.linalg.solve(W, self.H @ self.P).T
        self.x, self.P = self.x + K @ self.Z, self.P - K @ self.H @ self.P
        return statistic, len(self.Z)
