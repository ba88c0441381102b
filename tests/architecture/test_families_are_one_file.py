"""Outside ``families/`` nobody asks for a family by name; a spec is read without its proof."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fkgen.families import ALIASES, NAMES, family
from fkgen.study.reports.starters import resource

PACKAGE = Path(__file__).resolve().parents[2] / "fkgen"
TEMPLATES = PACKAGE.parent / "templates"
HEAVY = {"casadi", "sympy", "control", "matplotlib", "scipy", "jinja2"}
KNOWN = {*NAMES, *ALIASES}


def compared_with(tree):
    """Texts on either side of a comparison, or in a ``match``, with their lines."""
    for node in ast.walk(tree):
        sides = []
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
        elif isinstance(node, ast.MatchValue):
            sides = [node.value]
        for side in sides:
            for each in ast.walk(side):
                if isinstance(each, ast.Constant) and isinstance(each.value, str):
                    yield each.value, each.lineno


def tabled(tree):
    """Names of families that stand together in a tuple, list, set or as keys of a table."""
    lists = {
        id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Assign) and "__all__" in names(n)
    }
    for node in ast.walk(tree):
        if id(node) in lists:  # what a module exports are not families
            continue
        entries = node.keys if isinstance(node, ast.Dict) else getattr(node, "elts", ())
        texts = [each.value for each in entries if isinstance(each, ast.Constant)]
        yield from ((text, node.lineno) for text in texts if isinstance(text, str))


def names(assignment):
    return [target.id for target in assignment.targets if isinstance(target, ast.Name)]


OUTSIDE = [p for p in sorted(PACKAGE.rglob("*.py")) if p.parent != PACKAGE / "families"]


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_module_outside_asks_for_the_name_of_a_family(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = [(text, line) for ask in (compared_with, tabled) for text, line in ask(tree)]
    assert [each for each in found if each[0] in KNOWN] == []


@pytest.mark.parametrize("name", NAMES)
def test_a_family_says_its_name_and_has_a_starter(name):
    assert family(name).name == name
    assert resource(f"templates/{family(name).starter}").is_file()


@pytest.mark.parametrize("name", NAMES)
def test_options_of_a_family_are_fields_of_its_own(name):
    assert set(family(name).keys).isdisjoint({"family", "options"})


def test_reading_a_spec_of_any_family_loads_none_of_the_heavy_libraries():
    code = (
        "import sys, tomllib, fkgen\n"
        "from fkgen.families import NAMES, family\n"
        f"for name in NAMES: fkgen.load({str(TEMPLATES)!r} + '/' + family(name).starter)\n"
        f"print(sorted({HEAVY!r} & sys.modules.keys()))"
    )
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "[]\n"
