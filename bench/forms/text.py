"""What all printed forms share: tables of constants, tiles of accumulators, the loop over a record.

A printed file has one function,

    int64_t form_run(int64_t samples, const double *y, int32_t *status, double *state,
                     double *covariance)

which filters a record from x = 0, P(0|0) = P0 of the model (its first sample comes after one
prediction), writes the status and x(k|k) of every sample and P(T|T), and returns the samples that
it took: fewer if a pivot or a result was refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LANES = 4

Array = NDArray[np.float64]
Address = Callable[[int], str]


@dataclass(frozen=True)
class Sizes:
    """Of a model: n states, p measurements; in whole vectors W, G; in doubles NP, PP.

    Attributes
    ----------
    n, p : int
    """

    n: int
    p: int

    @property
    def W(self) -> int:
        """Vectors of a row of n."""
        return -(-self.n // LANES)

    @property
    def G(self) -> int:
        """Vectors of a row of p."""
        return -(-self.p // LANES)

    @property
    def NP(self) -> int:
        """Doubles of a padded row of n."""
        return LANES * self.W

    @property
    def PP(self) -> int:
        """Doubles of a padded row of p."""
        return LANES * self.G

    @property
    def ZW(self) -> int:
        """Doubles of a row of both: p first."""
        return self.NP + self.PP


def matrices(model: dict[str, Any]) -> tuple[Array, ...]:
    """A, C, Q, R, P0."""
    return tuple(np.array(model[name], float) for name in ("A", "C", "Q", "R", "P0"))


def table(name: str, values: ArrayLike) -> str:
    """A constant array, aligned."""
    flat = np.asarray(values, float).ravel()
    body = ", ".join(repr(float(value)) for value in flat)
    return f"static const double {name}[{flat.size}] ALIGNED = {{ {body} }};\n"


def padded(matrix: ArrayLike, columns: int) -> Array:
    """Rows filled up with zeros."""
    values = np.asarray(matrix, float)
    return np.pad(values, [(0, 0), (0, columns - values.shape[1])])


def both(left: ArrayLike, right: ArrayLike, sizes: Sizes) -> Array:
    """Columns of p and columns of n side by side, each padded."""
    return np.hstack([padded(left, sizes.PP), padded(right, sizes.NP)])


@dataclass(frozen=True)
class Link:
    """Terms of a sum over k = 0 .. count - 1: sign a[row] b[vector].

    Attributes
    ----------
    count : int
    a : function of the row
        Expression of the scalar, in ``k``.
    b : function of the vector
        Address of the vector, in ``k``.
    sign : str
    """

    count: int
    a: Address
    b: Address
    sign: str = "+"


def tile(
    rows: int,
    vectors: int,
    start: Callable[[int, int], str],
    links: Sequence[Link],
    finish: Sequence[str],
) -> str:
    """Rows x vectors accumulators c00, c01, .. that stay in registers while k runs."""
    text = ["{"]
    for r in range(rows):
        each = ", ".join(f"c{r}{v} = {start(r, v)}" for v in range(vectors))
        text.append(f"vec {each};")
    for link in links:
        text.append(f"TWICE for (k = 0; k < {link.count}; ++k) {{")
        text += [f"vec b{v} = LOAD({link.b(v)}); HOLD(b{v});" for v in range(vectors)]
        for r in range(rows):
            sums = " ".join(f"c{r}{v} {link.sign}= a * b{v};" for v in range(vectors))
            text.append(f"{{ const vec a = ALL({link.a(r)}); {sums} }}")
        text.append("}")
    return "\n".join([*text, *finish, "}"])


def tiled(rows: int, vectors: int, size: tuple[int, int], make: Callable[[int, int], str]) -> str:
    """Cover rows (i) x vectors (j) with tiles, smaller ones at the edges."""
    text = []
    for height, first, last in _cuts(rows, size[0]):
        inner = []
        for width, left, right in _cuts(vectors, size[1]):
            head = f"ROLLED for (j = {left}; j < {right}; j += {width})"
            inner.append(f"{head}\n{make(height, width)}")
        head = f"ROLLED for (i = {first}; i < {last}; i += {height})"
        text.append("\n".join([f"{head} {{", *inner, "}"]))
    return "\n".join(text)


def _cuts(count: int, step: int) -> list[tuple[int, int, int]]:
    """Size, begin and end of whole steps, and of what is left."""
    whole = count - count % step
    cuts = [(step, 0, whole)] if whole else []
    return [*cuts, (count - whole, whole, count)] if count > whole else cuts


def pivots(rows: int, first: int) -> list[str]:
    """LDL' of the block z00, z01, .. whose rows begin at ``first``; d0, d1, .. l10, .. are kept."""
    text = []
    for a in range(rows):
        text.append(f"d{first + a} = (present[{first + a}]) ? 1.0 / z{a}{a} : 0.0;")
        text.append(f"least = (present[{first + a}] && !(z{a}{a} >= least)) ? z{a}{a} : least;")
        for b in range(a + 1, rows):
            text.append(f"l{b}{a} = z{a}{b} * d{first + a};")
            text += [f"z{b}{c} -= l{b}{a} * z{a}{c};" for c in range(b, rows)]
    return text


def diagonal(rows: int, column: int) -> list[str]:
    """The upper half of a diagonal block c0x, c1x, .. from its lower half."""
    return [f"c{r}{column} = LOWER_{r}(c{r}{column}, mirror[{r}]);" for r in range(rows)]


def mirrored(rows: int, column: int) -> str:
    """The transposed block of column x of a tile, in ``mirror``."""
    names = [f"c{r}{column}" for r in range(rows)] + ["zero"] * (LANES - rows)
    return f"transpose({', '.join(names)}, mirror);"


def record(sizes: Sizes, step: str) -> str:
    """The function: its loop, around a call that returns nonzero for a result that is finite."""
    return f"""
int64_t form_run(int64_t samples, const double *y, int32_t *status, double *state,
    double *covariance)
{{
    int64_t t;
    int i, j;
    begin();
    for (t = 0; t < samples; ++t, y += {sizes.p}, state += {sizes.n})
    {{
        double e[{sizes.p}], bad = 0.0;
        ROLLED for (i = 0; i < {sizes.p}; ++i)
        {{
            e[i] = y[i] - expected()[i];
            bad += y[i] - y[i];
        }}
        status[t] = 0;
        if (__builtin_expect(!(bad == 0.0), 0))
        {{
            int present[{sizes.p}];
            status[t] = some_rows(y, e, present, {sizes.p});
            again(present);
        }}
        {step}
        for (i = 0; i < {sizes.n}; ++i) {{ state[i] = x[i]; }}
    }}
    for (i = 0; i < {sizes.n}; ++i)
    {{
        for (j = 0; j < {sizes.n}; ++j) {{ covariance[i * {sizes.n} + j] = P[i * {sizes.NP} + j]; }}
    }}
    return samples;
}}
"""
