"""Equations as they were written, for headers and messages."""

from __future__ import annotations

import casadi as ca
import equations
from equations import ATTITUDE, ROBOT, read

import fkgen
from fkgen.backend.lower import generate
from fkgen.problem.functions.writing import statements
from fkgen.proof.validate import validate


def lines(model, parameters=None):
    spec = read(model, parameters)
    own = spec.model.equations
    return [each.line for each in statements(own, spec.model.states, spec.model.outputs)]


def header(model, parameters=None, family="ekf", **sections):
    table = equations.table(model, parameters, family, **sections)
    spec = fkgen.Spec.from_dict(table)
    text = generate(validate(spec)).files[f"{spec.name}.h"]
    assert max(map(len, text.splitlines())) <= 100
    return text


def test_texts_are_shown_as_they_were_written():
    expected = ["let: c = cos(heading)"]
    expected += [f"{part}: {name} = {text}" for part in "fh" for name, text in ROBOT[part].items()]
    assert lines(ROBOT) == expected


def test_rotations_are_not_written_out():
    found = lines(ATTITUDE | {"x0": [1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3]})
    assert found == [
        "let: b = [bx, by, bz]",
        "let: rate = ([gx, gy, gz] - b)*dt",
        "let: a = rotate_back(q, [0, 0, 9.81])",
        "f: q = q * rate",
        *(f"h: a{axis} = a[{i}]" for i, axis in enumerate("xyz")),
    ]


def test_a_list_and_broken_lines_are_one_line():
    change = {"let": {"c": "cos( heading )", "v": ["speed*c", "speed *\n sin(heading)", 2]}}
    model = ROBOT | change | {"f": ["x + v[0]*dt", "y  + v[1]*dt", "heading + turn*dt + w_turn"]}
    found = lines(model)
    assert found[:3] == [
        "let: c = cos( heading )",
        "let: v = [speed*c, speed * sin(heading), 2]",
        "f: x = x + v[0]*dt",
    ]
    assert found[3] == "f: y = y + v[1]*dt"


def test_what_was_no_text_is_shown_with_the_definitions_that_it_needs():
    def measured(x, _, p):
        range_ = ca.hypot(x.x, x.y)
        return [range_ + ca.sin(range_), x.heading + p.dt]

    found = lines(ROBOT | {"h": measured})
    assert found[0] == "let: c = cos(heading)"
    assert found[1] == "let: h:1 = hypot(x, y)"
    assert found[-2:] == ["h: range = h:1 + sin(h:1)", "h: bearing = heading + dt"]
    # those that only a text needs are not there
    turned = dict(ATTITUDE["h"]) | {"ax": "rotate(q, [bx, by, bz])[0]"}
    assert not [line for line in lines(ATTITUDE | {"h": turned}) if ":R:" in line or "q.R" in line]


def test_a_text_without_a_blank_does_not_make_a_long_line():
    text = "+".join(f"x*{i}e-5*hypot(y,{i})**2" for i in range(1, 12))
    found = header(ROBOT | {"h": {"range": text, "bearing": "heading"}})
    start = found.index("h: range = ") + len("h: range = ")
    shown = found[start : found.index(" *   h: bearing")]
    assert "".join(shown.split()).replace("*", "") == text.replace("*", "")
    assert "1e-5 * hypot(y, 1)" in shown


def test_the_header_has_the_texts_and_those_of_each_mode_that_differ():
    modes = [{}, {"f": {"x": "x + 2*speed*c*dt"}}, {"let": {"c": "cos(heading)/2"}}]
    law = {"transition": [[0.8, 0.1, 0.1]] * 3, "initial": [0.5, 0.25, 0.25]}
    found = header(ROBOT, None, "imm", faults={"jump": law | {"modes": modes}})
    whole, _, rest = found.partition("* Mode 0: the model itself")
    for part, table in (("let", ROBOT["let"]), ("f", ROBOT["f"]), ("h", ROBOT["h"])):
        for name, text in table.items():
            assert f" *   {part}: {name} = {text}\n" in whole
    first, second = rest[rest.index("Mode 1") :].split(" * Mode 2: what differs.\n", 1)
    own = [line for line in first.splitlines() if line.startswith(" *   ")]
    assert own == [" *   f: x = x + 2*speed*c*dt"]
    second = second[: second.index("\n *\n")].splitlines()
    assert second == [" *   let: c = cos(heading)/2"]


def test_specs_with_other_texts_of_one_meaning_are_equal():
    other = {"range": "hypot( x,y )", "bearing": "(atan2(y, x)) - heading"}
    first, second = read(ROBOT), read(ROBOT | {"h": other})
    assert first == second
    assert first.canonical() == second.canonical()
    assert first.model.equations.written != second.model.equations.written
