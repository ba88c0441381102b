"""CasADi -> IR: walk the instructions of every block, one statement per operation; then verify."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import casadi as ca

from fkgen.backend import ir
from fkgen.backend.execute import SAMPLES
from fkgen.backend.fused.products import fused
from fkgen.backend.ir import Copy, Element, Literal, Operand, Operate, Operator, Space, Temp
from fkgen.backend.render import render
from fkgen.backend.size.guards import without_implied
from fkgen.backend.size.selection import selected
from fkgen.backend.source import Source
from fkgen.backend.stated import constants_of, stated
from fkgen.errors import InternalError, SpecError, UnfitError
from fkgen.families import family
from fkgen.problem import Model, Spec
from fkgen.problem.functions.finite import path_of
from fkgen.problem.functions.named import coordinates
from fkgen.symbolic import recursion as sym
from fkgen.symbolic.index import At, Target, Whole, name_of, names_in
from fkgen.symbolic.interface import OUTSIDE, Port
from fkgen.symbolic.ports import PARAMETER, prior_of, prior_ports
from fkgen.symbolic.validated import Validated
from fkgen.version import API_VERSION

#: Operators by the codes of CasADi, which have the same names but for these.
_OTHER = {ca.OP_FABS: Operator.ABS, ca.OP_FMAX: Operator.MAX, ca.OP_FMIN: Operator.MIN}
_OTHER |= {ca.OP_SQ: Operator.MUL, ca.OP_TWICE: Operator.ADD, ca.OP_INV: Operator.DIV}
_OPERATORS = _OTHER | {
    getattr(ca, f"OP_{each.name}"): each for each in Operator if hasattr(ca, f"OP_{each.name}")
}


def generate(design: Validated) -> Source:
    """Generate the C code of one validated filter. Nothing is written to disk.

    Raises
    ------
    SpecError
        If the filter refuses its self-test: rounding has eaten a covariance, say.
    """
    claims = tuple(claim.claim for claim in design.claims)
    try:
        return render(lower(design.recursion), claims)
    except UnfitError as unfit:
        raise unfit_spec(design.recursion.spec, unfit) from None


def unfit_spec(spec: Spec, unfit: UnfitError) -> SpecError:
    """What a program that cannot run says about its spec."""
    caveats = family(spec.filter.family).caveats(spec)
    ways = [each.remedy for each in caveats if each.remedy]
    ways = [*ways, "a smaller model.P0, or a larger R"]
    scalar, key = spec.code.scalar, "model.P0"
    if scalar == "float":
        key, ways = "code.scalar", ['scalar = "double"', *ways]
    given = f"numbers with which, in {scalar}, {unfit.what}"
    return SpecError(key, given=given, expected=", or ".join(ways), file=spec.file)


def lower(recursion: sym.Recursion) -> ir.CProgram:
    """Turn a recursion into the data of a C program, verified."""
    spec = recursion.spec
    model = spec.model
    ports, lowered = _phases(recursion)
    names, phases = {port.name for port in ports}, list(lowered.values())
    form: tuple[str, ...] = ()
    if recursion.form is not None:
        how = ": covariances are carried as factors U D U'" if recursion.form == "ud" else ""
        form = (f"covariance update: {recursion.form} form{how}",)
    nodes = [node for phase in phases for node in ir.walk(phase.body)]
    if any(isinstance(node, ir.OfMatrices) for node in nodes):
        form += ("form of the code: loops over whole matrices",)
    elif any(isinstance(node, ir.For) for node in nodes):
        form += ("form of the code: loops over rows of y, straight lines elsewhere",)
    return verify(
        ir.CProgram(
            name=spec.name,
            scalar=spec.code.scalar,
            family=spec.filter.family,
            source=recursion.source,
            notes=(*form, *recursion.notes),
            digest=digest_of(spec),
            sample_time=model.sample_time,
            attitudes=model.attitudes,
            parameters=tuple((p.name, p.default) for p in spec.parameters),
            ports=ports,
            outcomes=recursion.outcomes,
            repeats=recursion.repeats,
            prior=prior_of(spec),
            initial=tuple(sorted((k, v) for k, v in recursion.initial.items() if k in names)),
            constants=constants_of(spec.code.scalar, phases),
            shares_functions=spec.code.elementary == "shared",
            fma=spec.code.fma,
            optimise=spec.code.optimise,
            decoupled=spec.code.decoupled,
            stated=stated(spec, phases),
            paths=_paths(spec),
            **lowered,
            **_signals(model, ranged=recursion.ranged),
        )
    )


def digest_of(spec: Spec) -> str:
    """What the generated code calls the spec."""
    return hashlib.sha256(f"{API_VERSION}\n{spec.canonical()}".encode()).hexdigest()[:16]


def _phases(recursion: sym.Recursion) -> tuple[tuple[Port, ...], dict[str, Any]]:
    """The ports that C has, and the phases by the names that `CProgram` has for them."""
    spec, ports = recursion.spec, recursion.ports
    lowered = {
        name: lower_phase(ports, phase)
        for name in ("update", "closing", "predict")
        if (phase := getattr(recursion, name)) is not None
    }
    if recursion.start is not None:
        lowered["start"] = lower_phase(ports, recursion.start, ("x", "P"))
    origin = recursion.prior
    prior = {} if origin is None else {"origin": lower_phase(prior_ports(spec.model), origin)}
    if spec.code.fma:
        lowered, prior = ({k: fused(v) for k, v in each.items()} for each in (lowered, prior))
    if spec.code.ports is not None:
        shown = (*spec.code.ports, *(outcome.port for outcome in recursion.outcomes))
        ports, lowered = selected(ports, lowered, shown)
    return ports, {name: without_implied(phase) for name, phase in (lowered | prior).items()}


def _paths(spec: Spec) -> tuple[tuple[float, tuple[tuple[float, ...], ...]], ...]:
    """Where a self-test has values if equations have any: about paths from x0."""
    found, x0 = [], spec.model.x0.values(spec.defaults).ravel()
    for each in spec.equations:
        for level in (0.0, 1.0) if spec.model.nu else (0.0,):
            path = path_of(each, x0, [level] * spec.model.nu, spec.defaults, SAMPLES)
            if path is not None:
                found.append((level, path))
    return tuple(found)


def _signals(model: Model, *, ranged: bool) -> dict[str, Any]:
    """States, inputs and outputs by name, of an attitude its four numbers."""
    signals = {
        "states": [(name, s, s.manifold) for s in model.states for name in coordinates(s)],
        "inputs": [(each.name, each, "") for each in model.inputs],
        "outputs": [(each.name, each, "") for each in model.outputs],
    }
    return {
        key: tuple(
            ir.Signal(name, "" if manifold else each.unit, each.range if ranged else None)
            for name, each, manifold in found
        )
        for key, found in signals.items()
    }


def lower_phase(
    ports: tuple[Port, ...], phase: sym.Phase, inputs: tuple[str, ...] = ("u", "y", OUTSIDE)
) -> ir.Phase:
    """Turn one phase into statements; ``inputs`` are arguments of the function, not members."""
    lowering = _Lowering({port.name: bool(port.shape) for port in ports}, phase, inputs)
    for block in phase.blocks:
        lowering.take(block)
    return lowering.lowered()


@dataclass(slots=True)
class _Group:
    """Statements under one condition; ``before`` computes the pivot ``value``."""

    condition: sym.Condition | None
    section: str
    before: list[ir.Statement] = field(default_factory=list)
    value: Operand | None = None
    statements: list[ir.Statement] = field(default_factory=list)
    begins: list[int] = field(default_factory=list)

    def closed(self) -> ir.Body:
        """The statements under their conditions."""
        body = tuple(self.statements)
        if self.value is not None:
            body = (*self.before, ir.IfPositive(self.value, body))
        if self.condition is None or not self.condition.present:
            return body
        return (ir.IfPresent(self.condition.row, body),)


@dataclass(slots=True)
class _Lowering:
    """Builder of one phase's statements."""

    ports: Mapping[str, bool]
    phase: sym.Phase
    inputs: tuple[str, ...]
    written: set[str] = field(default_factory=set)
    temps: Iterator[int] = field(default_factory=count)
    title: str = ""
    groups: list[_Group] = field(default_factory=list)

    def take(self, block: sym.Block | sym.Loop | sym.OfMatrices) -> None:
        """Append a block, loop or product; those in a row under one condition share it."""
        title = f"{block.section}: {block.title}" if block.section else block.title
        if title and title != self.title:
            self.groups.append(_Group(None, block.section, statements=[ir.Heading(title)]))
            self.title = title
        if isinstance(block, sym.OfMatrices):
            node = self._product(block) if isinstance(block, sym.Product) else self._triangle(block)
            self.groups.append(_Group(None, block.section, statements=[node], begins=[0]))
            return
        last = self.groups[-1] if self.groups else None
        if last is None or last.section != block.section or not _same(last.condition, block.when):
            last = _Group(block.when, block.section)
            self.groups.append(last)
            if (threshold := block.threshold(self.phase.symbols)) is not None:
                last.value = self._instructions(threshold, block.reads, last.before)[0][0]
        last.begins.append(len(last.statements))
        if isinstance(block, sym.Loop):
            last.statements.append(self._loop(block))
            return
        function = block.function(self.phase.symbols)
        values = self._instructions(function, block.reads, last.statements)
        for guard, value in zip(block.guards, values[len(block.assign) :], strict=True):
            last.statements.append(ir.Require(tuple(value), guard.kind, guard.status))
        self._store(block, values, last.statements)

    def _product(self, product: sym.Product) -> ir.Product:
        """A product, whose target is a local."""
        begin = product.start
        start = None if begin is None else self._element(begin, 0, read=True)
        return ir.Product(
            target=self._element(product.target, 0, read=False),
            start=start,
            left=self._element(product.left, 0, read=True),
            right=self._element(product.right, 0, read=True),
            rows=product.rows,
            columns=product.columns,
            inner=product.inner,
            less=product.less,
            lower=product.lower,
        )

    def _triangle(self, triangle: sym.Triangle) -> ir.Triangle:
        """A copy of a symmetric matrix to a local."""
        target = self._element(triangle.target, 0, read=False)
        source = self._element(triangle.source, 0, read=True)
        return ir.Triangle(target, source, triangle.size, triangle.mirrored)

    def _loop(self, loop: sym.Loop) -> ir.For:
        """A loop with its blocks in groups of their own."""
        outer, self.groups = self.groups, []
        for block in loop.body:
            self.take(block)
        body = tuple(node for group in self.groups for node in group.closed())
        self.groups = outer
        written = {n.target.name for n in ir.every(ir.Assign, body) if n.target.space is Space.NEXT}
        for element in ir.read(Element, body):
            if element.space is Space.SELF and element.name in written:
                raise InternalError(f"a loop reads {element.name} and writes it")
        return ir.For(loop.index, loop.begin, loop.end, body)

    def lowered(self) -> ir.Phase:
        """Everything taken so far; blocks under one condition are one chunk."""
        body: list[ir.Statement] = []
        chunks: dict[int, str] = {}
        for group in self.groups:
            closed = group.closed()
            inside = group.begins if closed == tuple(group.statements) else []
            chunks |= {len(body) + begin: group.section for begin in inside or [0]}
            body += closed
        read = [*ir.read(Element, tuple(body))]
        return ir.Phase(
            locals=tuple(
                ir.Local(v.name, v.size, v.initial, v.values) for v in self.phase.variables
            ),
            body=tuple(body),
            reads_input=any(e.space is Space.INPUT and e.name == "u" for e in read),
            reads_parameters=any(e.space is Space.PARAMETER for e in read),
            unless=self.phase.unless,
            chunks=tuple(chunks.items()),
        )

    def _instructions(
        self, function: ca.Function, reads: tuple[Target, ...], out: list[ir.Statement]
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
                work[target[0]] = self._element(reads[source[0]], source[1], read=True)
            elif code == ca.OP_OUTPUT:
                values[target[0]][target[1]] = work[source[0]]
            else:
                work[target[0]] = self._operate(code, [work[i] for i in source], out)
        return values

    def _operate(self, code: int, arguments: list[Operand], out: list[ir.Statement]) -> Temp:
        if code == ca.OP_SIGN:  # the derivative of abs
            signs = ([Literal(0.0), *arguments], [*arguments, Literal(0.0)])
            return self._operate(
                ca.OP_SUB, [self._operate(ca.OP_LT, each, out) for each in signs], out
            )
        if code not in _OPERATORS:
            raise InternalError(f"no C for CasADi operation {code}")
        if code in {ca.OP_SQ, ca.OP_TWICE}:
            arguments = arguments * 2
        elif code == ca.OP_INV:
            arguments = [Literal(1.0), *arguments]
        target = Temp(next(self.temps))
        out.append(Operate(target, _OPERATORS[code], tuple(arguments)))
        return target

    def _store(
        self, block: sym.Block, values: list[list[Operand]], out: list[ir.Statement]
    ) -> None:
        """Assign all outputs at once: what is overwritten before it is read is kept first."""
        targets = [
            (self._element(name, i, read=False), value)
            for name, column in zip(block.assign, values, strict=False)
            for i, value in enumerate(column)
        ]
        overwritten = {target for target, _ in targets}
        moving = {target for target in overwritten if target.moves}
        kept: dict[Operand, Temp] = {}
        for target, value in targets:
            lost = value in overwritten
            if isinstance(value, Element) and not lost:  # or may be overwritten
                lost = any(value.may_be(each) for each in (overwritten if value.moves else moving))
            if lost and value != target and value not in kept:
                kept[value] = Temp(next(self.temps))
                out.append(Copy(kept[value], value))
        out += [ir.Assign(t, kept.get(v, v)) for t, v in targets if t != v]
        self.written |= {name_of(target) for target in block.assign} & set(self.ports)

    def _element(self, place: Target, at: int, *, read: bool) -> Element:
        index: Whole
        name, index = (place.name, place.index) if isinstance(place, At) else (place, at)
        if name.startswith(PARAMETER):
            return Element(Space.PARAMETER, name.removeprefix(PARAMETER), None)
        if name in self.inputs:
            return Element(Space.INPUT, name, index)
        if name in self.ports:
            space = Space.SELF if read and name not in self.written else Space.NEXT
            return Element(space, name, index if self.ports[name] else None)
        size = self.phase.symbols[name].numel()
        return Element(Space.LOCAL, name, index if size > 1 else None)


def _same(a: sym.Condition | None, b: sym.Condition | None) -> bool:
    if a is None or b is None or a is b:
        return a is b
    return a.row == b.row and a.positive is None and b.positive is None


def verify(program: ir.CProgram) -> ir.CProgram:
    """Return ``program`` if it is well formed: assigned before read, results once, no condition."""
    written: set[tuple[str, int | None]] = set()
    sizes = {port.name: port.size for port in program.ports}
    sizes |= {"u": len(program.inputs), **dict.fromkeys(("y", OUTSIDE), len(program.outputs))}
    for phase in program.phases:
        written |= _check_phase(program.name, phase)
        _check_places(program.name, phase, sizes)
    ports = program.ports
    expected = {(port.name, i if port.shape else None) for port in ports for i in range(port.size)}
    if written != expected:
        raise InternalError(f"{program.name}: results never written: {sorted(expected - written)}")
    updated = {port.name for port in program.written(program.update)}
    for later in program.phases[1:]:
        what = "the prediction" if later is program.predict else "the closing"
        read = {e.name for e in ir.read(Element, later.body) if e.space is Space.SELF}
        for name in read - updated:
            raise InternalError(f"{program.name}: {what} reads {name}, which no update writes")
    if program.repeats is not None:
        _check_repeats(program)
    return program


def _check_repeats(program: ir.CProgram) -> None:
    """An update after an update finds all that it reads, and may work on one instance in place."""
    updated = {port.name for port in program.written(program.update)}
    twins = {port.name for port, twin in program.twins if twin.name in updated}
    begun: set[str] = set()  # ports of which something is written
    for node in ir.walk(program.update.body):
        for operand in ir.operands(node):
            if not (isinstance(operand, Element) and operand.space is Space.SELF):
                continue
            if operand.name in begun or operand.name not in updated | twins:
                raise InternalError(f"{program.name}: no second update: it reads {operand.name}")
        if isinstance(node, ir.Assign) and node.target.space is Space.NEXT:
            begun.add(node.target.name)
    if program.closing is not None:
        raise InternalError(f"{program.name}: no second update: something ends with the first")


def _check_phase(name: str, phase: ir.Phase) -> set[tuple[str, int | None]]:
    """The results that a phase writes, and may then write again under a condition."""
    assigned: set[Temp] = set()
    written: set[tuple[str, int | None]] = set()
    unconditional = set(map(id, _unconditional(phase.body)))
    for node, loops in ir.inside(phase.body):
        for operand in ir.operands(node):
            if isinstance(operand, Temp) and operand not in assigned:
                raise InternalError(
                    f"{name}: temporary {operand.index} is read before it is assigned"
                )
        if isinstance(node, Operate | Copy):
            if node.target in assigned:
                raise InternalError(f"{name}: temporary {node.target.index} is assigned twice")
            assigned.add(node.target)
        if isinstance(node, ir.Assign) and node.target.space is Space.NEXT:
            first = id(node) in unconditional
            for index in ir.places(node.target.index, loops):
                place = node.target.name, index
                if not first and place not in written:
                    raise InternalError(f"{name}: {node.target} is written under a condition")
                if first and place in written:
                    raise InternalError(f"{name}: {node.target} is written twice")
                written.add(place)
    return written


def _unconditional(body: ir.Body) -> Iterator[ir.Statement]:
    """Statements that every sample runs, those in loops too."""
    for node in body:
        yield node
        if isinstance(node, ir.For):
            yield from _unconditional(node.body)


def _check_places(name: str, phase: ir.Phase, sizes: Mapping[str, int]) -> None:
    """Indices are known where they are used, elements exist, and locals are written before read."""
    sizes = {**sizes, **{local.name: local.size for local in phase.locals}}
    begun = {v.name for v in phase.locals if v.initial is not None or v.values}
    home: dict[Temp, tuple[ir.For, ...]] = {}  # the loops that a temporary lives in
    for node, loops in ir.inside(phase.body):
        for operand in ir.operands(node):
            if isinstance(operand, Temp) and loops[: len(home[operand])] != home[operand]:
                raise InternalError(f"{name}: temporary {operand.index} is read outside its loop")
        for each in (o for o in ir.operands(node) if isinstance(o, Element)):
            if each.space is Space.LOCAL and each.name not in begun:
                raise InternalError(f"{name}: {each} is read before it is written")
        if isinstance(node, Operate | Copy):
            home[node.target] = loops
        if isinstance(node, ir.Assign | ir.OfMatrices):
            begun.add(node.target.name)
        _check_indices(name, node, loops, sizes)


def _check_indices(
    name: str, node: ir.Statement, loops: tuple[ir.For, ...], sizes: Mapping[str, int]
) -> None:
    """The variables of the indices of a statement are those of loops around it, in their arrays."""
    known = {loop.index for loop in loops}
    elements = [each for each in ir.operands(node) if isinstance(each, Element) and each.moves]
    asked: list[Any] = [each.index for each in elements]
    match node:
        case ir.For(index, begin, end):
            asked += [begin, end]
            if index in known:
                raise InternalError(f"{name}: two loops over {index}, one in the other")
        case ir.IfPresent(row):
            asked.append(row)
        case ir.Assign(target) | ir.Product(target) | ir.Triangle(target) if target.moves:
            elements.append(target)
            asked.append(target.index)
    if unknown := {*names_in(*asked)} - known:
        raise InternalError(f"{name}: no loop over {', '.join(sorted(unknown))}")
    for each in elements:
        if any(not 0 <= (at or 0) < sizes[each.name] for at in ir.places(each.index, loops)):
            raise InternalError(f"{name}: {each} is outside of its array")
