"""Filters for faulty sensors in C: the bits of the program as data, with every compiler."""

from __future__ import annotations

import numpy as np
import pytest
from plants import generated, interpreted, run
from sensor_specs import EVERY, every
from toolchain import (
    ANY,
    BITS,
    C_COMPILERS,
    C_ONLY,
    FLAGS,
    call,
    each,
    needs_compiler,
    run_main,
    thorough,
)

import fkgen
from fkgen.backend.execute import Machine

pytestmark = needs_compiler()

LINEAR = ("linear_optimal", "linear_absorbing", "linear_moments", "augmented")
SCALARS = ("double", "float")

#: Exponentials, logarithms and the root of the genie's delta are fkgen's own in C, and those of
#: libm in the interpreter.
OWN_LOG = 1e-14
OWN_EXP = 1e-12


#: One of each kind, for what is slow.
FEW = [
    ("imm_product", "double"),
    ("imm_zeros", "float"),
    ("linear_moments", "double"),
    ("one_step_paper", "float"),
    ("augmented", "double"),
    ("genie", "float"),
    ("imm_jump", "double"),
]


def trial(plant, T=9):
    """Any record with missing rows and a distant sample; the genie is told something."""
    rng = np.random.default_rng(5)
    y, u = rng.standard_normal((T, plant.model.ny)), rng.standard_normal((T, plant.model.nu))
    y[2, 1] = y[5, 0] = np.nan
    y[4] = np.nan
    y[6, 0] = 1e3
    told = {"gamma": rng.integers(0, 2, T).astype(float), "delta": rng.choice([1.0, 10.0], T)}
    return y, u, told if plant.filter.family == "genie" else {}


def bits(values):
    """Integers of the same bits: -0.0 is not 0.0."""
    array = np.atleast_1d(np.asarray(values))
    return array.view(np.uint64 if array.dtype == np.float64 else np.uint32)


def sample(params, k):
    return {name: value[k] for name, value in params.items()}


ALL = [(name, scalar, compiler) for name in EVERY for scalar in SCALARS for compiler in C_COMPILERS]
#: Every filter with one compiler, one of each kind with the others too.
QUICK = [case for case in ALL if C_COMPILERS[case[2]] == ANY or case[:2] in FEW[:3]]


@pytest.mark.parametrize(("name", "scalar", "compiler"), thorough(ALL, QUICK))
def test_compiled_c_is_the_program_as_data_bit_for_bit(name, scalar, compiler, monkeypatch):
    monkeypatch.setenv("FKGEN_CC", " ".join(C_COMPILERS[compiler]))
    plant = every(scalar)[name]
    y, u, params = trial(plant)
    machine, compiled = Machine(generated(plant).program), fkgen.build(plant)
    for port, values in machine.ports.items():
        np.testing.assert_array_equal(
            bits(compiled.state(port)), bits(np.array(values)), err_msg=f"{port} at the start"
        )
    for k in range(len(y)):
        status = machine.step(u[k], y[k], sample(params, k))
        snapshot = compiled.step(y[k], u[k] if u.shape[1] else None, sample(params, k))
        assert snapshot.status == status.value
        for port, values in machine.ports.items():
            np.testing.assert_array_equal(
                bits(compiled.state(port)), bits(np.array(values)), err_msg=f"{port}[{k}]"
            )


@pytest.mark.parametrize("name", LINEAR)
def test_linear_filters_in_double_are_the_recursion_bit_for_bit(name):
    plant = every()[name]
    y, u, params = trial(plant)
    compiled, expected = run(plant, y, u, params), interpreted(plant, y, u, params)
    assert set(compiled.ports) == set(expected)
    for port, value in expected.items():
        if port == "log_likelihood":
            np.testing.assert_allclose(compiled[port], value, rtol=OWN_LOG, atol=OWN_LOG)
        else:
            np.testing.assert_array_equal(
                bits(compiled[port] + 0.0), bits(value + 0.0), err_msg=port
            )


@pytest.mark.parametrize("name", [name for name in EVERY if name not in LINEAR])
def test_other_filters_are_the_recursion_up_to_their_own_functions(name):
    plant = every()[name]
    y, u, params = trial(plant)
    compiled, expected = run(plant, y, u, params), interpreted(plant, y, u, params)
    assert set(compiled.ports) == set(expected)
    for port, value in expected.items():
        if port.endswith("log_weight"):
            held = value > -1e200  # the others stand for the logarithm of zero
            np.testing.assert_array_equal(compiled[port] > -1e200, held)
            np.testing.assert_allclose(
                compiled[port][held], value[held], rtol=OWN_EXP, atol=OWN_EXP
            )
            continue
        scale = np.nanmax(np.abs(value), initial=1e-300)
        np.testing.assert_allclose(
            compiled[port], value, rtol=0.0, atol=OWN_EXP * scale, err_msg=port
        )


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), thorough(FEW, FEW[::3]))
def test_the_files_compile_silently_and_their_self_test_passes(name, scalar, compiler, tmp_path):
    generated(every(scalar)[name]).write(tmp_path / "out")
    units = sorted(path.name for path in (tmp_path / "out").glob("*.c"))
    command = [*C_COMPILERS[compiler], "-std=c99", "-O2", *FLAGS, *C_ONLY, BITS]
    call(*command, *units, "-o", "selftest", cwd=tmp_path / "out")
    done = call(tmp_path / "out" / "selftest", cwd=tmp_path / "out", check=False)
    assert done.returncode == 0


SPLIT = """
#include "plant.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
int main(void)
{{
    plant_t a, b;
    {parameters}
    int k;
    plant_init(&a); plant_init(&b);
    for (k = 0; k < 20; ++k)
    {{
        {real} u[1], y[2];
        u[0] = ({real})(1.0 + 0.1 * k);
        y[0] = (k % 5 == 2) ? ({real})NAN : ({real})(0.3 + 0.01 * k);
        y[1] = (k % 7 == 2) ? ({real})NAN : ({real})(0.1 * k - 1.0);
        {told}
        if (plant_step(&a, {p} {u} y, 3u) != plant_update(&b, {p} {u} y, 3u)) printf("status\\n");
        if (plant_predict(&b{q}{w}) != PLANT_OK) printf("predict\\n");
        if (memcmp(&a, &b, sizeof a) != 0) printf("bits %d\\n", k);
        (void)u;
    }}
    return 0;
}}
"""


SPLITS = ("one_step", "imm", "imm3", "imm_jump", "linear_absorbing", "augmented", "genie")


@pytest.mark.parametrize(
    ("name", "scalar"),
    thorough(
        [(name, scalar) for name in SPLITS for scalar in SCALARS],
        [(name, SCALARS[at % 2]) for at, name in enumerate(SPLITS)],
    ),
)
def test_update_then_predict_is_step_to_the_bit(name, scalar, tmp_path):
    plant = every(scalar)[name]
    generated(plant).write(tmp_path / "out")
    genie, driven = name == "genie", bool(plant.model.nu)
    text = SPLIT.format(
        real=scalar,
        parameters="plant_params_t params; plant_params_init(&params);" if genie else "",
        told="params.gamma = (k % 3) ? 1 : 0; params.delta = (k % 4) ? 1 : 10;" if genie else "",
        p="&params," if genie else "",
        q=", &params" if genie else "",
        u="u," if driven else "",
        w=", u" if driven else "",
    )
    assert run_main(tmp_path / "out", text, "plant.c", "plant_selftest.c", flags=["-lm"]) == []
