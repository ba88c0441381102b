"""generated/ is what fkgen generates from the examples, byte by byte."""

from __future__ import annotations

import difflib
import re
import runpy
from pathlib import Path

import pytest

import fkgen

ROOT = Path(__file__).resolve().parents[2]
GENERATED = ROOT / "generated"
SPECS = sorted((ROOT / "examples").glob("*/*.toml"))
HINT = "If this is meant to change: python tools/golden.py --update, and read the whole diff."

#: What of a filter stands in generated/.
KEPT = runpy.run_path(str(ROOT / "tools" / "golden.py"))["kept"]

#: Lines of a difference that are shown; the tool shows more.
SHOWN = 40


@pytest.mark.parametrize("path", SPECS, ids=[f"{p.parent.name}/{p.stem}" for p in SPECS])
def test_generated_code_is_current(path):
    spec = fkgen.load(path)
    files = KEPT(fkgen.generate(fkgen.validate(spec)).files)
    folder = GENERATED / spec.name
    present = {each.name: each.read_bytes() for each in sorted(folder.glob("*"))}
    now = {name: text.encode() for name, text in files.items()}
    found = [
        line
        for name in sorted(present.keys() | now.keys())
        for line in difflib.unified_diff(
            present.get(name, b"").decode().splitlines(),
            now.get(name, b"").decode().splitlines(),
            f"generated/{spec.name}/{name}",
            "what fkgen generates now",
            lineterm="",
            n=1,
        )
    ]
    assert present == now, "\n".join(["", *found[:SHOWN], HINT])


def test_every_generated_folder_belongs_to_a_spec_and_every_spec_has_a_name_of_its_own():
    names = [fkgen.load(path).name for path in SPECS]
    assert len(set(names)) == len(names)
    assert {path.name for path in GENERATED.iterdir() if path.is_dir()} == set(names)


def test_generated_code_says_nothing_of_where_and_when_it_was_made():
    files = [path for path in GENERATED.glob("*/*") if path.is_file()]
    assert files
    for path in files:
        text = path.read_text(encoding="utf-8")
        assert str(ROOT) not in text
        assert not re.search(r"\b20[2-9]\d-\d\d|\b\d\d:\d\d\b", text), path
