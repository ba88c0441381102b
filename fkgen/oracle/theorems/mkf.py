"""The algebra behind the modified Kalman filter, eq. (1), (9)-(12), (21), for small dimensions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from fkgen.oracle.theorems.identity import Equations, Theorems, general, scalar, symmetric, sympy


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

    # diag(u) Cov(gamma) diag(u)
    N = property(lambda s: s.U * s.faults * s.U)
    # Covariance of the innovation, eq. (21)
    innovation = property(lambda s: s.C * s.P * s.C.T + s.D * s.N * s.D.T + s.R)
    # Om^-1 with the determinant written out, which spares SymPy most of its work
    inverse = property(lambda s: s.innovation.adjugate() / s.innovation.det().expand())
    # Covariance of x[k+1] with the innovation, the right-hand side of eq. (10)
    cross = property(lambda s: s.A * s.P * s.C.T + s.B * s.N * s.D.T)
    # Optimal gain, eq. (11), and the gain of the measurement update alone
    gain = property(lambda s: s.cross * s.inverse)
    filter_gain = property(lambda s: s.P * s.C.T * s.inverse)
    # P[k+1] without a measurement, and as in eq. (12)
    open_loop = property(lambda s: s.A * s.P * s.A.T + s.Q + s.B * s.N * s.B.T)
    riccati = property(lambda s: s.open_loop - s.cross * s.inverse * s.cross.T)
    # Any gain, in symbols
    free_gain = property(lambda s: general("k", *s.C.T.shape))

    def expanded(self, K: Any) -> Any:
        """P[k+1] for any gain as printed in eq. (9)."""
        return self.open_loop - self.cross * K.T - K * self.cross.T + K * self.innovation * K.T

    def stabilised(self, K: Any) -> Any:
        """P[k+1] for any gain as a sum of squares (Joseph)."""
        F, G = self.A - K * self.C, self.B - K * self.D
        return F * self.P * F.T + G * self.N * G.T + self.Q + K * self.R * K.T


def setting(n: int = 2, p: int = 1, q: int = 1) -> Setting:
    """Write down the symbols for n states, p measurements and q inputs."""
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


_THEOREMS = Theorems("Strandt, Schneider, Yaz", setting)


@_THEOREMS.claim("eq. (9) is the second moment of the error (5)", "eq. (5), (8), (9)")
def _second_moment_of_the_error(s: Setting) -> Equations:
    K = s.free_gain
    map_ = sympy.Matrix.hstack(s.A - K * s.C, (s.B - K * s.D) * s.U, sympy.eye(2), -K)
    return ((map_ * sympy.diag(s.P, s.faults, s.Q, s.R) * map_.T, s.expanded(K)),)


_THEOREMS.claim("eq. (9) equals the sum of squares (Joseph form) for any gain", "eq. (9)")(
    lambda s: ((s.stabilised(s.free_gain), s.expanded(s.free_gain)),)
)


@_THEOREMS.claim("the gradient of tr P[k+1] vanishes at the gain (11)", "eq. (10), (11)")
def _gradient(s: Setting) -> Equations:
    gradient = s.expanded(s.free_gain).trace().diff(s.free_gain)
    at_optimum = gradient.subs(dict(zip(s.free_gain, s.gain, strict=True)))
    return ((at_optimum, sympy.zeros(*gradient.shape)),)


@_THEOREMS.claim("the Hessian of tr P[k+1] is 2 Om, a sum of squares plus R", "eq. (9), (21)")
def _hessian(s: Setting) -> Equations:
    hessian = sympy.hessian(s.expanded(s.free_gain).trace(), list(s.free_gain))
    root = sympy.Matrix([[sympy.Symbol("l00"), 0], [sympy.Symbol("l10"), sympy.Symbol("l11")]])
    along = s.C * root
    squares = along * along.T + s.xi * (1 - s.xi) * (s.D * s.U) * (s.D * s.U).T + s.R
    covariance = s.innovation.subs(dict(zip(s.P, root * root.T, strict=True)))
    return (hessian, 2 * s.innovation[0, 0] * sympy.eye(2)), (covariance, squares)


_THEOREMS.claim("P(K* + d) - P(K*) = d Om d'", "eq. (9)-(11), completing the square")(
    lambda s: (
        (
            s.expanded(s.gain + s.free_gain) - s.expanded(s.gain),
            s.free_gain * s.innovation * s.free_gain.T,
        ),
    )
)
_THEOREMS.claim(
    "eq. (12) equals the Joseph form of eq. (9) at the gain (11)", "eq. (9), (11), (12)"
)(lambda s: ((s.stabilised(s.gain), s.riccati),))


@_THEOREMS.claim(
    "at success rates 1 and 0 gain and covariance are those of the Kalman predictor",
    "eq. (11), (12)",
)
def _rate_one_and_zero(s: Setting) -> Equations:
    kalman = s.A * s.P * s.C.T * (s.C * s.P * s.C.T + s.R).inv()
    covariance = s.A * s.P * s.A.T + s.Q - kalman * s.C * s.P * s.A.T
    pairs = ((s.gain, kalman), (s.riccati, covariance))
    return tuple((ours.subs(s.xi, rate), theirs) for rate in (0, 1) for ours, theirs in pairs)


@_THEOREMS.claim(
    "at success rate 1 the estimate is the Kalman predictor's, at 0 it ignores u", "eq. (4)"
)
def _estimate_at_rate_one_and_zero(s: Setting) -> Equations:
    x, y, u, K = general("x", 2, 1), scalar("y"), s.U, s.free_gain
    ours = s.A * x + s.xi * s.B * u + K * (y - s.C * x - s.xi * s.D * u)
    driven = s.A * x + s.B * u + K * (y - s.C * x - s.D * u)
    free = s.A * x + K * (y - s.C * x)
    return (ours.subs(s.xi, 1), driven), (ours.subs(s.xi, 0), free)


_THEOREMS.claim("gain and covariances are the same for xi and 1 - xi", "eq. (11), (12), (21)")(
    lambda s: tuple((m, m.subs(s.xi, 1 - s.xi)) for m in (s.riccati, s.gain, s.innovation))
)
_THEOREMS.claim("without input gain and covariance do not depend on xi", "eq. (11), (12)")(
    lambda s: tuple(
        (m, m.subs(s.xi, sympy.Symbol("other_xi", real=True)))
        for m in (each.subs(s.U[0, 0], 0) for each in (s.riccati, s.gain))
    )
)


@_THEOREMS.claim("K - A Kf = B N D' Om^-1, zero if D = 0", "eq. (11)")
def _two_gains(s: Setting) -> Equations:
    difference = s.gain - s.A * s.filter_gain
    without = difference.subs(s.D[0, 0], 0)
    return (difference, s.B * s.N * s.D.T * s.inverse), (without, 0 * without)


@_THEOREMS.claim("Pf = P - Kf Om Kf' equals its Joseph form", "eq. (11) with A = I and B = 0")
def _filtered_covariance(s: Setting) -> Equations:
    K = s.filter_gain
    F = sympy.eye(2) - K * s.C
    joseph = F * s.P * F.T + K * (s.R + s.D * s.N * s.D.T) * K.T
    return ((s.P - K * s.innovation * K.T, joseph),)


def _augmented(s: Setting) -> Equations:
    """Condition z = (x, gamma - xi) on y, then move on: against eq. (12) and (11)."""
    Z = sympy.diag(s.P, s.faults)
    row, onward = s.C.row_join(s.D * s.U), s.A.row_join(s.B * s.U)
    covariance = row * Z * row.T + s.R
    gain = Z * row.T * s.inverse
    moved = onward * (Z - gain * row * Z) * onward.T + s.Q
    return (covariance, s.innovation), (moved, s.riccati), (onward * gain, s.gain)


for _claim, _n, _p, _q in (
    ("conditioning (x, gamma - xi) on y and moving on gives (11) and (12)", 2, 1, 1),
    ("the same for two inputs of any fault covariance", 1, 1, 2),
    ("the same for two measurements", 1, 2, 1),
):
    _equations = f"eq. (1), (11), (12); n = {_n}, p = {_p}, q = {_q}"
    _THEOREMS.claim(_claim, _equations, partial(setting, _n, _p, _q))(_augmented)


@_THEOREMS.claim(
    "the mixture over both states of the actuator has the two moments of eq. (15)", "eq. (15), (21)"
)
def _mixture_moments(s: Setting) -> Equations:
    noise = s.C * s.P * s.C.T + s.R
    worked, failed = s.D * s.U, 0 * s.D
    mean = s.xi * worked + (1 - s.xi) * failed
    second = s.xi * (noise + worked * worked.T) + (1 - s.xi) * (noise + failed * failed.T)
    return (mean, s.xi * s.D * s.U), (second - mean * mean.T, s.innovation)


@_THEOREMS.claim(
    "N = s u u' for a common fault; B N B' = sum s_i u_i^2 b_i b_i' for independent ones",
    "eq. (9), several inputs",
    partial(setting, 2, 1, 2),
)
def _several_inputs(s: Setting) -> Equations:
    u, variance = s.U * sympy.ones(2, 1), s.xi * (1 - s.xi)
    together = s.U * (variance * sympy.ones(2, 2)) * s.U
    variances = [rate * (1 - rate) for rate in sympy.symbols("xi0 xi1")]
    apart = s.B * s.U * sympy.diag(*variances) * s.U * s.B.T
    columns = [s.B[:, i] * s.B[:, i].T * u[i] ** 2 * each for i, each in enumerate(variances)]
    return (together, variance * u * u.T), (apart, columns[0] + columns[1])


#: Every claim, in the order of the derivation.
IDENTITIES = tuple(_THEOREMS)
