"""The augmented form unrolled into local variables: for n <= 6, p <= 4, where latency is the limit.

The first rows of T stand between the store of Tc and the loads of its elements: a load of what was
just stored takes its time. W is read element by element, g = D^-1 W stays in registers: it comes
last, after the divisions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from forms import text
from forms.text import LANES, Sizes

_STEP = """
if (!(least > 0.0)) { status[t] = -3; return t; }
%s
sum0 = zero; sum1 = zero;
%s
sum0 += sum1;
if (!(TOTAL(sum0) <= limit)) { status[t] = -5; return t; }
turn = old; old = new; new = turn;
"""
_DECLARED = """
typedef struct { double T[%d] ALIGNED, W[%d] ALIGNED, m[%d] ALIGNED; } side_t;
static side_t sides[2], *old, *new, *turn;
static double P[%d] ALIGNED, x[%d] ALIGNED;
static const double limit = %r;
static double nis;
#define expected() (old->m)
"""


def straight(model: dict[str, Any]) -> str:
    """C of the form for one model."""
    A, C, Q, R, P0 = text.matrices(model)
    s = Sizes(len(A), len(C))
    CA, CQ, S0 = C @ A, C @ Q, C @ Q @ C.T + R
    limit = float(np.finfo(float).max / 4 / max(1.0, np.abs(A).max(), np.abs(CA).max()))
    held = (s.n + s.p) * s.NP, s.p * s.NP, s.ZW, s.n * s.NP, s.NP, limit
    move = _move(s)
    prior = " ".join(f"P{i}_{v} = LOAD(P0s + {i * s.NP + v * LANES});" for i, v in _all(s))
    begin = f"""
#define begin() memset(sides, 0, sizeof sides); memset(x, 0, sizeof x); \\
    old = &sides[0]; new = &sides[1]; {prior} \\
    turn = new; new = old; {" ".join(move.splitlines())} new = turn
#define again(present) {" ".join(_again(s).splitlines())}
"""
    loop = text.record(s, _STEP % (_correct(s), move))
    opening = "    int i, j;\n"
    loop = loop.replace(opening, opening + _locals(s))
    stored = "".join(f"    STORE(P + {i * s.NP + v * LANES}, P{i}_{v});\n" for i, v in _all(s))
    ending = f"    for (i = 0; i < {s.n}; ++i)\n    {{\n        for (j = 0;"
    return "".join(
        [
            '#include "vectors.h"\n\n',
            text.table("rows", np.vstack([CA, A])) + text.table("columns", text.both(CA.T, A.T, s)),
            text.table("Z0", text.both(S0, CQ, s)) + text.table("Qs", text.padded(Q, s.NP)),
            text.table("P0s", text.padded(P0, s.NP)),
            _DECLARED % held,
            begin,
            loop.replace(ending, stored + ending),
        ]
    )


def _all(s: Sizes) -> list[tuple[int, int]]:
    return [(i, v) for i in range(s.n) for v in range(s.W)]


def _locals(s: Sizes) -> str:
    """What lives in registers from one sample to the next."""
    numbers = [f"d{a} = 0.0" for a in range(s.p)] + ["least = 1.0"]
    numbers += [f"l{b}{a} = 0.0" for b in range(s.p) for a in range(b)]
    numbers += [f"s{a}{b} = 0.0" for a in range(s.p) for b in range(a, s.p)]
    vectors = ["sum0 = zero", "sum1 = zero", *[f"P{i}_{v} = zero" for i, v in _all(s)]]
    vectors += [f"{k}{a}_{v} = zero" for k in "wg" for a in range(s.p) for v in range(s.W)]
    return (
        "    const vec zero = ALL(0.0);\n    vec mirror[4];\n"
        "    static const int everything[4] = { 1, 1, 1, 1 };\n"
        f"    double {', '.join(numbers)};\n    vec {', '.join(vectors)};\n"
    )


def _sums(  # noqa: PLR0917 - what stands in a sum
    name: str,
    rows: Iterable[int],
    vectors: Sequence[int],
    count: int,
    a: Callable[[int, int], str],
    b: Callable[[int, int], str],
    start: Callable[[int, int], str] = lambda _r, _v: "zero",
) -> list[str]:
    """name{r}_{v} = start + sum over k of a(r, k) b(k, v), a link of all sums after the other."""
    each = list(rows)
    lines = [f"vec {name}{r}_{v} = {start(r, v)};" for r in each for v in vectors]
    for k in range(count):
        lines.append("{")
        lines += [f"vec b{v} = {b(k, v)}; HOLD(b{v});" for v in vectors]
        for r in each:
            links = " ".join(f"{name}{r}_{v} += a * b{v};" for v in vectors)
            lines.append(f"{{ const vec a = ALL({a(r, k)}); {links} }}")
        lines.append("}")
    return lines


def _rows_of_T(s: Sizes, rows: Sequence[int]) -> list[str]:
    """Rows of T = [CA; A] P, stored; those of A are summed for the test."""
    every = range(s.W)
    lines = _sums(
        "t", rows, every, s.n, lambda r, k: f"rows[{r * s.n + k}]", lambda k, v: f"P{k}_{v}"
    )
    for r in rows:
        lines += [f"STORE(new->T + {r * s.NP + v * LANES}, t{r}_{v});" for v in every]
        lines += [f"sum{v % 2} += MAGNITUDE(t{r}_{v});" for v in every if r >= s.p]
    return lines


def _move(s: Sizes) -> str:
    """From P and x to T, the pivots, W and the means of the next sample."""
    rest = [list(range(i, min(i + 4, s.p + s.n))) for i in range(s.p, s.p + s.n, 4)]
    columns = range(s.G + s.W)
    lines = [*_rows_of_T(s, range(s.p)), *_rows_of_T(s, rest[0])]
    lines += _sums(
        "z", range(s.p), columns, s.n,
        lambda r, k: f"new->T[{r * s.NP + k}]",
        lambda k, v: f"LOAD(columns + {k * s.ZW + v * LANES})",
        lambda r, v: f"LOAD(Z0 + {r * s.ZW + v * LANES})",
    )  # fmt: skip
    pairs = [(a, b) for a in range(s.p) for b in range(a, s.p)]
    lines += [f"s{a}{b} = z{a}_{b // LANES}[{b % LANES}];" for a, b in pairs]
    lines += _factor(s, "everything")
    for rows in rest[1:]:
        lines += _rows_of_T(s, rows)
    lines += [f"w{a}_{v} = z{a}_{s.G + v};" for a in range(s.p) for v in range(s.W)]
    lines += _eliminated(s, "new")
    lines += _sums(
        "m", [0], columns, s.n,
        lambda _, k: f"x[{k}]",
        lambda k, v: f"LOAD(columns + {k * s.ZW + v * LANES})",
    )  # fmt: skip
    for v in columns:
        lines.append(f"STORE(new->m + {v * LANES}, m0_{v}); sum{v % 2} += MAGNITUDE(m0_{v});")
    return "\n".join(["{", *lines, "}"])


def _factor(s: Sizes, present: str) -> list[str]:
    """Pivots and factors from s00, s01, ..; the names of the shared text are z00, z01, .."""
    pairs = [(a, b) for a in range(s.p) for b in range(a, s.p)]
    lines = ["least = DBL_MAX; {", *[f"double z{a}{b} = s{a}{b};" for a, b in pairs]]
    return [*[line.replace("present", present) for line in [*lines, *text.pivots(s.p, 0)]], "}"]


def _eliminated(s: Sizes, side: str) -> list[str]:
    lines = []
    for v in range(s.W):
        for b in range(s.p):
            lines += [f"w{b}_{v} -= l{b}{a} * w{a}_{v};" for a in range(b)]
            lines.append(f"STORE({side}->W + {b * s.NP + v * LANES}, w{b}_{v});")
            lines.append(f"g{b}_{v} = w{b}_{v} * ALL(d{b});")
    return lines


def _again(s: Sizes) -> str:
    """Rows are missing: V = L W, then another L."""
    lines = []
    for v in range(s.W):
        for b in reversed(range(s.p)):
            lines += [f"w{b}_{v} += l{b}{a} * w{a}_{v};" for a in range(b)]
    return "\n".join([*lines, *_factor(s, "present"), *_eliminated(s, "old")])


def _correct(s: Sizes) -> str:
    """X and P given the sample."""
    lines = []
    for a in range(s.p):
        earlier = "".join(f" - l{a}{b} * u{b}" for b in range(a))
        lines.append(f"const double u{a} = e[{a}]{earlier}, h{a} = u{a} * d{a};")
    lines.append(f"nis = {' + '.join(f'u{a} * h{a}' for a in range(s.p))};")
    for v in range(s.W):
        sums = "".join(f" c += w{a}_{v} * ALL(h{a});" for a in range(s.p))
        lines.append(f"{{ vec c = LOAD(old->m + {s.PP + v * LANES});{sums}")
        lines.append(f"STORE(x + {v * LANES}, c); }}")
    for block in range(s.W):
        lines += ["{", *_blocks(s, block), "}"]
    return "\n".join(lines)


def _blocks(s: Sizes, block: int) -> list[str]:
    """Four rows of P = Q + T A' - W' g up to the diagonal, and their mirror image."""
    rows = range(block * LANES, min(s.n, (block + 1) * LANES))
    columns = range(block + 1)
    lines = _sums(
        "c", rows, columns, s.n,
        lambda r, k: f"old->T[{(s.p + r) * s.NP + k}]",
        lambda k, v: f"LOAD(columns + {k * s.ZW + s.PP + v * LANES})",
        lambda r, v: f"LOAD(Qs + {r * s.NP + v * LANES})",
    )  # fmt: skip
    for a in range(s.p):
        lines += [
            f"c{r}_{v} -= ALL(old->W[{a * s.NP + r}]) * g{a}_{v};" for r in rows for v in columns
        ]
    for v in columns:
        names = [f"c{r}_{v}" for r in rows] + ["zero"] * (LANES - len(rows))
        lines.append(f"transpose({', '.join(names)}, mirror);")
        for q, r in enumerate(rows):
            image = f"LOWER_{q}(c{r}_{v}, mirror[{q}])" if v == block else f"c{r}_{v}"
            lines.append(f"P{r}_{v} = {image};")
        if v != block:
            lines += [f"P{v * LANES + q}_{block} = mirror[{q}];" for q in range(LANES)]
    return lines
