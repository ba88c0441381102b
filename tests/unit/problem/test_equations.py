"""Equations in place of matrices: what is read, its numbers, and back to a spec file."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
from equations import ATTITUDE, ROBOT, read, table
from scipy.spatial.transform import Rotation

import fkgen
from fkgen.errors import SpecError

SCALAR = {
    "states": [{"name": "p"}, {"name": "v"}],
    "outputs": [{"name": "y"}],
    "Q": np.eye(2).tolist(),
    "R": [[1.0]],
    "x0": [0.0, 0.0],
    "P0": np.eye(2).tolist(),
}


def numbers(found):
    return np.array(found, float)


def test_the_values_are_those_of_the_formulas_for_numbers_and_arrays_alike():
    equations = read(ROBOT).model.equations
    rng = np.random.default_rng(1)
    x, u, w = rng.normal(size=(3, 7)), rng.normal(size=(2, 7)), rng.normal(size=(1, 7))
    f, h = equations.evaluate(x, u, w, {"dt": 0.2})
    expected = [
        x[0] + u[0] * np.cos(x[2]) * 0.2,
        x[1] + u[0] * np.sin(x[2]) * 0.2,
        x[2] + (u[1] + w[0]) * 0.2,
    ]
    np.testing.assert_allclose(f, expected, rtol=1e-14)
    np.testing.assert_allclose(h, [np.hypot(x[0], x[1]), np.arctan2(x[1], x[0]) - x[2]], rtol=1e-14)
    one = equations.evaluate(x[:, 3], u[:, 3], w[:, 3], {"dt": 0.2})
    np.testing.assert_array_equal(one[0], numbers(f)[:, 3])
    np.testing.assert_array_equal(one[1], numbers(h)[:, 3])


@pytest.mark.parametrize("model", [ROBOT, ATTITUDE])
def test_a_spec_of_equations_comes_back_from_its_own_table(model):
    spec = read(model)
    again = fkgen.Spec.from_dict(spec.to_dict())
    assert again == spec
    assert again.canonical() == spec.canonical()
    assert pickle.loads(pickle.dumps(spec)) == spec  # noqa: S301 - our own


def test_the_order_of_definitions_tells_specs_apart():
    two = SCALAR | {"h": ["a*b"]}
    first = read(two | {"let": {"a": "sin(p)", "b": "cos(p)"}})
    second = read(two | {"let": {"b": "cos(p)", "a": "sin(p)"}})
    assert first.canonical() != second.canonical()


def test_lists_are_in_the_order_of_the_signals_and_what_is_left_out_stays():
    spec = read(SCALAR | {"f": ["p + sin(v)*dt", "v"], "h": ["exp(p)"]})
    same = read(SCALAR | {"f": {"p": "p + sin(v)*dt"}, "h": {"y": "exp(p)"}})
    assert spec == same


@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_time_that_is_continuous_is_integrated_over_a_sample(integrator):
    given = {"time": "continuous", "sample_time": "dt", "integrator": integrator, "substeps": 3}
    model = SCALAR | given | {"f": {"p": "v", "v": "-sin(p)"}, "h": ["p"]}
    equations = read(model).model.equations

    def rate(x):
        return np.array([x[1], -math.sin(x[0])])

    x, step = np.array([1.0, 0.3]), 0.2 / 3
    for _ in range(3):
        k1 = rate(x)
        k2, k = rate(x + step / 2 * k1), k1
        if integrator == "rk4":
            k3 = rate(x + step / 2 * k2)
            k = (k1 + 2 * k2 + 2 * k3 + rate(x + step * k3)) / 6
        x = x + step * k
    np.testing.assert_allclose(equations.moved([1.0, 0.3], [], [], {"dt": 0.2}), x, rtol=1e-14)


def test_vectors_and_rotations_are_those_of_textbooks():
    q = Rotation.from_rotvec([0.3, -0.2, 0.5])
    scalar = np.roll(q.as_quat(), 1)
    model = {**ATTITUDE, "outputs": [{"name": f"y{i}"} for i in range(9)], "R": np.eye(9).tolist()}
    model["x0"] = [1.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0]
    model["let"] = {
        "g": "[bx, by, bz]",
        "a": "rotate(q, 2*g - [gx, gy, gz]/4)",
        "b": "rotate_back(q*g, cross(g, [gx, gy, gz]))",
        "s": "norm(g) + dot(g, [1, 2, 3])",
    }
    model["h"] = ["a[0]", "a[1]", "a[2]", "b[0]", "b[1]", "b[2]", "s", "q[2]", "(-g)[1]"]
    model["f"] = {"q": "q * [gx, 2*gy, g[2]]", "bx": "s"}
    equations = read(model).model.equations
    g, u = np.array([0.2, 0.4, -1.1]), np.array([1.0, -0.5, 0.25])
    f, h = equations.evaluate([*scalar, *g], u, [], {"dt": 0.1})
    norm = np.linalg.norm(g) + g @ [1.0, 2.0, 3.0]
    np.testing.assert_allclose(
        h,
        [
            *q.apply(2 * g - u / 4),
            *(q * Rotation.from_rotvec(g)).inv().apply(np.cross(g, u)),
            norm,
            scalar[2],
            -g[1],
        ],
        rtol=1e-13,
    )
    turned = (q * Rotation.from_rotvec([u[0], 2 * u[1], g[2]])).as_quat()
    turned = np.roll(turned, 1)
    np.testing.assert_allclose(f[:4], turned * np.sign(turned[0]), rtol=1e-13)
    assert f[4] == pytest.approx(norm, rel=1e-14)


def test_equations_that_are_linear_are_the_matrices():
    model = SCALAR | {"inputs": [{"name": "force"}]}
    stated = model | {
        "let": {"gain": "exp(-dt)", "moved": "dt*v"},
        "f": ["p + moved + 0.5*dt**2*force - 0.25", "gain*v + force*dt"],
        "h": ["(2*p - v)/4 + force - dt"],
    }
    by_matrices = model | {
        "A": [[1.0, "dt"], [0.0, "exp(-dt)"]],
        "B": [["0.5*dt**2"], ["dt"]],
        "c": [-0.25, 0.0],
        "C": [[0.5, -0.25]],
        "D": [[1.0]],
        "d": ["-dt"],
    }
    assert read(stated, family="kf") == read(by_matrices, family="kf")


def test_noises_that_enter_linearly_are_part_of_q():
    noises = [{"name": "a", "variance": "dt"}, {"name": "b", "variance": 4.0}]
    f = ["if(dt > 1, 2*p, p) + a + 2*b", "v - 3*b"]
    model = SCALAR | {"f": f, "h": ["p"], "noises": noises}
    found = read(model, family="kf").model
    G = np.array([[1.0, 2.0], [0.0, -3.0]])
    expected = G @ np.diag([0.1, 4.0]) @ G.T + np.eye(2)
    np.testing.assert_allclose(found.Q.values({"dt": 0.1}), expected, rtol=1e-15)
    np.testing.assert_array_equal(found.A.values({"dt": 0.1}), np.eye(2))
    np.testing.assert_array_equal(found.A.values({"dt": 1.5}), np.diag([2.0, 1.0]))
    own = {"f": {"v": "0.5*v + b"}, "Q": [[2.0, 0.0], [0.0, 2.0]]}
    spec = jumping({}, own, {"Q": np.zeros((2, 2)).tolist()}, family="mjls_lmmse")(model)
    plain, changed, without = (m.Q.values({"dt": 0.1}) for m in spec.faults.jump.modes)
    np.testing.assert_allclose(plain, expected, rtol=1e-15)
    np.testing.assert_allclose(without, expected - np.eye(2), rtol=1e-15)
    G[1, 1] = 1.0
    np.testing.assert_allclose(changed, G @ np.diag([0.1, 4.0]) @ G.T + 2 * np.eye(2), rtol=1e-15)


def test_one_mode_that_is_not_linear_makes_equations_of_all():
    model = SCALAR | {"f": ["p + dt*v", "v"], "h": ["p"]}
    spec = jumping({}, {"h": ["p*v"]})(model)
    first, second = (mode.equations for mode in spec.faults.jump.modes)
    assert first.evaluate([1.0, 2.0], [], [], {"dt": 0.5}) == ((2.0, 2.0), (1.0,))
    assert second.seen([3.0, 2.0], [], {"dt": 0.5}) == (6.0,)
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec


def test_matrices_state_what_the_other_equations_do_not():
    mixed = SCALAR | {"A": [[1.0, "dt"], [0.0, 1.0]], "h": ["atan2(p, 2.0)"]}
    equations = read(mixed).model.equations
    assert numbers(equations.moved([1.0, 3.0], [], [], {"dt": 0.5})).tolist() == [2.5, 3.0]
    wrapped = SCALAR | {"A": [[1.0, 0.1], [0.0, 1.0]], "C": [[1.0, 0.0]]}
    wrapped["outputs"] = [{"name": "y", "unit": "rad", "wrap": True}]
    assert read(wrapped).model.equations.evaluate([1.0, 2.0], [], [], {}) == ((1.2, 2.0), (1.0,))


@pytest.mark.parametrize(
    ("change", "key", "given"),
    [
        ({"h": ["sin(p)"]}, "model.h.y", "'sin(p)'"),
        ({"f": {"v": "v*p"}, "h": ["p"]}, "model.f.v", "'v * p'"),
        ({"outputs": [{"name": "y", "wrap": True}], "h": ["p"]}, "model.outputs[0].wrap", "angle"),
        ({"time": "continuous", "sample_time": 0.1, "h": ["p"]}, "model.f", "dx/dt"),
    ],
)
def test_a_linear_family_names_the_row_and_the_family_to_take(change, key, given):
    for family in ("kf", "linear_optimal", "dfcf"):
        with pytest.raises(SpecError) as caught:
            fkgen.Spec.from_dict(table(SCALAR | change, family=family))
        assert caught.value.key == key
        assert given in caught.value.given
        assert "take " in caught.value.expected


def test_a_matrix_of_equations_is_refused_where_it_is_used():
    model = read(ROBOT).model
    assert (model.nx, model.ne, model.nu, model.ny) == (3, 3, 2, 2)
    with pytest.raises(SpecError, match=r"model\.f"):
        model.A.values()
    attitude = read(ATTITUDE).model
    assert (attitude.nx, attitude.ne) == (7, 6)


def jumping(*modes, family="equations:FAMILY"):
    rows = [[1.0 / len(modes)] * len(modes)] * len(modes)
    faults = {"jump": {"transition": rows, "modes": list(modes)}}
    return lambda model: fkgen.Spec.from_dict(table(model, family=family, faults=faults))


def test_modes_state_single_equations_and_the_rest_is_the_model():
    own = {
        "f": {"heading": "heading - turn*k*dt"},
        "h": {"range": "x*c"},
        "let": {"k": "sin(x)"},
        "R": np.eye(2).tolist(),
    }
    changed = {"let": {"c": "2*cos(heading)"}}
    spec = jumping({}, own, changed)(ROBOT)
    plain, second, third = (mode.equations for mode in spec.faults.jump.modes)
    assert plain == spec.model.equations
    x, u, w, p = [1.0, 2.0, 0.3], [2.0, 0.5], [0.1], {"dt": 0.1}
    f, h = plain.evaluate(x, u, w, p)
    own_f, own_h = second.evaluate(x, u, w, p)
    assert own_f[:2] == f[:2]
    assert own_f[2] == pytest.approx(0.3 - 0.5 * math.sin(1.0) * 0.1, rel=1e-14)
    assert own_h[1] == h[1]
    assert own_h[0] == pytest.approx(math.cos(0.3), rel=1e-14)
    assert third.moved(x, u, w, p)[0] == pytest.approx(1.0 + 2.0 * 2 * math.cos(0.3) * 0.1)
    assert third.moved(x, u, w, p)[1] == f[1]
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    assert fkgen.Spec.from_dict(spec.to_dict()).canonical() == spec.canonical()
    titles = [mode.title for mode in spec.faults.jump.chain(spec.model).modes]
    assert titles == ["the model", "with its own f, h, R", "with its own f"]
    assert spec.faults.jump.chain(spec.model).alike("ABQc") == ((0,), (1,), (2,))
    assert spec.faults.jump.chain(spec.model).alike("C") == ((0, 2), (1,))


def test_modes_of_an_attitude_turn_on_their_own():
    spec = jumping({}, {"f": {"q": "q * [0, gx, rate[2]]"}})(ATTITUDE)
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    own = spec.faults.jump.modes[1].equations
    q = np.roll(Rotation.from_rotvec([0.0, 1.0, 0.3]).as_quat(), 1)
    moved = own.moved([1.0, 0, 0, 0, 0, 0, 0], [1.0, 0.0, 3.0], [], {"dt": 0.1})
    np.testing.assert_allclose(moved[:4], q, rtol=1e-14)


def test_one_who_is_told_the_mode_has_its_equations():
    modes = {}, {"f": {"x": "x + c*heading"}, "let": {"c": "x*y"}}, {"h": {"range": "x"}}
    spec = jumping(*modes)(ROBOT)
    told = spec.faults.jump.told().equations
    x, u, w = [1.0, 2.0, 0.3], [2.0, 0.5], [0.1]
    for i, mode in enumerate(spec.faults.jump.modes):
        p = {"dt": 0.1} | {f"in_mode_{j}": float(i == j) for j in range(3)}
        np.testing.assert_allclose(
            np.concatenate(told.evaluate(x, u, w, p)),
            np.concatenate(mode.equations.evaluate(x, u, w, p)),
            rtol=1e-14,
        )


def test_modes_with_linear_equations_are_matrices_for_linear_families():
    model = SCALAR | {"f": ["p + dt*v", "v"], "h": ["p"]}
    stated = jumping({}, {"f": {"v": "0.5*v"}}, family="mjls_lmmse")(model)
    matrices = jumping({}, {"A": [[1.0, "dt"], [0.0, 0.5]]}, family="mjls_lmmse")(model)
    assert stated == matrices
    with pytest.raises(SpecError, match="imm or mme") as caught:
        jumping({}, {"h": ["p*v"]}, family="mjls_lmmse")(model)
    assert caught.value.key == "faults.jump.modes[1].h.y"


def test_a_sensor_that_fails_has_no_h():
    faults = {"sensor": {"rows": ["range"], "noise_factor": 4.0}}
    faults["sensor"] |= {"problem": 1, "gamma_rate": 0.9, "delta_nominal_rate": 0.8}
    spec = read(ROBOT, faults=faults)
    modes = spec.faults.chain(spec.model).modes
    x, u = [1.0, 2.0, 0.3], [2.0, 0.5]
    seen = [mode.equations.seen(x, u, {"dt": 0.1}) for mode in modes]
    full = spec.model.equations.seen(x, u, {"dt": 0.1})
    assert seen == [full, full, (0.0, full[1]), (0.0, full[1])]
    assert [mode.R.rows[0][0].value for mode in modes] == [0.01, 0.04, 0.01, 0.04]
    told = spec.faults.sensor.told(spec.model).equations
    assert told.seen(x, u, {"dt": 0.1, "gamma": 0.0, "delta": 1.0})[0] == 0.0


@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_an_attitude_in_continuous_time_turns_by_the_mean_of_its_body_rates(integrator):
    given = {"time": "continuous", "sample_time": "dt", "integrator": integrator, "substeps": 2}
    let = {"field": "rotate_back(q, [1.0, 0.5, -2.0])"}
    f = {"q": "[gx, gy, gz] + cross(field, [bx, by, bz])", "bx": "field[1]", "by": "-bx"}
    model = ATTITUDE | given | {"let": let, "f": f, "h": ["bx", "by", "bz"]}
    equations = read(model).model.equations
    u = np.array([0.3, -0.2, 0.5])

    def rate(q, b):
        field = q.inv().apply([1.0, 0.5, -2.0])
        return u + np.cross(field, b), np.array([field[1], -b[0], 0.0])

    def after(q, b, rates, step):
        return q * Rotation.from_rotvec(step * rates[0]), b + step * rates[1]

    q, b = Rotation.from_rotvec([0.4, -1.0, 2.9]), np.array([0.2, 0.7, -0.4])
    start = np.roll(q.as_quat(), 1)
    step = 0.4 / 2
    for _ in range(2):
        k = k1 = rate(q, b)
        if integrator == "rk4":
            k2 = rate(*after(q, b, k1, step / 2))
            k3 = rate(*after(q, b, k2, step / 2))
            k4 = rate(*after(q, b, k3, step))
            k = [(i + 2 * j + 2 * m + n) / 6 for i, j, m, n in zip(k1, k2, k3, k4, strict=True)]
        q, b = after(q, b, k, step)
    found = np.array(equations.moved([*start, 0.2, 0.7, -0.4], u, [], {"dt": 0.4}))
    expected = np.roll(q.as_quat(), 1)
    np.testing.assert_allclose(found[:4], expected * np.sign(expected[0]), rtol=1e-13)
    np.testing.assert_allclose(found[4:], b, rtol=1e-13)


def test_decisions_and_tables_take_arrays():
    tables = {"bend": {"x": [0.0, 1.0, 3.0], "y": [1.0, 4.0, 2.0], "kind": "pchip"}}
    h = ["if(p > 1, log(p), interp(p, 'bend')) + sign(v)*min(p, v) + (p <= v) + max(p, 2)**2"]
    equations = read(SCALAR | {"h": h}, tables=tables).model.equations
    x = np.array([[-1.0, 0.0, 0.5, 1.0, 2.5, 4.0], [1.0, -2.0, 0.0, 1.0, 3.0, 2.0]])
    (seen,) = equations.seen(x, [], {"dt": 0.1})
    bend = fkgen.Spec.from_dict(table(SCALAR | {"h": h}, tables=tables)).tables[0]
    for p, v, found in zip(*x, seen, strict=True):
        first = math.log(p) if p > 1 else bend.value(p)
        expected = first + np.sign(v) * min(p, v) + (p <= v) + max(p, 2) ** 2
        assert found == pytest.approx(expected, rel=1e-14)
