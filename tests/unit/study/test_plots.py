"""Pictures of a run: a panel per state and unit of y, NIS, probabilities; always the same bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fkgen
from fkgen.study.records.filtering import Selection, run_table
from fkgen.study.records.record import Table
from fkgen.study.records.summary import Summary
from fkgen.study.reports.plots import draw, gaps_of, rendered
from fkgen.study.reports.starters import starter

PORTS = ("filtered_state", "filtered_covariance", "innovation", "nis")


def table_of(spec, y, time_name=""):
    samples = len(y)
    return Table(
        file="r",
        time_name=time_name,
        time_label={"t_s": "time (s)"}.get(time_name, time_name),
        time=np.arange(samples, dtype=float),
        y=y,
        u=np.ones((samples, spec.model.nu)),
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plots")

    def make(family, y, time_name="", scalar="double"):
        path = folder / f"{family}.toml"
        text = starter(family).replace('scalar = "double"', f'scalar = "{scalar}"')
        path.write_text(text, encoding="utf-8")
        spec = fkgen.load(path)
        built = fkgen.build(spec)
        table = table_of(spec, y, time_name)
        more = ("mode_probability", "test_statistic", "test_dof", "fault_declared")
        known = [name for name in more if name in built.ports]
        run = run_table(built, table, Selection((), (*PORTS, *known)))
        return draw(spec, table, run)

    return make


def noise(samples, width, missing=0.0):
    rng = np.random.default_rng(1)
    y = rng.normal(size=(samples, width))
    y[rng.random(y.shape) < missing] = np.nan
    return y


def labels(figure):
    return [axis.get_ylabel() for axis in figure.axes]


def test_panels_carry_names_and_units(drawn):
    assert labels(drawn("kf", noise(40, 2))) == [
        *("position (m)", "speed (m/s)"),
        *("innovation (m)", "innovation (m/s)", "NIS"),
    ]


def test_probabilities_have_a_panel(drawn):
    figure = drawn("mme", noise(40, 2))
    assert labels(figure)[-1] == "probability"
    assert [text.get_text() for text in figure.axes[-1].get_legend().get_texts()] == [
        f"rate {rate}" for rate in (0.1, 0.3, 0.5, 0.7, 0.9)
    ]


def test_verdicts_have_a_panel_with_a_name_per_group_and_nis_counts_rows_of_the_host(drawn):
    y = noise(301, 3)
    y[:, 1] += np.linspace(0.0, 60.0, 301)
    axes = drawn("dfcf", y).axes
    assert axes[-1].get_ylabel() == "test / threshold"
    assert [text.get_text() for text in axes[-1].get_legend().get_texts()] == ["gnss", "beacon"]
    drawn_crosses = [line for line in axes[-1].lines if line.get_marker() == "x"]
    assert [len(line.get_xdata()) for line in drawn_crosses] == [2, 0]
    (nis,) = (axis for axis in axes if axis.get_ylabel() == "NIS")
    assert "(1 degrees of freedom)" in nis.get_title(loc="left")


@pytest.mark.parametrize(("family", "width"), [("imm", 2), ("one_step", 1)])
def test_modes_of_a_sensor_are_called_what_they_are(drawn, family, width):
    legend = drawn(family, noise(20, width)).axes[-1].get_legend().get_texts()
    names = ["signal", "signal, noise x 100", "no signal", "no signal, noise x 100"]
    assert [text.get_text() for text in legend] == names


@pytest.mark.parametrize(("family", "is_guide"), [("imm", True), ("genie", False), ("kf", False)])
def test_where_y_is_a_mixture_chi_square_is_a_guide(drawn, family, is_guide):
    axes = drawn(family, noise(20, 2)).axes
    (panel,) = (axis for axis in axes if axis.get_ylabel() == "NIS")
    assert ("a guide and no test" in panel.get_title(loc="left")) == is_guide


def test_rows_that_come_and_go_change_the_scale_of_nis(drawn):
    assert labels(drawn("kf", noise(40, 2, missing=0.3)))[-1] == "NIS / upper bound"


@pytest.mark.parametrize(
    ("family", "time_name", "label"),
    [("kf", "", "sample"), ("kf", "t_s", "time (s)"), ("kf", "t", "t"), ("mme", "", "time (s)")],
)
def test_the_time_axis_says_what_it_is(drawn, family, time_name, label):
    assert drawn(family, noise(5, 2), time_name).axes[-1].get_xlabel() == label


@pytest.mark.parametrize("y", [np.full((3, 2), np.nan), np.full((3, 2), np.inf), np.zeros((1, 2))])
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_records_without_information_are_drawn_too(drawn, tmp_path, y, scalar):
    assert rendered(drawn("kf", y, scalar=scalar), tmp_path / "a.png")


def test_gaps_are_what_is_longer_than_usual():
    time, silent = np.arange(12.0), np.zeros(12, bool)
    assert gaps_of(time, silent) == []
    silent[[4, 5, 6, 7]] = True
    assert gaps_of(time, silent) == [(3.0, 5.0)]
    now_and_then = np.arange(12) % 3 > 0
    assert gaps_of(time, now_and_then) == []
    time[6:] += 20.0
    assert gaps_of(time, np.zeros(12, bool)) == [(5.0, 21.0)]
    assert gaps_of(time, np.ones(12, bool)) == [(0.0, 31.0)]


def test_gaps_are_bars_through_all_panels(drawn):
    y = noise(60, 2)
    y[20:31] = np.nan
    for axis in drawn("kf", y).axes:
        (bar,) = (each for each in axis.collections if each.get_label().startswith("_"))
        assert bar.get_paths()[0].get_extents().intervalx.tolist() == [19.0, 31.0]
    assert not any(len(axis.collections) > 1 for axis in drawn("kf", noise(60, 2)).axes)


def test_rows_that_were_rejected_are_crosses_within_the_panel(drawn):
    y = noise(301, 3)
    y[:, 1] += np.linspace(0.0, 60.0, 301)
    figure, rejected = drawn("dfcf", y), 0
    for axis in figure.axes:
        if axis.get_ylabel().startswith("innovation"):
            low, high = axis.get_ylim()
            crosses = [
                line for line in axis.lines if line.get_marker() == "x" and len(line.get_xdata())
            ]
            rejected += len(crosses)
            for line in crosses:
                assert np.all((line.get_ydata() > low) & (line.get_ydata() < high))
            names = [text.get_text() for text in axis.get_legend().get_texts()]
            assert ("rejected" in names) == bool(crosses)
    assert rejected


@pytest.mark.parametrize("family", ["kf", "mkf"])
@pytest.mark.parametrize("by", ["row", "sample"])
def test_what_was_not_used_is_seen_and_counted_alike(family, by):
    one = [[1.0, 0.0], [0.0, 1.0]]
    model = {"A": [[1.0, 0.1], [0.0, 1.0]], "C": one, "Q": [[1e-3, 0.0], [0.0, 1e-2]], "R": one}
    model |= {"x0": [0.0, 0.0], "P0": one}
    if family == "mkf":
        model |= {"B": [[0.0], [0.1]]}
    table = {"name": "a", "model": model, "filter": {"family": family, "gate": 0.9999}}
    table["filter"] |= {"gate_by": by}
    if family == "mkf":
        table["faults"] = {"actuator": {"success_rate": 0.5}}
    spec = fkgen.Spec.from_dict(table)
    built = fkgen.build(spec)
    y = 0.3 * noise(80, 2)
    y[20:31], y[40, 1], y[50, 0] = np.nan, np.inf, 40.0
    record = table_of(spec, y, "t")
    record = replace(record, time=record.time + 100.0 * (record.time > 60))
    run = run_table(built, record, Selection((), (*PORTS, "rejected")))
    axes = draw(spec, record, run).axes
    state, innovation = axes[0], axes[2]
    lines = {line.get_label(): line for line in state.lines}
    assert lines["refused"].get_xdata().tolist() == [40.0]
    present = [k for k in range(80) if k not in range(20, 31) and k != 50]
    assert lines["measured"].get_xdata().tolist() == record.time[present].tolist()
    assert lines["measured"].get_ydata().tolist() == y[present, 0].tolist()
    crosses = [line.get_xdata().tolist() for line in innovation.lines if line.get_marker() == "x"]
    assert [50.0] in crosses
    (bar,) = (each for each in innovation.collections if each.get_label().startswith("_"))
    spans = [path.get_extents().intervalx.tolist() for path in bar.get_paths()]
    assert spans == [[19.0, 31.0], [60.0, 161.0]]
    summary = Summary(spec, built)
    summary.add(record, run)
    rows = 160 - 22 - 2 - (1 if by == "row" else 2)  # the sample that is refused loses both
    assert summary.text("r").startswith(
        f"r: 80 samples, {rows} of 160 rows used, 2 gaps (the longest of 101 s), 1 refused, 1 rej"
    )


def test_a_state_that_no_row_reads_as_it_is_has_no_dots():
    one = [[1.0, 0.0], [0.0, 1.0]]
    model = {"A": one, "Q": one, "R": one, "x0": [0.0, 0.0], "P0": one, "d": [0.0, 1.0]}
    model |= {"C": [[2.0, 0.0], [0.0, 1.0]]}
    spec = fkgen.Spec.from_dict({"name": "a", "model": model, "filter": {"family": "kf"}})
    record = table_of(spec, noise(9, 2))
    run = run_table(fkgen.build(spec), record, Selection((), PORTS))
    for axis in draw(spec, record, run).axes[:2]:
        assert "measured" not in [line.get_label() for line in axis.lines]


@pytest.mark.parametrize("ending", ["png", "pdf"])
def test_the_same_run_gives_the_same_bytes(drawn, tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    first, second = (rendered(drawn("kf", noise(9, 2)), path) for _ in range(2))
    assert first == second
