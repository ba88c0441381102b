"""Generated C compiles silently under every flag of the contract, and its self-test passes."""

from __future__ import annotations

import shutil

import pytest
import spread
from plants import generated
from toolchain import (
    ANY,
    BITS,
    C_COMPILERS,
    C_ONLY,
    CPP_COMPILERS,
    FLAGS,
    call,
    check_only,
    each,
    needs_compiler,
    thorough,
)

pytestmark = needs_compiler()

CASES = [(name, scalar) for name in spread.NAMES for scalar in ("double", "float")]

#: One of each kind, for what is slow: sanitizers, optimisers.
FEW = [
    (name, scalar)
    for name in ("kf_functions", "kf_exact", "mkf_independent", "mme_certain")
    for scalar in ("double", "float")
]
WIDE = ("kf_wide", "double")


@pytest.fixture
def written(name, scalar, tmp_path):
    generated(spread.specs(scalar)[name]).write(tmp_path / "out")
    return tmp_path / "out"


def units(folder):
    return sorted(path.name for path in folder.glob("*.c"))


def checked(command, standard, compiler, written):
    call(*command, standard, *FLAGS, BITS, check_only(compiler), *units(written), cwd=written)


#: In float by turns: the text differs in suffixes and names of functions only.
QUICK = [case for at, case in enumerate(CASES) if case[1] == "double" or at % 4 == 1]


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), thorough(CASES, QUICK))
def test_c99_compiles_without_a_warning(compiler, name, scalar, written):
    checked([*C_COMPILERS[compiler], *C_ONLY], "-std=c99", compiler, written)


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), thorough(CASES, FEW[::2]))
def test_c11_compiles_without_a_warning(compiler, name, scalar, written):
    checked([*C_COMPILERS[compiler], *C_ONLY], "-std=c11", compiler, written)


@pytest.mark.parametrize("compiler", each(CPP_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), thorough(CASES, FEW[1::2]))
def test_cpp17_compiles_without_a_warning(compiler, name, scalar, written):
    checked([*CPP_COMPILERS[compiler], "-x", "c++"], "-std=c++17", compiler, written)


LEVELS = [*((*case, level) for case in FEW for level in ("-O0", "-O2", "-O3")), (*WIDE, "-O1")]


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize(
    ("name", "scalar", "optimisation"), thorough(LEVELS, [(*case, "-O2") for case in FEW[::3]])
)
def test_the_self_test_passes_when_optimised(name, scalar, optimisation, compiler, written):
    # Warnings that need data flow, such as -Wmaybe-uninitialized, come with -O2.
    command = [*C_COMPILERS[compiler], "-std=c99", optimisation, *FLAGS, *C_ONLY, BITS]
    call(*command, *units(written), "-o", "selftest", cwd=written)
    assert call(written / "selftest", cwd=written, check=False).returncode == 0


SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")


@pytest.fixture(params=each(C_COMPILERS))
def sanitizing(request, tmp_path):
    """A compiler that has the run-time library of its sanitizers."""
    (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
    command = [*C_COMPILERS[request.param], *SANITIZE]
    if call(*command, "empty.c", "-o", "empty", cwd=tmp_path, check=False).returncode != 0:
        pytest.skip(f"{request.param} has no sanitizers here")
    return command


@pytest.mark.parametrize(("name", "scalar"), thorough([*FEW, WIDE], FEW[2::3]))
def test_the_self_test_passes_under_the_sanitizers(name, scalar, sanitizing, written):
    call(*sanitizing, "-std=c99", BITS, *units(written), "-o", "selftest", cwd=written)
    done = call(written / "selftest", cwd=written, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("compiler", each(CPP_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), thorough(FEW[::2], FEW[:1]))
def test_the_self_test_passes_inside_cpp(name, compiler, scalar, written):
    command = [*CPP_COMPILERS[compiler], "-x", "c++", "-std=c++17", "-O1", BITS]
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


#: <float.h> of a target whose double is its float, as on AVR, and of one whose float is neither.
SHORT = "#include_next <float.h>\n#undef {0}_MANT_DIG\n#define {0}_MANT_DIG {1}\n"


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", ["mkf_sensed"])
@pytest.mark.parametrize("unit", ["plant.c", "plant_selftest.c"])
def test_arithmetic_without_nan_or_with_other_bits_is_refused_at_compile_time(
    name, scalar, unit, written
):
    def refusal(*flags):
        done = call(*ANY, "-c", "-O2", BITS, *flags, unit, cwd=written, check=False)
        return "" if done.returncode == 0 else done.stderr

    assert refusal() == ""
    assert "-ffast-math removes" in refusal("-ffast-math")
    assert "-ffinite-math-only removes" in refusal("-ffinite-math-only")
    for kind, digits, refused in (("DBL", 24, "double"), ("FLT", 53, "float")):
        (written / "float.h").write_text(SHORT.format(kind, digits))
        found = refusal("-I.")
        assert (f"{refused} has no" in found) == (scalar == refused) == bool(found)


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", ["mkf_sensed", "kf_wide"])
@pytest.mark.parametrize(
    ("sound", "broken"),
    [
        ("if (plant_finite(plant_defect(y[i])))", "if (y[i] <= 1.0 || !(y[i] <= 1.0))"),
        ("> {zero}) || (y[i] < {zero})", "> {zero}) && (y[i] < {zero})"),
    ],
    ids=["NaN is a number", "infinity is missing"],
)
def test_the_self_test_fails_where_a_row_that_is_no_number_is_used(
    name, scalar, sound, broken, written
):
    zero = "0.0" if scalar == "double" else "0.0f"
    text = (written / "plant.c").read_text()
    assert text.count(sound.format(zero=zero)) == 1
    (written / "plant.c").write_text(text.replace(*(s.format(zero=zero) for s in (sound, broken))))
    call(*ANY, "-std=c99", BITS, *units(written), "-o", "selftest", cwd=written)
    assert call(written / "selftest", cwd=written, check=False).returncode == 1


@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), thorough([*FEW, ("kf_no_input", "double")], FEW[::3]))
def test_the_object_exports_its_prefix_needs_nothing_and_keeps_nothing(
    compiler, name, scalar, written
):
    command = [*C_COMPILERS[compiler], "-std=c99", "-O2", BITS, "-c", "plant.c"]
    call(*command, cwd=written)
    listed = call("nm", "plant.o", cwd=written).stdout.splitlines()
    found = [line.split()[-2:] for line in listed]
    verbs = ["init", "start", "update", "predict", "step", "check"]
    verbs += ["params_init"] if spread.specs()[name].parameters else []
    assert {symbol for kind, symbol in found if kind.isupper() and kind != "U"} == {
        f"plant_{verb}" for verb in verbs
    }
    # A compiler may copy and clear structures by calls of these, even in freestanding code.
    assert {symbol for kind, symbol in found if kind == "U"} <= {"memcpy", "memset", "memmove"}
    # Neither data that change nor room for them.
    assert not {kind for kind, _ in found} & set("DdBbCGgSs")
