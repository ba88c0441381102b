"""Records as Python users hold them: what is marked as missing, and columns by their names."""

from __future__ import annotations

import itertools
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from plants import PARAMETERS, VARYING, built, spec

from fkgen.errors import DataError, FkgenError, StepRefused

NAMED = VARYING | {
    "inputs": [{"name": "push"}],
    "outputs": [{"name": "gnss"}, {"name": "wheel"}],
}
SPEC = spec(NAMED, family="kf", parameters=PARAMETERS)
ONE = {"A": [[0.9]], "C": [[1.0]], "Q": [[0.1]], "R": [[0.5]], "x0": [0.0], "P0": [[1.0]]}
SINGLE = spec(ONE, family="kf")
NAN = np.nan
Y = np.array([[1.0, 2.0], [NAN, 3.0], [4.0, NAN], [NAN, NAN], [5.0, 6.0]])
U = np.array([[1.0], [-2.0], [0.5], [0.0], [3.0]])
DT = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
MASKED = np.ma.array(np.where(np.isnan(Y), 999.0, Y), mask=np.isnan(Y))
WHOLE = {
    "other": ["a"] * 5,
    "wheel": Y[:, 1],
    "dt": DT,
    "push": U[:, 0],
    "gnss": Y[:, 0],
}


def none_for_nan(values):
    return [None if np.isnan(value) else float(value) for value in values]


NONE = {
    key: none_for_nan(each) if key in {"gnss", "wheel"} else each for key, each in WHOLE.items()
}
FRAMES = {
    "pandas": pd.DataFrame(WHOLE),
    "pandas, nullable": pd.DataFrame(NONE).astype({"gnss": "Float64", "wheel": "Int64"}),
    "polars": pl.DataFrame(NONE),
    "pyarrow": pa.table(NONE),
    "dict": NONE,
    "structured": np.array(
        list(zip(Y[:, 1], DT, U[:, 0], Y[:, 0], strict=True)),
        dtype=[("wheel", float), ("dt", float), ("push", float), ("gnss", float)],
    ),
}
ROWS = {
    "lists": [[1, 2.0], [None, 3], (4, np.ma.masked), [None, None], np.array([5, 6])],
    "a row of None": [[1, 2.0], [None, 3], [4, None], None, [5, 6]],
    "a row of mask": [[1, 2.0], [None, 3], [4, None], np.ma.masked, [5, 6]],
    "masked": MASKED,
    "masked rows": list(MASKED),
    "masked text": np.ma.array(np.where(np.isnan(Y), {}, Y.astype(object)), mask=np.isnan(Y)),
    "numbers": [[Decimal(1), Fraction(2)], [NAN, 3], [4, pd.NA], [pd.NaT, None], [5, np.int8(6)]],
}


@pytest.fixture(scope="module")
def expected():
    return built(SPEC).run(Y, U, {"dt": DT})


def same(run, expected):
    for port in expected.ports:
        np.testing.assert_array_equal(run[port], expected[port])
    np.testing.assert_array_equal(run.status, expected.status)


@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
def test_columns_of_a_frame_are_found_by_name_and_others_ignored(frame, expected):
    params = frame if not isinstance(frame, dict) else {"dt": frame["dt"]}
    same(built(SPEC).run(frame, frame, params), expected)


@pytest.mark.parametrize("y", ROWS.values(), ids=ROWS)
def test_what_is_marked_as_missing_is_missing(y, expected):
    same(built(SPEC).run(y, U, {"dt": DT}), expected)


def test_a_batch_takes_masks_and_frames(expected):
    frame = FRAMES["pandas, nullable"]
    for y in (np.ma.stack([MASKED, MASKED]), [frame, frame], [ROWS["a row of None"], Y.tolist()]):
        found = built(SPEC).run_batch(y, [U, U] if not isinstance(y, list) else U, {"dt": DT})
        for m, port in itertools.product(range(2), expected.ports):
            np.testing.assert_array_equal(found[port][m], expected[port])


@pytest.mark.parametrize(
    "row",
    [
        lambda k: MASKED[k],
        lambda k: none_for_nan(Y[k]),
        lambda k: FRAMES["pandas"].iloc[k],
        lambda k: FRAMES["polars"][k],
        lambda k: FRAMES["polars"].row(k, named=True),
        lambda k: None if np.isnan(Y[k]).all() else Y[k][:, np.newaxis],
        lambda k: np.ma.masked if np.isnan(Y[k]).all() else Y[k : k + 1],
        lambda k: tuple(Y[k].tolist()),
        lambda k: list(Y[k]),
        lambda k: [int(v) if np.isfinite(v) else v for v in Y[k].tolist()],
        *(lambda k, kind=kind: Y[k].astype(kind) for kind in ("f8", ">f8", "f4", "f2", "O")),
        lambda k: np.repeat(Y[k], 2)[::2],
    ],
)
def test_a_step_takes_a_row_in_all_these_forms(row, expected):
    found = built(SPEC)
    found.reset()
    for k in range(len(Y)):
        snapshot = found.step(row(k), U[k], {"dt": DT[k]})
        np.testing.assert_array_equal(snapshot.filtered_state, expected.filtered_state[k])


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_a_step_rounds_numbers_as_a_run_does_whatever_holds_them(scalar):
    y = np.array([[0.1, 1e38], [1.0 + 2.0**-24 + 2.0**-50, 2.0], [1e39, 1.0], [0.3, 0.7]])
    found = built(spec(NAMED, family="kf", parameters=PARAMETERS, code={"scalar": scalar}))
    expected = found.run(y, U[:4], {"dt": 0.3})
    shown = (np.asarray, list, tuple, np.ndarray.tolist, lambda row: np.array([row]))
    for hold in shown:
        found.reset()
        for k, row in enumerate(y):
            if expected.status[k] < 0:
                with pytest.raises(StepRefused):
                    found.step(hold(row), hold(U[k]), {"dt": 0.3})
                found.predict(hold(U[k]), {"dt": np.float64(0.3)})
            else:
                found.step(hold(row), hold(U[k]), {"dt": 0.3})
            snapshot = found.snapshot()
            np.testing.assert_array_equal(snapshot.predicted_state, expected.predicted_state[k])
    assert (expected.status < 0).any() == (scalar == "float")


@pytest.mark.parametrize("y", [pd.Series([1.0, None, 2.0]), pl.Series([1.0, None, 2.0])])
def test_a_series_is_one_column_whatever_its_name(y):
    np.testing.assert_array_equal(built(SINGLE).run(y).status, [0, 1, 0])


def test_numbers_beyond_the_scalar_are_infinities():
    given = [10**400, -(10**400), 1.0]
    np.testing.assert_array_equal(
        built(SINGLE).run(given).status, built(SINGLE).run([np.inf, -np.inf, 1.0]).status
    )


@pytest.mark.parametrize(
    ("y", "u", "params", "message"),
    [
        (FRAMES["pandas"][["gnss"]], U, None, "y: given columns gnss; expected .*: gnss, wheel"),
        (pd.DataFrame(Y), U, None, r"y: given columns 0, 1; expected a column for each of: gnss"),
        (Y, FRAMES["polars"][["dt"]], None, "u: given columns dt; expected a column .*: push"),
        (
            Y,
            U,
            FRAMES["polars"][["gnss"]],
            "params: given columns gnss; expected one of: dt, angle",
        ),
        (pd.concat([FRAMES["pandas"]] * 2, axis=1), U, None, "y.gnss: given several columns of"),
        (FRAMES["pandas"].assign(wheel="a"), U, None, r"y\.wheel\[0\]: given text 'a'"),
        (
            {"gnss": [1, 2], "wheel": [1]},
            U,
            None,
            r"y\.wheel: given shape \(1,\); expected .* gnss",
        ),
        (
            Y,
            np.ma.array(U, mask=U == 0.0),
            None,
            r"u\.push\[3\]: given a missing value; expected a",
        ),
        (Y, [1, None, 1, 1, 1], None, r"u\.push\[1\]: given a missing value"),
        (Y, pl.DataFrame({"push": [1, 2, None, 4, 5]}), None, r"u\.push\[2\]: given a missing"),
        (Y, U, {"dt": np.ma.array(DT, mask=DT > 0.4)}, r"params\.dt\[4\]: given a missing value"),
        (Y, U, pd.DataFrame({"dt": [1, 2, pd.NA, 4, 5]}), r"params\.dt\[2\]: given a missing"),
        (Y, U, {"dt": None}, r"params\.dt: given a missing value"),
        (Y, U, [0.1], r"params: given a value of type list; expected a mapping .*: dt, angle"),
        (Y[:, :1], U, None, r"y: given shape \(5, 1\); expected shape \(T, 2\): gnss, wheel"),
        ([[1, 2], [1]], U, None, r"y: given 1 numbers in sample 1; expected 2, .*\(gnss, wheel\)"),
        ([[1, 2], [1, [2]]], U, None, r"y\.wheel\[1\]: given \[2\] of type list"),
        ([[1, 2], [1, True]], U, None, r"y\.wheel\[1\]: given True of type bool"),
        (np.array([["1", "2"]] * 5), U, None, r"y\.gnss\[0\]: given text '1'"),
        (Y + 0j, U, None, r"y: given type complex128; expected real numbers \(gnss, wheel\)"),
        (FRAMES["polars"].lazy(), U, None, "y: given a LazyFrame that cannot be read"),
    ],
)
def test_what_does_not_fit_names_the_signal_or_the_parameter(y, u, params, message):
    with pytest.raises(DataError, match=message) as error:
        built(SPEC).run(y, u, params)
    assert "\n" not in str(error.value)


class Hostile:
    """An object of which nothing can be read."""

    def __array__(self, *_args, **_options):
        raise RuntimeError("no\narray")

    def __repr__(self):
        raise RuntimeError


def test_nothing_that_is_given_raises_anything_else():
    odd = [None, NAN, 1, True, "a", b"a", 1j, {}, {"gnss": 1}, [], [[]], [[1], 2], {1}, object()]
    odd += [Hostile(), [Hostile()] * 2, int, len, np.ma.masked, pd.DataFrame(), pl.DataFrame()]
    odd += [np.zeros((0, 2)), np.datetime64("now"), pd.NA, [pd.NA], 10**400, Y, U, iter([1, 2])]
    odd += [FRAMES["pandas"], pd.Series(["a"]), np.zeros((5, 2), "V3"), [None, [1]], ["1", 2]]
    rng, found, errors = np.random.default_rng(0), built(SPEC), []
    for call, k in itertools.product((found.run, found.run_batch, found.step), range(400)):
        y, u, params = (odd[i] for i in rng.integers(len(odd), size=3))
        given = [(y, u, params), (Y, u, params), (y, U, None), (Y, U, {"dt": params})][k % 4]
        try:
            call(*given)
        except FkgenError as error:
            errors.append(str(error))
    assert len(errors) > 600
    assert not any("\n" in text or len(text) > 400 for text in errors)
