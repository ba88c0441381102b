"""Generated files arrive completely or not at all, and never on top of somebody else's."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
from plants import generated, motor

from fkgen.errors import OutputError


@pytest.fixture(scope="module")
def source():
    return generated(motor("kf"))


@pytest.fixture(scope="module")
def other():
    return generated(motor("mkf"))


def content(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_all_files_arrive_and_the_folder_is_returned(source, tmp_path):
    target = source.write(tmp_path / "deep" / "new")
    assert target == tmp_path / "deep" / "new"
    assert content(target) == dict(source.files)
    assert set(source.files) >= {"plant.h", "plant.c", "plant_selftest.c", "manifest.json"}


def test_an_empty_folder_is_filled(source, tmp_path):
    (tmp_path / "out").mkdir()
    source.write(tmp_path / "out")
    assert content(tmp_path / "out") == dict(source.files)


def test_a_path_may_be_a_text(source, tmp_path):
    source.write(str(tmp_path / "out"))
    assert (tmp_path / "out" / "plant.c").is_file()


def test_own_unchanged_output_is_replaced(source, other, tmp_path):
    source.write(tmp_path / "out")
    other.write(tmp_path / "out")
    assert content(tmp_path / "out") == dict(other.files)


def test_own_output_with_a_file_taken_away_is_replaced(source, tmp_path):
    source.write(tmp_path / "out")
    (tmp_path / "out" / "plant.c").unlink()
    source.write(tmp_path / "out")
    assert content(tmp_path / "out") == dict(source.files)


def test_a_folder_with_other_files_is_left_alone(source, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"other files \(notes.txt\)"):
        source.write(tmp_path)
    assert content(tmp_path) == {"notes.txt": "mine"}


def test_a_foreign_file_beside_own_output_is_left_alone(source, tmp_path):
    source.write(tmp_path / "out")
    (tmp_path / "out" / "main.c").write_text("mine")
    before = content(tmp_path / "out")
    with pytest.raises(OutputError, match=r"other files \(main.c\)"):
        source.write(tmp_path / "out")
    assert content(tmp_path / "out") == before


def test_an_edited_file_is_left_alone_and_named(source, tmp_path):
    source.write(tmp_path / "out")
    path = tmp_path / "out" / "plant.c"
    path.write_text(path.read_text() + "/* tuned */\n")
    before = content(tmp_path / "out")
    with pytest.raises(OutputError, match=r"plant\.c: given a generated file that was edited"):
        source.write(tmp_path / "out")
    assert content(tmp_path / "out") == before


@pytest.mark.parametrize("text", ["", "[]", "{", '{"generator": "other", "files": {}}', "null"])
def test_a_manifest_of_somebody_else_does_not_make_a_folder_ours(text, source, tmp_path):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(OutputError, match="other files"):
        source.write(tmp_path)
    assert content(tmp_path) == {"manifest.json": text}


def test_a_file_in_the_place_of_the_folder_is_left_alone(source, tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="given a file"):
        source.write(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_a_file_above_the_folder_is_an_output_error(source, tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError):
        source.write(tmp_path / "out" / "deeper")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("fails_at", [0, 2])
def test_a_full_disk_leaves_nothing_half_written(existing, fails_at, source, tmp_path, monkeypatch):
    target = tmp_path / "out"
    if existing:
        source.write(target)
    before = content(target) if existing else None
    write_text, calls = Path.write_text, []

    def full(path, *arguments, **options):
        calls.append(path)
        if len(calls) > fails_at:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_text(path, *arguments, **options)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match="no space left on device"):
        source.write(target)
    monkeypatch.undo()
    assert (content(target) if existing else None) == before
    assert [path.name for path in tmp_path.iterdir()] == (["out"] if existing else [])


def test_a_folder_that_cannot_be_moved_into_place_leaves_the_old_one(
    source, other, tmp_path, monkeypatch
):
    target = source.write(tmp_path / "out")
    rename = Path.rename

    def stubborn(path, to):
        if to == target and path.name.startswith(".out-") and "old" not in path.name:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", stubborn)
    with pytest.raises(OutputError, match="permission denied"):
        other.write(target)
    monkeypatch.undo()
    assert content(target) == dict(source.files)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_an_output_error(source, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="permission denied"):
        source.write(tmp_path / "out")


def test_the_folder_can_be_read_by_others(source, tmp_path):
    assert source.write(tmp_path / "out").stat().st_mode & 0o777 == 0o755


def test_the_manifest_lists_what_was_proved_and_what_was_written(source):
    manifest = json.loads(source.files["manifest.json"])
    assert set(manifest["files"]) == set(source.files) - {"manifest.json"}
    assert manifest["proved"] == list(source.claims) != []
    assert manifest["flops"] == source.program.flops
    assert [port["name"] for port in manifest["ports"]] == [p.name for p in source.program.ports]


def test_files_end_in_one_newline_and_have_no_trailing_blanks_or_tabs(source, other):
    for text in [*source.files.values(), *other.files.values()]:
        assert text.endswith("\n")
        assert not text.endswith("\n\n")
        assert all(line == line.rstrip() and "\t" not in line for line in text.splitlines())
        assert text.isascii()
