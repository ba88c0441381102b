"""What the pages about the families say is so: their code prints what stands beside it."""

from __future__ import annotations

import re
import shlex
import tomllib
from contextlib import redirect_stdout
from io import StringIO
from textwrap import dedent

import numpy as np
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main
from fkgen.families import NAMES, family
from fkgen.study.reports.starters import resource, starter

PAGES = {name: resource(f"docs/families/{name}.md") for name in NAMES}
OTHERS = {name: resource(f"docs/{name}.md") for name in ("fault-effects", "equations", "smooth")}
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


@pytest.mark.parametrize("page", ["docs/spec-file.md", "docs/equations.md"])
def test_spec_files_on_a_page_validate(page):
    found = blocks(resource(page), "toml")
    assert found
    for text in found:
        assert fkgen.validate(fkgen.Spec.from_dict(tomllib.loads(text))).claims


def test_errors_on_the_page_about_equations_are_those_that_come():
    text = resource("docs/equations.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w[\w.]* = .*)` \| (model\..*) \|$", text, re.MULTILINE)
    assert len(rows) > 5
    for change, said in rows:
        table = tomllib.loads(blocks(resource("docs/equations.md"), "toml")[0])
        for key, value in tomllib.loads(change).items():
            given = table["model"].get(key, {})
            table["model"][key] = {**given, **value} if isinstance(value, dict) else value
        with pytest.raises(fkgen.SpecError) as refused:
            fkgen.Spec.from_dict(table, file="spec.toml")
        assert str(refused.value) == f"spec.toml: {said}"


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


def test_the_page_about_records_says_what_happens(tmp_path, monkeypatch):
    """Its first section by the letter: files are saved, commands run, what they say compared."""
    monkeypatch.chdir(tmp_path)
    section = resource("docs/records.md").read_text(encoding="utf-8").split("\n## ")[1]
    log, *plain = re.findall(r"(?:^    .*\n)+", section, re.MULTILINE)
    (tmp_path / "log.csv").write_text(dedent(log), encoding="utf-8")
    said, expected, told = list[str](), list[str](), list[str]()
    for block in plain:
        lines = dedent(block).splitlines()
        if not lines[0].startswith("fkgen "):
            expected += lines
            continue
        for line in lines:
            if "climb.toml" in line:
                (text,) = re.findall(r"^```toml\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
                (tmp_path / "climb.toml").write_text(text, encoding="utf-8")
            result = CliRunner().invoke(main, shlex.split(line)[1:], prog_name="fkgen")
            assert result.exit_code == 0, result.output
            told.append(line)
            said += [] if line.startswith("fkgen check") else result.output.splitlines()
    assert len(told) == 4
    assert said == expected
    for name, deviation in (("filtered", 0.4), ("climb", 0.1)):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        table = np.genfromtxt(tmp_path / f"{name}.csv", delimiter=",", names=True, dtype=None)
        height = "filtered_sdheight" if name == "climb" else "filtered_sdGPS_height"
        assert table["Time_ms"][-1] == 1714564802612
        assert round(float(table[height][-1]), 1) == deviation
