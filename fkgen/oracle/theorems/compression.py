"""The algebra behind compression filters, proved by SymPy for one or two states.

References
----------
Lee & Lee, Lemmas 1 and 2, Theorem 1, with the misprints corrected: e' = x - xhat' in (4), minus in
front of both cross terms of (6), P-_{k+1} on the left of (13).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fkgen.oracle.theorems.mkf import Identity

PAPER = "Lee & Lee"


def _matrix(letter: str, rows: int, columns: int) -> Any:
    import sympy  # noqa: PLC0415 - slow to import

    return sympy.Matrix(rows, columns, lambda i, j: sympy.Symbol(f"{letter}{i}{j}", real=True))


def _symmetric(letter: str, size: int) -> Any:
    import sympy  # noqa: PLC0415 - slow to import

    return sympy.Matrix(
        size, size, lambda i, j: sympy.Symbol(f"{letter}{max(i, j)}{min(i, j)}", real=True)
    )


@dataclass(frozen=True, slots=True)
class _Estimate:
    """Mean and covariance of x given z = H e + v with cov(v, e) = S: (6)."""

    correction: Any
    covariance: Any


def _best(M: Any, z: Any, H: Any, R: Any, S: Any) -> _Estimate:
    K = (M * H.T + S.T) * (H * M * H.T + H * S.T + S * H.T + R).inv()
    return _Estimate(K * z, M - K * (H * M + S))


def _difference(a: _Estimate, b: _Estimate) -> tuple[Any, ...]:
    return a.correction - b.correction, a.covariance - b.covariance


def _stack_or_maintain() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    M, h, g = _symmetric("m", 2), _matrix("h", 1, 2), _matrix("g", 1, 2)
    r, s, z, w = (sympy.Matrix([[sympy.Symbol(name, real=True)]]) for name in "rszw")
    zero = sympy.zeros(1, 2)
    both = _best(
        M,
        sympy.Matrix.vstack(z, w),
        sympy.Matrix.vstack(h, g),
        sympy.diag(r, s),
        sympy.zeros(2, 2),
    )
    first = _best(M, z, h, r, zero)
    second = _best(first.covariance, w - g * first.correction, g, s, zero)
    total = _Estimate(first.correction + second.correction, second.covariance)
    return _difference(both, total)


def _scaled() -> tuple[Any, ...]:
    M, H, S, C = _symmetric("m", 1), _matrix("h", 2, 1), _matrix("s", 2, 1), _matrix("c", 2, 2)
    R, z = _symmetric("r", 2), _matrix("z", 2, 1)
    return _difference(_best(M, z, H, R, S), _best(M, C * z, C * H, C * R * C.T, C * S))


def _decorrelated() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    M, H, S = _symmetric("m", 2), _matrix("h", 1, 2), _matrix("s", 1, 2)
    r, z = (sympy.Matrix([[sympy.Symbol(name, real=True)]]) for name in "rz")
    free = _best(M, z, H + S * M.inv(), r - S * M.inv() * S.T, sympy.zeros(1, 2))
    return _difference(_best(M, z, H, r, S), free)


def _compressed() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    M, H, z = _symmetric("m", 1), _matrix("h", 2, 1), _matrix("z", 2, 1)
    R = _symmetric("r", 2)
    noise = (H.T * R.inv() * H).inv()
    short = noise * H.T * R.inv() * z
    one = sympy.eye(1)
    whole = _best(M, z, H, R, sympy.zeros(2, 1))
    return _difference(whole, _best(M, short, one, noise, sympy.zeros(1, 1)))


def _propagated() -> tuple[Any, ...]:
    import sympy  # noqa: PLC0415 - slow to import

    M, F, Q = _symmetric("m", 2), _matrix("f", 2, 2), _symmetric("q", 2)
    h, S = _matrix("h", 1, 2), _matrix("s", 1, 2)
    r, z = (sympy.Matrix([[sympy.Symbol(name, real=True)]]) for name in "rz")
    now = _best(M, z, h, r, S)
    moved = _Estimate(F * now.correction, F * now.covariance * F.T + Q)
    H = h * F.inv()
    late = _best(F * M * F.T + Q, z, H, r + H * Q * H.T, S * F.T - H * Q)
    return _difference(moved, late)


def _pair_of_filters() -> tuple[Any, ...]:
    """D = P - P* after a row of the host, as a sum of squares: nothing but D is needed for d."""
    import sympy  # noqa: PLC0415 - slow to import

    P, D, h = _symmetric("p", 2), _symmetric("d", 2), _matrix("h", 1, 2)
    r = sympy.Matrix([[sympy.Symbol("r", positive=True)]])
    zero, z = sympy.zeros(1, 2), sympy.Matrix([[sympy.Symbol("z")]])
    host, other = _best(P, z, h, r, zero), _best(P - D, z, h, r, zero)
    K = P * h.T * (h * P * h.T + r).inv()
    A = sympy.eye(2) - K * h
    v = A * D * h.T
    squares = A * D * A.T + v * (h * (P - D) * h.T + r).inv() * v.T
    return (host.covariance - other.covariance - squares,)


COMPRESSION_IDENTITIES = (
    Identity(
        claim="stacking two measurements is the same as using one and maintaining the other",
        source=f"{PAPER}, Lemma 1, eqs. (2)-(4)",
        residual=_stack_or_maintain,
    ),
    Identity(
        claim="a measurement may be scaled by any regular matrix",
        source=f"{PAPER}, Lemma 2-(i), eq. (7)",
        residual=_scaled,
    ),
    Identity(
        claim="noise correlated with the prior error may be de-correlated",
        source=f"{PAPER}, Lemma 2-(ii), eq. (8)",
        residual=_decorrelated,
    ),
    Identity(
        claim="rows beyond the number of states may be compressed",
        source=f"{PAPER}, Lemma 2-(iii), eq. (9)",
        residual=_compressed,
    ),
    Identity(
        claim="a measurement may be used one sample late, propagated with H F^-1",
        source=f"{PAPER}, Theorem 1, eqs. (12)-(16)",
        residual=_propagated,
    ),
    Identity(
        claim="a row of the host changes P - P* into a sum of squares",
        source=f"{PAPER}, Theorem 3 as two Kalman filters, eqs. (29), (33)",
        residual=_pair_of_filters,
    ),
)
