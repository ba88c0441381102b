"""Attitudes at run time: what a filter starts from, what it shows, how its numbers are named."""

from __future__ import annotations

import equations
import numpy as np
import pytest
import random_equations
from plants import built, generated
from toolchain import needs_compiler, run_main

import fkgen
from fkgen.errors import DataError
from fkgen.study.records.filtering import columns_of, select
from fkgen.trials.errors import error_signals

pytestmark = needs_compiler()

#: Roundings of a length, in units of the last place.
LENGTH = {"double": 1e-15, "float": 6e-7}
CASES = {"ekf_attitude": (), "imm_attitude": ("mode_state",), "one_step_attitude": ()}
Q = np.array([0.5, -0.1, 0.7, 0.5])
Q /= np.linalg.norm(Q)


def prior_with(plant, q):
    """The prior of a spec with another attitude; it stands behind one other state."""
    x0 = plant.model.x0.values().ravel().copy()
    at = plant.model.attitudes[0]
    x0[at : at + 4] = q
    return x0, slice(at, at + 4)


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("case", CASES)
def test_a_start_scales_an_attitude_to_unit_length_and_turns_it_to_positive_w(case, scalar):
    plant = random_equations.spec(case, 0, scalar)
    filtering, ports = built(plant), ("predicted_state", "filtered_state", *CASES[case])
    for factor in (1.0, -1.0, 1.0 + 9e-4, -1.0 + 9e-4):
        x0, at = prior_with(plant, factor * Q)
        filtering.reset(x0=x0, P0=np.eye(plant.model.ne))
        there = filtering.snapshot()
        for port in ports:
            for state in np.atleast_2d(there[port]):
                np.testing.assert_allclose(state[at], Q, atol=4.0 * LENGTH[scalar])
                assert abs(np.linalg.norm(state[at].astype(float)) - 1.0) < LENGTH[scalar]
        np.testing.assert_array_equal(there.predicted_covariance, np.eye(plant.model.ne))
        started = {"x0": there.filtered_state, "P0": there.filtered_covariance}
        filtering.reset(**started)  # an estimate is taken up bit by bit
        assert filtering.snapshot() == there
        record = random_equations.record(plant)
        given = record.y, record.u, record.parameters
        one, other = (filtering.run(*given, start=each) for each in (there, started))
        for port in one.ports:
            np.testing.assert_array_equal(one[port], other[port])


def test_a_start_far_from_a_rotation_is_refused_and_changes_nothing():
    plant = random_equations.spec("ekf_attitude")
    filtering = built(plant)
    filtering.reset()
    before, ne = filtering.snapshot(), plant.model.ne
    for q, length in ((1.0011 * Q, "1.0011"), (0.9989 * Q, "0.9989"), (0.0 * Q, "0")):
        x0, at = prior_with(plant, q)
        with pytest.raises(
            DataError, match=rf"^x0\[{at.start}\]: given four numbers of length {length}; "
        ):
            filtering.reset(x0=x0)
        record = random_equations.record(plant)
        several = np.stack([prior_with(plant, Q)[0], x0])
        with pytest.raises(DataError, match=rf"^x0\[1, {at.start}\]: given four numbers of"):
            filtering.run_batch([record.y] * 2, record.u, record.parameters, start={"x0": several})
    n = plant.model.nx
    with pytest.raises(DataError, match=rf"P0: given shape \({n}, {n}\); .*q\[x\], q\[y\], q\[z\]"):
        filtering.reset(P0=np.eye(n))
    with pytest.raises(DataError, match=rf"x0: given shape \({ne},\); .*q\[0\], q\[1\], q\[2\]"):
        filtering.reset(x0=np.zeros(ne))
    assert filtering.snapshot() == before


def test_in_c_a_start_far_from_a_rotation_has_a_status_of_its_own(tmp_path):
    plant = equations.read(equations.ATTITUDE, family="ekf")
    generated(plant).write(tmp_path)
    body = """
    plant_t f, before;
    double x[PLANT_NX] = {1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3};
    double P[PLANT_NE * (PLANT_NE + 1) / 2] = {0};
    int i;
    for (i = 0; i < PLANT_NE; ++i) { P[PLANT_P(i, i)] = 1.0; }
    printf("%d %d\\n", (int)plant_init(&f), PLANT_NE);
    before = f;
    x[0] = 1.0011; printf("%d\\n", (int)plant_start(&f, x, P));
    x[0] = 0.0; printf("%d\\n", (int)plant_start(&f, x, P));
    x[0] = 1e300; printf("%d\\n", (int)plant_start(&f, x, P));
    x[1] = NAN; printf("%d\\n", (int)plant_start(&f, x, P));
    printf("%d\\n", memcmp(&f, &before, sizeof f));
    x[0] = -0.9995; x[1] = 0.0; printf("%d\\n", (int)plant_start(&f, x, P));
    printf("%.17g\\n", f.predicted_state[0]);
    """
    include = '#include <math.h>\n#include <stdio.h>\n#include <string.h>\n#include "plant.h"\n'
    text = f"{include}int main(void)\n{{\n{body}\n    return 0;\n}}\n"
    found = run_main(tmp_path, text, "plant.c", flags=["-lm"])
    assert found == ["0 6", "-8", "-8", "-8", "-2", "0", "0", "1"]
    assert "PLANT_NOT_A_ROTATION = -8" in (tmp_path / "plant.h").read_text(encoding="utf-8")
    linear = generated(equations.read({**LINEAR}, {}, family="kf"))
    assert "#define PLANT_NE 2\n" in linear.files["plant.h"]
    assert "ROTATION" not in linear.files["plant.h"]


LINEAR = {
    "A": [[1.0, 0.1], [0.0, 1.0]], "C": [[1.0, 0.0]], "Q": [[0.1, 0.0], [0.0, 0.1]],
    "R": [[1.0]], "x0": [0.0, 0.0], "P0": [[1.0, 0.0], [0.0, 1.0]],
}  # fmt: skip


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("case", CASES)
def test_attitudes_stay_of_unit_length_with_w_not_negative(case, scalar):
    """Four thousand samples of what the plant does not do: y and u are noise."""
    plant = random_equations.spec(case, 0, scalar)
    rng, T = np.random.default_rng(5), 4000
    y = rng.standard_normal((T, plant.model.ny))
    run = built(plant).run(y, rng.standard_normal((T, plant.model.nu)))
    assert not run.refused.any()
    for port in ("filtered_state", "predicted_state", *CASES[case]):
        q = run[port][..., prior_with(plant, Q)[1]].astype(float)
        assert np.abs(np.linalg.norm(q, axis=-1) - 1.0).max() < LENGTH[scalar]
        assert q[..., 0].min() >= 0.0
    assert np.linalg.eigvalsh(run.filtered_covariance.astype(float)).min() > -1e-6


def test_columns_of_covariances_are_named_by_axes_of_the_body():
    filtering = built(equations.read(equations.ATTITUDE, family="ekf"))
    assert filtering.layout.errors == ("q[x]", "q[y]", "q[z]", "bx", "by", "bz")
    states = equations.read(equations.ATTITUDE).model.states
    assert tuple(each.name for each in error_signals(states)) == filtering.layout.errors
    kept = ("filtered_state", "filtered_sd", "filtered_covariance")
    chosen = select(filtering.layout, kept)
    run = filtering.run(np.ones((3, 3)), np.zeros((3, 3)), keep=chosen.ports)
    columns = dict(columns_of(filtering.layout, run, chosen))
    assert [*columns][:5] == [*(f"filtered_state.q[{i}]" for i in range(4)), "filtered_state.bx"]
    assert [*columns][7:11] == [*(f"filtered_sd.q[{axis}]" for axis in "xyz"), "filtered_sd.bx"]
    cross = columns["filtered_covariance.bx.q[z]"]
    np.testing.assert_array_equal(cross, run.filtered_covariance[:, 3, 2])


def test_the_header_says_what_the_rows_of_covariances_are():
    model = equations.ATTITUDE | {
        "states": [
            {"name": "q", "manifold": "SO3"},
            *({"name": f"b{i}", "unit": "rad/s"} for i in "xyz"),
        ]
    }
    text = generated(equations.read(model, family="ekf")).files["plant.h"]
    assert " *   0  q[x], rad\n" in text
    assert " *   3  bx, rad/s\n" in text
    assert "[rad, rad, rad, rad/s, rad/s, rad/s] squared" in text
    assert "[-, -, -, -, rad/s, rad/s, rad/s]" in text


def test_a_figure_has_a_panel_for_an_attitude_and_one_for_each_other_state():
    from fkgen.study.records.record import Table
    from fkgen.study.reports.plots import draw

    spec = fkgen.Spec.from_dict(equations.table(equations.ATTITUDE, family="ekf"))
    rng, T = np.random.default_rng(1), 50
    y, u = 9.0 * rng.standard_normal((T, 3)), rng.standard_normal((T, 3))
    run = built(spec).run(y, u)
    table = Table(file="record", time=np.arange(T), y=y, u=u, params={})
    labels = [axis.get_ylabel() for axis in draw(spec, table, run).axes]
    assert labels[:4] == ["q", "bx", "by", "bz"]
    lines = draw(spec, table, run).axes[0].get_lines()
    drawn = np.array([line.get_ydata() for line in lines[:4]]).T
    assert (np.einsum("ki,ki->k", drawn[1:], drawn[:-1]) > 0.0).all()
    np.testing.assert_allclose(np.abs(drawn), np.abs(run.filtered_state[:, :4]))
