"""Pictures of a run: a panel per state and unit of y, NIS, probabilities; always the same bytes."""

from __future__ import annotations

import numpy as np
import pytest

import fkgen
from fkgen.study.records.filtering import Selection, run_table
from fkgen.study.records.record import Table
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


@pytest.mark.parametrize("ending", ["png", "pdf"])
def test_the_same_run_gives_the_same_bytes(drawn, tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    first, second = (rendered(drawn("kf", noise(9, 2)), path) for _ in range(2))
    assert first == second
