"""Filters of one program can share one copy of the elementary functions, without another bit."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import spread
from plants import generated
from toolchain import ANY, BITS, C_ONLY, CPP_COMPILERS, FLAGS, call, check_only, needs_compiler

import fkgen
from fkgen.errors import OutputError

pytestmark = needs_compiler()

SCALARS = ("double", "float")


def source(name, scalar, prefix, elementary="shared"):
    table = spread.specs(scalar)[name].to_dict()
    table["name"] = prefix
    table["code"]["elementary"] = elementary
    return generated(fkgen.Spec.from_dict(table))


def shared_files(files):
    return {name: text for name, text in files.items() if name.startswith("fkgen_elementary_")}


@pytest.mark.parametrize("scalar", SCALARS)
def test_the_shared_files_are_the_same_whatever_a_filter_needs(scalar):
    first = shared_files(source("kf_functions", scalar, "one").files)
    assert set(first) == {f"fkgen_elementary_{scalar}.{end}" for end in "hc"}
    assert shared_files(source("mme", scalar, "two").files) == first


def test_without_the_option_every_filter_has_its_own_and_its_hash_is_what_it_was():
    spec = spread.specs()["mme"]
    assert not shared_files(generated(spec).files)
    assert "elementary" not in spec.canonical()


MAIN = """
#include "one.h"
#include "two.h"
int main(void)
{
    return ((one_selftest() == ONE_OK) && (two_selftest() == TWO_OK)) ? 0 : 1;
}
"""


@pytest.mark.parametrize("scalar", SCALARS)
def test_two_filters_with_one_copy_pass_their_self_tests_in_one_program(scalar, tmp_path):
    for name, prefix in (("kf_functions", "one"), ("mme", "two")):
        for file, text in source(name, scalar, prefix).files.items():
            if file.endswith((".c", ".h")) and not file.endswith("_main.c"):
                (tmp_path / file).write_text(text)
    (tmp_path / "main.c").write_text(MAIN)
    units = sorted(path.name for path in tmp_path.glob("*.c"))
    assert f"fkgen_elementary_{scalar}.c" in units
    call(*ANY, "-std=c99", "-O1", *FLAGS, *C_ONLY, BITS, *units, "-o", "both", cwd=tmp_path)
    assert call(tmp_path / "both", cwd=tmp_path, check=False).returncode == 0
    for compiler, command in CPP_COMPILERS.items():
        flags = ["-x", "c++", "-std=c++17", *FLAGS, BITS, check_only(compiler)]
        call(*command, *flags, *units, cwd=tmp_path)


@pytest.mark.parametrize("scalar", SCALARS)
@pytest.mark.parametrize("name", ["kf_functions", "mme"])
def test_a_shared_copy_gives_the_bits_of_its_own(name, scalar):
    spec = spread.specs(scalar)[name]
    rng = np.random.default_rng(5)
    y = rng.normal(size=(20, spec.model.ny))
    u = rng.normal(size=(20, spec.model.nu))
    own, shared = (
        fkgen.compile(source(name, scalar, "one", elementary)).run(y, u)
        for elementary in ("static", "shared")
    )
    for port in own.ports:
        np.testing.assert_array_equal(own[port], shared[port])


def test_a_folder_with_the_same_shared_files_may_be_written_to(tmp_path):
    one = source("mme", "double", "one")
    for file, text in shared_files(one.files).items():
        (tmp_path / file).write_text(text)
    one.write(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(one.files)


def test_a_folder_with_another_file_of_the_shared_name_is_left_alone(tmp_path):
    (tmp_path / "fkgen_elementary_double.c").write_text("/* mine */")
    with pytest.raises(OutputError, match="a file that fkgen did not write"):
        source("mme", "double", "one").write(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["fkgen_elementary_double.c"]


@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_filters_that_share_a_folder_and_a_copy_are_built_and_pass_together(tmp_path):
    for name, prefix in (("kf_functions", "one"), ("mme", "two")):
        source(name, "double", prefix).write(tmp_path / "src")
    call("cmake", "-S", "src", "-B", "build", cwd=tmp_path)
    call("cmake", "--build", "build", cwd=tmp_path)
    tested = call("ctest", "--test-dir", "build", cwd=tmp_path).stdout
    assert "0 tests failed out of 2" in tested


def test_a_newer_shared_copy_serves_the_filter_before(tmp_path):
    first, second = source("mme", "double", "one"), source("kf_functions", "double", "two")
    first.write(tmp_path)
    newer = {k: f"/* newer */ {v}" for k, v in shared_files(second.files).items()}
    replace(second, files={**second.files, **newer}).write(tmp_path)
    for each in (first, second):
        each.write(tmp_path)
    assert shared_files({p.name: p.read_text() for p in tmp_path.iterdir()}) == shared_files(
        first.files
    )
