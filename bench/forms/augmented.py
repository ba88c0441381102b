"""The form for any size: T = [CA; A] P(k|k) in rolled tiles; P(k+1|k) is never stored.

With CA, CQ and S0 = C Q C' + R from the model, V = CQ + Tc A' and S = S0 + Tc (CA)' do not wait for
the prediction: the pivots, a chain of divisions, are found before the other rows of T in the text
and beside them in the processor. The next P(k|k) = Q + T A' - W' D^-1 W in one tile.

Of two sides one holds what the last sample left, the other what this one makes; a refused result is
one that is not turned to. sum |T| below a limit proves that Q + T A' is finite.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from forms import text
from forms.text import LANES, Link, Sizes

DECLARED = """
typedef struct
{
    double T[%(T)d] ALIGNED, Z[%(Z)d] ALIGNED, g[%(Z)d] ALIGNED, m[%(ZW)d] ALIGNED;
    double d[%(p)d], least;
} side_t;

static side_t sides[2], *old, *new;
static double P[%(P)d] ALIGNED, x[%(NP)d] ALIGNED;
static const int everything[%(p)d] = { %(ones)s };
"""
BEGIN = """
INLINE const double *expected(void) { return old->m; }

INLINE void again(const int *present) { eliminate(old, present); }

static void begin(void)
{
    memset(sides, 0, sizeof sides);
    memset(P, 0, sizeof P);
    memset(x, 0, sizeof x);
    memcpy(P, P0s, sizeof P0s);
    old = &sides[0];
    new = &sides[1];
    (void)move(old);
}
"""
STEP = """
if (!(old->least > 0.0)) { status[t] = -3; return t; }
correct(e);
if (!move(new)) { status[t] = -5; return t; }
{ side_t *turn = old; old = new; new = turn; }
"""


def augmented(model: dict[str, Any], size: tuple[int, int] = (4, 2)) -> str:
    """C of the form for one model; ``size`` is that of the tiles of T."""
    A, C, Q, R, P0 = text.matrices(model)
    s = Sizes(len(A), len(C))
    CA, CQ, S0 = C @ A, C @ Q, C @ Q @ C.T + R
    limit = np.finfo(float).max / 4 / max(1.0, np.abs(A).max(), np.abs(CA).max())
    names = {"T": (s.p + s.NP) * s.NP, "Z": s.p * s.ZW, "ZW": s.ZW, "p": s.p, "NP": s.NP}
    names |= {"P": s.NP * s.NP, "ones": ", ".join(["1"] * s.p)}
    parts = [
        '#include "vectors.h"\n\n',
        text.table("rows", np.vstack([CA, A])) + text.table("columns", text.both(CA.T, A.T, s)),
        text.table("Z0", text.both(S0, CQ, s)) + text.table("Qs", text.padded(Q, s.NP)),
        text.table("P0s", text.padded(P0, s.NP)),
        DECLARED % names,
        _eliminations(s),
        _move(s, size, limit),
        _correct(s),
        BEGIN,
        text.record(s, STEP),
    ]
    return "".join(parts)


def _product(s: Sizes, size: tuple[int, int], rows: int, first: int) -> str:
    """Rows of T from ``first`` on; those of A are summed for the test of the results."""

    def make(height: int, width: int) -> str:
        link = Link(
            s.n,
            lambda r: f"rows[(i + {first + r}) * {s.n} + k]",
            lambda v: f"P + k * {s.NP} + (j + {v}) * {LANES}",
        )
        cells = [(r, v) for r in range(height) for v in range(width)]
        at = f"side->T + (i + {first} + %d) * {s.NP} + (j + %d) * {LANES}"
        kept = [f"STORE({at % cell}, c{cell[0]}{cell[1]});" for cell in cells]
        if first:
            kept += [f"sum{v % 2} += MAGNITUDE(c{r}{v});" for r, v in cells]
        return text.tile(height, width, lambda _r, _v: "zero", [link], kept)

    return text.tiled(rows, s.W, size, make)


def _block(s: Sizes, first: int, present: str) -> tuple[str, str]:
    """Rows first .. of [S V]: their sums and pivots; what the pivots do to them."""
    rows = min(LANES, s.p - first)

    def make(height: int, width: int) -> str:
        place = f"(j + %d) * {LANES}"
        links = [
            Link(
                s.n,
                lambda r: f"side->T[{(first + r) * s.NP} + k]",
                lambda v: f"columns + k * {s.ZW} + {place % v}",
            )
        ]
        if first:
            links.append(
                Link(
                    first,
                    lambda r: f"side->g[k * {s.ZW} + {first + r}]",
                    lambda v: f"side->Z + k * {s.ZW} + {place % v}",
                    "-",
                )
            )
        kept = [
            f"STORE(side->Z + {(first + r) * s.ZW} + {place % v}, c{r}{v});"
            for r in range(height)
            for v in range(width)
        ]
        start = f"LOAD(Z0 + %d + {place})"
        return text.tile(height, width, lambda r, v: start % ((first + r) * s.ZW, v), links, kept)

    found = [text.tiled(rows, s.G + s.W, (4, 2), make), "{"]
    found += [
        f"double z{a}{b} = side->Z[{(first + a) * s.ZW + first + b}];"
        for a in range(rows)
        for b in range(a, rows)
    ]
    found += [*text.pivots(rows, first), "}"]
    done = [f"ROLLED for (j = 0; j < {s.ZW}; j += {LANES}) {{"]
    for a in range(rows):
        at = f"{(first + a) * s.ZW} + j"
        done.append(f"vec z{a} = LOAD(side->Z + {at});")
        done += [f"z{a} -= l{a}{b} * z{b};" for b in range(a)]
        done.append(f"STORE(side->Z + {at}, z{a}); STORE(side->g + {at}, z{a} * d{first + a});")
    done.append("}")
    return "\n".join(found).replace("present", present), "\n".join(done)


def _elimination(s: Sizes, present: str, between: str) -> str:
    """[S V], its pivots and its rows; ``between`` stands after the first pivots."""
    names = [f"d{a} = 0.0" for a in range(s.p)] + ["least = DBL_MAX"]
    names += [f"l{b}{a} = 0.0" for b in range(1, min(LANES, s.p)) for a in range(b)]
    lines = [f"double {', '.join(names)};"]
    for first in range(0, s.p, LANES):
        found, done = _block(s, first, present)
        lines += [found, "" if first else between, done]
    return "\n".join(
        [*lines, *[f"side->d[{a}] = d{a};" for a in range(s.p)], "side->least = least;"]
    )


def _eliminations(s: Sizes) -> str:
    """With rows missing: seldom, so kept apart."""
    head = "static __attribute__((noinline)) void eliminate(side_t *side, const int *present)"
    return f"{head}\n{{\nint i, j, k;\n{_elimination(s, 'present', '')}\n}}\n"


def _move(s: Sizes, size: tuple[int, int], limit: float) -> str:
    """From P and x to T, [S V] and the means of the next sample."""
    rest = _product(s, size, s.n, s.p)
    return "\n".join(
        [
            "INLINE int move(side_t *side)",
            "{",
            "const vec zero = ALL(0.0); vec sum0 = zero, sum1 = zero; int i, j, k;",
            _product(s, (min(4, s.p), size[1]), s.p, 0),
            _elimination(s, "everything", rest),
            _means(s),
            f"sum0 += sum1; return TOTAL(sum0) <= {limit!r};".replace("np.float64", ""),
            "}\n",
        ]
    )


def _means(s: Sizes) -> str:
    """M = [CA; A] x, a few vectors at a time."""

    def make(height: int, width: int) -> str:
        place = f"(j + %d) * {LANES}"
        link = Link(s.n, lambda _: "x[k]", lambda v: f"columns + k * {s.ZW} + {place % v}")
        kept = [f"STORE(side->m + {place % v}, c0{v});" for v in range(width)]
        kept += [f"sum{v % 2} += MAGNITUDE(c0{v});" for v in range(width)]
        return text.tile(height, width, lambda _r, _v: "zero", [link], kept)

    return text.tiled(1, s.G + s.W, (1, 6), make)


def correct_mean(s: Sizes) -> list[str]:
    """The head of ``correct``: x given the sample, and nis."""
    lines = ["static double nis;", "INLINE void correct(const double *e)", "{"]
    lines += ["const vec zero = ALL(0.0); vec mirror[4]; int i, j, k; double total = 0.0;"]
    lines.append("(void)i; (void)k; (void)zero;")
    for a in range(s.p):
        earlier = "".join(f" - old->g[{b * s.ZW + a}] * u{b}" for b in range(a))
        lines.append(f"const double u{a} = e[{a}]{earlier}; total += u{a} * (u{a} * old->d[{a}]);")
    lines += ["nis = total;", f"ROLLED for (j = 0; j < {s.NP}; j += {LANES}) {{"]
    lines.append(f"vec c = LOAD(old->m + {s.PP} + j);")
    lines += [f"c += u{a} * LOAD(old->g + {a * s.ZW + s.PP} + j);" for a in range(s.p)]
    return [*lines, "STORE(x + j, c); }"]


def _correct(s: Sizes) -> str:
    """X and P given the sample: P = Q + T A' - W' g, lower blocks of four rows, mirrored."""
    lines = correct_mean(s)
    whole, left = divmod(s.n, LANES)
    pairs = whole - whole % 2
    if pairs:
        both = f"{_blocks(s, LANES, even=True)}\n++i;\n{_blocks(s, LANES, even=False)}"
        lines.append(f"ROLLED for (i = 0; i < {pairs}; ++i) {{\n{both}\n}}")
    if whole % 2:
        lines.append(f"i = {whole - 1};\n{_blocks(s, LANES, even=True)}")
    if left:
        lines.append(f"i = {whole};\n{_blocks(s, left, even=whole % 2 == 0)}")
    return "\n".join([*lines, "}\n"])


def _blocks(s: Sizes, rows: int, *, even: bool) -> str:
    """Block row i: pairs of blocks up to the diagonal; on even rows the last one is alone."""
    head = f"ROLLED for (j = 0; j < i - {0 if even else 1}; j += 2)"
    ends = _pass(s, rows, 1, diagonal=0) if even else _pass(s, rows, 2, diagonal=1)
    return f"{head}\n{_pass(s, rows, 2, diagonal=-1)}\n{ends}"


def _pass(s: Sizes, rows: int, width: int, *, diagonal: int) -> str:
    place = f"(j + %d) * {LANES}"
    links = [
        Link(
            s.n,
            lambda r: f"old->T[({s.p + r} + i * {LANES}) * {s.NP} + k]",
            lambda v: f"columns + {s.PP} + k * {s.ZW} + {place % v}",
        ),
        Link(
            s.p,
            lambda r: f"old->Z[k * {s.ZW} + {s.PP + r} + i * {LANES}]",
            lambda v: f"old->g + {s.PP} + k * {s.ZW} + {place % v}",
            "-",
        ),
    ]
    kept = []
    for v in range(width):
        kept.append(text.mirrored(rows, v))
        if v == diagonal:
            kept += text.diagonal(rows, v)
        else:
            kept += [
                f"STORE(P + ((j + {v}) * {LANES} + {r}) * {s.NP} + i * {LANES}, mirror[{r}]);"
                for r in range(LANES)
            ]
        kept += [
            f"STORE(P + (i * {LANES} + {r}) * {s.NP} + {place % v}, c{r}{v});" for r in range(rows)
        ]
    start = f"LOAD(Qs + (i * {LANES} + %d) * {s.NP} + {place})"
    return text.tile(rows, width, lambda r, v: start % (r, v), links, kept)
