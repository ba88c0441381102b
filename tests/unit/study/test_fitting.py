"""Parameters from records: what statsmodels and complex steps say of the same likelihoods."""

from __future__ import annotations

import copy
import json
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner
from complex_step import information, scores, terms
from scripts import EXAMPLES

import fkgen
from fkgen.cli import main
from fkgen.study.fitting.domain import Axis
from fkgen.study.fitting.likelihood import Likelihood, records_of
from fkgen.study.fitting.search import Surface

pytestmark = pytest.mark.compiled

NILE = EXAMPLES / "nile"

LEVEL = {
    "name": "level",
    "parameters": {"a": 1.0, "b": 1.0, "r": 1.0, "unused": 1.0},
    "model": {
        "A": [[1.0]],
        "C": [[1.0]],
        "Q": [["a*b"]],
        "R": [["r"]],
        "x0": [0.0],
        "P0": [[4.0]],
    },
    "filter": {"family": "kf"},
}
WALK = {
    "name": "walk",
    "parameters": {
        "a": 0.8,
        "c": {"default": 0.2, "max": 3.0},
        "q": 0.5,
        "r": {"default": 0.4, "min": 0.01},
        "p": 2.0,
        "m": [0.5, 0.1],
    },
    "model": {
        "A": [["a", 0.3], [0.0, "m_1"]],
        "C": [[1.0, "c"], [0.0, 1.0]],
        "Q": [["q", "0.2*q"], ["0.2*q", 1.0]],
        "R": [["r", 0.1], [0.1, 0.5]],
        "x0": ["m_0", 0.0],
        "P0": [["p", 0.0], [0.0, "r"]],
    },
    "filter": {"family": "kf"},
}
NAMES = ("a", "c", "q", "r", "p", "m_0", "m_1")
THETA = np.array([0.75, 0.3, 0.6, 0.35, 1.5, 0.4, 0.2])


def changed(table, **values):
    result = copy.deepcopy(table)
    for key, value in values.items():
        section, _, name = key.rpartition("__")
        result[section][name] = value
    return fkgen.Spec.from_dict(result)


def matrices(theta):
    """The matrices of WALK, by hand."""
    a, c, q, r, p, m_0, m_1 = theta
    zero = 0.0 * a
    return {
        "A": [[a, zero + 0.3], [zero, m_1]],
        "C": [[zero + 1.0, c], [zero, zero + 1.0]],
        "Q": [[q, 0.2 * q], [0.2 * q, zero + 1.0]],
        "R": [[r, zero + 0.1], [zero + 0.1, zero + 0.5]],
        "x0": [m_0, zero],
        "P0": [[p, zero], [zero, r]],
    }


@pytest.fixture(scope="module")
def walk():
    """Three records, of two lengths, some rows missing."""
    spec = fkgen.Spec.from_dict(WALK)
    y = fkgen.simulate(spec, 3, 80, 3).y
    y[np.random.default_rng(1).random(y.shape) < 0.15] = np.nan
    return spec, [y[0], y[1, :50], y[2, :50]]


@pytest.fixture(scope="module")
def nile():
    """The flows, and their fit."""
    y = np.genfromtxt(NILE / "record.csv", delimiter=",", names=True)["flow"]
    spec = fkgen.load(NILE / "spec.toml")
    return y, fkgen.fit(spec, y, estimate=("level_variance", "flow_variance"))


def test_the_nile_is_that_of_the_textbook(nile):
    """Durbin & Koopman 2012, sec. 2.10, and Commandeur & Koopman 2007 for the standard errors."""
    _, fit = nile
    assert fit.converged
    assert fit.message == "converged"
    assert fit.estimates["flow_variance"] == pytest.approx(15099.69, rel=2e-6)
    assert fit.estimates["level_variance"] == pytest.approx(1468.50, rel=1e-5)
    assert fit.standard_errors["flow_variance"] == pytest.approx(3146.0, rel=1e-4)
    assert fit.standard_errors["level_variance"] == pytest.approx(1280.2, rel=1e-4)
    assert fit.aic == 4.0 - 2.0 * fit.log_likelihood
    assert fit.bic == 2.0 * np.log(100) - 2.0 * fit.log_likelihood
    assert fit.spec.defaults == fit.estimates
    assert fit.spec.to_dict()["model"] == fkgen.load(NILE / "spec.toml").to_dict()["model"]


def test_statsmodels_has_the_same_likelihood_and_maximum(nile):
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    y, fit = nile
    model = structural.UnobservedComponents(y, "llevel")
    model.ssm.initialize_known(np.zeros(1), np.array([[1e7]]))
    model.ssm.loglikelihood_burn = 0
    judged = [fit.estimates[name] for name in ("flow_variance", "level_variance")]
    assert model.loglike(judged) == pytest.approx(fit.log_likelihood, rel=1e-8)
    for factor in (0.999, 1.001):  # no neighbour is better
        for at in range(2):
            other = list(judged)
            other[at] *= factor
            assert model.loglike(other) < fit.log_likelihood
    hessian = model._hessian_complex_step(np.array(judged), transformed=True)
    errors = np.sqrt(np.diag(np.linalg.inv(-len(y) * hessian)))
    told = [fit.standard_errors[name] for name in ("flow_variance", "level_variance")]
    np.testing.assert_allclose(told, errors, rtol=1e-4)
    profile = fit.profile("level_variance", points=9)
    for value, level in zip(profile.values[1:], profile.log_likelihood[1:], strict=True):
        over = np.linspace(0.5, 2.0, 400) * judged[0]
        assert max(model.loglike([each, value]) for each in over) == pytest.approx(level, abs=1e-4)


def test_intervals_end_where_the_profile_has_fallen(nile):
    _, fit = nile
    intervals, wider = fit.interval(0.95), fit.interval(0.99)
    for name, (low, high) in intervals.items():
        assert wider[name][0] < low < fit.estimates[name] < high < wider[name][1]
        curve = fit._curve(name)
        for end in (low, high):
            assert 2.0 * (fit.log_likelihood - curve.at(end)) == pytest.approx(3.841459, rel=1e-4)
        profile = fit.profile(name)
        assert profile.log_likelihood.max() == fit.log_likelihood
        assert profile.values[profile.log_likelihood.argmax()] == fit.estimates[name]
        assert (np.diff(profile.values) > 0.0).all()
        assert len(profile.values) == 21
        for end in (low, high):  # where straight lines between the values are, as they are drawn
            drawn = np.interp(end, profile.values, profile.log_likelihood)
            assert fit.log_likelihood - drawn == pytest.approx(0.5 * 3.841459, rel=0.03)


def test_differences_in_lanes_are_the_derivatives_of_complex_steps(walk):
    spec, records = walk
    built = fkgen.build(spec)
    given = records_of(built, (records, None, None), None, NAMES)
    likelihood = Likelihood(built, NAMES, given)
    found = np.concatenate([terms(matrices(THETA), y) for y in records])
    np.testing.assert_allclose(likelihood.samples([THETA])[0], found, rtol=1e-10)
    others = [THETA, 1.1 * THETA, 0.9 * THETA]
    totals = [sum(terms(matrices(theta), y).sum() for y in records) for theta in others]
    np.testing.assert_allclose(likelihood(others), totals, rtol=1e-10)
    begun = sum(terms(matrices(THETA), y[:10]).sum() for y in records)
    assert likelihood.first(30)([THETA])[0] == pytest.approx(begun, rel=1e-10)
    axes = tuple(
        Axis(name, value, -np.inf, np.inf) for name, value in zip(NAMES, THETA, strict=True)
    )
    point = Surface(likelihood, axes).point(np.ones(7), np.full(7, 2e-4))
    exact = np.concatenate([scores(matrices, THETA, y) for y in records])
    size = np.abs(THETA)
    np.testing.assert_allclose(point.gradient / size, exact.sum(axis=0), rtol=1e-6, atol=1e-6)
    by_sample = Surface(likelihood, axes).scores(point) / size
    np.testing.assert_allclose(by_sample, exact, rtol=1e-6, atol=1e-6)
    curved = sum(information(matrices, THETA, y) for y in records)
    np.testing.assert_allclose(
        point.information / np.outer(size, size), curved, rtol=1e-4, atol=1e-4
    )


def test_covariances_of_estimates_are_those_of_exact_derivatives(walk):
    """For kf the inverse information; for ekf, whose likelihood is approximate, the sandwich."""
    spec, records = walk
    names = ("a", "c", "q", "r", "m")
    fit = fkgen.fit(spec, records, estimate=names)
    assert fit.converged
    assert fit.names == ("a", "c", "q", "r", "m_0", "m_1")
    free = [NAMES.index(name) for name in fit.names]
    full = np.array([*list(fit.estimates.values())[:4], 2.0, *list(fit.estimates.values())[4:]])
    curved = sum(information(matrices, full, y) for y in records)[np.ix_(free, free)]
    slopes = np.concatenate([scores(matrices, full, y) for y in records])[:, free]
    inverse = np.linalg.inv(curved)
    assert np.abs(slopes.sum(axis=0) * np.sqrt(np.diag(inverse))).max() < 1e-3
    np.testing.assert_allclose(fit.covariance, inverse, rtol=2e-3, atol=1e-5)
    scale = np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
    np.testing.assert_allclose(fit.correlation, inverse / scale, atol=1e-3)
    other = fkgen.fit(changed(WALK, filter__family="ekf"), records, estimate=names)
    assert other.log_likelihood == pytest.approx(fit.log_likelihood, rel=1e-10)
    sandwich = inverse @ (slopes.T @ slopes) @ inverse
    np.testing.assert_allclose(other.covariance, sandwich, rtol=5e-3, atol=1e-5)
    widened = np.diag(sandwich) / np.diag(inverse)
    np.testing.assert_allclose(other.inflation, widened, rtol=1e-2)
    j = other.names.index("q")
    level = other._curve("q").at(other.interval()["q"][1])
    fallen = 2.0 * (other.log_likelihood - level) / widened[j]
    assert fallen == pytest.approx(3.8415, rel=2e-2)


def test_records_are_taken_in_every_form(walk):
    spec, records = walk
    y = np.stack(records[1:])
    both = fkgen.fit(spec, y, estimate=("a", "q"))
    apart = fkgen.fit(spec, [each.tolist() for each in y], estimate=("a", "q"))
    assert apart.log_likelihood == both.log_likelihood
    assert apart.estimates == both.estimates
    one = fkgen.fit(spec, np.concatenate([y[0], np.full((30, 2), np.nan)]), estimate="q")
    short = fkgen.fit(spec, y[0], estimate="q")
    assert one.log_likelihood == pytest.approx(short.log_likelihood, rel=1e-13)
    assert one.bic == pytest.approx(short.bic, rel=1e-13)  # it counts finite rows
    prior = {"x0": np.array([[1.0, 0.0], [0.0, 1.0]]), "P0": np.eye(2)}
    started = fkgen.fit(spec, list(y), estimate="q", start=prior)
    motor = fkgen.build(spec)
    runs = [
        motor.run(part, params=started.estimates, start={"x0": prior["x0"][m], "P0": prior["P0"]})
        for m, part in enumerate(y)
    ]
    total = sum(run.log_likelihood.sum() for run in runs)
    assert started.log_likelihood == pytest.approx(total, rel=1e-13)
    told = [{"a": 0.7}, {"a": np.linspace(0.7, 0.9, 50)}]
    varied = fkgen.fit(spec, list(y), params=told, estimate="q")
    runs = [
        motor.run(part, params={**own, **varied.estimates})
        for part, own in zip(y, told, strict=True)
    ]
    total = sum(run.log_likelihood.sum() for run in runs)
    assert varied.log_likelihood == pytest.approx(total, rel=1e-13)


@pytest.fixture(scope="module")
def level():
    """A level that wanders, and one that does not."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal(200)
    return np.cumsum(rng.standard_normal(200)) + noise, noise


def test_a_bound_is_the_estimate_and_the_interval_begins_there(level):
    _, still = level
    fit = fkgen.fit(fkgen.Spec.from_dict(LEVEL), still, estimate=("a", "r"))
    assert fit.estimates["a"] == 0.0
    assert "a is at its bound 0" in fit.message
    assert fit.converged
    low, high = fit.interval()["a"]
    assert low == 0.0
    assert 0.0 < high < 0.05
    curve = fit._curve("a")
    assert 2.0 * (fit.log_likelihood - curve.at(high)) == pytest.approx(3.8415, rel=1e-3)
    assert np.isfinite(fit.standard_errors["r"])
    assert np.isnan(fit.standard_errors["a"])
    large = fkgen.fit(fkgen.Spec.from_dict(LEVEL), 1e4 * still, estimate=("a", "r"))
    assert large.estimates["a"] == 0.0
    high = large.interval()["a"][1]
    assert high > 1e4
    fallen = 2.0 * (large.log_likelihood - large._curve("a").at(high))
    assert fallen == pytest.approx(3.8415, rel=1e-3)
    narrow = changed(LEVEL, parameters__r={"default": 2.0, "min": 1.5, "max": 4.0})
    fit = fkgen.fit(narrow, still, estimate=("a", "r"))
    assert fit.estimates["r"] == 1.5
    assert fit.interval()["r"][0] == 1.5
    assert "r is at its bound 1.5" in fit.message
    begun = changed(LEVEL, parameters__a=0.0)
    away = fkgen.fit(begun, level[0], estimate=("a", "r"))
    assert away.converged
    assert away.estimates["a"] > 0.5


def test_what_cannot_be_identified_is_named(level):
    fit = fkgen.fit(fkgen.Spec.from_dict(LEVEL), level[0], estimate=("a", "b", "r"))
    assert not fit.converged
    assert "a, b cannot be identified" in fit.message
    assert np.isinf([fit.standard_errors["a"], fit.standard_errors["b"]]).all()
    alone = fkgen.fit(fkgen.Spec.from_dict(LEVEL), level[0], estimate=("a", "r"))
    assert fit.log_likelihood == pytest.approx(alone.log_likelihood, rel=1e-9)
    assert fit.standard_errors["r"] < 10.0 * alone.standard_errors["r"]
    nothing = fkgen.fit(changed(LEVEL, parameters__b=0.0), level[0], estimate="a")
    assert not nothing.converged
    assert "a cannot be identified" in nothing.message


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"estimate": "q"}, "estimate: given 'q'; expected one of"),
        ({"estimate": ()}, "estimate: given no names"),
        ({"estimate": ("a", "a")}, "'a' twice"),
        ({"estimate": "unused"}, "'unused', which occurs nowhere"),
        ({"estimate": 3}, "estimate: given a value of type int"),
        ({"estimate": "a", "params": {"a": 2.0}}, "params.a: given a value"),
        ({"estimate": "a", "params": {"z": 2.0}}, "params.z: given an unknown name"),
        ({"estimate": ("a", "r"), "y": [1.0, np.nan, 2.0]}, "2 finite rows; expected more than 2"),
        ({"estimate": ("a", "r"), "y": [1.0]}, "1 finite row; expected more than 2"),
        ({"estimate": ("a", "r"), "y": []}, "0 finite rows; expected more than 2"),
        ({"estimate": "a", "y": [1.0, np.inf, 2.0]}, "given inf"),
        ({"estimate": ("a", "r"), "y": np.full(20, 3.0)}, "not finite near a = 0, r = 0, where"),
        ({"estimate": "a", "y": np.full(20, 1e200)}, "sample 0: the result would not be finite (a"),
        ({"estimate": "a", "y": [[[1.0], [2.0]], [[1.0, 3.0]]]}, "record 1: y: given shape (1, 2)"),
        ({"estimate": "a", "start": 3.0}, "start: given a value of type float"),
        ({"estimate": "a", "start": {"P0": [[-1.0]]}}, "P0: given"),
        ({"estimate": "a", "params": {"r": -1.0}}, "y: given sample 0"),
    ],
)
def test_bad_input_is_one_line(options, words):
    spec = fkgen.Spec.from_dict(LEVEL)
    given = {"y": np.zeros(20), **options}
    with pytest.raises(fkgen.UserError, match=r"^[^\n]*$") as caught:
        fkgen.fit(spec, **given)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"default": 1.0, "min": 2.0, "max": 1.0}, "a.min: given 2.0, above max = 1.0"),
        ({"default": 5.0, "min": 0.0, "max": 1.0}, "a.default: given 5.0; expected a default in"),
        ({"default": 1.0, "min": 1.0, "max": 1.0}, "'a', whose range is one number, 1"),
        (-1.0, "model.Q: given the variance -1"),
    ],
)
def test_a_range_that_holds_nothing_is_one_line(entry, words):
    with pytest.raises(fkgen.UserError, match=r"^[^\n]*$") as caught:
        fkgen.fit(changed(LEVEL, parameters__a=entry), np.zeros(20), estimate="a")
    assert words in str(caught.value)


def test_a_gate_has_no_likelihood():
    with pytest.raises(fkgen.SpecError, match=r"filter\.gate"):
        fkgen.fit(changed(LEVEL, filter__gate=0.999), np.zeros(20), estimate="a")


def test_rates_and_transitions_are_found_within_their_errors():
    actuator = fkgen.Spec.from_dict(
        {
            "name": "valve",
            "parameters": {"q": 0.1, "rate": 0.5},
            "model": {
                "A": [[0.9]],
                "B": [[0.5]],
                "C": [[1.0]],
                "Q": [["q"]],
                "R": [[0.01]],
                "x0": [0.0],
                "P0": [[1.0]],
            },
            "faults": {"actuator": {"success_rate": "rate"}},
            "filter": {"family": "mkf"},
            "code": {"scalar": "float"},
        }
    )
    true = {"q": 0.02, "rate": 0.7}
    u = np.where(np.arange(2000) // 20 % 2, 1.0, -1.0)[:, np.newaxis]
    y = fkgen.simulate(actuator, 1, 2000, 1, u, params=true).y[0]
    fit = fkgen.fit(actuator, y, u, estimate=("q", "rate"))
    for name, value in true.items():
        assert abs(fit.estimates[name] - value) < 4.0 * fit.standard_errors[name]
        low, high = fit.interval(0.9999)[name]
        assert low < value < high
        assert high - low < 12.0 * fit.standard_errors[name]
    assert fit.spec.code.scalar == "float"
    always = fkgen.simulate(actuator, 1, 400, 4, u[:400], params={"q": 0.02, "rate": 1.0}).y[0]
    fit = fkgen.fit(actuator, always, u[:400], estimate=("q", "rate"))
    assert fit.estimates["rate"] == 1.0
    assert "rate is at its bound 1" in fit.message
    assert fit.interval()["rate"][1] == 1.0


def test_the_command_keeps_comments_and_writes_all_of_it_or_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (NILE / "spec.toml").read_text(encoding="utf-8")
    text = text.replace("flow_variance = 10000.0 ", "flow_variance = {default = 1e4, min = 1} ")
    (tmp_path / "old.toml").write_text(text, encoding="utf-8")
    names = "level_variance,flow_variance"
    record = str(NILE / "record.csv")
    told = ["fit", "old.toml", record, "--estimate", names]
    done = CliRunner().invoke(main, [*told, "-o", "new.toml", "--plot", "fit.png"])
    assert done.exit_code == 0, done.output
    assert "15099.7" in done.stdout
    assert "converged" in done.stdout
    assert "year" in done.stderr
    assert "level_variance" not in done.stderr
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    before, after = text.splitlines(), (tmp_path / "new.toml").read_text("utf-8").splitlines()
    differing = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    assert len(differing) == 2
    assert all(a.partition("#")[2] == b.partition("#")[2] for a, b in differing)
    assert all(b.index("#") <= max(a.index("#"), len(b.split(" #")[0]) + 1) for a, b in differing)
    found = tomllib.loads("\n".join(after))["parameters"]
    as_json = CliRunner().invoke(main, [*told, "--json"])
    facts = json.loads(as_json.stdout)
    assert found["level_variance"] == facts["estimates"]["level_variance"]
    assert found["flow_variance"] == {"default": facts["estimates"]["flow_variance"], "min": 1}
    keys = {"estimates", "standard_errors", "covariance", "correlation", "log_likelihood"}
    keys |= {"aic", "bic", "converged", "message", "interval", "spec"}
    assert facts.keys() == keys
    several = CliRunner().invoke(main, [*told, record, "--json"])
    twice = json.loads(several.stdout)["log_likelihood"]
    assert twice == pytest.approx(2.0 * facts["log_likelihood"], rel=1e-9)
    for wrong, words in (
        (["-o", "new.toml"], "a file that exists"),
        (["--plot", "fit.doc"], "a picture that ends in"),
        (["--estimate", "z"], "estimate: given 'z'"),
    ):
        refused = CliRunner().invoke(main, [*told, *wrong])
        assert refused.exit_code == 2
        assert words in refused.stderr
        assert len(refused.stderr.strip().splitlines()) == 1


MOVING = {
    "name": "moving",
    "parameters": {"q": 1.0, "s": 1.0, "r": {"default": 1.0, "max": 50.0}},
    "model": {
        "A": [[0.95, 0.1], [0.0, 0.9]],
        "B": [[1.0], [0.0]],
        "C": [[1.0, 0.0], [0.3, 1.0]],
        "Q": [["q", "0.5*s"], ["0.5*s", "s"]],
        "R": [["r", 0.1], [0.1, 0.5]],
        "c": [0.2, 0.0],
        "x0": [0.0, 0.0],
        "P0": [[1.0, 0.0], [0.0, 1.0]],
    },
    "filter": {"family": "kf"},
}


def test_expected_autocovariances_are_those_of_responses_to_every_noise():
    """Innovations are linear in noises: the sum over responses to one impulse in each of them."""
    module = pytest.importorskip("fkgen.study.fitting.autocovariance")
    spec = fkgen.Spec.from_dict(MOVING)
    plant = module._Plant.of(spec, ("q", "s", "r"))
    built = fkgen.build(plant.observer("moving"))
    A, C, c, T, lags = np.array(MOVING["model"]["A"]), np.array(MOVING["model"]["C"]), 0.2, 400, 5
    Q, R = np.array([[0.5, 0.3], [0.3, 0.6]]), np.array([[2.0, 0.1], [0.1, 0.5]])
    still = np.zeros((T, 2))
    records = [still]
    for roots in (np.linalg.cholesky(Q).T, np.linalg.cholesky(R).T):
        for root in roots:
            x, rows = np.zeros(2), []
            for k in range(T):
                rows.append(C @ x + (root if k == 0 and len(records) > 2 else 0.0))
                x = A @ x + (root if k == 0 and len(records) <= 2 else 0.0)
            records.append(np.array(rows))
    run = built.run_batch(np.array(records), np.zeros((T, 1)), keep=["innovation"])
    responses = run.innovation[1:] - run.innovation[0]  # c, and the start, are in all of them
    assert np.abs(responses[:, -1]).max() < 1e-6 * c
    expected = plant.expected(Q, R, lags)
    for j in range(lags):
        found = np.einsum("mki,mkj->ij", responses[:, j:], responses[:, : T - j])
        np.testing.assert_allclose(found, expected[j], atol=1e-6)


def test_autocovariances_agree_with_the_likelihood(tmp_path, monkeypatch):
    pytest.importorskip("cvxpy")
    spec, true = fkgen.Spec.from_dict(MOVING), {"q": 0.5, "s": 0.3, "r": 2.0}
    u = np.sin(0.1 * np.arange(6000))[:, np.newaxis]
    y = fkgen.simulate(spec, 1, 6000, 2, u, params=true).y[0]
    other = fkgen.autocovariance(spec, y, u, estimate=tuple(true))
    fit = fkgen.fit(spec, y, u, estimate=tuple(true))
    for name, value in true.items():
        assert abs(other.estimates[name] - value) < 0.15 * value
        assert abs(other.estimates[name] - fit.estimates[name]) < 4.0 * fit.standard_errors[name]
    assert other.spec.defaults == other.estimates
    np.testing.assert_allclose(other.expected[0], other.autocovariance[0], atol=0.1)
    narrow = changed(MOVING, parameters__r={"default": 1.0, "max": 1.5})
    assert fkgen.autocovariance(narrow, y, u, estimate="r").estimates["r"] <= 1.5 + 1e-6
    for given, options, words in (
        (spec, {"estimate": ("q", "z")}, "given 'z'"),
        (spec, {"estimate": "q", "params": {"r": np.arange(3.0)}}, "params.r"),
        (changed(MOVING, model__A=[["q", 0.1], [0.0, 0.9]]), {"estimate": "q"}, "model.A"),
        (changed(MOVING, model__R=[["r**2", 0.1], [0.1, 0.5]]), {"estimate": "r"}, "not linear"),
        (
            changed(
                MOVING,
                model__Q=[[1.0, "0.5*s"], ["0.5*s", "s"]],
                model__R=[["(q + r)/2", 0.1], [0.1, 0.5]],
            ),
            {"estimate": ("q", "r")},
            "the same along a direction",
        ),
    ):
        with pytest.raises(fkgen.DataError, match=words):
            fkgen.autocovariance(given, y, u, **options)
    with pytest.raises(fkgen.DataError, match="missing rows"):
        fkgen.autocovariance(spec, np.full((100, 2), np.nan), u[:100], estimate="q")
