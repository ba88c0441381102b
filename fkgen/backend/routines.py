"""Find what a program does more than once and make it a routine; cut functions that are too long.

The unit is the block of a phase. Two runs of blocks are the same if their statements are, up to the
arrays they work on, the numbers they use and the rows of y they ask for: those become arguments,
a table of constants and bits. The statements and their order stay, and so do the bits.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, combinations, count, groupby
from typing import Any, get_args

from fkgen.backend import ir
from fkgen.backend.ir import Element, Space
from fkgen.errors import InternalError
from fkgen.symbolic.index import Index, Whole

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

#: Words that a name does not end with.
_FILLING = {"a", "and", "by", "every", "for", "in", "of", "s", "the", "what", "with"}

#: Functions that every filter has.
_FUNCTIONS = {
    *("correct", "close_window", "propagate", "init", "fill", "finite", "defect"),
    *("update", "predict", "step", "pass", "renew", "keep", "start", "begin", "all_finite"),
    *("selftest", "present_rows", "params_init", "finite_params", "part"),
    *("product", "unpack", "packed", "fused"),
    *ir.FUNCTIONS,
    *("reduced", "power_of_two"),
}

#: Names that an argument or a local of a routine must not have.
_TAKEN = {"self", "next", "params", "present", "numbers", "status"}

#: What stands in a routine for a number, a row of y and a table that its calls do not share.
_GIVEN = (partial(Element, Space.CONSTANT, "numbers"), ir.RowArgument, ir.TableArgument)

_HEADING = ir.Heading("")

Variable = tuple[Space, str]


@dataclass(frozen=True, slots=True)
class Form:
    """Statements up to names, numbers and rows, and what stands in their places."""

    shape: ir.Body
    variables: tuple[tuple[Variable, int | None], ...]
    literals: tuple[float, ...]
    rows: tuple[ir.Row, ...]
    tables: tuple[ir.Table | ir.TableArgument, ...]


def form_of(statements: Sequence[ir.Statement]) -> Form:
    """The form of statements: what they consist of is numbered in their order."""
    temps: dict[int, int] = {}
    variables: dict[Variable, tuple[int, int | None]] = {}
    given: tuple[list[Any], ...] = [], [], []

    def part(part: Any) -> Any:
        match part:
            case ir.Temp(index):
                return temps.setdefault(index, len(temps))
            case Element(Space.PARAMETER):
                return part
            case Element(space, name, index):
                own = 0 if isinstance(index, Index) else index  # loops count from the first element
                slot, base = variables.setdefault((space, name), (len(variables), own))
                return slot, (index or 0) - (base or 0)
            case Index():
                return part
        given[_kind(part)].append(part.value if isinstance(part, ir.Literal) else part)
        return "given"

    shape = tuple(_HEADING if isinstance(n, ir.Heading) else ir.mapped(n, part) for n in statements)
    bases = tuple((key, base) for key, (_, base) in variables.items())
    return Form(shape, bases, *map(tuple, given))


def _kind(part: Any) -> int:
    """Of what a call may give: 0 for a number, 1 for a row of y, 2 for a table."""
    return 0 if isinstance(part, ir.Literal) else 1 if isinstance(part, int | ir.RowArgument) else 2


@dataclass(slots=True)
class _Block:
    """Statements that stay together."""

    statements: ir.Body
    section: str
    form: Form = field(init=False)
    key: int = field(init=False)  # other for most other shapes
    names: frozenset[Variable] = field(init=False)
    lines: int = field(init=False)

    def __post_init__(self) -> None:
        self.form = form_of(self.statements)
        self.key = hash(self.form.shape)
        self.names = frozenset(key for key, _ in self.form.variables)
        self.lines = lines_of(self.statements)


@dataclass(slots=True, eq=False)
class _Function:
    """A function that is being rewritten: a phase, or the body of a routine."""

    name: str
    blocks: list[_Block]
    locals: list[ir.Local]

    def users(self, name: str) -> set[int]:
        """Which blocks use a local."""
        key = (Space.LOCAL, name)
        return {i for i, block in enumerate(self.blocks) if key in block.names}

    def split(self) -> None:
        """Cut blocks that are too long; what later statements read is carried in an array."""
        at = 0
        while at < len(self.blocks):
            chunk = self.blocks[at].statements
            if len(chunk) > LONGEST and not any(
                isinstance(n, ir.Nested | ir.OfMatrices) for n in chunk
            ):
                name = f"carried_{len(self.locals)}"
                pieces, size = _halves(chunk, name)
                self.locals.append(ir.Local(name, size, None))
                _Run(self, at, at + 1).put(pieces)
                # What crosses may make a part longer again than what it was cut to.
                at += len(pieces[0]) > LONGEST
            else:
                at += 1

    @property
    def body(self) -> ir.Body:
        return tuple(node for block in self.blocks for node in block.statements)


@dataclass(frozen=True, slots=True)
class _Run:
    """Some blocks in a row."""

    function: _Function
    start: int
    end: int

    @property
    def blocks(self) -> list[_Block]:
        return self.function.blocks[self.start : self.end]

    @property
    def statements(self) -> ir.Body:
        return tuple(node for block in self.blocks for node in block.statements)

    def is_whole(self) -> bool:
        """Whether it is part of one section, or whole sections."""
        sections = [block.section for block in self.function.blocks]
        begins = self.start == 0 or sections[self.start - 1] != sections[self.start]
        ends = (sections[self.end :] or [""])[0] != sections[self.end - 1]
        return len(set(sections[self.start : self.end])) == 1 or (begins and ends)

    def put(self, chunks: list[ir.Body]) -> None:
        """Other statements in its place."""
        section = self.blocks[0].section
        self.function.blocks[self.start : self.end] = [_Block(chunk, section) for chunk in chunks]

    @property
    def headings(self) -> list[str]:
        """The headings inside, or the one that it stands under."""
        before = _Run(self.function, 0, self.start).statements
        inside, above = ([*ir.every(ir.Heading, body)] for body in (self.statements, before))
        own = [heading.text for heading in inside or above[-1:]]
        return own or [self.function.name.replace("_", " ")]

    @property
    def is_call(self) -> bool:
        """Whether it does nothing but call one routine."""
        done = [node for node in self.statements if not isinstance(node, ir.Heading)]
        return len(done) == 1 and isinstance(done[0], ir.Call)

    def private(self, key: Variable, base: int | None) -> tuple[int | None, ir.Local] | None:
        """The local that a variable is, nameless, and where it begins; None if others use it."""
        inside = {*range(self.start, self.end)}
        if key[0] is not Space.LOCAL or not self.function.users(key[1]) <= inside:
            return None
        found = next(local for local in self.function.locals if local.name == key[1])
        return base, replace(found, name="")


@dataclass(frozen=True, slots=True)
class Outline:
    """The phases as they are printed, and the routines that they call, callees first."""

    phases: tuple[ir.Phase, ...]
    routines: tuple[ir.Routine, ...]

    @property
    def bodies(self) -> tuple[ir.Body, ...]:
        """The statements of all functions."""
        return (*(phase.body for phase in self.phases), *(each.body for each in self.routines))

    @property
    def of_matrices(self) -> tuple[ir.OfMatrices, ...]:
        """The statements about whole matrices."""
        nodes = (node for body in self.bodies for node in ir.walk(body))
        return tuple(node for node in nodes if isinstance(node, ir.OfMatrices))


def outline(program: ir.CProgram) -> Outline:
    """Rewrite the phases of a program with calls."""
    phases = tuple(program.verbs.values())
    if sum(lines_of(phase.body) for phase in phases) > LARGEST:
        return Outline(phases, ())
    functions = [_function(verb, phase) for verb, phase in program.verbs.items()]
    book = _Book(functions)
    while runs := book.repeated():
        book.take(runs)
    for function in list(book.functions):
        book.cut(function)
    rewritten = tuple(
        replace(phase, body=function.body, locals=book.locals(function), chunks=())
        for phase, function in zip(phases, functions, strict=True)
    )
    return Outline(rewritten, book.routines())


def _function(verb: str, phase: ir.Phase) -> _Function:
    ends = (*(at for at, _ in phase.chunks[1:]), len(phase.body))
    blocks = [
        _Block(part, section)
        for (start, section), end in zip(phase.chunks, ends, strict=True)
        for _, nodes in groupby(phase.body[start:end], lambda node: isinstance(node, ir.Heading))
        for part in _apart(tuple(nodes))
    ]
    return _Function(verb, blocks, list(phase.locals))


def _apart(chunk: ir.Body) -> list[ir.Body]:
    """What a chunk does several times with other numbers, one after the other."""
    if any(isinstance(node, ir.Copy | ir.Nested | ir.OfMatrices) for node in chunk):
        return [chunk]
    written = {node.target for node in ir.every(ir.Assign, chunk)}
    computed = (o for node in ir.every(ir.Operate, chunk) for o in node.arguments)
    parts = [] if written & set(computed) else _independent(chunk)
    shapes = Counter(form_of(part).shape for part in parts)
    apart = [p for p in parts if len(p) >= MANY and shapes[form_of(p).shape] >= MANY]
    moved = {id(node) for part in apart for node in part}
    rest = tuple(node for node in chunk if id(node) not in moved)
    guards = [*ir.every(ir.Require, (*rest, *chain(*apart)))]
    if not apart or guards != [*ir.every(ir.Require, chunk)]:
        return [chunk]
    return [rest, *apart] if rest else apart


def _independent(chunk: ir.Body) -> list[ir.Body]:
    """Statements in groups that share no value that is computed or asked for."""
    parent = list(range(len(chunk)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = i = parent[parent[i]]
        return i

    owner: dict[Any, int] = {}
    for i, node in enumerate(chunk):
        keys = [*ir.operands(node)]
        if isinstance(node, ir.Operate):
            keys = [node.target, *(key for key in keys if isinstance(key, ir.Temp))]
        for key in keys:
            parent[root(i)] = root(owner.setdefault(key, i))
    groups: dict[int, list[ir.Statement]] = defaultdict(list)
    for i, node in enumerate(chunk):
        groups[root(i)].append(node)
    return list(map(tuple, groups.values()))


def lines_of(statements: ir.Body) -> int:
    """About how many lines statements take in C."""
    braced = (ir.Require, *get_args(ir.Nested))
    return sum(
        4 if isinstance(n, braced) else 5 + len(n.arguments) // 3 if isinstance(n, ir.Call) else 1
        for n in ir.walk(statements)
    )


class _Book:
    """The functions of a program while routines are found."""

    def __init__(self, functions: list[_Function]) -> None:
        self.functions = list(functions)
        self.bodies: dict[str, tuple[ir.Routine, _Function]] = {}

    def repeated(self) -> list[_Run]:
        """The runs whose outlining saves most; none if nothing is worth it."""
        best: tuple[int, list[_Run]] = (0, [])
        seen: set[_Run] = set()
        alike = Counter(block.key for function in self.functions for block in function.blocks)
        for run in self._candidates():
            if run in seen:
                continue
            lines, most = sum(block.lines for block in run.blocks), alike[run.blocks[0].key]
            if (most - 1) * lines - OVERHEAD - 2 * most <= best[0]:
                continue  # it cannot save more
            runs = self._like(run)
            seen |= set(runs)
            if (len(runs) - 1) * lines - OVERHEAD - 2 * len(runs) <= best[0]:
                continue
            call = 2 + len(form_of(run.statements).variables) // 3
            saved = (len(runs) - 1) * lines - OVERHEAD - len(runs) * call
            enough = len(runs) > 1 and lines >= SHORTEST and not run.is_call
            if enough and saved > best[0]:
                best = saved, runs
        return best[1]

    def _candidates(self) -> Iterator[_Run]:
        """The longest runs that begin with each pair of blocks of one shape."""
        places: dict[Any, list[tuple[_Function, int]]] = defaultdict(list)
        for function in self.functions:
            for i, block in enumerate(function.blocks):
                places[block.form.shape].append((function, i))
        for same in places.values():
            for (f, i), (g, j) in combinations(same, 2):
                one = f.blocks[i : j if f is g else None]
                length = _alike(one, g.blocks[j:])
                while length > 1 and (
                    one[length - 1].form.shape == (_HEADING,)
                    or not _Run(f, i, i + length).is_whole()
                    or not _Run(g, j, j + length).is_whole()
                ):
                    length -= 1
                yield _Run(f, i, i + length)

    def _like(self, run: _Run) -> list[_Run]:
        """All runs like this one that do not overlap."""
        blocks, found = run.blocks, []
        wanted = [block.key for block in blocks]
        for function in self.functions:
            keys, at = [block.key for block in function.blocks], 0
            while at + len(blocks) <= len(function.blocks):
                other = _Run(function, at, at + len(blocks))
                same = keys[at : at + len(blocks)] == wanted
                same = same and _alike(blocks, other.blocks) == len(blocks) and other.is_whole()
                found += [other] if same else []
                at += len(blocks) if same else 1
        return found

    def take(self, runs: list[_Run]) -> None:
        """Make one routine of runs of one form and replace them by calls."""
        titles = _titles(runs)
        arguments = {name: routine.arguments for name, (routine, _) in self.bodies.items()}
        routine, chunks, calls = _drafted(runs, self._name(titles), titles, arguments)
        blocks = [_Block(c, old.section) for c, old in zip(chunks, runs[0].blocks, strict=True)]
        body = _Function(routine.name, blocks, list(routine.locals))
        last_first = sorted(zip(runs, calls, titles, strict=True), key=lambda each: -each[0].start)
        for run, call, title in last_first:
            headed = isinstance(run.statements[0], ir.Heading)
            run.put([(ir.Heading(title), call) if headed else (call,)])
        for run in runs:
            function = run.function
            function.locals = [local for local in function.locals if function.users(local.name)]
        self.functions.append(body)
        self.bodies[routine.name] = routine, body

    def cut(self, function: _Function) -> None:
        """Cut a function that is too long into routines that are called once."""
        function.split()
        while lines_of(function.body) > LONGEST:
            run = max(self._pieces(function), key=lambda run: lines_of(run.statements))
            if run.is_call or len(run.blocks) == len(function.blocks):
                return
            self.take([run])

    @staticmethod
    def _pieces(function: _Function) -> Iterator[_Run]:
        """As much as a routine may hold: whole sections from each heading on, or from anywhere."""
        blocks, end = function.blocks, len(function.blocks)
        headed = [i for i, block in enumerate(blocks) if block.form.shape[0] == _HEADING]
        sizes = [lines_of(block.statements) for block in blocks]
        for start in range(end):
            within = [k for k in range(start + 1, end + 1) if sum(sizes[start:k]) <= LONGEST]
            sections = [k for k in within if start in headed and k in {*headed, end}]
            stop = max(sections or ([] if headed else within), default=start + 1)
            yield _Run(function, start, stop)

    def _name(self, titles: list[str]) -> str:
        """A name after what the titles of the runs have in common."""
        words = [re.findall(r"[a-z]+", re.split("[:,]", title.lower())[0]) for title in titles]
        shared = [w for w in words[0] if all(w in other for other in words)][:4]
        while shared and shared[-1] in _FILLING:
            shared.pop()
        return _new("_".join(shared) or "part", _FUNCTIONS | self.bodies.keys())

    def _refuses(self, body: ir.Body) -> bool:
        """Whether statements may end the function."""
        return any(
            isinstance(node, ir.Require)
            or (isinstance(node, ir.Call) and self._refuses(self.bodies[node.routine][1].body))
            for node in ir.walk(body)
        )

    def locals(self, function: _Function) -> tuple[ir.Local, ...]:
        """Locals; what a refusal may leave unwritten begins at 0: compilers do not follow it."""
        calls = ir.every(ir.Call, function.body)
        left = {e.name for call in calls for e in self._left(call) if e.space is Space.LOCAL}
        return tuple(
            replace(local, initial=0.0) if local.name in left and local.initial is None else local
            for local in function.locals
        )

    def _left(self, call: ir.Call) -> list[Element]:
        """What a call leaves unwritten, in part or as a whole, where it refuses."""
        routine, function = self.bodies[call.routine]
        body = function.body
        refusing = (i for i, node in enumerate(body) if self._refuses((node,)))
        first = next(refusing, len(body))
        always = tuple(node for node in body[:first] if not isinstance(node, ir.Condition))
        before, after = self._written(always), self._written(body[first:])
        known = before | {replace(element, index=None) for element in before}
        late = {e.name for e in after - known if replace(e, index=None) not in before}
        pairs = zip(routine.arguments, call.arguments, strict=True)
        return [own for argument, own in pairs if argument.name in late]

    def _written(self, body: ir.Body) -> set[Element]:
        """Elements that statements write; of what calls write, the whole array."""
        found = {node.target for node in ir.stores(body)}
        for call in ir.every(ir.Call, body):
            pairs = zip(self.bodies[call.routine][0].arguments, call.arguments, strict=True)
            found |= {replace(own, index=None) for argument, own in pairs if argument.written}
        return found

    def routines(self) -> tuple[ir.Routine, ...]:
        """All routines, callees first."""
        ordered: dict[str, ir.Routine] = {}

        def visit(name: str) -> None:
            if name not in ordered:
                routine, function = self.bodies[name]
                for call in ir.every(ir.Call, function.body):
                    visit(call.routine)
                ordered[name] = replace(routine, body=function.body, locals=self.locals(function))

        for name in self.bodies:
            visit(name)
        return tuple(ordered.values())


def _new(stem: str, taken: set[str]) -> str:
    """A name that is not taken."""
    names = chain([stem], (f"{stem}_{i}" for i in count(2)))
    return next(name for name in names if name not in taken)


def _alike(one: Sequence[_Block], other: Sequence[_Block]) -> int:
    """How many blocks, from the first on, are the same with the same renaming of variables."""
    there: dict[Variable, tuple[Variable, int]] = {}
    back: dict[Variable, Variable] = {}
    for length, (block, twin) in enumerate(zip(one, other, strict=False)):
        a, b = block.form, twin.form
        if block.key != twin.key or a.shape != b.shape:
            return length
        for (key, base), (name, at) in zip(a.variables, b.variables, strict=True):
            shifted = name, (at or 0) - (base or 0)
            if there.setdefault(key, shifted) != shifted or back.setdefault(name, key) != key:
                return length
    return min(len(one), len(other))


def _titles(runs: list[_Run]) -> list[str]:
    """For each run the heading that tells it from the others; the first one, where none does."""
    each = [run.headings for run in runs]
    telling = (texts for texts in zip(*each, strict=False) if len(set(texts)) == len(runs))
    return list(next(telling, (headings[0] for headings in each)))


def _drafted(
    runs: list[_Run], name: str, titles: list[str], known: Mapping[str, tuple[ir.Argument, ...]]
) -> tuple[ir.Routine, list[ir.Body], list[ir.Call]]:
    """A routine, its chunks and its calls: what differs between the runs becomes arguments."""
    forms = [form_of(run.statements) for run in runs]
    places = _places(runs, forms, known)
    values = [(form.literals, form.rows, form.tables) for form in forms]
    given = [_columns(each) for each in zip(*values, strict=True)]
    columns = [iter(column) for column, _ in given]

    def part(part: Any) -> Any:
        match part:
            case ir.Temp() | Element(Space.PARAMETER) | Index():
                return part
            case Element(space, own, index):
                place, low = places[space, own]
                if isinstance(place, ir.Local):
                    return Element(Space.LOCAL, place.name, index)
                at = None if place.single else (index or 0) - low
                return Element(Space.ARGUMENT, place.name, at)
        column = next(columns[_kind(part)])
        return part if column is None else _GIVEN[_kind(part)](column)

    chunks = ir.numbered(ir.mapped(tuple(block.statements for block in runs[0].blocks), part))
    numbers, rows, tables = (table for _, table in given)
    routine = ir.Routine(
        name=name,
        title="; ".join(dict.fromkeys(titles)),
        arguments=tuple(p for p, _ in places.values() if isinstance(p, ir.Argument)),
        constants=numbers,
        rows=len(rows[0]),
        tables=len(tables[0]),
        locals=tuple(p for p, _ in places.values() if isinstance(p, ir.Local)),
        body=tuple(chain(*chunks)),
    )
    calls = []
    for i, form in enumerate(forms):
        each = list(zip(places.values(), forms[0].variables, form.variables, strict=True))
        own_names = {place.name: own for (place, _), _, ((_, own), _) in each}
        bound = tuple(
            Element(*variable, at).shifted(low - (base or 0))
            for (place, low), (_, base), (variable, at) in each
            if isinstance(place, ir.Argument)
        )
        table = ir.Table(name, i) if numbers[0] else None
        calls.append(ir.Call(name, bound, table, rows[i], tables[i]))
        if form_of(expanded(routine, calls[-1], own_names)) != form:
            raise InternalError(f"routine {name} is not what it stands for")
    return routine, list(chunks), calls


def _places(
    runs: list[_Run], forms: list[Form], known: Mapping[str, tuple[ir.Argument, ...]]
) -> dict[Variable, tuple[ir.Local | ir.Argument, int]]:
    """What each variable of the first run is in the routine, and the element where it begins."""
    indices, written, passed = _uses(runs[0].statements, known)
    taken = set(_TAKEN)
    places: dict[Variable, tuple[ir.Local | ir.Argument, int]] = {}
    for each in zip(*(form.variables for form in forms), strict=True):
        key = each[0][0]
        name = _new(_shared([name for (_, name), _ in each]), taken)
        taken.add(name)
        own = {run.private(*variable) for run, variable in zip(runs, each, strict=True)}
        if len(own) == 1 and (private := own.pop()):
            places[key] = replace(private[1], name=name), 0
            continue
        moves = any(isinstance(i, Index) for i in indices[key])
        single = key not in written | passed and len(indices[key]) == 1 and not moves
        single &= not any(_may_be_absent(*variable) for variable, _ in each)
        low = 0 if moves else min((i for i in indices[key] if isinstance(i, int)), default=0)
        places[key] = ir.Argument(name, key in written, single), low
    return places


def _may_be_absent(space: Space, name: str) -> bool:
    """Whether it is y, which is NULL where a prediction passes a sample: no caller reads it."""
    return space in {Space.INPUT, Space.ARGUMENT} and name.split("_", maxsplit=1)[0] == "y"


def _shared(names: list[str]) -> str:
    """What names have in common."""
    tokens = [name.split("_") for name in names]
    shared = [t for t in tokens[0] if all(t in other for other in tokens)]
    if len({len(each) for each in tokens}) == 1:
        shared = [each[0] for each in zip(*tokens, strict=True) if len(set(each)) == 1]
    return "_".join(shared) if shared and not shared[0].isdigit() else names[0]


def _columns(
    values: Sequence[Sequence[Any]],
) -> tuple[list[int | None], tuple[tuple[Any, ...], ...]]:
    """Values at the same places of several runs: those that differ become columns of a table."""
    columns: dict[tuple[str, ...], tuple[int, tuple[Any, ...]]] = {}
    places: list[int | None] = []
    for each in zip(*values, strict=True):
        key = tuple(map(repr, each))
        if len(set(key)) == 1 and not isinstance(each[0], ir.RowArgument | ir.TableArgument):
            places.append(None)
        else:
            places.append(columns.setdefault(key, (len(columns), each))[0])
    return places, tuple(tuple(kept[i] for _, kept in columns.values()) for i in range(len(values)))


def expanded(routine: ir.Routine, call: ir.Call, locals_: Mapping[str, str]) -> ir.Body:
    """The statements that a call runs, in the names of the caller."""
    names = (argument.name for argument in routine.arguments)
    bound = dict(zip(names, call.arguments, strict=True))

    def part(part: Any) -> Any:
        match part:
            case Element(Space.ARGUMENT, name, index):
                return bound[name].shifted(index or 0)
            case Element(Space.CONSTANT, _, int(index)) if (
                isinstance(call.constants, ir.Table) and routine.constants[0]
            ):
                return ir.Literal(routine.constants[call.constants.row][index])
            case Element(Space.LOCAL, name, _):
                return replace(part, name=locals_[name])
            case ir.RowArgument(index):
                return call.rows[index]
            case ir.TableArgument(index):
                return call.tables[index]
        return part

    statements: ir.Body = ir.mapped(routine.body, part)
    return statements


def _uses(
    statements: ir.Body, known: Mapping[str, tuple[ir.Argument, ...]]
) -> tuple[dict[Variable, set[Whole | None]], set[Variable], set[Variable]]:
    """The elements of each variable that are used; what is written; what is passed on as array."""
    indices: dict[Variable, set[Whole | None]] = defaultdict(set)
    for element in ir.elements(statements):
        indices[element.space, element.name].add(element.index)
    written = {(n.target.space, n.target.name) for n in ir.stores(statements)}
    passed = set()
    for call in ir.every(ir.Call, statements):
        for argument, element in zip(known[call.routine], call.arguments, strict=True):
            key = element.space, element.name
            passed |= set() if argument.single else {key}
            written |= {key} if argument.written else set()
    return indices, written, passed


def _halves(chunk: ir.Body, name: str) -> tuple[list[ir.Body], int]:
    """Two parts of a chunk, the first short enough, cut where the fewest numbers cross."""
    early = enumerate(chunk[:LONGEST])
    made = {node.target: i for i, node in early if isinstance(node, ir.Operate | ir.Copy)}
    last = {operand: i for i, node in enumerate(chunk) for operand in ir.operands(node)}

    def crossing(cut: int) -> list[ir.Temp]:
        return [temp for temp, i in made.items() if i < cut <= last.get(temp, -1)]

    cut = min(range(LONGEST // 2, LONGEST - 40), key=lambda at: (len(crossing(at)), -at))
    place = {temp: Element(Space.LOCAL, name, i) for i, temp in enumerate(crossing(cut))}
    keep = tuple(ir.Assign(element, temp) for temp, element in place.items())
    rest = ir.mapped(chunk[cut:], lambda part: place.get(part, part))
    return [(*chunk[:cut], *keep), rest], max(len(place), 2)
