"""Modes of a sensor or of the plant that follow a Markov chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from fkgen.estimators.models.merge import Gaussian
from fkgen.estimators.models.weights import (
    Kernel,
    Prediction,
    advance,
    advance_varying,
    drawn_anew,
)
from fkgen.faults.chain import ModeChain
from fkgen.problem import Spec
from fkgen.problem.probability import visited
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.linalg import pack, unpack
from fkgen.symbolic.plant import Plant


@dataclass(frozen=True, slots=True)
class Variant:
    """One condition of the plant within a mode: its share of the mode, and the plant in it."""

    title: str
    share: float
    plant: Plant


@dataclass(frozen=True, slots=True)
class Modes:
    """The modes of a switching filter.

    A mode has several variants where it lumps conditions together that only the density tells
    apart; they move alike. They are entangled where they lead to different estimates, because R
    correlates the rows that they differ in with others.
    """

    variants: tuple[tuple[Variant, ...], ...]
    kernel: Kernel
    initial: tuple[float, ...]  # at sample 0
    entangled: bool
    chain: ModeChain

    @classmethod
    def of(cls, spec: Spec, plants: Sequence[Plant]) -> Modes:
        """The modes that a spec states, made of the plants of its chain.

        Three modes for four conditions of a sensor: the mixture of both noises at gamma = 0.
        """
        chain, sensor = spec.faults.chain(spec.model), spec.faults.sensor
        count = len(chain.modes)
        lumps = sensor if sensor is not None and spec.filter.option("modes", 4) < count else None
        found = chain.lumped(tuple((i,) for i in range(count))) if lumps is None else lumps.lumped()
        variants = tuple(
            tuple(
                Variant(chain.modes[i].title, share, plants[i])
                for i, share in zip(group, shares, strict=True)
                if share > 0.0
            )
            for group, shares in zip(found.groups, found.shares, strict=True)
        )
        entangled = lumps is not None and lumps.entangles(spec.model.R)
        return cls(variants, found.transition, found.initial, entangled, chain)

    def varying(self, builder: PhaseBuilder) -> tuple[tuple[ca.SX, ...], ...]:
        """The kernel of a sample where it depends on parameters, named once."""
        if self.chain.law is None:
            return ()
        law = law_of(self.chain.law, self.variants[0][0].plant.parameters)
        named = builder.name_entries("kernel", law[:1, :] if self.chain.independent else law)
        return tuple(tuple(ca.horzsplit(row)) for row in ca.vertsplit(named))

    def advanced(
        self, builder: PhaseBuilder, now: tuple[ca.SX, ca.SX], scalar: str, *, mixing: bool
    ) -> Prediction:
        """The law of the next mode from ``now`` = (probability, logarithm)."""
        rows = self.varying(builder)
        if self.chain.independent:
            return drawn_anew(rows[0], now[0], scalar)
        if rows:
            return advance_varying(builder, rows, now, scalar)
        return advance(builder, self.kernel, now, scalar, mixing=mixing)

    @property
    def forgets(self) -> bool:
        """Whether some mode comes after every mode alike: it goes on from what all say together."""
        rows = zip(*self.kernel, strict=True)
        return self.chain.independent or any(len(set(entries)) == 1 for entries in rows)

    @property
    def note(self) -> str:
        """What the modes are, in their order."""
        names = [" or ".join(each.title for each in mode) for mode in self.variants]
        return "modes: " + "; ".join(f"{i} = {name}" for i, name in enumerate(names))

    @property
    def predicted_as(self) -> tuple[int, ...]:
        """Index of the mode whose prediction each mode uses.

        Unreachable modes reuse a reachable one so that their covariance cannot overflow.
        """
        constant = self.chain.law is None
        begun = self.initial if self.chain.first is None else self.chain.begun
        possible = visited(self.kernel if constant else self.chain.possible, begun)
        first = int(np.argmax(possible))
        return tuple(j if seen else first for j, seen in enumerate(possible))

    @property
    def motions(self) -> tuple[Plant, ...]:
        """Per mode a plant that moves as in this mode; modes that move alike have the same one."""
        known: dict[tuple[int, ...], Plant] = {}
        plants = [mode[0].plant for mode in self.variants]
        return tuple(known.setdefault(_identity(each, "ABcQ"), each) for each in plants)


def move_alike(plants: Sequence[Plant]) -> bool:
    """Whether plants differ in nothing but Q as far as x[k+1] is concerned."""
    return len({_identity(each, "ABc") for each in plants}) == 1


def mean_noise(plants: Sequence[Plant], probability: ca.SX) -> ca.SX:
    """Q if each of the plants has a probability."""
    distinct = {id(each.Q): each.Q for each in plants}
    if len(distinct) == 1:
        return plants[0].Q
    total = ca.SX(*plants[0].Q.shape)
    for key, Q in distinct.items():
        total += sum(probability[j] for j, each in enumerate(plants) if id(each.Q) == key) * Q
    return total


def _identity(plant: Plant, letters: str) -> tuple[int, ...]:
    """What tells two plants apart: matrices that are equal are the same object."""
    return tuple(id(getattr(plant, letter)) for letter in letters)


def of_states(prior: Gaussian, kept: tuple[int, ...] | None) -> Gaussian:
    """A prediction with 0, known, in place of the states that its mode does not have."""
    if kept is None:
        return prior
    which, n = list(kept), prior[0].numel()
    state, covariance = ca.SX(n, 1), ca.SX(n, n)
    state[which] = prior[0][which]
    covariance[which, which] = unpack(prior[1], n)[which, which]
    return ca.densify(state), pack(covariance)
