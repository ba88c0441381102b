"""A file is written completely or not at all, and nothing that exists is lost."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from fkgen.errors import OutputError
from fkgen.study.records.files import refuse_format, write_whole


def test_bytes_arrive(tmp_path):
    write_whole(tmp_path / "a", b"one")
    assert (tmp_path / "a").read_bytes() == b"one"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_permissions_are_those_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    write_whole(tmp_path / "a", b"one")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_file_that_exists_is_kept(tmp_path):
    (tmp_path / "a").write_bytes(b"old")
    with pytest.raises(OutputError, match="given a file that exists; expected the name of a new"):
        write_whole(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"


def test_force_replaces_it(tmp_path):
    (tmp_path / "a").write_bytes(b"old")
    write_whole(tmp_path / "a", b"new", force=True)
    assert (tmp_path / "a").read_bytes() == b"new"


def test_force_through_a_link_replaces_the_file_it_points_to(tmp_path):
    (tmp_path / "a").write_bytes(b"old")
    (tmp_path / "link").symlink_to("a")
    write_whole(tmp_path / "link", b"new", force=True)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "a").read_bytes() == b"new"


def test_a_file_that_came_into_being_meanwhile_is_kept(tmp_path, monkeypatch):
    def rival(_descriptor):
        (tmp_path / "a").write_bytes(b"rival")

    monkeypatch.setattr(os, "fsync", rival)
    with pytest.raises(OutputError, match="exists"):
        write_whole(tmp_path / "a", b"mine")
    assert (tmp_path / "a").read_bytes() == b"rival"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("force", [False, True])
def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch, force):
    (tmp_path / "old").write_bytes(b"old")

    def full(_descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="given no space left on device"):
        write_whole(tmp_path / ("old" if force else "new"), b"data", force=force)
    assert [p.name for p in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old").read_bytes() == b"old"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_device_is_written_directly():
    with pytest.raises(OutputError, match="no space left on device"):
        write_whole(Path("/dev/full"), b"data")
    write_whole(Path(os.devnull), b"data")


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(OutputError, match="given a folder; expected the name of a file"):
        write_whole(tmp_path, b"")


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(OutputError, match="a folder that does not exist"):
        write_whole(tmp_path / "no" / "a", b"")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="permission denied"):
        write_whole(tmp_path / "a", b"")
    tmp_path.chmod(0o700)


@pytest.mark.parametrize("name", ["a", "a.jpg", "a.png.gz"])
def test_pictures_need_a_known_ending(name):
    with pytest.raises(OutputError, match=r"\.png, \.pdf, \.svg"):
        refuse_format(Path(name))
