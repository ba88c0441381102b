"""A check finds what is wrong with a model, and nothing in a model that is sound."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import fkgen
from fkgen.study.reports.starters import starter


def track(**changes):
    """A point on a line, position measured."""
    model = {
        "A": [[1.0, 0.1], [0.0, 1.0]],
        "C": [[1.0, 0.0]],
        "Q": [[1e-4, 0.0], [0.0, 1e-2]],
        "R": [[1.0]],
        "x0": [0.0, 0.0],
        "P0": [[1.0, 0.0], [0.0, 1.0]],
        "states": [{"name": "position", "unit": "m"}, {"name": "speed", "unit": "m/s"}],
    }
    table = {"name": "track", "model": model | changes.pop("model", {}), "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table | changes)


def motor(family, **changes):
    """One state, one input that fails, seen directly (D = 1) unless told otherwise."""
    model = {
        "A": [[0.9]],
        "B": [[0.1]],
        "C": [[1.0]],
        "D": [[1.0]],
        "Q": [[1e-3]],
        "R": [[1e-2]],
        "x0": [0.0],
        "P0": [[1.0]],
    } | changes.pop("model", {})
    faults = {"dependence": "common"} | changes.pop("faults", {})
    options = {"family": family} | changes.pop("filter", {})
    table = {"name": "m", "model": model, "faults": {"actuator": faults}, "filter": options}
    return fkgen.Spec.from_dict(table | changes)


def codes(report, severity=None):
    return {f.code for f in report.findings if severity in {None, f.severity}}


def finding(report, code):
    return next(f for f in report.findings if f.code == code)


def test_a_sound_model_has_notes_only():
    report = fkgen.check(track())
    assert report.sound
    assert {f.severity for f in report.findings} == {"note"}
    assert report.values["observability_rank"] == 2
    assert report.values["spectral_radius"] == pytest.approx(1.0)
    assert report.values["innovation_rank"] == 1


def test_report_and_findings_are_frozen():
    report = fkgen.check(track())
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.findings = ()
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.findings[0].code = "x"


def test_the_stationary_filter_is_where_the_recursion_comes_to_rest():
    spec = track()
    A, C, Q, R = (getattr(spec.model, letter).values() for letter in "ACQR")
    P = np.eye(2)
    for _ in range(2000):
        S = C @ P @ C.T + R
        K = P @ C.T / S
        filtered = P - K @ S @ K.T
        P = A @ filtered @ A.T + Q
    values = fkgen.check(spec).values
    radius = np.abs(np.linalg.eigvals(A - A @ K @ C)).max()
    assert values["closed_loop_radius"] == pytest.approx(radius, rel=1e-6)
    assert values["time_constant_samples"] == pytest.approx(-1.0 / np.log(radius), rel=1e-6)
    for i, name in enumerate(("position", "speed")):
        assert values[f"stationary_sd.{name}"] == pytest.approx(np.sqrt(filtered[i, i]), rel=1e-6)


def test_the_time_constant_is_in_seconds_too_if_the_sample_time_is_known():
    values = fkgen.check(track(model={"sample_time": 0.1})).values
    assert values["time_constant_seconds"] == pytest.approx(0.1 * values["time_constant_samples"])
    assert "time_constant_seconds" not in fkgen.check(track()).values


def test_a_hidden_integrator_is_an_error_and_named():
    report = fkgen.check(track(model={"C": [[0.0, 1.0]]}))
    assert not report.sound
    found = finding(report, "undetectable")
    assert found.severity == "error"
    assert "nothing about position," in found.message
    assert found.remedy
    assert "no_stationary_filter" in codes(report)


def test_a_hidden_mode_that_dies_away_is_a_warning():
    report = fkgen.check(track(model={"A": [[0.5, 0.0], [0.0, 0.9]]}))
    assert report.sound
    assert finding(report, "unobservable").severity == "warning"
    assert report.values["observability_rank"] == 1


def test_an_unstable_plant_that_is_seen_is_a_note():
    report = fkgen.check(track(model={"A": [[1.2, 0.1], [0.0, 1.0]]}))
    assert report.sound
    assert finding(report, "unstable_plant").value == pytest.approx(1.2)


def test_a_constant_without_noise_puts_the_filter_to_sleep():
    report = fkgen.check(track(model={"Q": [[1e-4, 0.0], [0.0, 0.0]]}))
    found = finding(report, "not_stabilisable")
    assert found.severity == "warning"
    assert "reaches speed," in found.message
    assert "closed_loop_radius" not in report.values


def test_a_zero_row_of_C_is_a_sensor_that_says_nothing():
    model = {"C": [[1.0, 0.0], [0.0, 0.0]], "R": [[1.0, 0.0], [0.0, 1.0]]}
    assert finding(fkgen.check(track(model=model)), "silent_output").message.startswith("y1 ")


def test_a_zero_row_of_C_with_a_direct_input_says_something():
    model = {"C": [[1.0], [0.0]], "D": [[0.0], [1.0]], "R": [[1.0, 0.0], [0.0, 1.0]]}
    spec = motor("mkf", model=model, faults={"success_rate": 0.7})
    assert "silent_output" not in codes(fkgen.check(spec))


def test_a_state_that_nothing_drives_is_named():
    model = {"A": [[0.9, 0.1], [0.0, 0.0]], "Q": [[1.0, 0.0], [0.0, 0.0]]}
    assert "drives speed:" in finding(fkgen.check(track(model=model)), "idle_state").message


def test_a_measurement_without_noise_is_named():
    report = fkgen.check(track(model={"R": [[0.0]]}))
    assert "y0 without noise" in finding(report, "noise_free_output").message
    assert report.values["prior_to_noise"] == np.inf
    assert report.values["joseph_form"] == 1.0
    assert json.loads(report.to_json())["values"]["prior_to_noise"] is None


def test_two_exact_copies_of_one_measurement_lack_rank():
    model = {"C": [[1.0, 0.0], [1.0, 0.0]], "R": [[1.0, 1.0], [1.0, 1.0]]}
    report = fkgen.check(track(model=model))
    assert report.values["innovation_rank"] == 1
    assert finding(report, "innovation_rank").value == 1
    assert "R is singular" in finding(report, "noise_free_output").message


def test_a_vague_prior_names_the_form_of_the_update():
    vague = {"P0": [[1e9, 0.0], [0.0, 1.0]]}
    report = fkgen.check(track(model=vague))
    assert "joseph" in finding(report, "conditioning").message
    assert report.values["prior_to_noise"] == pytest.approx(1e9)


def test_the_short_form_in_float_with_a_vague_prior_is_an_error():
    code = {"scalar": "float", "update": "short"}
    report = fkgen.check(track(model={"P0": [[1e9, 0.0], [0.0, 1.0]]}, code=code))
    assert not report.sound
    assert "joseph" in finding(report, "conditioning").remedy


def test_numbers_beyond_float_are_an_error_in_float_only():
    model = {"C": [[1.0, 1e-39]]}
    assert "float_range" in codes(
        fkgen.check(track(model=model, code={"scalar": "float"})), "error"
    )
    assert "float_range" not in codes(fkgen.check(track(model=model)))


def test_process_noise_below_the_rounding_of_float_is_a_warning():
    model = {"Q": [[1e-12, 0.0], [0.0, 1e-10]], "R": [[1e4]]}
    report = fkgen.check(track(model=model, code={"scalar": "float"}))
    assert "rounding" in codes(report, "warning")
    assert "rounding" not in codes(fkgen.check(track(model=model)))


def test_a_parameter_that_nothing_uses_is_a_warning():
    report = fkgen.check(track(parameters={"tau": 1.0}))
    assert "tau" in finding(report, "unused_parameter").message
    assert "time_varying" not in codes(report)


def test_figures_of_a_time_varying_model_are_for_the_defaults():
    spec = track(parameters={"dt": 0.1}, model={"A": [[1.0, "dt"], [0.0, 1.0]]})
    report = fkgen.check(spec)
    assert "dt = 0.1" in finding(report, "time_varying").message
    constant = fkgen.check(track())
    assert report.values["closed_loop_radius"] == constant.values["closed_loop_radius"]


def test_a_parameter_in_a_success_rate_is_used():
    spec = motor("mkf", faults={"success_rate": "xi"}, parameters={"xi": 0.7})
    assert "unused_parameter" not in codes(fkgen.check(spec))


@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_certain_rates_are_noted(rate):
    report = fkgen.check(motor("mkf", faults={"success_rate": rate}))
    assert finding(report, "certain_rate").value == rate


def test_without_feedthrough_the_fault_is_process_noise():
    spec = motor("mkf", model={"D": [[0.0]]}, faults={"success_rate": 0.7})
    assert finding(fkgen.check(spec), "no_feedthrough").severity == "note"


def test_the_fault_itself_gives_the_innovation_rank_if_there_is_an_input():
    model = {"C": [[1.0], [0.0]], "D": [[0.0], [1.0]], "R": [[1.0, 0.0], [0.0, 0.0]]}
    report = fkgen.check(motor("mkf", model=model, faults={"success_rate": 0.7}))
    assert report.values["innovation_rank"] == 1
    assert report.values["innovation_rank_driven"] == 2


def bank(**options):
    return {"hypotheses": [0.3, 0.5, 0.7]} | options


def test_mirrored_hypotheses_are_noted():
    report = fkgen.check(motor("mme", filter=bank()))
    assert "0.3 and 0.7" in finding(report, "mirrored_hypotheses").message
    assert finding(report, "needs_input").severity == "note"


def test_equal_hypotheses_are_a_warning():
    report = fkgen.check(motor("mme", filter=bank(hypotheses=[0.3, 0.3])))
    assert "same_hypotheses" in codes(report, "warning")


def test_identification_without_feedthrough_is_slow_but_not_impossible():
    report = fkgen.check(motor("mme", model={"D": [[0.0]]}, filter=bank()))
    assert report.sound
    assert finding(report, "slow_identification").severity == "warning"


def test_inputs_that_never_reach_the_outputs_identify_nothing():
    model = {
        "A": [[0.9, 0.0], [0.1, 0.9]],
        "B": [[0.0], [1.0]],
        "C": [[1.0, 0.0]],
        "D": [[0.0]],
        "Q": [[1.0, 0.0], [0.0, 1.0]],
        "x0": [0.0, 0.0],
        "P0": [[1.0, 0.0], [0.0, 1.0]],
    }
    assert "unidentifiable" in codes(fkgen.check(motor("mme", model=model, filter=bank())), "error")


def test_many_independent_inputs_fall_back_to_the_gaussian():
    model = {"B": [[0.1] * 5], "D": [[1.0] * 5]}
    faults = {"dependence": "independent"}
    spec = motor("mme", model=model, faults=faults, filter=bank(hypotheses=[0.3, 0.8]))
    assert finding(fkgen.check(spec), "gaussian_likelihood").value == 5


def test_the_floor_is_judged():
    none = fkgen.check(motor("mme", filter=bank(weight_floor=0.0)))
    assert finding(none, "no_weight_floor").severity == "note"
    high = fkgen.check(motor("mme", filter=bank(weight_floor=0.1)))
    assert finding(high, "high_weight_floor").value == pytest.approx(0.3)
    usual = codes(fkgen.check(motor("mme", filter=bank())))
    assert not usual & {"no_weight_floor", "high_weight_floor"}


def test_large_code_is_a_warning_and_many_states_are_not(monkeypatch):
    n = 18
    rng = np.random.default_rng(1)
    model = {
        "A": (0.1 * rng.normal(size=(n, n))).tolist(),
        "C": rng.normal(size=(4, n)).tolist(),
        "Q": np.eye(n).tolist(),
        "R": np.eye(4).tolist(),
        "x0": [0.0] * n,
        "P0": np.eye(n).tolist(),
    }
    table = {"name": "large", "model": model, "filter": {"family": "kf"}}
    report = fkgen.check(fkgen.Spec.from_dict(table))
    assert report.values["flops_per_step"] > 8000
    assert "large_code" not in codes(report, "warning")
    monkeypatch.setattr("fkgen.study.diagnostics.check.LARGE", 10)
    assert "large_code" in codes(fkgen.check(fkgen.Spec.from_dict(table)), "warning")


@pytest.mark.parametrize("family", ["kf", "mkf", "mme"])
def test_starters_are_sound(family, tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(starter(family), encoding="utf-8")
    report = fkgen.check(fkgen.load(path))
    assert {f.severity for f in report.findings} <= {"note"}


def test_units_do_not_change_findings():
    unit = np.array([1e6, 1e-3])
    spec = track()
    model = {
        "A": (spec.model.A.values() * unit[:, None] / unit).tolist(),
        "C": (spec.model.C.values() / unit).tolist(),
        "Q": (spec.model.Q.values() * np.outer(unit, unit)).tolist(),
        "P0": (spec.model.P0.values() * np.outer(unit, unit)).tolist(),
    }
    here, there = fkgen.check(spec), fkgen.check(track(model=model))
    assert codes(here) == codes(there)
    assert here.values["closed_loop_radius"] == pytest.approx(there.values["closed_loop_radius"])
    there_sd = there.values["stationary_sd.speed"]
    assert there_sd == pytest.approx(1e-3 * here.values["stationary_sd.speed"])
