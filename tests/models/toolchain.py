"""C compilers that this machine has, and programs made of generated source with them."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys

import pytest

#: The flags of the contract, under which generated C compiles without a warning.
FLAGS = (
    "-Wall",
    "-Wextra",
    "-pedantic",
    "-Wconversion",
    "-Wshadow",
    "-Wdouble-promotion",
    "-Wcast-qual",
    "-Wundef",
    "-Wfloat-equal",
    "-Werror",
)
C_ONLY = ("-Wmissing-prototypes",)
BITS = "-ffp-contract=off"


def c_compilers():
    """Commands by name: gcc and clang where they are, that of ziglang for a missing clang."""
    found = {name: [path] for name in ("gcc", "clang") if (path := shutil.which(name))}
    if "clang" not in found and importlib.util.find_spec("ziglang"):
        found["zig"] = [sys.executable, "-m", "ziglang", "cc"]
    return found


def cpp_compilers():
    found = {name: [path] for name in ("g++", "clang++") if (path := shutil.which(name))}
    if "clang++" not in found and importlib.util.find_spec("ziglang"):
        found["zig"] = [sys.executable, "-m", "ziglang", "c++"]
    return found


C_COMPILERS = c_compilers()
CPP_COMPILERS = cpp_compilers()

#: What a test asks for when any compiler will do.
ANY = next(iter(C_COMPILERS.values()), None)


exhaustive = pytest.mark.exhaustive


def each(compilers):
    """Names of compilers to parametrise by; that of ziglang beside another is for test-all."""
    return [
        pytest.param(name, marks=exhaustive) if name == "zig" and len(compilers) > 1 else name
        for name in compilers
    ]


def thorough(cases, few):
    """Cases to parametrise by; all but a few are for test-all."""
    others = [case if isinstance(case, tuple) else (case,) for case in cases if case not in few]
    return [*few, *(pytest.param(*case, marks=exhaustive) for case in others)]


def check_only(compiler):
    """The flag that compiles without linking, and without an object where the compiler can."""
    return "-c" if compiler == "zig" else "-fsyntax-only"


def needs_compiler():
    return pytest.mark.skipif(ANY is None, reason="no gcc, clang or ziglang")


def call(*command, cwd, check=True):
    """Run a command; its output is in the message if it fails."""
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, capture_output=True, text=True, check=False
    )
    if check and done.returncode != 0:
        pytest.fail(f"{' '.join(map(str, command))}: status {done.returncode}\n{done.stderr}")
    return done


def run_main(folder, text, *sources, flags=()):
    """Compile a main function with generated sources and run it; what it printed, as lines."""
    (folder / "driver.c").write_text(text)
    program = folder / "driver"
    call(*ANY, "-std=c99", "-O1", BITS, *flags, "driver.c", *sources, "-o", program, cwd=folder)
    return call(program, cwd=folder).stdout.splitlines()
