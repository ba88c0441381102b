"""Generated C compiles silently under every flag of the contract, and its self-test passes."""

from __future__ import annotations

import shutil
import subprocess

import pytest
import spread
from models import generated
from toolchain import (
    ANY,
    BITS,
    C_COMPILERS,
    C_ONLY,
    CPP_COMPILERS,
    FLAGS,
    call,
    needs_compiler,
)

pytestmark = needs_compiler()

CASES = [(name, scalar) for name in spread.NAMES for scalar in ("double", "float")]

#: One of each kind, for what is slow: sanitizers, optimisers.
FEW = ("kf_functions", "kf_wide", "kf_exact", "mkf_independent", "mme", "mme_certain")


@pytest.fixture
def written(name, scalar, tmp_path):
    generated(spread.specs(scalar)[name]).write(tmp_path / "out")
    return tmp_path / "out"


def units(folder):
    return sorted(path.name for path in folder.glob("*.c"))


@pytest.mark.parametrize("compiler", list(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), CASES)
def test_c99_and_c11_compile_without_a_warning(compiler, name, scalar, written):
    for source in units(written):
        for standard in ("-std=c99", "-std=c11"):
            command = [*C_COMPILERS[compiler], standard, *FLAGS, *C_ONLY, BITS]
            call(*command, "-fsyntax-only", source, cwd=written)


@pytest.mark.parametrize("compiler", list(CPP_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), CASES)
def test_cpp17_compiles_without_a_warning(compiler, name, scalar, written):
    command = [*CPP_COMPILERS[compiler], "-x", "c++", "-std=c++17", *FLAGS, BITS]
    for source in units(written):
        call(*command, "-fsyntax-only", source, cwd=written)


@pytest.mark.parametrize("compiler", list(C_COMPILERS))
@pytest.mark.parametrize("optimisation", ["-O0", "-O2", "-O3"])
@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", FEW)
def test_the_self_test_passes_when_optimised(name, scalar, optimisation, compiler, written):
    # Warnings that need data flow, such as -Wmaybe-uninitialized, come with -O2.
    command = [*C_COMPILERS[compiler], "-std=c99", optimisation, *FLAGS, *C_ONLY, BITS]
    call(*command, *units(written), "-o", "selftest", cwd=written)
    assert call(written / "selftest", cwd=written, check=False).returncode == 0


@pytest.mark.parametrize("compiler", list(C_COMPILERS))
@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", FEW)
def test_the_self_test_passes_under_the_sanitizers(name, scalar, compiler, written):
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]
    command = [*C_COMPILERS[compiler], "-std=c99", *checks, BITS]
    call(*command, *units(written), "-o", "selftest", cwd=written)
    done = call(written / "selftest", cwd=written, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("compiler", list(CPP_COMPILERS))
@pytest.mark.parametrize("name", FEW)
@pytest.mark.parametrize("scalar", ["double"])
def test_the_self_test_passes_inside_cpp(name, compiler, scalar, written):
    command = [*CPP_COMPILERS[compiler], "-x", "c++", "-std=c++17", "-O2", BITS]
    call(*command, *units(written), "-o", "selftest", cwd=written)
    assert call(written / "selftest", cwd=written, check=False).returncode == 0


@pytest.mark.parametrize("scalar", ["double"])
@pytest.mark.parametrize("name", ["mkf_sensed"])
def test_the_self_test_fails_when_a_constant_is_another(name, scalar, written):
    text = (written / "plant.c").read_text()
    assert text.count("0.9802") >= 1
    (written / "plant.c").write_text(text.replace("0.9802", "0.9802000000000001"))
    call(*ANY, "-std=c99", BITS, *units(written), "-o", "selftest", cwd=written)
    assert call(written / "selftest", cwd=written, check=False).returncode == 1


@pytest.mark.parametrize("scalar", ["double"])
@pytest.mark.parametrize("name", ["mkf_sensed"])
def test_fast_math_is_refused_at_compile_time(name, scalar, written):
    done = call(*ANY, "-c", "-ffast-math", "-O2", "plant.c", cwd=written, check=False)
    assert done.returncode != 0
    assert "-ffast-math removes" in done.stderr


def symbols(folder):
    """Names by kind (T text, U undefined, D data, B bss), of the object and of its sections."""
    listed = subprocess.run(
        ["nm", "plant.o"], cwd=folder, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    return [line.split()[-2:] for line in listed]


@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
@pytest.mark.parametrize("compiler", list(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), CASES)
def test_the_object_exports_its_prefix_needs_nothing_and_keeps_nothing(
    compiler, name, scalar, written
):
    command = [*C_COMPILERS[compiler], "-std=c99", "-O2", BITS, "-c", "plant.c"]
    if name == "kf_wide":
        command.append("-fno-tree-vectorize")
    call(*command, cwd=written)
    found = symbols(written)
    exported = {symbol for kind, symbol in found if kind == "T"}
    expected = {f"plant_{verb}" for verb in ("init", "update", "predict", "step")}
    if spread.specs()[name].parameters:
        expected.add("plant_params_init")
    assert exported == expected
    undefined = {symbol for kind, symbol in found if kind == "U"}
    # A compiler may copy and clear structures by calls of these, even in freestanding code.
    assert undefined <= {"memcpy", "memset", "memmove"}
    assert not {kind for kind, _ in found} & set("DdBbCGgSs")
