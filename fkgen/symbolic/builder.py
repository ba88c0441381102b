"""`Script`, the mutable builder: it collects the blocks of a phase while it is written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column
from fkgen.symbolic.recursion import Block, Condition, Guard, Phase, Variable


class Script:
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
    def when(
        self, row: int | None, positive: ca.SX | None = None, *, present: bool = True
    ) -> Iterator[None]:
        """Blocks written inside run only if this row of y is present (any row, if None)."""
        self._condition = Condition(row, positive, present)
        yield
        self._condition = None

    def where(self, positive: ca.SX) -> AbstractContextManager[None]:
        """Blocks written inside run only if ``positive`` is, whatever rows are present."""
        return self.when(None, positive, present=False)

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

    def put(self, assign: Mapping[str, ca.SX], guards: Sequence[Guard] = ()) -> None:
        """Append a block: all assignments happen at once."""
        dense = {name: ca.densify(value) for name, value in assign.items()}
        for name, value in dense.items():
            if value.shape != self._symbols[name].shape:
                raise InternalError(f"{name} is {self._symbols[name].shape}, given {value.shape}")
        *sections, title = self._titles or [""]
        block = Block(title, dense, self._condition, tuple(guards), section="; ".join(sections))
        self._blocks.append(block)

    def let(self, name: str, value: ca.SX, initial: float | None = None) -> ca.SX:
        """Name an intermediate value, so that it is computed once; constants stay as they are."""
        if value.is_constant():
            return value
        symbol = self.local(name, value.numel(), initial)
        self.put({name: value})
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
        symbols = self.let(name, ca.cse(column([matrices[at].nz[k] for at, k in position])))
        named = tuple(ca.SX(matrix) for matrix in matrices)
        for i, (at, k) in enumerate(position):
            named[at].nz[k] = symbols[i]
        return named

    def demand(self, kind: Kind, values: Sequence[ca.SX], status: Status) -> None:
        """Refuse the sample unless all values are of this kind; constants are left out."""
        undecided = [value for value in values if not value.is_constant()]
        if undecided:
            self.put({}, [Guard(column(undecided), kind, status)])

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
