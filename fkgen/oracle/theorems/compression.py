"""The algebra behind full and partial compression filters, proved for one or two states.

Misprints corrected: e' = x - xhat' in (4), minus in front of both cross terms of (6), P-_{k+1} on
the left of (13); F11 in the cross terms of R and G1 q G' in (43), the bracket of (47).
"""

from __future__ import annotations

from typing import Any

from fkgen.oracle.theorems.identity import Equations, Theorems, general, scalar, symmetric, sympy

_FULL, _PARTIAL = Theorems("Lee & Lee"), Theorems("Lee & Lee")


def _best(M: Any, z: Any, H: Any, R: Any, S: Any) -> tuple[Any, Any]:
    """Mean and covariance of x given z = H e + v with cov(v, e) = S: (6)."""
    K = (M * H.T + S.T) * (H * M * H.T + H * S.T + S * H.T + R).inv()
    return K * z, M - K * (H * M + S)


def _same(a: tuple[Any, Any], b: tuple[Any, Any]) -> Equations:
    return (a[0], b[0]), (a[1], b[1])


@_FULL.claim(
    "stacking two measurements is the same as using one and maintaining the other",
    "Lemma 1, eqs. (2)-(4)",
)
def _stack_or_maintain() -> Equations:
    M, h, g = symmetric("m", 2), general("h", 1, 2), general("g", 1, 2)
    r, s, z, w = map(scalar, "rszw")
    none = sympy.zeros(1, 2)
    both = _best(M, z.col_join(w), h.col_join(g), sympy.diag(r, s), sympy.zeros(2, 2))
    first, P = _best(M, z, h, r, none)
    second, P = _best(P, w - g * first, g, s, none)
    return _same(both, (first + second, P))


@_FULL.claim("a measurement may be scaled by any regular matrix", "Lemma 2-(i), eq. (7)")
def _scaled() -> Equations:
    M, H, S, C = symmetric("m", 1), general("h", 2, 1), general("s", 2, 1), general("c", 2, 2)
    R, z = symmetric("r", 2), general("z", 2, 1)
    return _same(_best(M, z, H, R, S), _best(M, C * z, C * H, C * R * C.T, C * S))


@_FULL.claim("noise correlated with the prior error may be de-correlated", "Lemma 2-(ii), eq. (8)")
def _decorrelated() -> Equations:
    M, H, S = symmetric("m", 2), general("h", 1, 2), general("s", 1, 2)
    r, z = map(scalar, "rz")
    free = _best(M, z, H + S * M.inv(), r - S * M.inv() * S.T, sympy.zeros(1, 2))
    return _same(_best(M, z, H, r, S), free)


@_FULL.claim("rows beyond the number of states may be compressed", "Lemma 2-(iii), eq. (9)")
def _compressed() -> Equations:
    M, H, R, z = symmetric("m", 1), general("h", 2, 1), symmetric("r", 2), general("z", 2, 1)
    noise = (H.T * R.inv() * H).inv()
    short = noise * H.T * R.inv() * z
    whole = _best(M, z, H, R, sympy.zeros(2, 1))
    return _same(whole, _best(M, short, sympy.eye(1), noise, sympy.zeros(1, 1)))


@_FULL.claim(
    "a measurement may be used one sample late, propagated with H F^-1", "Theorem 1, eqs. (12)-(16)"
)
def _propagated() -> Equations:
    M, F, Q = symmetric("m", 2), general("f", 2, 2), symmetric("q", 2)
    h, S = general("h", 1, 2), general("s", 1, 2)
    r, z = map(scalar, "rz")
    correction, P = _best(M, z, h, r, S)
    H = h * F.inv()
    late = _best(F * M * F.T + Q, z, H, r + H * Q * H.T, S * F.T - H * Q)
    return _same((F * correction, F * P * F.T + Q), late)


@_FULL.claim(
    "a row of the host changes P - P* into a sum of squares",
    "Theorem 3 as two Kalman filters, eqs. (29), (33)",
)
def _pair_of_filters() -> Equations:
    P, D, h = symmetric("p", 2), symmetric("d", 2), general("h", 1, 2)
    r, z = map(scalar, "rz")
    none = sympy.zeros(1, 2)
    _, host = _best(P, z, h, r, none)
    _, other = _best(P - D, z, h, r, none)
    A = sympy.eye(2) - P * h.T * (h * P * h.T + r).inv() * h
    v = A * D * h.T
    squares = A * D * A.T + v * (h * (P - D) * h.T + r).inv() * v.T
    return ((host - other, squares),)


@_FULL.claim(
    "Z may be moved on and de-correlated without F^-1, by the smoother's gain",
    "(31), (32) with the covariance before the update, n = 2",
)
def _without_inverse() -> Equations:
    """Hbar = H A, Rbar = R + H ((I - A F) P (I - A F)' + A Q A') H', A = P F' (F P F' + Q)^-1."""
    P, F, predicted = symmetric("p", 2), general("f", 2, 2), symmetric("m", 2)
    moved, R, one = general("h", 1, 2), scalar("r"), sympy.eye(2)  # moved = H F^-1
    H, Q, inverse = moved * F, predicted - F * P * F.T, predicted.adjugate() / predicted.det()
    A = P * F.T * inverse
    printed = R + moved * Q * moved.T - moved * Q * inverse * Q * moved.T
    mild = R + H * ((one - A * F) * P * (one - A * F).T + A * Q * A.T) * H.T
    return (moved * (one - Q * inverse), H * A), (printed, mild)


def _blocks() -> tuple[Any, Any, Any, Any]:
    """Moments of e and V: the joint covariance, and its blocks P, S and R."""
    joint = symmetric("j", 3)
    return joint, joint[:2, :2], joint[2:, :2], joint[2:, 2:]


@_PARTIAL.claim(
    "R and S move as the moments of F11 V - F12 e2 - G1 w do",
    "(43) with F11 in the cross terms and G1 q G'; (D2), (D3)",
)
def _propagation() -> Equations:
    """E+ = F e + G w, V+ = F11 V - F12 e2 - G1 w, (D2)."""
    joint, P, S, R = _blocks()
    F, G, q = general("f", 2, 2), general("g", 2, 1), scalar("q")
    moved = sympy.diag(F, F[0, 0])
    moved[2, 1] = -F[0, 1]
    entering = G.col_join(-G[:1, :])
    after = moved * joint * moved.T + entering * q * entering.T
    F11, F12, G1, S2 = F[:1, :1], F[:1, 1:], G[:1, :], S[:, 1:]
    noise = F11 * R * F11.T + F12 * P[1:, 1:] * F12.T + G1 * q * G1.T
    noise -= F11 * S2 * F12.T + F12 * S2.T * F11.T
    cross = (F11 * S - F12 * P[1:, :]) * F.T - G1 * q * G.T
    return (after[2:, 2:], noise), (after[2:, :2], cross)


def _maintained(K: Any, L: Any, h: Any, r: Any) -> tuple[Any, Any]:
    """Moments of e - K z and V - L z with z = h e + v, and what is left of cov(Z, z)."""
    joint, *_ = _blocks()
    moved = sympy.eye(3) - K.col_join(L) * h.row_join(sympy.zeros(1, 1))
    entering = -K.col_join(L)
    after = moved * joint * moved.T + entering * r * entering.T
    return after, sympy.Matrix([[1, 0, 1]]) * (moved * joint[:, :2] * h.T + entering * r)


@_PARTIAL.claim(
    "the optimal maintenance leaves Z uncorrelated with the innovation of the host",
    "Lemma 1-(ii) for correlated noise, in place of (44)",
)
def _maintenance() -> Equations:
    _, P, S, R = _blocks()
    h, r = general("h", 1, 2), scalar("r")
    s = h * P * h.T + r
    K, L = P * h.T * s.inv(), S * h.T * s.inv()
    after, correlation = _maintained(K, L, h, r)
    kept = S * (sympy.eye(2) - K * h).T
    nothing = sympy.zeros(1, 1)
    return (after[2:, 2:], R - L * s * L.T), (after[2:, :2], kept), (correlation, nothing)


@_PARTIAL.claim(
    "(44) has the moments it states, and leaves Z correlated with the innovation by S h'", "(44)"
)
def _printed_maintenance() -> Equations:
    _, P, S, _ = _blocks()
    h, r = general("h", 1, 2), scalar("r")
    K = P * h.T * (h * P * h.T + r).inv()
    after, correlation = _maintained(K, sympy.zeros(1, 1), h, r)
    return (after[2:, :2], S * (sympy.eye(2) - K * h).T), (correlation, S * h.T)


@_PARTIAL.claim("(46) needs no inverse of R: it is a Kalman update of V", "(46)")
def _compression() -> Equations:
    R, r, one = scalar("R"), scalar("r"), sympy.eye(1)
    B = r * (R + r).inv()
    kept = (R.inv() + r.inv()).inv()
    return (kept, B * R), (kept * R.inv(), B), (one - B, R * (R + r).inv())


@_PARTIAL.claim(
    "the host update is the best linear estimate from Z",
    "(47) with its bracket closed before the inverse",
)
def _host_update() -> Equations:
    joint, P, S, R = _blocks()
    h, measures = sympy.Matrix([[1, 0]]), sympy.Matrix([[1, 0, 1]])
    cross, W = joint[:2, :] * measures.T, measures * joint * measures.T
    K = (P * h.T + S.T) * (h * P * h.T + h * S.T + S * h.T + R).inv()
    return (K, cross * W.inv()), (P - K * (S + h * P), P - cross * W.inv() * cross.T)


COMPRESSION_IDENTITIES = tuple(_FULL)
PARTIAL_IDENTITIES = tuple(_PARTIAL)
