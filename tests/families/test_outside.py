"""A family from outside the package goes through every stage without an edit in it."""

from __future__ import annotations

import numpy as np
import pytest

import fkgen
from fkgen.proof.verify import verify

SPEC = """
name = "observed"
[model]
A = [[1.0, 0.1], [0.0, 0.95]]
C = [[1.0, 0.0]]
Q = [[1e-4, 0.0], [0.0, 1e-2]]
R = [[0.04]]
x0 = [0.5, 0.0]
P0 = [[1.0, 0.0], [0.0, 1.0]]
[filter]
family = "fixed_gain:FAMILY"
gain = [0.4, 0.7]
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("outside") / "observed.toml"
    path.write_text(SPEC, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def spec(path):
    return fkgen.load(path)


def test_its_options_are_its_own_and_are_written_back(spec):
    assert spec.filter.options.gain == (0.4, 0.7)
    assert spec.to_dict()["filter"] == {"family": "fixed_gain:FAMILY", "gain": [0.4, 0.7]}
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec


def test_it_is_checked_and_verified(spec):
    assert fkgen.check(spec).sound
    claims = verify(spec)
    assert any("observer written in matrices" in claim.claim for claim in claims)
    assert all(claim.holds for claim in claims)


def test_a_wrong_gain_is_caught(spec, monkeypatch):
    import fixed_gain

    right = fixed_gain.corrected
    monkeypatch.setattr(fixed_gain, "corrected", lambda p, s, K: right(p, s, 1.001 * K))
    with pytest.raises(fkgen.ValidationError, match="fixed_gain:FAMILY"):
        fkgen.validate(spec)


def test_its_c_code_names_it_and_runs(spec, tmp_path):
    source = fkgen.generate(fkgen.validate(spec))
    assert "fixed_gain:FAMILY" in source.files["observed.h"]
    y = np.random.default_rng(3).normal(size=(40, 1))
    y[7] = np.nan
    run = fkgen.build(spec).run(y)
    x = np.array([[0.5], [0.0]])
    A, K = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[0.4], [0.7]])
    for measured, filtered in zip(y, run.filtered_state, strict=True):
        if np.isfinite(measured).all():
            x = x + K * (measured - x[0])
        np.testing.assert_allclose(
            filtered, x.ravel(), rtol=1e-12, atol=1e-12
        )  # same few roundings
        x = A @ x


def test_it_is_compared_with_the_kalman_filter(spec):
    table = spec.to_dict() | {"filter": {"family": "kf"}}
    found = fkgen.compare([fkgen.Spec.from_dict(table), spec], runs=40, steps=60)
    assert found.row("fixed_gain:FAMILY").relative.value > found.row("kf").relative.value
    # The covariance of a fixed gain is that of its error, so the NEES is 1 within its own error.
    nees = found.row("fixed_gain:FAMILY").nees
    assert abs(nees.value - 1.0) < 4.0 * nees.error


@pytest.mark.parametrize(
    ("family", "given"),
    [
        ("no_such_module:FAMILY", "No module named 'no_such_module'"),
        ("fixed_gain:OTHER", "has no such name"),
        ("fixed_gain:NO_FAMILY", "is of type int"),
        ("fixed_gain:", "'fixed_gain:'"),
        (".fixed_gain:FAMILY", "'.fixed_gain:FAMILY'"),
    ],
)
def test_what_is_no_family_is_refused_in_one_line(spec, family, given):
    table = spec.to_dict() | {"filter": {"family": family}}
    with pytest.raises(fkgen.SpecError) as caught:
        fkgen.Spec.from_dict(table)
    assert caught.value.key == "filter.family"
    assert given in caught.value.given
    assert "module:NAME" in caught.value.expected
    assert "\n" not in str(caught.value)


def test_an_unknown_option_is_refused_with_those_of_the_family(spec):
    table = spec.to_dict()
    table["filter"]["gian"] = 1.0
    with pytest.raises(fkgen.SpecError, match="did you mean 'gain'"):
        fkgen.Spec.from_dict(table)


@pytest.mark.parametrize(("name", "canonical"), [("gpb1", "one_step"), ("mmae", "mme")])
def test_a_family_has_the_names_of_the_literature(name, canonical):
    import tomllib

    from fkgen.study.reports.starters import starter

    table = tomllib.loads(starter(name))
    table["filter"]["family"] = name
    assert fkgen.Spec.from_dict(table).filter.family == canonical
