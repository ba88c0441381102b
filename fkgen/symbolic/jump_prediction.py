"""Prediction of the split state: every mode's step, then the mixing by the chain.

F = (P' (x) I) diag(A_i) is never formed. With u = A_N x + sum (A_i - A_N) z^i, which is the next x
but for noise, and t^i = A_i z^i, the next part j is p_Nj u + sum_i (p_ij - p_Nj) t^i.
"""

from __future__ import annotations

import casadi as ca

from fkgen.symbolic.estimate import bound_all, finite
from fkgen.symbolic.jump_moments import (
    later_moments,
    moments_of,
    moved_moments,
    next_law,
    offset_of,
    plant_noise,
    split_noise,
)
from fkgen.symbolic.jumping import Jumping
from fkgen.symbolic.linalg import column, pack, sparse, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.recursion import Phase
from fkgen.symbolic.script import Script


def steps(split: Jumping, plants: tuple[Plant, ...], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant of (t, u): what every mode makes of the split state."""
    w, n, last = split.width, split.base.nx, split.plant(plants, split.parts - 1)
    G = ca.SX(split.size, split.size)
    known = offset_of(last, u)
    for i in range(split.parts - 1):
        plant, at = split.plant(plants, i), slice(i * w, i * w + n)
        G[at, at] = plant.A
        G[split.own, at] = plant.A - last.A
        if split.ones:
            one = i * w + n
            G[at, one] = offset_of(plant, u)
            G[one, one] = 1
            G[split.own, one] = offset_of(plant, u) - known
    G[split.own, split.own] = last.A
    constant = ca.SX(split.size, 1)
    constant[split.own] = known
    return sparse(G), sparse(constant)


def mixing(split: Jumping) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant that make the next split state of (t, u)."""
    P, w, n, last = split.transition, split.width, split.base.nx, split.parts - 1
    M, constant = ca.SX(split.size, split.size), ca.SX(split.size, 1)
    for j in range(last):
        to = slice(j * w, j * w + w)
        M[slice(j * w, j * w + n), split.own] = float(P[last, j]) * ca.SX.eye(n)
        for i in range(last):
            share = float(P[i, j] - P[last, j])
            M[to, slice(i * w, i * w + w)] = share * ca.SX.eye(w)
        if split.ones:
            constant[j * w + n] = float(P[last, j])
    M[split.own, split.own] = ca.SX.eye(n)
    return sparse(M), sparse(constant)


def lean_congruence(M: ca.SX, P: ca.SX) -> ca.SX:
    """Packed ``M P M'``, the second product of each entry along the emptier of its two rows."""
    T = M @ P
    rows = [sparse(M[i, :].T) for i in range(M.shape[0])]
    entries = []
    for i, j in triangle(len(rows)):
        a, b = (i, j) if rows[j].nnz() <= rows[i].nnz() else (j, i)
        entries.append(ca.mtimes(T[a, :], rows[b]))
    return column(entries)


def predict_split(split: Jumping, symbols: dict[str, ca.SX]) -> Phase:
    """The phase ``predict`` of a gain that follows the moments."""
    script, n = Script(symbols), split.base.nx
    u = symbols["u"]
    plants = bound_all(script, split.plants, "ABQc")
    now = moments_of(split, symbols, "")
    with script.titled("second moments, mode by mode"):
        moved = moved_moments(script, split, plants, now, u)
        law = next_law(split, now.law)
        noise = [
            unpack(script.let(f"plant_noise_{j}", pack(each)), n)
            for j, each in enumerate(plant_noise(split, plants, now.law))
        ]
        second, first = later_moments(split, moved, noise)
        if split.restarts and not split.ones:
            first = moved_means(split, plants, now.first, now.law)
        results = {"predicted_mode_second_moment": ca.vertcat(*second)}
        if split.means:
            results["predicted_mode_first_moment"] = ca.vertcat(*first)
        if not split.settled:
            results["predicted_mode_law"] = law
    with script.titled("every mode's step"):
        G, known = steps(split, plants, u)
        moved_state = script.let("moved_state", G @ symbols["augmented_filtered_state"] + known)
        filtered = unpack(symbols["augmented_filtered_covariance"], split.size)
        packed = script.let("moved_covariance", lean_congruence(G, filtered))
    with script.titled("mixing by the chain"):
        M, constant = mixing(split)
        state = M @ moved_state + constant
        covariance = lean_congruence(M, unpack(packed, split.size))
        covariance += pack(split_noise(split, moved, noise))
    with script.titled("prediction of the next sample"):
        results |= {"augmented_state": state, "augmented_covariance": covariance}
        results |= whole(split, state, covariance, "predicted")
        guards = [finite(state, covariance)]
        guards += [finite(column([each[0]]), each) for each in second]
        script.put(results, guards)
    return script.phase()


def moved_means(
    split: Jumping, plants: tuple[Plant, ...], means: tuple[ca.SX, ...], law: ca.SX
) -> list[ca.SX]:
    """E[x 1{mode}] one sample later, without inputs."""
    each = [plant.A @ means[i] + law[i] * plant.c for i, plant in enumerate(plants)]
    mixed = ca.SX(ca.DM(split.kernel)).T @ ca.horzcat(*each).T
    return [ca.densify(mixed[j, :].T) for j in range(split.modes)]


def whole(split: Jumping, state: ca.SX, packed: ca.SX, prefix: str) -> dict[str, ca.SX]:
    """State and covariance of x, which the split state ends with."""
    X = unpack(packed, split.size)
    return {
        f"{prefix}_state": state[split.own],
        f"{prefix}_covariance": pack(X[split.own, split.own]),
    }
