"""The C program as data: statements under a few conditions and in loops, no C syntax yet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, TypeVar
from typing import Literal as Either

from fkgen.symbolic.index import Index, Whole, names_in, value, variable
from fkgen.symbolic.interface import VERDICTS, Kind, Outcome, Port, Status

Scalar = Either["double", "float"]
T = TypeVar("T")


class Space(Enum):
    """Where an element lives."""

    PARAMETER = "parameter"
    INPUT = "input"
    LOCAL = "local"
    SELF = "self"
    NEXT = "next"
    ARGUMENT = "argument"
    CONSTANT = "constant"


class Operator(Enum):
    """Arithmetic of one statement; the second group calls functions of the program's own."""

    ADD = "+"
    SUB = "-"
    MUL = "*"
    DIV = "/"
    #: a b + c, a b - c and c - a b, rounded once
    FMA = "fma"
    FMS = "fms"
    FNMA = "fnma"
    NEG = "neg"
    ABS = "abs"
    MAX = "max"
    MIN = "min"
    #: LT, LE: 1 where it holds, else 0; IF_ELSE_ZERO: the second argument where the first is 1,
    #: else 0 whatever the second one is
    LT = "<"
    LE = "<="
    IF_ELSE_ZERO = "if_else_zero"
    EXP = "exp"
    LOG = "log"
    SQRT = "sqrt"
    FLOOR = "floor"
    SIN = "sin"
    COS = "cos"
    TAN = "tan"
    ATAN2 = "atan2"
    ASIN = "asin"
    ACOS = "acos"
    SINH = "sinh"
    COSH = "cosh"
    TANH = "tanh"
    HYPOT = "hypot"

    @property
    def is_function(self) -> bool:
        """Whether it is printed as a call."""
        return self.value in FUNCTIONS


#: Operators that are functions in C.
FUNCTIONS = {"exp", "log", "sqrt", "floor", "sin", "cos", "tan", "atan2"}
FUNCTIONS |= {"asin", "acos", "sinh", "cosh", "tanh", "hypot"}


#: Operators that are a product and a sum in one rounding; the argument of fma() that has the other
#: sign.
FUSED = {Operator.FMA: None, Operator.FMS: 2, Operator.FNMA: 0}


@dataclass(frozen=True, slots=True)
class Temp:
    """A value that is assigned once."""

    index: int


@dataclass(frozen=True, slots=True)
class Literal:
    """A constant in the program's scalar type."""

    value: float


@dataclass(frozen=True, slots=True)
class Element:
    """One scalar of a named array, or a named scalar (``index`` None)."""

    space: Space
    name: str
    index: Whole | None

    @property
    def moves(self) -> bool:
        """Whether loops decide which element it is."""
        return isinstance(self.index, Index)

    def may_be(self, other: Element) -> bool:
        """Whether both can be the same number."""
        if (self.space, self.name) != (other.space, other.name):
            return False
        return self.index == other.index or self.moves or other.moves

    def shifted(self, by: Whole) -> Element:
        """The element so many places on; a scalar stays itself."""
        return self if self.index is None else replace(self, index=self.index + by)


@dataclass(frozen=True, slots=True)
class Expression:
    """``operator(arguments)`` inside another operation: its value goes nowhere else."""

    operator: Operator
    arguments: tuple[Operand, ...]


Operand = Temp | Literal | Element | Expression


@dataclass(frozen=True, slots=True)
class Operate:
    """``target = operator(arguments)``."""

    target: Temp
    operator: Operator
    arguments: tuple[Operand, ...]


@dataclass(frozen=True, slots=True)
class Copy:
    """``target = value``, to keep a value that is about to be overwritten."""

    target: Temp
    value: Operand


@dataclass(frozen=True, slots=True)
class Assign:
    """``target := value``."""

    target: Element
    value: Operand


@dataclass(frozen=True, slots=True)
class CopyArray:
    """``target[i] := source[i]`` for ``size`` elements from those named on; two arrays."""

    target: Element
    source: Element
    size: int


@dataclass(frozen=True, slots=True)
class Require:
    """Return ``status`` unless all ``values`` are of this kind."""

    values: tuple[Operand, ...]
    kind: Kind
    status: Status


@dataclass(frozen=True, slots=True)
class RowArgument:
    """A row of y that the caller of a routine names."""

    index: int


Row = Whole | RowArgument


@dataclass(frozen=True, slots=True)
class TableArgument:
    """A row of constants of another routine that the caller of a routine names."""

    index: int


@dataclass(frozen=True, slots=True)
class Table:
    """A row of the constants of a routine."""

    routine: str
    row: int


@dataclass(frozen=True, slots=True)
class IfPresent:
    """Run ``body`` if this row of y is present (any row, if None)."""

    row: Row | None
    body: Body


@dataclass(frozen=True, slots=True)
class IfPositive:
    """Run ``body`` if ``value`` is positive; if it is ``rare``, few samples do."""

    value: Operand
    body: Body
    rare: bool = False


@dataclass(frozen=True, slots=True)
class For:
    """Run ``body`` for index = begin, ..., end - 1."""

    index: str
    begin: Whole
    end: Whole
    body: Body

    def rounds(self, variables: Mapping[str, int]) -> range:
        """The values of its index where those of the loops around it are known."""
        return range(value(self.begin, variables), value(self.end, variables))


@dataclass(frozen=True, slots=True)
class Product:
    """``target[i, j] = start[i, j] + the sum over k of left[i, k] right[k, j]`` for all i and j.

    Elements are indexed by ``i``, ``j`` and ``k``. Every sum is one chain in ascending order of k,
    from ``start`` or from its first product; ``less``: products are subtracted; ``lower``: entries
    on and below the diagonal only; ``fused``: every
    further product is rounded together with the sum before it.
    """

    target: Element
    start: Element | None
    left: Element
    right: Element
    rows: int
    columns: int
    inner: int
    less: bool
    lower: bool
    fused: bool = False

    @property
    def loops(self) -> tuple[For, ...]:
        """What its indices run over."""
        columns: Whole = variable("i") + 1 if self.lower else self.columns
        ends: tuple[tuple[str, Whole], ...] = (("i", self.rows), ("j", columns), ("k", self.inner))
        return tuple(For(index, 0, end, ()) for index, end in ends)

    @property
    def terms(self) -> int:
        """How many products there are."""
        n = min(self.rows, self.columns)
        entries = n * (n + 1) // 2 + (self.rows - n) * n
        return self.inner * (entries if self.lower else self.rows * self.columns)

    @property
    def operators(self) -> Counter[Operator]:
        """Its operations."""
        added = self.terms - (self.terms // self.inner if self.start is None else 0)
        apart = self.terms - added if self.fused else self.terms
        return Counter({Operator.MUL: apart, self.adding: added})

    @property
    def adding(self) -> Operator:
        """How a product comes to the sum before it."""
        if self.fused:
            return Operator.FNMA if self.less else Operator.FMA
        return Operator.SUB if self.less else Operator.ADD


@dataclass(frozen=True, slots=True)
class Triangle:
    """``target[i, j] = source[i, j]`` for j <= i < size; ``mirrored``: ``target[j, i]`` as well."""

    target: Element
    source: Element
    size: int
    mirrored: bool

    @property
    def loops(self) -> tuple[For, ...]:
        """What its indices run over: both do everywhere where it is mirrored."""
        columns: Whole = self.size if self.mirrored else variable("i") + 1
        return For("i", 0, self.size, ()), For("j", 0, columns, ())


@dataclass(frozen=True, slots=True)
class Heading:
    """What the following statements do."""

    text: str


@dataclass(frozen=True, slots=True)
class Call:
    """Run a routine: where its arguments begin, its row of constants, the rows of y it is about.

    ``tables`` are rows of constants for the routines that it calls.
    """

    routine: str
    arguments: tuple[Element, ...]
    constants: Table | TableArgument | None
    rows: tuple[Row, ...]
    tables: tuple[Table | TableArgument, ...] = ()


Condition = IfPresent | IfPositive
Nested = Condition | For
OfMatrices = Product | Triangle
Statement = Operate | Copy | CopyArray | Assign | Require | Nested | OfMatrices | Heading | Call
Body = tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class Local:
    """A local array (or scalar, if ``size`` is 1), zeroed first where ``initial`` is given.

    With ``values`` it is a table of constants.
    """

    name: str
    size: int
    initial: float | None
    values: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Argument:
    """An array that a routine works on, from the element that the call names; or one number."""

    name: str
    written: bool
    single: bool


@dataclass(frozen=True, slots=True, eq=False)
class Routine:
    """Statements that a program runs more than once, or that are a function for their length.

    Elements of its arguments have the space ``ARGUMENT``; ``CONSTANT`` is the table of numbers in
    which the calls differ, one row per call.
    """

    name: str
    title: str
    arguments: tuple[Argument, ...]
    constants: tuple[tuple[float, ...], ...]
    rows: int
    tables: int
    locals: tuple[Local, ...]
    body: Body


@dataclass(frozen=True, slots=True)
class Phase:
    """One function: what it declares, what it does, which arguments it needs.

    It is not called while the port ``unless``, if there is one, is positive.
    """

    locals: tuple[Local, ...]
    body: Body
    reads_input: bool
    reads_parameters: bool
    unless: str | None = None
    #: Where in the body each block begins, and the section that it belongs to
    chunks: tuple[tuple[int, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Signal:
    """Name, unit and range of one state, input or measurement."""

    name: str
    unit: str
    range: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Constant:
    """A number that the code calls by a name."""

    name: str
    value: float
    meaning: str


@dataclass(frozen=True, slots=True)
class Stated:
    """The spec as far as a reader of the code has to know it."""

    model: tuple[str, ...] = ()  # The model, its modes and faults, as lines of a comment
    ranges: tuple[tuple[str, str], ...] = ()  # What is known about each parameter
    #: Constants of the code that are products of entries, and which
    folded: tuple[tuple[float, str], ...] = ()
    spec: str = "{}"  # It itself as JSON, with its f and h in the words of its author


@dataclass(frozen=True, slots=True, kw_only=True)
class Vectors:
    """Inputs and expected outputs of the self-test, bit for bit."""

    u: tuple[tuple[float, ...], ...]  # u, y: One row per sample; NaN in y where a row is missing
    y: tuple[tuple[float, ...], ...]
    trace: tuple[tuple[float, ...], ...]
    final: tuple[tuple[str, tuple[float, ...]], ...]
    start: tuple[tuple[str, float], ...] = ()  # Scalars that are set before the first sample


@dataclass(frozen=True, slots=True, kw_only=True)
class CProgram:
    """One filter, ready to be printed."""

    name: str
    scalar: Scalar
    family: str
    source: str
    notes: tuple[str, ...]
    digest: str
    states: tuple[Signal, ...]  # Of an attitude its four numbers
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    attitudes: tuple[int, ...]  # Where quaternions begin in x
    sample_time: float | str | None  # seconds, or the parameter that holds them
    parameters: tuple[tuple[str, float], ...]
    ports: tuple[Port, ...]  # Those with slots come last
    prior: tuple[tuple[float, ...], tuple[float, ...]]  # x0, and P0 packed
    initial: tuple[tuple[str, tuple[float, ...]], ...]
    update: Phase
    predict: Phase
    closing: Phase | None = None
    start: Phase | None = None
    #: Computes x and P of the prior, where they depend on parameters
    origin: Phase | None = None
    outcomes: tuple[Outcome, ...] = ()
    #: Rows with correlated noises; None where an update after an update is refused
    repeats: tuple[tuple[int, ...], ...] | None = None
    constants: tuple[Constant, ...] = ()
    stated: Stated = Stated()
    shares_functions: bool = False
    fma: bool = False  # Whether it calls fma() of C
    #: Inputs of one level, and y along the path that they lead from x0 on without any noise
    paths: tuple[tuple[float, tuple[tuple[float, ...], ...]], ...] = ()
    optimise: Either["speed", "size"] = "speed"
    decoupled: bool = False  # As of `Code`

    @property
    def errors(self) -> tuple[Signal, ...]:
        """Rows of the covariance of x: of an attitude ``q`` the angles ``q[x]`` and so on."""
        found = list(self.states)
        for at in reversed(self.attitudes):
            stem = found[at].name.removesuffix("[0]")
            found[at : at + 4] = [Signal(f"{stem}[{axis}]", "rad") for axis in "xyz"]
        return tuple(found)

    @property
    def screens(self) -> bool:
        """Whether rows of y have ranges."""
        return any(row.range is not None for row in self.outputs)

    @property
    def statuses(self) -> tuple[Status, ...]:
        """What its functions can return."""
        told = {outcome.status for outcome in self.outcomes}
        told |= {Status.NOT_A_ROTATION} if self.attitudes else set()
        ranged = any(each.range for each in (*self.states, *self.inputs))
        told |= {Status.INPUT_OUT_OF_RANGE} if ranged else set()
        told |= {Status.PRIOR_COUPLED} if self.decoupled else set()
        special = {*VERDICTS, *(Status.NOT_A_ROTATION, Status.INPUT_OUT_OF_RANGE)}
        special |= {Status.PRIOR_COUPLED}
        return tuple(status for status in Status if status not in special or status in told)

    @property
    def verbs(self) -> dict[str, Phase]:
        """All phases there are by the names of their functions."""
        phases = {"correct": self.update, "close_window": self.closing, "propagate": self.predict}
        phases |= {"prior": self.origin, "begin": self.start}
        return {verb: phase for verb, phase in phases.items() if phase is not None}

    @property
    def phases(self) -> tuple[Phase, ...]:
        """Update, closing (if there is one) and predict, in this order."""
        closing = () if self.closing is None else (self.closing,)
        return self.update, *closing, self.predict

    def written(self, *phases: Phase | None) -> tuple[Port, ...]:
        """The ports that phases write."""
        nodes = (node for phase in phases if phase for node in every(Assign, phase.body))
        names = {node.target.name for node in nodes if node.target.space is Space.NEXT}
        return tuple(port for port in self.ports if port.name in names)

    @property
    def accumulated(self) -> tuple[Port, ...]:
        """The ports that an update goes on from and writes, also where no row was measured."""
        known = {e.name for e in read(Element, self.update.body) if e.space is Space.SELF}
        return tuple(port for port in self.written(self.update) if port.name in known)

    @property
    def slotted(self) -> tuple[Port, ...]:
        """Ports of which a sample writes some slots."""
        return tuple(port for port in self.ports if port.slots)

    @property
    def twins(self) -> tuple[tuple[Port, Port], ...]:
        """Predictions that updates read, with what an update makes of them."""
        known = {port.name: port for port in self.ports}
        return tuple((p, known[p.corrected]) for p in self.ports if p.corrected in known)

    @property
    def functions(self) -> frozenset[Operator]:
        """Elementary functions that the program needs."""
        every_phase = _operations(*self.verbs.values(), rare=True)
        return frozenset(op for op in every_phase if op.is_function)

    @property
    def operations(self) -> Counter[Operator]:
        """Operations of one step with every row present, the closing left out."""
        return _operations(self.update, self.predict)

    @property
    def flops(self) -> int:
        """Additions, multiplications and the like of one step; calls are counted apart."""
        return _flops(self.update, self.predict)

    @property
    def has_rare(self) -> bool:
        """Whether few samples have to do more than that."""
        return any(node.rare for phase in self.phases for node in every(IfPositive, phase.body))

    @property
    def fused(self) -> int:
        """How many of them are a product and a sum in one."""
        return sum(n for operator, n in self.operations.items() if operator in FUSED)

    @property
    def statements(self) -> int:
        """The same as they stand in the text, where loops repeat them."""
        nodes = (
            node for phase in (self.update, self.predict) for node in every(Operate, phase.body)
        )
        return sum(1 for node in nodes if not node.operator.is_function)

    @property
    def closing_flops(self) -> int:
        """The same of the closing."""
        return 0 if self.closing is None else _flops(self.closing)


def _operations(*phases: Phase, rare: bool = False) -> Counter[Operator]:
    found: Counter[Operator] = Counter()
    for phase in phases:
        for node, times in counted(phase.body, rare=rare):
            if isinstance(node, Operate):
                found[node.operator] += times
            elif isinstance(node, Product):
                found += node.operators
    return found


def _flops(*phases: Phase) -> int:
    return sum(n for operator, n in _operations(*phases).items() if not operator.is_function)


#: What a node consists of, in the order of computation.
_PARTS: dict[type, tuple[str, ...]] = {
    Expression: ("arguments",),
    Operate: ("arguments", "target"),
    Copy: ("value", "target"),
    CopyArray: ("source", "target"),
    Assign: ("value", "target"),
    Require: ("values",),
    IfPresent: ("row", "body"),
    IfPositive: ("value", "body"),
    For: ("body",),
    Product: ("start", "left", "right", "target"),
    Triangle: ("source", "target"),
    Call: ("arguments", "constants", "tables", "rows"),
    Heading: (),
}


def mapped(node: Any, part: Callable[[Any], Any]) -> Any:
    """Statements with other temporaries, numbers, elements, rows and tables in their places."""
    if isinstance(node, tuple):
        return tuple(mapped(each, part) for each in node)
    if type(node) not in _PARTS:
        return None if node is None else part(node)
    parts = {name: mapped(getattr(node, name), part) for name in _PARTS[type(node)]}
    return replace(node, **parts)


def numbered(node: Any) -> Any:
    """Statements with their temporaries numbered anew, in order."""
    temps: dict[Temp, Temp] = {}

    def part(part: Any) -> Any:
        return temps.setdefault(part, Temp(len(temps))) if isinstance(part, Temp) else part

    return mapped(node, part)


def walk(body: Body) -> Iterator[Statement]:
    """Every statement, those under conditions and in loops too, in order."""
    for node in body:
        yield node
        if isinstance(node, Nested):
            yield from walk(node.body)


def counted(
    body: Body, loops: tuple[For, ...] = (), times: int = 1, *, rare: bool = False
) -> Iterator[tuple[Statement, int]]:
    """Every statement, and how often it is run if every condition holds, rare ones if ``rare``."""
    for node in body:
        yield node, times
        if isinstance(node, For):
            around = (*loops, node)
            yield from counted(node.body, around, _times(around, {}), rare=rare)
        elif isinstance(node, Condition) and (rare or not getattr(node, "rare", False)):
            yield from counted(node.body, loops, times, rare=rare)


def _times(loops: tuple[For, ...], known: Mapping[str, int]) -> int:
    """How often the innermost of loops comes round."""
    first, *rest = loops
    rounds = first.rounds(known)
    if not rest:
        return len(rounds)
    return sum(_times(tuple(rest), {**known, first.index: i}) for i in rounds)


def inside(body: Body, loops: tuple[For, ...] = ()) -> Iterator[tuple[Statement, tuple[For, ...]]]:
    """Every statement, and the loops that it is in, the outermost first."""
    for node in body:
        yield node, (*loops, *node.loops) if isinstance(node, OfMatrices) else loops
        if isinstance(node, Nested):
            around = (*loops, node) if isinstance(node, For) else loops
            yield from inside(node.body, around)


def _rounds(loops: tuple[For, ...], known: dict[str, int]) -> Iterator[dict[str, int]]:
    """Every combination of values that the indices of loops take, in order."""
    if not loops:
        yield known
        return
    for i in loops[0].rounds(known):
        yield from _rounds(loops[1:], {**known, loops[0].index: i})


def places(index: Whole | None, loops: tuple[For, ...]) -> list[int | None]:
    """All values of an index in these loops, in order."""
    if not isinstance(index, Index):
        return [index]
    needed = {*names_in(index)}
    for loop in reversed(loops):  # loops that bound those that count
        needed |= {*names_in(loop.begin, loop.end)} if loop.index in needed else set()
    kept = tuple(loop for loop in loops if loop.index in needed)
    return [index.at(known) for known in _rounds(kept, {})]


def every(kind: type[T], body: Body) -> Iterator[T]:
    """Every statement of a kind, those under conditions too, in order."""
    return (node for node in walk(body) if isinstance(node, kind))


def stores(body: Body) -> Iterator[Assign | OfMatrices]:
    """Every statement that writes elements, those under conditions too, in order."""
    return (node for node in walk(body) if isinstance(node, Assign | OfMatrices))


def read(kind: type[T], body: Body) -> Iterator[T]:
    """Every operand of a kind that statements read, those under conditions too."""
    return (each for node in walk(body) for each in operands(node) if isinstance(each, kind))


def elements(body: Body) -> list[Element]:
    """Every element that statements read or write, those under conditions too."""
    parts: list[Any] = []
    mapped(body, parts.append)
    return [part for part in parts if isinstance(part, Element)]


def operands(node: Statement) -> list[Operand]:
    """What a statement reads itself (not its body), that of its expressions too."""
    found: list[Operand] = []
    for name in _PARTS[type(node)]:
        if name in {"arguments", "value", "values", "source", "start", "left", "right"}:
            mapped(getattr(node, name), found.append)
    return found
