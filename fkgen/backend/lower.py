"""CasADi -> IR: walk the instructions of every block, one statement per operation; then verify."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import casadi as ca

from fkgen.backend.ir import (
    Assign,
    Copy,
    CProgram,
    Element,
    Heading,
    IfPositive,
    IfPresent,
    Literal,
    Local,
    Operand,
    Operate,
    Operator,
    Phase,
    Require,
    Signal,
    Space,
    Statement,
    Temp,
    operands,
    walk,
)
from fkgen.backend.render import render
from fkgen.backend.source import Source
from fkgen.backend.stated import constants_of, stated
from fkgen.errors import InternalError
from fkgen.symbolic import recursion as sym
from fkgen.symbolic.interface import Port
from fkgen.symbolic.ports import PARAMETER
from fkgen.symbolic.validated import Validated
from fkgen.version import API_VERSION

_BINARY = {
    ca.OP_ADD: Operator.ADD,
    ca.OP_SUB: Operator.SUB,
    ca.OP_MUL: Operator.MUL,
    ca.OP_DIV: Operator.DIV,
    ca.OP_FMAX: Operator.MAX,
    ca.OP_FMIN: Operator.MIN,
    ca.OP_ATAN2: Operator.ATAN2,
}
_UNARY = {
    ca.OP_NEG: Operator.NEG,
    ca.OP_FABS: Operator.ABS,
    ca.OP_EXP: Operator.EXP,
    ca.OP_LOG: Operator.LOG,
    ca.OP_SQRT: Operator.SQRT,
    ca.OP_SIN: Operator.SIN,
    ca.OP_COS: Operator.COS,
    ca.OP_TAN: Operator.TAN,
}


def generate(design: Validated) -> Source:
    """Generate the C code of one validated filter. Nothing is written to disk."""
    return render(lower(design.recursion), tuple(claim.claim for claim in design.claims))


def lower(recursion: sym.Recursion) -> CProgram:
    """Turn a recursion into the data of a C program, verified."""
    spec = recursion.spec
    model = spec.model
    signals = {
        kind: tuple(Signal(s.name, s.unit) for s in getattr(model, kind))
        for kind in ("states", "inputs", "outputs")
    }
    closing = lower_phase(recursion.ports, recursion.closing) if recursion.closing else None
    update, predict = (
        lower_phase(recursion.ports, phase) for phase in (recursion.update, recursion.predict)
    )
    phases = [phase for phase in (update, closing, predict) if phase is not None]
    return verify(
        CProgram(
            name=spec.name,
            scalar=spec.code.scalar,
            family=spec.filter.family,
            source=recursion.source,
            notes=_notes(recursion),
            digest=hashlib.sha256(f"{API_VERSION}\n{spec.canonical()}".encode()).hexdigest()[:16],
            sample_time=model.sample_time,
            parameters=tuple((p.name, p.default) for p in spec.parameters),
            ports=recursion.ports,
            outcomes=recursion.outcomes,
            initial=tuple(sorted(recursion.initial.items())),
            update=update,
            predict=predict,
            closing=closing,
            constants=constants_of(spec.code.scalar, phases),
            shares_functions=spec.code.elementary == "shared",
            stated=stated(spec, phases),
            **signals,
        )
    )


def _notes(recursion: sym.Recursion) -> tuple[str, ...]:
    """Decisions that the header repeats."""
    form = () if recursion.form is None else (f"covariance update: {recursion.form} form",)
    return (*form, *recursion.notes)


def lower_phase(
    ports: tuple[Port, ...], phase: sym.Phase, inputs: tuple[str, ...] = ("u", "y")
) -> Phase:
    """Turn one phase into statements; ``inputs`` are arguments of the function, not members."""
    lowering = _Lowering({port.name: bool(port.shape) for port in ports}, phase, inputs)
    for block in phase.blocks:
        lowering.take(block)
    body = lowering.body()
    read = [
        operand for node in walk(body) for operand in operands(node) if isinstance(operand, Element)
    ]
    return Phase(
        locals=tuple(Local(v.name, v.size, v.initial) for v in phase.variables),
        body=body,
        reads_input=any(e.space is Space.INPUT and e.name == "u" for e in read),
        reads_parameters=any(e.space is Space.PARAMETER for e in read),
        unless=phase.unless,
        chunks=lowering.chunks(),
    )


@dataclass(slots=True)
class _Group:
    """Statements under one condition; ``before`` computes the pivot ``value``."""

    condition: sym.Condition | None
    before: list[Statement]
    value: Operand | None
    statements: list[Statement]
    section: str = ""
    begins: list[int] = field(default_factory=list)

    def closed(self) -> tuple[Statement, ...]:
        """The statements under their conditions."""
        body = tuple(self.statements)
        if self.value is not None:
            body = (*self.before, IfPositive(self.value, body))
        if self.condition is None or not self.condition.present:
            return body
        return (IfPresent(self.condition.row, body),)


@dataclass(slots=True)
class _Lowering:
    """Builder of one phase's statements."""

    ports: Mapping[str, bool]
    phase: sym.Phase
    inputs: tuple[str, ...]
    written: set[str] = field(default_factory=set)
    temps: int = 0
    title: str = ""
    groups: list[_Group] = field(default_factory=list)

    def take(self, block: sym.Block) -> None:
        """Append a block; blocks in a row under one condition share it."""
        title = f"{block.section}: {block.title}" if block.section else block.title
        if title and title != self.title:
            self.groups.append(_Group(None, [], None, [Heading(title)], block.section))
            self.title = title
        last = self.groups[-1] if self.groups else None
        if last is None or last.section != block.section or not _same(last.condition, block.when):
            self.groups.append(self._group(block))
        group = self.groups[-1]
        group.begins.append(len(group.statements))
        values = self._instructions(block.function(self.phase.symbols), block, group.statements)
        guards = values[len(block.assign) :]
        for guard, value in zip(block.guards, guards, strict=True):
            group.statements.append(Require(tuple(value), guard.kind, guard.status))
        self._store(block, values, group.statements)

    def body(self) -> tuple[Statement, ...]:
        """Everything taken so far."""
        return tuple(node for group in self.groups for node in group.closed())

    def chunks(self) -> tuple[tuple[int, str], ...]:
        """Where in the body blocks begin, and their sections; those under one condition are one."""
        at = 0
        result: dict[int, str] = {}
        for group in self.groups:
            closed = group.closed()
            inside = group.begins if closed == tuple(group.statements) else [0]
            result |= {at + begin: group.section for begin in inside or [0]}
            at += len(closed)
        return tuple(result.items())

    def _group(self, block: sym.Block) -> _Group:
        before: list[Statement] = []
        threshold = block.threshold(self.phase.symbols)
        value = None
        if threshold is not None:
            value = self._instructions(threshold, block, before)[0][0]
        return _Group(block.when, before, value, [], block.section)

    def _instructions(
        self, function: ca.Function, block: sym.Block, out: list[Statement]
    ) -> list[list[Operand]]:
        """Append the operations of a function; return the operands of its outputs."""
        work: dict[int, Operand] = {}
        values: list[list[Operand]] = [
            [Literal(0.0)] * function.nnz_out(i) for i in range(function.n_out())
        ]
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            source, target = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_CONST:
                work[target[0]] = Literal(function.instruction_constant(k))
            elif code == ca.OP_INPUT:
                work[target[0]] = self._element(block.reads[source[0]], source[1], read=True)
            elif code == ca.OP_OUTPUT:
                values[target[0]][target[1]] = work[source[0]]
            else:
                work[target[0]] = self._operate(code, [work[i] for i in source], out)
        return values

    def _operate(self, code: int, arguments: list[Operand], out: list[Statement]) -> Temp:
        if code == ca.OP_SQ:
            operator, arguments = Operator.MUL, [arguments[0]] * 2
        elif code == ca.OP_TWICE:
            operator, arguments = Operator.ADD, [arguments[0]] * 2
        elif code == ca.OP_INV:
            operator, arguments = Operator.DIV, [Literal(1.0), arguments[0]]
        elif code in _UNARY:
            operator, arguments = _UNARY[code], arguments[:1]
        elif code in _BINARY:
            operator, arguments = _BINARY[code], arguments[:2]
        else:
            raise InternalError(f"no C for CasADi operation {code}")
        target = self._temp()
        out.append(Operate(target, operator, tuple(arguments)))
        return target

    def _store(self, block: sym.Block, values: list[list[Operand]], out: list[Statement]) -> None:
        """Assign all outputs at once: what is overwritten before it is read is kept first."""
        targets = [
            (self._element(name, i, read=False), value)
            for name, column in zip(block.assign, values, strict=False)
            for i, value in enumerate(column)
        ]
        overwritten = {target for target, _ in targets}
        kept: dict[Operand, Temp] = {}
        for target, value in targets:
            if value in overwritten and value != target and value not in kept:
                kept[value] = self._temp()
                out.append(Copy(kept[value], value))
        out += [Assign(t, kept.get(v, v)) for t, v in targets if t != v]
        self.written |= set(block.assign) & set(self.ports)

    def _element(self, name: str, index: int, *, read: bool) -> Element:
        if name.startswith(PARAMETER):
            return Element(Space.PARAMETER, name.removeprefix(PARAMETER), None)
        if name in self.inputs:
            return Element(Space.INPUT, name, index)
        if name in self.ports:
            space = Space.SELF if read and name not in self.written else Space.NEXT
            return Element(space, name, index if self.ports[name] else None)
        size = self.phase.symbols[name].numel()
        return Element(Space.LOCAL, name, index if size > 1 else None)

    def _temp(self) -> Temp:
        self.temps += 1
        return Temp(self.temps - 1)


def _same(a: sym.Condition | None, b: sym.Condition | None) -> bool:
    if a is None or b is None or a is b:
        return a is b
    return a.row == b.row and a.positive is None and b.positive is None


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
