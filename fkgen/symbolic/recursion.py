"""A recursion as a frozen value: ports, two phases of blocks, guards. What families build.

A block assigns whole variables, all at once, from the values that the variables have when the block
begins. A conditional block runs only when its row of ``y`` is present. That is all the control flow
there is, so a block is one CasADi function, and a phase is straight-line C with a few branches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import casadi as ca

from fkgen.spec import Spec


class Role(Enum):
    """What a port is for: carried to the next sample, or written for the user only."""

    STATE = "state"
    OUTPUT = "output"


class Status(Enum):
    """Why a generated function returns what it returns; the value is the C status code."""

    OK = 0
    SKIPPED = 1
    NULL_POINTER = -1
    INPUT_NOT_FINITE = -2
    NOT_POSITIVE_DEFINITE = -3
    PARAMETER_OUT_OF_RANGE = -4
    RESULT_NOT_FINITE = -5

    @property
    def meaning(self) -> str:
        """One sentence for the header and for error messages."""
        return _MEANINGS[self]


_MEANINGS = {
    Status.OK: "the sample was used",
    Status.SKIPPED: "no row of y was present: nothing was learnt from this sample",
    Status.NULL_POINTER: "a pointer argument is NULL",
    Status.INPUT_NOT_FINITE: "u holds NaN or an infinity, or y holds an infinity",
    Status.NOT_POSITIVE_DEFINITE: "a covariance lost its positivity",
    Status.PARAMETER_OUT_OF_RANGE: "a run-time parameter gives a variance below zero or a rate outside [0, 1]",
    Status.RESULT_NOT_FINITE: "the result would not be finite",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Port:
    """A member of the C instance and a column of a run.

    Attributes
    ----------
    name : str
        Name in C and in Python.
    shape : tuple of int
        Shape of one sample as Python shows it.
    symmetric : bool
        The last two axes are one symmetric matrix, of which the lower triangle is stored by rows.
    role : Role
    meaning, unit : str
        For the header.
    per_row : bool
        One entry per row of y, NaN in Python where the row is missing.
    """

    name: str
    shape: tuple[int, ...]
    role: Role
    meaning: str
    unit: str = ""
    symmetric: bool = False
    per_row: bool = False

    @property
    def size(self) -> int:
        """Number of scalars stored in C."""
        size = 1
        for length in self.shape[:-2] if self.symmetric else self.shape:
            size *= length
        if self.symmetric:
            n = self.shape[-1]
            size *= n * (n + 1) // 2
        return size


class Kind(Enum):
    """What a guard demands of its value."""

    POSITIVE = "positive"
    NONNEGATIVE = "nonnegative"
    FINITE = "finite"


@dataclass(frozen=True, slots=True)
class Guard:
    """The sample is refused with ``status`` unless ``value`` is of this kind."""

    value: ca.SX
    kind: Kind
    status: Status


@dataclass(frozen=True, slots=True)
class Condition:
    """When a block runs: a row of y is present (any row, if None), and a pivot is above rank tolerance."""

    row: int | None
    positive: ca.SX | None = None


@dataclass(frozen=True, slots=True)
class Variable:
    """A local of one phase. With an ``initial`` value it may be assigned under a condition."""

    name: str
    size: int
    initial: float | None = None


@dataclass(frozen=True, slots=True)
class Block:
    """Simultaneous assignments ``variable := expression`` with the guards that precede them."""

    title: str
    assign: Mapping[str, ca.SX]
    when: Condition | None = None
    guards: tuple[Guard, ...] = ()
    reads: tuple[str, ...] = ()

    def function(self, symbols: Mapping[str, ca.SX]) -> ca.Function:
        """The block as one CasADi function of the variables it reads.

        Outputs: the assigned values in order, then the guards, then the condition's pivot if there is one.
        """
        outputs = [*self.assign.values(), *(guard.value for guard in self.guards)]
        if self.when is not None and self.when.positive is not None:
            outputs.append(self.when.positive)
        return ca.Function("block", [symbols[name] for name in self.reads], outputs)


@dataclass(frozen=True, slots=True)
class Phase:
    """Blocks in order, and the locals that they use."""

    blocks: tuple[Block, ...]
    variables: tuple[Variable, ...]
    symbols: Mapping[str, ca.SX]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recursion:
    """One filter for one spec, as two phases over named ports.

    Attributes
    ----------
    spec : Spec
        What was asked for.
    source : str
        Where the equations come from.
    ports : tuple of Port
        Members of the instance, in order.
    initial : mapping of str to tuple of float
        Stored (packed) start values of ports; the others start at zero.
    update, predict : Phase
        ``step`` is update, then predict.
    notes : tuple of str
        Decisions that the header repeats, such as the form of the covariance update.
    """

    spec: Spec
    source: str
    ports: tuple[Port, ...]
    initial: Mapping[str, tuple[float, ...]]
    update: Phase
    predict: Phase
    notes: tuple[str, ...] = field(default=())

    @property
    def phases(self) -> tuple[Phase, Phase]:
        """Update and predict, in this order."""
        return self.update, self.predict

    def port(self, name: str) -> Port:
        """Return the port of this name; KeyError if there is none."""
        return {port.name: port for port in self.ports}[name]
