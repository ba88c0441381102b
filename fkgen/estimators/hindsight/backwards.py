"""Fixed-interval smoothing: x(k | all of the record), back through what a filter has found.

With the errors of predictions e[k+1] = F e[k] + w - K v and innovations nu = C e + v, sums from the
end of the record on, r = C' S^-1 nu + F' r, M = C' S^-1 C + F' M F, say what later samples tell of
e[k+1] (de Jong 1989, Biometrika 76; Durbin & Koopman 2012, sec. 4.4). No covariance of states is
inverted, and F is stable where the filter is: singular P and Q, and states that die away, do no
harm. M is the response of r to e, and what noise adds has a covariance N of its own; smoothed
covariances are sums of squares of both, as in Joseph's form, which keeps their digits where priors
are vague.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.hindsight.linearised import Linearised
from fkgen.problem import Spec

Array = NDArray[np.float64]

#: Samples whose matrices are in memory at a time.
PIECE = 2**15

#: What of a correlation matrix of innovations counts as zero: rows without noise that others imply.
NEGLIGIBLE = 1e-13


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Forwards:
    """What a filter has found at T samples, means (T, n) and covariances (T, ne, ne)."""

    predicted: tuple[Array, Array]  # x(k|k-1), P(k|k-1)
    filtered: tuple[Array, Array]
    innovation: Array  # (T, p), 0 where a row was not used
    used: NDArray[np.bool_]  # (T, p)
    u: Array  # (T, q)
    parameters: Array  # (T, number of parameters)

    def backwards(self, spec: Spec) -> tuple[Array, Array]:
        """The same given all of the record, piece by piece from the end."""
        plant = Linearised(spec)
        matrices, moved = plant.matrices(), plant.moved()
        state, covariance = (np.empty_like(each) for each in self.filtered)
        n = covariance.shape[-1]
        later = np.zeros((n, 1)), np.zeros((n, n)), np.zeros((n, n))
        for end in range(len(state), 0, -PIECE):
            piece = slice(max(end - PIECE, 0), end)
            x, filtered = (each[0][piece].T for each in (self.predicted, self.filtered))
            own = matrices((x, filtered, self.u[piece].T, self.parameters[piece].T))
            if spec.model.attitudes:
                own["A"] = own["A"] @ self._turned(piece, own, moved[1])
            (errors, spread), later = self._smoothed(piece, own, later)
            none = np.zeros((0, len(errors)))
            off = filtered, errors[..., 0].T, none, none
            state[piece], turn = moved[0](off)[..., 0], moved[1](off)
            covariance[piece] = turn @ spread @ _T(turn)
        return state, covariance

    def _turned(self, piece: slice, own: Mapping[str, Array], turned: Any) -> Array:
        """By what corrections turn the axes of errors."""
        inverse = inverse_of_rows(own["C"], self.predicted[1][piece], own["R"], self.used[piece])
        nu = self.innovation[piece][..., np.newaxis]
        errors = self.predicted[1][piece] @ _T(own["C"]) @ inverse @ nu
        none = np.zeros((0, len(errors)))
        found: Array = turned((self.predicted[0][piece].T, errors[..., 0].T, none, none))
        return found

    def _smoothed(
        self, piece: slice, own: Mapping[str, Array], later: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        """By what samples lie off their filtered states, with covariances; r, M, N at the first."""
        A, C, Q, R, S = (own[letter] for letter in "ACQRS")
        P, filtered = self.predicted[1][piece], self.filtered[1][piece]
        inverse = inverse_of_rows(C, P, R, self.used[piece])
        weighted = _T(C) @ inverse  # C' S^-1
        gain = (A @ P @ _T(C) + S) @ inverse
        F = A - gain @ C
        nu = self.innovation[piece][..., np.newaxis]
        r, first_r = _summed(F, weighted @ nu, later[0], both=False)
        M, first_M = _summed(F, weighted @ C, later[1])
        V = _T(F) @ M
        U = weighted - V @ gain
        noise = V @ S @ _T(U)
        N, first_N = _summed(F, U @ R @ _T(U) + V @ Q @ _T(V) + noise + _T(noise), later[2])
        cross = -P @ weighted @ _T(S)  # Cov(x, w | y)
        to_next = filtered @ _T(A) + cross
        gain = to_next @ M
        of_x, of_w = np.eye(A.shape[-1]) - gain @ A, -gain
        shared = of_x @ cross @ _T(of_w)
        covariance = of_x @ filtered @ _T(of_x) + shared + _T(shared)
        covariance += of_w @ (Q - S @ inverse @ _T(S)) @ _T(of_w) + to_next @ N @ _T(to_next)
        symmetric = (covariance + _T(covariance)) / 2.0
        return (to_next @ r, symmetric), (first_r, first_M, first_N)


def _T(matrices: Array) -> Array:
    return matrices.swapaxes(-1, -2)


def inverse_of_rows(C: Array, P: Array, R: Array, used: NDArray[np.bool_]) -> Array:
    """(C P C' + R)^-1 over the rows used, zero elsewhere; of a singular one the pseudoinverse."""
    S = C @ P @ _T(C) + R
    scale = np.sqrt(np.maximum(np.diagonal(S, axis1=-2, axis2=-1), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=used & (scale > 0.0))
    values, vectors = np.linalg.eigh(inverse[..., :, None] * S * inverse[..., None, :])
    kept = np.divide(1.0, values, out=np.zeros_like(values), where=values > NEGLIGIBLE)
    roots = inverse[..., :, None] * vectors
    found: Array = roots * kept[..., None, :] @ _T(roots)
    return found


def _summed(F: Array, source: Array, last: Array, *, both: bool = True) -> tuple[Array, Array]:
    """X[k] = source[k] + F[k]' X[k+1] F[k], or without the last factor: all X[k+1], and X[0].

    Samples are worked through in about sqrt(T) stretches side by side, of which each is first
    summed up from nothing; what the end of a stretch begins with is known then.
    """
    T, n = source.shape[0], F.shape[-1]
    length = max(1, round(T**0.5))
    count = -(-T // length)
    before = count * length - T  # samples that change nothing, ahead of the first
    F = np.concatenate([np.broadcast_to(np.eye(n), (before, n, n)), F])
    F = F.reshape(count, length, n, n)
    source = np.concatenate([np.zeros((before, *source.shape[1:])), source])
    source = source.reshape(count, length, *source.shape[1:])

    def step(X: Array, k: int) -> Array:
        moved = _T(F[:, k]) @ X
        return source[:, k] + (moved @ F[:, k] if both else moved)

    through, total = np.broadcast_to(np.eye(n), (count, n, n)), np.zeros_like(source[:, 0])
    for k in reversed(range(length)):
        total, through = step(total, k), _T(F[:, k]) @ through
    ends = np.empty_like(total)
    for i in reversed(range(count)):
        ends[i] = last
        moved = through[i] @ last
        last = total[i] + (moved @ through[i].T if both else moved)
    found, X = np.empty_like(source), ends
    for k in reversed(range(length)):
        found[:, k], X = X, step(X, k)
    return found.reshape(count * length, *source.shape[2:])[before:], last
