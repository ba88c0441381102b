"""Logarithms that only results need which nobody may have asked for.

Whether such a result is finite decides on a status all the same. The logarithm of a positive finite
number is; sums in which the number itself takes its place are finite at most where they were, and
are where all else in them is, but for numbers next to the largest: there the sample is done again.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from fkgen.backend import ir
from fkgen.backend.ir import Element, Literal, Operator, Space, Temp
from fkgen.symbolic.interface import Kind

_SUMS = {Operator.ADD, Operator.SUB, Operator.NEG}


def needless_logarithms(program: ir.CProgram, phase: ir.Phase) -> dict[Temp, frozenset[str]]:
    """Logarithms of a phase that nothing needs but some ports, by the ports."""
    shown = _only_shown(program)
    uses: dict[Temp, list[ir.Statement]] = defaultdict(list)
    for node in ir.walk(phase.body):
        for operand in ir.operands(node):
            if isinstance(operand, Temp):
                uses[operand].append(node)

    def ports(temp: Temp) -> frozenset[str] | None:
        """The ports that a number goes to; None if it goes elsewhere."""
        found: frozenset[str] = frozenset()
        for node in uses[temp]:
            match node:
                case ir.Operate(target, operator, arguments) if _keeps(operator, arguments):
                    further = ports(target)
                    if further is None:
                        return None
                    found |= further
                case ir.Require(_, Kind.FINITE):
                    pass
                case ir.Assign(Element(Space.NEXT, name)) if name in shown:
                    found |= {name}
                case _:
                    return None
        return found

    logs = (
        node.target for node in ir.every(ir.Operate, phase.body) if node.operator is Operator.LOG
    )
    return {temp: found for temp in logs if (found := ports(temp))}


def _keeps(operator: Operator, arguments: Sequence[ir.Operand]) -> bool:
    """Whether what is not finite stays so, and a logarithm cannot make it so."""
    factors = [abs(each.value) for each in arguments if isinstance(each, Literal)]
    return operator in _SUMS or (operator is Operator.MUL and any(f <= 1.0 for f in factors))


def _only_shown(program: ir.CProgram) -> set[str]:
    """Ports that no phase reads and that decide on nothing."""
    read = {
        each.name
        for phase in program.phases
        for each in ir.read(Element, phase.body)
        if each.space in {Space.SELF, Space.NEXT}
    }
    read |= {outcome.port for outcome in program.outcomes}
    read |= {port.given for port in program.ports}
    read |= {phase.unless for phase in program.phases if phase.unless is not None}
    return {port.name for port in program.ports} - read
