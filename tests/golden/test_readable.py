"""Generated C can be read: the model stands in the header, lines are short, tests are tables."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import spread
from plants import generated

import fkgen

ROOT = Path(__file__).resolve().parents[2]
SPECS = {spec.name: spec for spec in map(fkgen.load, sorted((ROOT / "examples").glob("*/*.toml")))}
WIDTH = 100
#: The most of a file that may repeat an earlier shape of twelve lines.
REPEATED = 0.35
WINDOW = 12

FUNCTIONS = {name: getattr(math, name) for name in ("exp", "log", "sqrt", "sin", "cos", "tan")}
FUNCTIONS |= {
    "atan2": math.atan2,
    "hypot": math.hypot,
    "abs": abs,
    "diag": lambda *entries: np.diag(entries),
    "zeros": lambda rows, columns: np.zeros((rows, columns)),
}


def text_of(name, end):
    return (ROOT / "generated" / name / f"{name}{end}").read_text(encoding="utf-8")


def listings(header, parameters):
    """(name, value) of every matrix in the comment at the top, in order."""
    comment = header[: header.index("\n */")].replace("\n * ", "\n  ")
    found = []
    for match in re.finditer(r"^ +(\w+) = (?=\[|diag|zeros)", comment, flags=re.MULTILINE):
        depth, end = 0, match.end()
        while True:
            depth += {"[": 1, "(": 1, "]": -1, ")": -1}.get(comment[end], 0)
            end += 1
            if not depth and comment[end - 1] in "])":
                break
        code = " ".join(comment[match.end() : end].split())
        value = eval(code, {"__builtins__": {}}, FUNCTIONS | parameters)  # noqa: S307 - our text
        found.append((match[1], np.array(value, dtype=float)))
    return found


def assert_stated(spec, header):
    # Off the defaults, so that an expression is told from its default value.
    parameters = {name: 1.25 * value for name, value in spec.defaults.items()}
    found = listings(header, parameters)
    letters = ["A", "B", "C", "D", "Q", "R", "x0", "P0"]
    if spec.model.equations is not None:
        letters = letters[4:]
        assert_equations_stated(spec, header)
    if not spec.model.nu:
        letters = [letter for letter in letters if letter not in {"B", "D"}]
    assert [name for name, _ in found[: len(letters)]] == letters
    for name, value in found[: len(letters)]:
        expected = getattr(spec.model, name).values(parameters)
        np.testing.assert_array_equal(value.reshape(expected.shape), expected, name)
    stated = dict(found[len(letters) :])
    if spec.faults.sensor is not None and spec.faults.sensor.kernel:
        law = spec.faults.sensor.law
        kernel = spec.faults.sensor.kernel if law is None else law.values(parameters)
        np.testing.assert_array_equal(stated["kernel"], kernel)
    if spec.faults.jump is not None:
        np.testing.assert_array_equal(stated["transition"], spec.faults.jump.transition)
        np.testing.assert_array_equal(stated["initial"], spec.faults.jump.initial)


def assert_equations_stated(spec, header):
    """The row of every output, with its value where it needs no definition."""
    model, rng = spec.model, np.random.default_rng(3)
    x, u = rng.uniform(1.0, 2.0, model.nx), rng.uniform(1.0, 2.0, model.nu)
    seen = model.equations.seen(x, u, spec.defaults)
    names = dict(zip(model.equations.states, x, strict=True)) | spec.defaults
    names |= dict(zip(model.equations.inputs, u, strict=True)) | FUNCTIONS
    for signal, expected in zip(model.outputs, seen, strict=True):
        text = re.search(
            rf"^ \*   h: {signal.name} = (.*(?:\n \*       .*)*)$", header, re.MULTILINE
        )
        words = set(re.findall(r"[A-Za-z_][\w.:]*", text[1]))
        if words <= names.keys():
            assert eval(text[1], {"__builtins__": {}}, names) == pytest.approx(expected)  # noqa: S307 - our text


@pytest.mark.parametrize("name", SPECS)
def test_the_header_of_an_example_states_the_model_of_its_spec(name):
    assert_stated(SPECS[name], text_of(name, ".h"))


@pytest.mark.parametrize("name", spread.NAMES)
def test_every_header_states_the_model_of_its_spec(name):
    spec = spread.specs()[name]
    assert_stated(spec, generated(spec).files[f"{spec.name}.h"])


def test_each_mode_states_the_matrices_that_differ():
    spec = SPECS["markov_jump"]
    header = text_of("markov_jump", ".h")
    for index, mode in enumerate(spec.faults.jump.modes):
        part = header[header.index(f" * Mode {index}") :]
        part = part[: part.index("\n *\n")] + "\n */"
        found = dict(listings(part, {}))
        differing = {
            letter for letter in "ABCDQR" if getattr(mode, letter) != getattr(spec.model, letter)
        }
        assert found.keys() == differing
        for letter in differing:
            np.testing.assert_array_equal(found[letter], getattr(mode, letter).values())


@pytest.mark.parametrize(
    ("name", "member", "unit"),
    [
        ("dc_motor_known", "predicted_state", "[A, rad/s]"),
        ("dc_motor_known", "predicted_covariance", "[A, rad/s] squared"),
        ("dc_motor_known", "innovation", "[rad/s]"),
        ("dc_motor_known", "innovation_covariance", "[rad/s] squared"),
        ("dc_motor_known", "gain", "[A, rad/s] per [rad/s]"),
        ("dc_motor_unknown", "mode_state", "[A, rad/s]"),
        ("gps_glitch", "filtered_covariance", "[m, m/s, m] squared"),
    ],
)
def test_members_carry_the_units_of_the_signals(name, member, unit):
    comment = re.search(rf" {member}(\[\d+\])?; /\*\*< (.*?) \*/", text_of(name, ".h"), re.DOTALL)
    assert " ".join(comment[2].split()).endswith(f", {unit}")


def test_parameters_state_their_range():
    assert "/**< default 0.7; a rate, in [0, 1] */" in text_of("dc_motor_known", ".h")
    spec = spread.specs()["kf_arithmetic"]
    header = " ".join(generated(spec).files["plant.h"].split())
    assert "r; /**< default 0.5; a variance, >= 0; in R */" in header


def test_every_folded_product_is_the_product_that_it_names():
    spec = SPECS["dc_motor_known"]
    source = text_of("dc_motor_known", ".c")
    block = source[source.index("/* Products of entries") :]
    rows = re.findall(r"^ \*   (\S+) = (.+)$", block[: block.index("*/")], flags=re.MULTILINE)
    assert len(rows) >= 3
    values = {letter: getattr(spec.model, letter).values(spec.defaults) for letter in "ABCD"}
    for number, text in rows:
        code = re.sub(r"(?<=[\]2]) (?=[A-D])", " * ", text.replace("^2", "**2"))
        assert abs(eval(code, {}, values)) == float(number)  # noqa: S307 - our text


@pytest.mark.parametrize(
    "path", sorted((ROOT / "generated").glob("*/*.[ch]")), ids=lambda p: p.name
)
def test_no_function_is_longer_than_400_lines(path):
    bodies = re.findall(r"^\{$.*?^\}$", path.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert max((body.count("\n") + 1 for body in bodies), default=0) <= 400


@pytest.mark.parametrize(
    "path", sorted((ROOT / "generated").glob("*/*.[ch]")), ids=lambda p: p.name
)
def test_no_line_is_longer_than_a_hundred_characters(path):
    lines = path.read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if len(line) > WIDTH] == []


@pytest.mark.parametrize("scalar", ["double", pytest.param("float", marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("name", spread.NAMES)
def test_no_line_is_long_under_a_long_name_either(name, scalar):
    table = spread.specs(scalar)[name].to_dict()
    table["name"] = "a_name_of_the_forty_characters_there_are"
    files = generated(fkgen.Spec.from_dict(table)).files
    long = [
        line
        for file, text in files.items()
        if file.endswith((".c", ".h"))
        for line in text.splitlines()
        if len(line) > WIDTH
    ]
    assert long == []


_KEPT = {"const", "double", "float", "if", "else", "return", "static", "int", "for", "struct"}


def shape(line):
    """A line with names and numbers masked."""
    line = re.sub(r"/\*.*?\*/", "", line)
    words = r"[A-Za-z_]\w*|(?<![A-Za-z_])\d[\w.]*(?:[eE][+-]?\d+)?"
    return re.sub(words, lambda m: m[0] if m[0] in _KEPT else "N", line).strip()


def repeated(text):
    """Share of the lines that lie in a window whose shape was seen before."""
    lines = [shape(line) for line in text.splitlines()]
    seen, covered = set(), [False] * len(lines)
    for i in range(len(lines) - WINDOW + 1):
        window = tuple(lines[i : i + WINDOW])
        if window in seen:
            covered[i : i + WINDOW] = [True] * WINDOW
        seen.add(window)
    return sum(covered) / len(lines)


@pytest.mark.parametrize("name", [n for n in SPECS if list((ROOT / "generated" / n).glob("*.c"))])
def test_a_self_test_hardly_repeats_itself(name):
    assert repeated(text_of(name, "_selftest.c")) <= REPEATED
