"""What a fault does: closed forms of the paper and laws of the deviation."""

from __future__ import annotations

import numpy as np
import plants
import pytest
from effect_plants import MODELS, T, close, paper, varying

import fkgen
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.fault_effect import after_pulse, after_step, gains, within_step
from fkgen.profiles import drift, pulse, step
from fkgen.study.effects.report import draw
from fkgen.study.records.table import read_table

SEEDED = [(1, "A"), (2, None), (3, None)]


def plant(seed, name):
    """A model of the paper, or a random time-varying one: spec, params, its system and gains."""
    found, params = (paper(name), {}) if name else varying(seed)
    system = LinearSystem.from_spec(found, T, params)
    return found, params, system, gains(system)


@pytest.mark.parametrize(("seed", "name"), SEEDED)
def test_sensor_faults_are_9_12_and_15(seed, name):
    spec, params, _, found = plant(seed, name)
    a, k0, i = np.array([1.3, -0.7]), 4, 6
    once = fkgen.fault_effect(spec, pulse(T, k0, a), params=params).state_deviation
    lasting = fkgen.fault_effect(spec, step(T, k0, a), params=params).state_deviation
    ended = fkgen.fault_effect(spec, step(T, k0, a, stop=k0 + i + 1), params=params)
    for k in range(k0, T):
        close(once[k], after_pulse(found.M, found.K, k0, k - k0, a))
        close(lasting[k], within_step(found.M, found.K, k0, k - k0, a))
    for j in range(T - k0 - i):
        expected = after_step(found.M, found.K, (k0, i), j, a)
        close(ended.state_deviation[k0 + i + j], expected)
    assert not once[:k0].any()
    assert np.array_equal(ended.error_deviation, -ended.state_deviation)


@pytest.mark.parametrize(("seed", "name"), SEEDED)
def test_anomalies_of_plant_and_filter_are_20_23_and_26(seed, name):
    spec, params, system, _ = plant(seed, name)
    entry = np.concatenate([np.zeros_like(system.B[:1]), system.B[:-1]])
    a, k0, i = np.arange(1.0, spec.model.nu + 1.0), 4, 6  # the paper's k0: u acts a sample before
    once = fkgen.fault_effect(spec, input=pulse(T, k0 - 1, a), params=params)
    lasting = fkgen.fault_effect(spec, input=step(T, k0 - 1, a), params=params).state_deviation
    ended = fkgen.fault_effect(spec, input=step(T, k0 - 1, a, stop=k0 + i), params=params)
    for k in range(k0, T):
        close(once.state_deviation[k], after_pulse(system.A, entry, k0, k - k0, a))
        close(lasting[k], within_step(system.A, entry, k0, k - k0, a), lasting)
    for j in range(T - k0 - i):
        expected = after_step(system.A, entry, (k0, i), j, a)
        close(ended.state_deviation[k0 + i + j], expected)
    assert not once.error_deviation.any()
    assert not once.innovation_deviation.any()


@pytest.mark.parametrize("mutant", ["ascending", "gain inside", "one sample less", "P without Q"])
def test_the_readings_that_the_paper_allows_are_told_apart(mutant):
    spec, params, system, found = plant(2, None)
    a, k0, i = np.array([1.3, -0.7]), 4, 6
    effect = fkgen.fault_effect(spec, step(T, k0, a), params=params).state_deviation[k0 + i]
    M, K = found.M, found.K
    if mutant == "ascending":
        M = M.transpose(0, 2, 1)
        wrong = sum(
            (after_pulse(M, np.eye(3)[None].repeat(T, 0), k0 + c, i - c, np.eye(3)).T @ K[k0 + c])
            for c in range(i + 1)
        )
        wrong = wrong @ a
    elif mutant == "gain inside":
        wrong = within_step(M @ (K[:-1] @ system.C[:-1]), K, k0, i, a)
    elif mutant == "one sample less":
        wrong = within_step(M, K, k0 + 1, i - 1, a)
    else:
        still = LinearSystem.from_spec(spec, T, {n: v * (n[0] != "q") for n, v in params.items()})
        wrong = within_step(gains(still).M, gains(still).K, k0, i, a)
    assert np.abs(wrong - effect).max() > 1e-3 * np.abs(effect).max()


# --------------------------------------------------------------------------- laws of the deviation


def test_no_fault_is_no_effect_twice_the_fault_twice_the_effect_and_faults_add_up():
    spec, params = varying(21)
    first, second = pulse(T, 3, [1.0, 2.0]), drift(T, 10, [0.1, -0.2])

    def effect(sensor):
        return fkgen.fault_effect(spec, sensor, params=params).state_deviation

    assert not effect(0.0 * first).any()
    close(effect(2.0 * first), 2.0 * effect(first))
    close(effect(first + second), effect(first) + effect(second))


def test_a_later_fault_of_a_filter_at_rest_is_the_same_later():
    spec = paper("A")
    rest = fkgen.Spec.from_dict(
        spec.to_dict() | {"model": spec.to_dict()["model"] | {"P0": resting(spec)[0].tolist()}}
    )
    early = fkgen.fault_effect(rest, step(T, 2, [1.0, 1.0])).state_deviation
    late = fkgen.fault_effect(rest, step(T, 9, [1.0, 1.0])).state_deviation
    np.testing.assert_allclose(late[9:], early[2:-7], rtol=1e-9, atol=1e-9)


def resting(spec):
    """Stationary P(k+1|k), K, M, by 3000 steps of the textbook recursion."""
    system = LinearSystem.from_spec(spec, 3000)
    found = gains(system)
    A = system.A[0]
    return A @ found.filtered[-1] @ A.T + system.Q[0], found.K[-1], found.M[-1]


RADII = {"A": 0.913677674, "B": 0.99, "C": 0.913677674, "D": 0.99}
GAINS = {
    "A": [[0.390455, -2.359148], [0.095987, 2.905521], [-0.720434, -2.359201]],
    "B": [[0.0, 1.580064], [0.0, 4.138951], [0.0, -4.914225]],
    "C": [[0.390455, -2.359148], [0.095987, 2.905521], [-0.720434, -2.359201]],
    "D": [[0.455281, 0.0], [0.0, 0.807086], [-0.655605, 0.0]],
}


@pytest.mark.parametrize("name", MODELS)
def test_the_filters_of_the_paper_come_to_rest_at_these_radii_and_gains(name):
    spec = paper(name)
    _, K, M = resting(spec)
    radius = fkgen.check(spec).values["closed_loop_radius"]
    assert radius == pytest.approx(RADII[name], abs=5e-10)
    assert np.abs(np.linalg.eigvals(M)).max() == pytest.approx(radius, rel=1e-9)
    np.testing.assert_allclose(K, GAINS[name], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_deviation_measured_by_the_covariance_never_grows_after_the_fault(seed):
    spec, params = varying(seed)
    k0, a = 4, np.array([1.0, -2.0])
    effect = fkgen.fault_effect(spec, pulse(T, k0, a), params=params)
    system = LinearSystem.from_spec(spec, T, params)
    found = gains(system)
    inverse = np.linalg.inv(found.filtered)
    V = np.einsum("ki,kij,kj->k", effect.state_deviation, inverse, effect.state_deviation)
    weight = np.linalg.solve(system.R[k0], a)
    C = system.C[k0]
    assert V[k0] == pytest.approx(weight @ C @ found.filtered[k0] @ C.T @ weight, rel=1e-10)
    assert np.all(np.diff(V[k0:]) <= 1e-10 * V[k0])


def test_the_noncentrality_of_a_pulse_adds_up_to_that_of_the_best_test():
    spec, k0, a = paper("A"), 8, np.array([1.0, 0.5])
    effect = fkgen.fault_effect(spec, pulse(400, k0, a))
    others = np.zeros((400, 2))
    others[k0] = np.nan
    smoothed = smoothed_covariance(LinearSystem.from_spec(spec, 400), others, k0)
    C, R = (getattr(spec.model, letter).values() for letter in "CR")
    expected = a @ np.linalg.solve(R + C @ smoothed @ C.T, a)
    assert effect.noncentrality.sum() == pytest.approx(expected, rel=1e-9)


def smoothed_covariance(system, y, at):
    """Cov(x[at] | the rows of y that are there), by a Rauch-Tung-Striebel pass."""
    found = gains(system, y=y)
    P = found.filtered[-1]
    for k in range(system.length - 2, at - 1, -1):
        predicted = system.A[k] @ found.filtered[k] @ system.A[k].T + system.Q[k]
        G = found.filtered[k] @ system.A[k].T @ np.linalg.inv(predicted)
        P = found.filtered[k] + G @ (P - predicted) @ G.T
    return P


def test_a_picture_runs_over_the_times_of_the_record(tmp_path):
    one = [[1.0]]
    model = {"A": [[0.5]], "C": one, "Q": one, "R": one, "x0": [0.0], "P0": one}
    spec = fkgen.Spec.from_dict({"name": "a", "model": model, "filter": {"family": "kf"}})
    path = tmp_path / "r.csv"
    path.write_text("t [ms],y0\n0,1\n250,1\n1000,1\n1250,1\n", encoding="utf-8")
    table = read_table(path, spec)
    effect = fkgen.fault_effect(spec, sensor=[[1.0], [0.0], [0.0], [0.0]])
    over = effect.settled(0.5)
    for record, times, label in (
        (table, [0.0, 0.25, 1.0, 1.25], "time (s)"),
        (None, [0.0, 1.0, 2.0, 3.0], "sample"),
    ):
        axes = draw(spec, effect, over, 1e-3, record).axes
        assert axes[-1].get_xlabel() == label
        for axis in axes:
            assert axis.lines[0].get_xdata().tolist() == times
        (end,) = (line for line in axes[0].lines if line.get_label() == "over")
        assert end.get_xdata()[0] == times[int(over[0])]


def as_functions(model):
    """The same plant by f and h; the wrap of a row that never comes near makes it no linear one."""

    def rows(*letters):
        parts = zip(*(np.asarray(model[each]) for each in letters), strict=True)
        return [
            "+".join(f"{value!r}*{name}{i}" for row, name in zip(row_of, "xu", strict=True)
                     for i, value in enumerate(row.tolist()))
            for row_of in parts
        ]  # fmt: skip

    named = {"states": ("x", 3), "inputs": ("u", 2), "outputs": ("y", 2)}
    found = {key: [{"name": f"{x}{i}"} for i in range(n)] for key, (x, n) in named.items()}
    found["outputs"][0] |= {"unit": "rad", "wrap": True}
    return found | {key: model[key] for key in ("Q", "R", "x0", "P0")} | {
        "f": rows("A", "B"), "h": rows("C", "D"),
    }  # fmt: skip


def test_of_functions_that_are_linear_pairs_say_what_the_recursion_does():
    model = plants.random_model(7, 3, 2, 2, direct=True) | {"x0": [0.0] * 3}
    model |= {key: (1e-4 * np.asarray(model[key])).tolist() for key in ("Q", "R", "P0")}
    linear, table = plants.spec(model), {"name": "curved", "filter": {"family": "ekf"}}
    curved = fkgen.Spec.from_dict(table | {"model": as_functions(model)})
    assert curved.filter.linearises
    rng, T = np.random.default_rng(4), 25
    sensor, anomaly = 0.01 * rng.normal(size=(2, T, 2))
    for mode in ("both", "plant", "filter"):
        given = {"sensor": sensor, "input": anomaly, "mode": mode, "u": np.zeros((T, 2))}
        exact = fkgen.fault_effect(linear, **given)
        paired = fkgen.fault_effect(curved, **given, runs=3)
        assert paired.kind == "paired"
        for name in ("state_deviation", "error_deviation", "innovation_deviation", "state_sd"):
            expected = getattr(exact, name)
            np.testing.assert_allclose(getattr(paired, name), expected, rtol=1e-9, atol=1e-12)


def test_the_bias_of_a_range_moves_an_estimate_by_what_the_geometry_says():
    """Far away, with a prior worth nothing, the estimate takes in the whole bias of the range."""
    model = {
        "states": [{"name": "px"}, {"name": "py"}],
        "outputs": [{"name": "range"}, {"name": "bearing", "unit": "rad", "wrap": True}],
        "Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1e-4, 0.0], [0.0, 1e-8]],
        "x0": [300.0, -400.0], "P0": [[1e-2, 0.0], [0.0, 1e-2]],
        "h": {"range": "hypot(px, py)", "bearing": "atan2(py, px)"},
    }  # fmt: skip
    spec = fkgen.Spec.from_dict({"name": "far", "model": model, "filter": {"family": "ekf"}})
    bias = np.zeros((12, 2))
    bias[6:, 0] = 2.0
    found = fkgen.fault_effect(spec, bias, runs=40)
    np.testing.assert_allclose(found.state_deviation[:6], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.state_deviation[11], [1.2, -1.6], atol=0.02)
    np.testing.assert_allclose(found.error_deviation, -found.state_deviation, atol=1e-9)
