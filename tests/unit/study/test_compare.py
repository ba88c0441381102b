"""Comparison of filters: known numbers, honest ties, costs, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import plants
import pytest
from click.testing import CliRunner
from sensor_specs import SCALAR

import fkgen
from fkgen.cli import main
from fkgen.study.comparisons.footprint import Footprint
from fkgen.study.comparisons.ranking import Estimate, Score, beaten, mean, ratio, recommended
from fkgen.study.comparisons.scores import detection, weighted_squares

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
EXAMPLE_1 = EXAMPLES / "sensor_faults" / "example1.toml"


@pytest.fixture(scope="module")
def found():
    families = ("imm", "one_step", "linear_optimal", "kf", "linear_optimal:form=augmented")
    return fkgen.compare(fkgen.load(EXAMPLE_1), families, seed=3)


#: Ten thousand runs of independent code: MSE over the genie's and its standard error, NEES.
KNOWN = {
    "imm": (1.3603, 0.0031, 0.999),
    "one_step": (1.3810, 0.0034, 0.958),
    "linear_optimal": (1.5956, 0.0044, 1.205),
    "linear_optimal:form=augmented": (1.5082, 0.0038, 0.999),
    "kf": (1.8331, 0.0053, 3.899),
}


@pytest.mark.parametrize("label", KNOWN)
def test_errors_over_the_genie_are_those_of_the_paper_s_example(found, label):
    row, (value, error, nees) = found.row(label), KNOWN[label]
    assert abs(row.relative.value - value) < 4.0 * np.hypot(row.relative.error, error)
    assert abs(row.nees.value - nees) < 4.0 * np.hypot(row.nees.error, 0.01)
    assert row.relative.error < 0.01


def test_the_filters_are_ordered_and_one_is_recommended(found):
    order = [row.label for row in found.rows]
    assert order == ["imm", "one_step", "linear_optimal:form=augmented", "linear_optimal", "kf"]
    assert found.genie.relative == Estimate(1.0, 0.0)
    assert abs(found.genie.nees.value - 1.0) < 4.0 * found.genie.nees.error
    assert found.recommended == "imm"
    assert found.recommendation.startswith("Take imm: its mean squared error, 1.36")
    assert "below that of one_step." in found.recommendation
    assert found.recommendation.count(".\n") == 0
    assert {row.label for row in found.rows if row.pareto} >= {"imm", "one_step", "kf"}


def test_equal_rows_make_imm_a_tie_that_costs_more():
    sensor = {"noise_factor": 10.0, "problem": 1, "gamma_rate": 0.8, "delta_nominal_rate": 0.7}
    spec = plants.spec(SCALAR, family="imm", sensor=sensor)
    found = fkgen.compare(spec, ("imm", "one_step"), runs=400)
    assert found.row("imm").relative.value == pytest.approx(found.row("one_step").relative.value)
    assert found.recommended == "one_step"
    assert "is that of imm within 2 standard errors" in found.recommendation or (
        "is the smallest, and imm, which may be as good, costs no less" in found.recommendation
    )
    assert not found.row("imm").pareto


def test_the_genie_of_actuators_is_told_what_arrives():
    found = fkgen.compare(plants.motor(), runs=300, u=1.0)
    assert [row.label for row in found.rows] == ["mkf", "kf"]
    for row in (found.genie, found.row("mkf")):
        assert abs(row.nees.value - 1.0) < 4.0 * row.nees.error
    assert found.row("mkf").relative.value > 1.0
    assert found.row("kf").nees.value > 2.0
    assert np.isnan(found.row("mkf").delay.value)


def test_without_faults_the_kalman_filter_is_its_own_genie():
    found = fkgen.compare(plants.spec(plants.random_model(4, 3, 2)), runs=200)
    assert found.row("kf").relative == Estimate(1.0, 0.0)
    # the test of the NIS: its false alarms are those asked for
    alarms = found.row("kf").false_alarms
    assert abs(alarms.value - 0.01) < 4.0 * alarms.error


def test_soft_faults_are_found_by_the_test_of_the_innovation():
    spec, bias = plants.spec(plants.random_model(4, 3, 2)), np.zeros((60, 2))
    bias[40:] = 20.0
    found = fkgen.compare(spec, runs=200, steps=60, skip=20, sensor=bias).row("kf")
    assert found.detected.value > 0.99
    assert found.delay.value < 0.2
    assert found.relative.value > 10.0


def test_a_host_is_judged_by_the_rows_that_it_uses():
    spec = fkgen.load(EXAMPLES / "soft_fault" / "dfcf.toml")
    row = fkgen.compare(spec, ("dfcf",), runs=100, steps=400).row("dfcf")
    assert abs(row.nis.value - 1.0) < 4.0 * row.nis.error < 0.1
    # one window in twenty is rejected without a fault, and only ends of windows count
    assert abs(row.false_alarms.value - 0.05) < 4.0 * row.false_alarms.error


def test_several_specs_are_filters_as_they_stand():
    truth, doubting = fkgen.load(EXAMPLE_1), fkgen.load(EXAMPLE_1).to_dict()
    doubting["model"]["R"] = [[2.8]]
    doubting |= {"faults": {}, "filter": {"family": "kf"}}
    careful = fkgen.Spec.from_dict(doubting, file="careful.toml")
    found = fkgen.compare((truth, careful), ("kf",), runs=2000)
    assert {row.label for row in found.rows} == {"one_step", "kf"}
    # R E[delta]: 1.5735 by independent code
    assert found.row("kf").relative.value == pytest.approx(1.5735, abs=0.03)


def test_detection_counts_what_was_found_and_when():
    faults = np.array([[1, 0, 1, 1, 1, 0, 0, 1, 1, 0]], bool)
    said = np.array([[0, 1, 0, 0, 1, 0, 1, 0, 0, 1]], bool)
    counts = detection(faults, said, 0)
    assert [float(each[0]) for each in (counts.healthy, counts.alarms)] == [4.0, 3.0]
    assert [float(each[0]) for each in (counts.onsets, counts.found, counts.waited)] == [2, 1, 2]


def test_nees_leaves_out_directions_without_variance():
    rng = np.random.default_rng(0)
    unit = np.array([1.0, 1e3, 1e-4])
    root = np.array([[1.0, 0.2], [0.3, 1.0], [1.0, -0.5]]) + 0.2 * rng.random((4, 50, 3, 2))
    e = (root @ rng.standard_normal((4, 50, 2, 1)))[..., 0]
    inverse = np.linalg.pinv(root @ root.swapaxes(-1, -2), rcond=1e-10, hermitian=True)
    exact = np.einsum("mti,mtij,mtj->mt", e, inverse, e).mean(axis=1) / 2.0
    P = unit[:, None] * (root @ root.swapaxes(-1, -2)) * unit
    # the rank is decided row by row, whatever the units; the third pivot is rounding: 1e-16 / 1e-3
    total, count = weighted_squares(e * unit, P, np.finfo(float).eps)
    np.testing.assert_allclose(total / count, exact, rtol=1e-9)


def test_ratios_have_the_error_of_the_delta_method():
    rng, values = np.random.default_rng(1), []
    for _ in range(2000):
        below = rng.gamma(4.0, size=50)
        values.append(ratio(below + 0.3 * rng.standard_normal(50) + 1.0, below))
    spread = np.std([each.value for each in values])
    assert np.mean([each.error for each in values]) == pytest.approx(spread, rel=0.06)
    assert mean(np.array([1.0, np.nan, 3.0])).value == 2.0


def standing(label, value, cost, noise):
    print_ = Footprint(operations=cost, calls=0, state=8, flash={})
    return Score(label, print_, value, noise)


def test_what_is_not_decided_is_no_tie():
    calm, wild = np.zeros(100), np.zeros(100)
    calm[:] = np.resize([0.01, -0.01], 100)
    wild[:50], wild[50:] = 200.0, -200.0
    nees = {name: Estimate(1.0, 0.01) for name in ("fine", "cheap", "wild")}
    fine = standing("fine", 1.0, 100, np.zeros(100))
    cheap = standing("cheap", 1.001, 50, calm)
    rough = standing("wild", 30.0, 10, wild)
    assert recommended([fine, cheap, rough], nees)[0] == "cheap"
    assert recommended([fine, rough], nees)[0] == "fine"
    assert "more trials" in recommended([fine, rough], nees)[1]
    assert beaten(fine, [fine, cheap])
    assert not beaten(cheap, [fine, cheap, rough])
    wrong = {"cheap": Estimate(1.5, 0.01), "fine": Estimate(1.0, 0.01)}
    assert "is too small (NEES 1.50" in recommended([fine, cheap], wrong)[1]


def test_the_same_comparison_gives_the_same_numbers(monkeypatch):
    spec = fkgen.load(EXAMPLE_1)
    one = fkgen.compare(spec, ("imm", "kf"), runs=30, steps=40)
    monkeypatch.setattr("fkgen.study.comparisons.comparison.CHUNK", 300)
    assert fkgen.compare(spec, ("imm", "kf"), runs=30, steps=40).to_json() == one.to_json()
    imm = fkgen.Spec.from_dict(spec.to_dict() | {"filter": {"family": "imm"}})
    operations = json.loads(one.to_json())["rows"][0]["footprint"]["operations"]
    assert operations == fkgen.build(imm).layout.flops


@pytest.mark.parametrize(
    ("families", "options", "message"),
    [
        (("mkf",), {}, "families: given 'mkf'; expected of sensor faults: kf, linear_optimal"),
        (("emm",), {}, "families: given 'emm'; expected of sensor faults"),
        (("imm:modes=5",), {}, "filter.modes: given 5.0; expected 4, or 3"),
        (("imm",), {"runs": 1}, "runs: given 1; expected a whole number from 2"),
        (("imm",), {"steps": 0}, "steps: given 0; expected a whole number from 1"),
        (("imm",), {"skip": 200}, "skip: given 200; expected from 0 to 199"),
        (
            ("imm",),
            {"false_alarm": 1.0},
            "false_alarm: given 1.0; expected a probability",
        ),
        (("imm",), {"u": 1.0}, "u: given inputs; expected none"),
    ],
)
def test_what_cannot_be_compared_is_refused(families, options, message):
    with pytest.raises(fkgen.UserError) as refused:
        fkgen.compare(fkgen.load(EXAMPLE_1), families, **options)
    assert message in str(refused.value)


def test_filters_for_other_plants_are_refused():
    other = plants.spec(plants.random_model(1, 2, 1))
    with pytest.raises(fkgen.DataError, match="expected 1 states, 0 inputs, 1 measurements"):
        fkgen.compare((fkgen.load(EXAMPLE_1), other))
    unstable = plants.spec(plants.random_model(2, 1, 1) | {"A": [[2.0]]})
    with pytest.raises(fkgen.DataError, match="the plant is not stable"):
        fkgen.compare(unstable, steps=2000, runs=4)


def test_filters_of_one_family_are_told_apart():
    spec = fkgen.load(EXAMPLE_1)
    twins = [fkgen.Spec.from_dict(spec.to_dict()) for _ in range(2)]
    found = fkgen.compare((spec, *twins), runs=20, steps=20)
    assert {row.label for row in found.rows} == {
        "one_step (example1)",
        "one_step (2)",
        "one_step (3)",
    }


def test_files_of_one_name_in_two_folders_are_told_apart():
    table = fkgen.load(EXAMPLE_1).to_dict()
    twins = [fkgen.Spec.from_dict(table, file=f"{folder}/spec.toml") for folder in "ab"]
    rows = fkgen.compare(twins, runs=20, steps=20).rows
    assert {row.label for row in rows} == {"one_step (1)", "one_step (2)"}


@pytest.mark.parametrize("options", [{"gate": 0.8}, {"gain": "stationary"}], ids=str)
def test_the_genie_of_a_filter_with_a_gate_or_a_constant_gain_has_neither(options):
    table = fkgen.load(EXAMPLE_1).to_dict() | {"faults": {}}
    table["model"] |= {"P0": [[3.0]]}
    plain, spec = (
        fkgen.Spec.from_dict(table | {"filter": {"family": "kf"} | each}) for each in ({}, options)
    )
    found = fkgen.compare(spec, ["kf"], runs=60, steps=30, skip=0)
    assert found.genie.rmse == fkgen.compare(plain, ["kf"], runs=60, steps=30, skip=0).genie.rmse
    assert found.row("kf").relative.value > 1.0


@pytest.mark.parametrize("time", [0.1, "dt"])
def test_the_genie_of_a_continuous_jumping_plant_moves_as_its_trials_do(time):
    table = {
        "name": "plant",
        "parameters": {"dt": 0.1},
        "model": {
            "time": "continuous",
            "sample_time": time,
            "A": [[0.0, 1.0], [0.0, -0.5]],
            "C": [[1.0, 0.0]],
            "Q": [[0.0, 0.0], [0.0, 0.2]],
            "R": [[0.1]],
            "c": [0.0, 0.3],
            "x0": [0.0, 1.0],
            "P0": [[1.0, 0.0], [0.0, 1.0]],
        },
        "faults": {
            "jump": {
                "transition": [[0.9, 0.1], [0.2, 0.8]],
                "modes": [{}, {"A": [[0.0, 1.0], [0.0, -2.0]], "Q": [[0.0, 0.0], [0.0, 2.0]]}],
            }
        },
        "filter": {"family": "mjls_lmmse"},
    }
    found = fkgen.compare(fkgen.Spec.from_dict(table), ["mjls_lmmse"], runs=200, steps=60)
    for row in (found.genie, *found.rows):
        assert abs(row.nees.value - 1.0) < 4.0 * row.nees.error
        assert abs(row.nis.value - 1.0) < 4.0 * row.nis.error


def test_a_spec_of_the_genie_keeps_its_own_row():
    table = fkgen.load(EXAMPLE_1).to_dict()
    told = fkgen.Spec.from_dict(table | {"filter": {"family": "genie"}})
    found = fkgen.compare((fkgen.load(EXAMPLE_1), told), runs=20, steps=40)
    assert found.genie.relative.value == 1.0
    assert (
        found.genie.rmse["x0"].value
        < found.rows[0].rmse["x0"].value
        < found.rows[1].rmse["x0"].value
    )


def test_without_noise_there_is_nothing_to_compare():
    still = plants.random_model(2, 1, 1) | {"Q": [[0.0]], "P0": [[0.0]]}
    with pytest.raises(fkgen.DataError, match="errors that are zero for the genie"):
        fkgen.compare(plants.spec(still), runs=4, steps=8)


def test_the_command_compares_draws_and_says_what_to_take(tmp_path):
    picture, runner = tmp_path / "front.png", CliRunner()
    options = ["--families", "imm,kf", "--runs", "50", "--steps", "60"]
    done = runner.invoke(main, ["compare", str(EXAMPLE_1), *options, "--plot", str(picture)])
    assert done.exit_code == 0, done.output
    assert "Take imm" in done.output
    assert "kf: the same plant with its faults left out" in done.output
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = runner.invoke(main, ["compare", str(EXAMPLE_1), *options, "--plot", str(picture)])
    assert again.exit_code == 2
    assert "a file that exists" in again.output
    as_json = runner.invoke(main, ["compare", str(EXAMPLE_1), *options, "--json"])
    assert json.loads(as_json.stdout)["recommended"] == "imm"


def test_the_commands_take_soft_faults_from_a_file(tmp_path):
    spec, fault, runner = tmp_path / "plant.toml", tmp_path / "fault.csv", CliRunner()
    spec.write_text(
        'name = "plant"\nmodel = {A = [[0.5]], C = [[1.0]], Q = [[1.0]], R = [[1.0]], x0 = [0.0],'
        ' P0 = [[1.0]], outputs = [{name = "gauge"}]}\nfilter = {family = "kf"}\n'
    )
    fault.write_text("gauge\n" + "0\n" * 20 + "30\n" * 20)
    options = ["--profile", str(fault), "--runs", "40", "--json"]
    found = json.loads(runner.invoke(main, ["compare", str(spec), *options]).stdout)
    assert found["steps"] == 40
    assert found["rows"][0]["detected"]["value"] == 1.0
    drawn = runner.invoke(main, ["simulate", str(spec), "--profile", str(fault)]).stdout
    clean = runner.invoke(main, ["simulate", str(spec), "--steps", "40"]).stdout
    gauge = [
        np.array([float(line.split(",")[0]) for line in text.splitlines()[1:]])
        for text in (drawn, clean)
    ]
    np.testing.assert_allclose(gauge[0] - gauge[1], [0.0] * 20 + [30.0] * 20, atol=1e-12)
    fault.write_text("gage\n1\n")
    refused = runner.invoke(main, ["compare", str(spec), *options])
    assert "expected at least one of: gauge" in refused.output


def test_the_command_simulates_a_record_that_can_be_filtered(tmp_path):
    record, runner = tmp_path / "record.csv", CliRunner()
    spec = str(EXAMPLES / "gps_glitch" / "spec.toml")
    like = str(EXAMPLES / "gps_glitch" / "record.csv")
    drawn = runner.invoke(
        main, ["simulate", spec, "--record", like, "--steps", "40", "-o", str(record)]
    )
    assert drawn.exit_code == 0, drawn.output
    lines = record.read_text().splitlines()
    heading = "t_s,baro,gps_height,gps_climb,dt,true.height,true.climb,true.offset,gamma,delta"
    assert lines[0] == heading
    assert len(lines) == 41
    assert any(",," in line for line in lines)  # the GPS is missing where the record lacks it
    done = runner.invoke(main, ["run", spec, str(record)])
    assert done.exit_code == 0, done.output


def test_the_page_of_the_example_quotes_what_the_command_wrote():
    folder = EXAMPLES / "which_filter"
    tables = (folder / "tables.md").read_text().splitlines()
    page = (folder / "README.md").read_text().splitlines()
    quoted = [line for line in page if line.startswith(("|  |", "| MSE", "| rmse", "Take "))]
    assert len(quoted) >= 9
    assert set(quoted) <= set(tables)
    again = fkgen.compare(fkgen.load(EXAMPLE_1), ("kf",), runs=10_000, steps=101, skip=50, seed=1)
    error = str(again.row("kf").relative)
    assert any(line.startswith("| MSE") and line.endswith(f"{error} |") for line in tables)


def test_two_million_samples_give_the_error_of_the_paper_s_example():
    table = fkgen.load(EXAMPLE_1).to_dict() | {"filter": {"family": "imm"}}
    spec = fkgen.Spec.from_dict(table)
    drawn, done = fkgen.simulate(spec, 2000, 1000, 1), []
    run = fkgen.build(spec).run_batch(drawn.y, keep=("filtered_state",), advance=done.append)
    assert sum(done) == 2000
    error = (run.filtered_state - drawn.state)[:, 50:, 0]
    # section 3.4: 1.3603 +- 0.0031 times 1.2294 +- 0.0036
    assert abs((error**2).mean() - 1.3603 * 1.2294) < 4.0 * 0.006
