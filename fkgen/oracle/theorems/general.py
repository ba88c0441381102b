"""Identities for matrices of any size: SymPy judges them over letters that do not commute.

No entry and no inverse occurs: a gain K is what solves K S = P C', which it does for a singular S
as well. Products are expanded, what is given is read from left to right, and sums have to agree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fkgen.oracle.theorems.identity import Equations, Identity, sympy

#: Rows and columns by name: {"C": "pn"} is p by n.
Sizes = dict[str, str]


def transposed(expression: Any) -> Any:
    """The transpose; that of a letter X is the letter X_t, and back."""
    if isinstance(expression, sympy.Symbol):
        name, _, turned = expression.name.partition("_")
        return letter(name if turned else f"{name}_t")
    if isinstance(expression, sympy.Mul):
        return sympy.Mul(*map(transposed, reversed(expression.args)))
    return expression.func(*map(transposed, expression.args)) if expression.args else expression


def letter(name: str) -> Any:
    """A matrix of any size."""
    return sympy.Symbol(name, commutative=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class GeneralIdentity(Identity):
    """An identity for all sizes, of what is given: pairs (product, what it is equal to)."""

    sizes: Sizes
    symmetric: str = ""
    given: Callable[[], Equations] = field(default=tuple)

    def plain(self, expression: Any) -> Any:
        """The same without transposes of symmetric matrices."""
        return expression.subs({letter(f"{each}_t"): letter(each) for each in self.symmetric})

    def hypotheses(self) -> list[tuple[Any, Any]]:
        """What is given."""
        return [(self.plain(left), self.plain(right)) for left, right in self.given()]

    def entries(self) -> list[tuple[Any, Any]]:
        """Left and right side of every equation between matrices."""
        return [(self.plain(left), self.plain(right)) for left, right in self.equations()]

    def holds(self) -> bool:
        """Whether the sides are equal by what is given and the laws of matrices."""
        turned = [
            tuple(self.plain(transposed(side)) for side in pair) for pair in self.hypotheses()
        ]
        rules = [rule for both in zip(self.hypotheses(), turned, strict=True) for rule in both]
        return all(_reduced(left - right, rules) == 0 for left, right in self.entries())


def _reduced(expression: Any, rules: list[tuple[Any, Any]]) -> Any:
    """A sum of products in which nothing more can be read from left to right."""
    before, now = None, sympy.expand(expression)
    while now != before:
        before = now
        for left, right in rules:
            now = sympy.expand(now.subs(left, right))
    return now


def _joseph(K: Any, off: Any) -> Any:
    """P(k|k) for the gain K + off, R = S - C P C'."""
    P, C, S = map(letter, "PCS")
    F, gain = 1 - (K + off) * C, K + off
    return F * P * transposed(F) + gain * (S - C * P * transposed(C)) * transposed(gain)


def _gain_given() -> Equations:
    P, C, S, K = map(letter, "PCSK")
    return ((P * transposed(C), K * S),)


def _joseph_form() -> Equations:
    P, S, K = map(letter, "PSK")
    return ((_joseph(K, 0), P - K * S * transposed(K)),)


def _any_gain() -> Equations:
    P, S, K, d = map(letter, "PSKd")
    right = P - K * S * transposed(K) + d * S * transposed(d)
    return ((_joseph(K, d), right),)


def _two_sensors_given() -> Equations:
    """The gain K of C from P, then that of D from P - K S K'."""
    P, C, D, K, S, L, T = map(letter, "PCDKSLT")
    rest = L * T + K * S * transposed(K) * transposed(D)
    return ((P * transposed(C), K * S), (P * transposed(D), rest))


def _in_sequence() -> Equations:
    """(K - L D K, L) is the gain of both at once; its covariance and its mean are the same."""
    P, C, D, K, S, L, T = map(letter, "PCDKSLT")
    x, y, z = map(letter, "xyz")
    first, across = K - L * D * K, C * P * transposed(D)
    own = T + D * K * S * transposed(K) * transposed(D)  # D P D' and its noise
    after = x + K * (y - C * x)
    return (
        (first * S + L * transposed(across).subs(letter("P_t"), P), P * transposed(C)),
        (first * across + L * own, P * transposed(D)),
        (
            P - first * C * P - L * D * P,
            P - K * S * transposed(K) - L * T * transposed(L),
        ),
        (after + L * (z - D * after), x + first * (y - C * x) + L * (z - D * x)),
    )


def _actuators_given() -> Equations:
    """(11): K Om = A P C' + B N D'."""
    A, P, C, K, S, B, N, D = map(letter, "APCKSBND")
    return ((A * P * transposed(C), K * S - B * N * transposed(D)),)


def _actuators() -> Equations:
    """(9) for the gain K + d, G W G' = Om - C P C' - D N D', against (12)."""
    A, P, C, K, S, B, N, D, Q, d = map(letter, "APCKSBNDQd")
    gain = K + d
    R = S - C * P * transposed(C) - D * N * transposed(D)
    E, F = A - gain * C, B - gain * D
    cost = E * P * transposed(E) + F * N * transposed(F) + Q + gain * R * transposed(gain)
    least = A * P * transposed(A) + B * N * transposed(B) + Q - K * S * transposed(K)
    return ((cost, least + d * S * transposed(d)),)


_ONE_SENSOR = {"P": "nn", "C": "pn", "S": "pp", "K": "np"}

GENERAL_IDENTITIES = (
    GeneralIdentity(
        claim="the Joseph form is the standard form",
        source="Bierman 1977, any size, K S = P C'",
        sizes=_ONE_SENSOR,
        symmetric="PS",
        given=_gain_given,
        equations=_joseph_form,
    ),
    GeneralIdentity(
        claim="any other gain costs the square of what it is off by",
        source="Bierman 1977, any size, K S = P C'",
        sizes=_ONE_SENSOR | {"d": "np"},
        symmetric="PS",
        given=_gain_given,
        equations=_any_gain,
    ),
    GeneralIdentity(
        claim="sensors one after the other are both at once",
        source="Bierman 1977, any sizes, uncorrelated noises",
        sizes=_ONE_SENSOR | {"D": "qn", "L": "nq", "T": "qq", "x": "nr", "y": "pr", "z": "qr"},
        symmetric="PST",
        given=_two_sensors_given,
        equations=_in_sequence,
    ),
    GeneralIdentity(
        claim="the gain (11) minimises (9), whose least value is (12)",
        source="Strandt, Schneider & Yaz, any size, K Om = A P C' + B N D'",
        sizes=_ONE_SENSOR | {"A": "nn", "B": "nm", "N": "mm", "D": "pm", "Q": "nn", "d": "np"},
        symmetric="PSNQ",
        given=_actuators_given,
        equations=_actuators,
    ),
)
