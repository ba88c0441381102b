"""What a filter shows to the outside: ports, statuses, demands. No CasADi here."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Role(Enum):
    """What a port is for: carried to the next sample, or written for the user only."""

    STATE = "state"
    OUTPUT = "output"


class Status(Enum):
    """Why a generated function returns what it returns; the value is the C status code."""

    OK = 0
    SKIPPED = 1
    FAULT_DECLARED = 2
    LOCKED_OUT = 3
    NULL_POINTER = -1
    INPUT_NOT_FINITE = -2
    NOT_POSITIVE_DEFINITE = -3
    PARAMETER_OUT_OF_RANGE = -4
    RESULT_NOT_FINITE = -5
    SELFTEST_FAILED = -6

    @property
    def meaning(self) -> str:
        """One sentence for the header and for error messages."""
        return _MEANINGS[self]


_MEANINGS = {
    Status.OK: "the sample was used",
    Status.SKIPPED: "no row of y was present: nothing was learnt from this sample",
    Status.FAULT_DECLARED: "what was tested is rejected as faulty and did not correct the estimate",
    Status.LOCKED_OUT: "the same, and too many samples in a row were rejected: doubt the filter",
    Status.NULL_POINTER: "a pointer argument is NULL",
    Status.INPUT_NOT_FINITE: "u holds NaN or an infinity, or y holds an infinity",
    Status.NOT_POSITIVE_DEFINITE: "a covariance lost its positivity",
    Status.PARAMETER_OUT_OF_RANGE: (
        "a variance below zero, a rate outside [0, 1], or an indicator with another value"
    ),
    Status.RESULT_NOT_FINITE: "the result would not be finite",
    Status.SELFTEST_FAILED: "the self-test does not give the recorded bits on this target",
}


#: Statuses that only filters have which test their samples.
VERDICTS = (Status.FAULT_DECLARED, Status.LOCKED_OUT)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is returned for a sample with a row whose ``port`` ends above a ``level``, anywhere."""

    status: Status
    port: str
    level: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Port:
    """A member of the C instance and a column of a run."""

    name: str  # Name in C and in Python
    shape: tuple[int, ...]  # Shape of one sample as Python shows it
    role: Role
    meaning: str  # For the header
    #: For the header, in the units of the signals: "x", "y", "xx" and "yy" for products of two
    #: of them, "x/y"; empty for numbers without a unit, and mixtures
    unit: str = ""
    #: The last two axes are one symmetric matrix, of which the lower triangle is stored by rows
    symmetric: bool = False
    per_row: bool = False  # One entry per row of y, NaN in Python where the row is missing
    #: A port of the same shape: where it is 0, this one says nothing and is NaN in Python
    given: str = ""

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
