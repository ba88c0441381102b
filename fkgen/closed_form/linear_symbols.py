"""One step of the linear filter for faulty sensors in SymPy symbols, eq. (23).

SymPy has no static types: `Any` stands for its matrices and expressions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """One step of eq. (23), scalar or matrix, in symbols.

    Attributes
    ----------
    A, H : Matrix
        Plant; H is `C` elsewhere in fkgen.
    C, V : Matrix
        C_(k+1) = E[x x'] at the new sample and V_k = E[xhat xhat'] at the last one.
    R : Matrix
        R E[delta].
    g, p : Matrix
        Diagonal matrices of E[gamma] and p11, ones at rows that do not fail.
    pair : Matrix
        E[G_i G_j].
    """

    A: Any
    H: Any
    C: Any
    V: Any
    R: Any
    g: Any
    p: Any
    pair: Any

    @property
    def predicted(self) -> Any:
        """A V A', the second moment of the predicted estimate."""
        return self.A * self.V * self.A.T

    @property
    def signal(self) -> Any:
        """E[z z'], noise included."""
        return self.pair.multiply_elementwise(self.H * self.C * self.H.T) + self.R

    @property
    def bracket(self) -> Any:
        """What is inverted in eq. (23c)."""
        return self.signal - self.p * self.H * self.predicted * self.H.T * self.p

    @property
    def numerator(self) -> Any:
        """What multiplies the inverse in eq. (23c)."""
        return self.C * self.H.T * self.g - self.predicted * self.H.T * self.p

    @property
    def F2(self) -> Any:
        """Eq. (23c)."""
        return self.numerator * self.bracket.adjugate() / self.bracket.det().expand()

    @property
    def F1(self) -> Any:
        """Eq. (23b)."""
        return self.A - self.F2 * self.p * self.H * self.A

    def estimate_moment(self, F1: Any, F2: Any) -> Any:
        """Eq. (23e) for any gains."""
        cross = F2 * self.p * self.H * self.A * self.V * F1.T
        return F1 * self.V * F1.T + F2 * self.signal * F2.T + cross + cross.T


def step(n: int = 1, p: int = 1, faulty: Sequence[int] = (0,)) -> Step:
    """Write down the symbols for n states and p measurements.

    Parameters
    ----------
    n, p : int
        Dimensions.
    faulty : sequence of int
        Rows subject to faults.

    Returns
    -------
    Step
    """
    import sympy  # noqa: PLC0415 - slow to import

    def general(name: str, rows: int, columns: int) -> Any:
        return sympy.Matrix(rows, columns, lambda i, j: sympy.Symbol(f"{name}{i}{j}", real=True))

    def symmetric(name: str, size: int) -> Any:
        return sympy.Matrix(
            size, size, lambda i, j: sympy.Symbol(f"{name}{max(i, j)}{min(i, j)}", real=True)
        )

    rate, persistence = sympy.symbols("g p", real=True)

    def diagonal(value: Any) -> Any:
        return sympy.diag(*(value if i in faulty else 1 for i in range(p)))

    return Step(
        A=general("a", n, n),
        H=general("h", p, n),
        C=symmetric("c", n),
        V=symmetric("v", n),
        R=symmetric("r", p),
        g=diagonal(rate),
        p=diagonal(persistence),
        pair=sympy.Matrix(p, p, lambda i, j: rate if i in faulty or j in faulty else 1),
    )
