"""What the pages about the families say is so: their code prints what stands beside it."""

from __future__ import annotations

import re
import tomllib
from contextlib import redirect_stdout
from io import StringIO

import pytest

import fkgen
from fkgen.families import NAMES, family
from fkgen.study.reports.starters import resource, starter

PAGES = {name: resource(f"docs/families/{name}.md") for name in NAMES}
OTHERS = {"fault-effects": resource("docs/fault-effects.md")}
EXTRA = {
    "linear_optimal": [
        {"form": "augmented"},
        {"problem": "moments", "gamma_persistence": 0.9},
        {"initial": [0, 0, 1, 0], "inputs": True},
    ],
    "one_step": [{"covariance": "paper"}],
    "mjls_lmmse": [
        {"detector": "energy", "window": 3},
        {"detector": "none"},
        {"reinitialise": True},
        {"inputs": True},
    ],
    "dfcf": [{"reacquire": 3}],
}
"""Options of a starter that add ports."""


def blocks(path, language):
    text = path.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("name", [*NAMES, *OTHERS])
def test_code_on_a_page_prints_what_stands_beside_it(name):
    for code in blocks({**PAGES, **OTHERS}[name], "python"):
        printed = StringIO()
        with redirect_stdout(printed):
            exec(compile(code, f"{name}.md", "exec"), {})  # noqa: S102
        expected = re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)
        assert expected
        assert printed.getvalue().splitlines() == expected


@pytest.mark.parametrize("page", ["docs/spec-file.md"])
def test_spec_files_on_a_page_validate(page):
    found = blocks(resource(page), "toml")
    assert found
    for text in found:
        assert fkgen.validate(fkgen.Spec.from_dict(tomllib.loads(text))).claims


def ports_of(name):
    """Ports of the starter of a family, and of what its options add."""
    table = tomllib.loads(starter(name))
    found = set()
    for changes in [{}, *EXTRA.get(name, [])]:
        each = tomllib.loads(starter(name))
        for key, value in changes.items():
            if key == "inputs":
                each["model"]["B"] = [[1.0]] * len(table["model"]["A"])
            elif key in family(name).keys:
                each["filter"][key] = value
            else:
                each["faults"]["sensor"][key] = value
        found |= {port.name for port in family(name).build(fkgen.Spec.from_dict(each)).ports}
    return found


def named(path):
    rows = re.findall(r"^\| (`[^|]*) \|", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {name for row in rows for name in re.findall(r"`(\w+)`", row)}


MORE = {"imm": "one_step", "compression_full": "dfcf"}
"""Pages that another one refers to."""


@pytest.mark.parametrize(
    "name", ["linear_optimal", "one_step", "imm", "genie", "mjls_lmmse", "dfcf", "compression_full"]
)
def test_every_port_of_a_filter_for_faults_is_on_a_page(name):
    shared = named(PAGES[MORE[name]]) if name in MORE else set()
    assert ports_of(name) <= named(PAGES[name]) | named(PAGES["kf"]) | shared
