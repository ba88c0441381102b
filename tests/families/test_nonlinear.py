"""Compiled ekf, iekf and ukf are the filters that NumPy writes down, whatever the equations."""

from __future__ import annotations

import equations
import numpy as np
import pytest
from click.testing import CliRunner
from nonlinear_specs import CASES, in_numpy, record_of, spec_of
from plants import built, distance, interpreted, random_model, run, spec

import fkgen
from fkgen.cli import main
from fkgen.study.reports.starters import starter

FILTERS = {
    "ekf": ("ekf", {}),
    "iekf": ("iekf", {"iterations": 2}),
    "ukf": ("ukf", {}),
    "ukf with a centre": ("ukf", {"kappa": 1.5}),
}
#: Two double computations; what a last step of iekf goes that rounding decides on comes on top.
EXACT = 1e-9


def given(values):
    """Parameters as `run` takes them: the entries of vectors by their names."""
    return dict(values)


def compared(found, expected, tolerance):
    expected = dict(expected)
    doubt = float(expected.pop("doubt", np.zeros(1)).max())
    decided = expected.pop("decided", None)
    if decided is not None:
        count = len(decided) if decided.all() else int(decided.argmin())
        stayed = expected.pop("stayed")[:count]
        np.testing.assert_array_equal(found["stayed"][:count], stayed)
    errors = {port: distance(found[port], value) for port, value in expected.items()}
    wrong = {port: error for port, error in errors.items() if not error <= tolerance + 10.0 * doubt}
    assert not wrong


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", FILTERS)
def test_ports_are_those_of_the_filter_in_numpy(name, case):
    family, options = FILTERS[name]
    plant = spec_of(case, family, **options)
    y, u, params = record_of(plant)
    found = built(plant).run(y, u if plant.model.nu else None, params)
    assert (found.status >= 0).all()
    compared(found, in_numpy(plant, y, u, params), EXACT)


#: Two rows of the six: factors are written in straight lines.
SHORT = {"outputs": [{"name": "ax"}, {"name": "my"}], "h": {"ax": "a[0]", "my": "b[1]"}}
SHORT |= {"R": [[0.4, 0.1], [0.1, 0.3]]}


@pytest.mark.parametrize(
    ("family", "options"),
    [("iekf", {"iterations": 2}), ("ukf", {}), ("ukf", {"kappa": 1.5})],
    ids=["iekf", "ukf", "ukf with a centre"],
)
@pytest.mark.parametrize(("case", "rows"), [("circle", {}), ("attitude", SHORT)])
def test_steps_and_points_are_the_same_in_factors(case, rows, family, options):
    plant = spec_of(case, family, code={"update": "ud"}, model=rows, **options)
    y, u, params = record_of(plant)
    compared(interpreted(plant, y, u, params), in_numpy(plant, y, u, params), EXACT)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_other_coefficients_and_records_agree_too(name, seed):
    family, options = FILTERS[name]
    for case in ("polynomial", "circle"):
        plant = spec_of(case, family, seed=seed, **options)
        y, u, params = record_of(plant, 20, seed=seed)
        compared(interpreted(plant, y, u, params), in_numpy(plant, y, u, params), EXACT)


@pytest.mark.parametrize("case", ["circle", "attitude"])
@pytest.mark.parametrize("name", FILTERS)
def test_in_float_they_are_those_in_double(name, case):
    family, options = FILTERS[name]
    plant = spec_of(case, family, code={"scalar": "float"}, **options)
    y, u, params = record_of(plant)
    found = built(plant).run(y, u if plant.model.nu else None, params)
    expected = in_numpy(plant, y, u, params)
    for port in ("filtered_state", "filtered_covariance", "predicted_state", "innovation"):
        # Some hundred roundings of 6e-8; steps of iekf are decided on at 1e-4 deviations.
        assert distance(found[port], expected[port]) < 2e-3, port


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("direct", [False, True])
def test_a_linear_plant_is_that_of_kf(name, direct):
    family, options = FILTERS[name]
    model = random_model(4, 3, 2, 1, direct=direct, correlated=True)
    names = {"states": "abc", "inputs": "u", "outputs": "pr"}
    by = [*"abcu"]
    stated = {key: model[key] for key in ("Q", "R", "x0", "P0")}
    stated |= {key: [{"name": each} for each in of] for key, of in names.items()}
    D = model.get("D", np.zeros((2, 1)))
    for key, matrix in (
        ("f", np.hstack([model["A"], model["B"]])),
        ("h", np.hstack([model["C"], D])),
    ):
        rows = [
            " + ".join(f"({float(v)!r})*{x}" for v, x in zip(r, by, strict=True)) for r in matrix
        ]
        stated[key] = dict(zip(names["states" if key == "f" else "outputs"], rows, strict=True))
    rng = np.random.default_rng(3)
    y, u = rng.normal(size=(30, 2)), rng.normal(size=(30, 1))
    y[4], y[7, 0] = np.nan, np.nan
    expected = run(spec(model, family="kf"), y, u)
    for each in (model, stated):
        found = run(spec(each, family=family, **options), y, u)
        for port in expected.ports:
            if family == "ekf":
                np.testing.assert_array_equal(found[port], expected[port], err_msg=port)
            assert distance(found[port], expected[port]) < 1e-12, port


@pytest.mark.parametrize("name", FILTERS)
def test_points_and_steps_of_what_is_affine_give_the_same(name):
    """An output that wraps keeps a plant from being linear; innovations are short of a turn."""
    family, options = FILTERS[name]
    model = {
        "states": [{"name": "a", "wrap": True}, {"name": "b"}],
        "outputs": [{"name": "p", "wrap": True}, {"name": "r"}],
        "noises": [{"name": "w", "variance": 2e-4}],
        "Q": np.diag([1e-4, 1e-4]).tolist(),
        "R": [[1e-3, 2e-4], [2e-4, 1e-3]],
        "x0": [3.1, 0.2],
        "P0": [[1e-2, 1e-3], [1e-3, 1e-2]],
        "f": {"a": "a + 0.4*b", "b": "0.9*b + w"},
        "h": {"p": "a + 0.1*b", "r": "b"},
    }
    plant = equations.table(model, {"k": 1.0}, family)
    plant["filter"] |= options
    plant = fkgen.Spec.from_dict(plant)
    plain = [{key: each[key] for key in ("name",)} for each in model["states"]]
    table = {
        "A": [[1.0, 0.4], [0.0, 0.9]],
        "C": [[1.0, 0.1], [0.0, 1.0]],
        "Q": [[1e-4, 0.0], [0.0, 3e-4]],
    }
    linear = spec(
        {key: model[key] for key in ("R", "x0", "P0")} | table | {"states": plain}, family="kf"
    )
    y, u, _ = record_of(plant, 20)
    y[:, 0] %= 2.0 * np.pi
    expected = run(linear, y, u)
    found = built(plant).run(y)
    for port in ("filtered_state", "filtered_covariance", "predicted_covariance", "nis"):
        assert distance(found[port], expected[port]) < 1e-9, port


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("case", ["circle", "attitude"])
def test_calls_in_any_order(name, case):
    family, options = FILTERS[name]
    plant = spec_of(case, family, **options)
    one, other = (fkgen.build(plant) for _ in range(2))
    y, u, _ = record_of(plant, 3, missing=0.0)
    u = u if plant.model.nu else [None] * 3
    stepped = one.step(y[0], u[0])
    other.update(y[0], u[0])
    halves = other.predict(u[0])
    for port in ("filtered_state", "predicted_state", "predicted_covariance"):
        assert distance(halves[port], stepped[port]) < 1e-13
    skipped = one.step(np.full(plant.model.ny, np.nan), u[1])
    moved = other.predict(u[1])
    np.testing.assert_array_equal(moved.predicted_state, skipped.predicted_state)
    np.testing.assert_array_equal(moved.predicted_covariance, skipped.predicted_covariance)


@pytest.mark.parametrize("family", ["ekf", "ukf"])
def test_a_row_without_noise_is_believed(family):
    exact = {"R": [[0.0, 0.0], [0.0, 0.1]]}
    plant = spec_of("circle", family, model=exact)
    y, u, params = record_of(plant, missing=0.1)
    found = built(plant).run(y, None, params)
    expected = in_numpy(plant, y, u, params)
    for port in ("filtered_state", "filtered_covariance", "predicted_state"):
        assert distance(found[port], expected[port]) < 1e-6, port


def test_iekf_needs_noise_in_every_row():
    for R in ([[0.0, 0.0], [0.0, 0.1]], [[1.0, 1.0], [1.0, 1.0]]):
        with pytest.raises(fkgen.SpecError, match="positive definite R") as fault:
            spec_of("circle", "iekf", model={"R": R})
        assert fault.value.key == "model.R"


@pytest.mark.parametrize(
    ("family", "options", "key"),
    [
        ("iekf", {"iterations": 0}, "filter.iterations"),
        ("iekf", {"iterations": 2.5}, "filter.iterations"),
        ("iekf", {"iterations": 21}, "filter.iterations"),
        ("iekf", {"gate": 0.99}, "filter.gate"),
        ("iekf", {"kappa": 1.0}, "filter.kappa"),
        ("ukf", {"kappa": -0.1}, "filter.kappa"),
        ("ukf", {"gate": 0.99}, "filter.gate"),
        ("ukf", {"iterations": 3}, "filter.iterations"),
        ("ekf", {"iterations": 3}, "filter.iterations"),
    ],
)
def test_options_of_others_and_out_of_range_are_refused(family, options, key):
    with pytest.raises(fkgen.SpecError) as fault:
        spec_of("circle", family, **options)
    assert fault.value.key == key
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("family", ["ekf", "iekf", "ukf"])
def test_what_has_no_value_is_refused_and_changes_nothing(family):
    model = {
        "states": [{"name": "a"}],
        "outputs": [{"name": "y"}],
        "noises": [{"name": "w", "variance": "v"}],
        "Q": [[1e-4]],
        "R": [[0.01]],
        "x0": [0.5],
        "P0": [[0.01]],
        "f": {"a": "a*k + w"},
        "h": {"y": "log(a)"},
    }
    found = fkgen.build(equations.read(model, {"v": 1e-4, "k": 1.0}, family=family))
    y = np.log(np.full((4, 1), 0.5))
    good = {"v": np.full(4, 1e-4), "k": np.full(4, 1.0)}
    assert (found.run(y, params=good).status >= 0).all()
    v = good["v"].copy()
    v[1] = -1e-9
    status = found.run(y, params=good | {"v": v}).status
    assert status[1] == -4
    assert (np.delete(status, 1) >= 0).all()
    k = good["k"].copy()
    k[1] = -1.0  # the next state is negative, and has no logarithm
    result = found.run(y, params=good | {"k": k})
    assert result.status[2] == -5
    assert np.isfinite(result.filtered_state).all()


def test_verify_takes_equations(tmp_path):
    (tmp_path / "s.toml").write_text(starter("ekf"), encoding="utf-8")
    result = CliRunner().invoke(main, ["verify", str(tmp_path / "s.toml")])
    assert result.exit_code == 0, result.output
