"""The algebra behind the linear filter for faulty sensors, eq. (19)-(23), (29)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from fkgen.oracle.theorems.identity import Equations, Theorems, general, symmetric, sympy


@dataclass(frozen=True, eq=False, kw_only=True)
class Step:
    """One step of eq. (23), scalar or matrix, in symbols."""

    A: Any  # A, H: Plant; H is `C` elsewhere in fkgen
    H: Any
    C: Any  # C, V: C_(k+1) = E[x x'] at the new sample and V_k = E[xhat xhat'] at the last one
    V: Any
    R: Any  # R E[delta]
    g: Any  # g, p: Diagonal matrices of E[gamma] and p11, ones at rows that do not fail
    p: Any
    pair: Any  # E[G_i G_j]

    # A V A', the second moment of the predicted estimate, and the prediction error covariance
    predicted = property(lambda s: s.A * s.V * s.A.T)
    prediction_error = property(lambda s: s.C - s.predicted)
    # E[z z'], noise included
    signal = property(lambda s: s.pair.multiply_elementwise(s.H * s.C * s.H.T) + s.R)
    # What is inverted in eq. (23c), and what multiplies the inverse
    bracket = property(lambda s: (s.signal - s.p * s.H * s.predicted * s.H.T * s.p).expand())
    numerator = property(lambda s: s.C * s.H.T * s.g - s.predicted * s.H.T * s.p)
    # Eq. (23c), (23b) and C - V with (23e)
    F2 = property(lambda s: s.numerator * s.bracket.adjugate() / s.bracket.det().expand())
    F1 = property(lambda s: s.A - s.F2 * s.p * s.H * s.A)
    error = property(lambda s: s.C - s.estimate_moment(s.F1, s.F2))

    def estimate_moment(self, F1: Any, F2: Any) -> Any:
        """Eq. (23e) for any gains."""
        cross = F2 * self.p * self.H * self.A * self.V * F1.T
        return F1 * self.V * F1.T + F2 * self.signal * F2.T + cross + cross.T


def step(n: int = 1, p: int = 1, faulty: Sequence[int] = (0,)) -> Step:
    """Write down the symbols for n states and p measurements, with the rows subject to faults."""
    rate, persistence = sympy.symbols("g p", real=True)
    failing = [i in faulty for i in range(p)]
    s = Step(
        A=general("a", n, n),
        H=general("h", p, n),
        C=symmetric("c", n),
        V=symmetric("v", n),
        R=symmetric("m", p),
        g=sympy.diag(*(rate if fails else 1 for fails in failing)),
        p=sympy.diag(*(persistence if fails else 1 for fails in failing)),
        pair=sympy.Matrix(p, p, lambda i, j: rate if failing[i] or failing[j] else 1),
    )
    return replace(s, R=2 * s.R - s.bracket)  # symbols for the bracket: no inverse of a sum


_THEOREMS = Theorems("Sigalov, Oshman", partial(step, 2, 1))


@_THEOREMS.claim(
    "under Lemma 2 and (23b) the error is orthogonal to each past measurement, any gain",
    "eq. (20), i <= k, (21), Lemma 2",
)
def _past_measurement(s: Step) -> Equations:
    """E[(xhat_(k+1) - x_(k+1)) z_i'] for i <= k, with E[xhat_k z_i'] = E[x_k z_i'] from before.

    For gamma_i = 1 of rate g_i: E[x_k z_i'] = g_i E[x_k x_i'] H', E[gamma_(k+1) gamma_i] = p g_i.
    """
    lagged = sympy.Matrix(2, 2, lambda i, j: sympy.Symbol(f"x{i}{j}"))  # E[x_k x_i']
    rate = sympy.Symbol("g_i")
    x_z = rate * lagged * s.H.T
    gamma_x_z = s.p[0, 0] * rate * s.A * lagged * s.H.T  # E[gamma_(k+1) x_(k+1) z_i']
    F2 = sympy.Matrix(sympy.symbols("f0:2"))  # any gain, not only (23c)
    F1 = s.A - F2 * s.p * s.H * s.A
    return ((F1 * x_z + F2 * s.H * gamma_x_z, s.A * x_z),)


@_THEOREMS.claim(
    "with (23b) and (23c) the error is orthogonal to the new measurement", "eq. (20), i = k + 1"
)
def _new_measurement(s: Step) -> Equations:
    """E[(xhat_(k+1) - x_(k+1)) z_(k+1)'], with E[xhat_k gamma x_k'] = p V_k."""
    xhat_z = s.V * s.A.T * s.H.T * s.p
    return ((s.F1 * xhat_z + s.F2 * s.signal, s.C * s.H.T * s.g),)


@_THEOREMS.claim("(23b) and (23c) solve (22)", "eq. (22)")
def _equation_22(s: Step) -> Equations:
    left = s.g[0, 0] * (sympy.eye(2) - s.F2 * s.H) * s.C * s.H.T
    return ((left, s.F1 * s.p[0, 0] * s.V * s.A.T * s.H.T + s.F2 * s.R),)


@_THEOREMS.claim(
    "(23e) is E[xhat xhat'] for any gains, and E[xhat x'] for those of (23)", "eq. (23e)"
)
def _estimate_moment(s: Step) -> Equations:
    F2 = sympy.Matrix(sympy.symbols("f0:2"))
    F1 = sympy.Matrix(2, 2, sympy.symbols("e0:4"))
    xhat_z = s.V * s.A.T * s.H.T * s.p
    joint = sympy.Matrix(sympy.BlockMatrix([[s.V, xhat_z], [xhat_z.T, s.signal]]))
    map_ = sympy.Matrix.hstack(F1, F2)
    with_state = s.F1 * s.V * s.A.T + s.F2 * s.g * s.H * s.C  # E[xhat_(k+1) x_(k+1)']
    moment = s.estimate_moment
    return (map_ * joint * map_.T, moment(F1, F2)), (moment(s.F1, s.F2), with_state)


_THEOREMS.claim("V = A V A' + F2 M F2' with M the bracket of (23c)", "eq. (23c), (23e)")(
    lambda s: ((s.estimate_moment(s.F1, s.F2), s.predicted + s.F2 * s.bracket * s.F2.T),)
)


def _covariance_form(s: Step) -> Equations:
    """N, M, F2 and P from the prediction error covariance against C - V."""
    prediction = s.prediction_error  # Pp = C_(k+1) - A V_k A'
    weight = s.pair - s.p * sympy.ones(*s.p.shape) * s.p
    M = s.p * s.H * prediction * s.H.T * s.p + weight.multiply_elementwise(s.H * s.C * s.H.T) + s.R
    N = prediction * s.H.T * s.p + s.C * s.H.T * (s.g - s.p)
    inverse = M.adjugate() / M.det().expand()
    return (N, s.numerator), (M, s.bracket), (prediction - N * inverse * N.T, s.error)


for _claim, _n, _p, _faulty in (
    ("the covariance form equals C - V", 2, 1, (0,)),
    ("the same for two rows of which one never fails", 1, 2, (1,)),
    ("the same for two rows that fail together", 1, 2, (0, 1)),
):
    _setting = partial(step, _n, _p, _faulty)
    _THEOREMS.claim(_claim, f"eq. (23); n = {_n}, p = {_p}", _setting)(_covariance_form)


@_THEOREMS.claim(
    "three samples of (23) satisfy all orthogonality conditions, time-varying p11",
    "eq. (20), (23); n = p = 1",
)
def _first_samples(_: Step) -> Equations:
    """Three samples of a scalar plant without induction: the errors against z_0, z_1 and z_2.

    E[gamma_0], E[gamma_1], E[gamma_2], p11(1) and p11(2) are free, as for an absorbing chain.
    """
    # Elements of a field of rational functions: sums of them are reduced at once.
    field, *free = sympy.field("g0 g1 g2 p1 p2", sympy.QQ)
    a, q, r = sympy.Rational(-4, 5), 1, 3
    g, p = free[:3], [field.zero, *free[3:]]
    C = [sympy.Integer(2)]
    for k in range(2):
        C.append(a**2 * C[k] + q)

    def z_z(k: int, i: int) -> Any:
        if k == i:
            return g[k] * C[k] + r
        first, last = min(i, k), max(i, k)
        return p[last] * g[first] * a ** (last - first) * C[first]

    weights: list[Any] = []  # xhat_k = sum of weights[i] z_i
    V, entries = field.zero, []
    for k in range(3):
        F2 = (g[k] * C[k] - p[k] * a**2 * V) / (z_z(k, k) - (p[k] * a) ** 2 * V)
        F1 = a - p[k] * F2 * a
        V = F1**2 * V + F2**2 * z_z(k, k) + 2 * p[k] * F1 * F2 * a * V
        weights = [*(F1 * weight for weight in weights), F2]
        entries += [
            (
                sum(weight * z_z(j, i) for j, weight in enumerate(weights)),
                g[i] * a ** (k - i) * C[i],
            )
            for i in range(k + 1)
        ]
    return tuple(([left.as_expr()], [right.as_expr()]) for left, right in entries)


@_THEOREMS.claim(
    "for independent gamma the filter is Nahi's",
    "Optimal recursive estimation with uncertain observation",
    paper="Nahi 1969",
)
def _nahi(s: Step) -> Equations:
    """p11 = E[gamma]: gain and covariance as Nahi has them."""
    R = s.R.subs(s.p[0, 0], s.g[0, 0])
    s, g, prediction = replace(s, p=s.g, R=R), s.g[0, 0], s.prediction_error
    M = g**2 * s.H * prediction * s.H.T + s.R + g * (1 - g) * s.H * s.C * s.H.T
    K = g * prediction * s.H.T / M.det().expand()
    covariance = prediction - g * K * s.H * prediction
    return (s.F2, K), (s.F1, s.A - g * K * s.H * s.A), (s.error, covariance)


@_THEOREMS.claim(
    "for gamma = 1 the filter is the Kalman filter with R E[delta]",
    "eq. (23)",
    partial(step, 2, 1, ()),
)
def _kalman(s: Step) -> Equations:
    prediction = s.prediction_error
    K = prediction * s.H.T / (s.H * prediction * s.H.T + s.R).det().expand()
    return (s.F2, K), (s.error, prediction - K * s.H * prediction)


@_THEOREMS.claim(
    "for p11 = E[gamma] the estimate stays unbiased whatever the mean of x", "eq. (19), (23b)"
)
def _mean(s: Step) -> Equations:
    s, mean = replace(s, p=s.g), sympy.Matrix(sympy.symbols("m0:2"))
    return ((s.F1 * mean + s.F2 * s.g * s.H * s.A * mean, s.A * mean),)


@_THEOREMS.claim("p11 after two steps is p11 only if p11 = 1 or the rows are equal", "Corollary 1")
def _corollary(_: Step) -> Equations:
    """Two steps of a two-state chain, states (1, 0), and E[gamma_k] where gamma = 1 is kept."""
    p11, p01, start = sympy.symbols("p11 p01 pi")
    chain = sympy.Matrix([[p11, 1 - p11], [p01, 1 - p01]])
    law = sympy.Matrix([[start, 1 - start]])
    again = (chain**2)[0, 0] - p11
    kept = (law * chain**3)[0, 0].subs({p11: 1})
    return (
        ([again], [(1 - p11) * (p01 - p11)]),
        ([kept], [1 - (1 - start) * (1 - p01) ** 3]),
    )


@_THEOREMS.claim(
    "example 2 has E[gamma] = 1 - q (1 - p) and the transition probabilities (29)", "eq. (28), (29)"
)
def _example_2(_: Step) -> Equations:
    """Gamma = 1 - alpha + alpha beta, alpha drawn once, beta at each sample."""
    p, q = sympy.symbols("p q")
    rate = (1 - q) + q * p
    both, after_failure = (1 - q) + q * p**2, q * (1 - p) * p
    return (
        ([both / rate], [(1 - q * (1 - p**2)) / (1 - q * (1 - p))]),
        ([after_failure / (1 - rate)], [p]),
        ([both / rate - rate], [q * (1 - q) * (1 - p) ** 2 / (1 - q * (1 - p))]),
    )


#: Every claim, in the order of the derivation.
LINEAR_IDENTITIES = tuple(_THEOREMS)
