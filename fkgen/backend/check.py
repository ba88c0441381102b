"""The written rules of the IR, run as a check between lowering and printing."""

from __future__ import annotations

from collections.abc import Iterator

from fkgen.backend.ir import (
    Assign,
    Copy,
    CProgram,
    Element,
    Operate,
    Phase,
    Space,
    Temp,
    operands,
    walk,
)
from fkgen.errors import InternalError
from fkgen.symbolic.interface import Port


def verify(program: CProgram) -> CProgram:
    """Return ``program`` unchanged if it is well formed.

    Raises
    ------
    InternalError
        If a temporary is read before it is assigned or is assigned twice, if a result is written
        under a condition, twice or never, or if the prediction or the closing reads what the
        update does not write.
    """
    written: set[tuple[str, int | None]] = set()
    for phase in program.phases:
        written |= _check_phase(program.name, phase)
    expected = {element for port in program.ports for element in elements(port)}
    if written != expected:
        raise InternalError(f"{program.name}: results never written: {sorted(expected - written)}")
    updated = {n.target.name for n in program.update.body if isinstance(n, Assign)}
    for later in program.phases[1:]:
        what = "the prediction" if later is program.predict else "the closing"
        for name in {e.name for e in _reads(later) if e.space is Space.SELF} - updated:
            raise InternalError(f"{program.name}: {what} reads {name}, which no update writes")
    return program


def elements(port: Port) -> list[tuple[str, int | None]]:
    """Name and index of every stored scalar of a port."""
    return [(port.name, i if port.shape else None) for i in range(port.size)]


def _check_phase(name: str, phase: Phase) -> set[tuple[str, int | None]]:
    assigned: set[int] = set()
    written: set[tuple[str, int | None]] = set()
    unconditional = set(map(id, phase.body))
    for node in walk(phase.body):
        for operand in operands(node):
            if isinstance(operand, Temp) and operand.index not in assigned:
                raise InternalError(
                    f"{name}: temporary {operand.index} is read before it is assigned"
                )
        if isinstance(node, Operate | Copy):
            if node.target.index in assigned:
                raise InternalError(f"{name}: temporary {node.target.index} is assigned twice")
            assigned.add(node.target.index)
        if isinstance(node, Assign) and node.target.space is Space.NEXT:
            if id(node) not in unconditional:
                raise InternalError(f"{name}: {node.target} is written under a condition")
            if (node.target.name, node.target.index) in written:
                raise InternalError(f"{name}: {node.target} is written twice")
            written.add((node.target.name, node.target.index))
    return written


def _reads(phase: Phase) -> Iterator[Element]:
    for node in walk(phase.body):
        yield from (operand for operand in operands(node) if isinstance(operand, Element))
