"""Four records side by side, one in each lane of a vector: every number of the filter is a vector.

    int64_t form_batch(int64_t records, int64_t samples, const double *y, int32_t *status,
                       double *state)

takes records by fours and returns those it took: fewer if a pivot or a result was refused. The
textbook's algebra in tiles of accumulators; up to six states the loops are unrolled.
"""

from __future__ import annotations

from typing import Any

from forms import text
from forms.text import LANES, Link

_LOOP = """
static void begin(void)
{
    int i;
    for (i = 0; i < NX * NX; ++i) { P[i] = ALL(prior[i]); }
    for (i = 0; i < NX; ++i) { x[i] = ALL(0.0); }
}

INLINE vec expected(int i)
{
    vec c = ALL(0.0);
    int k;
    for (k = 0; k < NX; ++k) { c += Cs[i * NX + k] * x[k]; }
    return c;
}

INLINE vec step(const vec *e, const mask *there);
static vec least;

int64_t form_batch(int64_t records, int64_t samples, const double *y, int32_t *status,
    double *state)
{
    int64_t at, t;
    int i, l;
    for (at = 0; at + 4 <= records; at += 4)
    {
        begin();
        for (t = 0; t < samples; ++t)
        {
            vec e[NY];
            mask there[NY];
            const double *from = y + (at * samples + t) * NY;
            double *to = state + (at * samples + t) * NX;
            for (i = 0; i < NY; ++i)
            {
                for (l = 0; l < 4; ++l) { e[i][l] = from[l * samples * NY + i]; }
                there[i] = (mask)((e[i] - e[i]) == ALL(0.0));
                e[i] = (vec)((mask)(e[i] - expected(i)) & there[i]);
            }
            const vec total = step(e, there);
            const mask good = ((total - total) == ALL(0.0)) & (least > ALL(0.0));
            if (!(good[0] & good[1] & good[2] & good[3])) { return at; }
            for (l = 0; l < 4; ++l)
            {
                mask some = there[0];
                for (i = 1; i < NY; ++i) { some |= there[i]; }
                status[(at + l) * samples + t] = some[l] ? 0 : 1;
            }
            for (i = 0; i + 4 <= NX; i += 4)
            {
                vec turned[4];
                transpose(xf[i], xf[i + 1], xf[i + 2], xf[i + 3], turned);
                for (l = 0; l < 4; ++l) { memcpy(to + l * samples * NX + i, &turned[l], 32); }
            }
            for (; i < NX; ++i)
            {
                for (l = 0; l < 4; ++l) { to[l * samples * NX + i] = xf[i][l]; }
            }
        }
    }
    return at;
}
"""


def lanes(model: dict[str, Any]) -> str:
    """C of the form for one model."""
    A, C, Q, R, P0 = text.matrices(model)
    n, p = len(A), len(C)
    prior = A @ P0 @ A.T + Q
    tables = {"As": A, "Cs": C, "Qs": Q, "Rs": R, "prior": prior}
    head = f'#include "vectors.h"\n#define NX {n}\n#define NY {p}\n'
    if n <= 6:
        head += '#undef ROLLED\n#undef TWICE\n#define ROLLED _Pragma("GCC unroll 16")\n'
        head += "#define TWICE ROLLED\n"
    return "".join(
        [
            head,
            *[text.table(name, values) for name, values in tables.items()],
            "static vec P[NX * NX], T[NX * NX], V[NY * NX], g[NY * NX], x[NX], xf[NX];\n",
            _LOOP,
            _step(n, p),
        ]
    )


def _product(rows: int, n: int, constant: str, source: str, target: str) -> str:
    """Target = constant source, both by rows of n vectors."""

    def make(height: int, width: int) -> str:
        link = Link(
            n,
            lambda r: f"{constant}[(i + {r}) * NX + k]",
            lambda v: f"(const double *)({source} + k * NX + j + {v})",
        )
        kept = [
            f"{target}[(i + {r}) * NX + j + {v}] = c{r}{v};"
            for r in range(height)
            for v in range(width)
        ]
        return text.tile(height, width, lambda _r, _v: "ALL(0.0)", [link], kept)

    return text.tiled(rows, n, (4, 2), make)


def _step(n: int, p: int) -> str:
    pairs = [(a, b) for a in range(p) for b in range(a, p)]
    lines = [
        "INLINE vec step(const vec *e, const mask *there)",
        "{",
        "int i, j, k; vec total = ALL(0.0);",
    ]
    lines.append(_product(p, n, "Cs", "P", "V"))
    for a, b in pairs:
        terms = f"for (k = 0; k < NX; ++k) s{a}{b} += Cs[{b} * NX + k] * V[{a} * NX + k];"
        lines.append(f"vec s{a}{b} = ALL(Rs[{a * p + b}]); ROLLED {terms}")
    lines.append("least = ALL(DBL_MAX);")
    for a in range(p):
        lines.append(f"const vec d{a} = (vec)((mask)(1.0 / s{a}{a}) & there[{a}]);")
        lines.append(f"least = SELECT(there[{a}] & ~(mask)(s{a}{a} >= least), s{a}{a}, least);")
        for b in range(a + 1, p):
            lines.append(f"const vec l{b}{a} = s{a}{b} * d{a};")
            lines += [f"s{b}{c} -= l{b}{a} * s{a}{c};" for c in range(b, p)]
    for a in range(p):
        earlier = "".join(f" - l{a}{b} * u{b}" for b in range(a))
        lines.append(f"const vec u{a} = e[{a}]{earlier}, h{a} = u{a} * d{a};")
    lines.append("ROLLED for (j = 0; j < NX; ++j) {")
    for a in range(p):
        earlier = "".join(f" - l{a}{b} * v{b}" for b in range(a))
        lines.append(f"const vec v{a} = V[{a} * NX + j]{earlier};")
        lines.append(f"V[{a} * NX + j] = v{a}; g[{a} * NX + j] = v{a} * d{a};")
    gained = "".join(f" + v{a} * h{a}" for a in range(p))
    lines.append(f"xf[j] = x[j]{gained}; total += xf[j]; }}")
    less = "".join(f" - V[{a} * NX + i] * g[{a} * NX + j]" for a in range(p))
    lines.append("ROLLED for (i = 0; i < NX; ++i) { ROLLED for (j = 0; j <= i; ++j) {")
    lines.append(f"const vec c = P[i * NX + j]{less}; P[i * NX + j] = c; P[j * NX + i] = c; }} }}")
    lines.append(_product(n, n, "As", "P", "T"))
    lines.append(
        "ROLLED for (i = 0; i < NX; ++i) { vec c = ALL(0.0); ROLLED for (k = 0; k < NX; ++k)"
    )
    lines.append("c += As[i * NX + k] * xf[k]; x[i] = c; total += c; }")
    lines.append(_predicted(n))
    lines.append("ROLLED for (i = 0; i < NX; ++i) { ROLLED for (j = 0; j < i; ++j)")
    lines.append("P[j * NX + i] = P[i * NX + j]; total += P[i * NX + i]; }")
    return "\n".join([*lines, "return total;", "}\n"])


def _predicted(n: int) -> str:
    """P = Q + T A', tiles that reach the diagonal: rows of A are scalars, those of T vectors."""
    parts = []
    for first in range(0, n, 2):
        width = min(2, n - first)
        for column in range(0, first + width, LANES):
            height = min(LANES, n - column)
            link = Link(
                n,
                lambda r, column=column: f"As[{(column + r) * n} + k]",
                lambda v, first=first: f"(const double *)(T + {(first + v) * n} + k)",
            )
            kept = [
                f"P[{(first + v) * n + column + r}] = c{r}{v};"
                for v in range(width)
                for r in range(height)
                if column + r <= first + v
            ]
            parts.append(
                text.tile(
                    height,
                    width,
                    lambda r, v, first=first, column=column: (
                        f"ALL(Qs[{(first + v) * n + column + r}])"
                    ),
                    [link],
                    kept,
                )
            )
    return "\n".join(parts)
