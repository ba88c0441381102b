"""`fkgen generate --harness`: the program for libFuzzer, driven here by numbers drawn in C."""

from __future__ import annotations

import runpy
import shutil
import subprocess
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from click.testing import CliRunner
from toolchain import call, needs_compiler, run_main

import fkgen
from fkgen.cli import main
from fkgen.study.reports.starters import starter

pytestmark = needs_compiler()

ROOT = Path(__file__).resolve().parents[2]

#: Drawn bytes; every fourth sequence has none of the high exponents, so that more is accepted.
DRIVER = """
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int main(void)
{
    static uint8_t bytes[4096];
    uint64_t s = 88172645463325252u;
    int k, i;
    for (k = 0; k < 3000; ++k)
    {
        for (i = 0; i < 4096; ++i)
        {
            s ^= s << 13; s ^= s >> 7; s ^= s << 17;
            bytes[i] = (uint8_t)((k % 4) ? s : (s & 0x3f));
        }
        LLVMFuzzerTestOneInput(bytes, sizeof bytes);
    }
    printf("done\\n");
    return 0;
}
"""


def test_no_call_of_a_filter_with_ranges_breaks_its_word_whatever_bits_it_is_given(tmp_path):
    spec = ROOT / "examples" / "firmware_motor" / "spec.toml"
    out = tmp_path / "out"
    arguments = ["generate", str(spec), "--harness", "-o", str(out)]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    assert "fuzz" not in (out / "CMakeLists.txt").read_text(encoding="utf-8")
    assert run_main(out, DRIVER, "motor.c", "motor_fuzz.c") == ["done"]


@cache
def fuzzes():
    """Whether there is a clang that links libFuzzer."""
    empty = "int LLVMFuzzerTestOneInput(const char *p, unsigned long n) { return !p && n; }"
    if shutil.which("clang") is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        command = ("clang", "-fsanitize=fuzzer,address", "-x", "c", "-", "-o", f"{folder}/empty")
        done = subprocess.run(command, input=empty, text=True, capture_output=True, check=False)
    return done.returncode == 0


def test_ten_thousand_sequences_of_calls_find_nothing_where_covariances_are_factors():
    if not fuzzes():
        pytest.skip("there is no clang with libFuzzer: apt install clang libclang-rt-14-dev")
    one = runpy.run_path(str(ROOT / "tools" / "fuzz.py"))["one"]
    spec = fkgen.load(ROOT / "examples" / "nile" / "spec.toml")
    spec = replace(spec, code=replace(spec.code, update="ud"))
    assert one(spec, 10_000, 120) == ("nile", "ud", "10,000", "")


def test_the_harness_finds_a_refusal_that_changes_something(tmp_path):
    (tmp_path / "spec.toml").write_text(starter("kf"), encoding="utf-8")
    out = tmp_path / "out"
    arguments = ["generate", str(tmp_path / "spec.toml"), "--harness", "-o", str(out)]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    text = (out / "my_filter.c").read_text(encoding="utf-8")
    refusal = "return MY_FILTER_INPUT_NOT_FINITE;"
    broken = text.replace(refusal, f"self->updated += 1; {refusal}")
    assert broken != text
    (out / "my_filter.c").write_text(broken, encoding="utf-8")
    (out / "driver.c").write_text(DRIVER, encoding="utf-8")
    files = ("driver.c", "my_filter.c", "my_filter_fuzz.c")
    call("cc", "-std=c99", "-O1", *files, "-o", "driver", cwd=out)
    assert call("./driver", cwd=out, check=False).returncode < 0
