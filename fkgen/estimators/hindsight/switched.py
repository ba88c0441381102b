"""Fixed-interval smoothing of filters over modes, by Kim's approximation.

From sample k + 1 back to sample k, for each pair (i, j) of modes: the estimate under i, moved as j
moves it, is smoothed by what the whole record says under j as Rauch, Tung and Striebel do, and the
pair has the weight Pr(j at k+1 | all) Pr(i at k | y[0..k]) p_ij / Pr(j at k+1 | y[0..k]). The
pairs of each i are merged into one Gaussian (Kim 1994, J. Econometrics 60, pp. 1-22). It
is exact where the mode never changes. A filter that keeps one Gaussian has one mode here.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.hindsight.backwards import inverse_of_rows
from fkgen.estimators.hindsight.linearised import over_samples
from fkgen.estimators.models.modes import Modes
from fkgen.problem import Spec
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.plant import Plant, mode_plants, plant_of

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ForwardsByMode:
    """What a filter over N modes has found at T samples."""

    state: Array  # (T, N, n): x(k|k) under each mode
    covariance: Array  # (T, N, n, n)
    probability: Array  # (T, N) of the modes at sample k
    u: Array  # (T, q)
    parameters: Array  # (T, number of parameters)

    def backwards(self, spec: Spec) -> tuple[Array, Array]:
        """Mean (T, n) and covariance (T, n, n) given all of the record."""
        (A, moved, Q), law = self._moves(spec)
        T, _, n = self.state.shape
        states, covariances = np.empty((T, n)), np.empty((T, n, n))
        x, P, weights = self.state[-1], self.covariance[-1], self.probability[-1]
        states[-1], covariances[-1] = _merged(weights, x, P)
        every = np.ones(n, bool)
        for k in reversed(range(T - 1)):
            own, spread = self.state[k][:, None], self.covariance[k][:, None]
            ahead = A[k] @ spread @ A[k].mT + Q[k]  # (N, N, n, n): from mode i as mode j moves
            gain = spread @ A[k].mT @ inverse_of_rows(np.eye(n), ahead, np.zeros((n, n)), every)
            off = x - (A[k] @ own[..., None])[..., 0] - moved[k]
            pairs = own + (gain @ off[..., None])[..., 0]
            spreads = spread + gain @ (P - ahead) @ gain.mT
            joint = self.probability[k][:, None] * law[k]
            total = joint.sum(axis=0)
            joint *= np.divide(weights, total, out=np.zeros_like(total), where=total > 0.0)
            weights = joint.sum(axis=1)
            even = np.full_like(joint, 1.0 / len(weights))  # of a mode that cannot have been
            possible = weights[:, None] > 0.0
            x, P = _merged(
                np.divide(joint, weights[:, None], out=even, where=possible), pairs, spreads
            )
            states[k], covariances[k] = _merged(weights, x, P)
        return states, covariances

    def _moves(self, spec: Spec) -> tuple[tuple[Array, Array, Array], Array]:
        """By mode A (T, N, n, n), B u + c (T, N, n) and Q; the law of the next mode (T, N, N)."""
        plants, kernel = _modes(spec, self.probability.shape[1])
        u, none = ca.SX.sym("u", plants[0].nu), ca.SX(0, 1)
        inputs = none, none, u, ca.vertcat(ca.SX(0, 1), *plants[0].parameters.values())
        T = len(self.state)
        nothing = np.zeros((0, T))
        given = nothing, nothing, self.u.T, self.parameters.T

        def along(matrix: ca.SX) -> Array:
            if not matrix.numel() or not ca.symvar(matrix):
                return np.broadcast_to(np.asarray(ca.DM(matrix)), (T, *matrix.shape))
            return over_samples(inputs, matrix)(given)

        A, Q = (np.stack([along(getattr(p, x)) for p in plants], axis=1) for x in "AQ")
        moved = np.stack([along(p.B @ u + p.c)[..., 0] for p in plants], axis=1)
        return (A, moved, Q), along(kernel)


def _modes(spec: Spec, count: int) -> tuple[tuple[Plant, ...], ca.SX]:
    """How each mode moves, and the law of the next one."""
    plant = plant_of(spec)
    if count == 1:
        return (plant,), ca.SX(1)
    modes = Modes.of(spec, mode_plants(spec, spec.faults.chain(spec.model).modes, plant))
    if modes.chain.law is None:
        return modes.motions, ca.SX(ca.DM(np.array(modes.kernel)))
    if modes.chain.independent:  # the next mode says nothing of this one
        return modes.motions, ca.SX.ones(count, count)
    return modes.motions, law_of(modes.chain.law, plant.parameters)


def _merged(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture over the last axis of the weights."""
    mean = (weights[..., None] * means).sum(axis=-2)
    off = means - mean[..., None, :]
    spread = covariances + off[..., :, None] * off[..., None, :]
    return mean, (weights[..., None, None] * spread).sum(axis=-3)
