"""Equations without a value where a filter is: the sample is refused, and told which they are."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import equations
import numpy as np
import pytest
from click.testing import CliRunner
from equations import ATTITUDE, ROBOT
from plants import built
from toolchain import needs_compiler

import fkgen
from fkgen.cli import main
from fkgen.errors import StepRefused
from fkgen.study.records import csv_files

pytestmark = needs_compiler()

MODEL = {
    "states": [{"name": "a"}, {"name": "b"}], "outputs": [{"name": "y"}],
    "Q": [[1e-6, 0.0], [0.0, 1e-6]], "R": [[0.1]], "x0": [3.0, 0.5],
    "P0": [[1e-4, 0.0], [0.0, 1e-4]],
}  # fmt: skip
SECTIONS = {
    "ekf": {},
    "imm": {
        "faults": {
            "jump": {
                "transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5],
                "modes": [{}, {"R": [[1.0]]}],
            }
        }
    },
    "genie": {"faults": {"sensor": {"noise_factor": 4.0, "rows": [0]}}},
}  # fmt: skip
#: f of a, and h; a is -1, where neither root nor logarithm has a value. Decisions hide that.
CASES = {
    "a root": ("a", "sqrt(a) + sin(b)"),
    "a motion": ("log(a) + 1", "a + sin(b)"),
    "a comparison": ("a", "if(log(a) > 0, sin(a), 2*b)"),
    "a comparison of the motion": ("if(log(a) > 0, sin(a), 2*b)", "a + sin(b)"),
    "a smaller one": ("a", "min(sqrt(a), 3) + b"),
    "a place in a table": ("a", "interp(log(a), 'curve') + b"),
}


@pytest.mark.parametrize("family", SECTIONS)
@pytest.mark.parametrize("case", CASES)
def test_a_sample_at_which_equations_have_no_value_is_refused(family, case):
    f, h = CASES[case]
    tables = {"curve": {"x": [0.0, 1.0], "y": [0.0, 1.0]}}
    model = MODEL | {"f": {"a": f}, "h": {"y": h}}
    given = equations.table(model, {}, family, tables=tables, **SECTIONS[family])
    found = built(fkgen.Spec.from_dict(given))
    told = {"gamma": 1.0, "delta": 1.0} if family == "genie" else None
    found.reset()
    assert found.step([1.0], None, told).status == 0
    found.reset(x0=[-1.0, 0.5])
    before = found.snapshot()
    with pytest.raises(StepRefused) as caught:
        found.step([1.0], None, told)
    assert caught.value.name == "PLANT_RESULT_NOT_FINITE"
    assert found.snapshot() == before
    run = found.run(np.ones((2, 1)), None, told, start={"x0": [-1.0, 0.5]})
    assert (run.status == -5).all()
    assert np.isfinite(run.filtered_state).all()


FAMILIES = {**SECTIONS, "iekf": {}, "ukf": {}}
TABLES = {"curve": {"x": [0.0, 1.0], "y": [0.0, 1.0]}}


def filter_of(model, family="ekf", parameters=None, **sections):
    own = {**FAMILIES[family], **sections}
    return built(fkgen.Spec.from_dict(equations.table(model, parameters or {}, family, **own)))


def refused(call, *given):
    with pytest.raises(StepRefused) as caught:
        call(*given)
    assert str(caught.value).endswith(caught.value.reason)
    assert "\n" not in str(caught.value)
    return caught.value.reason


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("case", CASES)
def test_the_text_that_has_no_value_is_named(family, case):
    f, h = CASES[case]
    found = filter_of(MODEL | {"f": {"a": f}, "h": {"y": h}}, family, tables=TABLES)
    found.reset(x0=[-1.0, 0.5])
    before = found.snapshot()
    told = {"gamma": 1.0, "delta": 1.0} if family == "genie" else None
    key, text = ("f.a", f) if "motion" in case else ("h.y", h)
    reason = refused(found.step, [1.0], None, told)
    assert f"{key} = {text} has a " in reason
    assert "not a number at a = -" in reason
    assert found.snapshot() == before
    assert (
        refused(found.update if key == "h.y" else found.predict, *([1.0] * (key == "h.y"))) or told
    )


def test_a_derivative_is_named_with_the_state_by_which_it_is_taken():
    found = filter_of(
        MODEL | {"h": {"y": "sqrt(a - 3) + b"}, "f": {"b": "hypot(a - 1, b)"}, "x0": [4.0, 0.5]}
    )
    found.reset(x0=[3.0, 0.5])
    said = "h.y = sqrt(a - 3) + b has a derivative with respect to a that is infinite"
    assert refused(found.update, [1.0]) == f"{said} at a = 3, b = 0.5"
    found.reset(x0=[1.0, 0.0])
    said = "f.b = hypot(a - 1, b) has a derivative with respect to a that is not a number"
    assert refused(found.predict) == f"{said} at a = 1, b = 0"


def test_what_points_do_not_need_is_no_reason_for_ukf():
    model = MODEL | {"h": {"y": "abs(a - 3)**0.5 + b"}, "x0": [4.0, 0.5]}
    found = filter_of(model, "ukf")
    found.reset(x0=[3.0, 0.5])
    assert found.update([1.0]).status == 0


def test_a_definition_is_named_where_it_has_no_value_and_not_those_that_need_it():
    let = {"inner": "log( a )", "outer": "inner + b", "v": ["outer", "2*outer"]}
    found = filter_of(MODEL | {"let": let, "h": {"y": "v[1] + if(b > 0, 1, inner)"}})
    found.reset(x0=[0.0, 0.5])
    assert (
        refused(found.update, [1.0]) == "let.inner = log( a ) has a value that is infinite at a = 0"
    )


def test_a_branch_that_is_not_taken_is_no_reason():
    let = {"hidden": "log(a)", "shown": "sqrt(b)"}
    model = MODEL | {"let": let, "h": {"y": "if(a > 0, hidden, 1) + shown + sin(a)"}}
    found = filter_of(model, "ukf")
    found.reset(x0=[-1.0, -0.5])
    assert "let.shown = sqrt(b) has a value that is not a number at b = -0.5" in refused(
        found.update, [1.0]
    )


def test_f_is_looked_at_wherever_runge_and_kutta_take_it():
    time = {"time": "continuous", "sample_time": 1.0, "x0": [300.0, 0.5]}
    found = filter_of(MODEL | time | {"f": {"a": "-0.1*sqrt(a)"}, "h": {"y": "a + b"}})
    found.reset(x0=[1e-4, 0.0])  # half a step from there is 1e-4 - 0.05 * 0.01
    assert refused(found.predict) == (
        "f.a = -0.1*sqrt(a) has a value that is not a number at a = -0.0004"
    )


def test_modes_are_told_apart_and_have_their_own_texts():
    jump = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5]}
    jump["modes"] = [{}, {"h": {"y": "sqrt(a)  - b"}}]
    model = MODEL | {"h": {"y": "a + b + sin(a)"}}
    found = filter_of(model, "imm", faults={"jump": jump})
    found.reset(x0=[-1.0, 0.5])
    assert refused(found.step, [1.0]).startswith("mode 1: h.y = sqrt(a) - b has a value")


def test_inputs_parameters_and_points_of_noises_are_among_the_values():
    change = {"h": {"range": "hypot(x, y)*sqrt(gain)", "bearing": "heading"}}
    found = filter_of(ROBOT | change, parameters={"dt": 0.1, "gain": 1.0})
    reason = refused(found.update, [1.0, 0.0], [2.0, 0.0], {"gain": -4.0})
    assert reason.startswith("h.range = hypot(x, y)*sqrt(gain) has a value that is not a number")
    assert reason.endswith("at x = 3, y = 4, gain = -4")
    change = {"f": {"heading": "heading + sqrt(gain + w_turn)*dt"}}
    found = filter_of(ROBOT | change, "ukf", {"dt": 0.1, "gain": 1.0})
    reason = refused(found.predict, [2.0, 0.0], {"gain": 0.01})
    said = "f.heading = heading + sqrt(gain + w_turn)*dt has a value that is not a number"
    assert reason.startswith(said)
    assert "w_turn = -0.02, " in reason  # 0.01 sqrt(4): three states and a noise


@pytest.mark.parametrize("family", ["ekf", "ukf"])
def test_an_attitude_is_named_by_its_numbers(family):
    model = {**ATTITUDE, "x0": [1.0, *[0.0] * 6]} | {
        "h": {"ax": "sqrt(q[0] - 0.5)", "ay": "a[1]", "az": "a[2]"}
    }
    found = filter_of(model, family, {"dt": 0.1})
    found.reset(x0=[0.1, np.sqrt(0.99), *[0.0] * 5])
    reason = refused(found.update, [0.0] * 3, [0.0] * 3)
    assert reason.startswith("h.ax = sqrt(q[0] - 0.5) has a value that is not a number at q[0] = ")


def test_a_number_beyond_float_is_too_large():
    found = filter_of(MODEL | {"h": {"y": "exp(a) + b"}}, code={"scalar": "float"})
    found.reset(x0=[100.0, 0.5])
    assert refused(found.update, [1.0]) == (
        "h.y = exp(a) + b has a value that is too large (2.68812e+43) at a = 100, b = 0.5"
    )


def test_another_reason_is_not_made_one_of_equations():
    found = filter_of(MODEL | {"h": {"y": "sin(a) + b"}})
    assert refused(found.step, [np.inf]) == ""
    assert refused(found.step, [1e300]) == ""


def test_copies_and_filters_in_other_processes_know_the_reason(tmp_path):
    found = filter_of(MODEL | {"h": {"y": "sqrt(a)+sin(b)"}})
    found.reset(x0=[-1.0, 0.5])
    expected = refused(found.step, [1.0])
    assert "h.y = sqrt(a)+sin(b) has" in expected
    assert refused(copy.copy(found).step, [1.0]) == expected
    path = tmp_path / "filter"
    path.write_bytes(pickle.dumps(found))
    code = (
        "import pickle, sys\n"
        "import fkgen\n"
        f"found = pickle.load(open({str(path)!r}, 'rb'))\n"
        "try:\n"
        "    found.step([1.0])\n"
        "except fkgen.StepRefused as refused:\n"
        "    print(refused.reason)\n"
        "assert 'casadi' not in sys.modules\n"
        "assert 'sympy' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, expected), done.stderr


def test_equal_models_in_other_words_are_told_in_their_own():
    for text in ("sqrt(a) + sin(b)", "sqrt( a )+sin(b)"):
        table = equations.table(MODEL | {"h": {"y": text}}, {}, "ekf")
        found = fkgen.build(fkgen.Spec.from_dict(table))
        found.reset(x0=[-1.0, 0.5])
        assert f"h.y = {text} has" in refused(found.step, [1.0])


TOML = """
name = "tank"
[model]
states = [{name = "level", unit = "m"}]
inputs = [{name = "inflow"}]
outputs = [{name = "head"}]
Q = [[1e-12]]
R = [[0.01]]
x0 = [40.0]
P0 = [[1e-10]]
[model.f]
level = "level + 0.1*inflow - 0.1*sqrt(level)"
[model.h]
head = "level**2"
[filter]
family = "ekf"
"""


@pytest.mark.parametrize("block", [60, 1 << 22])
def test_a_run_names_the_equation_of_the_first_sample_that_is_refused(tmp_path, monkeypatch, block):
    monkeypatch.setattr(csv_files, "BLOCK", block)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tank.toml").write_text(TOML, encoding="utf-8")
    rows = ["0.0,"] * 20 + ["-410.0,", "0.0,", "0.0,"]  # at the second to last it is empty
    (tmp_path / "r.csv").write_text("\n".join(["inflow,head", *rows]) + "\n", encoding="utf-8")
    result = CliRunner().invoke(main, ["run", "tank.toml", "r.csv"], prog_name="fkgen")
    assert result.exit_code == 1, result.output
    (line,) = [each for each in result.stderr.splitlines() if "samples refused" in each]
    assert "2 samples refused, the first in line 23: TANK_RESULT_NOT_FINITE" in line
    level = 40.0
    for inflow in [*[0.0] * 20, -410.0]:
        level = level + 0.1 * inflow - 0.1 * np.sqrt(level)
    said = "f.level = level + 0.1*inflow - 0.1*sqrt(level) has a value that is not a number at"
    assert f": the result would not be finite: {said} level = {level:g}, inflow = 0; held" in line
