"""`code.decoupled`: parts of a state that nothing couples, against the filter of the whole."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
from plants import covariance
from toolchain import needs_compiler

import fkgen
from fkgen.errors import SpecError, StepRefused

pytestmark = needs_compiler()

T = 25
#: The same sums without terms that are 0, in another order where straight lines replace loops.
TOLERANCE = {"double": 1e-12, "float": 2e-5}


def scattered(blocks, order):
    """Blocks down a diagonal, with rows and columns in another order."""
    n = sum(len(each) for each in blocks)
    whole, at = np.zeros((n, n)), 0
    for each in blocks:
        whole[at : at + len(each), at : at + len(each)] = each
        at += len(each)
    return whole[np.ix_(order, order)]


@cache
def linear(parts=(2, 3, 1), seed=3):
    """Parts of several sizes, their states and rows in disorder, each with a row of its own."""
    rng = np.random.default_rng(seed)
    n, p = sum(parts), len(parts)
    order, owner = rng.permutation(n), np.repeat(np.arange(p), parts)
    model = {
        "A": scattered([0.5 * rng.standard_normal((m, m)) for m in parts], order),
        "Q": scattered([covariance(rng, m) for m in parts], order),
        "P0": scattered([covariance(rng, m) for m in parts], order),
        "C": np.where(owner[order] == np.arange(p)[:, None], rng.standard_normal((p, n)), 0.0),
        "R": np.diag(0.5 + rng.random(p)),
        "B": np.eye(n)[:, :2],
    }
    return {name: value.tolist() for name, value in model.items()} | {"x0": [0.1] * n}


def nonlinear():
    """Two pendulums that do not know of each other, the angle of each measured by its sine."""
    states = [{"name": name} for name in ("a", "va", "b", "vb")]
    motion = {axis: f"{axis} + 0.1*v{axis}" for axis in "ab"} | {
        f"v{axis}": f"0.95*v{axis} - 0.1*sin({axis})" for axis in "ab"
    }
    return {
        "states": states,
        "outputs": [{"name": "ya"}, {"name": "yb"}],
        "f": motion,
        "h": {"ya": "sin(a)", "yb": "sin(b)"},
        "Q": (0.01 * np.eye(4)).tolist(),
        "R": (0.1 * np.eye(2)).tolist(),
        "x0": [0.3, 0.0, -0.2, 0.1],
        "P0": np.eye(4).tolist(),
    }


ACTUATOR = {"actuator": {"success_rate": [0.9, 0.7], "dependence": "independent"}}
CASES = {
    "kf": (linear, {}),
    "mkf": (linear, ACTUATOR),
    "ekf": (nonlinear, {}),
    "joseph": (linear, {}),
    "gate": (linear, {}),
}


def spec(case, *, decoupled, scalar="double", **changes):
    """A spec of this case."""
    plant, faults = CASES[case]
    family = case if case in {"mkf", "ekf"} else "kf"
    code = {"scalar": scalar, "decoupled": decoupled}
    code |= {"update": "joseph"} if case == "joseph" else {}
    options = {"family": family} | ({"gate": 0.99} if case == "gate" else {})
    table = {"name": "parts", "model": plant() | changes, "filter": options, "code": code}
    return fkgen.Spec.from_dict(table | ({"faults": faults} if faults else {}))


def operations(of):
    """What the header says of a step."""
    header = fkgen.generate(fkgen.validate(of)).files["parts.h"]
    return int(re.search(r"every row present: ([\d,]+) floating", header)[1].replace(",", ""))


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("case", CASES)
def test_the_filter_is_that_of_the_whole_state(case, scalar):
    rng = np.random.default_rng(8)
    specs = [spec(case, decoupled=d, scalar=scalar) for d in (False, True)]
    whole, parts = map(fkgen.build, specs)
    p, q = specs[0].model.ny, specs[0].model.nu
    y = rng.standard_normal((T, p)) * 2.0
    y[rng.random((T, p)) < 0.2] = np.nan
    u = rng.standard_normal((T, q)) if q else None
    one, other = (each.run(y, u) for each in (whole, parts))
    for name in ("filtered_state", "filtered_covariance", "predicted_covariance", "nis"):
        expected, found = getattr(one, name), getattr(other, name)
        scale = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE[scalar] * scale)


def alone(m):
    """One part of m states."""
    rng = np.random.default_rng(m)
    model = {
        "A": rng.standard_normal((m, m)).tolist(),
        "C": rng.standard_normal((1, m)).tolist(),
        "Q": covariance(rng, m).tolist(),
        "R": [[1.0]],
        "x0": [0.0] * m,
        "P0": covariance(rng, m).tolist(),
    }
    return fkgen.Spec.from_dict({"name": "parts", "model": model, "filter": {"family": "kf"}})


@pytest.mark.parametrize("parts", [(2, 3, 1), (2,) * 16])
def test_a_step_costs_what_its_parts_cost(parts):
    together = sum(operations(alone(m)) for m in parts)
    table = {"name": "parts", "model": linear(parts, seed=1), "filter": {"family": "kf"}}
    apart = fkgen.Spec.from_dict(table | {"code": {"decoupled": True}})
    # Only parts of up to three states fold products with constants; sums over rows come on top.
    assert operations(apart) <= 1.25 * together + 10 * len(parts)
    assert operations(fkgen.Spec.from_dict(table)) > 1.5 * operations(apart)


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_a_prior_that_couples_parts_is_refused(scalar):
    built = fkgen.build(spec("kf", decoupled=True, scalar=scalar))
    before = built.step(np.ones(3), np.zeros(2))
    coupled = np.array(linear()["P0"])
    i, j = next((i, j) for i in range(6) for j in range(i) if coupled[i, j] == 0.0)
    coupled[i, j] = coupled[j, i] = 1e-3
    with pytest.raises(StepRefused, match=r"code\.decoupled"):
        built.reset(P0=coupled)
    after = built.step(np.ones(3), np.zeros(2))
    assert not np.array_equal(before.filtered_state, after.filtered_state)  # it went on
    built.reset(P0=2.0 * np.array(linear()["P0"]))


@pytest.mark.parametrize("letter", ["A", "Q", "P0", "C", "R"])
def test_one_entry_couples_two_parts(letter):
    plain = operations(spec("kf", decoupled=True))
    matrix = np.array(linear()[letter])
    free = [(i, j) for i, j in zip(*np.nonzero(matrix == 0.0), strict=True)]
    i, j = free[0]
    matrix[i, j] = 0.05
    if letter in "QRP0":
        matrix[j, i] = 0.05
    changes = {letter: matrix.tolist()}
    tied = spec("kf", decoupled=True, **changes)
    assert operations(tied) > plain
    y = np.random.default_rng(2).standard_normal((T, 3))
    one, other = (
        fkgen.build(each).run(y, np.zeros((T, 2)))
        for each in (tied, spec("kf", decoupled=False, **changes))
    )
    np.testing.assert_allclose(one.filtered_covariance, other.filtered_covariance, atol=1e-12)


def test_an_input_that_is_random_couples_what_it_moves():
    B = np.ones((6, 1)).tolist()
    faults = {"actuator": {"success_rate": 0.8}}
    table = {"name": "parts", "model": linear() | {"B": B}, "filter": {"family": "mkf"}}
    with pytest.raises(SpecError, match="coupled as a whole"):
        fkgen.validate(
            fkgen.Spec.from_dict(table | {"faults": faults, "code": {"decoupled": True}})
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"filter": {"family": "ukf"}}, "family ukf"),
        ({"filter": {"family": "kf", "gain": "stationary"}}, "not stationary"),
        ({"filter": {"family": "kf", "lag": 2}}, "one of the two"),
        ({"code": {"decoupled": True, "form": "loops"}}, "straight"),
        ({"code": {"decoupled": 3}}, "decoupled"),
    ],
)
def test_where_it_cannot_be_the_spec_is_refused(change, message):
    table = {
        "name": "parts",
        "model": linear(),
        "filter": {"family": "kf"},
        "code": {"decoupled": True},
    }
    with pytest.raises(SpecError, match=message):
        fkgen.Spec.from_dict(table | change)
