"""Find what a program does more than once and make it a routine; cut functions that are too long.

The unit is the block of a phase. Two runs of blocks are the same if their statements are, up to the
arrays they work on, the numbers they use and the rows of y they ask for: those become arguments,
a table of constants and bits. The statements and their order stay, and so do the bits.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

from fkgen.backend.ir import (
    Argument,
    Assign,
    Call,
    Copy,
    CProgram,
    Element,
    Expression,
    Heading,
    IfPositive,
    IfPresent,
    Literal,
    Local,
    Operand,
    Operate,
    Phase,
    Require,
    Routine,
    Row,
    RowArgument,
    Space,
    Statement,
    Table,
    TableArgument,
    Temp,
    operands,
    walk,
)
from fkgen.errors import InternalError

#: Fewer lines than this are not worth a call.
SHORTEST = 8
#: A routine is worth its prototype, its braces and its calls.
OVERHEAD = 6
#: Lines of one function before it is cut, so that it stays below 400 with what is around them.
LONGEST = 300
#: Lines beyond which a program stays as it is: the search would take longer than the compiler.
LARGEST = 8000

#: So often something is done, and so many statements it has, where it becomes a block of its own.
MANY = 3

Chunk = tuple[Statement, ...]
Variable = tuple[Space, str]
_Place = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Form:
    """Statements up to names, numbers and rows, and what stands in their places."""

    shape: tuple[Any, ...]
    variables: tuple[tuple[Variable, int | None], ...]
    literals: tuple[float, ...]
    rows: tuple[Row, ...]
    tables: tuple[Table | TableArgument, ...]


class _Reader:
    """Walks statements in order and numbers what it meets."""

    def __init__(self) -> None:
        self.temps: dict[int, int] = {}
        self.variables: dict[Variable, tuple[int, int | None]] = {}
        self.literals: list[float] = []
        self.rows: list[Row] = []
        self.tables: list[Table | TableArgument] = []

    def operand(self, operand: Operand) -> Any:
        match operand:
            case Temp(index):
                return "t", self.temps.setdefault(index, len(self.temps))
            case Literal(value):
                self.literals.append(value)
                return "#"
            case Expression(operator, arguments):
                return operator, tuple(map(self.operand, arguments))
            case Element(Space.PARAMETER):
                return operand
        key = operand.space, operand.name
        slot, base = self.variables.setdefault(key, (len(self.variables), operand.index))
        return slot, (operand.index or 0) - (base or 0)

    def statement(self, node: Statement) -> Any:  # noqa: PLR0911 - one per node
        match node:
            case Operate(target, operator, arguments):
                return operator, tuple(map(self.operand, arguments)), self.operand(target)
            case Copy(target, value):
                return "copy", self.operand(value), self.operand(target)
            case Assign(target, value):
                return "assign", self.operand(value), self.operand(target)
            case Require(values, kind, status):
                return kind, status, tuple(map(self.operand, values))
            case IfPresent(row, body):
                if row is not None:
                    self.rows.append(row)
                return "present", row is None, tuple(map(self.statement, body))
            case IfPositive(value, body):
                return "positive", self.operand(value), tuple(map(self.statement, body))
            case Call(routine, arguments, constants, rows, tables):
                self.rows += rows
                self.tables += (*(() if constants is None else (constants,)), *tables)
                return routine, tuple(map(self.operand, arguments))
        return "heading"


def form_of(statements: Sequence[Statement]) -> Form:
    """The form of statements."""
    reader = _Reader()
    shape = tuple(map(reader.statement, statements))
    variables = tuple((key, base) for key, (_, base) in reader.variables.items())
    tables = tuple(reader.tables)
    return Form(shape, variables, tuple(reader.literals), tuple(reader.rows), tables)


class Writer:
    """Walks statements in the same order and puts other operands and rows into their places.

    Values are numbered anew.
    """

    def __init__(
        self,
        operand: Callable[[Operand], Operand],
        row: Callable[[Row], Row] = lambda row: row,
        table: Callable[[Table | TableArgument], Table | TableArgument] = lambda table: table,
        known: Mapping[int, Temp | Element] | None = None,
    ) -> None:
        self._operand, self._row, self._table = operand, row, table
        self._known = known or {}
        self._temps: dict[int, Temp] = {}

    def operand(self, operand: Any) -> Any:
        """An operand."""
        if isinstance(operand, Expression):
            return replace(operand, arguments=tuple(map(self.operand, operand.arguments)))
        if isinstance(operand, Temp) and operand.index in self._known:
            return self._known[operand.index]
        if isinstance(operand, Temp):
            return self._temps.setdefault(operand.index, Temp(len(self._temps)))
        return self._operand(operand)

    def many(self, nodes: Sequence[Statement]) -> Chunk:
        """Statements in a row."""
        return tuple(map(self.statement, nodes))

    def statement(self, node: Statement) -> Statement:  # noqa: PLR0911 - one per node
        """One statement."""
        match node:
            case Operate(target, operator, arguments):
                values = tuple(map(self.operand, arguments))
                return Operate(self.operand(target), operator, values)
            case Copy(target, value):
                kept = self.operand(value)
                return Copy(self.operand(target), kept)
            case Assign(target, value):
                kept = self.operand(value)
                return Assign(self.operand(target), kept)
            case Require(values, kind, status):
                return Require(tuple(map(self.operand, values)), kind, status)
            case IfPresent(row, body):
                return IfPresent(None if row is None else self._row(row), self.many(body))
            case IfPositive(value, body):
                return IfPositive(self.operand(value), self.many(body))
            case Call(routine, arguments, constants, rows, tables):
                values = tuple(map(self.operand, arguments))
                own = tuple(map(self._row, rows))
                first = None if constants is None else self._table(constants)
                return Call(routine, values, first, own, tuple(map(self._table, tables)))
        return node


@dataclass(slots=True)
class _Function:
    """A function that is being rewritten: a phase, or the body of a routine."""

    name: str
    chunks: list[Chunk]
    locals: list[Local]
    sections: list[str]
    forms: list[Form] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.forms = [form_of(chunk) for chunk in self.chunks]

    def whole(self, start: int, end: int) -> bool:
        """Whether chunks are part of one section, or whole sections."""
        sections = self.sections
        within = len(set(sections[start:end])) == 1
        begins = start == 0 or sections[start - 1] != sections[start]
        return within or (begins and (sections[end:] or [""])[0] != sections[end - 1])

    def put(self, start: int, length: int, chunks: list[Chunk]) -> None:
        """Other chunks in place of some."""
        where = slice(start, start + length)
        self.chunks[where] = chunks
        self.forms[where] = [form_of(chunk) for chunk in chunks]
        self.sections[where] = [self.sections[start]] * len(chunks)

    def users(self, name: str) -> set[int]:
        """Which chunks use a local."""
        key = (Space.LOCAL, name)
        return {i for i, form in enumerate(self.forms) if key in dict(form.variables)}

    def split(self) -> None:
        """Cut blocks that are too long; what later statements read is carried in an array."""
        at = 0
        while at < len(self.chunks):
            chunk = self.chunks[at]
            if len(chunk) > LONGEST and not any(
                isinstance(n, IfPresent | IfPositive) for n in chunk
            ):
                name = f"carried_{len(self.locals)}"
                pieces, size = _halves(chunk, name)
                self.locals.append(Local(name, size, None))
                self.put(at, 1, pieces)
                continue
            at += 1

    @property
    def body(self) -> Chunk:
        return tuple(node for chunk in self.chunks for node in chunk)


@dataclass(frozen=True, slots=True)
class _Run:
    """Some chunks in a row."""

    function: _Function
    start: int
    length: int

    @property
    def statements(self) -> Chunk:
        chunks = self.function.chunks[self.start : self.start + self.length]
        return tuple(node for chunk in chunks for node in chunk)

    @property
    def headings(self) -> list[str]:
        """The headings inside, or the one that it stands under."""
        before = self.function.chunks[: self.start]
        inside = [node.text for node in self.statements if isinstance(node, Heading)]
        above = [n.text for chunk in reversed(before) for n in chunk if isinstance(n, Heading)]
        return inside or above[:1] or [self.function.name.replace("_", " ")]

    @property
    def is_call(self) -> bool:
        """Whether it does nothing but call one routine."""
        done = [node for node in self.statements if not isinstance(node, Heading)]
        return len(done) == 1 and isinstance(done[0], Call)

    def is_private(self, name: str) -> bool:
        """Whether nothing outside uses a local."""
        inside = range(self.start, self.start + self.length)
        return self.function.users(name) <= set(inside)


@dataclass(frozen=True, slots=True)
class Outline:
    """The phases as they are printed, and the routines that they call, callees first."""

    phases: tuple[Phase, ...]
    routines: tuple[Routine, ...]

    @property
    def bodies(self) -> tuple[Chunk, ...]:
        """The statements of all functions."""
        return (
            *(phase.body for phase in self.phases),
            *(routine.body for routine in self.routines),
        )


def outline(program: CProgram) -> Outline:
    """Rewrite the phases of a program with calls."""
    verbs = ["correct", *(["close_window"] if program.closing else []), "propagate"]
    if sum(lines_of(phase.body) for phase in program.phases) > LARGEST:
        return Outline(program.phases, ())
    functions = [_function(*each) for each in zip(verbs, program.phases, strict=True)]
    book = _Book(functions)
    while runs := book.repeated():
        book.take(runs)
    for function in list(book.functions):
        book.cut(function)
    phases = tuple(
        replace(phase, body=function.body, locals=book.locals(function), chunks=())
        for phase, function in zip(program.phases, functions, strict=True)
    )
    return Outline(phases, book.routines())


def _function(verb: str, phase: Phase) -> _Function:
    ends = (*(at for at, _ in phase.chunks[1:]), len(phase.body))
    chunks: list[Chunk] = []
    sections: list[str] = []
    for (start, section), end in zip(phase.chunks, ends, strict=True):
        body = phase.body[start:end]
        pieces = [
            p for _, g in groupby(body, lambda n: isinstance(n, Heading)) for p in _apart(tuple(g))
        ]
        chunks += pieces
        sections += [section] * len(pieces)
    return _Function(verb, chunks, list(phase.locals), sections)


def _apart(chunk: Chunk) -> list[Chunk]:
    """What a chunk does several times with other numbers, one after the other."""
    if any(isinstance(node, Copy | IfPresent | IfPositive) for node in chunk):
        return [chunk]
    written = {node.target for node in chunk if isinstance(node, Assign)}
    computed = (o for node in chunk if isinstance(node, Operate) for o in node.arguments)
    parts = [] if written & set(computed) else _independent(chunk)
    shapes = Counter(form_of(part).shape for part in parts)
    apart = [p for p in parts if len(p) >= MANY and shapes[form_of(p).shape] >= MANY]
    moved = {id(node) for part in apart for node in part}
    rest = tuple(node for node in chunk if id(node) not in moved)
    guards = [node for part in (rest, *apart) for node in part if isinstance(node, Require)]
    if not apart or guards != [node for node in chunk if isinstance(node, Require)]:
        return [chunk]
    return [rest, *apart] if rest else apart


def _independent(chunk: Chunk) -> list[Chunk]:
    """Statements in groups that share no value that is computed or asked for."""
    parent = list(range(len(chunk)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = i = parent[parent[i]]
        return i

    owner: dict[Any, int] = {}
    for i, node in enumerate(chunk):
        keys = [o for o in operands(node) if isinstance(o, Temp) or not isinstance(node, Operate)]
        keys += [node.target] if isinstance(node, Operate) else []
        for key in keys:
            parent[root(i)] = root(owner.setdefault(key, i))
    groups: dict[int, list[Statement]] = defaultdict(list)
    for i, node in enumerate(chunk):
        groups[root(i)].append(node)
    return list(map(tuple, groups.values()))


def lines_of(statements: Chunk) -> int:
    """About how many lines statements take in C."""
    braced = (Require, IfPresent, IfPositive)
    return sum(
        4 if isinstance(n, braced) else 5 + len(n.arguments) // 3 if isinstance(n, Call) else 1
        for n in walk(statements)
    )


class _Book:
    """The functions of a program while routines are found."""

    def __init__(self, functions: list[_Function]) -> None:
        self.functions = list(functions)
        self.bodies: dict[str, tuple[Routine, _Function]] = {}

    def repeated(self) -> list[_Run]:
        """The runs whose outlining saves most; none if nothing is worth it."""
        best: tuple[int, list[_Run]] = (0, [])
        seen: set[_Place] = set()
        for place in self._candidates():
            if place in seen:
                continue
            f, start, length = place
            run = _Run(self.functions[f], start, length)
            runs = self._like(run, seen)
            lines = lines_of(run.statements)
            call = 2 + len(form_of(run.statements).variables) // 3
            saved = (len(runs) - 1) * lines - OVERHEAD - len(runs) * call
            enough = len(runs) > 1 and lines >= SHORTEST and not run.is_call
            if enough and saved > best[0]:
                best = saved, runs
        return best[1]

    def _candidates(self) -> Iterator[_Place]:
        """The longest runs that begin with each pair of chunks of one shape."""
        places: dict[Any, list[tuple[int, int]]] = defaultdict(list)
        for f, function in enumerate(self.functions):
            for i, form in enumerate(function.forms):
                places[form.shape].append((f, i))
        for same in places.values():
            for a, (f, i) in enumerate(same):
                for g, j in same[a + 1 :]:
                    one, other = self.functions[f].forms[i:], self.functions[g].forms[j:]
                    length = _alike(one[: j - i] if f == g else one, other)
                    while length > 1 and (
                        one[length - 1].shape == ("heading",)
                        or not self.functions[f].whole(i, i + length)
                        or not self.functions[g].whole(j, j + length)
                    ):
                        length -= 1
                    yield f, i, length

    def _like(self, run: _Run, seen: set[_Place]) -> list[_Run]:
        """All runs like this one that do not overlap."""
        forms = run.function.forms[run.start : run.start + run.length]
        found = []
        for f, function in enumerate(self.functions):
            at = 0
            while at + run.length <= len(function.forms):
                same = _alike(forms, function.forms[at : at + run.length]) == run.length
                if same and function.whole(at, at + run.length):
                    seen.add((f, at, run.length))
                    found.append(_Run(function, at, run.length))
                    at += run.length
                else:
                    at += 1
        return found

    def take(self, runs: list[_Run]) -> None:
        """Make one routine of runs of one form and replace them by calls."""
        titles = _titles(runs)
        arguments = {name: routine.arguments for name, (routine, _) in self.bodies.items()}
        draft = _Draft(runs, self._name(titles), titles, arguments)
        routine, calls = draft.routine, draft.calls
        first, end = runs[0], runs[0].start + runs[0].length
        sections = first.function.sections[first.start : end]
        body = _Function(routine.name, draft.chunks, list(routine.locals), sections)
        headed = [isinstance(run.statements[0], Heading) for run in runs]
        for run, call, title, with_title in sorted(
            zip(runs, calls, titles, headed, strict=True), key=lambda each: -each[0].start
        ):
            text = (Heading(title), call) if with_title else (call,)
            run.function.put(run.start, run.length, [text])
        for function in {id(run.function): run.function for run in runs}.values():
            function.locals = [local for local in function.locals if function.users(local.name)]
        self.functions.append(body)
        self.bodies[routine.name] = routine, body

    def cut(self, function: _Function) -> None:
        """Cut a function that is too long into routines that are called once."""
        function.split()
        while lines_of(function.body) > LONGEST:
            run = max(self._pieces(function), key=lambda run: lines_of(run.statements))
            if run.is_call or run.length == len(function.chunks):
                return
            self.take([run])

    @staticmethod
    def _pieces(function: _Function) -> Iterator[_Run]:
        """As much as a routine may hold: whole sections from each heading on, or from anywhere."""
        forms, end = function.forms, len(function.forms)
        headed = [i for i, form in enumerate(forms) if form.shape[0] == "heading"]
        sizes = [lines_of(chunk) for chunk in function.chunks]
        for start in range(end):
            within = [k for k in range(start + 1, end + 1) if sum(sizes[start:k]) <= LONGEST]
            sections = [k for k in within if start in headed and k in {*headed, end}]
            stop = max(sections or ([] if headed else within), default=start + 1)
            yield _Run(function, start, stop - start)

    def _name(self, titles: list[str]) -> str:
        """A name after what the titles of the runs have in common."""
        words = [re.findall(r"[a-z]+", re.split("[:,]", title.lower())[0]) for title in titles]
        shared = [w for w in words[0] if all(w in other for other in words)][:4]
        while shared and shared[-1] in _FILLING:
            shared.pop()
        stem = "_".join(shared) or "part"
        name, count = stem, 1
        while name in self.bodies or name in _FUNCTIONS:
            count += 1
            name = f"{stem}_{count}"
        return name

    def _refuses(self, node: Statement) -> bool:
        """Whether a statement may end the function."""
        if isinstance(node, Call):
            return any(map(self._refuses, walk(self.bodies[node.routine][1].body)))
        return isinstance(node, Require)

    def locals(self, function: _Function) -> tuple[Local, ...]:
        """Locals; what a call writes that may refuse begins at 0: compilers do not follow it."""
        passed = {
            element.name
            for node in walk(function.body)
            if isinstance(node, Call) and self._refuses(node)
            for element in node.arguments
            if element.space is Space.LOCAL
        }
        return tuple(
            replace(local, initial=0.0) if local.name in passed and local.initial is None else local
            for local in function.locals
        )

    def routines(self) -> tuple[Routine, ...]:
        """All routines, callees first."""
        ordered: dict[str, Routine] = {}

        def visit(name: str) -> None:
            routine, body = self.bodies[name]
            for node in walk(body.body):
                if isinstance(node, Call) and node.routine not in ordered:
                    visit(node.routine)
            ordered[name] = replace(routine, body=body.body, locals=self.locals(body))

        for name in self.bodies:
            if name not in ordered:
                visit(name)
        return tuple(ordered.values())


def _alike(one: Sequence[Form], other: Sequence[Form]) -> int:
    """How many forms, from the first on, are the same with the same renaming of variables."""
    there: dict[Variable, tuple[Variable, int | None]] = {}
    back: dict[Variable, Variable] = {}
    for length, (a, b) in enumerate(zip(one, other, strict=False)):
        if a.shape != b.shape:
            return length
        for (key, base), (name, at) in zip(a.variables, b.variables, strict=True):
            shift = (at or 0) - (base or 0)
            if there.setdefault(key, (name, shift)) != (name, shift):
                return length
            if back.setdefault(name, key) != key:
                return length
    return min(len(one), len(other))


#: Words that a name does not end with.
_FILLING = {"a", "and", "by", "every", "for", "in", "of", "s", "the", "what", "with"}

#: Functions that every filter has.
_FUNCTIONS = {
    *("correct", "close_window", "propagate", "init", "fill", "finite", "finite_input", "defect"),
    *("update", "predict", "step", "selftest", "present_rows", "params_init", "part"),
    *("exp", "log", "sqrt", "sin", "cos", "tan", "atan2", "reduced", "power_of_two"),
}

#: Names that an argument or a local of a routine must not have.
_TAKEN = {"self", "next", "params", "present", "numbers", "status"}


class _Draft:
    """A routine in the making: what differs between the runs becomes arguments."""

    def __init__(
        self,
        runs: list[_Run],
        name: str,
        titles: list[str],
        known: Mapping[str, tuple[Argument, ...]],
    ) -> None:
        self.runs, self.forms = runs, [form_of(run.statements) for run in runs]
        self.names: set[str] = set(_TAKEN)
        self.places: dict[Variable, Callable[[int | None], Element]] = {}
        self.arguments: list[Argument] = []
        self.bindings: list[list[Element]] = [[] for _ in runs]
        self.locals: list[Local] = []
        self._indices, self._written, self._passed = _uses(runs[0].statements, known)
        for slot in range(len(self.forms[0].variables)):
            self._place(slot)
        self.columns = _Columns([form.literals for form in self.forms])
        self.row_columns = _Columns([form.rows for form in self.forms])
        self.table_columns = _Columns([form.tables for form in self.forms])
        self.chunks = self._chunks()
        self.routine = Routine(
            name=name,
            title="; ".join(dict.fromkeys(titles)),
            arguments=tuple(self.arguments),
            constants=self.columns.table,
            rows=len(self.row_columns.table[0]),
            tables=len(self.table_columns.table[0]),
            locals=tuple(self.locals),
            body=tuple(node for chunk in self.chunks for node in chunk),
        )
        self.calls = [
            Call(
                name,
                tuple(bound),
                Table(name, i) if self.columns.table[0] else None,
                tuple(self.row_columns.table[i]),
                tuple(self.table_columns.table[i]),
            )
            for i, bound in enumerate(self.bindings)
        ]
        for form, call in zip(self.forms, self.calls, strict=True):
            if form_of(expanded(self.routine, call, self._originals(form))) != form:
                raise InternalError(f"routine {name} is not what it stands for")

    def _place(self, slot: int) -> None:
        """Decide where one variable of the first run stands in the routine."""
        each = [form.variables[slot] for form in self.forms]
        key, base = each[0]
        name = self._name([name for (_, name), _ in each])
        own = [self._private(run, *variable) for run, variable in zip(self.runs, each, strict=True)]
        if own[0] is not None and all(o is not None and _like(o, own[0]) for o in own):
            self.locals.append(replace(own[0], name=name))
            self.places[key] = lambda index: Element(Space.LOCAL, name, index)
            return
        low = min((i for i in self._indices[key] if i is not None), default=0)
        single = key not in self._written | self._passed and len(self._indices[key]) == 1
        self.arguments.append(Argument(name, key in self._written, single))
        for bound, ((space, own_name), at) in zip(self.bindings, each, strict=True):
            begin = None if at is None else at - (base or 0) + low
            bound.append(Element(space, own_name, begin))
        self.places[key] = lambda index: Element(
            Space.ARGUMENT, name, None if single else (index or 0) - low
        )

    def _private(self, run: _Run, key: Variable, base: int | None) -> Local | None:
        if key[0] is not Space.LOCAL or not run.is_private(key[1]):
            return None
        found = next(local for local in run.function.locals if local.name == key[1])
        return replace(found, name=str(base))

    def _name(self, names: list[str]) -> str:
        """What the names of the runs have in common."""
        tokens = [name.split("_") for name in names]
        shared = [t for t in tokens[0] if all(t in other for other in tokens)]
        if len({len(each) for each in tokens}) == 1:
            shared = [each[0] for each in zip(*tokens, strict=True) if len(set(each)) == 1]
        stem = "_".join(shared) if shared and not shared[0].isdigit() else names[0]
        name, count = stem, 1
        while name in self.names:
            count += 1
            name = f"{stem}_{count}"
        self.names.add(name)
        return name

    def _chunks(self) -> list[Chunk]:
        literals, rows = iter(self.columns.places), iter(self.row_columns.places)
        tables = iter(self.table_columns.places)

        def operand(operand: Operand) -> Operand:
            if isinstance(operand, Literal):
                at = next(literals)
                return operand if at is None else Element(Space.CONSTANT, "numbers", at)
            if isinstance(operand, Element) and operand.space is not Space.PARAMETER:
                return self.places[operand.space, operand.name](operand.index)
            return operand

        def row(row: Row) -> Row:
            at = next(rows)
            return row if at is None else RowArgument(at)

        def table(table: Table | TableArgument) -> Table | TableArgument:
            at = next(tables)
            return table if at is None else TableArgument(at)

        writer, run = Writer(operand, row, table), self.runs[0]
        chunks = run.function.chunks[run.start : run.start + run.length]
        return [writer.many(chunk) for chunk in chunks]

    def _originals(self, form: Form) -> dict[str, str]:
        """Names of the routine's locals in one run."""
        result = {}
        for (first, _), ((_, name), _) in zip(self.forms[0].variables, form.variables, strict=True):
            place = self.places[first](0)
            if place.space is Space.LOCAL:
                result[place.name] = name
        return result


class _Columns:
    """Values at the same places of several runs: those that differ become columns of a table."""

    def __init__(self, values: Sequence[Sequence[Any]]) -> None:
        columns: dict[tuple[str, ...], int] = {}
        kept: list[tuple[Any, ...]] = []
        self.places: list[int | None] = []
        for each in zip(*values, strict=True):
            key = tuple(map(repr, each))
            if len(set(key)) == 1 and not isinstance(each[0], RowArgument | TableArgument):
                self.places.append(None)
                continue
            if key not in columns:
                columns[key] = len(kept)
                kept.append(each)
            self.places.append(columns[key])
        self.table = tuple(tuple(column[i] for column in kept) for i in range(len(values)))


def expanded(routine: Routine, call: Call, locals_: dict[str, str]) -> Chunk:
    """The statements that a call runs, in the names of the caller."""
    bound = {
        argument.name: element
        for argument, element in zip(routine.arguments, call.arguments, strict=True)
    }

    def operand(operand: Operand) -> Operand:
        match operand:
            case Element(Space.ARGUMENT, name, index):
                begin = bound[name]
                if index is None or begin.index is None:
                    return begin
                return replace(begin, index=begin.index + index)
            case Element(Space.CONSTANT, "numbers", index) if (
                isinstance(call.constants, Table) and index is not None and routine.constants[0]
            ):
                return Literal(routine.constants[call.constants.row][index])
            case Element(Space.LOCAL, name, _):
                return replace(operand, name=locals_[name])
        return operand

    def row(row: Row) -> Row:
        return call.rows[row.index] if isinstance(row, RowArgument) else row

    def table(table: Table | TableArgument) -> Table | TableArgument:
        return call.tables[table.index] if isinstance(table, TableArgument) else table

    return Writer(operand, row, table).many(routine.body)


def _uses(
    statements: Chunk, known: Mapping[str, tuple[Argument, ...]]
) -> tuple[dict[Variable, set[int | None]], set[Variable], set[Variable]]:
    """The elements of each variable that are used; what is written; what is passed on as array."""
    indices: dict[Variable, set[int | None]] = defaultdict(set)
    written: set[Variable] = set()
    passed: set[Variable] = set()
    for node in walk(statements):
        for element in _own_elements(node):
            indices[element.space, element.name].add(element.index)
        if isinstance(node, Assign):
            written.add((node.target.space, node.target.name))
        if isinstance(node, Call):
            pairs = zip(known[node.routine], node.arguments, strict=True)
            arrays = [(argument, (e.space, e.name)) for argument, e in pairs if not argument.single]
            passed |= {key for _, key in arrays}
            written |= {key for argument, key in arrays if argument.written}
    return indices, written, passed


def _like(a: Local, b: Local) -> bool:
    return (a.name, a.size, a.initial) == (b.name, b.size, b.initial)


def _titles(runs: list[_Run]) -> list[str]:
    """For each run the heading that tells it from the others; the first one, where none does."""
    each = [run.headings for run in runs]
    telling = [texts for texts in zip(*each, strict=False) if len(set(texts)) == len(runs)]
    if len(runs) > 1 and telling:
        return list(telling[0])
    return [headings[0] for headings in each]


def _own_elements(node: Statement) -> Iterator[Element]:
    yield from (o for o in operands(node) if isinstance(o, Element))
    if isinstance(node, Assign):
        yield node.target


def _halves(chunk: Chunk, name: str) -> tuple[list[Chunk], int]:
    """Two parts of a chunk, the first short enough, cut where the fewest numbers cross."""
    made = {o.target.index: i for i, o in enumerate(chunk) if isinstance(o, Operate | Copy)}
    early = {temp: i for temp, i in made.items() if i < LONGEST}
    last: dict[int, int] = {}
    for i, node in enumerate(chunk):
        last |= {o.index: i for o in operands(node) if isinstance(o, Temp)}

    def crossing(cut: int) -> list[int]:
        return [temp for temp, i in early.items() if i < cut <= last.get(temp, -1)]

    cut = min(range(LONGEST // 2, LONGEST - 40), key=lambda at: (len(crossing(at)), -at))
    carried = {temp: i for i, temp in enumerate(crossing(cut))}
    size = max(len(carried), 2)
    place = {temp: Element(Space.LOCAL, name, i) for temp, i in carried.items()}
    keep = tuple(Assign(element, Temp(temp)) for temp, element in place.items())
    known = {temp: place.get(temp, Temp(temp)) for temp in made}
    rest = Writer(lambda operand: operand, known=known).many(chunk[cut:])
    return [(*chunk[:cut], *keep), rest], size
