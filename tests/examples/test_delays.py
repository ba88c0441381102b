"""Delays and fixed lag by copies of states: what the page says, against the joint Gaussian."""

from __future__ import annotations

import re
import tomllib
from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pytest
from plants import random_model
from toolchain import needs_compiler

import fkgen
from fkgen.study.reports.starters import resource

PAGE = resource("docs/delays.md").read_text(encoding="utf-8")
T = 12


def block(language):
    (text,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    return text


def expected(model, delays, y, lag):
    """x(k|k) and x(max(k-lag, 0)|k) from the joint law of all states and rows: (T, n) each."""
    A, C, Q, R, P0 = (np.array(model[key], float) for key in ("A", "C", "Q", "R", "P0"))
    n, p = len(A), len(C)
    # x = G (x[0], w[0], w[1], ...), stacked over the samples
    G = np.zeros((T, n, T * n))
    G[0, :, :n] = np.eye(n)
    for k in range(1, T):
        G[k] = A @ G[k - 1]
        G[k, :, k * n : (k + 1) * n] = np.eye(n)
    law = np.kron(np.eye(T), Q)
    law[:n, :n] = P0
    mean = G @ np.concatenate([model["x0"], np.zeros((T - 1) * n)])
    filtered, lagged = np.empty((T, n)), np.empty((T, n))
    for k in range(T):
        rows = [(j, i) for j in range(k + 1) for i in range(p) if np.isfinite(y[j, i])]
        H = np.array([C[i] @ G[j - delays[i]] for j, i in rows]).reshape(len(rows), T * n)
        noise = [[R[a, b] * (j == m) for m, b in rows] for j, a in rows]
        S = H @ law @ H.T + np.array(noise).reshape(len(rows), len(rows))
        e = [y[j, i] - C[i] @ mean[j - delays[i]] for j, i in rows]
        for out, at in ((filtered, k), (lagged, max(k - lag, 0))):
            out[k] = mean[at] + G[at] @ law @ H.T @ np.linalg.solve(S, np.array(e))
    return filtered, lagged


def record(p, delays, seed):
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(T, p)) * 3.0
    y[rng.random(y.shape) < 0.2] = np.nan
    for i, d in enumerate(delays):
        y[:d, i] = np.nan
    return y


@needs_compiler()
def test_the_program_of_the_page_prints_what_stands_beside_it():
    printed, code = StringIO(), block("python")
    with redirect_stdout(printed):
        exec(compile(code, "delays.md", "exec"), {})  # noqa: S102
    assert printed.getvalue().split() == re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)


@needs_compiler()
@pytest.mark.parametrize("update", ["short", "joseph"])
def test_the_spec_of_the_page_is_exact_about_the_late_row_and_about_the_past(update):
    table = tomllib.loads(block("toml"))
    whole = table["model"]
    model = {"A": [row[:2] for row in whole["A"][:2]], "C": [[0.0, 1.0], [1.0, 0.0]]}
    model |= {key: [row[:2] for row in whole[key][:2]] for key in ("Q", "P0")}
    model |= {"R": whole["R"], "x0": whole["x0"][:2]}
    y = record(2, (0, 3), 5)
    run = fkgen.build(fkgen.Spec.from_dict(table | {"code": {"update": update}})).run(y)
    filtered, lagged = expected(model, (0, 3), y, 3)
    np.testing.assert_allclose(run.filtered_state[:, :2], filtered, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.filtered_state[:, 4], lagged[:, 0], rtol=1e-9, atol=1e-9)


@needs_compiler()
@pytest.mark.parametrize(("lag", "delays"), [(2, (0, 2, 1)), (4, (3, 0, 0))])
def test_copies_of_any_model_are_exact(lag, delays):
    names = {}
    exec(block("python").partition("\n\n\ncar = ")[0], names)  # noqa: S102
    model = random_model(91, 2, 3, correlated=True)
    y = record(3, delays, 6)
    extended = names["with_copies"](model, lag, delays)
    spec = {"name": "late", "model": extended, "filter": {"family": "kf"}}
    run = fkgen.build(fkgen.Spec.from_dict(spec)).run(y)
    filtered, lagged = expected(model, delays, y, lag)
    np.testing.assert_allclose(run.filtered_state[:, :2], filtered, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(run.filtered_state[:, -2:], lagged, rtol=1e-8, atol=1e-8)
