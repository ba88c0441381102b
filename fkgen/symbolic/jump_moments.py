"""Moments of a jumping plant, and the covariance of its split noise: Lemma 3 and what follows.

Written as second moments of indicators around their prediction, so that nothing cancels; the rows
of x itself hold the plant's own noise only.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.symbolic.jumping import Jumping
from fkgen.symbolic.linalg import congruence, outer_lower, pack, sparse, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.script import Script


@dataclass(frozen=True, slots=True)
class Moments:
    """E[x x' 1{mode}], E[x 1{mode}] and Pr(mode), mode by mode; no first moments if not needed."""

    second: tuple[ca.SX, ...]
    first: tuple[ca.SX, ...]
    law: ca.SX


def moments_of(split: Jumping, symbols: dict[str, ca.SX], prefix: str) -> Moments:
    """The moments that are carried along, as matrices and columns."""
    n = split.base.nx
    second = ca.vertsplit(symbols[f"{prefix}mode_second_moment"], n * (n + 1) // 2)
    first: tuple[ca.SX, ...] = ()
    if split.means:
        first = tuple(ca.vertsplit(symbols[f"{prefix}mode_first_moment"], n))
    law = split.law(symbols) if prefix else _carried_law(split, symbols)
    return Moments(tuple(unpack(each, n) for each in second), first, law)


def _carried_law(split: Jumping, symbols: dict[str, ca.SX]) -> ca.SX:
    return split.law(symbols) if split.settled else symbols["mode_law"]


def next_law(split: Jumping, law: ca.SX) -> ca.SX:
    """Law of the mode one sample later, its rounding taken out of the sum."""
    if split.settled:
        return law
    moved = ca.SX(ca.DM(split.kernel)).T @ law
    return moved / ca.sum1(moved)


def total(matrices: list[ca.SX]) -> ca.SX:
    """Sum of matrices of one shape."""
    result = matrices[0]
    for matrix in matrices[1:]:
        result = result + matrix
    return result


def shared(matrices: list[ca.SX], weights: list[ca.SX]) -> ca.SX:
    """Weighted sum; weights of a matrix that several modes have in common are added first."""
    distinct: dict[int, tuple[ca.SX, ca.SX]] = {}
    for matrix, weight in zip(matrices, weights, strict=True):
        known = distinct.get(id(matrix))
        distinct[id(matrix)] = (matrix, weight if known is None else known[1] + weight)
    return total([weight * matrix for matrix, weight in distinct.values()])


def offset_of(plant: Plant, u: ca.SX) -> ca.SX:
    """What is known and added to the state: B u + c."""
    return plant.B @ u + plant.c


def moved_moments(
    script: Script, split: Jumping, plants: tuple[Plant, ...], now: Moments, u: ca.SX
) -> list[ca.SX]:
    """Second moment of (A x + b, 1) 1{mode}, or of A x 1{mode}, mode by mode."""
    n, result = split.base.nx, []
    for i, plant in enumerate(plants):
        if split.ones:
            last = ca.horzcat(ca.SX(1, n), ca.SX(1))
            through = sparse(ca.vertcat(ca.horzcat(plant.A, offset_of(plant, u)), last))
            q = now.first[i]
            before = ca.blockcat(now.second[i], q, q.T, now.law[i])
        else:
            through, before = plant.A, now.second[i]
        moved = script.let(f"moved_moment_{i}", congruence(through, before))
        result.append(unpack(moved, split.width))
    return result


def plant_noise(split: Jumping, plants: tuple[Plant, ...], law: ca.SX) -> list[ca.SX]:
    """sum_i p_ij pi_i Q_i: what the plant's own noise adds in the step to each mode."""
    P = split.kernel
    return [
        shared([p.Q for p in plants], [float(P[i, j]) * law[i] for i in range(split.modes)])
        for j in range(split.modes)
    ]


def later_moments(
    split: Jumping, moved: list[ca.SX], noise: list[ca.SX]
) -> tuple[list[ca.SX], list[ca.SX]]:
    """Packed second and first moments one sample later."""
    P, n, N = split.kernel, split.base.nx, split.modes
    mixed = [
        total([float(P[i, j]) * moved[i] for i in range(N) if P[i, j]] or [0 * moved[0]])
        for j in range(N)
    ]
    second = [pack(mixed[j][:n, :n] + noise[j]) for j in range(N)]
    return second, [ca.densify(each[:n, n]) for each in mixed] if split.ones else []


def split_noise(split: Jumping, moved: list[ca.SX], noise: list[ca.SX]) -> ca.SX:
    """Covariance of the noise of the split state, as a matrix of which the lower half counts."""
    P, w, n = split.transition, split.width, split.base.nx
    count = split.parts
    parts = [share * moment for share in split.shares for moment in moved]
    own = [share * each for share in split.shares for each in noise]
    W = ca.SX(split.size, split.size)
    for j in range(count - 1):
        at = slice(j * w, j * w + n)
        W[split.own, at] = own[j]
        for k in range(j + 1):
            shares = [P[i, j] * ((1.0 - P[i, j]) if j == k else -P[i, k]) for i in range(count)]
            terms = [float(s) * part for s, part in zip(shares, parts, strict=True) if s]
            block = total(terms) if terms else ca.SX(w, w)
            if j == k:
                block[:n, :n] = block[:n, :n] + own[j]
            W[j * w : j * w + w, k * w : k * w + w] = block
    W[split.own, split.own] = total(noise)
    return sparse(W)


def unconditional(split: Jumping, now: Moments) -> tuple[ca.SX, ca.SX]:
    """Mean and packed covariance of the split state without any measurement."""
    n, w = split.base.nx, split.width
    mean = ca.SX(split.size, 1)
    X = ca.SX(split.size, split.size)
    means, seconds = [], []
    for share in split.shares:
        for i in range(split.modes):
            q, pi = share * now.first[i], share * now.law[i]
            Z = share * now.second[i]
            means.append(ca.vertcat(q, pi) if split.ones else q)
            seconds.append(ca.blockcat(Z, q, q.T, pi) if split.ones else Z)
    for i in range(split.parts - 1):
        mean[i * w : (i + 1) * w] = means[i]
        X[i * w : (i + 1) * w, i * w : (i + 1) * w] = seconds[i]
        X[split.own, i * w : (i + 1) * w] = seconds[i][:n, :]
    mean[split.own] = total([each[:n] for each in means])
    X[split.own, split.own] = total([each[:n, :n] for each in seconds])
    spread = outer_lower(mean, mean)
    lower = [X[i, j] for i, j in triangle(split.size)]
    return mean, ca.densify(ca.vertcat(*lower)) - spread
