"""Generated files arrive completely or not at all, and never on top of somebody else's."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path

import pytest
from plants import generated, motor

import fkgen
from fkgen.backend.source import write_package
from fkgen.errors import OutputError


@pytest.fixture(scope="module")
def source():
    return generated(motor("kf"))


@pytest.fixture(scope="module")
def other():
    return generated(motor("mkf"))


def content(folder):
    return {path.name: path.read_text() for path in folder.iterdir()}


def renamed(spec, name):
    return fkgen.Spec.from_dict(spec.to_dict() | {"name": name})


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


def test_files_of_others_stay_beside_own_ones(source, other, tmp_path):
    others = {"notes.txt": "mine", "main.c": "int main(void);", "plant_old.c": "", ".hidden": ""}
    for name, text in others.items():
        (tmp_path / name).write_text(text)
    for each in (source, other, source):
        each.write(tmp_path)
        assert content(tmp_path) == others | dict(each.files)


def test_a_build_file_of_others_stays_and_the_manifest_does_not_claim_it(source, other, tmp_path):
    (tmp_path / "CMakeLists.txt").write_text("# mine")
    for each in (source, other, source):
        each.write(tmp_path)
        assert (tmp_path / "CMakeLists.txt").read_text() == "# mine"
        manifest = json.loads((tmp_path / "manifest.json").read_text())
        assert set(manifest["files"]) == set(each.files) - {"manifest.json", "CMakeLists.txt"}
    (tmp_path / "CMakeLists.txt").unlink()
    source.write(tmp_path)
    assert content(tmp_path) == dict(source.files)


@pytest.mark.parametrize("name", ["plant.c", "plant.h", "plant_selftest.c"])
def test_a_file_of_others_in_the_place_of_an_own_one_is_left_alone(name, source, tmp_path):
    (tmp_path / name).write_text("/* mine */")
    with pytest.raises(OutputError, match=rf"{name}: given a file that fkgen did not write"):
        source.write(tmp_path)
    assert content(tmp_path) == {name: "/* mine */"}


def test_several_filters_share_a_folder_in_any_order(tmp_path):
    specs = {name: motor(family) for name, family in (("b", "kf"), ("a", "mkf"), ("c", "mme"))}
    sources = {name: generated(renamed(spec, name)) for name, spec in specs.items()}
    for at, order in enumerate(("abc", "cab", "bcab")):
        for name in order:
            sources[name].write(tmp_path / str(at))
    found = content(tmp_path / "0")
    assert content(tmp_path / "1") == content(tmp_path / "2") == found
    summary = {"manifest.json", "CMakeLists.txt"}
    texts = {k: v for each in sources.values() for k, v in each.files.items() if k not in summary}
    assert {k: v for k, v in found.items() if k not in summary} == texts
    for name in sources:
        assert f"add_library({name} STATIC {name}.c)" in found["CMakeLists.txt"]
        assert f"COMMAND {name}_selftest" in found["CMakeLists.txt"]
    manifest = json.loads(found["manifest.json"])
    assert [each["name"] for each in manifest["filters"]] == ["a", "b", "c"]
    for each in manifest["filters"]:
        alone = json.loads(sources[each["name"]].files["manifest.json"])
        del alone["generator"], alone["files"]["CMakeLists.txt"]
        assert each == alone


def test_an_edited_file_of_another_filter_is_not_overwritten_nor_lost(source, tmp_path):
    second = generated(renamed(motor("mkf"), "second"))
    for each in (source, second):
        each.write(tmp_path)
    for name in ("plant.h", "CMakeLists.txt"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(f"{text}# tuned")
        before = content(tmp_path)
        with pytest.raises(OutputError, match=rf"{name}: given a generated file that was edited"):
            second.write(tmp_path)
        assert content(tmp_path) == before
        (tmp_path / name).write_text(text)
    second.write(tmp_path)


def test_a_filter_whose_source_was_taken_away_is_forgotten(source, tmp_path):
    second = generated(renamed(motor("mkf"), "second"))
    for each in (source, second):
        each.write(tmp_path)
    for name in source.files.keys() - second.files.keys():
        (tmp_path / name).unlink()
    second.write(tmp_path)
    assert content(tmp_path) == dict(second.files)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_filters_whose_files_have_the_same_names_do_not_share_a_folder(order, source, tmp_path):
    pair = (source, generated(renamed(motor("kf"), "plant_selftest")))
    first, second = (pair[i] for i in order)
    first.write(tmp_path)
    with pytest.raises(OutputError, match=r"plant_selftest\.c: given a file of another filter"):
        second.write(tmp_path)
    assert content(tmp_path) == dict(first.files)


def test_a_manifest_that_leads_out_of_the_folder_is_not_followed(source, tmp_path):
    (tmp_path / "mine.c").write_text("mine")
    source.write(tmp_path / "out")
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    manifest["files"]["../mine.c"] = hashlib.sha256(b"mine").hexdigest()
    (tmp_path / "out" / "manifest.json").write_text(json.dumps(manifest))
    source.write(tmp_path / "out")
    assert (tmp_path / "mine.c").read_text() == "mine"


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
    with pytest.raises(OutputError, match=r"manifest\.json: given a file that fkgen did not write"):
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


@pytest.mark.parametrize("fails_at", range(13))
def test_a_file_that_cannot_be_moved_leaves_everything_as_it_was(
    fails_at, source, other, tmp_path, monkeypatch
):
    (tmp_path / "notes.txt").write_text("mine")
    source.write(tmp_path)
    before, rename, calls = content(tmp_path), Path.rename, []

    def stubborn(path, to):
        calls.append(path)
        if len(calls) == fails_at + 1:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", stubborn)
    if fails_at < 12:  # six files go, six come
        with pytest.raises(OutputError, match="permission denied"):
            other.write(tmp_path)
        assert content(tmp_path) == before
    else:
        other.write(tmp_path)
        assert content(tmp_path) == {"notes.txt": "mine"} | dict(other.files)


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("method", ["write_text", "rename", "mkdir"])
def test_a_package_that_cannot_be_written_leaves_no_folder(method, existing, tmp_path, monkeypatch):
    target, files = tmp_path / "out", {"src/deep/a.c": "a", "src/b.c": "b", "c.txt": "c"}
    if existing:
        target.mkdir()
        (target / "notes.txt").write_text("mine")
    before, right, calls = sorted(tmp_path.rglob("*")), getattr(Path, method), []

    def failing(path, *arguments, **options):
        calls.append(path)
        if path.name in {"b.c", "deep"} and (method != "mkdir" or path.parent.parent == target):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return right(path, *arguments, **options)

    monkeypatch.setattr(Path, method, failing)
    with pytest.raises(OutputError, match="no space left on device"):
        write_package(target, files, {})
    monkeypatch.undo()
    assert calls
    assert sorted(tmp_path.rglob("*")) == before
    write_package(target, files, {})
    assert (target / "src" / "deep" / "a.c").read_text() == "a"


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
