"""The stationary gain of a jumping plant: moments and a Riccati equation at design time.

What is left at run time is the state: one product with a constant gain and one with F. Exists where
the second moments have a limit: a mean-square stable plant (Costa, Fragoso & Marques 2005, ch. 3)
and an ergodic chain.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.estimate import demand_finite, finite
from fkgen.estimators.gaussian.sequential import PIVOTS_PER_LOG, RANK_TOLERANCE, condition
from fkgen.estimators.lmmse.jump import (
    AugmentedState,
    Moments,
    augmented_noise,
    augmented_ports,
    augmented_start,
    innovation_results,
    judges,
    law_ports,
    measured,
    mixing,
    moved_means,
    moved_moments,
    next_law,
    notes_of,
    plant_noise,
    shared,
    signal_moment,
    steps,
    unchanged,
)
from fkgen.estimators.lmmse.loss_tests import LossTest, loss_outcomes, loss_ports
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.probability import stationary_law
from fkgen.symbolic.builder import Script
from fkgen.symbolic.linalg import pack, sparse, unpack
from fkgen.symbolic.ports import innovation_ports, start_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

Array = NDArray[np.float64]

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
    A, Q = ([_number(getattr(plant, x)) for plant in z.plants] for x in ("A", "Q"))
    c = [_number(plant.c).ravel() for plant in z.plants]
    F = np.block([[P[i, j] * A[i] for i in range(N)] for j in range(N)])
    source = np.concatenate([sum(P[i, j] * law[i] * c[i] for i in range(N)) for j in range(N)])
    q = np.linalg.solve(np.eye(N * n) - F, source).reshape(N, n)
    T = np.block([[P[i, j] * np.kron(A[i], A[i]) for i in range(N)] for j in range(N)])
    added = []
    for i in range(N):
        cross = np.outer(A[i] @ q[i], c[i])
        added.append(law[i] * (Q[i] + np.outer(c[i], c[i])) + cross + cross.T)
    source = np.concatenate([sum(P[i, j] * added[i] for i in range(N)).ravel() for j in range(N)])
    Z = np.linalg.solve(np.eye(N * n * n) - T, source).reshape(N, n, n)
    second = tuple(sparse(ca.SX(ca.DM(0.5 * (each + each.T)))) for each in Z)
    return Moments(second, tuple(ca.SX(ca.DM(each)) for each in q), ca.SX(ca.DM(law)))


def stationary_of(z: AugmentedState) -> Stationary:
    """Solve for the stationary error covariance and its gain."""
    script, u = Script({}), ca.SX(z.base.nu, 1)
    now = stationary_moments(z)
    moved = moved_moments(script, z, z.plants, now, u)
    W = _number(augmented_noise(z, moved, plant_noise(z, z.plants, now.law)))
    W = np.tril(W) + np.tril(W, -1).T
    F = _number(mixing(z)[0] @ steps(z, z.plants, u)[0])
    L = z.rate * _number(measured(z, z.plants, u)[0])
    weights = [now.law[i] for i in range(z.modes)]
    noise = _number(shared([plant.R for plant in z.plants[: z.modes]], weights))
    doubt = z.rate * (1.0 - z.rate)
    signal = _number(unpack(signal_moment(z, z.plants, now, u), z.base.ny))
    R = noise + doubt * signal
    X = riccati(F, L, W, R)
    S = L @ X @ L.T + R
    gain = X @ L.T @ np.linalg.pinv(S, rcond=RANK, hermitian=True)
    return Stationary(predicted=X, filtered=X - gain @ L @ X, innovation=S, noise=noise, gain=gain)


def riccati(F: Array, L: Array, W: Array, R: Array) -> Array:
    """Solve X = F X F' + W - F X L' (L X L' + R)^-1 L X F' for a stable F.

    Newton's method from the gain zero, which descends to the solution (Kleinman 1968, Hewer 1971).
    """
    X = _lyapunov(F, W)
    for _ in range(100):
        S = L @ X @ L.T + R
        K = F @ X @ L.T @ np.linalg.pinv(S, rcond=RANK, hermitian=True)
        following = _lyapunov(F - K @ L, W + K @ R @ K.T)
        change = np.abs(following - X).max()
        X = following
        if change <= SETTLED * np.abs(X).max():
            break
    return X


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
    z = AugmentedState.of(spec)
    at_rest = stationary_of(z)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *(loss_ports(spec) if judges(spec) else ()),
        *law_ports(z),
        *augmented_ports(z, covariances=False),
    )
    symbols = symbols_of(spec, z.base, ports)
    start = augmented_start(z) | start_of(spec)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial={port.name: start[port.name] for port in ports if port.name in start},
        update=_update(z, symbols, at_rest),
        predict=_predict(z, symbols, at_rest),
        notes=(
            "constant gain: covariances are those the filter comes to, from sample 0 on",
            "a missing row of y is replaced by its prediction",
            *notes_of(z),
        ),
        outcomes=loss_outcomes(spec) if judges(spec) else (),
    )


def _update(z: AugmentedState, symbols: dict[str, ca.SX], at_rest: Stationary) -> Phase:
    script, spec, prior = Script(symbols), z.spec, symbols["augmented_state"]
    L, _ = measured(z, z.plants, symbols["u"])
    nothing, scalar = ca.SX(1, 1), spec.code.scalar
    measurement = Measurement(
        C=ca.SX(z.base.ny, 1),
        offset=sparse(z.rate * L) @ prior,
        R=sparse(ca.SX(ca.DM(at_rest.innovation))),
        y=symbols["y"],
        rows=z.base.rows,
        at=tuple(range(z.base.ny)),
        rank_tolerance=RANK_TOLERANCE[scalar] if is_singular(at_rest.innovation) else None,
        pivots_per_log=PIVOTS_PER_LOG[scalar],
    )
    found = condition(script, (nothing, nothing), measurement, form="short")
    corrected = script.let(
        "corrected", prior + sparse(ca.SX(ca.DM(at_rest.gain))) @ found.innovation
    )
    demand_finite(script, corrected)
    results: dict[str, ca.SX] = {}
    if judges(spec):
        test = LossTest(script, symbols, spec)
        verdict = test.verdict(found, measurement, sparse(ca.SX(ca.DM(at_rest.noise))))
        state = script.local("kept_state", z.size)
        script.put({"kept_state": corrected})
        with script.when(None, verdict.excess):
            script.put({"kept_state": prior})
        if z.restarts:
            locked = ca.fmin(test.locked(verdict.rejections), verdict.excess)
            with script.when(None, locked):
                script.put({"kept_state": _expected(z, symbols)})
        corrected, results = state, verdict.results
    results |= innovation_results(found) | {
        "augmented_filtered_state": corrected,
        "filtered_state": corrected[z.own],
        "filtered_covariance": _own(z, at_rest.filtered),
        **unchanged(z, symbols),
    }
    with script.titled("results of the update"):
        script.put(results)
    return script.phase()


def _own(z: AugmentedState, matrix: Array) -> ca.SX:
    """The covariance of x, packed."""
    return pack(ca.SX(ca.DM(matrix[z.own, z.own])))


def _expected(z: AugmentedState, symbols: dict[str, ca.SX]) -> ca.SX:
    """Mean of the augmented state without any measurement."""
    n, law = z.base.nx, z.law(symbols)
    first = ca.vertsplit(symbols["predicted_mode_first_moment"], n)
    means = []
    for share in z.shares:
        for i, q in enumerate(first):
            means.append(share * (ca.vertcat(q, law[i]) if z.ones else q))
    own = sum(first[1:], start=first[0])
    return ca.vertcat(*means[:-1], own)


def _predict(z: AugmentedState, symbols: dict[str, ca.SX], at_rest: Stationary) -> Phase:
    script, u = Script(symbols), symbols["u"]
    with script.titled("every mode's step"):
        G, known = steps(z, z.plants, u)
        moved = script.let("moved_state", G @ symbols["augmented_filtered_state"] + known)
    results: dict[str, ca.SX] = {}
    if not z.settled:
        results["predicted_mode_law"] = next_law(z, symbols["mode_law"])
    if z.restarts:
        first = ca.vertsplit(symbols["mode_first_moment"], z.base.nx)
        law = z.law(symbols) if z.settled else symbols["mode_law"]
        means = moved_means(z, z.plants, tuple(first), law)
        results["predicted_mode_first_moment"] = ca.vertcat(*means)
    with script.titled("mixing by the chain, and prediction of the next sample"):
        M, constant = mixing(z)
        state = M @ moved + constant
        own = state[z.own]
        results |= {
            "augmented_state": state,
            "predicted_state": own,
            "predicted_covariance": _own(z, at_rest.predicted),
        }
        script.put(results, [finite(own, _own(z, at_rest.predicted))])
    return script.phase()
