"""The cache of compiled filters: complete or absent, whoever builds at the same time."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from plants import motor
from toolchain import needs_compiler

import fkgen
from fkgen.errors import OutputError
from fkgen.runtime import cache

ROOT = Path(__file__).resolve().parents[3]
PLANT = motor("kf")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def fill(text):
    def write(entry):
        (entry / cache.LIBRARY).write_text(text)
        (entry / cache.LAYOUT).write_text("{}")

    return write


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_what_was_stored_is_found_and_nothing_else(folder):
    assert cache.find("key") is None
    entry = cache.store("key", fill("a"))
    assert cache.find("key") == entry == folder / "key"
    assert cache.find("other") is None
    assert names(folder) == ["key"]


def test_who_comes_second_uses_what_the_first_stored(folder):
    cache.store("key", fill("first"))
    entry = cache.store("key", fill("second"))
    assert (entry / cache.LIBRARY).read_text() == "first"
    assert names(folder) == ["key"]


def test_an_entry_without_its_library_is_made_again(folder):
    entry = cache.store("key", fill("old"))
    (entry / cache.LIBRARY).unlink()
    assert cache.find("key") is None
    cache.store("key", fill("new"))
    assert (cache.find("key") / cache.LIBRARY).read_text() == "new"
    assert names(folder) == ["key"]


def test_a_build_that_is_interrupted_leaves_nothing_behind(folder):
    def interrupted(entry):
        (entry / cache.LIBRARY).write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cache.store("key", interrupted)
    assert cache.find("key") is None
    assert names(folder) == []


def test_a_full_disk_is_an_output_error_and_leaves_nothing_behind(folder):
    def full(entry):
        (entry / cache.LAYOUT).write_text("{}")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OutputError, match=r"no space left on device; expected .* FKGEN_CACHE"):
        cache.store("key", full)
    assert names(folder) == []


def test_a_cache_below_a_file_is_an_output_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(OutputError, match="expected a folder that can be written"):
        cache.store("key", fill("a"))
    assert cache.find("key") is None


def test_a_cache_that_cannot_be_made_is_an_output_error(folder, monkeypatch):
    def refused(path, *arguments, **options):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(OutputError, match="permission denied"):
        fkgen.build(PLANT)


def test_keys_tell_parts_apart():
    assert cache.key_of("a", "bc") != cache.key_of("ab", "c")
    assert cache.key_of("a", "b") == cache.key_of("a", "b")


def test_the_cache_is_where_the_variables_say(tmp_path, monkeypatch):
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path / "own"))
    assert cache.folder() == tmp_path / "own"
    monkeypatch.delenv("FKGEN_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.folder() == tmp_path / "xdg" / "fkgen"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.folder() == tmp_path / ".cache" / "fkgen"


@needs_compiler()
def test_a_spec_that_was_built_is_only_loaded(folder, monkeypatch):
    fkgen.build(PLANT)
    before = names(folder)

    def unexpected(*arguments, **options):
        raise AssertionError("built again")

    monkeypatch.setattr("fkgen.pipeline.validate", unexpected)
    assert fkgen.build(PLANT).step([0.1], [1.0]).status == 0
    assert names(folder) == before


@needs_compiler()
def test_another_spec_or_another_compiler_flag_is_another_entry(folder, monkeypatch):
    fkgen.build(PLANT)
    fkgen.build(motor("kf", code={"scalar": "float"}))
    assert len(names(folder)) == 2


BUILD = """
import sys, numpy as np
from plants import motor
import fkgen
found = fkgen.build(motor("kf"))
print(float(found.run(np.ones((3, 1)), np.ones((3, 1))).filtered_state[-1, 0]).hex())
"""


@needs_compiler()
def test_processes_that_build_at_once_get_the_same_filter_and_leave_one_entry(folder):
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "models")])
    environment = os.environ | {"PYTHONPATH": path}

    def build(_):
        return subprocess.run(
            [sys.executable, "-c", BUILD],
            capture_output=True,
            text=True,
            env=environment,
            check=True,
        ).stdout

    with ThreadPoolExecutor(3) as pool:
        answers = set(pool.map(build, range(3)))
    assert len(answers) == 1
    assert len(names(folder)) == 1


@needs_compiler()
def test_a_process_killed_while_it_builds_does_not_spoil_the_cache(folder, tmp_path):
    hanging = tmp_path / "hanging-cc"
    hanging.write_text("#!/bin/sh\nexec sleep 60\n")
    hanging.chmod(0o755)
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "models")])
    environment = os.environ | {"PYTHONPATH": path, "FKGEN_CC": str(hanging)}
    victim = subprocess.Popen(
        [sys.executable, "-c", BUILD], env=environment, start_new_session=True
    )
    try:
        while not (folder.exists() and names(folder)):
            assert victim.poll() is None
            time.sleep(0.05)
    finally:
        os.killpg(victim.pid, signal.SIGKILL)
        victim.wait()
    assert [name.startswith(".building-") for name in names(folder)] == [True]
    assert fkgen.build(PLANT).step([0.1], [1.0]).status == 0
