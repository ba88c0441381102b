"""Linearise a plant where its estimate is: f and h there, and derivatives in place of A and C.

A plant with matrices passes through unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.lifting.equations import Lifted
from fkgen.symbolic.linalg import congruence
from fkgen.symbolic.plant import Plant


def seen_from(
    builder: PhaseBuilder, plants: Sequence[Plant], states: Sequence[ca.SX], u: ca.SX, tag: str = ""
) -> tuple[Plant, ...]:
    """Plants with h, C and D at a state each; what they have in common is computed once."""
    found = _evaluated(builder, plants, states, u, (f"seen{tag}", ("seen", "C", "D", "seen_by")))
    demand_decided(builder, [own[i] for own in found if own is not None for i in (0, 3)])
    return tuple(
        plant if own is None else replace(plant, seen=own[0], C=own[1], D=own[2])
        for plant, own in zip(plants, found, strict=True)
    )


def moved_from(
    builder: PhaseBuilder, plants: Sequence[Plant], states: Sequence[ca.SX], u: ca.SX, tag: str = ""
) -> tuple[Plant, ...]:
    """Plants with f, A, B at a state each, and what the noises that enter through f add to P."""
    stirred = {id(plant.lifted): plant.lifted for plant in plants if plant.lifted is not None}
    for lifted in stirred.values():
        demand_variances(builder, lifted)
    letters = ("moved", "A", "B", "G", "moved_by")
    found = _evaluated(builder, plants, states, u, (f"moved{tag}", letters))
    demand_decided(builder, [own[4] for own in found if own is not None])
    moved = []
    for plant, own in zip(plants, found, strict=True):
        if own is None or plant.lifted is None:
            moved.append(plant)
            continue
        G = spread = None
        if own[3].nnz():
            G, spread = own[3], congruence(own[3], ca.diag(plant.lifted.variances))
        moved.append(replace(plant, moved=own[0], A=own[1], B=own[2], spread=spread, G=G))
    return tuple(moved)


def demand_decided(builder: PhaseBuilder, columns: Sequence[ca.SX]) -> None:
    """Refuse the sample where h, or what f and h decide by, has no value."""
    entries = (each[i] for each in columns for i in range(each.numel()))
    values = {value.element_hash(): value for value in entries}
    builder.demand(Kind.FINITE, [*values.values()], Status.RESULT_NOT_FINITE)


def demand_variances(builder: PhaseBuilder, lifted: Lifted) -> None:
    """Refuse noises that enter through f with a variance below zero."""
    variances = ca.vertsplit(lifted.variances) if lifted.variances.numel() else []
    builder.demand(Kind.NONNEGATIVE, variances, Status.PARAMETER_OUT_OF_RANGE)


def evaluated(
    builder: PhaseBuilder, plant: Plant, state: ca.SX, u: ca.SX, named: tuple[str, tuple[str, ...]]
) -> list[ca.SX]:
    """Some of the expressions of a plant with f and h, by their letters, at a state."""
    (found,) = _evaluated(builder, [plant], [state], u, named)
    if found is None:
        raise InternalError("a plant with matrices is linear everywhere")
    return found


def _evaluated(
    builder: PhaseBuilder,
    plants: Sequence[Plant],
    states: Sequence[ca.SX],
    u: ca.SX,
    named: tuple[str, tuple[str, ...]],
) -> list[list[ca.SX] | None]:
    """Expressions of each plant at its state, named; None for a plant with matrices."""
    name, letters = named
    values: list[ca.SX] = []
    for plant, state in zip(plants, states, strict=True):
        if plant.lifted is not None:
            own = [getattr(plant.lifted, letter) for letter in letters]
            values += ca.substitute(own, [plant.lifted.x, plant.lifted.u], [state, u])
    with builder.titled("linearisation"):
        ready = iter(builder.name_distinct(name, values))
    return [None if plant.lifted is None else [next(ready) for _ in letters] for plant in plants]
