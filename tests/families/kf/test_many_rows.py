"""Many rows of y with a full R, many states: loops, against matrices with rows cut out."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from plants import covariance
from toolchain import needs_compiler

import fkgen
from fkgen.errors import StepRefused

pytestmark = needs_compiler()

T = 12
#: Relative to the size that a number has over the record: some thousand roundings.
TOLERANCE = {"double": 1e-11, "float": 2e-3}
#: Bytes of C: what a person still opens, and a compiler takes some seconds for.
SIZE = 300_000


@cache
def plant(n, p):
    """A dense plant, as arrays."""
    rng = np.random.default_rng(100 * n + p)
    A = rng.standard_normal((n, n))
    model = {"A": 0.9 * A / np.abs(np.linalg.eigvals(A)).max(), "C": rng.standard_normal((p, n))}
    model |= {"Q": covariance(rng, n), "R": covariance(rng, p) + 0.5 * np.eye(p)}
    return model | {"x0": rng.standard_normal(n), "P0": covariance(rng, n)}


@cache
def built(n, p, scalar):
    model = {name: value.tolist() for name, value in plant(n, p).items()}
    table = {"name": "many", "model": model, "filter": {"family": "kf"}, "code": {"scalar": scalar}}
    return fkgen.generate(fkgen.validate(fkgen.Spec.from_dict(table)))


def record(n, p):
    """Rows are missing at random, all of them in one sample, all but one in another."""
    rng = np.random.default_rng(7)
    y = rng.standard_normal((T, p)) * 3.0
    y[rng.random((T, p)) < 0.3] = np.nan
    y[3], y[4, 1:], y[5] = np.nan, np.nan, rng.standard_normal(p)
    return y


class Textbook:
    """The Kalman filter of matrices at once, with missing rows cut out."""

    def __init__(self, model):
        self.__dict__ |= model
        self.x, self.P = model["x0"], model["P0"]

    def update(self, y):
        here = np.isfinite(y)
        H, e = self.C[here], (y - self.C @ self.x)[here]
        self.S = self.C @ self.P @ self.C.T + self.R
        S, PH = self.S[np.ix_(here, here)], self.P @ H.T
        self.nis = e @ np.linalg.solve(S, e)
        self.ll = -0.5 * (self.nis + np.linalg.slogdet(2.0 * np.pi * S)[1])
        self.x = self.x + PH @ np.linalg.solve(S, e)
        self.P = self.P - PH @ np.linalg.solve(S, PH.T)

    def predict(self):
        self.x, self.P = self.A @ self.x, self.A @ self.P @ self.A.T + self.Q


def expected(model, y):
    book, found = Textbook(model), []
    for row in y:
        book.update(row)
        found.append((book.x, book.P, book.S, book.nis, book.ll))
        book.predict()
    names = (
        "filtered_state",
        "filtered_covariance",
        "innovation_covariance",
        "nis",
        "log_likelihood",
    )
    return dict(zip(names, map(np.array, zip(*found, strict=True)), strict=True))


@pytest.mark.parametrize(
    ("n", "p", "scalar"),
    [
        *((4, 40, "double"), (2, 40, "float"), (8, 33, "float")),
        *((8, 2, "double"), (13, 5, "double"), (16, 4, "float"), (31, 9, "double")),
    ],
)
def test_any_rows_may_be_missing(n, p, scalar):
    source, y = built(n, p, scalar), record(n, p)
    found = fkgen.compile(source).run(y)
    for name, values in expected(plant(n, p), y).items():
        error = np.abs(found[name] - values).max() / np.abs(values).max()
        assert error < TOLERANCE[scalar], (name, error)
    assert sum(map(len, source.files.values())) < SIZE
    innovation = y[0] - plant(n, p)["C"] @ plant(n, p)["x0"]
    np.testing.assert_allclose(found.innovation[0], innovation, rtol=1e-5, atol=1e-5)


def test_calls_in_any_order():
    """Updates, predictions and steps at random; a second update of correlated rows is refused."""
    n, p = 4, 40
    built_filter, book = fkgen.compile(built(n, p, "double")), Textbook(plant(n, p))
    rng, updated = np.random.default_rng(11), False
    for verb in rng.choice(["update", "predict", "step"], 40):
        y = rng.standard_normal(p) * 3.0
        y[rng.random(p) < rng.random()] = np.nan
        y[rng.integers(p)] = 0.5
        if verb != "predict" and updated:
            with pytest.raises(StepRefused):
                getattr(built_filter, verb)(y)
        elif verb == "predict":
            built_filter.predict()
            book.predict()
            updated = False
        else:
            getattr(built_filter, verb)(y)
            book.update(y)
            filtered = book.x, book.P[np.tril_indices(n)]
            updated = verb == "update"
            if verb == "step":
                book.predict()
            for name, value in zip(
                ("filtered_state", "filtered_covariance"), filtered, strict=True
            ):
                np.testing.assert_allclose(built_filter.state(name), value, rtol=0, atol=1e-10)
        if not updated:
            np.testing.assert_allclose(built_filter.state("predicted_state"), book.x, atol=1e-10)


@pytest.mark.parametrize(("n", "p"), [(9, 3), (21, 4)])
def test_the_text_does_not_grow_with_the_plant(n, p):
    assert built(n, p, "double").program.statements < 40 * n


def test_size_comes_before_speed_where_it_is_asked_for():
    model = {name: value.tolist() for name, value in plant(6, 3).items()}
    table = {"name": "small", "model": model, "filter": {"family": "kf"}}
    asked = [fkgen.Spec.from_dict(table | {"code": code}) for code in ({}, {"optimise": "size"})]
    fast, small = (fkgen.generate(fkgen.validate(spec)) for spec in asked)
    assert len(small.files["small.c"]) < 0.7 * len(fast.files["small.c"])
    assert "always_inline" not in small.files["small.c"].split("#else")[-1]
    y = record(6, 3)
    runs = [fkgen.compile(source).run(y) for source in (fast, small)]
    for name, values in expected(plant(6, 3), y).items():
        for found in runs:
            assert np.abs(found[name] - values).max() < 1e-11 * np.abs(values).max(), name


def test_straight_lines_beyond_the_limit_are_refused_in_one_line():
    model = {name: value.tolist() for name, value in plant(16, 4).items()}
    table = {"name": "lengthy", "model": model, "filter": {"family": "kf"}}
    spec = fkgen.Spec.from_dict(table | {"code": {"form": "straight"}})
    with pytest.raises(
        fkgen.SpecError, match=r"code\.form.*16 states.*operations.*at most 4000"
    ) as e:
        fkgen.validate(spec)
    assert "\n" not in str(e.value)


def test_the_header_says_the_form():
    assert "loops over whole matrices" in built(13, 5, "double").files["many.h"]
    source = built(4, 40, "double")
    assert "loops over rows of y" in source.files["many.h"]
    assert "for (int j = 0; j < 40; ++j)" in source.files["many.c"]
