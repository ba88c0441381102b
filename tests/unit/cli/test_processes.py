"""Builds that meet, and builds that are stopped: the cache stays usable."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from fkgen.study.reports.starters import starter

SLOW_CC = """#!/bin/sh
touch "{mark}"
sleep {seconds}
exec cc "$@"
"""


def heed_interrupts():
    """A process started in the background of a script ignores SIGINT, and so do its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "motor.toml").write_text(starter("mkf"), encoding="utf-8")
    (tmp_path / "r.csv").write_text("voltage,speed_measured\n1,0.1\n1,0.2\n", encoding="utf-8")
    return tmp_path


@pytest.fixture
def start(folder):
    """Start fkgen in a process of its own, with a cache of this test."""
    started = []

    def call(*arguments, compiler="cc"):
        process = subprocess.Popen(
            [sys.executable, "-m", "fkgen", *arguments],
            cwd=folder,
            env=os.environ | {"FKGEN_CACHE": str(folder / "cache"), "FKGEN_CC": str(compiler)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=heed_interrupts,  # noqa: PLW1509 - it starts no thread
        )
        started.append(process)
        return process

    yield call
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def slow_compiler(folder):
    def make(seconds):
        path = folder / "slowcc"
        path.write_text(
            SLOW_CC.format(mark=folder / "compiling", seconds=seconds), encoding="utf-8"
        )
        path.chmod(0o755)
        return path

    return make


def wait_for(path):
    deadline = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < deadline, "the build never reached the compiler"
        time.sleep(0.02)


def finished(process):
    out, errors = process.communicate(timeout=120)
    assert "Traceback" not in errors
    return process.returncode, out, errors


def test_two_builds_of_one_spec_at_once_both_succeed(start, slow_compiler, folder):
    compiler = slow_compiler(1)
    both = [start("run", "motor.toml", "r.csv", compiler=compiler) for _ in range(2)]
    results = [finished(process) for process in both]
    assert [status for status, _, _ in results] == [0, 0]
    assert results[0][1] == results[1][1]
    assert len(list((folder / "cache").iterdir())) == 1


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_a_build_that_is_stopped_leaves_a_usable_cache(start, slow_compiler, folder, stop):
    process = start("run", "motor.toml", "r.csv", "-o", "o.csv", compiler=slow_compiler(30))
    wait_for(folder / "compiling")
    os.killpg(process.pid, stop)
    status, out, errors = finished(process)
    assert out == ""
    if stop == signal.SIGINT:
        assert status == 130
        assert errors == "error: interrupted\n"
        assert list((folder / "cache").iterdir()) == []
    else:
        assert status == -signal.SIGKILL
    assert not (folder / "o.csv").exists()
    again = start("run", "motor.toml", "r.csv", "-o", "o.csv", compiler=slow_compiler(0))
    assert finished(again)[0] == 0
    assert (folder / "o.csv").is_file()
