"""Emit a Kalman step as a careful engineer would write it: straight-line C, packed lower triangles.

Measurements are taken one after the other (R is diagonal). Nothing is shared with fkgen: this is
what its code is compared with. Zeros and ones of the model are left out, as anybody would.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

LOG_2PI = 1.8378770664093453

Row = Sequence[float]


def kalman(model: dict[str, Any]) -> str:
    """C of ``hand_init`` and ``hand_step`` for one model; ``CHECKS`` turns the refusals on."""
    A, C, Q, R = model["A"], model["C"], model["Q"], model["R"]
    n, p = len(A), len(C)
    lines = [f"const double p{i}_{j} = f->P[{_at(i, j)}];" for i, j in _lower(n)]
    lines = [line.replace("const ", "") for line in lines]
    lines += [f"double x{i} = f->x[{i}];" for i in range(n)]
    lines += [f"double e{i} = 0.0;" for i in range(p)]
    lines += ["double nis = 0.0, determinant = 0.0;"]
    lines += _checked(f"p{i}_{i} >= 0.0" for i in range(n))
    lines += _checked(f"!isinf(y[{i}])" for i in range(p))
    for i in range(p):
        lines += _when_present(i, [f"e{i} = y[{i}] - ({_dot(C[i], 'x', n)});"])
    for i in range(p):
        lines += _row(i, C, R)
    lines += [f"const double {_s(i, j)} = {_entry(i, j)};" for i, j in _lower(p)]
    lines += _predict(A, Q)
    lines += _checked(f"isfinite(m{i}) && isfinite(n{i}_{i})" for i in range(n))
    lines += _stores(n, p)
    body = "\n".join(line if line.startswith("#") else f"    {line}" for line in lines)
    prior = ", ".join(repr(model["P0"][i][j]) for i, j in _lower(n))
    init = f"    *f = (hand_t){{ .P = {{ {prior} }} }};"
    return (
        f'#include "hand.h"\n\nvoid hand_init(hand_t *f)\n{{\n{init}\n}}\n\n'
        f"int hand_step(hand_t *f, const double *y)\n{{\n{body}\n    return 0;\n}}\n"
    )


def _row(r: int, C: Sequence[Row], R: Sequence[Row]) -> list[str]:
    """Take row r of y: w = P c, s = c w + r, x += w v/s, P -= w w'/s; tell the later rows."""
    n, p = len(C[0]), len(C)
    lines = [f"const double w{r}_{i} = {_dot(C[r], 'p', n, row=i)};" for i in range(n)]
    lines += [f"const double s{r} = {_dot(C[r], f'w{r}_', n)} + {R[r][r]!r};"]
    lines += [f"const double h{r}_{j} = {_dot(C[j], f'w{r}_', n)};" for j in range(r + 1, p)]
    lines += [f"double g{r}_{j} = 0.0;" for j in range(r + 1, p)]
    lines += _checked([f"s{r} > 0.0"])
    inner = [f"const double inverse = 1.0 / s{r};"]
    residual = "".join(f" - g{j}_{r} * v{j}" for j in range(r))
    inner += [f"const double v = e{r}{residual};", "const double z = v * inverse;"]
    inner += [f"g{r}_{j} = h{r}_{j} * inverse;" for j in range(r + 1, p)]
    inner += [f"v{r} = v;", "nis += v * z;", f"determinant += log(s{r}) + {LOG_2PI!r};"]
    for i in range(n):
        inner += [f"const double k{i} = w{r}_{i} * inverse;", f"x{i} += w{r}_{i} * z;"]
        inner += [f"p{i}_{j} -= k{i} * w{r}_{j};" for j in range(i + 1)]
    return [*lines, f"double v{r} = 0.0;", *_when_present(r, inner)]


def _entry(i: int, j: int) -> str:
    """S[i, j] from the sequential pivots: what earlier rows took away is given back."""
    given = "".join(f" + g{r}_{i} * h{r}_{j}" for r in range(j))
    return (f"s{i}" if i == j else f"h{j}_{i}") + given


def _predict(A: Sequence[Row], Q: Sequence[Row]) -> list[str]:
    n = len(A)
    lines = [f"const double m{i} = {_dot(A[i], 'x', n)};" for i in range(n)]
    lines += [
        f"const double b{i}_{j} = {_dot(A[i], 'p', n, row=j)};" for i in range(n) for j in range(n)
    ]
    lines += [
        f"const double n{i}_{j} = {_dot(A[j], f'b{i}_', n)}"
        + (f" + {Q[i][j]!r};" if Q[i][j] else ";")
        for i, j in _lower(n)
    ]
    return lines


def _stores(n: int, p: int) -> list[str]:
    lines = [f"f->x[{i}] = m{i}; f->xf[{i}] = x{i};" for i in range(n)]
    lines += [f"f->P[{_at(i, j)}] = n{i}_{j}; f->Pf[{_at(i, j)}] = p{i}_{j};" for i, j in _lower(n)]
    lines += [f"f->innovation[{i}] = e{i};" for i in range(p)]
    lines += [f"f->S[{_at(i, j)}] = {_s(i, j)};" for i, j in _lower(p)]
    return [*lines, "f->nis = nis;", "f->log_likelihood = -0.5 * (nis + determinant);"]


def _s(i: int, j: int) -> str:
    return f"S{i}_{j}"


def _dot(coefficients: Row, name: str, n: int, row: int | None = None) -> str:
    """Sum of coefficients times name0, name1, ..; with ``row``: that row of a symmetric matrix."""
    terms = []
    for j in range(n):
        factor = f"{name}{j}" if row is None else f"{name}{max(row, j)}_{min(row, j)}"
        value = float(coefficients[j])
        if value:
            terms.append(factor if value == 1.0 else f"{value!r} * {factor}")
    return " + ".join(terms) or "0.0"


def _checked(conditions: Iterable[str]) -> list[str]:
    tests = " && ".join(f"({condition})" for condition in conditions)
    return ["#if CHECKS", f"if (!({tests})) return -1;", "#endif"]


def _when_present(row: int, inner: list[str]) -> list[str]:
    return ["#if CHECKS", f"if (!isnan(y[{row}]))", "#endif", "{", *inner, "}"]


def _lower(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1)]


def _at(i: int, j: int) -> int:
    return i * (i + 1) // 2 + j
