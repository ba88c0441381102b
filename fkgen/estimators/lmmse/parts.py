"""Parts of a state that nothing couples: covariances between them are 0 and never computed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import actuation_of
from fkgen.problem import Spec
from fkgen.problem.table.place import Place
from fkgen.symbolic.index import Target
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.lifting.expressions import lift
from fkgen.symbolic.linalg import between
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import prior_symbols
from fkgen.symbolic.recursion import Block, Guard, Phase


def in_parts(spec: Spec, plant: Plant, sensed: Plant) -> Plant:
    """The plant with the part that each row of the covariance belongs to, in straight lines.

    Nothing in A, C, Q, R, S, P0 and in inputs that are random reaches from one into another;
    ``sensed`` has C and R as rows are measured.

    Raises
    ------
    SpecError
        The state is coupled as a whole.
    """
    ties = ca.SX.eye(plant.ne)
    for group in _coupled(spec, plant, sensed):
        ties[list(group), list(group)] = 1
    count, order, borders = ties.sparsity().scc()
    if count == 1:
        at = Place(spec.file, "code").entry("decoupled")
        raise at.error("true, for a state that is coupled as a whole", "false, or no such entry")
    parts = [0] * plant.ne
    for part in range(count):
        for row in order[borders[part] : borders[part + 1]]:
            parts[row] = part
    return replace(plant, parts=tuple(parts), code_form="straight")


def _coupled(spec: Spec, plant: Plant, sensed: Plant) -> Iterator[set[int]]:
    """Rows of the covariance that have to stay together."""
    u = actuation_of(spec, plant, ca.SX.sym("u", plant.nu))
    for matrix in (plant.A, plant.Q, lift(spec.model.P0, plant.parameters)):
        yield from ({i, j} for i, j in _entries(matrix))
    for before, at in enumerate(plant.attitudes):  # the three axes of an attitude
        yield set(range(at - before, at - before + 3))
    if plant.lifted is not None:  # noises that reach several states
        yield from ({i for i, _ in _entries(each)} for each in ca.horzsplit(plant.lifted.G))
    seen = [{j for _, j in _entries(row)} for row in ca.vertsplit(sensed.C)]
    yield from (seen[i] | seen[j] for i, j in _entries(sensed.R))
    # What y tells of beside x, noise and random inputs, ties all that it reaches.
    yield {i for i, _ in _entries(plant.S)}.union(*(seen[j] for _, j in _entries(plant.S)))
    reached = {i for i, _ in _entries(plant.B @ u.through)}
    yield reached.union(*(seen[i] for i, _ in _entries(plant.D @ u.through)))


def _entries(matrix: ca.SX) -> list[tuple[int, int]]:
    """Places that are not zero by structure."""
    return list(zip(*matrix.sparsity().get_triplet(), strict=True))


def of_parts_only(
    spec: Spec, plant: Plant, symbols: dict[str, ca.SX], start: Phase | None
) -> Phase:
    """The phase that starts a filter, which refuses a prior that couples parts."""
    if start is None:
        known: dict[Target, ca.SX] = {}
        known.update(symbols | prior_symbols(spec.model))
        start = Phase(blocks=(), variables=(), symbols=known)
    P = start.symbols["P"]
    coupled = ca.vertcat(*(P[at] for at in between(plant.parts)))
    guard = Guard(ca.vertcat(coupled, -coupled), Kind.NONNEGATIVE, Status.PRIOR_COUPLED)
    block = Block("no covariance between parts of the state", {}, None, (guard,), ("P",))
    return replace(start, blocks=(block, *start.blocks))
