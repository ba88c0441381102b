"""Ranges of parameters, and tables: what is read, what is refused, what is written again."""

from __future__ import annotations

import pytest
from refusals import INF, KF, Case, changed, check

from fkgen.problem import Parameter, Spec

TAU, DRAG = "parameters.tau", "tables.drag"
LINE = {"x": [0.0, 1.0, 3.0], "y": [1.0, 2.0, 0.0]}


def ranged(**limits: object) -> dict[str, object]:
    return {TAU: {"default": 0.05, **limits}}


REFUSED: list[Case] = [
    (KF, {TAU: {"min": 0.0}}, f"{TAU}.default", "nothing", "a finite number, the default"),
    (KF, ranged(default=2.0, max=1.0), f"{TAU}.default", "2.0", "in the range, -inf to 1.0"),
    (KF, ranged(min=0.1), f"{TAU}.default", "0.05", "in the range, 0.1 to inf"),
    (KF, ranged(min=0.1, max=0.01), f"{TAU}.min", "0.1, above max = 0.01", "that holds numbers"),
    (KF, ranged(minimum=0.0), f"{TAU}.minimum", "an unknown key", "default, min, max"),
    (KF, ranged(max=INF), f"{TAU}.max", "inf", "a finite number"),
    (KF, ranged(max="1"), f"{TAU}.max", "the text '1'", "a finite number"),
    (KF, ranged(max=1e200) | {"code.scalar": "float"}, TAU, "1e+200", "the largest of the scalar"),
    (KF, {"tables": [1]}, "tables", "the list [1]", "drag = {x = ["),
    (KF, {DRAG: 1.0}, DRAG, "the float 1.0", "a table with x, y, kind"),
    (KF, {DRAG: {"x": [0.0, 1.0]}}, f"{DRAG}.y", "nothing", "at least 2 finite numbers"),
    (KF, {DRAG: LINE | {"x": [0.0, 1.0]}}, f"{DRAG}.y", "3 numbers", "2: one for each of x"),
    (KF, {DRAG: LINE | {"x": [0.0, 1.0, 1.0]}}, f"{DRAG}.x[2]", "1.0 after 1.0", "increase"),
    (KF, {DRAG: LINE | {"x": [0.0, 2.0, 1.0]}}, f"{DRAG}.x[2]", "1.0 after 2.0", "increase"),
    (KF, {DRAG: LINE | {"y": [0.0, INF, 1.0]}}, f"{DRAG}.y[1]", "inf", "a finite number"),
    (KF, {DRAG: LINE | {"y": [0.0, "tau", 1.0]}}, f"{DRAG}.y[1]", "the text 'tau'", "a finite"),
    (KF, {DRAG: LINE | {"y": [0.0]}}, f"{DRAG}.y", "1 numbers", "2 to 200 numbers"),
    (KF, {DRAG: LINE | {"kind": "cubic"}}, f"{DRAG}.kind", "'cubic'", "one of linear, pchip"),
    (KF, {DRAG: LINE | {"z": 1}}, f"{DRAG}.z", "an unknown key", "one of x, y, kind"),
    (KF, {DRAG: {"x": [0.0, 1e-300], "y": [0.0, 1e300]}}, f"{DRAG}.y", "overflow", "finite slopes"),
    (KF, {"tables.2drag": LINE}, "tables.2drag", "'2drag'", "a C identifier"),
    (KF, {"model.R": [["interp(tau, 'drag')"]]}, "model.R[0][0]", "interp", "the spec has none"),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: f"{case[2]}: {case[3]}")
def test_refusals(case: Case) -> None:
    check(*case)


def test_a_spec_with_ranges_and_tables_is_written_and_read_again() -> None:
    entry = "interp(if(tau >= 0.01, tau, 0), 'drag')"
    table = changed(KF, ranged(min=0.0, max=1.0) | {DRAG: LINE, "model.R": [[entry]]})
    spec = Spec.from_dict(table)
    assert spec.parameters == (Parameter("tau", 0.05, 0.0, 1.0),)
    again = Spec.from_dict(spec.to_dict())
    assert again == spec
    assert again.canonical() == spec.canonical()
    assert spec.model.R.values({"tau": 0.5})[0, 0] == 1.5
    other = changed(table, {f"{DRAG}.y": [1.0, 2.5, 0.0]})
    assert Spec.from_dict(other).canonical() != spec.canonical()
    wider = changed(table, ranged(min=0.0, max=2.0))
    assert Spec.from_dict(wider).canonical() != spec.canonical()
