"""`PhaseBuilder`, the mutable builder: it collects the blocks of a phase while it is written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column
from fkgen.symbolic.recursion import Block, Condition, Guard, Phase, Variable


class PhaseBuilder:
    """Write a phase line by line; `phase` freezes it."""

    def __init__(self, ports: Mapping[str, ca.SX]) -> None:
        self._symbols = dict(ports)
        self._owner = {e.element_hash(): n for n, s in ports.items() for e in ca.symvar(s)}
        self._variables: list[Variable] = []
        self._blocks: list[Block] = []
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
        self, row: int | None, positive: ca.SX | None = None, *, present: bool = True
    ) -> Iterator[None]:
        """Blocks written inside run only if this row of y is present (any row, if None)."""
        self._condition = Condition(row, positive, present)
        yield
        self._condition = None

    def if_positive(self, positive: ca.SX) -> AbstractContextManager[None]:
        """Blocks written inside run only if ``positive`` is, whatever rows are present."""
        return self.if_present(None, positive, present=False)

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

    def assign(self, assign: Mapping[str, ca.SX], guards: Sequence[Guard] = ()) -> None:
        """Append a block: all assignments happen at once."""
        dense = {name: ca.densify(value) for name, value in assign.items()}
        for name, value in dense.items():
            if value.shape != self._symbols[name].shape:
                raise InternalError(f"{name} is {self._symbols[name].shape}, given {value.shape}")
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
        local = {variable.name for variable in self._variables}
        live: set[str] = set()
        blocks: list[Block] = []
        for block in reversed(self._blocks):
            assign = {k: v for k, v in block.assign.items() if k not in local or k in live}
            if not (assign or block.guards):
                continue
            condition = block.when.positive if block.when else None
            values = [*assign.values(), *(guard.values for guard in block.guards)]
            values += [] if condition is None else [condition]
            reads = {self._owner[e.element_hash()] for v in values for e in ca.symvar(v)}
            blocks.append(replace(block, assign=assign, reads=tuple(sorted(reads))))
            live |= reads
        variables = tuple(v for v in self._variables if v.name in live)
        symbols = {k: v for k, v in self._symbols.items() if k not in local or k in live}
        return Phase(tuple(reversed(blocks)), variables, symbols, unless)


def _without_sign(value: ca.SX) -> tuple[ca.SX, int]:
    """A value and 1, or its opposite and -1 where it is stated by that."""
    return (value.dep(0), -1) if value.is_op(ca.OP_NEG) else (value, 1)
