"""The least bias that a test finds: anchors, the table of the four models, Friedland's identity."""

from __future__ import annotations

import numpy as np
import pytest
from effect_plants import paper
from plants import common, random_model, spec

import fkgen
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.fault_effect import gains
from fkgen.profiles import step
from fkgen.study.effects.effect import detection_power, required_noncentrality

ANCHORS = {1: 20.9039, 2: 23.8173, 4: 27.6827, 10: 35.1024, 20: 43.3474}


@pytest.mark.parametrize("degrees", ANCHORS)
def test_the_noncentrality_that_a_test_needs(degrees):
    assert required_noncentrality(degrees, 1e-3, 0.9) == pytest.approx(ANCHORS[degrees], abs=1e-4)


def test_one_degree_of_freedom_is_a_shifted_normal():
    from scipy.stats import norm

    shift = norm.isf(0.5e-3) + norm.isf(0.1)  # the other tail has 1e-15
    assert required_noncentrality(1, 1e-3, 0.9) == pytest.approx(shift**2, rel=1e-9)


def test_power_and_required_noncentrality_are_inverse():
    for degrees, alarm, power in ((3, 0.01, 0.5), (40, 1e-4, 0.99), (200, 0.05, 0.051)):
        needed = np.array([required_noncentrality(degrees, alarm, power)])
        found = detection_power(needed, np.array([degrees]), alarm)
        assert found[0] == pytest.approx(power, abs=1e-10)


WINDOWS = (1, 10, 50, 200)
#: Model and sensor: lambda at the onset and in the end, first NIS, GLR and sum of NIS per window.
TABLE = {
    ("A", 0): ((2.007, 0.00042), 3.445, [3.228, 3.125, 3.051, 3.008], [3.445, 4.5, 5.886, 7.781]),
    ("A", 1): (
        (85.47, 14.03),
        0.528,
        [0.4945, 0.268, 0.1674, 0.0856],
        [0.528, 0.386, 0.323, 0.221],
    ),
    ("B", 0): (
        (1e4, 1e4),
        0.0488,
        [0.0457, 0.0145, 0.0065, 0.0032],
        [0.0488, 0.0208, 0.0125, 0.0084],
    ),
    ("B", 1): (
        (79.31, 0.0011),
        0.548,
        [0.5134, 0.3464, 0.3238, 0.3236],
        [0.548, 0.499, 0.625, 0.837],
    ),
    ("D", 0): ((2.023, 0.0002), 3.431, [3.2145, 3.213, 3.207, 3.183], [3.431, 4.627, 6.187, 8.232]),
    ("D", 1): (
        (95.96, 3.85),
        0.498,
        [0.4667, 0.1742, 0.1228, 0.1019],
        [0.498, 0.251, 0.237, 0.264],
    ),
}


@pytest.mark.parametrize(("name", "row"), TABLE)
def test_the_models_of_the_paper(name, row):
    (onset, plateau), first, glr, summed = TABLE[name, row]
    found = [
        fkgen.detectability(paper(name), np.eye(2)[row], 1e-3, 0.9, window) for window in WINDOWS
    ]
    close = {"rel": 3e-3, "abs": 6e-5}  # the table has three to four digits
    assert found[0].information[0] == pytest.approx(onset, **close)
    assert found[0].plateau == pytest.approx(plateau, rel=0.04)
    assert [each.nis for each in found] == pytest.approx([first] * 4, **close)
    assert [each.glr for each in found] == pytest.approx(glr, **close)
    assert [each.windowed_nis for each in found] == pytest.approx(summed, **close)


@pytest.mark.parametrize("name", "ABCD")
def test_what_remains_of_a_lasting_bias_is_the_plateau(name):
    for row in ("y0", "y1"):
        found = fkgen.detectability(paper(name), row, window=2000)  # 0.99**2000 is 2e-9
        assert found.information[-1] == pytest.approx(found.plateau, rel=1e-6, abs=1e-12)


def test_a_row_by_name_a_row_by_direction_and_the_size_of_the_direction():
    spec = paper("A")
    by_name = fkgen.detectability(spec, "y1")
    by_row = fkgen.detectability(spec, [0.0, 1.0])
    twice = fkgen.detectability(spec, [0.0, 2.0])
    assert by_name.glr == by_row.glr
    assert twice.glr == pytest.approx(0.5 * by_row.glr, rel=1e-12)


def test_information_is_what_a_filter_with_the_bias_as_a_state_learns_of_it():
    model = random_model(31, 3, 2, correlated=True)
    found, T, d = spec(model), 30, np.array([0.6, -1.1])
    effect = fkgen.fault_effect(found, step(T, 0, d))
    plain = LinearSystem.from_spec(found, T)
    prior = 7.0
    wide = LinearSystem.from_spec(spec(with_bias(model, d, prior)), T)
    y = np.random.default_rng(5).standard_normal((T, 2))
    augmented = batch_lmmse(wide, y, None)
    information = np.cumsum(effect.noncentrality)
    variance = augmented.filtered_covariance[:, 3, 3]
    np.testing.assert_allclose(1.0 / variance, information + 1.0 / prior, rtol=1e-9)
    run = fkgen.build(found).run(y)
    S = gains(plain).innovation
    weighted = np.linalg.solve(S, effect.innovation_deviation[..., np.newaxis])[..., 0]
    bias = np.cumsum(np.sum(weighted * run.innovation, axis=1)) * variance
    np.testing.assert_allclose(augmented.filtered_state[:, 3], bias, rtol=1e-9, atol=1e-12)
    corrected = run.filtered_state - effect.state_deviation * bias[:, np.newaxis]
    np.testing.assert_allclose(augmented.filtered_state[:, :3], corrected, rtol=1e-9, atol=1e-12)


def with_bias(model, d, variance):
    """The plant with a constant fourth state that is added to y along d."""
    A, C, Q, P0 = (np.array(model[letter]) for letter in ("A", "C", "Q", "P0"))
    return model | {
        "A": np.block([[A, np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]]).tolist(),
        "C": np.hstack([C, d[:, np.newaxis]]).tolist(),
        "Q": np.block([[Q, np.zeros((3, 1))], [np.zeros((1, 4))]]).tolist(),
        "P0": np.block([[P0, np.zeros((3, 1))], [np.zeros((1, 3)), variance]]).tolist(),
        "x0": [*model["x0"], 0.0],
    }


def resting(spec):
    """P(k+1|k) at rest, by 3000 steps of the textbook recursion."""
    system = LinearSystem.from_spec(spec, 3000)
    A = system.A[0]
    return A @ gains(system).filtered[-1] @ A.T + system.Q[0]


def test_tests_have_the_power_they_are_said_to_have():
    spec, T, runs = paper("A"), 10, 2000
    found = fkgen.detectability(spec, "y1", 0.05, 0.6, T)
    rest = paper("A", resting(spec).tolist())
    system = LinearSystem.from_spec(rest, T)
    from fkgen.oracle.plants.actuator import simulate

    y = np.array(
        [simulate(system, np.zeros((T, 1)), np.random.default_rng(m)) for m in range(runs)]
    )
    built = fkgen.build(rest)
    from scipy.stats import chi2

    for size, degrees, window in ((found.nis, 2, 1), (found.windowed_nis, 20, T)):
        run = built.run_batch(y + np.array([0.0, size]), np.zeros((T, 1)), keep=["nis"])
        share = np.mean(run.nis[:, :window].sum(axis=1) > chi2.isf(0.05, degrees))
        assert abs(share - 0.6) < 4.0 * np.sqrt(0.24 / runs)


def test_mkf_sees_less_while_commands_may_be_lost():
    found = spec(random_model(33, 2, 1, 1), family="mkf", actuator=common(0.5))
    still, driven = fkgen.detectability(found, "y0"), fkgen.detectability(found, "y0", u=[4.0])
    assert driven.nis > 1.1 * still.nis


def test_where_y_shows_which_commands_are_lost_there_is_no_chi_square():
    found = spec(random_model(33, 2, 1, 1, direct=True), family="mkf", actuator=common(0.5))
    assert np.isfinite(fkgen.detectability(found, "y0").glr)
    with pytest.raises(fkgen.DataError, match="is a mixture"):
        fkgen.detectability(found, "y0", u=[4.0])


def test_a_bias_that_the_filter_never_sees_is_infinite():
    model = random_model(34, 2, 1) | {"R": [[0.0]]}
    exact = fkgen.detectability(spec(model), "y0")
    assert np.isfinite(exact.nis)
    noise = {"A": [[0.5]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]], "x0": [0.0], "P0": [[1.0]]}
    assert fkgen.detectability(spec(noise), [1e-200]).glr == np.inf
