"""The algebra behind every update: forms of one correction, factors, information, lag, mixtures."""

from __future__ import annotations

from typing import Any

from fkgen.oracle.theorems.identity import Equations, Theorems, general, scalar, symmetric, sympy

_UPDATE, _MIXTURE = Theorems("Bierman 1977"), Theorems("Bar-Shalom, Li & Kirubarajan 2001")


def _corrected(P: Any, C: Any, S: Any) -> tuple[Any, Any]:
    """Gain, and P(k|k) in the standard form; S = C P C' + R is the innovation's covariance."""
    K = P * C.T * S.adjugate() / S.det()
    return K, P - K * S * K.T


def _joseph_form(P: Any, C: Any, S: Any, K: Any) -> Any:
    """P(k|k) for any gain, R = S - C P C': a symbol for S spares the inverse of a sum."""
    F = sympy.eye(2) - K * C
    return F * P * F.T + K * (S - C * P * C.T) * K.T


@_UPDATE.claim("the Joseph form is the standard form", "n = 2, p = 2, correlated rows")
def _joseph() -> Equations:
    P, C, S = symmetric("p", 2), general("c", 2, 2), symmetric("s", 2)
    K, standard = _corrected(P, C, S)
    return ((_joseph_form(P, C, S, K), standard),)


@_UPDATE.claim("any other gain costs the square of what it is off by", "n = 2, p = 2")
def _best_gain() -> Equations:
    P, C, S, d = symmetric("p", 2), general("c", 2, 2), symmetric("s", 2), general("d", 2, 2)
    K, standard = _corrected(P, C, S)
    return ((_joseph_form(P, C, S, K + d), standard + d * S * d.T),)


@_UPDATE.claim(
    "rows one after the other, decorrelated, are all at once", "R = L D L', n = 2, p = 2"
)
def _rows_in_sequence() -> Equations:
    """L^-1 y has uncorrelated rows, of any variance, and corrects as y does."""
    P, C, S = symmetric("p", 2), general("c", 2, 2), symmetric("s", 2)
    unmixed = sympy.Matrix([[1, 0], [sympy.Symbol("l", real=True), 1]])
    S[0, 1] = S[1, 0] = (C * P * C.T)[0, 1]  # R = S - C P C' is diagonal
    _, first = _corrected(P, C[:1, :], S[:1, :1])
    rest = S[1:, 1:] - C[1:, :] * (P - first) * C[1:, :].T
    _, second = _corrected(first, C[1:, :], rest)
    mixed = symmetric("t", 2)
    _, apart = _corrected(P, unmixed * C, unmixed * mixed * unmixed.T)
    return (second, _corrected(P, C, S)[1]), (apart, _corrected(P, C, mixed)[1])


@_UPDATE.claim("the scalar update of U and D is that of P = U D U'", "UDU' update, n = 3")
def _factored() -> Equations:
    one, h, r = sympy.eye(3), general("h", 1, 3), scalar("r")
    U = sympy.Matrix(3, 3, lambda i, j: general("u", 3, 3)[i, j] if i < j else one[i, j])
    D = sympy.diag(*general("d", 1, 3))
    f, alpha, k = (h * U).T, r[0, 0], sympy.zeros(3, 1)
    factors, variances = U.copy(), D.copy()
    for i in range(3):
        before, alpha = alpha, alpha + D[i, i] * f[i] ** 2
        variances[i, i] = D[i, i] * before / alpha
        factors[:, i] = U[:, i] - f[i] / before * k
        k += D[i, i] * f[i] * U[:, i]
    P = U * D * U.T
    K, standard = _corrected(P, h, h * P * h.T + r)
    return (factors * variances * factors.T, standard), (k / alpha, K)


@_UPDATE.claim("information adds up: P(k|k)^-1 = P^-1 + C' R^-1 C", "information form, n = 2")
def _information() -> Equations:
    P, C, r = symmetric("p", 2), general("c", 1, 2), scalar("r")
    x, y = general("x", 2, 1), scalar("y")
    K, standard = _corrected(P, C, C * P * C.T + r)
    inverse = P.adjugate() / P.det()
    known = inverse * x + C.T / r[0, 0] * y
    mean = x + K * (y - C * x)
    information = inverse + C.T / r[0, 0] * C
    return (information * standard, sympy.eye(2)), (standard * known, mean)


@_UPDATE.claim(
    "a state kept beside its successor is corrected as a smoother corrects it",
    "fixed lag, n = 2, p = 1",
)
def _lagged() -> Equations:
    """(x[k], x[k-1]) corrected together, against the step back of Rauch, Tung and Striebel."""
    P, A, C, r = symmetric("p", 2), general("a", 2, 2), general("c", 1, 2), scalar("r")
    predicted = symmetric("m", 2)  # A P A' + Q, of which Q makes any covariance
    joint = (predicted.row_join(A * P)).col_join((P * A.T).row_join(P))
    S = C * predicted * C.T + r
    _, both = _corrected(joint, C.row_join(sympy.zeros(1, 2)), S)
    _, filtered = _corrected(predicted, C, S)
    back = P * A.T * predicted.adjugate() / predicted.det()
    return (both[2:, 2:], P + back * (filtered - predicted) * back.T), (both[:2, :2], filtered)


@_MIXTURE.claim("the spread of a mixture's means is a sum of squares over pairs", "N = 3, n = 2")
def _mixture() -> Equations:
    """Second moment without the mean's, around the mean, and over pairs of modes."""
    modes, none = range(3), sympy.zeros(2, 2)
    x, P = [general(f"x{i}", 2, 1) for i in modes], [symmetric(f"p{i}", 2) for i in modes]
    w = [*sympy.symbols("w0 w1", real=True)]
    w.append(1 - sum(w))
    mean = sum((w[i] * x[i] for i in modes), sympy.zeros(2, 1))
    second = sum((w[i] * (P[i] + x[i] * x[i].T) for i in modes), none)
    around = sum((w[i] * (P[i] + (x[i] - mean) * (x[i] - mean).T) for i in modes), none)
    pairs = sum(
        (w[i] * w[j] * (x[i] - x[j]) * (x[i] - x[j]).T for i in modes for j in range(i)), none
    )
    within = sum((w[i] * P[i] for i in modes), none)
    return (around, second - mean * mean.T), (around, within + pairs)


#: What every linear update rests on; what a filter that mixes modes rests on besides.
GAUSSIAN_IDENTITIES = tuple(_UPDATE)
MIXTURE_IDENTITIES = (*_UPDATE, *_MIXTURE)
