"""One sample of the modified Kalman filter in SymPy symbols, eq. (1), (9)-(12), (21).

SymPy has no static types: `Any` stands for its matrices and expressions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False, kw_only=True)
class Setting:
    """Symbols of one sample: plant, prediction error covariance and fault covariance.

    Attributes
    ----------
    A, B, C, D, P, Q, R : Matrix
        Plant of eq. (1) and P[k]; P, Q, R symmetric.
    U : Matrix
        diag(u).
    xi : Symbol
        Success rate.
    faults : Matrix
        Cov(gamma): xi (1 - xi) for one input, free symbols for several.
    """

    A: Any
    B: Any
    C: Any
    D: Any
    P: Any
    Q: Any
    R: Any
    U: Any
    xi: Any
    faults: Any

    @property
    def N(self) -> Any:
        """diag(u) Cov(gamma) diag(u)."""
        return self.U * self.faults * self.U

    @property
    def innovation(self) -> Any:
        """Covariance of the innovation, eq. (21)."""
        return self.C * self.P * self.C.T + self.D * self.N * self.D.T + self.R

    @property
    def inverse(self) -> Any:
        """Om^-1 with the determinant written out, which spares SymPy most of its work."""
        return self.innovation.adjugate() / self.innovation.det().expand()

    @property
    def cross(self) -> Any:
        """Covariance of x[k+1] with the innovation, the right-hand side of eq. (10)."""
        return self.A * self.P * self.C.T + self.B * self.N * self.D.T

    @property
    def gain(self) -> Any:
        """Optimal gain, eq. (11)."""
        return self.cross * self.inverse

    @property
    def filter_gain(self) -> Any:
        """Gain of the measurement update alone."""
        return self.P * self.C.T * self.inverse

    @property
    def riccati(self) -> Any:
        """P[k+1] as in eq. (12)."""
        return self.open_loop - self.cross * self.inverse * self.cross.T

    @property
    def open_loop(self) -> Any:
        """P[k+1] without a measurement."""
        return self.A * self.P * self.A.T + self.Q + self.B * self.N * self.B.T

    def expanded(self, K: Any) -> Any:
        """P[k+1] for any gain as printed in eq. (9)."""
        return self.open_loop - self.cross * K.T - K * self.cross.T + K * self.innovation * K.T

    def stabilised(self, K: Any) -> Any:
        """P[k+1] for any gain as a sum of squares (Joseph)."""
        F, G = self.A - K * self.C, self.B - K * self.D
        return F * self.P * F.T + G * self.N * G.T + self.Q + K * self.R * K.T


def setting(n: int = 2, p: int = 1, q: int = 1) -> Setting:
    """Write down the symbols for n states, p measurements and q inputs.

    Parameters
    ----------
    n, p, q : int
        Dimensions.

    Returns
    -------
    Setting
    """
    import sympy  # noqa: PLC0415 - slow to import

    def general(name: str, rows: int, columns: int) -> Any:
        return sympy.Matrix(rows, columns, lambda i, j: sympy.Symbol(f"{name}{i}{j}", real=True))

    def symmetric(name: str, size: int) -> Any:
        return sympy.Matrix(
            size, size, lambda i, j: sympy.Symbol(f"{name}{max(i, j)}{min(i, j)}", real=True)
        )

    xi = sympy.Symbol("xi", real=True)
    return Setting(
        A=general("a", n, n),
        B=general("b", n, q),
        C=general("c", p, n),
        D=general("d", p, q),
        P=symmetric("p", n),
        Q=symmetric("q", n),
        R=symmetric("r", p),
        U=sympy.diag(*sympy.symbols(f"u0:{q}", real=True)),
        xi=xi,
        faults=sympy.Matrix([[xi * (1 - xi)]]) if q == 1 else symmetric("g", q),
    )
