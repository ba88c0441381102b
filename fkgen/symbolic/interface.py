"""What a filter shows to the outside: ports and how they are stored, statuses. No CasADi here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from enum import Enum
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Role(Enum):
    """What a port is for: carried to the next sample, or written for the user only."""

    STATE = "state"
    OUTPUT = "output"


class Status(Enum):
    """Why a generated function returns what it returns: a C status code, and what it means."""

    _value_: int
    meaning: str  # One sentence for the header and for error messages

    def __new__(cls, code: int, meaning: str = "") -> Self:
        """Make ``Status(code)`` find a member."""
        status = object.__new__(cls)
        status._value_, status.meaning = code, meaning
        return status

    OK = 0, "the sample was used"
    SKIPPED = 1, "no row of y was present: nothing was learnt from this sample"
    FAULT_DECLARED = 2, "what was tested is rejected as faulty and did not correct the estimate"
    LOCKED_OUT = 3, "the same, and too many samples in a row were rejected: doubt the filter"
    NULL_POINTER = -1, "a pointer argument is NULL"
    INPUT_NOT_FINITE = -2, "u holds NaN or an infinity, or y holds an infinity"
    NOT_POSITIVE_DEFINITE = -3, "a covariance lost its positivity"
    PARAMETER_OUT_OF_RANGE = (
        -4,
        "a parameter out of its range, or one that no variance, rate or expression can take",
    )
    RESULT_NOT_FINITE = -5, "the result would not be finite"
    SELFTEST_FAILED = -6, "the self-test does not give the recorded bits on this target"
    WRONG_ORDER = -7, "a second update of this sample, which this filter cannot take: predict first"
    NOT_A_ROTATION = -8, "a quaternion to start from is not of unit length, to within 1e-3"
    INPUT_OUT_OF_RANGE = -9, "u, or a mean to start from, lies outside of its range"
    INVALID_INSTANCE = -10, "not started, damaged, or an instance of another model"
    PRIOR_COUPLED = -11, "a covariance to start from between states that code.decoupled keeps apart"


#: Members of an instance beside its ports: 1 after an update and 0 after a prediction, which tells
#: the latest estimate; 1 for each group of rows with correlated noises of which one was used since.
UPDATED, CORRELATED = "updated", "correlated"

#: An argument of an update beside y: 1 for each row that was measured and is out of its range.
OUTSIDE = "outside"

#: The member of an instance that says of which model it is.
MODEL = "model"

#: Statuses that only filters have which test their samples.
VERDICTS = (Status.FAULT_DECLARED, Status.LOCKED_OUT)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What is returned for a sample with a row whose ``port`` ends above a ``level``, anywhere."""

    status: Status
    port: str
    level: float


def triangle(n: int) -> list[tuple[int, int]]:
    """Index pairs of the lower triangle of an n x n matrix, by rows: (0,0), (1,0), (1,1), ..."""
    return [(i, j) for i in range(n) for j in range(i + 1)]


@dataclass(frozen=True, slots=True)
class Port:
    """A member of the C instance and a column of a run."""

    name: str  # Name in C and in Python
    shape: tuple[int, ...]  # Shape of one sample as Python shows it
    meaning: str  # For the header
    _: KW_ONLY
    role: Role
    #: For the header, in the units of the signals: "x", "y", "xx" and "yy" for products of two
    #: of them, "x/y"; empty for numbers without a unit, and mixtures
    unit: str = ""
    #: The last two axes are one symmetric matrix, of which the lower triangle is stored by rows
    symmetric: bool = False
    per_row: bool = False  # One entry per row of y, NaN in Python where the row is missing
    #: A port of the same shape: where it is 0, this one says nothing and is NaN in Python
    given: str = ""
    #: Of a prediction that updates read: the port that holds the same once an update has been
    corrected: str = ""
    #: 1 or 0 for each row of y, which C also shows as the bits of words, and Python as booleans
    flags: bool = False
    inner: bool = False  # For the filter alone: a run keeps it only if it is asked for by name
    start: tuple[float, ...] = field(default=(), compare=False)  # As stored; empty for zeros
    #: What it starts as in place of ``start``, repeated: mean or packed covariance of the prior
    prior: Literal["", "x", "P"] = ""

    @property
    def member(self) -> str:
        """The member of the C instance that holds the values."""
        return f"{self.name}_rows" if self.flags else self.name

    @property
    def size(self) -> int:
        """Number of scalars stored in C."""
        if not self.symmetric:
            return math.prod(self.shape)
        return math.prod(self.shape[:-2]) * len(triangle(self.shape[-1]))

    def unpacked(self, stored: ArrayLike) -> NDArray[np.floating]:
        """A stored sample in the shape that Python shows."""
        values = np.asarray(stored)
        if not self.symmetric:
            return values.reshape(self.shape)
        pairs = triangle(n := self.shape[-1])
        index = np.zeros((n, n), int)
        for at, (i, j) in enumerate(pairs):
            index[i, j] = index[j, i] = at
        return values.reshape(-1, len(pairs))[:, index].reshape(self.shape)

    def shown(self, stored: Mapping[str, ArrayLike], y: ArrayLike) -> NDArray[np.floating]:
        """Its value after a sample: NaN where it says nothing, and where a row of y is missing."""
        value = self.unpacked(stored[self.name])
        if self.given:
            value = np.where(self.unpacked(stored[self.given]) > 0, value, np.nan)
        return np.where(np.isnan(y), np.nan, value) if self.per_row else value


class Kind(Enum):
    """What a guard demands of its value."""

    POSITIVE = "positive"
    NONNEGATIVE = "nonnegative"
    FINITE = "finite"
