"""The stationary gain of a jumping plant: moments and a Riccati equation at design time.

What is left at run time is the state: one product with a constant gain and one with F. Exists where
the second moments have a limit: a mean-square stable plant (Costa, Fragoso & Marques 2005, ch. 3)
and an ergodic chain. Modes that differ in noise alone need no moments: their gain is that of a
Kalman filter with the mean of Q and R, which integrators have too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.estimate import demand_finite, finite, measurement_of
from fkgen.estimators.gaussian.sequential import condition
from fkgen.estimators.lmmse import jump
from fkgen.estimators.lmmse.jump import Array, AugmentedState, Moments
from fkgen.estimators.lmmse.kalman import constant, innovation_results
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.probability import stationary_law
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.linalg import pack, sparse, unpack
from fkgen.symbolic.recursion import Phase, Recursion

#: Relative change below which an iteration that converges quadratically has ended.
SETTLED = 1e-15

#: Singular values of S below this share of the largest are zero, as for the pseudo-inverse.
RANK = 1e-13


@dataclass(frozen=True, eq=False, kw_only=True)
class Stationary:
    """The limits of the filter."""

    predicted: Array  # (M, M), error covariance at k+1 given y[0..k]
    filtered: Array  # (M, M), the same at k
    innovation: Array  # (p, p), S
    noise: Array  # (p, p), covariance of y without signal
    gain: Array  # (M, p), X L' S^-1: from the innovation to the correction


def stationary_moments(z: AugmentedState) -> Moments:
    """Limits of E[x x' 1{mode}], E[x 1{mode}] and Pr(mode), from linear equations."""
    law = stationary_law(z.kernel)
    if law is None:
        raise InternalError("a stationary gain for a chain without a limit")
    P, n, N = z.kernel, z.base.nx, z.modes
    A, Q, c = ([_number(getattr(plant, x)) for plant in z.plants[:N]] for x in "AQc")
    c = [each.ravel() for each in c]
    q = _limit(P, A, [law[i] * c[i] for i in range(N)]).reshape(N, n)
    added = []
    for i in range(N):
        cross = np.outer(A[i] @ q[i], c[i])
        added.append((law[i] * (Q[i] + np.outer(c[i], c[i])) + cross + cross.T).ravel())
    Z = _limit(P, [np.kron(each, each) for each in A], added).reshape(N, n, n)
    second = [constant(0.5 * (each + each.T)) for each in Z]
    return Moments(second, [ca.SX(ca.DM(each)) for each in q], ca.SX(ca.DM(law)))


def _limit(P: Array, steps: Sequence[NDArray[np.floating]], added: list[Array]) -> Array:
    """Solve v_j = sum_i P_ij (step_i v_i + added_i) for the v of all modes, stacked."""
    modes = range(len(P))
    F = np.block([[P[i, j] * steps[i] for i in modes] for j in modes])
    source = np.concatenate([sum(P[i, j] * added[i] for i in modes) for j in modes])
    return np.asarray(np.linalg.solve(np.eye(len(F)) - F, source))


def stationary_of(z: AugmentedState) -> Stationary:
    """Solve for the stationary error covariance and its gain."""
    if z.parts == 1:
        return _of_one_part(z)
    builder, u, N = PhaseBuilder({}), ca.SX(z.base.nu, 1), z.modes
    now = stationary_moments(z)
    moved = jump.moved_moments(builder, z, z.plants, now, u)
    noises = jump.plant_noise(z, z.plants, now.law)
    W = _number(jump.augmented_noise(z, moved, noises, z.arrived({}, "")))
    F = _number(jump.mixing(z)[0] @ jump.steps(z, z.plants, u)[0])
    L = float(z.rate) * _number(jump.measured(z, z.plants, u)[0])
    weights = [now.law[i] for i in range(N)]
    noise = _number(jump.shared([plant.R for plant in z.plants[:N]], weights))
    doubt = float(z.rate) * (1.0 - float(z.rate))
    signal = _number(unpack(jump.signal_moment(z, z.plants, now, u), z.base.ny))
    R = noise + doubt * signal
    return _solved((F, L, W, R), noise, riccati(F, L, W, R))


def _of_one_part(z: AugmentedState) -> Stationary:
    """The steady state where no second moment of the state is needed, which may have no limit."""
    law, own = stationary_law(np.array(z.chain.transition)), z.plants[: len(z.chain.modes)]
    if law is None:
        raise InternalError("a stationary gain for a chain without a limit")
    Q, R = (np.einsum("i,iab->ab", law, [_number(getattr(p, x)) for p in own]) for x in "QR")
    A, C = _number(z.base.A), _number(z.base.C)
    return _solved((A, C, Q, R), R, stabilising(A, C, Q, R))


def _solved(system: tuple[Array, Array, Array, Array], noise: Array, X: Array) -> Stationary:
    _, L, _, R = system
    S, inverse = _innovation(X, L, R)
    gain = X @ L.T @ inverse
    return Stationary(predicted=X, filtered=X - gain @ L @ X, innovation=S, noise=noise, gain=gain)


def stabilising(A: Array, C: Array, Q: Array, R: Array, cross: Array | None = None) -> Array:
    """Refine SciPy's solution, which has some ten digits, by Newton's method if no S is there."""
    from scipy.linalg import solve_discrete_are  # noqa: PLC0415 - slow to import

    P = np.asarray(solve_discrete_are(A.T, C.T, Q, R, s=cross), float)
    P = 0.5 * (P + P.T)
    return P if cross is not None and cross.any() else riccati(A, C, Q, R, P)


def riccati(F: Array, L: Array, W: Array, R: Array, start: Array | None = None) -> Array:
    """Solve X = F X F' + W - F X L' (L X L' + R)^-1 L X F' for a stable F, or from a start.

    Newton's method from the gain zero, which descends to the solution (Kleinman 1968, Hewer 1971),
    or from a start whose gain stabilises.
    """
    X = _lyapunov(F, W) if start is None else start
    for _ in range(100):
        K = F @ X @ L.T @ _innovation(X, L, R)[1]
        following = _lyapunov(F - K @ L, W + K @ R @ K.T)
        change = np.abs(following - X).max()
        X = following
        if change <= SETTLED * np.abs(X).max():
            break
    return X


def _innovation(X: Array, L: Array, R: Array) -> tuple[Array, Array]:
    """S = L X L' + R and its inverse."""
    S = L @ X @ L.T + R
    return S, np.asarray(np.linalg.pinv(S, rcond=RANK, hermitian=True), float)


def _lyapunov(F: Array, W: Array) -> Array:
    """Sum of F^k W F'^k, twice as many terms at every turn."""
    X, power = W, F
    while np.abs(power).max() > SETTLED:
        X = X + power @ X @ power.T
        power = power @ power
    return 0.5 * (X + X.T)


def _number(matrix: ca.SX) -> Array:
    """Values of a matrix of constants."""
    return np.array(ca.evalf(matrix), float)


def stationary_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion with a constant gain."""
    z = AugmentedState(spec)
    at_rest = stationary_of(z)
    notes = (
        "constant gain: covariances are those the filter comes to, from sample 0 on",
        "a missing row of y is replaced by its prediction",
    )
    phases = (partial(phase, at_rest=at_rest) for phase in (_update, _predict))
    return jump.recursion_of(z, source, *phases, notes=notes)


def _update(z: AugmentedState, symbols: dict[str, ca.SX], *, at_rest: Stationary) -> Phase:
    builder, prior = PhaseBuilder(symbols), symbols["augmented_state"]
    L, known = jump.measured(z, z.plants, symbols["u"])
    nothing = (ca.SX(1, 1), ca.SX(1, 1))
    measurement = measurement_of(
        replace(z.base, noise_free=is_singular(at_rest.innovation)),
        y=symbols["y"],
        C=ca.SX(z.base.ny, 1),
        offset=sparse(z.rate * L) @ prior + z.rate * known,
        R=constant(at_rest.innovation),
    )
    found = condition(builder, nothing, measurement, form="short")
    corrected = builder.define("corrected", prior + constant(at_rest.gain) @ found.innovation)
    demand_finite(builder, corrected)
    (state,), results = jump.kept(
        builder,
        z,
        (found, measurement, constant(at_rest.noise)),
        corrected=(corrected,),
        prior=(prior,),
        fresh=lambda: (jump.unconditional_mean(z, *_means(z, symbols, "predicted_")),),
    )
    results |= innovation_results(found) | {
        "augmented_filtered_state": state,
        "filtered_state": state[z.own],
        "filtered_covariance": _own(z, at_rest.filtered),
        **jump.unchanged(z, symbols),
    }
    with builder.titled("results of the update"):
        builder.assign(results)
    return builder.phase()


def _own(z: AugmentedState, matrix: Array) -> ca.SX:
    """The covariance of x, packed."""
    return pack(ca.SX(ca.DM(matrix[z.own, z.own])))


def _means(z: AugmentedState, symbols: dict[str, ca.SX], of: str) -> tuple[list[ca.SX], ca.SX]:
    """E[x 1{mode}] and Pr(mode) without any measurement."""
    law = jump.grouped(z, z.law(symbols, of))
    return ca.vertsplit(symbols[f"{of}mode_first_moment"], z.base.nx), law


def _predict(z: AugmentedState, symbols: dict[str, ca.SX], *, at_rest: Stationary) -> Phase:
    builder = PhaseBuilder(symbols)
    with builder.titled("every mode's step"):
        G, known = jump.steps(z, z.plants, symbols["u"])
        moved = builder.define("moved_state", G @ symbols["augmented_filtered_state"] + known)
    results: dict[str, ca.SX] = {}
    if not z.settled:
        results["predicted_mode_law"] = jump.next_law(z, symbols["mode_law"])
    if z.restarts:
        means = jump.moved_means(z, z.plants, *_means(z, symbols, ""), symbols["u"])
        results["predicted_mode_first_moment"] = ca.vertcat(*means)
    with builder.titled("mixing by the chain, and prediction of the next sample"):
        M, known = jump.mixing(z)
        state = M @ moved + known
        covariance = _own(z, at_rest.predicted)
        results |= {
            "augmented_state": state,
            "predicted_state": state[z.own],
            "predicted_covariance": covariance,
        }
        builder.assign(results, [finite(state[z.own], covariance)])
    return builder.phase()
