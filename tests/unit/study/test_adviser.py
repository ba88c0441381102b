"""What a check says about the decay of effects, about what can be seen, and about float."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from effect_plants import paper
from plants import common, motor, random_model, spec

import fkgen
from fkgen.backend.ir import Operator
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.oracle.textbook.fault_effect import gains
from fkgen.problem import Code
from fkgen.profiles import pulse
from fkgen.study.diagnostics.digits import ARITHMETIC, Bounded, usual_range
from fkgen.study.diagnostics.subject import Subject


def finding(report, code):
    return next(f for f in report.findings if f.code == code)


def codes(report):
    return {f.code for f in report.findings}


# ------------------------------------------------------------------- decay: Theorem 1 is not true


def alternating():
    """An optimal filter in which every rho(M[k]) < 1 and the effect of a pulse grows for ever."""
    model = {
        "A": [[0.5, "a", 0.3], ["2 - a", 0.5, 0.0], [0.0, 0.0, 0.9]],
        "C": [[0.0, 0.0, 1.0]],
        "Q": 0.1 * np.eye(3),
        "R": [[0.5]],
        "x0": [0.0, 0.0, 0.0],
        "P0": np.eye(3),
    }
    return spec(model, parameters={"a": 0.0}), {"a": np.tile([2.0, 0.0], 21)[:41]}


def test_every_radius_below_one_does_not_keep_the_effect_of_a_pulse_from_growing():
    plant, params = alternating()
    found = gains(LinearSystem.from_spec(plant, 41, params))
    radii = np.abs(np.linalg.eigvals(found.M)).max(axis=1)
    assert radii.max() == pytest.approx(0.62, abs=0.01)
    effect = fkgen.fault_effect(plant, pulse(41, 3, 1.0), params=params)
    assert np.abs(effect.state_deviation[3]).max() < 1.0
    assert 1e11 < np.abs(effect.state_deviation[40]).max() < 1e12


def test_a_check_does_not_call_that_filter_stable():
    report = fkgen.check(alternating()[0])
    text = " ".join(f.message for f in report.findings)
    assert "error_decay" not in codes(report)
    found = finding(report, "error_decay_unproved")
    assert "only certain that the effect, measured by P(k|k), never grows" in found.message
    assert "would prove nothing more" in found.message
    assert "stable" not in text.replace("unstable", "")


def test_a_product_of_numbers_below_one_need_not_vanish():
    still = {"A": [[1.0]], "C": [["c"]], "Q": [[0.0]], "R": [[1.0]], "x0": [0.0], "P0": [[1.0]]}
    T = 4000
    plant, params = spec(still, parameters={"c": 1.0}), {"c": 1.0 / np.arange(1.0, T + 1.0)}
    effect = fkgen.fault_effect(plant, pulse(T, 0, 1.0), params=params).state_deviation[:, 0]
    # P0 -> P(0|0) halves it; from there on the product is that of all samples but the first.
    assert 0.5 * effect[-1] / effect[0] == pytest.approx(1.0 / (1.0 + np.pi**2 / 6.0), rel=2e-4)
    assert "error_decay" not in codes(fkgen.check(plant))


def test_constant_data_that_come_to_rest_are_condition_c():
    report = fkgen.check(paper("A"))
    found = finding(report, "error_decay")
    assert "rho(M) = 0.913677674 < 1 (condition c)" in found.message
    assert found.value == report.values["closed_loop_radius"]
    assert report.values["closed_loop_norm"] == pytest.approx(1.076, abs=5e-4)
    assert "may have grown at first" in found.message
    assert report.values["filtered_gain.x0.y1"] == pytest.approx(-2.359148, abs=1e-6)


def test_without_rest_or_with_inputs_that_may_fail_only_e_is_left():
    asleep = random_model(1, 2, 1) | {"A": [[1.0, 0.0], [0.0, 0.5]], "Q": [[0.0, 0.0], [0.0, 1.0]]}
    assert (
        "does not come to rest"
        in finding(fkgen.check(spec(asleep)), "error_decay_unproved").message
    )
    failing = fkgen.check(spec(random_model(2, 2, 1, 1), family="mkf", actuator=common(0.5)))
    assert "the gain changes with u" in finding(failing, "error_decay_unproved").message
    assert "error_decay_unknown" in codes(fkgen.check(motor("mme")))


# -------------------------------------------------------------------------------------- visibility


def test_what_n_samples_tell_of_a_state_is_in_its_unit():
    model = random_model(3, 3, 2, correlated=True)
    values = fkgen.check(spec(model)).values
    A, C, R = (np.array(model[letter]) for letter in "ACR")
    W = sum(
        np.linalg.matrix_power(A, k).T @ C.T @ np.linalg.solve(R, C @ np.linalg.matrix_power(A, k))
        for k in range(3)
    )
    expected = np.sqrt(np.diag(np.linalg.inv(W)))
    found = [values[f"observation_sd.x{i}"] for i in range(3)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    scaled = model | {
        "A": (A * np.outer([1, 1e4, 1], [1, 1e-4, 1])).tolist(),
        "C": (C * [1, 1e-4, 1]).tolist(),
    }
    again = fkgen.check(spec(scaled)).values["observation_sd.x1"]
    assert again == pytest.approx(1e4 * expected[1], rel=1e-9)


def test_a_hidden_state_is_told_by_no_number_of_samples():
    values = fkgen.check(paper("B")).values
    assert values["observation_sd.x0"] == np.inf
    assert np.isfinite(values["observation_sd.x1"])


def test_biases_are_those_of_detectability():
    plant = paper("A")
    values = fkgen.check(plant).values
    for name in ("y0", "y1"):
        found = fkgen.detectability(plant, name, window=1)
        assert values[f"detectable_bias.{name}"] == pytest.approx(found.glr, rel=1e-9)
        share = np.sqrt(found.plateau / found.information[0])
        assert values[f"visible_share.{name}"] == pytest.approx(share, rel=1e-9)


def test_a_bias_that_an_integrator_takes_in_is_named():
    track = random_model(4, 2, 1) | {"A": [[1.0, 1.0], [0.0, 1.0]], "C": [[1.0, 0.0]]}
    report = fkgen.check(spec(track))
    assert finding(report, "unseen_bias").message.startswith("a lasting bias of y0 cannot be seen")
    assert report.values["visible_share.y0"] < 1e-9
    assert "unseen_bias" not in codes(fkgen.check(paper("A")))


def test_sensors_that_err_together_are_named_with_their_ratio():
    twice = random_model(4, 2, 2) | {
        "A": [[1.0, 1.0], [0.0, 0.9]],
        "C": [[1.0, 0.0], [1000.0, 0.0]],
        "R": [[1.0, 0.0], [0.0, 4e6]],
    }
    report = fkgen.check(spec(twice))
    assert "unseen_bias" not in codes(report)
    assert report.values["unseen_bias_directions"] == 1
    assert "y0 and y1 together (in the ratio 1 : 1e+03)" in finding(report, "unseen_biases").message
    effect = fkgen.fault_effect(spec(twice), np.tile([1.0, 1000.0], (400, 1)))
    assert effect.noncentrality[-1] < 1e-12
    assert fkgen.check(paper("A")).values["unseen_bias_directions"] == 0


def test_an_input_that_reaches_no_measurement_is_named():
    model = random_model(5, 2, 1, 1) | {"A": [[0.5, 0.0], [0.1, 0.5]], "C": [[1.0, 0.0]]}
    hidden = model | {"B": [[0.0], [1.0]]}
    assert finding(fkgen.check(spec(hidden)), "unseen_input").severity == "warning"
    seen = model | {"B": [[1.0], [0.0]]}
    assert "unseen_input" not in codes(fkgen.check(spec(seen)))


# ------------------------------------------------------------------------------- rounding of float

OPERATIONS = {
    Operator.ADD: lambda a, b: a + b,
    Operator.SUB: lambda a, b: a - b,
    Operator.MUL: lambda a, b: a * b,
    Operator.DIV: lambda a, b: a / b,
}


def test_bounds_hold_for_random_expressions_in_exact_arithmetic():
    rng = np.random.default_rng(1)
    used = []
    for _ in range(200):
        exact = [Fraction(float(v)) for v in rng.standard_normal(4)]
        single = [np.float32(float(v)) for v in exact]
        bounded = [Bounded.stored(float(v)) for v in exact]
        for _ in range(12):
            operator = list(OPERATIONS)[rng.integers(4)]
            i, j = rng.integers(len(exact), size=2)
            if operator is Operator.DIV and abs(exact[j]) < Fraction(1, 5):
                continue
            exact.append(OPERATIONS[operator](exact[i], exact[j]))
            single.append(OPERATIONS[operator](single[i], single[j]))
            bounded.append(ARITHMETIC[operator](bounded[i], bounded[j]))
        for value, number, bound in zip(exact, single, bounded, strict=True):
            off = abs(Fraction(float(number)) - value)
            # The bound itself is computed in double, and its centre rounded there.
            assert off <= Fraction(bound.error) * Fraction(1001, 1000) + abs(value) / 2**50
            if bound.error:
                used.append(float(off) / bound.error)
    assert max(used) > 0.3  # the bounds are not idle


@pytest.mark.parametrize(
    "plant",
    [paper("A"), paper("B"), spec(random_model(1, 3, 2, 1)), spec(random_model(2, 4, 1)), motor()],
    ids=["A", "B", "random", "one sensor", "motor"],
)
def test_compiled_float_stays_within_the_bound(plant):
    values = fkgen.check(plant).values
    T = 1500
    u = np.ones((T, plant.model.nu))
    y = simulate(LinearSystem.from_spec(plant, T), u, np.random.default_rng(1))
    single, double = (
        fkgen.build(replace(plant, code=Code(scalar, update)))
        .run(y, u if plant.model.nu else None, keep=["filtered_state"])
        .filtered_state.astype(float)
        for scalar, update in (("float", "auto"), ("double", "joseph"))
    )
    inside = np.all(np.abs(double) <= usual_range(Subject(plant)), axis=1)
    assert inside.mean() > 0.9
    bound = [values[f"float_error_bound.{s.name}"] for s in plant.model.states]
    off = np.abs(single - double)[T // 2 :][inside[T // 2 :]].max(axis=0)
    assert np.all(off <= bound)
    assert np.all(off >= 1e-5 * np.array(bound))  # pessimistic, but about the same thing


def test_float_is_judged_by_the_bound():
    assert finding(fkgen.check(paper("A")), "float_suitable").severity == "note"
    wide = random_model(6, 2, 1) | {"A": [[1.0, 1.0], [0.0, 1.0]], "C": [[1.0, 0.0]]}
    wide |= {"Q": [[1e-6, 0.0], [0.0, 1e-6]], "R": [[1e-4]], "P0": [[1e10, 0.0], [0.0, 1.0]]}
    in_double = finding(fkgen.check(spec(wide)), "float_rounding")
    in_float = finding(fkgen.check(spec(wide, code={"scalar": "float"})), "float_rounding")
    assert in_double.severity == "note"
    assert in_float.severity == "warning"
    assert in_float.value > 0.1
    assert 'scalar = "double"' in in_float.remedy
