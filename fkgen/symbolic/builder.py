"""`PhaseBuilder`, the mutable builder: it collects the blocks of a phase while it is written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import casadi as ca

from fkgen.errors import InternalError
from fkgen.symbolic.index import At, Index, Target, Whole, name_of, variable
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column
from fkgen.symbolic.recursion import (
    Block,
    Condition,
    Guard,
    Loop,
    OfMatrices,
    Part,
    Phase,
    Product,
    Triangle,
    Variable,
)


class PhaseBuilder:
    """Write a phase line by line; `phase` freezes it."""

    def __init__(self, ports: Mapping[str, ca.SX]) -> None:
        self._symbols: dict[Target, ca.SX] = {}
        self._symbols.update((name, symbol) for name, symbol in ports.items())
        self._owner: dict[int, Target] = {
            e.element_hash(): n for n, s in ports.items() for e in ca.symvar(s)
        }
        self._variables: list[Variable] = []
        self._blocks: list[Part] = []
        self._condition: Condition | None = None
        self._titles: list[str] = []

    @contextmanager
    def titled(self, title: str) -> Iterator[None]:
        """Give the blocks written inside a heading in the C code; under another one, a section."""
        self._titles.append(title)
        yield
        self._titles.pop()

    @contextmanager
    def if_present(
        self, row: Whole | None, positive: ca.SX | None = None, *, present: bool = True
    ) -> Iterator[None]:
        """Blocks written inside run only if this row of y is present (any row, if None)."""
        self._condition = Condition(row, positive, present)
        yield
        self._condition = None

    @contextmanager
    def if_positive(self, positive: ca.SX, *, rare: bool = False) -> Iterator[None]:
        """Blocks written inside run only if ``positive`` is, whatever rows are present.

        What is ``rare`` is no part of an ordinary sample.
        """
        self._condition = Condition(None, positive, present=False, rare=rare)
        yield
        self._condition = None

    @contextmanager
    def loop(self, index: str, begin: Whole, end: Whole) -> Iterator[Index]:
        """Blocks and loops written inside run for index = begin, ..., end - 1.

        A condition around it is that of the whole loop, and is asked for once.
        """
        outer, condition = self._blocks, self._condition
        self._blocks, self._condition = [], None
        yield variable(index)
        *sections, title = self._titles or [""]
        section = "; ".join(sections)
        body = tuple(self._blocks)
        outer.append(Loop(title, index, begin, end, body, condition, section=section))
        self._blocks, self._condition = outer, condition

    def product(
        self,
        target: At,
        factors: tuple[At, At],
        sizes: tuple[int, int, int],
        start: At | None = None,
        *,
        less: bool = False,
        lower: bool = False,
    ) -> None:
        """Append target := start + left right; ``sizes`` are its rows, columns and what is summed.

        Places are indices of the variables i, j and k, as in `Product`.
        """
        *above, title = self._titles or [""]
        section = "; ".join(above)
        self._blocks.append(
            Product(title, target, *factors, start, *sizes, less, lower, section=section)
        )

    def triangle(self, target: At, source: At, size: int, *, mirrored: bool) -> None:
        """Append a copy of the lower triangle of a symmetric matrix, or of all of it."""
        *above, title = self._titles or [""]
        self._blocks.append(
            Triangle(title, target, source, size, mirrored, section="; ".join(above))
        )

    def at(self, name: str, index: Whole) -> ca.SX:
        """The element of a variable that an index leads to, as a symbol."""
        if isinstance(index, int):
            return self._symbols[name][index]
        place = At(name, index)
        if place not in self._symbols:
            symbol = ca.SX.sym(f"{name}[{index}]")
            self._symbols[place] = symbol
            self._owner[symbol.element_hash()] = place
        return self._symbols[place]

    def read(self, place: At) -> ca.SX:
        """The element at a place, as a symbol."""
        return self.at(place.name, place.index)

    def has(self, name: str) -> bool:
        """Whether a variable or port of this name is declared."""
        return name in self._symbols

    def owner_of(self, value: ca.SX) -> str | None:
        """The variable that a column is, if it is one."""
        owner = self._owner.get(value[0].element_hash())
        if not isinstance(owner, str) or self._symbols[owner].shape != value.shape:
            return None
        return owner if ca.is_equal(self._symbols[owner], value, 1) else None

    def array(self, name: str, value: ca.SX) -> str:
        """The variable that a column is, for loops to read it, or one with its values."""
        owner = self.owner_of(value)
        if owner is not None:
            return owner
        if not self.has(name):
            self.local(name, value.numel())
        self.assign({name: value})
        return name

    def table(self, name: str, values: Sequence[float]) -> str:
        """Declare an array of constants that loops read, or name the one that has them already."""
        for known in self._variables:
            if known.values == tuple(values):
                return known.name
        self.local(name, len(values))
        self._variables[-1] = replace(self._variables[-1], values=tuple(values))
        return name

    def local(self, name: str, size: int, initial: float | None = None) -> ca.SX:
        """Declare a variable of this phase and return its symbol."""
        if name in self._symbols:
            raise InternalError(f"variable {name} is declared twice")
        symbol = ca.SX.sym(name, size)
        self._symbols[name] = symbol
        self._owner |= {element.element_hash(): name for element in ca.symvar(symbol)}
        self._variables.append(Variable(name, size, initial))
        return symbol

    def symbol(self, name: str) -> ca.SX:
        """The symbol of a variable or port that is declared."""
        return self._symbols[name]

    def assign(self, assign: Mapping[Any, ca.SX], guards: Sequence[Guard] = ()) -> None:
        """Append a block: all assignments, of variables by name or elements, happen at once."""
        dense = {name: ca.densify(value) for name, value in assign.items()}
        for name, value in dense.items():
            shape = self._symbols[name].shape if isinstance(name, str) else (1, 1)
            if value.shape != shape:
                raise InternalError(f"{name} is {shape}, given {value.shape}")
        *sections, title = self._titles or [""]
        block = Block(title, dense, self._condition, tuple(guards), section="; ".join(sections))
        self._blocks.append(block)

    def define(self, name: str, value: ca.SX, initial: float | None = None) -> ca.SX:
        """Name an intermediate value, so that it is computed once; constants stay as they are."""
        if value.is_constant():
            return value
        symbol = self.local(name, value.numel(), initial)
        self.assign({name: value})
        return symbol

    def name_entries(self, name: str, matrix: ca.SX) -> ca.SX:
        """Compute the entries that need arithmetic once; return the matrix with their symbols."""
        return self.name_all(name, (matrix,))[0]

    def name_all(self, name: str, matrices: Sequence[ca.SX]) -> tuple[ca.SX, ...]:
        """The same for several matrices.

        What their entries have in common, such as sin(w dt) in rotations, is computed once too.
        """
        position = [
            (at, k)
            for at, matrix in enumerate(matrices)
            for k in range(matrix.nnz())
            if not (matrix.nz[k].is_constant() or matrix.nz[k].is_leaf())
        ]
        if not position:
            return tuple(matrices)
        symbols = self.define(name, ca.cse(column([matrices[at].nz[k] for at, k in position])))
        named = tuple(ca.SX(matrix) for matrix in matrices)
        for i, (at, k) in enumerate(position):
            named[at].nz[k] = symbols[i]
        return named

    def name_distinct(self, name: str, matrices: Sequence[ca.SX]) -> tuple[ca.SX, ...]:
        """The same, where entries may be equal, or opposite: each is computed once."""
        flat = [matrix.nz[k] for matrix in matrices for k in range(matrix.nnz())]
        flat = ca.vertsplit(ca.cse(column(flat))) if flat else []
        entries = [_without_sign(each) for each in flat]
        known = {value.element_hash(): value for value, _ in entries if not value.is_constant()}
        known = {key: value for key, value in known.items() if not value.is_leaf()}
        if not known:
            return tuple(matrices)
        symbols = self.define(name, column(list(known.values())))
        places = {key: symbols[at] for at, key in enumerate(known)}
        ready = iter([sign * places.get(v.element_hash(), v) for v, sign in entries])
        named = tuple(ca.SX(matrix) for matrix in matrices)
        for matrix in named:
            for k in range(matrix.nnz()):
                matrix.nz[k] = next(ready)
        return named

    def demand(self, kind: Kind, values: Sequence[ca.SX], status: Status) -> None:
        """Refuse the sample unless all values are of this kind; constants are left out."""
        undecided = [value for value in values if not value.is_constant()]
        if undecided:
            self.assign({}, [Guard(column(undecided), kind, status)])

    def phase(self, *, unless: str | None = None) -> Phase:
        """Freeze what was written, without assignments to locals that nothing reads."""
        live: set[str] = set()
        blocks = self._live(self._blocks, live)
        variables = tuple(v for v in self._variables if v.name in live)
        dead = {variable.name for variable in self._variables} - live
        symbols = {k: v for k, v in self._symbols.items() if name_of(k) not in dead}
        return Phase(blocks, variables, symbols, unless)

    def _live(self, blocks: Sequence[Part], live: set[str]) -> tuple[Part, ...]:
        """The blocks that compute what is ``live`` after them; then it is what is before them."""
        local = {variable.name for variable in self._variables}
        found: list[Part] = []
        for block in reversed(blocks):
            if isinstance(block, OfMatrices):
                if block.target.name in live or block.target.name not in local:
                    found.append(block)
                    live |= set(block.reads)
                continue
            values = (
                [] if block.when is None or block.when.positive is None else [block.when.positive]
            )
            left: Block | Loop
            if isinstance(block, Loop):
                body, known = self._live(block.body, live), set[str]()
                while known != live:  # what one round reads another one may have written
                    known = set(live)
                    body = self._live(block.body, live)
                if not body:
                    continue
                left = replace(block, body=body)
            else:
                assign = {
                    k: v
                    for k, v in block.assign.items()
                    if name_of(k) in live or name_of(k) not in local
                }
                if not (assign or block.guards):
                    continue
                values = [*assign.values(), *(guard.values for guard in block.guards), *values]
                left = replace(block, assign=assign)
            reads = {self._owner[e.element_hash()] for v in values for e in ca.symvar(v)}
            found.append(replace(left, reads=tuple(sorted(reads, key=str))))
            live |= {name_of(place) for place in reads}
        return tuple(reversed(found))


def _without_sign(value: ca.SX) -> tuple[ca.SX, int]:
    """A value and 1, or its opposite and -1 where it is stated by that."""
    return (value.dep(0), -1) if value.is_op(ca.OP_NEG) else (value, 1)
