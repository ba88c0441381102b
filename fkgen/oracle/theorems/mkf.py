"""One sample of the modified Kalman filter in SymPy symbols, eq. (1), (9)-(12), (21).

SymPy has no static types: `Any` stands for its matrices and expressions.

The algebra behind the modified Kalman filter, proved by SymPy for small dimensions.

Each identity is a residual that must be exactly zero for every value of its symbols.
`Identity.holds` decides by expanding the numerator: a rational function is zero if and only if that
polynomial is. SymPy has no static types: `Any` stands for its matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False, kw_only=True)
class Setting:
    """Symbols of one sample: plant, prediction error covariance and fault covariance."""

    A: Any  # A, B, C, D, P, Q, R: Plant of eq. (1) and P[k]; P, Q, R symmetric
    B: Any
    C: Any
    D: Any
    P: Any
    Q: Any
    R: Any
    U: Any  # diag(u)
    xi: Any  # Success rate
    faults: Any  # Cov(gamma): xi (1 - xi) for one input, free symbols for several

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
    """Write down the symbols for n states, p measurements and q inputs."""
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


PAPER = "Strandt, Schneider, Yaz"


@dataclass(frozen=True, eq=False, kw_only=True)
class Identity:
    """One claim and the expression that must vanish if it is true."""

    claim: str  # What is claimed, in a sentence
    source: str  # Where it stands
    residual: Callable[[], tuple[Any, ...]]  # Returns the SymPy matrices that must be zero

    def holds(self) -> bool:
        """Whether every entry of the residual is identically zero."""
        import sympy  # noqa: PLC0415 - slow to import

        entries = (entry for matrix in self.residual() for entry in sympy.Matrix(matrix))
        return all(sympy.expand(sympy.numer(sympy.together(entry))) == 0 for entry in entries)


def _free_gain(s: Setting) -> Any:
    import sympy  # noqa: PLC0415 - slow to import

    return sympy.Matrix(*s.C.T.shape, lambda i, j: sympy.Symbol(f"k{i}{j}", real=True))


def _second_moment_of_the_error() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    s = setting()
    K = _free_gain(s)
    map_ = sympy.Matrix.hstack(s.A - K * s.C, (s.B - K * s.D) * s.U, sympy.eye(2), -K)
    return (map_ * sympy.diag(s.P, s.faults, s.Q, s.R) * map_.T - s.expanded(K),)


def _stabilised_form() -> tuple[Any, ...]:
    s = setting()
    K = _free_gain(s)
    return (s.stabilised(K) - s.expanded(K),)


def _gradient() -> tuple[Any, ...]:
    s = setting()
    K = _free_gain(s)
    gradient = s.expanded(K).trace().diff(K)
    return (gradient.subs(dict(zip(K, s.gain, strict=True))),)


def _hessian() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    s = setting()
    K = _free_gain(s)
    hessian = sympy.hessian(s.expanded(K).trace(), list(K))
    root = sympy.Matrix([[sympy.Symbol("l00"), 0], [sympy.Symbol("l10"), sympy.Symbol("l11")]])
    along = s.C * root
    squares = along * along.T + s.xi * (1 - s.xi) * (s.D * s.U) * (s.D * s.U).T + s.R
    covariance = s.innovation.subs(dict(zip(s.P, root * root.T, strict=True)))
    return hessian - 2 * s.innovation[0, 0] * sympy.eye(2), covariance - squares


def _price_of_another_gain() -> tuple[Any, ...]:
    s = setting()
    d = _free_gain(s)
    return (s.expanded(s.gain + d) - s.expanded(s.gain) - d * s.innovation * d.T,)


def _optimal_covariance() -> tuple[Any, ...]:
    s = setting()
    return (s.stabilised(s.gain) - s.riccati,)


def _rate_one_and_zero() -> tuple[Any, ...]:
    s = setting()
    kalman = s.A * s.P * s.C.T * (s.C * s.P * s.C.T + s.R).inv()
    covariance = s.A * s.P * s.A.T + s.Q - kalman * s.C * s.P * s.A.T
    pairs = ((s.gain, kalman), (s.riccati, covariance))
    return tuple(ours.subs(s.xi, rate) - theirs for rate in (0, 1) for ours, theirs in pairs)


def _estimate_at_rate_one_and_zero() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    s = setting()
    x, y, K = sympy.Matrix(sympy.symbols("x0 x1")), sympy.Matrix([sympy.Symbol("y")]), _free_gain(s)
    ones = sympy.ones(1, 1)
    ours = s.A * x + s.xi * s.B * s.U * ones + K * (y - s.C * x - s.xi * s.D * s.U * ones)
    driven = s.A * x + s.B * s.U * ones + K * (y - s.C * x - s.D * s.U * ones)
    free = s.A * x + K * (y - s.C * x)
    return ours.subs(s.xi, 1) - driven, ours.subs(s.xi, 0) - free


def _mirrored_rate() -> tuple[Any, ...]:
    s = setting()
    return tuple(m - m.subs(s.xi, 1 - s.xi) for m in (s.riccati, s.gain, s.innovation))


def _no_input() -> tuple[Any, ...]:
    s = setting()
    still = {s.U[0, 0]: 0}
    return s.riccati.subs(still).diff(s.xi), s.gain.subs(still).diff(s.xi)


def _two_gains() -> tuple[Any, ...]:
    s = setting()
    difference = s.gain - s.A * s.filter_gain
    without = {s.D[0, 0]: 0}
    return difference - s.B * s.N * s.D.T * s.inverse, difference.subs(without)


def _filtered_covariance() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    s = setting()
    K = s.filter_gain
    F = sympy.eye(2) - K * s.C
    return (s.P - K * s.innovation * K.T - F * s.P * F.T - K * (s.R + s.D * s.N * s.D.T) * K.T,)


def _augmented(n: int, p: int, q: int) -> tuple[Any, ...]:
    """Condition z = (x, gamma - xi) on y, then move on: against eq. (12) and (11)."""
    import sympy  # noqa: PLC0415 - slow to import

    s = setting(n, p, q)
    Z = sympy.diag(s.P, s.faults)
    row = sympy.Matrix.hstack(s.C, s.D * s.U)
    onward = sympy.Matrix.hstack(s.A, s.B * s.U)
    covariance = row * Z * row.T + s.R
    gain = Z * row.T * s.inverse
    conditioned = Z - gain * row * Z
    return (
        covariance - s.innovation,
        onward * conditioned * onward.T + s.Q - s.riccati,
        onward * gain - s.gain,
    )


def _mixture_moments() -> tuple[Any, ...]:
    s = setting()
    noise = s.C * s.P * s.C.T + s.R
    worked, failed = s.D * s.U, 0 * s.D
    mean = s.xi * worked + (1 - s.xi) * failed
    second = s.xi * (noise + worked * worked.T) + (1 - s.xi) * (noise + failed * failed.T)
    return mean - s.xi * s.D * s.U, second - mean * mean.T - s.innovation


def _several_inputs() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    s = setting(2, 1, 2)
    u = s.U * sympy.ones(2, 1)
    variance = s.xi * (1 - s.xi)
    together = s.U * (variance * sympy.ones(2, 2)) * s.U
    r0, r1 = sympy.symbols("xi0 xi1")
    apart = s.B * s.U * sympy.diag(r0 * (1 - r0), r1 * (1 - r1)) * s.U * s.B.T
    columns = [
        s.B[:, i] * s.B[:, i].T * u[i] ** 2 * rate * (1 - rate) for i, rate in enumerate((r0, r1))
    ]
    return together - variance * u * u.T, apart - columns[0] - columns[1]


#: Every claim, in the order of the derivation.
IDENTITIES: tuple[Identity, ...] = (
    Identity(
        claim="eq. (9) is the second moment of the error (5)",
        source=f"{PAPER}, eq. (5), (8), (9)",
        residual=_second_moment_of_the_error,
    ),
    Identity(
        claim="eq. (9) equals the sum of squares (Joseph form) for any gain",
        source=f"{PAPER}, eq. (9)",
        residual=_stabilised_form,
    ),
    Identity(
        claim="the gradient of tr P[k+1] vanishes at the gain (11)",
        source=f"{PAPER}, eq. (10), (11)",
        residual=_gradient,
    ),
    Identity(
        claim="the Hessian of tr P[k+1] is 2 Om, a sum of squares plus R",
        source=f"{PAPER}, eq. (9), (21)",
        residual=_hessian,
    ),
    Identity(
        claim="P(K* + d) - P(K*) = d Om d'",
        source=f"{PAPER}, eq. (9)-(11), completing the square",
        residual=_price_of_another_gain,
    ),
    Identity(
        claim="eq. (12) equals the Joseph form of eq. (9) at the gain (11)",
        source=f"{PAPER}, eq. (9), (11), (12)",
        residual=_optimal_covariance,
    ),
    Identity(
        claim="at success rates 1 and 0 gain and covariance are those of the Kalman predictor",
        source=f"{PAPER}, eq. (11), (12)",
        residual=_rate_one_and_zero,
    ),
    Identity(
        claim="at success rate 1 the estimate is the Kalman predictor's, at 0 it ignores u",
        source=f"{PAPER}, eq. (4)",
        residual=_estimate_at_rate_one_and_zero,
    ),
    Identity(
        claim="gain and covariances are the same for xi and 1 - xi",
        source=f"{PAPER}, eq. (11), (12), (21)",
        residual=_mirrored_rate,
    ),
    Identity(
        claim="without input gain and covariance do not depend on xi",
        source=f"{PAPER}, eq. (11), (12)",
        residual=_no_input,
    ),
    Identity(
        claim="K - A Kf = B N D' Om^-1, zero if D = 0",
        source=f"{PAPER}, eq. (11)",
        residual=_two_gains,
    ),
    Identity(
        claim="Pf = P - Kf Om Kf' equals its Joseph form",
        source=f"{PAPER}, eq. (11) with A = I and B = 0",
        residual=_filtered_covariance,
    ),
    Identity(
        claim="conditioning (x, gamma - xi) on y and moving on gives (11) and (12)",
        source=f"{PAPER}, eq. (1), (11), (12); n = 2, p = 1, q = 1",
        residual=lambda: _augmented(2, 1, 1),
    ),
    Identity(
        claim="the same for two inputs of any fault covariance",
        source=f"{PAPER}, eq. (1), (11), (12); n = 1, p = 1, q = 2",
        residual=lambda: _augmented(1, 1, 2),
    ),
    Identity(
        claim="the same for two measurements",
        source=f"{PAPER}, eq. (1), (11), (12); n = 1, p = 2, q = 1",
        residual=lambda: _augmented(1, 2, 1),
    ),
    Identity(
        claim="the mixture over both states of the actuator has the two moments of eq. (15)",
        source=f"{PAPER}, eq. (15), (21)",
        residual=_mixture_moments,
    ),
    Identity(
        claim="N = s u u' for a common fault; B N B' = sum s_i u_i^2 b_i b_i' for independent ones",
        source=f"{PAPER}, eq. (9), several inputs",
        residual=_several_inputs,
    ),
)
