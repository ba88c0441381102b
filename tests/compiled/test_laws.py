"""Laws of faults that depend on parameters: as numbers in their place, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
from laws import ARRIVALS, JUMP, MODEL, MODES, RATE, SENSOR, ports_of, record, spec
from plants import assert_agree, built
from scipy.stats import norm
from toolchain import needs_compiler

import fkgen
from fkgen.errors import DataError, SpecError
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw

pytestmark = needs_compiler()


def sensor(family, number):
    laws = SENSOR[number]
    factors = ("p*5", 4.0)
    return [
        (family, {"sensor": {"noise_factor": f, **law}})
        for f, law in zip(factors, laws, strict=True)
    ]


def jump(family, *more, **options):
    found = []
    for at, law in enumerate(JUMP):
        table = {"modes": MODES, "initial": [0.5, 0.3, 0.2], **law}
        for each in more:
            table |= each[at]
        found.append((family, {"jump": table}, options))
    return found


#: The second one has the first state alone.
UNEQUAL = [{}, {"states": [0], "A": [[0.9]]}]
CASES = {
    **{f"{f} {n}": sensor(f, n) for f in ("one_step", "imm", "linear_optimal") for n in SENSOR},
    "imm jump": jump("imm"),
    "imm unequal": [
        ("imm", {"jump": {"modes": UNEQUAL, "initial": [0.6, 0.4], "transition": P}}, {})
        for P in ([["p", "1 - p"], ["q", "1 - q"]], [[0.8, 0.2], [0.1, 0.9]])
    ],
    "mjls": jump("mjls_lmmse"),
    "mjls rate": jump("mjls_lmmse", RATE),
    "mjls chain": jump("mjls_lmmse", ({"arrival_chain": [[0.4, 0.6], [0.1, 0.9]]},) * 2),
    "mjls arrivals": jump("mjls_lmmse", ARRIVALS),
    "mjls llr": jump("mjls_lmmse", RATE, detector="llr"),
}


@pytest.mark.parametrize("name", list(CASES))
def test_a_law_with_parameters_is_the_law_with_numbers(name):
    given, numbers = CASES[name]
    varying = spec(*given, p=0.7, q=0.05)
    assert fkgen.Spec.from_dict(varying.to_dict()) == varying
    expected = built(spec(*numbers)).run(record())
    found = built(varying).run(record(), params={"p": 0.8, "q": 0.1})
    np.testing.assert_array_equal(found.status, expected.status)
    assert_agree(found, expected, ports_of(expected), 1e-12)  # some roundings of 1 - p


@pytest.mark.parametrize("name", list(CASES))
def test_a_law_that_is_none_is_refused(name):
    filtering = built(spec(*CASES[name][0], p=0.7, q=0.05))
    p, q = np.full(14, 0.7), np.full(14, 0.05)
    p[3], p[8], q[10] = 1.001, -0.001, -0.001
    wrong = filtering.run(record(), params={"p": p, "q": q}).status < 0
    assert np.flatnonzero(wrong).tolist() == [3, 8, 10]
    assert (filtering.run(record(), params={"p": p, "q": q}).status[wrong] == -4).all()


def test_float_has_the_same_laws():
    given, numbers = CASES["imm 4"]
    expected = built(spec(*numbers)).run(record())
    found = built(spec(*given, scalar="float", p=0.7, q=0.05)).run(
        record(), params={"p": 0.8, "q": 0.1}
    )
    assert_agree(found, expected, ["filtered_state", "mode_probability"], 1e-5)


SCALAR = {"A": [[0.9]], "C": [[1.0]], "Q": [[0.3]], "R": [[0.2]], "x0": [1.0], "P0": [[0.8]]}


def posterior(law, x, P, y, factor):
    """Bayes' rule for the four conditions of a scalar sensor."""
    gamma, delta = np.array([1, 1, 0, 0]), np.array([1, factor, 1, factor])
    density = norm.pdf(y, gamma * x, np.sqrt(gamma * P + 0.2 * delta))
    return law * density / (law @ density)


@pytest.mark.parametrize("family", ["one_step", "imm"])
def test_a_rate_is_that_of_its_own_sample_and_a_kernel_that_of_the_step_to_the_next(family):
    y, p, c = [[0.3], [1.4]], np.array([0.9, 0.2]), np.array([3.0, 9.0])
    fault = {"problem": 1, "gamma_rate": "p", "delta_nominal_rate": 0.75, "noise_factor": "c"}
    own = built(spec(family, {"sensor": fault}, model=SCALAR, p=0.5, c=4.0))
    found = own.run(y, params={"p": p, "c": c})
    first = posterior(np.kron([p[0], 1 - p[0]], [0.75, 0.25]), 1.0, 0.8, 0.3, c[0])
    np.testing.assert_allclose(found.mode_probability[0], first, rtol=1e-12)
    gamma, delta = np.array([1, 1, 0, 0]), np.array([1, c[0], 1, c[0]])
    said = norm.logpdf(0.3, gamma * 1.0, np.sqrt(gamma * 0.8 + 0.2 * delta))
    np.testing.assert_allclose(found.mode_evidence[0], said, rtol=1e-12)
    # Sample 1 has one Gaussian before it, for the modes say nothing about each other.
    x, P = found.predicted_state[0, 0], found.predicted_covariance[0, 0, 0]
    second = posterior(np.kron([p[1], 1 - p[1]], [0.75, 0.25]), x, P, 1.4, c[1])
    np.testing.assert_allclose(found.mode_probability[1], second, rtol=1e-12)

    kernel = [["p", "1 - p", 0.0, 0.0], *([0.25] * 4 for _ in range(3))]
    fault = {"problem": 4, "kernel": kernel, "initial": [1.0, 0.0, 0.0, 0.0], "noise_factor": "c"}
    chain = built(spec(family, {"sensor": fault}, model=SCALAR, p=0.5, c=4.0))
    found = chain.run(y, params={"p": p, "c": c})
    law = np.array([p[0], 1.0 - p[0], 0.0, 0.0])
    np.testing.assert_allclose(found.predicted_mode_probability[0], law, rtol=1e-12)
    x, P = found.predicted_state[0, 0], found.predicted_covariance[0, 0, 0]
    second = posterior(law, x, P, 1.4, c[1])
    np.testing.assert_allclose(found.mode_probability[1], second, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize("family", ["linear_optimal", "mjls_lmmse"])
def test_rates_of_linear_filters_are_those_of_their_own_sample(family):
    p = np.array([0.9, 0.2, 1.0, 0.0, 0.6])
    faults = {"jump": {"transition": [[1.0]], "modes": [{}], "arrival_rate": "p"}}
    if family == "linear_optimal":
        faults = {"sensor": {"problem": 1, "gamma_rate": "p"}}
    y = np.array([0.5, -0.4, 1.1, 0.3, 0.8])
    found = built(spec(family, faults, model=SCALAR, p=0.5)).run(y[:, None], params={"p": p})
    x, P, second = 1.0, 0.8, 1.8  # Nahi 1969 with one state: E[x^2] beside the error variance
    for k, rate in enumerate(p):
        gain = rate * P / (rate**2 * P + rate * (1.0 - rate) * second + 0.2)
        x, P = x + gain * (y[k] - rate * x), P - gain * rate * P
        assert found.filtered_state[k, 0] == pytest.approx(x, rel=1e-12)
        assert found.filtered_covariance[k, 0, 0] == pytest.approx(P, rel=1e-12)
        x, P, second = 0.9 * x, 0.81 * P + 0.3, 0.81 * second + 0.3


def test_the_noise_factor_of_a_genie_may_change_with_the_sample():
    faults = {"sensor": {"noise_factor": "exp(c)"}}
    genie = built(spec("genie", faults, model=SCALAR, c=1.0))
    c = np.array([0.5, 1.5, 1.0])
    told = {"gamma": np.array([1.0, 1.0, 0.0]), "delta": np.array([np.exp(0.5), np.exp(1.5), 1.0])}
    S = genie.run([[1.0]] * 3, params={"c": c} | told).innovation_covariance[:, 0, 0]
    assert S[0] == pytest.approx(0.8 + 0.2 * np.exp(0.5))
    assert S[2] == pytest.approx(0.2)
    wrong = told | {"delta": np.array([np.exp(0.5), np.exp(1.0), 1.0])}
    assert genie.run([[1.0]] * 3, params={"c": c} | wrong).status.tolist() == [0, -4, 0]


@pytest.mark.parametrize("name", ["imm 1", "imm 4", "mjls rate"])
def test_trials_are_drawn_with_the_law_of_the_parameters(name):
    given, numbers = CASES[name]
    varying = spec(*given, p=0.7, q=0.05)
    expected = fkgen.simulate(spec(*numbers), 3, 50, seed=5)
    found = fkgen.simulate(varying, 3, 50, seed=5, params={"p": 0.8, "q": 0.1})
    np.testing.assert_allclose(found.y, expected.y, rtol=1e-12)
    steady = {"p": np.full(50, 0.8), "q": np.full(50, 0.1)}
    same = fkgen.simulate(varying, 3, 50, seed=5, params=steady)
    np.testing.assert_array_equal(same.y, found.y)
    with pytest.raises(DataError, match=r"params: given out of range.* at sample 1 of trial 0"):
        fkgen.simulate(varying, 3, 2, params={"p": [0.7, 1.2]})
    with pytest.raises(DataError, match=r"params: given p = 1.2, q = 0.05; expected values with"):
        fkgen.simulate(varying, 3, 2, params={"p": 1.2})


REFUSED = {
    "mixed modes": (sensor("imm", "4")[0], {"modes": 3}, "filter.modes", "4: what three"),
    "augmented": (sensor("linear_optimal", "4")[0], {"form": "augmented"}, "filter.form", "lemma2"),
    "stationary": (jump("mjls_lmmse")[0][:2], {"gain": "stationary"}, "filter.gain", "numbers"),
}


@pytest.mark.parametrize("name", list(REFUSED))
def test_what_has_no_meaning_with_parameters_is_refused(name):
    faults, options, key, expected = REFUSED[name]
    with pytest.raises(SpecError) as caught:
        spec(*faults, options, p=0.7, q=0.05)
    assert caught.value.key == key
    assert expected in caught.value.expected


@pytest.mark.parametrize("name", ["imm 1", "imm 2", "imm 3", "imm 4", "imm jump"])
def test_two_updates_with_laws_of_the_sample_are_one_with_both_rows(name):
    model = MODEL | {"R": [[0.5, 0.0], [0.0, 0.3]]}
    family, faults, *options = CASES[name][0]
    filtering = built(spec(family, faults, *options, model=model, p=0.7, q=0.05))
    y, p, q = record(), 0.7 + 0.1 * np.sin(np.arange(14)), np.full(14, 0.08)
    y[4:7] = [[0.4, -1.0], [1.5, 0.2], [-2.0, 0.7]]
    whole = filtering.run(y, params={"p": p, "q": q})
    filtering.reset(params={"p": p[0], "q": q[0]})
    for k in range(14):
        now = {"p": p[k], "q": q[k]}
        first = filtering.update([y[k, 0], np.nan], params=now)
        found = filtering.update([np.nan, y[k, 1]], params=now)
        for port in ("filtered_state", "filtered_covariance", "mode_probability"):
            np.testing.assert_allclose(found[port], whole[port][k], rtol=1e-11, atol=1e-13)
        if "mode_evidence" in filtering.ports:
            evidence = whole.mode_evidence[k]
            np.testing.assert_allclose(found.mode_evidence, evidence, rtol=1e-10, atol=1e-10)
        added = first.log_likelihood + found.log_likelihood
        np.testing.assert_allclose(added, whole.log_likelihood[k], rtol=1e-10, atol=1e-10)
        filtering.predict(params=now)


def test_a_mean_that_an_offset_moves_starts_at_x0():
    y, gamma, c = np.array([0.5, -0.4, 1.1]), 0.7, 0.5
    model = SCALAR | {"x0": [3.0], "c": [c]}
    fault = {"sensor": {"problem": 1, "gamma_rate": gamma}}
    found = built(spec("linear_optimal", fault, model=model)).run(y[:, None])
    x, P, mean, second = 3.0, 0.8, 3.0, 9.8  # Nahi 1969, with E[x] for E[x^2] of the next sample
    for k in range(3):
        gain = gamma * P / (gamma**2 * P + gamma * (1.0 - gamma) * second + 0.2)
        x, P = x + gain * (y[k] - gamma * x), P - gain * gamma * P
        assert found.filtered_state[k, 0] == pytest.approx(x, rel=1e-12)
        x, P = 0.9 * x + c, 0.81 * P + 0.3
        second = 0.81 * second + 2.0 * 0.9 * mean * c + c**2 + 0.3
        mean = 0.9 * mean + c


DRAWN = {
    "one_step 1": {"p": [0.9, 0.2, 0.6, 1.0, 0.05, 0.5], "q": 0.1},
    "imm 2": {"p": [0.8, 0.3, 0.5, 0.7, 0.2, 0.85], "q": [0.1, 0.2, 0.0, 0.15, 0.1, 0.05]},
    "imm 3": {"p": [0.9, 0.2, 0.6, 1.0, 0.1, 0.5], "q": [0.1, 0.8, 0.0, 1.0, 0.3, 0.5]},
    "imm 4": {"p": [0.9, 0.2, 0.6, 0.8, 0.1, 0.5], "q": [0.1, 0.02, 0.0, 0.05, 0.03, 0.1]},
    "imm jump": {"p": [0.9, 0.2, 0.6, 1.0, 0.0, 0.5], "q": [0.1, 0.3, 0.0, 0.2, 0.3, 0.1]},
    "imm unequal": {"p": [0.9, 0.2, 0.6, 1.0, 0.0, 0.5], "q": [0.1, 0.3, 0.0, 0.2, 0.3, 0.1]},
    "mjls rate": {"p": [0.9, 0.2, 0.6, 1.0, 0.0, 0.5], "q": 0.1},
    "mjls arrivals": {"p": [0.9, 0.2, 0.6, 1.0, 0.0, 0.5], "q": [0.1, 0.3, 0.0, 0.2, 0.3, 0.1]},
}


@pytest.mark.parametrize("name", list(DRAWN))
def test_trials_follow_the_law_of_every_sample(name):
    plant, params = spec(*CASES[name][0], p=0.7, q=0.05), DRAWN[name]
    runs, T = 40_000, 6
    found = fkgen.simulate(plant, runs, T, seed=3, params=params)
    arrays = {key: np.broadcast_to(value, T) for key, value in params.items()}
    if plant.faults.jump is None:
        law = SensorLaw.over(plant, T, arrays)
        steps, expected = law.steps(T), [law.initial]
        np.testing.assert_allclose(np.unique(found.delta[:, 2]), sorted({1.0, 5 * arrays["p"][2]}))
        noise = found.y - found.gamma[..., None] * (found.state @ np.array(MODEL["C"]).T)
        share = (noise**2 / np.diag(MODEL["R"]) / found.delta[..., None]).mean(axis=(0, 2))
        np.testing.assert_allclose(share, 1.0, atol=0.04)  # of chi-square: 8 deviations
    else:
        system = JumpSystem.from_spec(plant, T, arrays)
        steps, expected = system.transitions, [system.initial]
        arriving = [system.arrival_initial]
        for P in system.channel[:-1]:
            arriving.append(arriving[-1] @ P)
        if found.arrival is not None:
            rate = found.arrival.mean(axis=0)
            np.testing.assert_allclose(rate, np.array(arriving)[:, 1], atol=0.015)
    for P in steps[:-1]:
        expected.append(expected[-1] @ P)
    shares = (found.mode[..., None] == np.arange(len(expected[0]))).mean(axis=0)
    np.testing.assert_allclose(shares, expected, atol=0.015)  # 6 deviations of 40,000 trials
    assert not shares[np.array(expected) < 1e-15].any()
    for k in range(T - 1):  # pairs: which sample a step has its parameters from
        for i in range(len(expected[0])):
            of = found.mode[:, k] == i
            if of.sum() > 2000:
                ahead = (found.mode[of, k + 1][:, None] == np.arange(len(expected[0]))).mean(axis=0)
                np.testing.assert_allclose(ahead, steps[k][i], atol=3.0 / np.sqrt(of.sum()))


def test_a_rate_that_is_certain_at_the_default_is_one_at_run_time():
    faults = {"jump": {"transition": [[1.0]], "modes": [{}], "arrival_rate": "p"}}
    rates = {"p": 0.5}
    half, whole = (built(spec("mjls_lmmse", faults, model=SCALAR, p=p)) for p in (0.5, 1.0))
    expected, found = (each.run([[0.5], [1.0]], params=rates) for each in (half, whole))
    np.testing.assert_array_equal(found.filtered_state, expected.filtered_state)
