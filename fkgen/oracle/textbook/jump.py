"""LMMSE filter of a jumping plant in whole matrices, as the literature writes it.

The state of mode i is (x, 1) 1{mode = i}: Costa 1994, with the constant as one more state. The
covariance of the split noise is a difference: Costa, Fragoso & Marques 2005, sec. 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.exact.paths import JumpResult
from fkgen.oracle.plants.actuator import Plant
from fkgen.oracle.plants.jump import JumpSystem, lasting_law
from fkgen.oracle.textbook.loss_tests import LossTest, verdict
from fkgen.oracle.textbook.riccati import stationary_prediction_by_control


def composite(system: JumpSystem) -> JumpSystem:
    """The plant with modes (mode, gamma), first all that arrive, then all lost: C, D, d = 0."""
    twice = {
        name: np.concatenate([each, 0.0 * each if name in "CDd" else each], axis=1)
        for name, each in ((name, getattr(system, name)) for name in Plant.VARYING)
    }
    lost, arrived = system.arrival_initial
    return replace(
        system.always_arriving(),
        **twice,
        transitions=np.array(
            [
                np.kron(arrival[::-1, ::-1], P)
                for arrival, P in zip(system.channel, system.transitions, strict=True)
            ]
        ),
        initial=np.asarray(np.kron([arrived, lost], system.initial), float),
    )


@dataclass(frozen=True, eq=False)
class Split:
    """The split plant at one sample: everything that the filter equations need."""

    F: Array  # F, L: (M, M), (p, M): z[k+1] = F z[k] + noise, E[y | z] = rho L z, M = N (n + 1)
    L: Array
    moved: Array  # (M, M): Second moment of z[k+1], block-diagonal
    now: Array  # (M, M): Second moment of z[k], block-diagonal
    R: Array  # (p, p): Mean covariance of v
    signal: Array  # (p, p): Second moment of the signal

    @property
    def noise(self) -> Array:
        """Covariance of the split noise, V + Qbar = Z(k+1) - F Z(k) F'."""
        return np.asarray(self.moved - self.F @ self.now @ self.F.T)

    def innovation_covariance(self, X: Array, rate: float) -> Array:
        """S = p^2 L X L' + p (1 - p) E[s s'] + R: Nahi 1969; p = 1 if a signal is certain."""
        doubt = rate * (1.0 - rate) * self.signal
        return np.asarray(rate**2 * self.L @ X @ self.L.T + doubt + self.R)


def _block_diagonal(blocks: Array) -> Array:
    """(N, m, m) as one (N m, N m) matrix."""
    N, m, _ = blocks.shape
    return np.asarray(np.einsum("ij,iab->iajb", np.eye(N), blocks).reshape(N * m, N * m))


def _start_of(system: JumpSystem) -> tuple[Array, Array]:
    """Mean of z[0], and the second moments of its blocks, (N, n + 1, n + 1)."""
    one = np.append(system.x0, 1.0)
    second = np.outer(one, one)
    second[:-1, :-1] += system.P0
    return np.kron(system.initial, one), system.initial[:, None, None] * second


def _with_constant(system: JumpSystem, k: int, added: Array) -> Array:
    """The matrices that move (x, 1) in each mode, and the noise in it, (2, N, n + 1, n + 1)."""
    n = system.nx
    both = np.zeros((2, system.count, n + 1, n + 1))
    both[0, :, :n, :n], both[0, :, :n, n], both[0, :, n, n] = system.A[k], added, 1.0
    both[1, :, :n, :n] = system.Q[k]
    return both


def _split_at(system: JumpSystem, u: Array, k: int, moments: Array, law: Array) -> Split:
    """The split plant at sample k: Costa 1994, Lemma 3 of Sun & Zhao & Yin for the moments."""
    N, P = system.count, system.transitions[k]
    added, sensed = system.offsets(u)
    A, Q = _with_constant(system, k, added[k])
    signal = np.concatenate([system.C[k], sensed[k][:, :, None]], axis=2)
    F = np.block([[P[i, j] * A[i] for i in range(N)] for j in range(N)])
    each = A @ moments @ A.transpose(0, 2, 1) + law[:, None, None] * Q
    return Split(
        F=F,
        L=np.concatenate(list(signal), axis=1),
        moved=_block_diagonal(np.einsum("ij,iab->jab", P, each)),
        now=_block_diagonal(moments),
        R=np.einsum("i,iab->ab", law, system.R[k]),
        signal=np.einsum("iab,ibc,idc->ad", signal, moments, signal),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class SteadyState:
    """A filter whose covariances have come to rest."""

    split: Split  # The split plant with stationary moments
    covariance: Array  # (M, M): Error covariance of z(k|k-1)
    innovation_covariance: Array  # (p, p)
    gain: Array  # (M, p): From the innovation to the correction
    closed_loop_radius: float  # Spectral radius of the error from sample to sample

    @property
    def filtered(self) -> Array:
        """Error covariance of z(k|k)."""
        return self.covariance - self.gain @ self.innovation_covariance @ self.gain.T

    @property
    def expected_squares(self) -> tuple[float, float]:
        """E |r|^2 with a signal, J1, and without one, J0, of a filter that trusts a signal."""
        predicted = self.split.L @ self.covariance @ self.split.L.T
        J1 = float(np.trace(predicted + self.split.R))
        return J1, float(np.trace(self.split.R + self.split.signal - predicted))


def textbook_jumps(
    system: JumpSystem,
    y: Array,
    u: Array,
    *,
    test: LossTest | None = None,
    steady: SteadyState | None = None,
) -> JumpResult:
    """Filter a record; y, u (T, p), (T, q)."""
    n, N = system.nx, system.count
    laws, rates = system.mode_law(), np.full(len(y), system.arrival_initial[1])
    rates = rates if system.arrival_rates is None else system.arrival_rates
    q, moments = _start_of(system)
    z, X = q, _block_diagonal(moments) - np.outer(q, q)
    E, results = np.tile(np.eye(n, n + 1), N), []
    for k, now in enumerate(y):
        split = _split_at(system, u, k, moments, laws[k])
        rate = float(rates[k])
        L, S = rate * split.L, split.innovation_covariance(X, rate)
        if steady is not None:
            split = replace(steady.split, F=split.F, L=split.L)
            X, S = steady.covariance, steady.innovation_covariance
        r = now - L @ z
        verdicts, restart = verdict(test, now, r, S, split.R)
        row: dict[str, ArrayLike] = {
            "innovation": r,
            "innovation_covariance": S,
            "mode_law": laws[k],
            **_agreement(r, S),
            **verdicts,
        }
        accepted = np.flatnonzero(np.isfinite(now) & (not verdicts["fault_declared"]))
        inverse = np.linalg.pinv(S[np.ix_(accepted, accepted)], rcond=1e-13, hermitian=True)
        K = X @ L[accepted].T @ inverse if steady is None else steady.gain[:, accepted]
        z, X = z + K @ r[accepted], X - K @ L[accepted] @ X
        if restart:
            z, X = q, split.now - np.outer(q, q)
        shown = X if steady is None else steady.filtered
        row |= {"filtered_state": E @ z, "filtered_covariance": E @ shown @ E.T}
        z, X = split.F @ z, split.F @ X @ split.F.T + split.noise
        shown = X if steady is None else steady.covariance
        row |= {"predicted_state": E @ z, "predicted_covariance": E @ shown @ E.T}
        q = split.F @ q
        moments = np.einsum("iaib->iab", split.moved.reshape(N, n + 1, N, n + 1))
        results.append(row)
    return JumpResult.of(results)


def _agreement(r: Array, S: Array) -> dict[str, float]:
    """How well the rows present fit their prediction."""
    rows = np.flatnonzero(np.isfinite(r))
    r, S = r[rows], S[np.ix_(rows, rows)]
    nis = float(r @ np.linalg.pinv(S, rcond=1e-13, hermitian=True) @ r)
    determinant = float(np.linalg.slogdet(2.0 * np.pi * S)[1])
    return {"nis": nis, "log_likelihood": -0.5 * (nis + determinant)}


#: Powers of two of the moment operator after which it has stopped to change, at the latest.
DOUBLINGS = 60


def _limiting_moments(system: JumpSystem) -> Array:
    """Second moments of (x, 1) 1{mode} after 2, 4, 8, ... steps until nothing changes."""
    N, m, P = system.count, system.nx + 1, system.transition
    A, Q = _with_constant(system, 0, system.c[0])
    corner = np.eye(m**2)[-1]
    each = [np.kron(A[i], A[i]) + np.outer(Q[i].ravel(), corner) for i in range(N)]
    # The matrix that moves all blocks, stacked, by one step.
    power = np.block([[P[i, j] * each[i] for i in range(N)] for j in range(N)])
    moments = start = _start_of(system)[1]
    for _ in range(DOUBLINGS):
        power = power @ power
        later = (power @ start.ravel()).reshape(N, m, m)
        mass = later[:, -1, -1].sum()  # probabilities sum to one, but for rounding
        power, later = power / mass, later / mass
        change = np.abs(later - moments).max()
        moments = 0.5 * (later + later.transpose(0, 2, 1))
        if change <= 1e-14 * np.abs(moments).max():
            break
    return moments


def stationary_jumps(system: JumpSystem, rate: float = 1.0) -> SteadyState | None:
    """Find the limits of moments, covariance and gain; None if the equation has no solution."""
    N, m = system.count, system.nx + 1
    A = system.A[0, 0]
    if rate == 1.0 and _noise_alone(system) and np.abs(np.linalg.eigvals(A)).max() >= 1.0:
        return _without_moments(system)
    moments = _limiting_moments(system)
    split = _split_at(system, np.zeros((1, 0)), 0, moments, moments[:, -1, -1])
    # The indicators sum to one: the last follows from the others, and so does its error.
    size = N * m
    drop = np.eye(size - 1, size)
    lift = drop.T.copy()
    lift[-1, m - 1 : size - 1 : m] = -1.0
    F, L = drop @ split.F @ lift, rate * split.L @ lift
    R = split.R + rate * (1.0 - rate) * split.signal
    noise = drop @ split.noise @ drop.T
    found = stationary_prediction_by_control(F, L, noise, R)
    if found is None:
        return None
    X = lift @ found[0] @ lift.T
    S = split.innovation_covariance(X, rate)
    return SteadyState(
        split=split,
        covariance=X,
        innovation_covariance=S,
        gain=rate * X @ split.L.T @ np.linalg.pinv(S, rcond=1e-13, hermitian=True),
        closed_loop_radius=_radius(system, F - F @ found[0] @ L.T @ np.linalg.pinv(S) @ L),
    )


def _noise_alone(system: JumpSystem) -> bool:
    """Whether the modes differ in Q and R only."""
    same = (getattr(system, name)[0] for name in Plant.VARYING if name not in "QR")
    return all(np.array_equal(each, np.broadcast_to(each[0], each.shape)) for each in same)


def _without_moments(system: JumpSystem) -> SteadyState | None:
    """Modes that differ in noise alone, whose moments need no limit: the sum of the parts is x.

    The estimate of the first part stands for the sum; where the moments have no limit, they are
    NaN.
    """
    n, N, m = system.nx, system.count, system.nx + 1
    law = lasting_law(system.transition)
    A, C = system.A[0, 0], system.C[0, 0]
    Q, R = (np.tensordot(law, each[0], axes=1) for each in (system.Q, system.R))
    found = stationary_prediction_by_control(A, C, Q, R)
    if found is None:
        return None
    P, place = found[0], np.eye(N * m, n)
    S = C @ P @ C.T + R
    gain = P @ C.T @ np.linalg.pinv(S, rcond=1e-13, hermitian=True)
    unknown = np.full((N, m, m), np.nan)
    split = _split_at(system, np.zeros((1, system.B.shape[-1])), 0, unknown, law)
    return SteadyState(
        split=split,
        covariance=place @ P @ place.T,
        innovation_covariance=S,
        gain=place @ gain,
        closed_loop_radius=found[1],
    )


def _radius(system: JumpSystem, loop: Array) -> float:
    """Spectral radius of the error; that of the indicators counts only if something is added."""
    m = system.nx + 1
    kept = (
        np.ones(len(loop), bool)
        if system.c.any() or system.d.any()
        else np.arange(len(loop)) % m < system.nx
    )
    return float(np.abs(np.linalg.eigvals(loop[np.ix_(kept, kept)])).max())
