"""The partial compression filter against its primitive noises, its reductions and known numbers."""

from __future__ import annotations

import numpy as np
import pytest
from partial_plants import PAPER, cpcf, dense, expected, record, sparse_positions
from plants import distance, interpreted, random_model, run, spec

#: Relative error of recursions of some tens of samples on well-conditioned models.
ROUNDING = 1e-9

#: (n, m, host rows)
SHAPES = [(1, 1, 0), (1, 1, 1), (2, 1, 1), (3, 1, 2), (3, 2, 1), (4, 2, 2), (2, 2, 0), (4, 3, 1)]


def assert_as_expected(filtering, y, u, params):
    found = interpreted(filtering, y, u, params)
    wanted = expected(filtering, y, u, params)
    errors = {name: distance(found[name], wanted[name]) for name in wanted}
    assert max(errors.values()) < ROUNDING, errors
    return found


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
@pytest.mark.parametrize("shape", SHAPES)
def test_all_ports_are_those_of_errors_in_primitive_noises(shape, maintenance):
    n, m, hosts = shape
    for seed in range(3):
        model, parameters, host = dense(seed, n, m, hosts, direct=seed == 1, varying=seed == 2)
        filtering = cpcf(
            model, host=host, window=2 + 2 * seed, false_alarm=0.4,
            maintenance=maintenance, parameters=parameters,
        )  # fmt: skip
        found = assert_as_expected(filtering, *record(filtering, 24, seed=seed))
        assert (found["test_dof"] > 0.0).any()


def test_windows_are_accepted_and_rejected_and_the_host_is_inflated_after_so_many():
    model, _, host = dense(7, 3, 2, 1)
    declared = 0.0
    for seed in range(4):
        filtering = cpcf(model, host=host, window=3, false_alarm=0.7, reacquire=2)
        found = assert_as_expected(filtering, *record(filtering, 40, seed=seed))
        declared += found["fault_declared"].sum()
        assert found["test_dof"].astype(bool).sum() > found["fault_declared"].sum()
    assert declared > 20


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
def test_a_singular_plant_and_a_known_start_are_no_trouble(maintenance):
    model, _, host = dense(11, 3, 2, 1, singular=True)
    model["P0"] = np.diag([0.0, 1.0, 0.0]).tolist()
    model["Q"] = np.diag([0.0, 0.0, 0.5]).tolist()
    filtering = cpcf(model, host=host, window=4, maintenance=maintenance)
    assert_as_expected(filtering, *record(filtering, 20))


def test_an_exact_row_of_the_host_is_taken_as_exact():
    model, _, host = dense(12, 3, 1, 2)
    for i in range(3):
        for j in range(3):
            if i in host and j in host:
                model["R"][i][j] = 0.0
    filtering = cpcf(model, host=host, window=4)
    y, u, params = record(filtering, 12)
    found, wanted = interpreted(filtering, y, u, params), expected(filtering, y, u, params)
    for name in ("filtered_state", "filtered_covariance", "compressed_noise"):
        assert distance(found[name], wanted[name]) < 1e-6  # both sides decide on a rank


def test_a_sample_without_rows_of_the_host_leaves_the_compressed_measurement_alone():
    model, _, host = dense(13, 3, 1, 1)
    y, u, params = record(cpcf(model, host=host), 2, missing=0.0)
    y[1] = np.nan
    found = interpreted(cpcf(model, host=host), y, u, params)
    for name in ("measurement", "noise", "cross_covariance"):
        before = found[f"predicted_compressed_{name}"][0]
        np.testing.assert_array_equal(found[f"compressed_{name}"][1], before)


def test_tested_sample_by_sample_and_accepted_it_is_a_kalman_filter():
    model, parameters, host = dense(14, 3, 2, 2, direct=True, varying=True)
    compressing = cpcf(model, host=host, window=1, test=False, parameters=parameters)
    y, u, params = record(compressing, 15)
    y[0, [i for i in range(4) if i not in host]] = np.nan  # sample 0 ends no window
    y[np.isnan(y).any(axis=1)] = np.nan
    everything = interpreted(spec(model, parameters=parameters), y, u, params)
    found = interpreted(compressing, y, u, params)
    for name in ("filtered_state", "filtered_covariance", "predicted_state"):
        assert distance(found[name], everything[name]) < ROUNDING


def test_one_measurement_in_a_window_is_used_as_a_kalman_filter_would_have():
    model, _, host = dense(15, 3, 1, 1)
    other = 1 - host[0]
    y, u, params = record(cpcf(model, host=host), 9, missing=0.0)
    y[[0, 1, 3, 4, 5, 6, 8], other] = np.nan
    everything = interpreted(spec(model), y, u)
    found = interpreted(cpcf(model, host=host, window=4, test=False), y, u, params)
    for name in ("filtered_state", "filtered_covariance"):
        assert distance(found[name][[4, 8]], everything[name][[4, 8]]) < ROUNDING
        assert distance(found[name][3], everything[name][3]) > 1e-3


def test_without_compression_measurements_it_is_the_host_alone_and_tests_nothing():
    y = np.zeros((310, 2))
    y[:, 0], y[:, 1] = np.nan, np.sin(np.arange(310))
    found, host = run(cpcf(PAPER), y), run(spec(PAPER), y)
    np.testing.assert_array_equal(found.filtered_covariance, host.filtered_covariance)
    np.testing.assert_array_equal(found.filtered_state, host.filtered_state)
    assert not found.test_dof.any()
    assert np.isnan(found.test_statistic).all()
    assert not found.compressed_noise.any()


def test_a_compressed_measurement_may_be_used_long_after_the_last_raw_one():
    model, _, host = dense(16, 2, 1, 1)
    filtering = cpcf(model, host=host, window=12)
    y, u, params = record(filtering, 13, missing=0.0)
    y[2:, 1 - host[0]] = np.nan
    assert assert_as_expected(filtering, y, u, params)["test_dof"][12] == 1.0


def test_a_compressed_measurement_that_has_decayed_says_nothing_any_more():
    """Z shrinks by F11 = 0.01 a sample beside V, which is then as large as the host's error."""
    model = {
        "A": [[0.01, 1.0], [0.0, 0.9]], "C": [[1.0, 0.0], [0.0, 1.0]], "Q": np.eye(2).tolist(),
        "R": np.eye(2).tolist(), "x0": [0.0, 0.0], "P0": np.eye(2).tolist(),
    }  # fmt: skip
    for window, dof in ((2, 1.0), (5, 0.0)):
        filtering = cpcf(model, window=window)
        y, u, params = record(filtering, window + 1, missing=0.0)
        y[1:, 0] = np.nan
        found, wanted = (each(filtering, y, u, params) for each in (interpreted, expected))
        for name in ("filtered_state", "filtered_covariance", "test_dof"):
            assert distance(found[name], wanted[name]) < ROUNDING
        assert found["test_dof"][window] == dof


@pytest.mark.parametrize("variance", [1e4, 1e6, 1e8, 1e12])
def test_a_vague_start_costs_no_more_digits_than_the_form_of_the_update_allows(variance):
    """The short form is taken up to a ratio to the noise of 1e6, the Joseph form beyond."""
    filtering = cpcf({**PAPER, "P0": [[variance, 0.0], [0.0, 1.0]]}, window=30)
    y = sparse_positions(61) + np.random.default_rng(1).standard_normal((61, 2))
    found, wanted = (each(filtering, y, np.zeros((61, 0))) for each in (interpreted, expected))
    for name in ("filtered_covariance", "filtered_state", "compressed_noise"):
        assert distance(found[name][[30, 60]], wanted[name][[30, 60]]) < 1e-10


def in_other_units(model, T, Y):
    """The plant for x' = T x and y' = Y y, both diagonal."""
    A, C, Q, R, P0 = (np.array(model[letter]) for letter in ("A", "C", "Q", "R", "P0"))
    back = np.linalg.inv(T)
    changed = {
        "A": T @ A @ back, "C": Y @ C @ back, "Q": T @ Q @ T, "R": Y @ R @ Y,
        "P0": T @ P0 @ T, "x0": T @ np.array(model["x0"]),
    }  # fmt: skip
    return {key: value.tolist() for key, value in changed.items()}


@pytest.mark.parametrize("m", [1, 2])
def test_the_units_of_states_and_rows_do_not_matter(m):
    model, _, host = dense(17, 3, m, 1)
    T, Y = np.diag([1e3, 1e-2, 7.0]), np.diag([1e-3, 1e2, 5.0][: m + 1])
    y, u, params = record(cpcf(model, host=host, window=3), 12)
    first, second = (
        interpreted(cpcf(each, host=host, window=3), values, u, params)
        for each, values in ((model, y), (in_other_units(model, T, Y), y * np.diag(Y)))
    )
    scaled = T @ first["filtered_covariance"] @ T
    unit = np.sqrt(np.einsum("kii->ki", scaled))
    error = (second["filtered_covariance"] - scaled) / (unit[:, :, None] * unit[:, None])
    assert np.abs(error).max() < ROUNDING
    assert distance(second["test_statistic"], first["test_statistic"]) < 1e-7
    np.testing.assert_array_equal(second["test_dof"], first["test_dof"])


def test_where_rows_measure_some_states_the_order_of_states_does_not_matter():
    y = sparse_positions(151) + 3.0
    swapped = {key: np.array(PAPER[key])[::-1].tolist() for key in ("x0", "F")}
    swapped |= {"A": [[1.0, 0.0], [0.2, 1.0]], "C": [[0.0, 1.0], [1.0, 0.0]]}
    swapped |= {"V": PAPER["V"], "R": PAPER["R"], "P0": [[0.01, 0.0], [0.0, 1.0]]}
    found, same = run(cpcf(swapped), y), run(cpcf(PAPER), y)
    for name in ("compressed_measurement", "compressed_noise", "test_statistic"):
        assert distance(found[name], same[name]) < 1e-12
    assert distance(found.filtered_state[:, ::-1], same.filtered_state) < 1e-12


def test_a_row_that_measures_a_state_by_a_factor_is_compressed_in_units_of_the_state():
    y = sparse_positions(151) + 3.0
    scaled = {**PAPER, "C": [[1e3, 0.0], [0.0, 1.0]], "R": [[1e8, 0.0], [0.0, 0.01]]}
    found, same = run(cpcf(scaled), y * [1e3, 1.0]), run(cpcf(PAPER), y)
    for name in ("filtered_covariance", "compressed_measurement", "compressed_noise"):
        assert distance(found[name], same[name]) < 1e-12


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
def test_the_covariance_is_between_those_of_kalman_filter_and_host(maintenance):
    for seed in range(4):
        model, _, host = dense(seed, 3, 2, 1)
        y, u, _ = record(cpcf(model, host=host), 7, seed=seed, missing=0.0)
        silent = y.copy()
        silent[:, [i for i in range(3) if i not in host]] = np.nan
        filtering = cpcf(model, host=host, window=6, test=False, maintenance=maintenance)
        P, most, least = (
            interpreted(each, record_of, u)["filtered_covariance"][6]
            for each, record_of in ((filtering, y), (spec(model), silent), (spec(model), y))
        )
        assert np.linalg.eigvalsh(most - P)[0] > -ROUNDING
        assert np.linalg.eigvalsh(P - least)[0] > -ROUNDING


# ------------------------------------------------------------------------------- known numbers


def test_the_counter_example_to_the_claim_of_theorem_4():
    """Worse than the host with the last raw measurement."""
    one = [[1.0]]
    walk = {"A": one, "C": one, "Q": [[100.0]], "R": [[1000.0]], "x0": [0.0], "P0": one}
    found = run(cpcf(walk, host=(), window=1), np.zeros((2, 1)))
    assert found.compressed_noise[1, 0, 0] == pytest.approx(523.809524, abs=1e-6)
    assert found.compressed_cross_covariance[1, 0, 0] == pytest.approx(-47.619048, abs=1e-6)
    assert found.filtered_covariance[1, 0, 0] == pytest.approx(95.619184640, abs=1e-8)
    last_raw = run(spec(walk), np.array([[np.nan], [0.0]])).filtered_covariance[1, 0, 0]
    assert last_raw == pytest.approx(91.734786558, abs=1e-8)
    both = run(spec(walk), np.zeros((2, 1))).filtered_covariance[1, 0, 0]
    assert both == pytest.approx(91.733962435, abs=1e-8)


#: P11 after the update at 900 s, by window in seconds: it has 0.0001 to 0.003 to go.
AT_900_S = {
    "paper": {10: 0.449508, 30: 0.476483, 60: 0.547734, 150: 0.762462},
    "optimal": {10: 0.446258, 30: 0.446513, 60: 0.447225, 150: 0.449962},
}


def updated(seconds, maintenance, *, at):
    """P11 with windows of so many seconds."""
    filtering = cpcf(PAPER, window=5 * seconds, test=False, maintenance=maintenance)
    found = run(filtering, sparse_positions(5 * at + 1), keep=("filtered_covariance",))
    return found.filtered_covariance[-1, 0, 0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("maintenance", AT_900_S)
def test_longer_windows_cost_what_the_table_says(maintenance):
    for seconds, variance in AT_900_S[maintenance].items():
        assert updated(seconds, maintenance, at=900) == pytest.approx(variance, abs=6e-7)


def test_at_900_s_the_variances_are_not_yet_stationary():
    kalman = run(spec(PAPER), sparse_positions(15001)).filtered_covariance[:, 0, 0]
    assert kalman[4500] == pytest.approx(0.446222, abs=6e-7)
    assert kalman[15000] == pytest.approx(0.446114, abs=6e-7)
    assert updated(150, "paper", at=3000) == pytest.approx(0.759847, abs=6e-7)


@pytest.mark.parametrize(
    ("maintenance", "variance", "noise", "cross"),
    [
        ("paper", 0.835489231245, 3.73852882, (-0.02862579, -0.00097205)),
        ("optimal", 0.809902600804, None, None),
    ],
)
def test_the_first_update_of_the_simulation(maintenance, variance, noise, cross):
    found = run(cpcf(PAPER, test=False, maintenance=maintenance), sparse_positions(151))
    assert found.filtered_covariance[150, 0, 0] == pytest.approx(variance, abs=1e-11)
    if noise is not None:
        assert found.compressed_noise[150, 0, 0] == pytest.approx(noise, abs=1e-8)
        np.testing.assert_allclose(found.compressed_cross_covariance[150, 0], cross, atol=1e-8)


def test_thresholds_come_from_false_alarm_and_degrees_of_freedom():
    """A statistic just below and just above the quantile, for one and for two rows."""
    for m, quantile in ((1, 3.841458820694), (2, 5.991464547108)):
        model = random_model(3, m, m)
        model |= {"C": np.eye(m).tolist(), "x0": [0.0] * m}
        filtering = cpcf(model, host=(), window=2)
        y = np.full((3, m), np.nan)
        y[1] = 1.0
        scale = np.sqrt(quantile / run(filtering, y).test_statistic[2])
        for factor, verdict in ((1 - 1e-9, 0.0), (1 + 1e-9, 1.0)):
            assert run(filtering, y * scale * factor).fault_declared[2] == verdict


def test_with_the_test_off_nothing_is_rejected_but_the_statistic_is_there():
    y = sparse_positions(151)
    y[:, 0] += 1000.0
    tested, untested = (run(cpcf(PAPER, test=flag), y) for flag in (True, False))
    assert tested.fault_declared[150] == 1.0
    assert untested.fault_declared[150] == 0.0
    assert tested.test_statistic[150] == untested.test_statistic[150] > 1000.0
