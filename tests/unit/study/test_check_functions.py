"""What `check` says of plants with f and h: against brute force, draws and trials of filters."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from equations import ATTITUDE, ROBOT, table
from scipy.integrate import solve_ivp

import fkgen
from fkgen.cli import main
from fkgen.oracle.plants.equations import space_of
from fkgen.oracle.plants.manifold import wrapped
from fkgen.study.diagnostics.curvature import Curved, measured, roots, second_order
from fkgen.study.diagnostics.trajectory import Trajectory, drive_of, window_of
from fkgen.study.diagnostics.visibility import unobservable

Z = 4.5  # standard errors

#: A target that is held in a region, seen from a place outside of it.
TRACKER = {
    "states": [{"name": name} for name in ("px", "vx", "py", "vy")],
    "outputs": [{"name": "range"}, {"name": "bearing", "unit": "rad", "wrap": True}],
    "Q": np.diag([0.0, 0.01, 0.0, 0.01]).tolist(),
    "R": [[0.25, 0.0], [0.0, 0.01**2]],
    "x0": [-60.0, 1.0, 40.0, -1.0],
    "P0": np.diag([4.0, 0.1, 4.0, 0.1]).tolist(),
    "f": {
        "px": "px + vx",
        "vx": "0.95*vx - 0.01*(px + 60)",
        "py": "py + vy",
        "vy": "0.95*vy - 0.01*(py - 10)",
    },
    "h": {"range": "hypot(px, py)", "bearing": "atan2(py, px)"},
}


def pendulum(strength, variance):
    return {
        "states": [{"name": "a"}, {"name": "v"}],
        "outputs": [{"name": "y"}],
        "Q": [[0.01, 0.0], [0.0, 0.01]],
        "R": [[variance]],
        "x0": [1.5, 0.0],
        "P0": [[1.0, 0.0], [0.0, 0.1]],
        "f": {"a": "a + 0.2*v", "v": f"0.9*v + {strength}*0.2*sin(a)"},
        "h": {"y": "a"},
    }


def read(model, parameters=None, family="ekf", **sections):
    given = {"dt": 0.1} if parameters is None else parameters
    return fkgen.Spec.from_dict(table(model, given, family=family, **sections))


def path_of(spec, **given):
    return Trajectory(spec, drive_of(spec, **given))


def curved(spec, **given):
    path = path_of(spec, **given)
    return Curved(path, spec.model.equations, path.systems[0])


def finding(report, code):
    return next(f for f in report.findings if f.code == code)


def drawn(change, root, k, rng, count=400_000):
    """What of a function of Gaussian errors at a sample is not linear, by draws and differences."""
    T, e = root.shape[:2]
    d = np.zeros((2 * e, T, e))
    d[:, k] = 1e-6 * np.vstack([np.eye(e), -np.eye(e)])
    slopes = (change(d)[:e, k] - change(d)[e:, k]) / 2e-6
    errors = np.zeros((count // 50, T, e))
    parts = []
    for _ in range(50):
        errors[:, k] = rng.standard_normal((len(errors), e)) @ root[k].T
        parts.append(change(errors)[:, k] - errors[:, k] @ slopes)
    return np.concatenate(parts)


@pytest.mark.parametrize("name", ["robot", "attitude"])
def test_second_order_terms_are_what_draws_say_of_functions_that_are_nearly_quadratic(name):
    quiet = {"P0": np.diag([0.04, 0.04, 0.01]).tolist(), "Q": np.zeros((3, 3)).tolist()}
    quiet |= {"x0": [3.0, 4.0, 0.8]}  # neither sine nor cosine is flat
    spec = read(ROBOT | quiet)
    u = [1.0, 0.4]
    if name == "attitude":
        spec = read(ATTITUDE | {"P0": np.diag([0.004] * 3 + [0.01] * 3).tolist()})
        u = [0.3, 0.2, -0.1]
    plant, rng = curved(spec, u=np.tile(u, (3, 1))), np.random.default_rng(0)
    path = plant.path
    cases = [
        (plant.change_of_h(path.predicted[0]), roots(path.predicted[1])),
        (plant.change_of_f(path.filtered[0]), plant.spread),
    ]
    for change, root in cases:
        terms, q = second_order(change, root), drawn(change, root, 0, rng)
        size = np.sqrt(terms.mean[0] ** 2 + np.diag(terms.covariance[0]))
        # the next terms are smaller by the spread of an angle, a fifth at most, squared
        allowed = 0.1 * size + Z * q.std(axis=0) / np.sqrt(len(q))
        assert (np.abs(q.mean(axis=0) - terms.mean[0]) < allowed + 1e-12).all()
        off = np.abs(np.cov(q.T) - terms.covariance[0])
        assert (off < 0.2 * np.outer(size, size) + 1e-12).all()
        assert size.max() > 1e-4


def test_second_order_terms_of_a_quadratic_are_traces():
    rng = np.random.default_rng(1)
    M = rng.normal(size=(2, 3, 3))
    M = M + M.transpose(0, 2, 1)
    L = rng.normal(size=(1, 3, 3))
    P = L[0] @ L[0].T

    def change(d):
        return np.einsum("...a,iab,...b->...i", d, M, d) / 2 + d[..., :2]

    found = second_order(change, roots(P[None]))
    np.testing.assert_allclose(found.mean[0], [np.trace(m @ P) / 2 for m in M], rtol=1e-10)
    expected = [[np.trace(a @ P @ b @ P) / 2 for b in M] for a in M]
    np.testing.assert_allclose(found.covariance[0], expected, rtol=1e-10)


def test_the_mean_error_of_ekf_is_that_of_its_trials():
    spec = read(TRACKER | {"P0": np.diag([25.0, 0.1, 25.0, 0.1]).tolist()})
    T = 8
    drawn = fkgen.simulate(spec, 40_000, T, 2)
    run = fkgen.build(spec).run_batch(drawn.y, keep=["filtered_state", "filtered_covariance"])
    error = drawn.state - run.filtered_state
    sd = np.sqrt(np.diagonal(run.filtered_covariance, axis1=2, axis2=3)).mean(axis=0)
    mean, noise = error.mean(axis=0) / sd, error.std(axis=0) / sd / np.sqrt(len(error))
    found = measured(curved(spec)).extended[:T]
    assert np.abs(found).max() > 0.15
    # of second order: terms of the next even order are smaller by the square of 5 m over 72 m
    assert (np.abs(found - mean) < 0.12 * np.abs(found).max() + Z * noise).all()


@pytest.mark.parametrize(
    ("model", "steps", "enough"),
    [
        (TRACKER, 8, "ekf"),
        (TRACKER | {"P0": np.diag([100.0, 0.1, 100.0, 0.1]).tolist()}, 8, "iekf"),
        (pendulum(1.0, 4.0), 20, "ukf"),
    ],
)
def test_the_filter_that_is_said_to_be_enough_knows_its_error_and_cheaper_ones_do_not(
    model, steps, enough
):
    spec = read(model)
    found = finding(fkgen.check(spec), "nonlinearity")
    assert found.severity == ("note" if enough == "ekf" else "warning")
    assert (f"{enough} is enough" if enough == "ekf" else f'"{enough}"') in (
        found.message + found.remedy
    )
    compared = fkgen.compare(spec, ("ekf", "iekf", "ukf"), runs=500, steps=steps, skip=0)
    nees = {row.label: row.nees.value for row in compared.rows}
    order = ["ekf", "iekf", "ukf"]
    for cheaper in order[: order.index(enough)]:
        assert nees[cheaper] > 1.0 + 2.0 * abs(nees[enough] - 1.0), nees
    if enough != "ukf":
        assert abs(nees[enough] - 1.0) < 0.1
    own = fkgen.check(read(model, family=enough))
    assert finding(own, "nonlinearity").severity == "note"


def test_a_square_seen_from_its_lowest_point_is_beyond_any_gaussian():
    model = pendulum(0.0, 0.1) | {"x0": [0.3, 0.0], "h": {"y": "a**2"}}
    found = finding(fkgen.check(read(model, family="ukf")), "nonlinearity")
    assert found.severity == "warning"
    assert "no Gaussian" in found.message


def rollout(spec, x, u, params, count):
    """Measurements without noise, by the numbers of the equations alone."""
    seen = []
    for k in range(count):
        now = {name: values[k] for name, values in params.items()}
        x, y = spec.model.equations.evaluate(x, u[k], [0.0] * len(spec.model.equations.noises), now)
        seen.append(y)
    return np.array(seen)


@pytest.mark.parametrize("name", ["tracker", "attitude"])
def test_windows_determine_states_as_differences_of_measurements_say(name):
    model = TRACKER if name == "tracker" else ATTITUDE | {
        "let": ATTITUDE["let"] | {"m": "rotate_back(q, [0.5, 0.1, -0.8])"},
        "outputs": [{"name": f"{a}{i}"} for a in "am" for i in "xyz"],
        "h": {f"{a}{i}": f"{a}[{j}]" for a in "am" for j, i in enumerate("xyz")},
        "R": np.diag([0.04] * 3 + [0.01] * 3).tolist(),
    }  # fmt: skip
    spec = read(model)
    u = [0.3, 0.2, -0.1][: spec.model.nu]
    path = path_of(spec, **({"u": u} if u else {}))
    space, x, count = space_of(spec.model.states), path.filtered[0][3], 20
    found = window_of(path.systems[:1], x, path.u, 3, count)
    params = {n: np.asarray(v)[3:] for n, v in path.drive.params.items()}
    wraps, columns = [each.wrap for each in spec.model.outputs], []
    for direction in np.eye(space.ne):
        pair = [
            rollout(spec, space.moved(x, s * 1e-5 * direction), path.u[3:], params, count)
            for s in (1.0, -1.0)
        ]
        apart = np.where(wraps, wrapped(pair[0] - pair[1]), pair[0] - pair[1])
        columns.append((apart / 2e-5 / np.sqrt(np.diag(spec.model.R.values()))).ravel())
    slopes = np.array(columns).T
    expected = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    np.testing.assert_allclose(found.deviation, expected, rtol=1e-5)
    assert not len(found.open)


def test_one_landmark_leaves_the_turn_about_it_open():
    spec = read(ROBOT | {"Q": np.diag([1e-4, 1e-4, 0.0]).tolist()})
    report = fkgen.check(spec, u=[1.0, 0.3])
    found = finding(report, "unobservable")
    assert found.severity == "warning"
    assert "one combination of x, y and heading" in found.message
    assert all(np.isinf(report.values[f"observation_sd.{s}"]) for s in ("x", "y", "heading"))
    path = path_of(spec, u=[1.0, 0.3])
    x = path.filtered[0][10]
    (direction,) = window_of(path.systems[:1], x, path.u, 10, 50).open
    turn = np.array([-x[1], x[0], 1.0])  # of the place about the landmark, and of the heading
    cosine = direction @ turn / np.linalg.norm(direction) / np.linalg.norm(turn)
    assert abs(abs(cosine) - 1.0) < 1e-9


def test_where_an_input_has_to_show_a_state_its_windows_are_named(tmp_path):
    model = {
        "states": [{"name": "x"}, {"name": "gain"}, {"name": "h", "wrap": True}],
        "inputs": [{"name": "u"}], "outputs": [{"name": "y"}, {"name": "z"}],
        "Q": np.diag([0.01, 0.0, 0.01]).tolist(), "R": [[0.1, 0.0], [0.0, 0.1]],
        "x0": [0.0, 1.0, 0.0], "P0": np.diag([1.0, 1.0, 0.1]).tolist(),
        "f": {"x": "0.9*x"}, "h": {"y": "x + gain*u", "z": "h"},
    }  # fmt: skip
    spec = read(model, {})
    T = 200
    u = np.where(np.arange(T) < 100, 0.0, np.sin(np.arange(T)))[:, None]
    y = fkgen.simulate(spec, 1, T, 3, u).y[0]
    found = finding(fkgen.check(spec, y=y, u=u), "unobservable")
    assert found.severity == "note"
    assert "in 2 of 4 windows" in found.message
    assert "samples 0 and 50: there the measurements say nothing about gain" in found.message
    assert finding(fkgen.check(spec), "unobservable").severity == "warning"
    assert "wrap-unit" in {f.code for f in fkgen.check(spec).findings}
    record, file = tmp_path / "record.csv", tmp_path / "plant.json"
    rows = [f"{a},{b},{c}" for (a, b), (c,) in zip(y.tolist(), u.tolist(), strict=True)]
    record.write_text("\n".join(["y,z,u", *rows]))
    file = tmp_path / "plant.toml"
    file.write_text(TOML)
    done = CliRunner().invoke(main, ["check", str(file), "--record", str(record), "--json"])
    assert done.exit_code == 0, done.output
    told = {f["code"]: f["message"] for f in json.loads(done.stdout)["findings"]}
    assert told["unobservable"] == found.message


TOML = """
name = "plant"
[model]
states = [{name = "x"}, {name = "gain"}, {name = "h", wrap = true}]
inputs = [{name = "u"}]
outputs = [{name = "y"}, {name = "z"}]
Q = [[0.01, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.01]]
R = [[0.1, 0.0], [0.0, 0.1]]
x0 = [0.0, 1.0, 0.0]
P0 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.1]]
f = {x = "0.9*x"}
h = {y = "x + gain*u", z = "h"}
[filter]
family = "ekf"
"""


def test_what_is_unobservable_of_a_linear_plant_is_so_of_the_same_by_functions():
    A, C = (
        np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.0], [0.0, 0.0, 1.0]]),
        np.array([[1.0, 0.0, 0.0]]),
    )
    model = {
        "states": [{"name": "a"}, {"name": "b"}, {"name": "c", "unit": "rad", "wrap": True}],
        "outputs": [{"name": "y"}], "R": [[0.1]], "Q": np.diag([0.1, 0.1, 0.1]).tolist(),
        "x0": [0.0] * 3, "P0": np.eye(3).tolist(),
        "f": {"a": "0.9*a + 0.1*b", "b": "0.8*b"}, "h": {"y": "a"},
    }  # fmt: skip
    path = path_of(read(model, {}))
    found = window_of(path.systems[:1], path.filtered[0][0], path.u, 0, 50)
    hidden = unobservable(A, C)
    assert len(found.open) == hidden.size == 1
    np.testing.assert_allclose(np.abs(found.open[0]), [0.0, 0.0, 1.0], atol=1e-9)


def modes_seeing(*rows):
    """Three states that move on their own; of every mode what its row measures."""
    model = {
        "states": [{"name": name} for name in "abc"], "outputs": [{"name": "y"}], "R": [[0.1]],
        "Q": np.diag([0.1, 0.1, 0.1]).tolist(), "x0": [0.5, 0.5, 0.5], "P0": np.eye(3).tolist(),
        "f": {"a": "0.9*a", "b": "0.8*sin(b)"}, "h": {"y": rows[0]},
    }  # fmt: skip
    N = len(rows)
    jump = {"transition": np.full((N, N), 1.0 / N).tolist(), "initial": [1.0 / N] * N}
    jump["modes"] = [{"h": {"y": row}} for row in rows]
    return read(model, {}, family="imm", faults={"jump": jump})


def told_of(report):
    return {
        f.message.partition(" of that mode")[0] for f in report.findings if f.code == "unobservable"
    }


def test_a_state_that_some_modes_do_not_see_is_told_with_them_and_one_that_none_sees_by_itself():
    report = fkgen.check(modes_seeing("a", "a + b", "b", "2*b"))
    (none,) = [f for f in report.findings if f.code == "unobservable" and f.severity == "warning"]
    assert none.message.endswith("on the measurements of any mode say nothing about c")
    along = "along a trial: over 50 samples from any of its 4 windows on the measurements"
    assert told_of(report) - {none.message} == {
        f"unobservable in mode 0 {along}",
        f"unobservable in modes 2 and 3 {along}",
    }
    said = sorted(f.message for f in report.findings if f.code == "unobservable" and f is not none)
    assert said[0].endswith("say nothing about b and c, those of another do")
    assert said[1].endswith("say nothing about a and c, those of another do")
    values = report.values
    assert [values[f"unobservable_windows.{m}"] for m in range(4)] == [4.0] * 4
    assert np.isfinite([values["observation_sd.a"], values["observation_sd.b"]]).all()
    assert np.isinf(values["observation_sd.c"])


def test_the_order_of_modes_does_not_matter_and_what_all_see_is_no_finding():
    rows = ["a + b + c", "c", "a + 2*b + 3*c"]
    expected = "say nothing about a and b, those of another do"
    for order in ([0, 1, 2], [1, 2, 0]):
        report = fkgen.check(modes_seeing(*(rows[i] for i in order)))
        (found,) = [f for f in report.findings if f.code == "unobservable"]
        assert found.severity == "note"
        assert f"in mode {order.index(1)} along" in found.message
        assert found.message.endswith(expected)
        assert report.values["unobservable_windows"] == 0.0
    report = fkgen.check(modes_seeing(rows[0], rows[2]))
    assert not [f for f in report.findings if f.code == "unobservable"]


def test_a_direction_that_only_modes_together_show_is_open_in_each_and_not_in_all():
    report = fkgen.check(modes_seeing("a + c", "b + c", "c"))
    found = [f for f in report.findings if f.code == "unobservable"]
    assert {f.severity for f in found} == {"note"}
    assert len(found) == 3


@pytest.mark.parametrize("dependence", ["common", "independent"])
def test_inputs_that_enter_through_a_curve_are_off_by_what_coins_say(dependence):
    turning = ROBOT["f"] | {"x": "x + speed*cos(heading + turn*dt)*dt"}
    model = ROBOT | {"f": turning, "Q": np.diag([1e-4, 1e-4, 1e-6]).tolist()}
    rates = [0.6, 0.3] if dependence == "independent" else 0.6
    faults = {"actuator": {"success_rate": rates, "dependence": dependence}}
    spec = read(model, family="mkf", faults=faults)
    u = np.array([20.0, 9.0])
    report = fkgen.check(spec, u=u)
    path, rng = path_of(spec, u=u), np.random.default_rng(5)
    draws = rng.random((100_000, 2 if dependence == "independent" else 1)) < rates
    k = int(finding(report, "not_affine").message.partition("sample ")[2].partition(")")[0])
    x, P = path.filtered[0][k], path.predicted[1][k]
    now = {"dt": 0.1}
    mean = spec.model.equations.moved(x, np.broadcast_to(rates, 2) * u, [0.0], now)[0]
    inputs = (np.broadcast_to(draws, (len(draws), 2)) * u).T
    moved = np.broadcast_to(spec.model.equations.moved(x, inputs, [0.0], now)[0], len(draws))
    expected = abs(moved.mean() - mean) / np.sqrt(P[0, 0])
    error = moved.std() / np.sqrt(len(draws)) / np.sqrt(P[0, 0])
    assert abs(report.values["not_affine_f"] - expected) < Z * error
    assert report.values["not_affine_h"] == 0.0
    affine = fkgen.check(read(ROBOT | {"Q": model["Q"]}, family="mkf", faults=faults), u=u)
    assert affine.values["not_affine_f"] < 1e-9
    assert "not_affine" not in {f.code for f in affine.findings}


def test_a_step_that_is_too_long_for_its_integrator_is_measured():
    model = {
        "states": [{"name": "x"}, {"name": "v"}], "outputs": [{"name": "y"}],
        "time": "continuous", "sample_time": 0.5, "x0": [1.0, 0.0],
        "Q": [[0.0, 0.0], [0.0, 1e-3]], "R": [[1e-4]], "P0": [[1e-4, 0.0], [0.0, 1e-4]],
        "f": {"x": "v", "v": "-16*sin(x)"}, "h": {"y": "x"},
    }  # fmt: skip
    spec = read(model, {})
    report = fkgen.check(spec)
    found = finding(report, "integration")
    path = path_of(spec)
    x, sd = path.filtered[0], np.sqrt(np.diagonal(path.predicted[1], axis1=1, axis2=2))
    sd = np.vstack([sd[1:], sd[-1:]])
    close = {"rtol": 1e-11, "atol": 1e-12}

    def rates(_, z):
        return [z[1], -16.0 * np.sin(z[0])]

    exact = np.array([solve_ivp(rates, (0.0, 0.5), z, **close).y[:, -1] for z in x])

    def off(substeps):
        plant = read(model | {"substeps": substeps}, {}).model.equations
        moved = np.array(plant.moved(x.T, [], [], {})).T
        return (np.abs(moved - exact) / sd).max()

    assert abs(report.values["integration_error"] / off(1) - 1.0) < 0.02
    count = int(found.remedy.partition("= ")[2])
    assert off(count) < 0.0101
    assert off(count // 2) > 0.0099
    assert "integration" not in {
        f.code for f in fkgen.check(read(model | {"substeps": count}, {})).findings
    }


SENSOR = {"noise_factor": 25.0, "rows": [0], "problem": 1}
SENSOR |= {"gamma_rate": 0.9, "delta_nominal_rate": 0.7}
JUMP = {"transition": [[0.9, 0.1], [0.3, 0.7]], "modes": [{}, {"R": [[25.0, 0], [0, 1e-3]]}]}
CURVED_INPUT = {
    "inputs": [{"name": "u"}],
    "f": TRACKER["f"] | {"vx": "0.95*vx - 0.01*(px + 60) + u"},
}
ACTUATOR = {"success_rate": 0.7, "dependence": "common"}
HYPOTHESES = {"hypotheses": [0.9, 0.5]}
FAULTY = {
    "imm": {"sensor": SENSOR}, "one_step": {"sensor": SENSOR}, "genie": {"sensor": SENSOR},
    "mkf": {"actuator": ACTUATOR}, "mme": {"actuator": {"dependence": "common"}},
}  # fmt: skip


@pytest.mark.parametrize(
    "family", ["ekf", "iekf", "ukf", "imm", "one_step", "genie", "mkf", "mme", "jump"]
)
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_every_family_is_checked_and_its_mild_plant_is_in_order(family, scalar):
    faults = {"jump": JUMP} if family == "jump" else FAULTY.get(family, {})
    model = TRACKER | (CURVED_INPUT if "actuator" in faults else {})
    given = table(
        model, {"spare": 1.0}, family="imm" if family == "jump" else family, faults=faults
    )
    given["filter"] |= HYPOTHESES if family == "mme" else {}
    spec = fkgen.Spec.from_dict(given | {"code": {"scalar": scalar}})
    report = fkgen.check(spec)
    assert report.sound, report.findings
    assert finding(report, "nonlinearity").severity == "note"
    assert "unused_parameter" in {f.code for f in report.findings}
    assert report.values["stationary_sd.px"] > 0.0
    assert ("float_start_to_sd" in report.values) == (scalar == "float")


def test_an_attitude_in_float_is_held_against_double_by_its_rotation():
    spec = read(ATTITUDE, code={"scalar": "float"})
    report = fkgen.check(spec)
    assert 0.0 < report.values["float_start_to_sd"] < 0.1
    assert "one combination of q[x], q[y] and q[z]" in finding(report, "unobservable").message
    assert "second_order_f.later.q[z]" in report.values


def test_a_function_without_a_value_near_the_estimate_is_an_error():
    model = pendulum(0.0, 0.1) | {"x0": [0.8, 0.0], "h": {"y": "sqrt(a)"}}
    report = fkgen.check(read(model), y=np.full((4, 1), np.nan))
    assert not report.sound
    assert "h has no value for y" in finding(report, "no_value").message


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda s: fkgen.detectability(s, "range"),
            "detectability: given a plant with functions f",
        ),
        (lambda s: fkgen.check(s, y=np.zeros((5, 3))), "y: given shape (5, 3)"),
        (lambda s: fkgen.check(s, y=np.zeros((5, 2)), u=np.zeros((5, 1))), "u: given"),
        (lambda s: fkgen.check(s, params={"q": 1.0}), "params.q: given an unknown name"),
        (lambda s: fkgen.fault_effect(s, np.ones((5, 2)), runs=1), "runs: given 1"),
        (lambda s: fkgen.compare(s, ("kf",), steps=5), "take ekf, iekf or ukf"),
    ],
)
def test_what_has_no_answer_is_refused_in_a_line(call, message):
    with pytest.raises(fkgen.UserError) as refused:
        call(read(TRACKER, {}))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_record_says_nothing_of_matrices():
    linear = fkgen.Spec.from_dict(
        {"name": "p", "filter": {"family": "kf"}}
        | {"model": {k: [[0.5]] for k in "ACQR"} | {"x0": [0.0], "P0": [[1.0]]}}
    )
    with pytest.raises(fkgen.DataError, match="check: given a record; expected none"):
        fkgen.check(linear, y=np.zeros((5, 1)))


def test_h_that_leaves_its_domain_is_a_finding_and_no_fault_of_linear_algebra():
    model = {
        "states": [{"name": "x"}],
        "outputs": [{"name": "y"}],
        "Q": [[0.1]],
        "R": [[0.1]],
        "x0": [0.8],
        "P0": [[1.0]],
        "f": {"x": "0.9*x"},
        "h": {"y": "sqrt(x)"},
    }
    table = {"name": "leaves", "model": model, "filter": {"family": "ekf"}}
    found = {each.code for each in fkgen.check(fkgen.Spec.from_dict(table)).findings}
    assert "no_value" in found
