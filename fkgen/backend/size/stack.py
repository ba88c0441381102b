"""How much stack a call needs at most, from the program alone: the same on every machine.

At -O0 every name of a function has its place, and what is inlined has one for each call. At -Os
places are for arrays, for the copy of the instance, and for what is alive at the same time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from fkgen.backend import ir
from fkgen.backend.routines import Outline

#: Bytes of one scalar.
BYTES = {"double": 8, "float": 4}

#: Of a function at -O0 and at -Os: registers, the return address and arguments; and the frames of
#: the elementary functions and of those that check what comes in.
_SAVED, _SAVED_SMALL = 96, 48
_LEAF, _LEAF_SMALL = 128, 128

#: Frames at -O0 of the functions for products of matrices, each of which holds a tile.
_TILES = 768

#: Copies of the instance that a compiler keeps at -O0: the next one, and those of branches.
_COPIES = 3

#: Printed as a question, whose answer has a place of its own.
_ASKING = {ir.Operator.ABS, ir.Operator.MAX, ir.Operator.MIN}


@dataclass(frozen=True, slots=True)
class Stack:
    """Bytes that a call needs at most, interrupts left out."""

    plain: int  # at -O0
    small: int  # at -Os


def stack_of(program: ir.CProgram, outlined: Outline, *, inlined: bool) -> Stack:
    """Bounds on the stack of a call of update, predict or step."""
    size = BYTES[program.scalar]
    instance = instance_of(program)
    routines = {each.name: each for each in outlined.routines}
    plain, small = [], []
    for phase in outlined.phases:
        plain.append(_plain(phase.locals, phase.body, routines, size))
        small.append(_small(phase.locals, phase.body, routines, size))
    together = sum(plain) if inlined else max(plain)
    if outlined.of_matrices:
        together += _TILES
    together += together // 8  # what expressions keep on the way
    return Stack(
        plain=_rounded(_COPIES * instance + 2 * _SAVED + _LEAF + together),
        small=_rounded(instance + _SAVED_SMALL + _LEAF_SMALL + sum(small)),
    )


def instance_of(program: ir.CProgram) -> int:
    """Bytes of an instance: ports, which estimate is the latest, bits of rows, of which model."""
    size = BYTES[program.scalar]
    scalars = sum(port.size for port in program.ports) + 1 + len(program.repeats or ())
    words = -(-len(program.outputs) // 32) * sum(port.flags for port in program.ports) + 1
    return -(-(size * scalars + 4 * words) // size) * size


def _plain(
    locals_: tuple[ir.Local, ...], body: ir.Body, routines: Mapping[str, ir.Routine], size: int
) -> int:
    """Names, each in a place of its own, those of what is called too."""
    names = sum(1 for node in ir.walk(body) if isinstance(node, ir.Operate | ir.Copy))
    names += sum(1 for operator in _operators(body) if operator in _ASKING or operator.is_function)
    names += sum(1 for _ in ir.every(ir.For, body))
    own = size * (names + _arrays(locals_)) + _SAVED
    calls = (routines[call.routine] for call in ir.every(ir.Call, body))
    return own + sum(_plain(each.locals, each.body, routines, size) for each in calls)


def _small(
    locals_: tuple[ir.Local, ...], body: ir.Body, routines: Mapping[str, ir.Routine], size: int
) -> int:
    """Arrays, and what is alive at the same time; of what is called the most."""
    own = size * (_alive(body) + _arrays(locals_)) + _SAVED_SMALL
    called = [routines[name] for name in {call.routine for call in ir.every(ir.Call, body)}]
    return own + max((_small(each.locals, each.body, routines, size) for each in called), default=0)


def _arrays(locals_: tuple[ir.Local, ...]) -> int:
    """Scalars of locals; tables of constants are kept elsewhere."""
    return sum(local.size for local in locals_ if not local.values)


def _alive(body: ir.Body) -> int:
    """The most values that are computed and not yet used for the last time."""
    nodes = list(ir.walk(body))
    loops = max((len(loops) for _, loops in ir.inside(body)), default=0)
    last = {operand: i for i, node in enumerate(nodes) for operand in ir.operands(node)}
    ends: dict[int, int] = {}
    most = alive = loops
    for i, node in enumerate(nodes):
        if isinstance(node, ir.Operate | ir.Copy):
            alive += 1
            end = last.get(node.target, i)
            ends[end] = ends.get(end, 0) + 1
        most = max(most, alive)
        alive -= ends.pop(i, 0)
    return most


def _operators(body: ir.Body) -> Iterator[ir.Operator]:
    """Every operation of statements, those inside expressions too."""
    for node in ir.walk(body):
        if isinstance(node, ir.Operate):
            yield node.operator
        waiting = [node.value] if isinstance(node, ir.Assign) else [*getattr(node, "arguments", ())]
        while waiting:
            part = waiting.pop()
            if isinstance(part, ir.Expression):
                yield part.operator
                waiting += part.arguments


def _rounded(size: int) -> int:
    return -(-size // 16) * 16
