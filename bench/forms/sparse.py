"""The augmented form for sparse A and C: sums over the nonzeros of a row, whole vectors at a time.

U = (A P)' by transposes of four by four in registers, then rows of [C; 1] (A P A' + Q) as sums over
the nonzeros of A again. [S V] has its rows in front; text grows with the nonzeros, not with n^2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from forms import text
from forms.augmented import BEGIN, DECLARED, STEP, correct_mean
from forms.text import LANES, Array, Sizes


def sparse(model: dict[str, Any]) -> str:
    """C of the form for one model."""
    A, C, Q, R, P0 = text.matrices(model)
    s = Sizes(len(A), len(C))
    CA, CQ, S0 = C @ A, C @ Q, C @ Q @ C.T + R
    largest = max(1.0, np.abs(A).sum(axis=1).max(), np.abs(CA).sum(axis=1).max())
    limit = float(np.finfo(float).max / 4 / largest)
    names = {"T": s.NP * s.ZW, "Z": s.p * s.ZW, "ZW": s.ZW, "p": s.p, "NP": s.NP}
    names |= {"P": s.NP * s.NP, "ones": ", ".join(["1"] * s.p)}
    return "".join(
        [
            '#include "vectors.h"\n\n',
            text.table("Z0", text.both(S0, CQ, s)) + text.table("Qs", text.padded(Q, s.NP)),
            text.table("P0s", text.padded(P0, s.NP)),
            DECLARED % names,
            _eliminate(s, CA),
            _move(s, A, CA, limit),
            _correct(s, A),
            BEGIN,
            text.record(s, STEP),
        ]
    )


def _terms(row: Array) -> list[tuple[int, float]]:
    return [(k, float(value)) for k, value in enumerate(row) if value]


def _times(value: float, factor: str) -> str:
    return factor if value == 1.0 else f"{value!r} * {factor}"


def _sum(row: Array, place: str) -> str:
    """A chain over the nonzeros of a row; place % k is the address of vector k."""
    terms = [_times(value, f"LOAD({place % k})") for k, value in _terms(row)]
    return " + ".join(terms) or "ALL(0.0)"


def _move(s: Sizes, A: Array, CA: Array, limit: float) -> str:
    """U = ([CA; A] P)' (the T of a side), [S V], pivots and means of the next sample."""
    lines = ["INLINE int move(side_t *side)", "{", "const vec zero = ALL(0.0); vec sum0 = zero;"]
    lines += ["vec mirror[4]; int j;"]
    groups = [(CA, first, first) for first in range(0, s.p, LANES)]
    groups += [(A, first, s.PP + first) for first in range(0, s.n, LANES)]
    lines.append(f"ROLLED for (j = 0; j < {s.NP}; j += {LANES}) {{")
    for matrix, first, column in groups:
        rows = matrix[first : first + LANES]
        each = [f"vec c{r} = {_sum(row, f'P + %d * {s.NP} + j')};" for r, row in enumerate(rows)]
        names = [f"c{r}" for r in range(len(rows))] + ["zero"] * (LANES - len(rows))
        lines += ["{", *each, f"transpose({', '.join(names)}, mirror);"]
        lines += [f"sum0 += MAGNITUDE(c{r});" for r in range(len(rows))]
        lines += [
            f"STORE(side->T + (j + {r}) * {s.ZW} + {column}, mirror[{r}]);" for r in range(LANES)
        ]
        lines.append("}")
    lines += ["}", "eliminate(side, everything);"]
    for r, row in enumerate([*CA, *A]):
        at = r if r < s.p else s.PP + r - s.p
        terms = " + ".join(_times(value, f"x[{k}]") for k, value in _terms(row)) or "0.0"
        lines.append(f"side->m[{at}] = {terms};")
    lines.append(f"ROLLED for (j = 0; j < {s.ZW}; j += {LANES})")
    lines.append("sum0 += MAGNITUDE(LOAD(side->m + j));")
    return "\n".join([*lines, f"return TOTAL(sum0) <= {limit!r};", "}\n"])


def _eliminate(s: Sizes, CA: Array) -> str:
    """[S V] = Z0 + CA U, then all rows by the pivots, one after the other."""
    head = "static __attribute__((noinline)) void eliminate(side_t *side, const int *present)"
    lines = [head, "{", "int j; double least = DBL_MAX;"]
    lines.append(f"ROLLED for (j = 0; j < {s.ZW}; j += {LANES}) {{")
    for r, row in enumerate(CA):
        at = f"{r * s.ZW} + j"
        lines.append(
            f"STORE(side->Z + {at}, LOAD(Z0 + {at}) + {_sum(row, f'side->T + %d * {s.ZW} + j')});"
        )
    lines.append("}")
    for a in range(s.p):
        pivot = f"side->Z[{a * s.ZW + a}]"
        lines.append(f"{{ const double pivot = {pivot}, d = present[{a}] ? 1.0 / pivot : 0.0;")
        lines.append(
            f"least = (present[{a}] && !(pivot >= least)) ? pivot : least; side->d[{a}] = d;"
        )
        later = range(a + 1, s.p)
        lines += [f"const double l{b} = side->Z[{a * s.ZW + b}] * d;" for b in later]
        lines.append(f"ROLLED for (j = {a // LANES * LANES}; j < {s.ZW}; j += {LANES}) {{")
        lines.append(f"const vec row = LOAD(side->Z + {a * s.ZW} + j);")
        lines.append(f"STORE(side->g + {a * s.ZW} + j, row * d);")
        for b in later:
            at = f"side->Z + {b * s.ZW} + j"
            lines.append(f"STORE({at}, LOAD({at}) - l{b} * row);")
        lines += ["}", "}"]
    return "\n".join([*lines, "side->least = least;", "}\n"])


def _correct(s: Sizes, A: Array) -> str:
    """X and P given the sample: P = Q + A U - W' g, four rows at a time, mirrored."""
    lines = correct_mean(s)
    for block in range(s.W):
        first = block * LANES
        rows = A[first : first + LANES]
        lines.append(f"ROLLED for (j = 0; j <= {first}; j += {LANES}) {{")
        lines += [f"vec g{a} = LOAD(old->g + {a * s.ZW + s.PP} + j);" for a in range(s.p)]
        for r, row in enumerate(rows):
            total = _sum(row, f"old->T + %d * {s.ZW} + {s.PP} + j")
            lines.append(f"vec c{r}0 = LOAD(Qs + {(first + r) * s.NP} + j) + ({total});")
            lines += [f"c{r}0 -= old->Z[{a * s.ZW + s.PP + first + r}] * g{a};" for a in range(s.p)]
        lines.append(text.mirrored(len(rows), 0))
        lines += [f"if (j == {first}) {{", *text.diagonal(len(rows), 0), "} else {"]
        lines += [f"STORE(P + (j + {r}) * {s.NP} + {first}, mirror[{r}]);" for r in range(LANES)]
        lines.append("}")
        lines += [f"STORE(P + {(first + r) * s.NP} + j, c{r}0);" for r in range(len(rows))]
        lines.append("}")
    return "\n".join([*lines, "}\n"])
