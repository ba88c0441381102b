"""One filter on a grid of plants: what varies, what is refused, what is drawn."""

from __future__ import annotations

import json
import math

import numpy as np
import plants
import pytest

import fkgen
from fkgen.study.campaigns.report import draw_sweep
from fkgen.study.campaigns.sweep import table_of

RATE, NOISE = "faults.actuator.success_rate", "model.R"


@pytest.fixture(scope="module")
def motor():
    return plants.motor(actuator=plants.common(0.7))


@pytest.fixture(scope="module")
def found(motor):
    over = {NOISE: "0.25x:4x:3", RATE: "0.7:1.3:3"}
    return fkgen.sweep(motor, over, 100, 50, u=5.0)


def test_every_cell_is_the_campaign_of_its_plant(motor, found):
    assert found.cells.shape == (3, 3)
    assert found.axes[0].values == pytest.approx((0.25, 1.0, 4.0))
    assert found.axes[1].values == pytest.approx((0.7, 1.0, 1.3))
    table = motor.to_dict()
    table["faults"]["actuator"]["success_rate"] = 1.0
    table["model"]["R"] = [[4.0 * table["model"]["R"][0][0]]]
    other = fkgen.montecarlo(motor, 100, 50, u=5.0, truth=fkgen.Spec.from_dict(table))
    assert found.cells[2, 1].to_json() == other.to_json()
    assert found.cells[1, 0].to_json() == fkgen.montecarlo(motor, 100, 50, u=5.0).to_json()


def test_plants_that_cannot_be_are_marked_and_the_rest_runs(found):
    assert [isinstance(each, str) for each in found.cells.flat] == [False, False, True] * 3
    assert "success_rate" in found.cells[0, 2]
    assert not found.consistent[:, 2].any()
    assert np.isnan(found.values("rmse")[:, 2]).all()
    assert np.isfinite(found.values("rmse")[:, :2]).all()
    head, rows = table_of(found)
    assert len(rows) == 9
    assert all(len(row) == len(head) for row in rows)
    assert "no such plant" in rows[2][-1]
    cells = json.loads(found.to_json())["cells"]
    assert [each["error"] is None for each in cells] == [True, True, False] * 3
    assert cells[0]["campaign"]["verdicts"] == found.cells[0, 0].verdicts


def test_where_the_filter_is_consistent(found):
    assert found.consistent[1, 0]
    assert not found.consistent[2, 0]  # noise four times as large as the filter says
    assert found.cells[2, 0].verdicts["nis"] == "optimistic"


def test_entries_parameters_and_numbers():
    model = plants.random_model(2, 2, 1) | {"R": [["r"]]}
    spec = plants.spec(model, parameters={"r": 0.5})
    once = fkgen.montecarlo(spec, 20, 10, truth=plants.spec(model, parameters={"r": 0.1}))
    found = fkgen.sweep(spec, {"parameters.r": [0.5, 0.1]}, 20, 10)
    assert found.cells[1].to_json() == once.to_json()
    table = spec.to_dict()
    table["model"]["Q"][0][0] *= 2.0
    once = fkgen.montecarlo(spec, 20, 10, truth=fkgen.Spec.from_dict(table))
    found = fkgen.sweep(spec, {"model.Q.0.0": "1x:2x:2"}, 20, 10)
    assert found.cells[1].to_json() == once.to_json()


@pytest.mark.parametrize(
    ("over", "message"),
    [
        (
            {"model.Qq": "1:2:3"},
            "sweep model.Qq: given an unknown key 'Qq'; expected a key of model",
        ),
        ({"plant.Q": "1:2:3"}, "a key of the spec"),
        ({"model.Q.7.0": "1:2:3"}, "given an unknown key '7'"),
        ({"model.Q": "1:2:3"}, "numbers for a table or a matrix; expected factors of it"),
        ({"model.Q": "1x:2:3"}, "from:to:count"),
        ({"model.Q": "1x:2x:0"}, "from:to:count"),
        ({"model.Q": "-1x:2x:3"}, "factors above zero"),
        ({"model.Q": "everything"}, "given 'everything'"),
        ({RATE: []}, "given no values"),
        ({RATE: "0:1:101", NOISE: "1x:2x:101"}, "given 10201 plants; expected at most 10000"),
        ({}, "over: given nothing"),
        ({RATE: "1.5:2:3"}, "success_rate"),
    ],
)
def test_what_is_no_sweep_is_refused_in_one_line(motor, over, message):
    with pytest.raises(fkgen.UserError) as refused:
        fkgen.sweep(motor, over, 10, 5, u=1.0)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_maps_and_curves(motor, found):
    figure = draw_sweep(found)
    (axes,) = (each for each in figure.axes if each.images)
    shown = np.ma.getdata(axes.images[0].get_array())
    assert shown[1, 0] == math.log2(found.cells[1, 0].nees.value)
    assert len(axes.patches) == found.consistent.sum()
    curve = fkgen.sweep(motor, {NOISE: "0.25x:4x:3"}, 100, 50, u=5.0)
    above, below = draw_sweep(curve).axes
    assert above.lines[0].get_ydata().tolist() == curve.values("nees").tolist()
    assert len(above.patches) == curve.consistent.sum()
    assert len(below.lines) == 2
