"""Which C compiler is taken, and what is said when there is none or it refuses."""

from __future__ import annotations

import importlib.util
import shutil
import sys

import pytest
from plants import generated, motor
from toolchain import needs_compiler

import fkgen
from fkgen.errors import CompilerError, UserError
from fkgen.runtime import compiler
from fkgen.runtime.compiler import Compiler, compile_shared, find_compiler


@pytest.fixture
def path(tmp_path, monkeypatch):
    """An empty PATH of our own, without variables that name a compiler."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    for name in ("FKGEN_CC", "CC"):
        monkeypatch.delenv(name, raising=False)
    return folder


@pytest.fixture
def without_zig(monkeypatch):
    monkeypatch.setattr(compiler.importlib.util, "find_spec", lambda _: None)


def program(folder, name, text="exit 0"):
    found = folder / name
    found.write_text(f"#!/bin/sh\n{text}\n")
    found.chmod(0o755)
    return str(found)


def test_cc_comes_before_gcc_and_gcc_before_clang(path):
    for name in ("clang", "gcc", "cc"):
        expected = program(path, name)
        assert find_compiler().command == (expected,)


def test_the_variables_come_before_the_path_and_ours_before_the_usual_one(path, monkeypatch):
    program(path, "cc")
    usual, ours = program(path, "usual"), program(path, "ours")
    monkeypatch.setenv("CC", "usual")
    assert find_compiler().command == (usual,)
    monkeypatch.setenv("FKGEN_CC", "ours")
    assert find_compiler().command == (ours,)


def test_a_variable_may_hold_arguments(path, monkeypatch):
    wrapper = program(path, "ccache")
    monkeypatch.setenv("FKGEN_CC", "ccache gcc -m64")
    assert find_compiler().command == (wrapper, "gcc", "-m64")


def test_flags_of_the_variable_come_last_and_make_another_filter(
    path, source, tmp_path, monkeypatch
):
    log = tmp_path / "log"
    program(path, "cc", f'echo "$@" > {log}; exit 1')
    monkeypatch.setenv("FKGEN_CFLAGS", "")
    before = find_compiler().identity
    monkeypatch.setenv("FKGEN_CFLAGS", "-O0 -g")
    assert find_compiler().identity != before
    with pytest.raises(CompilerError):
        compile_shared(find_compiler(), source, tmp_path / "filter.so", statements=1)
    words = log.read_text().split()
    assert words.index("-O3") < words.index("-O0") < words.index("-g")


def test_an_empty_variable_says_nothing(path, monkeypatch):
    expected = program(path, "cc")
    monkeypatch.setenv("FKGEN_CC", " ")
    assert find_compiler().command == (expected,)


@pytest.mark.parametrize("variable", ["FKGEN_CC", "CC"])
def test_a_variable_that_names_nothing_is_an_error_not_a_hint(variable, path, monkeypatch):
    program(path, "cc")
    monkeypatch.setenv(variable, "no-such-compiler")
    with pytest.raises(CompilerError, match=f"{variable} is 'no-such-compiler'"):
        find_compiler()


@pytest.mark.usefixtures("path", "without_zig")
def test_no_compiler_at_all_is_an_error_that_says_what_to_install():
    with pytest.raises(CompilerError, match=r"no C compiler found: looked for .* apt install gcc"):
        find_compiler()
    assert issubclass(CompilerError, UserError)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("path")
@pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="no ziglang")
def test_ziglang_is_the_last_resort_and_works(monkeypatch, tmp_path):
    assert find_compiler().command == (sys.executable, "-m", "ziglang", "cc")
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path / "cache"))
    assert fkgen.build(motor("kf")).step([0.1], [1.0]).status == 0


def test_another_compiler_of_the_same_name_has_another_identity(path):
    program(path, "cc")
    first = find_compiler().identity
    assert find_compiler().identity == first
    program(path, "cc", "exit 0  # a newer one")
    assert find_compiler().identity != first


def test_an_alias_has_the_identity_of_what_it_stands_for(path):
    program(path, "gcc-12")
    (path / "cc").symlink_to(path / "gcc-12")
    assert find_compiler().identity.startswith(str(path / "gcc-12"))


@pytest.fixture
def source(tmp_path):
    found = tmp_path / "plant.c"
    found.write_text("int answer(void);\nint answer(void) { return 42; }\n")
    return found


def test_the_first_error_of_a_compiler_is_in_the_message(path, source, tmp_path):
    failing = program(
        path, "cc", "echo 'note: x' >&2; echo 'plant.c:1: error: no luck' >&2; exit 1"
    )
    with pytest.raises(CompilerError, match=r"refused plant.c: plant.c:1: error: no luck"):
        compile_shared(Compiler((failing,), ""), source, tmp_path / "filter.so", statements=1)


def test_a_compiler_that_fails_in_silence_is_an_error_with_its_status(path, source, tmp_path):
    failing = program(path, "cc", "exit 3")
    with pytest.raises(CompilerError, match="exit status 3"):
        compile_shared(Compiler((failing,), ""), source, tmp_path / "filter.so", statements=1)


def test_a_compiler_that_writes_nothing_is_an_error(path, source, tmp_path):
    lazy = program(path, "cc", "exit 0")
    with pytest.raises(CompilerError, match=r"refused plant.c"):
        compile_shared(Compiler((lazy,), ""), source, tmp_path / "filter.so", statements=1)


def test_a_compiler_that_cannot_be_run_is_an_error(path, source, tmp_path):
    broken = path / "cc"
    broken.write_bytes(b"\x00not a program")
    broken.chmod(0o755)
    with pytest.raises(CompilerError, match="cannot be run"):
        compile_shared(Compiler((str(broken),), ""), source, tmp_path / "filter.so", statements=1)


def test_a_compiler_that_does_not_come_back_is_an_error(path, source, tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "_WAIT", 0.2)
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    slow = program(path, "cc", "exec sleep 30")
    with pytest.raises(CompilerError, match=r"cannot be run: .*timed out"):
        compile_shared(Compiler((slow,), ""), source, tmp_path / "filter.so", statements=1)


@pytest.mark.parametrize(("statements", "level"), [(10, "-O3"), (compiler.LARGE + 1, "-O1")])
def test_flags_keep_the_bits_and_hide_what_is_not_exported(
    path, source, tmp_path, statements, level
):
    log = tmp_path / "log"
    noting = program(path, "cc", f'echo "$@" > {log}; exit 1')
    with pytest.raises(CompilerError):
        compile_shared(
            Compiler((noting, "-m64"), ""), source, tmp_path / "filter.so", statements=statements
        )
    words = log.read_text().split()
    assert words[0] == "-m64"
    assert {"-ffp-contract=off", "-fvisibility=hidden", "-std=c99", level} <= set(words)
    assert not any("fast" in word for word in words)


@needs_compiler()
def test_a_failing_compiler_leaves_no_entry_in_the_cache(path, tmp_path, monkeypatch):
    monkeypatch.setenv("FKGEN_CACHE", str(tmp_path / "cache"))
    program(path, "cc", "echo 'error: broken' >&2; exit 1")
    with pytest.raises(CompilerError, match="error: broken"):
        fkgen.compile(generated(motor("kf")))
    assert list((tmp_path / "cache").iterdir()) == []


@needs_compiler()
@pytest.mark.parametrize("name", [n for n in ("gcc", "clang") if shutil.which(n)])
def test_gcc_and_clang_give_the_same_bits(name, monkeypatch):
    plant = motor("mme")
    expected = fkgen.build(plant)
    monkeypatch.setenv("FKGEN_CC", name)
    other = fkgen.build(plant)
    for _ in range(20):
        assert other.step([0.1, 0.9], [1.0]) == expected.step([0.1, 0.9], [1.0])
