"""A recursion as a frozen value: ports, phases of blocks, guards. What families build.

A block assigns variables, or elements of them, all at once, from the values that the variables have
when the block begins. A conditional block runs only when its row of ``y`` is present, or a value
positive. A loop runs blocks and loops for every value of an index between constant bounds, or those
of the loops around it. A product of matrices is one statement, whatever their size. That is all the
control flow there is inside a phase, so a block is one CasADi function, and a phase is C with a few
branches, in straight lines where nothing grows large.
Work that most samples do without is a phase of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import casadi as ca
import numpy as np

from fkgen.errors import InternalError
from fkgen.problem import Matrix, Number, Spec
from fkgen.problem.functions.named import UNIT_TOLERANCE
from fkgen.problem.table.place import Place, suggestion
from fkgen.symbolic.domain import demands
from fkgen.symbolic.index import At, Index, Target, Whole, name_of
from fkgen.symbolic.interface import Kind, Outcome, Port, Status, triangle
from fkgen.symbolic.lifting.expressions import lift
from fkgen.symbolic.lifting.rotations import scaled_to_unit, within
from fkgen.symbolic.linalg import column, pack
from fkgen.symbolic.ports import PARAMETER, prior_of, prior_symbols


@dataclass(frozen=True, slots=True)
class Guard:
    """The sample is refused with ``status`` unless all ``values`` (a column) are of this kind."""

    values: ca.SX
    kind: Kind
    status: Status


@dataclass(frozen=True, slots=True)
class Condition:
    """When a block runs: a row of y (any, if None) is present and a value is positive.

    With ``present`` false, whatever rows are present.
    """

    row: Whole | None
    positive: ca.SX | None = None
    present: bool = True
    rare: bool = False  # Most samples do without

    def threshold(
        self, reads: Sequence[Target], symbols: Mapping[Target, ca.SX]
    ) -> ca.Function | None:
        """The value that has to be positive, if there is one, as a function of what is read."""
        if self.positive is None:
            return None
        return ca.Function("threshold", [symbols[place] for place in reads], [self.positive])


@dataclass(frozen=True, slots=True)
class Variable:
    """A local of one phase. With an ``initial`` value it may be assigned under a condition.

    With ``values`` it is a table of constants, and never assigned.
    """

    name: str
    size: int
    initial: float | None = None
    values: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Block:
    """Simultaneous assignments ``variable := expression`` with the guards that precede them."""

    title: str
    assign: Mapping[Target, ca.SX]
    when: Condition | None = None
    guards: tuple[Guard, ...] = ()
    reads: tuple[Target, ...] = ()
    section: str = ""  # What the title stands under

    def function(self, symbols: Mapping[Target, ca.SX]) -> ca.Function:
        """The assigned values in order, then the guards, as one CasADi function of what is read."""
        outputs = [*self.assign.values(), *(guard.values for guard in self.guards)]
        return ca.Function("block", [symbols[name] for name in self.reads], outputs)

    def threshold(self, symbols: Mapping[Target, ca.SX]) -> ca.Function | None:
        """The value that must be positive for the block to run, if there is one."""
        return None if self.when is None else self.when.threshold(self.reads, symbols)


@dataclass(frozen=True, slots=True)
class Loop:
    """Blocks and loops that run for index = begin, ..., end - 1, one value after the other.

    ``reads`` is what the condition needs; it is asked for once, before the loop.
    """

    title: str
    index: str
    begin: Whole
    end: Whole
    body: tuple[Part, ...]
    when: Condition | None = None
    reads: tuple[Target, ...] = ()
    section: str = ""

    def threshold(self, symbols: Mapping[Target, ca.SX]) -> ca.Function | None:
        """The value that must be positive for the loop to run, if there is one."""
        return None if self.when is None else self.when.threshold(self.reads, symbols)

    @property
    def is_parallel(self) -> bool:
        """Whether its order does not matter: elements are written that no other round reads."""
        blocks = [block for block in self.body if isinstance(block, Block)]
        targets = [target for block in blocks for target in block.assign]
        written = {target.name: target for target in targets if isinstance(target, At)}
        reads = [target for block in blocks for target in block.reads]
        return (
            len(blocks) == len(self.body)
            and all(block.when is None for block in blocks)
            and all(
                isinstance(target, At)
                and target == written[target.name]
                and isinstance(target.index, Index)
                and target.index.rises_with(self.index)
                for target in targets
            )
            and all(each == written.get(name_of(each), each) for each in reads)
        )


@dataclass(frozen=True, slots=True)
class Product:
    """target[i, j] := start[i, j] + the sum over k of left[i, k] right[k, j], for all i and j.

    Places are indices of ``i``, ``j`` and ``k``. Every sum is one chain in ascending order of k; it
    begins with ``start``, or with its first product if there is none. With ``less``, which takes a
    start, products are subtracted; with ``lower`` entries above the diagonal are left as they are.
    No element is read that is written, but as its own start.
    """

    title: str
    target: At
    left: At
    right: At
    start: At | None
    rows: int
    columns: int
    inner: int
    less: bool = False
    lower: bool = False
    section: str = ""

    @property
    def reads(self) -> tuple[str, ...]:
        """The variables that it reads."""
        places = (self.left, self.right, *([self.start] if self.start else []))
        return tuple(dict.fromkeys(place.name for place in places))


@dataclass(frozen=True, slots=True)
class Triangle:
    """target[i, j] := source[i, j] for j <= i < size; ``mirrored``: target[j, i] as well.

    Places are indices of ``i`` and ``j``. Source and target are different variables.
    """

    title: str
    target: At
    source: At
    size: int
    mirrored: bool
    section: str = ""

    @property
    def reads(self) -> tuple[str, ...]:
        """The variable that it reads."""
        return (self.source.name,)


#: Statements about whole matrices, which stand in no loop and under no condition.
OfMatrices = Product | Triangle

#: What a phase consists of, and a loop, in which there are none about whole matrices.
Part = Block | Loop | OfMatrices


@dataclass(frozen=True, slots=True)
class Phase:
    """Blocks in order, and the locals that they use.

    With ``unless`` the phase is left out while the port of this name, a scalar, is positive.
    """

    blocks: tuple[Part, ...]
    variables: tuple[Variable, ...]
    symbols: Mapping[Target, ca.SX]
    unless: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Recursion:
    """One filter for one spec, as phases over named ports."""

    spec: Spec  # What was asked for
    source: str  # Where the equations come from
    ports: tuple[Port, ...]  # Members of the instance, in order
    update: Phase  # update, predict: step is update, then predict
    predict: Phase
    #: The last part of an update, for the samples at which something comes to an end
    closing: Phase | None = None
    #: Of the covariance update, "short", "joseph" or "ud"; None where nothing is updated
    form: Literal["short", "joseph", "ud"] | None = None
    factor_order: tuple[int, ...] = ()  # Of states in the rows of factors, in the form "ud"
    #: What y tells of beside x, by the port of a covariance of x: the port of its covariance with
    #: x, by rows, and how many numbers it is of, for each of the covariances in the first
    beside: Mapping[str, tuple[str, tuple[int, ...]]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Other decisions that the header repeats
    ranged: bool = False  # Whether it observes the ranges that the spec states of signals
    #: Statuses in place of OK, the first that applies
    outcomes: tuple[Outcome, ...] = ()
    #: Rows of y with correlated noises, in groups: an update that follows an update may take rows
    #: of other groups than those before it. None where no update may follow an update.
    repeats: tuple[tuple[int, ...], ...] | None = None
    #: Writes start values that are computed from the prior, its mean ``x`` and covariance ``P``
    start: Phase | None = None
    #: Writes this prior where that of the spec depends on parameters
    prior: Phase | None = field(init=False, default=None)
    #: Start values in place of those that ports have; complete once this is made, with the default
    #: parameters
    initial: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        starts = {port.name: port.start for port in self.ports if port.start}
        object.__setattr__(self, "prior", _prior(self.spec, self.update.symbols))
        bounded = all(_is_bounded(getattr(plant, x)) for plant in self.spec.plants for x in "QR")
        for name in ("update", "predict", "closing", "start"):
            phase = getattr(self, name)
            if phase is not None:
                sound = _guarded(phase, self.ports, bounded=bounded)
                if name != "closing":
                    sound = _within_domain(self.spec, sound, starting=name == "start")
                object.__setattr__(self, name, sound)
        if attitudes := self.spec.model.attitudes:
            object.__setattr__(self, "start", _from_rotations(self, attitudes))
        begun = self.begun(self.spec.defaults)
        object.__setattr__(self, "initial", {**starts, **begun, **self.initial})
        names = [port.name for port in self.ports]
        for i, name in enumerate(self.spec.code.ports or ()):
            if name not in names:
                expected = f"one of {', '.join(names)}{suggestion(name, names)}"
                place = Place(self.spec.file, "code").entry("ports").item(i)
                raise place.error(f"{name!r}, which {self.spec.filter.family} has not", expected)

    @property
    def phases(self) -> tuple[Phase, ...]:
        """Update, closing (if there is one) and predict, in this order."""
        closing = () if self.closing is None else (self.closing,)
        return self.update, *closing, self.predict

    def begun(
        self, parameters: Mapping[str, float], other: Mapping[str, tuple[float, ...]] | None = None
    ) -> dict[str, tuple[float, ...]]:
        """Start values that follow from the prior, and from the parameters of sample 0.

        ``other``: mean ``x`` or packed covariance ``P`` in place of those of the spec.
        """
        given = {PARAMETER + name: (float(value),) for name, value in parameters.items()}
        prior = dict(zip(("x", "P"), prior_of(self.spec), strict=True))
        if self.prior is not None:
            prior = _evaluated(self.prior, given)
        prior |= other or {}
        copied = {port.name: prior[port.prior] for port in self.ports if port.prior}
        copied = {name: v * (self.port(name).size // len(v)) for name, v in copied.items()}
        return copied | ({} if self.start is None else _evaluated(self.start, given | prior))

    def port(self, name: str) -> Port:
        """Return the port of this name; KeyError if there is none."""
        return {port.name: port for port in self.ports}[name]


#: Title of blocks that keep ports in their ranges: what these are made of is guarded before.
CONFINED = "within the ranges of the spec"

#: Title of the block that looks at the run-time parameters.
_DOMAIN = "run-time parameters in their range"


def _within_domain(spec: Spec, phase: Phase, *, starting: bool = False) -> Phase:
    """The phase, which refuses first of all what the spec has no meaning for.

    A start that no parameter decides has a meaning always.
    """
    names = [item.name for item in spec.parameters if PARAMETER + item.name in phase.symbols]
    read = {name for block in phase.blocks for name in block.reads}
    if len(names) < len(spec.parameters) or phase.blocks[0].title == _DOMAIN:
        return phase
    if starting and not any(PARAMETER + name in read for name in names):
        return phase
    parameters = {name: phase.symbols[PARAMETER + name] for name in names}
    found = demands(spec, parameters, starting=starting)
    if not found:
        return phase
    status = Status.PARAMETER_OUT_OF_RANGE
    guards = tuple(Guard(ca.vertcat(*values), kind, status) for kind, values in found.items())
    used = {each.name() for guard in guards for each in ca.symvar(guard.values)}
    reads = tuple(sorted(PARAMETER + name for name in used))
    return replace(phase, blocks=(Block(_DOMAIN, {}, None, guards, reads), *phase.blocks))


#: The mean of a prior, its quaternions of unit length.
_UNIT = "unit_x"
#: Quaternions so near to unit length are left as they are: an estimate is taken up bit by bit.
ROUNDED = {"double": 1e-15, "float": 5e-7}


def _from_rotations(recursion: Recursion, attitudes: tuple[int, ...]) -> Phase:
    """The phase that starts a filter, which takes quaternions near unit length and scales them."""
    given, own = prior_symbols(recursion.spec.model), recursion.start
    if own is not None and _UNIT in own.symbols:
        return own
    x, limits, scaled = given["x"], [], ca.SX(given["x"])
    for at in attitudes:
        limits += within(x[at : at + 4], UNIT_TOLERANCE)
        scaled[at : at + 4] = scaled_to_unit(x[at : at + 4], ROUNDED[recursion.spec.code.scalar])
    guard = Guard(ca.vertcat(*limits), Kind.NONNEGATIVE, Status.NOT_A_ROTATION)
    blocks = [Block("quaternions of unit length", {_UNIT: scaled}, None, (guard,), ("x",))]
    symbols: dict[Target, ca.SX] = {
        port.name: ca.SX.sym(port.name, port.size) for port in recursion.ports
    }
    symbols.update(given)
    if own is None:
        symbols[_UNIT], written = ca.SX.sym(_UNIT, x.numel()), set()
    else:
        symbols |= {**own.symbols, _UNIT: own.symbols["x"], "x": x}
        own_blocks = [block for block in own.blocks if isinstance(block, Block)]
        written = {name_of(target) for block in own_blocks for target in block.assign}
        for block in own_blocks:
            reads = tuple(_UNIT if name == "x" else name for name in block.reads)
            blocks.append(replace(block, reads=reads))
    priors = [p for p in recursion.ports if p.prior == "x" and p.name not in written]
    means: dict[Target, ca.SX] = {
        p.name: ca.repmat(symbols[_UNIT], p.size // x.numel()) for p in priors
    }
    blocks.append(Block("every mean", means, None, (), (_UNIT,)))
    variables = (*(() if own is None else own.variables), Variable(_UNIT, x.numel()))
    return Phase(tuple(blocks), variables, symbols)


def _prior(spec: Spec, symbols: Mapping[Target, ca.SX]) -> Phase | None:
    """x0 and P0 where they depend on parameters."""
    model = spec.model
    if model.x0.is_constant and model.P0.is_constant:
        return None
    parameters = {item.name: symbols[PARAMETER + item.name] for item in spec.parameters}
    x, P = ca.densify(lift(model.x0, parameters)), lift(model.P0, parameters)
    variances = [P[i, i] for i in range(model.ne) if not P[i, i].is_constant()]
    assign: dict[Target, ca.SX] = {"x": x, "P": pack(P)}
    guards = [Guard(column(variances), Kind.NONNEGATIVE, Status.PARAMETER_OUT_OF_RANGE)]
    every = [each for values in assign.values() for each in ca.vertsplit(values)]
    computed = [each for each in every if not (each.is_constant() or each.is_leaf())]
    guards += [Guard(column(computed), Kind.FINITE, Status.RESULT_NOT_FINITE)]
    guards = [guard for guard in guards if guard.values.numel()]
    used = {each.name() for value in assign.values() for each in ca.symvar(value)}
    reads = tuple(sorted(PARAMETER + name for name in used))
    block = Block("mean and covariance of the prior", assign, None, tuple(guards), reads)
    names = (PARAMETER + item.name for item in spec.parameters)
    own: dict[Target, ca.SX] = {name: symbols[name] for name in names}
    own.update(prior_symbols(model))
    phase = Phase((block,), (), own)
    return _within_domain(spec, phase, starting=True)


def _evaluated(
    phase: Phase, given: Mapping[str, tuple[float, ...]]
) -> dict[str, tuple[float, ...]]:
    """What a phase without conditions and loops assigns."""
    values: dict[Target, ca.DM] = {name: ca.DM(list(value)) for name, value in given.items()}
    for block in phase.blocks:
        if not isinstance(block, Block):
            raise InternalError("start values do not come from loops and products")
        found = block.function(phase.symbols).call([values[name] for name in block.reads])
        values |= dict(zip(block.assign, found, strict=False))
    local = {variable.name for variable in phase.variables}
    written = {name_of(target) for target in values.keys() - given.keys()} - local
    return {name: tuple(np.asarray(values[name]).ravel().tolist()) for name in written}


def _guarded(phase: Phase, ports: Sequence[Port], *, bounded: bool) -> Phase:
    """The phase with a guard on what it writes to ports, unless it is a copy or guarded already."""
    places = {port.name: _places(port, bounded=bounded) for port in ports}
    of_ports = (symbol for key, symbol in phase.symbols.items() if name_of(key) in places)
    copied = {e.element_hash() for symbol in of_ports for e in ca.symvar(symbol)}
    sound: set[int] = set()  # locals that a guard has seen since they were assigned

    def written(block: Block) -> list[ca.SX]:
        found = []
        for target, value in block.assign.items():
            if name_of(target) in places:
                at = places[name_of(target)] if isinstance(target, str) else [0]
                found += [value[i] for i in at]
        return found

    def guarded(block: Part, *, once: bool) -> Part:
        nonlocal sound
        if isinstance(block, OfMatrices):
            sound -= {e.element_hash() for e in ca.symvar(phase.symbols[block.target.name])}
            return block
        if block.title == CONFINED:
            return block
        if isinstance(block, Loop):
            body = tuple(guarded(each, once=False) for each in block.body)
            return replace(block, body=body)
        finite = [guard.values for guard in block.guards if guard.kind is Kind.FINITE]
        seen = {value.element_hash() for values in finite for value in ca.vertsplit(values)}
        values = {v.element_hash(): v for v in written(block) if not v.is_constant()}
        left = [value for key, value in values.items() if key not in seen | copied | sound]
        guards = block.guards
        if left:
            guards += (Guard(ca.vertcat(*left), Kind.FINITE, Status.RESULT_NOT_FINITE),)
        sound |= seen if block.when is None and once else set()
        for target in block.assign:
            sound -= {e.element_hash() for e in ca.symvar(phase.symbols[name_of(target)])}
        return replace(block, guards=guards)

    return replace(phase, blocks=tuple(guarded(block, once=True) for block in phase.blocks))


def _is_bounded(covariance: Matrix) -> bool:
    """Whether a covariance is finite where its variances are: parameters change nothing else."""
    entries = enumerate(covariance.rows)
    return all(
        isinstance(entry, Number) for i, row in entries for j, entry in enumerate(row) if i != j
    )


def _places(port: Port, *, bounded: bool) -> list[int]:
    """Where to look; in covariances whose other entries are ``bounded`` by them, at variances."""
    if not (port.symmetric and bounded):
        return list(range(port.size))
    n = port.shape[-1]
    size = len(triangle(n))
    return [at + i * (i + 3) // 2 for at in range(0, port.size, size) for i in range(n)]
