"""Theorem 4 of Lee & Lee as it is printed, misprints mended: matrices, no shortcuts."""

from __future__ import annotations

import numpy as np


class Theorem4:
    """Host and compression filter in the coordinates of (39), h = [I 0]; G q G' comes as Q.

    Acceptance is the caller's: `update` is called, or `discard`. ``condition`` is the worst
    condition number of what was inverted: each inverse costs so many roundings.
    """

    condition = 1.0

    def __init__(self, x, P, m, *, maintenance="paper"):
        self.x, self.P, self.m, self.maintenance = x, P, m, maintenance
        self.discard()

    def discard(self):
        n, m = len(self.x), self.m
        self.alive, self.Z, self.R, self.S = False, np.zeros(m), np.zeros((m, m)), np.zeros((m, n))

    def propagate(self, F, Q):
        m, P = self.m, self.P
        F11, F12 = F[:m, :m], F[:m, m:]
        if self.alive:
            R, S2 = self.R, self.S[:, m:]
            self.R = (
                F11 @ R @ F11.T
                + F12 @ P[m:, m:] @ F12.T
                + Q[:m, :m]
                - F11 @ S2 @ F12.T
                - F12 @ S2.T @ F11.T
            )
            self.S = (F11 @ self.S - F12 @ P[m:]) @ F.T - Q[:m]
            self.Z = F11 @ self.Z
        self.x, self.P = F @ self.x, F @ P @ F.T + Q

    def host(self, h, r, y):
        z, s = y - h @ self.x, h @ self.P @ h.T + r
        K = self.P @ h.T @ self._inverse(s)
        if self.alive:
            change = K[: self.m]
            if self.maintenance == "optimal":
                L = self.S @ h.T @ self._inverse(s)
                self.R = self.R - L @ s @ L.T
                change = change + L
            self.Z = self.Z - change @ z
            self.S = self.S @ (np.eye(len(self.x)) - K @ h).T
        self.x, self.P = self.x + K @ z, self.P - K @ h @ self.P

    def compress(self, phi, r, y):
        back = self._inverse(phi)
        z, r = back @ y - self.x[: self.m], back @ r @ back.T
        if not self.alive:
            self.alive, self.Z, self.R, self.S = True, z, r, np.zeros_like(self.S)
            return
        R = self._inverse(self._inverse(self.R) + self._inverse(r))
        self.Z = R @ (self._inverse(self.R) @ self.Z + self._inverse(r) @ z)
        self.S = R @ self._inverse(self.R) @ self.S
        self.R = R

    def statistic(self):
        return float(self.Z @ np.linalg.solve(self._W(), self.Z))

    def update(self):
        h = np.eye(self.m, len(self.x))
        K = (self.P @ h.T + self.S.T) @ self._inverse(self._W())
        self.x, self.P = self.x + K @ self.Z, self.P - K @ (self.S + h @ self.P)
        self.discard()

    def _inverse(self, matrix):
        self.condition = max(self.condition, np.linalg.cond(matrix))
        return np.linalg.inv(matrix)

    def _W(self):
        m = self.m
        return self.P[:m, :m] + self.S[:, :m] + self.S[:, :m].T + self.R
