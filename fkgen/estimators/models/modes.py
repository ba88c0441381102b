"""The modes of a switching filter: conditions of the sensor, or plants between which one jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.sensing import is_entangled, mode_plants, mode_titles
from fkgen.estimators.lmmse.jumping import jump_modes_of
from fkgen.estimators.models.markov import Kernel
from fkgen.faults import JumpFaults, JumpMode, SensorFaults
from fkgen.faults.lumping import merged
from fkgen.problem import Matrix, Model, Spec
from fkgen.problem.probability import visited
from fkgen.symbolic.plant import Plant, plant_of


@dataclass(frozen=True, slots=True)
class Variant:
    """One condition of the plant within a mode: its share of the mode, and the plant in it."""

    title: str
    share: float
    plant: Plant


@dataclass(frozen=True, slots=True)
class Modes:
    """The modes of a switching filter.

    Attributes
    ----------
    variants : tuple of tuple of Variant
        Per mode; several where a mode lumps conditions together that only the density tells apart.
        They move alike.
    kernel : N tuples of N floats
    initial : tuple of N floats
        Law of the mode at sample 0.
    entangled : bool
        The variants of a mode lead to different estimates, because R correlates the rows that they
        differ in with others.
    """

    variants: tuple[tuple[Variant, ...], ...]
    kernel: Kernel
    initial: tuple[float, ...]
    entangled: bool

    @property
    def size(self) -> int:
        """Number N of modes."""
        return len(self.variants)

    @property
    def note(self) -> str:
        """What the modes are, in their order."""
        names = [" or ".join(each.title for each in mode) for mode in self.variants]
        return "modes: " + "; ".join(f"{i} = {name}" for i, name in enumerate(names))

    @property
    def predicted_as(self) -> tuple[int, ...]:
        """Per mode the mode whose prediction it takes: its own.

        A mode that can never come takes that of the first that can, so that nothing grows unseen.
        """
        possible = visited(self.kernel, self.initial)
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
        own = [probability[j] for j, each in enumerate(plants) if id(each.Q) == key]
        total += sum(own[1:], start=own[0]) * Q
    return total


def _identity(plant: Plant, letters: str) -> tuple[int, ...]:
    """What tells two plants apart: matrices that are equal are the same object."""
    return tuple(id(getattr(plant, letter)) for letter in letters)


def plants_of(spec: Spec) -> tuple[Plant, ...]:
    """What the modes are made of: the plants of jump faults, or the one whose sensor fails."""
    return (plant_of(spec),) if spec.faults.jump is None else jump_modes_of(spec).plants


def modes_of(spec: Spec, plants: Sequence[Plant]) -> Modes:
    """The modes that a spec states, made of `plants_of` it or of the same with named entries."""
    if spec.faults.jump is not None:
        return _jumping(plants, spec.faults.jump, spec.model)
    if spec.faults.sensor is None:
        raise InternalError(f"{spec.filter.family} without modes")
    return _sensing(plants[0], spec.faults.sensor, spec.filter.option("modes", 4))


def _jumping(plants: Sequence[Plant], faults: JumpFaults, model: Model) -> Modes:
    """Every mode is a plant of its own."""
    variants = tuple(
        (Variant(_title(mode, model), 1.0, plant),)
        for mode, plant in zip(faults.modes, plants, strict=True)
    )
    return Modes(variants, faults.transition, faults.initial, entangled=False)


def _title(mode: JumpMode, model: Model) -> str:
    """What tells a mode from the model."""
    own = [letter for letter in "ABCDQR" if getattr(mode, letter) != getattr(model, letter)]
    own += ["c"] if mode.c != Matrix.zeros(model.nx, 1) else []
    return "with its own " + ", ".join(own) if own else "the model"


def _sensing(plant: Plant, faults: SensorFaults, count: int) -> Modes:
    """The four modes of (gamma, delta), or three with the mixture of both noises at gamma = 0."""
    titles, plants = mode_titles(faults), mode_plants(plant, faults)
    single = [Variant(title, 1.0, each) for title, each in zip(titles, plants, strict=True)]
    entangled = is_entangled(plant, faults.rows)
    if count == len(single):
        return Modes(tuple((each,) for each in single), faults.kernel, faults.initial, entangled)
    lumped = merged(faults.kernel, faults.initial)
    silent = tuple(
        replace(variant, share=share)
        for variant, share in zip(single[2:], lumped.shares, strict=True)
        if share > 0.0
    )
    return Modes(
        (*((each,) for each in single[:2]), silent), lumped.kernel, lumped.initial, entangled
    )
