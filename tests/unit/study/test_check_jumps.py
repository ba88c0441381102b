"""What check says about jumping plants: chain, mean-square radius, rest, tests for losses."""

from __future__ import annotations

import numpy as np
import pytest
from jump_plants import (
    EXAMPLE_A,
    EXAMPLE_B,
    EXAMPLE_S,
    EXAMPLE_U,
    GILBERT,
    changed,
    filtered,
    spec_of,
)

import fkgen

#: Position and velocity undamped; modes differ in Q and R.
NOISE_ALONE = changed(EXAMPLE_U, modes=[{"A": EXAMPLE_U["model"]["A"]}] * 3)
ALTERNATING = [[0.0, 1.0, 0.0], [0.5, 0.0, 0.5], [0.0, 1.0, 0.0]]


def report(table, **options):
    return fkgen.check(spec_of(table, **options))


def found(table, **options):
    return {finding.code: finding for finding in report(table, **options).findings}


def test_the_numbers_of_example_A():
    values = report(EXAMPLE_A, arrival_rate=0.85, detector="llr").values
    assert values["mean_square_radius"] == pytest.approx(0.9409, rel=1e-12)
    assert values["ergodic"] == 1.0
    assert values["closed_loop_radius"] == pytest.approx(0.885367, abs=5e-7)
    assert values["J1"] == pytest.approx(3.868801, abs=5e-7)
    assert values["J0"] == pytest.approx(2350.534333, abs=5e-7)
    assert values["stationary_trace"] == pytest.approx(1519.995342, abs=5e-7)
    assert values["stationary_covariance[0][0]"] == pytest.approx(2.639928, abs=5e-7)
    assert values["stationary_filtered_covariance[0][0]"] == pytest.approx(0.838538, abs=5e-7)
    assert values["stationary_probability.1"] == pytest.approx(0.338028, abs=5e-7)


@pytest.mark.parametrize(
    ("plant", "options"),
    [
        (EXAMPLE_A, {"arrival_chain": GILBERT}),
        (EXAMPLE_B, {}),
        (EXAMPLE_B, {"arrival_rate": 0.8}),
        (NOISE_ALONE, {}),
    ],
)
def test_rest_is_where_the_filter_comes_to(plant, options):
    values = report(plant, **options).values
    last = filtered(plant, np.zeros((400, 1)), **options)
    for i in range(3):
        for j in range(i + 1):
            for name in ("", "filtered_"):
                port = "filtered_covariance" if name else "predicted_covariance"
                expected = last[port][-1, i, j]
                found = values[f"stationary_{name}covariance[{i}][{j}]"]
                assert found == pytest.approx(expected, rel=1e-6)  # 0.94^400, and sums


def test_a_plant_that_is_not_mean_square_stable():
    assert found(EXAMPLE_U)["not_mean_square_stable"].severity == "note"
    doubtful = found(EXAMPLE_U, arrival_rate=0.9)["not_mean_square_stable"]
    assert doubtful.severity == "warning"
    assert "radius 1" in doubtful.message
    assert doubtful.remedy == "a detector, or arrival = 'known'"
    values = report(EXAMPLE_U).values
    assert values["mean_square_radius"] == pytest.approx(1.0, abs=1e-6)
    assert not {"J1", "J0", "closed_loop_radius"} & set(values)


def test_a_plant_that_is_nearly_not_mean_square_stable():
    near = {"modes": [{"A": [[0.9999]]}, {"A": [[0.9999]]}]}
    finding = found(EXAMPLE_S, **near)["nearly_unstable"]
    assert finding.severity == "warning"
    assert "5e+03 samples" in finding.message


def test_chains_without_a_limit():
    cycle = found(EXAMPLE_A, transition=ALTERNATING)["not_ergodic"]
    assert "goes round in 2 steps" in cycle.message
    split = found(EXAMPLE_A, transition=np.eye(3).tolist())["not_ergodic"]
    assert "several stationary laws" in split.message
    assert report(EXAMPLE_A, transition=ALTERNATING).values["ergodic"] == 0.0
    assert "J1" not in report(EXAMPLE_A, transition=ALTERNATING).values


def test_a_mode_that_never_comes():
    P = [[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.1, 0.1, 0.8]]
    finding = found(EXAMPLE_A, transition=P, initial=[1.0, 0.0, 0.0])["impossible_mode"]
    assert finding.message == "the mode 2 never comes"


def test_how_many_losses_are_invisible():
    """Share of predicted signals within two deviations: counted over a long simulation."""
    note = found(EXAMPLE_A, arrival_rate=0.85, detector="llr")["invisible_losses"]
    assert note.severity == "note"
    assert note.value == pytest.approx(0.0365, abs=5e-4)
    small = changed(EXAMPLE_A, modes=[{"R": [[1e5]]}] * 3)
    loud = found(small, arrival_rate=0.85, detector="llr")["invisible_losses"]
    assert loud.severity == "warning"
    assert loud.value > 0.99
    far = found(EXAMPLE_S, arrival_rate=0.85, detector="llr")["invisible_losses"]
    assert far.value < 1e-6  # it settles far from zero


def test_false_alarms_of_the_energy_rule():
    rule = found(EXAMPLE_A, arrival_rate=0.85, detector="energy")["energy_rule"]
    assert rule.severity == "warning"
    assert "31.7%" in rule.message
    assert "energy_rule" not in found(EXAMPLE_A, arrival_rate=0.85, detector="energy", kappa=9.0)
    wide = report(EXAMPLE_A, arrival_rate=0.85, detector="energy", kappa=1.5, window=5).values
    rng = np.random.default_rng(1)
    means = (rng.standard_normal((200_000, 5)) ** 2).mean(axis=1)
    assert wide["false_alarm_rate"] == pytest.approx((means > 1.5).mean(), abs=4e-3)


def test_what_is_said_about_nis_and_about_an_alpha_that_nothing_uses():
    assert "one_hypothesis" in found(EXAMPLE_A, arrival_rate=0.85, detector="nis")
    assert "unused_alpha" in found(EXAMPLE_A, arrival_rate=0.85, detector="llr", alpha=0.2)
    assert "unused_alpha" not in found(EXAMPLE_A, arrival_rate=0.85, detector="nis", alpha=0.2)


def test_an_innovation_that_is_singular():
    twice = changed(
        EXAMPLE_A,
        model={"C": [[1, 0, 0], [1, 0, 0]], "R": [[1, 1], [1, 1]]},
        modes=[{"R": [[1, 1], [1, 1]]}] * 3,
    )
    assert found(twice)["innovation_rank"].value == 1
    assert "innovation_rank" not in found(EXAMPLE_A)


def test_parameters_of_modes_are_used():
    modes = [{"c": ["a", 0, 0]}, {}, {"R": [["1 + b**2"]]}]
    findings = found(EXAMPLE_A, modes=modes, parameters={"a": 1.0, "b": 2.0, "d": 3.0})
    assert findings["unused_parameter"].message == "nothing uses the parameter d"
    assert "a = 1 and b = 2" in findings["time_varying"].message
