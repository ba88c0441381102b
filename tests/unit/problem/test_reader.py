"""Spec files: read as TOML, refused with their name where they cannot be."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from fkgen.errors import SpecError
from fkgen.problem import Spec, load

TOML = """
name = "motor"

[model]
A = [[0.98, -0.0002], [0.0094, "exp(-0.01/tau)"]]
C = [[0.0, 1.0]]
Q = [[1e-6, 0], [0, 1e-6]]
R = [[1e-4]]
x0 = [0, 0]
P0 = [[1, 0], [0, 1]]

[parameters]
tau = 0.05

[filter]
family = "kf"
"""
SPEC = Spec.from_dict(tomllib.loads(TOML))


def test_a_file_gives_the_same_spec(tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(TOML, encoding="utf-8")
    assert load(path) == load(str(path)) == SPEC
    assert load(path).file == str(path)


@pytest.mark.parametrize(
    ("content", "key", "given"),
    [
        (b"name = ", "file", "at line 1, the end of the document"),
        (b"name = 'a'\nname = 'b'\n", "file", "(at line 2"),
        (b"a = [\n1,\n2 3]", "file", "line 3"),
        (b"name = '\xff'", "file", "bytes that are not UTF-8 at offset 8"),
        (b"x = " + b"9" * 5000, "file", "invalid TOML"),
        (b"x = " + b"[" * 20_000, "file", "nested too deeply"),
        (b"", "spec", "an empty spec"),
        (b"# nothing\n", "spec", "an empty spec"),
        (TOML.encode().replace(b"[0.0, 1.0]", b"[0.0]"), "model.C", "shape (1, 1)"),
        (TOML.encode().replace(b"tau = 0.05", b"tau = nan"), "parameters.tau", "nan"),
        (TOML.encode().replace(b"tau = 0.05", b"tau = 1979-05-27"), "parameters.tau", "date"),
    ],
)
def test_files_that_are_no_spec(tmp_path: Path, content: bytes, key: str, given: str) -> None:
    path = tmp_path / "motor.toml"
    path.write_bytes(content)
    with pytest.raises(SpecError) as caught:
        load(path)
    error = caught.value
    assert (error.file, error.key) == (str(path), key)
    assert given in error.given
    assert str(error).isprintable()
    assert error.__suppress_context__ or error.__context__ is None


def test_a_byte_order_mark_is_no_reason_to_refuse(tmp_path: Path) -> None:
    path = tmp_path / "motor.toml"
    path.write_text(TOML, encoding="utf-8-sig")
    assert load(path) == SPEC


@pytest.mark.parametrize("name", ["missing.toml", "", "a\x00b"])
def test_paths_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    with pytest.raises(SpecError, match="expected a readable file") as caught:
        load(f"{tmp_path}/{name}")
    assert caught.value.key == "file"
    assert caught.value.__suppress_context__
