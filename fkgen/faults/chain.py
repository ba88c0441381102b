"""A plant whose matrices follow a Markov chain: what every fault is but a soft one.

Costa, Fragoso & Marques 2005 call it a Markov jump linear system. Faults of sensors and jumps
write their chain once; estimators and trials read it. The oracles translate specs on their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.problem.equations import Equations
from fkgen.problem.functions.reading import plain_mode
from fkgen.problem.model import plain_source
from fkgen.problem.probability import (
    Distribution,
    FirstLaw,
    Transition,
    period,
    resting_law,
    stationary_law,
    visited,
)
from fkgen.problem.text.discretise import Continuous
from fkgen.problem.text.expression import ZERO, Expression, Number, operation
from fkgen.problem.text.matrix import Matrix, plain_fields

#: Matrices of a mode, which a mode of ``faults.jump`` may state.
LETTERS = ("A", "B", "C", "D", "Q", "R", "c", "d")

#: Mean-square radii closer to one than this are not told from one.
MARGIN = 1e-9

Array = NDArray[np.float64]
Groups = tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mode:
    """x[k+1] = A x + B u + c + w and y[k] = C x + D u + d + v, with Cov(w) = Q and Cov(v) = R."""

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    Q: Matrix
    R: Matrix
    c: Matrix  # (n, 1)
    d: Matrix  # (p, 1)
    title: str = field(default="", compare=False)
    kept: tuple[int, ...] | None = None  # States that the mode has, if not all; the others are 0
    source: Continuous | None = None  # What A, B, c and Q were computed from, if time is continuous
    equations: Equations | None = None  # What is there in place of A, B, C, D, c and d

    @property
    def is_constant(self) -> bool:
        """Whether no entry depends on a parameter."""
        if self.equations is not None:
            return not (self.equations.names or self.Q.names or self.R.names)
        return all(getattr(self, letter).is_constant for letter in LETTERS)

    @property
    def silent(self) -> Mode:
        """The mode of a lost sample: y is noise alone."""
        if self.equations is not None:
            lost = replace(self.equations, h=(ZERO,) * len(self.equations.h))
            return replace(self, equations=lost, title=f"{self.title}, lost")
        C, D, d = (Matrix.zeros(*each.shape) for each in (self.C, self.D, self.d))
        return replace(self, C=C, D=D, d=d, title=f"{self.title}, lost")

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        if self.equations is not None:
            own = {"Q": self.Q.plain(), "R": self.R.plain()}
            return own | plain_mode(self.equations)
        table = plain_fields(self) | {key: getattr(self, key).plain_column() for key in "cd"}
        if self.source is not None:
            table |= plain_source(self.source)
        if self.kept is not None:
            table |= {key: _cut(table[key], key, self.kept) for key in "ABCQc"}
            table["states"] = list(self.kept)
        absent = ["title", "source", "kept", "equations", *([] if self.B.shape[1] else ["B", "D"])]
        return {key: entry for key, entry in table.items() if key not in absent}


def _cut(table: Any, letter: str, kept: tuple[int, ...]) -> object:
    """The rows and columns of some states."""
    rows = table if letter == "C" else [table[i] for i in kept]
    return [[row[j] for j in kept] for row in rows] if letter in "ACQ" else rows


@dataclass(frozen=True, slots=True)
class Channel:
    """On which samples are lost: Pr(j at k+1 | i at k) and the law of sample 0, (lost, arrived)."""

    transition: Transition
    initial: Distribution
    law: Matrix | None = None  # the transition where it depends on parameters
    first: FirstLaw | None = None  # and the law of sample 0

    @classmethod
    def of(cls, transition: ArrayLike, chain: Matrix | None = None) -> Channel:
        """The channel in its stationary law; in that after a loss if there are several."""
        P = np.asarray(transition, float)
        law = stationary_law(P)
        initial = tuple((P[0] if law is None else law).tolist())
        first = None if chain is None else resting_law(chain)
        return cls(tuple(map(tuple, P.tolist())), initial, chain, first)


@dataclass(frozen=True, slots=True)
class Lumping:
    """A coarser chain, whose modes are groups of modes of another."""

    groups: Groups
    shares: tuple[tuple[float, ...], ...]  # Pr(mode | its group), taken for a constant
    transition: Transition
    initial: Distribution
    unequal_successors: float  # how far the next group depends on more than this group
    unequal_shares: float  # how far the shares are no constants

    @property
    def defect(self) -> float:
        """Largest error of a probability that lumping makes; 0 if the groups are Markov."""
        return max(self.unequal_successors, self.unequal_shares)


@dataclass(frozen=True, slots=True)
class ModeChain:
    """Modes and the chain that they follow; modes with equal matrices share the objects."""

    modes: tuple[Mode, ...]
    transition: Transition  # Pr(j at k+1 | i at k)
    initial: Distribution  # of sample 0
    law: Matrix | None = None  # the transition where it depends on parameters
    #: The law of every sample is a row of it, with the parameters of that sample
    independent: bool = False
    first: FirstLaw | None = None  # initial where it depends on parameters

    @property
    def possible(self) -> Transition:
        """Positive where a mode can follow another one, whatever the parameters are."""
        if self.law is None:
            return self.transition
        return tuple(tuple(float(each != ZERO) for each in row) for row in self.law.rows)

    @property
    def begun(self) -> Distribution:
        """Positive where the chain can begin, whatever the parameters are."""
        if self.first is None:
            return self.initial
        if self.first.stated:
            return tuple(float(each != ZERO) for each in self.first.stated)
        law = stationary_law(self.possible)
        return self.initial if law is None else tuple(law.tolist())

    def times(self, channel: Channel) -> ModeChain:
        """The chain of pairs, first all modes of samples that arrive, then all of lost ones."""
        arrived_first = np.array(channel.transition)[::-1, ::-1]
        law = first = None
        if self.law is not None or channel.law is not None:
            of = self.law or Matrix.of(self.transition)
            arrival = channel.law or Matrix.of(channel.transition)
            both = (_products(a[::-1], p) for a in arrival.rows[::-1] for p in of.rows)
            law = Matrix(tuple(both))
        if self.first is not None or channel.first is not None:
            starts = _numbers(channel), _numbers(self)
            first = FirstLaw(_products(starts[0][::-1], starts[1]))  # both stay, if one is empty
        return ModeChain(
            (*self.modes, *(mode.silent for mode in self.modes)),
            tuple(map(tuple, np.kron(arrived_first, self.transition).tolist())),
            tuple(np.kron(channel.initial[::-1], self.initial).tolist()),
            law,
            first=first,
        )

    def alike(self, letters: str) -> Groups:
        """The modes, those with the same matrices together."""
        groups: dict[tuple[object, ...], list[int]] = {}
        for i, mode in enumerate(self.modes):
            key: list[object] = [getattr(mode, each) for each in letters]
            if mode.equations is not None:
                key += [mode.equations.said(f) for f, letter in ("fA", "hC") if letter in letters]
            groups.setdefault(tuple(key), []).append(i)
        return tuple(map(tuple, groups.values()))

    def lumped(self, groups: Groups) -> Lumping:
        """Take groups of modes for the modes of a chain."""
        if self.first is None:
            return lump(self.transition, self.initial, groups)
        begun = np.array(self.begun)
        return lump(self.transition, tuple((begun / begun.sum()).tolist()), groups)


def _numbers(chain: Channel | ModeChain) -> tuple[Expression, ...]:
    """The law of sample 0 as expressions."""
    return tuple(map(Number, chain.initial)) if chain.first is None else chain.first.stated


def _products(
    first: tuple[Expression, ...], second: tuple[Expression, ...]
) -> tuple[Expression, ...]:
    """Probabilities of pairs."""
    return tuple(operation("*", a, b) for a in first for b in second)


def lump(transition: Sequence[Distribution], initial: Distribution, groups: Groups) -> Lumping:
    """Take groups of modes for the modes of a chain, whether that is exact or not.

    Where it is not, shares are those of the stationary law, or of the start if there are several,
    or of all ways into the group.
    """
    P, start = np.array(transition), np.array(initial)
    reached, stationary = visited(P, start), stationary_law(P)
    laws = [start if stationary is None else stationary, start, P[reached].sum(axis=0)]
    shares = tuple(_shares(laws, list(group)) for group in groups)
    rows = [np.array(share) @ P[list(group)] for share, group in zip(shares, groups, strict=True)]
    successors, within = [0.0], [0.0]
    for share, group in zip(shares, groups, strict=True):
        members = list(group)
        seen = np.vstack([start, P[reached]])[:, members]
        within.append(float(np.abs(seen - np.outer(seen.sum(axis=1), share)).max()))
        following = P[[i for i in members if reached[i]]]
        for other in groups:
            into = following[:, list(other)].sum(axis=1)
            successors.append(float(np.ptp(into)) if into.size else 0.0)
    return Lumping(
        groups,
        shares,
        tuple(tuple(float(row[list(group)].sum()) for group in groups) for row in rows),
        tuple(float(start[list(group)].sum()) for group in groups),
        max(successors),
        max(within),
    )


def _shares(laws: Sequence[Array], members: list[int]) -> tuple[float, ...]:
    """Pr(member | group) of the first law in which the group is possible."""
    for law in laws:
        whole = law[members].sum()
        if whole > 0.0:
            first = [float(each / whole) for each in law[members[:-1]]]
            return (*first, 1.0 - sum(first))
    return (1.0, *(0.0 for _ in members[1:]))


def mean_square_radius(transition: Sequence[Sequence[float]], dynamics: Sequence[Array]) -> float:
    """Spectral radius of the operator that moves second moments; below 1: mean-square stable.

    Costa, Fragoso & Marques 2005, Theorem 3.9: block (j, i) is p_ij A_i (x) A_i.
    """
    P = np.asarray(transition, float)
    moved = [np.kron(A, A) for A in dynamics]
    blocks = [[P[i, j] * moved[i] for i in range(len(P))] for j in range(len(P))]
    return float(np.abs(np.linalg.eigvals(np.block(blocks))).max())


def is_ergodic(transition: Sequence[Sequence[float]]) -> bool:
    """Whether the law of the mode converges to one limit, wherever the chain starts."""
    return stationary_law(transition) is not None and period(transition) == 1
