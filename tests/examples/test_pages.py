"""Tutorials and errata are followed to the letter; on the other pages no name or option is stale.

A page that is followed is read from top to bottom in an empty folder. A block whose first line is
a comment with a file name is saved; ``console`` blocks are run and what they print is compared,
``...`` standing for anything; ``python`` blocks run in one namespace, prints compared with
the comments beside them; ``toml`` blocks have to be specs. ``<!-- not run: reason -->`` before a
block leaves it out.
"""

from __future__ import annotations

import ast
import inspect
import os
import re
import shlex
import shutil
import subprocess
import tomllib
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from io import StringIO
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import fkgen
from fkgen.cli import main

ROOT = Path(__file__).resolve().parents[2]
FOLLOWED = [*sorted((ROOT / "docs/tutorials").glob("*.md")), ROOT / "docs/errata.md"]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/*/*.md")])
BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>.+) -->\n)?```(?P<language>\S*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
NAMED = re.compile(r"(?:#|/\*) (?P<file>[\w-]+\.(?:toml|py|c|csv))(?: \*/)?\n")


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    reason: str | None  # why it is not run

    @property
    def file(self):
        named = NAMED.match(self.text)
        return named and named["file"]


def blocks(path):
    text = path.read_text(encoding="utf-8")
    return [Block(m["language"], m["text"], m["reason"]) for m in BLOCK.finditer(text)]


def name(path):
    return path.relative_to(ROOT).as_posix()


def said(command):
    """What a command prints, on both streams."""
    if command.startswith("fkgen "):
        result = CliRunner().invoke(main, shlex.split(command)[1:], prog_name="fkgen")
        assert result.exit_code == 0, result.output
        return result.output
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)  # noqa: S602
    assert done.returncode == 0, done.stderr
    return done.stdout


def same(printed, shown):
    """Say whether lines are those shown, ``...`` standing for any."""
    shown = [line.rstrip() for line in shown if line.strip()]
    printed = [line.rstrip() for line in printed if line.strip()]
    pattern = "".join(
        r"(?:.*\n)*?" if line.strip() == "..." else re.escape(line).replace(r"\.\.\.", ".*") + r"\n"
        for line in shown
    )
    return re.fullmatch(pattern, "".join(f"{line}\n" for line in printed)) is not None


def follow_console(text):
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, *shown = part.splitlines()
        printed = said(command)
        assert same(printed.splitlines(), shown), f"{command}\n{printed}"


def follow_python(text, names):
    printed = StringIO()
    with redirect_stdout(printed):
        exec(compile(text, "page", "exec"), names)  # noqa: S102
    assert printed.getvalue().splitlines() == re.findall(
        r"^ *print\(.*\)  # (.*)$", text, re.MULTILINE
    )


@pytest.mark.compiled
@pytest.mark.parametrize("path", FOLLOWED, ids=name)
def test_a_page_that_is_followed_is_true_to_the_letter(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROOT", str(ROOT))
    monkeypatch.syspath_prepend(tmp_path)
    names = {}
    for block in blocks(path):
        if block.reason is not None:
            continue
        if block.file:
            Path(block.file).write_text(block.text, encoding="utf-8")
        if block.language == "toml":
            fkgen.Spec.from_dict(tomllib.loads(block.text))
        elif block.language == "console":
            follow_console(block.text)
        elif block.language == "python" and not block.file:
            follow_python(block.text, names)


def test_lines_that_differ_are_seen():
    assert same(["a", "b", "c"], ["a", "...", "c"])
    assert same(["a"], ["a", "..."])
    assert not same(["a", "b"], ["a"])
    assert not same(["a", "b"], ["...", "c"])


@cache
def public(path):
    """The public object of a dotted name that begins with fkgen."""
    found = fkgen
    for part in path.split(".")[1:]:
        found = getattr(found, part)
    return found


def dotted(node):
    """``fkgen.profiles.step`` of the tree of an expression, empty where it is something else."""
    if isinstance(node, ast.Name):
        return node.id
    below = dotted(node.value) if isinstance(node, ast.Attribute) else ""
    return f"{below}.{node.attr}" if below else ""


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_python_on_a_page_calls_what_there_is(path):
    for block in blocks(path):
        if block.language != "python":
            continue
        for node in ast.walk(ast.parse(block.text)):
            called = dotted(node.func) if isinstance(node, ast.Call) else ""
            if called.startswith("fkgen."):
                keywords = {keyword.arg: None for keyword in node.keywords if keyword.arg}
                starred = any(isinstance(each, ast.Starred) for each in node.args)
                given = [] if starred else node.args
                inspect.signature(public(called)).bind_partial(*given, **keywords)


def parameters(command):
    """Options of a command as one writes them, with whether a value follows."""
    return {
        option: not (parameter.is_flag or parameter.count)
        for parameter in command.params
        if isinstance(parameter, click.Option)
        for option in (*parameter.opts, *parameter.secondary_opts)
    }


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_commands_on_a_page_have_the_options_they_are_given(path):
    text = path.read_text(encoding="utf-8")
    for line in re.findall(r"^(?:    |\$ )(fkgen (?!/).*)$", text, re.MULTILINE):
        words = line.split("  ")[0].split(" #")[0].split()
        command = main.commands.get(words[1])
        if words[1].startswith("--"):
            continue
        assert command is not None, line
        known = {*parameters(command), "--help", "-h"}
        options = {word.split("=")[0] for word in words[2:] if re.match(r"--?[a-z]", word)}
        assert options <= known, line


def test_every_page_is_on_the_site():
    """What the index does not lead to, nobody finds. The build of the site says so too."""
    listed = set()
    for page in (ROOT / "docs").rglob("*.md"):
        for block in blocks(page):
            if block.language == "{toctree}":
                for line in block.text.splitlines():
                    if line and not line.startswith(":"):
                        folder = os.path.relpath((page.parent / line).parent, ROOT)
                        listed |= set((ROOT / folder).glob(f"{Path(line).name}.md"))
                        listed |= set(ROOT.glob(os.path.normpath(f"{name(page.parent)}/{line}.md")))
    listed = {path.resolve() for path in listed}
    pages = {path.resolve() for path in PAGES}
    apart = {ROOT / "README.md", ROOT / "docs/index.md"}
    assert pages - listed - {path.resolve() for path in apart} == set()


@pytest.fixture(autouse=True)
def _needs_a_compiler_where_a_page_calls_one(request):
    path = request.node.funcargs.get("path")
    if path in FOLLOWED and "$ cc " in path.read_text(encoding="utf-8") and not shutil.which("cc"):
        pytest.skip("there is no cc here")
