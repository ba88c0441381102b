"""The algebra of the partial compression filter, proved by SymPy for two states and one row.

Moments of what really happens to e and V, from those of primitive noises, beside the equations.

References
----------
Lee & Lee, Theorem 4 and Appendix D, with the misprints corrected: F11 in the cross terms of R and
G1 q G' in (43), the bracket of (47).
"""

from __future__ import annotations

from typing import Any

from fkgen.oracle.theorems.mkf import Identity

PAPER = "Lee & Lee"


def _symmetric(letter: str, size: int) -> Any:
    import sympy  # noqa: PLC0415 - slow to import

    return sympy.Matrix(
        size, size, lambda i, j: sympy.Symbol(f"{letter}{max(i, j)}{min(i, j)}", real=True)
    )


def _blocks() -> tuple[Any, Any, Any, Any]:
    """Moments of e and V: the joint covariance, and its blocks P, S and R."""
    joint = _symmetric("j", 3)
    return joint, joint[:2, :2], joint[2:, :2], joint[2:, 2:]


def _row(letter: str) -> Any:
    import sympy  # noqa: PLC0415 - slow to import

    return sympy.Matrix([[sympy.Symbol(f"{letter}{i}", real=True) for i in range(2)]])


def _variance(letter: str) -> Any:
    import sympy  # noqa: PLC0415 - slow to import

    return sympy.Matrix([[sympy.Symbol(letter, positive=True)]])


def _propagation() -> tuple[Any, ...]:
    """E+ = F e + G w, V+ = F11 V - F12 e2 - G1 w, (D2)."""
    import sympy  # noqa: PLC0415 - slow to import

    joint, P, S, R = _blocks()
    F = sympy.Matrix(2, 2, lambda i, j: sympy.Symbol(f"f{i}{j}", real=True))
    G, q = _row("g").T, _variance("q")
    moved = sympy.zeros(3, 3)
    moved[:2, :2], moved[2, 1], moved[2, 2] = F, -F[0, 1], F[0, 0]
    entering = sympy.Matrix.vstack(G, -G[:1, :])
    after = moved * joint * moved.T + entering * q * entering.T
    F11, F12, G1, S2 = F[:1, :1], F[:1, 1:], G[:1, :], S[:, 1:]
    noise = F11 * R * F11.T + F12 * P[1:, 1:] * F12.T + G1 * q * G1.T
    noise -= F11 * S2 * F12.T + F12 * S2.T * F11.T
    cross = (F11 * S - F12 * P[1:, :]) * F.T - G1 * q * G.T
    return after[2:, 2:] - noise, after[2:, :2] - cross


def _maintenance() -> tuple[Any, ...]:
    """Z without all that is correlated with z = h e + v."""
    import sympy  # noqa: PLC0415 - slow to import

    joint, P, S, R = _blocks()
    h, r, one = _row("h"), _variance("r"), sympy.eye(2)
    s = h * P * h.T + r
    K, L = P * h.T * s.inv(), S * h.T * s.inv()
    moved = sympy.zeros(3, 3)
    moved[:2, :2], moved[2:, :2], moved[2, 2] = one - K * h, -L * h, 1
    entering = sympy.Matrix.vstack(-K, -L)
    after = moved * joint * moved.T + entering * r * entering.T
    measures = sympy.Matrix([[1, 0, 1]])
    correlation = measures * (moved * joint[:, :2] * h.T + entering * r)
    return (
        after[2:, 2:] - (R - L * s * L.T),
        after[2:, :2] - S * (one - K * h).T,
        correlation,
    )


def _printed_maintenance() -> tuple[Any, ...]:
    """(44) leaves V as it is, and Z correlated with z by S h'."""
    import sympy  # noqa: PLC0415 - slow to import

    joint, P, S, _ = _blocks()
    h, r, one = _row("h"), _variance("r"), sympy.eye(2)
    K = P * h.T * (h * P * h.T + r).inv()
    moved = sympy.diag(one - K * h, sympy.eye(1))
    entering = sympy.Matrix.vstack(-K, sympy.zeros(1, 1))
    measures = sympy.Matrix([[1, 0, 1]])
    after = moved * joint * moved.T + entering * r * entering.T
    correlation = measures * (moved * joint[:, :2] * h.T + entering * r)
    return after[2:, :2] - S * (one - K * h).T, correlation - S * h.T


def _compression() -> tuple[Any, ...]:
    """(46) with and without inverses, and the gain of a Kalman filter for V."""
    import sympy  # noqa: PLC0415 - slow to import

    R, r = _variance("R"), _variance("r")
    B = r * (R + r).inv()
    kept = (R.inv() + r.inv()).inv()
    one = sympy.eye(1)
    return kept - B * R, kept * R.inv() - B, one - B - R * (R + r).inv()


def _host_update() -> tuple[Any, ...]:
    """(47) is the best linear estimate of e from Z = h e + V."""
    import sympy  # noqa: PLC0415 - slow to import

    joint, P, S, R = _blocks()
    h, measures = sympy.Matrix([[1, 0]]), sympy.Matrix([[1, 0, 1]])
    cross, W = joint[:2, :] * measures.T, measures * joint * measures.T
    K = (P * h.T + S.T) * (h * P * h.T + h * S.T + S * h.T + R).inv()
    return K - cross * W.inv(), P - K * (S + h * P) - (P - cross * W.inv() * cross.T)


PARTIAL_IDENTITIES = (
    Identity(
        claim="R and S move as the moments of F11 V - F12 e2 - G1 w do",
        source=f"{PAPER}, (43) with F11 in the cross terms and G1 q G'; (D2), (D3)",
        residual=_propagation,
    ),
    Identity(
        claim="the optimal maintenance leaves Z uncorrelated with the innovation of the host",
        source=f"{PAPER}, Lemma 1-(ii) for correlated noise, in place of (44)",
        residual=_maintenance,
    ),
    Identity(
        claim="(44) has the moments it states, and leaves Z correlated with the innovation by S h'",
        source=f"{PAPER}, (44)",
        residual=_printed_maintenance,
    ),
    Identity(
        claim="(46) needs no inverse of R: it is a Kalman update of V",
        source=f"{PAPER}, (46)",
        residual=_compression,
    ),
    Identity(
        claim="the host update is the best linear estimate from Z",
        source=f"{PAPER}, (47) with its bracket closed before the inverse",
        residual=_host_update,
    ),
)
