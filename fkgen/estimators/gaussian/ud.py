"""Covariances as P = U D U': U unit upper triangular, D diagonal and never negative.

What is stored are U and D, so P is positive semidefinite whatever is rounded: Bierman 1977,
*Factorization Methods for Discrete Sequential Estimation*, ch. V-VII; Thornton 1976.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status, triangle
from fkgen.symbolic.linalg import (
    cleared,
    column,
    congruence,
    is_zero,
    operations,
    sparse,
    total,
    unpack,
)
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import prior_symbols
from fkgen.symbolic.recursion import Phase

#: Up to here a variance is taken for 0: the reciprocal of what is larger does not overflow.
LEAST = {"double": 1e-300, "float": 1e-36}

#: Share of a variance below which what is left of it is rounding, for each row of the matrix.
DUST = {"double": 2.0**-52, "float": 2.0**-23}


@dataclass(frozen=True, slots=True)
class Factors:
    """U and D of one covariance; their row i is about state ``order[i]``."""

    unit: ca.SX  # (n, n)
    scale: ca.SX  # (n,)
    order: tuple[int, ...]
    scalar: str

    @classmethod
    def of(cls, packed: ca.SX, order: Sequence[int], scalar: str) -> Factors:
        """What is packed by columns of U, with D in place of its diagonal."""
        unit, scale = ca.SX.eye(len(order)), ca.SX(len(order), 1)
        for at, (j, i) in enumerate(triangle(len(order))):
            if i == j:
                scale[j] = packed[at]
            elif not is_zero(packed[at]):
                unit[i, j] = packed[at]
        return cls(unit, scale, tuple(order), scalar)

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.order)

    @property
    def packed(self) -> ca.SX:
        """As a column, by columns of U."""
        pairs = triangle(self.size)
        return column([self.scale[j] if i == j else self.unit[i, j] for j, i in pairs])

    def named(self, builder: PhaseBuilder, name: str) -> Factors:
        """The same, computed once; what is 0 by structure stays so."""
        zeros = [at for at, entry in enumerate(ca.vertsplit(self.packed)) if is_zero(entry)]
        named = cleared(builder.define(name, self.packed), zeros)
        return Factors.of(named, self.order, self.scalar)

    def covariance(self) -> ca.SX:
        """P, packed: sums of few roundings, so that every entry is right to a unit or two."""
        n, place = self.size, {state: at for at, state in enumerate(self.order)}
        scaled = self.unit @ ca.diag(self.scale)
        entries = []
        for a, b in triangle(n):
            i, j = sorted((place[a], place[b]))
            terms = [self.unit[i, k] * scaled[j, k] for k in range(j, n)]
            entries.append(_balanced([each for each in terms if not is_zero(each)]))
        return column(entries)

    def in_rows(self) -> ca.SX:
        """U with its rows in the order of states."""
        return self.unit[[self.order.index(i) for i in range(self.size)], :]

    def seen(self, C: ca.SX) -> ca.SX:
        """C P C', packed."""
        through = sparse(C[:, list(self.order)] @ self.unit)
        scaled = through @ ca.diag(self.scale)
        return column([ca.mtimes(scaled[i, :], through[j, :].T) for i, j in triangle(C.shape[0])])

    def joined(self, covariance: ca.SX) -> Factors:
        """With numbers beside the state that it knows nothing of."""
        n, r = self.size, covariance.shape[0]
        columns, weights = columns_of(covariance, self.scalar)
        other = Factors(ca.SX.eye(r), ca.SX(r, 1), tuple(range(r)), self.scalar)
        other = other.moved(sparse(ca.SX(r, r)), columns, weights)
        order = (*self.order, *(n + i for i in range(r)))
        unit = ca.diagcat(self.unit, other.unit)
        return Factors(unit, ca.vertcat(self.scale, other.scale), order, self.scalar)

    def moved(
        self, M: ca.SX, columns: ca.SX, weights: ca.SX, order: Sequence[int] | None = None
    ) -> Factors:
        """Those of M P M' + the sum of ``weights[k]`` times the square of column k.

        Gram-Schmidt of [M U, columns] (Thornton); where M U is upper triangular already, columns
        are added one by one (Agee & Turner). ``order`` is that of the rows of M afterwards.
        """
        order = self.order if order is None else tuple(order)
        rows = list(order)
        carried = sparse(M[rows, list(self.order)] @ self.unit)
        added = sparse(columns[rows, :])
        ways = [_orthogonal(carried, self.scale, added, weights, self.scalar)]
        if _is_triangular(carried):
            ways.append(_grown(carried, self.scale, added, weights, self.scalar))
        found = [Factors(unit, scale, order, self.scalar) for unit, scale in ways]
        return min(found, key=lambda each: operations(each.packed))


def unpacked(held: ca.SX | Factors, n: int) -> ca.SX | Factors:
    """A packed covariance as a matrix; factors as they are."""
    return held if isinstance(held, Factors) else unpack(held, n)


def seen_through(C: ca.SX, held: ca.SX | Factors) -> ca.SX:
    """C P C', packed, of a covariance that is a matrix or factors."""
    return held.seen(C) if isinstance(held, Factors) else congruence(C, held)


@dataclass(frozen=True, slots=True)
class Wide:
    """A covariance as factors and columns beside them, of which it is the sum of squares."""

    base: Factors
    columns: ca.SX  # (n, k), with a weight each
    weights: ca.SX  # (k, 1)

    @property
    def order(self) -> tuple[int, ...]:
        """That of the factors."""
        return self.base.order

    @property
    def scalar(self) -> str:
        """That of the factors."""
        return self.base.scalar

    def moved(
        self, M: ca.SX, columns: ca.SX, weights: ca.SX, order: Sequence[int] | None = None
    ) -> Factors:
        """Factors of what a map makes of it, with columns added."""
        columns = ca.horzcat(sparse(M @ self.columns), columns)
        return self.base.moved(M, columns, ca.vertcat(self.weights, weights), order)

    def narrow(self) -> Factors:
        """Its factors."""
        n = self.base.size
        return self.moved(ca.SX.eye(n), ca.SX(n, 0), ca.SX(0, 1))


def merged(
    weights: Sequence[ca.SX], parts: Sequence[tuple[ca.SX, Factors]], *, spread: bool = True
) -> tuple[ca.SX, Wide]:
    """Mean and covariance of a mixture of Gaussians, whose factors have one order.

    Nothing is subtracted but means: that of the first from the others, with weights that sum to 1.
    """
    (first, base), *others = parts
    apart = [each - first for each, _ in others]
    shift = sum((w * d for w, d in zip(weights[1:], apart, strict=True)), ca.SX(*first.shape))
    columns = [ca.SX(base.size, 0)]
    sizes = [ca.SX(0, 1)]
    for weight, (_, held) in zip(weights[1:], others, strict=True):
        columns.append(held.in_rows())
        sizes.append(weight * held.scale)
    if spread and others:
        columns += [-shift, *(each - shift for each in apart)]
        sizes += weights
    scaled = Factors(base.unit, weights[0] * base.scale, base.order, base.scalar)
    return first + shift, Wide(scaled, ca.horzcat(*columns), ca.vertcat(*sizes))


def packed_factors(several: Iterable[Factors | None]) -> ca.SX:
    """Factors of several covariances, one after the other."""
    return ca.vertcat(*(each.packed for each in several if each is not None))


def _balanced(terms: list[ca.SX]) -> ca.SX:
    """A sum whose longest chain is short."""
    if len(terms) <= 2:
        return total(terms) if terms else ca.SX(0)
    half = len(terms) // 2
    return _balanced(terms[:half]) + _balanced(terms[half:])


def reciprocal(value: ca.SX, scalar: str, *, positive: bool = False) -> tuple[ca.SX, ca.SX]:
    """1 / value, and 0; where a value that is not negative is 0, 1 and 1."""
    if positive or is_positive(value, scalar):
        return 1 / value, ca.SX(0)
    nothing = value <= LEAST[scalar]
    return 1 / (value + nothing), nothing


def is_positive(value: ca.SX, scalar: str) -> bool:
    """Whether a value is a constant above 0."""
    return bool(value.is_constant()) and float(value) > LEAST[scalar]


def _is_triangular(M: ca.SX) -> bool:
    """Whether a matrix is upper triangular with constants on its diagonal, none of them 0."""
    if M.shape[0] != M.shape[1] or not M.sparsity().is_triu():
        return False
    diagonal = [M[i, i] for i in range(M.shape[0])]
    return all(each.is_constant() and not is_zero(each) for each in diagonal)


def _orthogonal(
    carried: ca.SX, scale: ca.SX, added: ca.SX, weights: ca.SX, scalar: str
) -> tuple[ca.SX, ca.SX]:
    """Modified weighted Gram-Schmidt of the rows of [carried, added], from the last one up."""
    whole, n = ca.horzcat(carried, added), carried.shape[0]
    weight = [*ca.vertsplit(scale), *(weights[k] for k in range(added.shape[1]))]
    rows = [
        {k: whole[i, k] for k in range(whole.shape[1]) if not is_zero(whole[i, k])}
        for i in range(n)
    ]
    unit, left = ca.SX.eye(n), ca.SX(n, 1)
    for j in reversed(range(n)):
        if not rows[j]:
            continue
        scaled = {k: weight[k] * value for k, value in rows[j].items()}
        terms = [value * scaled[k] for k, value in rows[j].items()]
        left[j] = total(terms)
        positive = any(is_positive(each, scalar) for each in terms)
        inverse, _ = reciprocal(left[j], scalar, positive=positive)
        for i in range(j):
            common = sorted(rows[i].keys() & rows[j].keys())
            if not common:
                continue
            share = total(rows[i][k] * scaled[k] for k in common) * inverse
            unit[i, j] = share
            for k, value in rows[j].items():
                rest = -share * value if k not in rows[i] else rows[i][k] - share * value
                rows[i][k] = rest
    return sparse(unit), left


def _grown(
    carried: ca.SX, scale: ca.SX, added: ca.SX, weights: ca.SX, scalar: str
) -> tuple[ca.SX, ca.SX]:
    """U D U' of a triangular U, with one column after the other added: rank one, nothing lost."""
    n, diagonal = carried.shape[0], [float(carried[i, i]) for i in range(carried.shape[0])]
    unit = sparse(carried @ ca.SX(ca.DM(np.diag(1.0 / np.array(diagonal)))))
    left = [scale[i] * diagonal[i] ** 2 for i in range(n)]
    positive = set[int]()  # by what was added to them
    first = [max(added[:, k].sparsity().row(), default=-1) for k in range(added.shape[1])]
    for at in sorted(range(added.shape[1]), key=first.__getitem__):
        rest, weight = {i: added[i, at] for i in range(n) if not is_zero(added[i, at])}, weights[at]
        for j in reversed(range(n)):
            if j not in rest or is_zero(weight):
                continue
            own = rest.pop(j)
            share = weight * own
            grown = left[j] + share * own
            positive |= {j} if is_positive(share * own, scalar) else set()
            inverse, nothing = reciprocal(grown, scalar, positive=j in positive)
            share = share * inverse
            weight = weight * (left[j] * inverse + nothing)
            left[j] = grown
            for i in range(j):
                if is_zero(unit[i, j]) and i not in rest:
                    continue
                rest[i] = rest.get(i, ca.SX(0)) - own * unit[i, j]
                unit[i, j] = unit[i, j] + share * rest[i]
    return sparse(unit), ca.vertcat(*left)


def factors_of(P: ca.SX, order: Sequence[int], scalar: str) -> tuple[Factors, ca.SX]:
    """U D U' of a semidefinite matrix, and what is negative where it is none, (n, 1)."""
    n, rows = len(order), list(order)
    left, unit = ca.SX(P[rows, rows]), ca.SX.eye(n)
    own, scale, short = ca.diag(left), ca.SX(n, 1), ca.SX(n, 1)
    dust, reduced = 2.0 * n * DUST[scalar], set[int]()
    for j in reversed(range(n)):
        if is_zero(own[j]):
            continue
        scale[j] = short[j] = left[j, j]
        significant = ca.SX(1)
        if j in reduced:  # what is left may be rounding
            significant = left[j, j] > dust * own[j]
            scale[j] = ca.SX.binary(ca.OP_IF_ELSE_ZERO, significant, left[j, j])
            short[j] = left[j, j] + dust * own[j]
        inverse, _ = reciprocal(scale[j], scalar)
        shares = {i: left[i, j] * inverse for i in range(j) if not is_zero(left[i, j])}
        for i, share in shares.items():
            unit[i, j] = share * significant
        for i in shares:
            for k in (k for k in shares if k <= i):
                left[i, k] = left[k, i] = left[i, k] - unit[i, j] * left[k, j]
        reduced |= shares.keys()
    return Factors(sparse(unit), scale, tuple(order), scalar), short


def columns_of(covariance: ca.SX, scalar: str) -> tuple[ca.SX, ca.SX]:
    """Columns and weights of which a semidefinite matrix is the sum of squares; few of them."""
    covariance = sparse(covariance)
    n = covariance.shape[0]
    if covariance.is_constant():
        columns, weights = _constant_columns(np.array(ca.DM(covariance)))
        return sparse(ca.SX(ca.DM(columns))), ca.SX(ca.DM(weights))
    found, _ = factors_of(covariance, range(n), scalar)
    kept = [i for i in range(n) if not is_zero(found.scale[i])]
    return found.unit[:, kept], found.scale[kept]


def noise_columns(Q: ca.SX, order: Sequence[int], scalar: str) -> tuple[ca.SX, ca.SX]:
    """The same, triangular in the order of factors."""
    columns, weights = columns_of(sparse(Q)[list(order), list(order)], scalar)
    return columns[[order.index(i) for i in range(len(order))], :], weights


def _constant_columns(
    covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    left, own = np.array(covariance), np.diag(covariance).copy()
    n = len(own)
    columns, weights = [], []
    for j in reversed(range(n)):
        pivot = float(left[j, j])
        if pivot <= 4.0 * n * DUST["double"] * own[j]:
            continue
        whole = np.where(np.arange(n) <= j, left[:, j] / pivot, 0.0)
        columns.append(whole)
        weights.append(pivot)
        left -= pivot * np.outer(whole, whole)
    if not columns:
        return np.zeros((n, 0)), np.zeros(0)
    return np.array(columns).T, np.array(weights)


def order_of(plants: Sequence[Plant]) -> tuple[int, ...]:
    """The order of states in which factors cost least.

    One in which every A is upper triangular, measured states late, if there is one.
    """
    n = plants[0].ne
    before: dict[int, set[int]] = {i: set() for i in range(n)}
    for plant in plants:
        for i, j in zip(*plant.A.sparsity().get_triplet(), strict=True):
            if i != j:
                before[j].add(i)
    seen = {j for plant in plants for j in plant.C.sparsity().get_triplet()[1]}
    found: list[int] = []
    while len(found) < n:
        ready = [i for i in range(n) if i not in found and before[i] <= set(found)]
        if not ready:
            others = [i for i in range(n) if i not in seen]
            return min(tuple(range(n)), (*others, *sorted(seen)), key=partial(_cost, plants[0]))
        found.append(min(ready, key=lambda i: (i in seen, i)))
    return tuple(found)


def _cost(plant: Plant, order: tuple[int, ...]) -> int:
    """Operations of factors in this order: of the prediction, and about those of rows of y."""
    n, scalar = plant.ne, plant.scalar
    P = Factors.of(ca.SX.sym("P", len(triangle(n))), order, scalar)
    columns, weights = noise_columns(plant.Q, order, scalar)
    reached = [
        n - min(map(order.index, row.sparsity().get_triplet()[1]), default=n)
        for row in ca.vertsplit(plant.C)
    ]
    rows = sum(reach * (2 * reach + 8) for reach in reached)
    return operations(P.moved(plant.A, columns, weights).packed) + rows


def begun(
    builder: PhaseBuilder,
    P: ca.SX,
    how: tuple[Sequence[int], str],
    kept: Sequence[int] | None = None,
) -> ca.SX:
    """Factors of a packed prior, in an order and a scalar, or of some rows of it, 0 elsewhere."""
    n, (order, scalar) = len(how[0]), how
    covariance = unpack(P, n)
    if kept is not None:
        whole, rows = ca.SX(n, n), list(kept)
        whole[rows, rows] = covariance[rows, rows]
        covariance = sparse(whole)
    found, short = factors_of(covariance, order, scalar)
    builder.demand(Kind.NONNEGATIVE, ca.vertsplit(short), Status.NOT_POSITIVE_DEFINITE)
    return found.packed


def started(
    spec: Spec, symbols: Mapping[str, ca.SX], ports: Mapping[str, int], order: Sequence[int]
) -> Phase:
    """The phase that factors the prior, so many times for each of these ports."""
    given = prior_symbols(spec.model)
    builder = PhaseBuilder({**symbols, **given})
    found = begun(builder, given["P"], (order, spec.code.scalar))
    with builder.titled("factors of the prior"):
        builder.assign({name: ca.repmat(found, count) for name, count in ports.items()})
    return builder.phase()


def factors_note(order: Sequence[int], spec: Spec) -> tuple[str, ...]:
    """What the header says about the order of rows of factors, where it is not that of states."""
    names = [signal.name for signal in spec.model.states]
    if list(order) == sorted(order) or len(names) != len(order):
        return ()
    return (f"rows of factors: {', '.join(names[i] for i in order)}",)
