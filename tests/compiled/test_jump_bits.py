"""Filters of jumping plants in C: the bits of the program as data, warnings, statuses, cost."""

from __future__ import annotations

import numpy as np
import pytest
from jump_plants import EXAMPLE_A, EXAMPLE_B, GILBERT, changed, random_table, record_of, spec_of
from plants import generated, interpreted, run
from toolchain import BITS, C_COMPILERS, C_ONLY, FLAGS, call, each, needs_compiler

import fkgen
from fkgen.backend.execute import Machine
from fkgen.backend.ir import Operate
from fkgen.errors import StepRefused
from fkgen.families import family

TWO_ROWS = random_table(71, 2, 2, 2, q=1, offsets=True, correlated=True)
RESTART = {"lock_out": 2, "reinitialise": True}
EXACT_ROW = [{"R": [[1.0, 0.0], [0.0, 0.0]]}] * 2
PARAMETERS = [{"A": [["0.9*a", 0.1], [0.0, "sqrt(a)"]]}, {"R": [["exp(a)", 0.0], [0.0, 1.0]]}]
PLANTS = {
    "plain": (TWO_ROWS, {}),
    "chain": (TWO_ROWS, {"arrival_chain": GILBERT}),
    "exact row": (TWO_ROWS, {"modes": EXACT_ROW, "arrival_rate": 0.8}),
    "parameters": (TWO_ROWS, {"modes": PARAMETERS, "parameters": {"a": 0.9}}),
    "llr": (TWO_ROWS, {"arrival_rate": 0.6, "detector": "llr"}),
    "nis": (TWO_ROWS, {"arrival_rate": 0.6, "detector": "nis", "alpha": 0.4, **RESTART}),
    "energy": (TWO_ROWS, {"arrival_rate": 0.6, "detector": "energy", "window": 3, **RESTART}),
    "stationary": (EXAMPLE_B, {"arrival_rate": 0.6, "detector": "llr", "gain": "stationary"}),
}
BOTH = [*((name, "double") for name in PLANTS), ("nis", "float"), ("llr", "float")]

#: fkgen's own logarithm, root and exponential against those of libm.
OWN = 1e-12

pytestmark = needs_compiler()


def plant_of(name, scalar="double"):
    table, options = PLANTS[name]
    return fkgen.Spec.from_dict(changed(table, **options) | {"code": {"scalar": scalar}})


def bits(values):
    array = np.atleast_1d(np.asarray(values))
    return array.view(np.uint64 if array.dtype == np.float64 else np.uint32)


def trial(plant):
    y, u = record_of(plant, 12, missing=0.2)
    y[4] = np.nan
    y[7] = 30.0
    return y, u


@pytest.mark.parametrize(("name", "scalar"), BOTH)
def test_compiled_c_is_the_program_as_data_bit_for_bit(name, scalar):
    plant = plant_of(name, scalar)
    y, u = trial(plant)
    machine, compiled = Machine(generated(plant).program), fkgen.build(plant)
    for k in range(len(y)):
        status = machine.step(u[k], y[k], plant.defaults)
        snapshot = compiled.step(y[k], u[k] if u.shape[1] else None)
        assert snapshot.status == status.value
        for port, values in machine.ports.items():
            np.testing.assert_array_equal(
                bits(compiled.state(port)), bits(np.array(values)), err_msg=f"{port}[{k}]"
            )


@pytest.mark.parametrize("name", PLANTS)
def test_compiled_code_is_the_recursion(name):
    plant = plant_of(name)
    y, u = trial(plant)
    compiled, expected = run(plant, y, u), interpreted(plant, y, u)
    assert set(compiled.ports) == set(expected)
    for port, value in expected.items():
        scale = np.nanmax(np.abs(value), initial=1e-300)
        np.testing.assert_allclose(compiled[port], value, rtol=0, atol=OWN * scale, err_msg=port)


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize(("name", "scalar"), [("nis", "float"), ("energy", "double")])
def test_the_files_compile_silently_and_their_self_test_passes(name, scalar, compiler, tmp_path):
    generated(plant_of(name, scalar)).write(tmp_path / "out")
    units = sorted(path.name for path in (tmp_path / "out").glob("*.c"))
    command = [*C_COMPILERS[compiler], "-std=c99", "-O2", *FLAGS, *C_ONLY, BITS]
    call(*command, *units, "-o", "selftest", cwd=tmp_path / "out")
    call("./selftest", cwd=tmp_path / "out")


def test_statuses_that_a_filter_cannot_return_are_not_in_its_header():
    without, tested = generated(plant_of("plain")), generated(plant_of("llr"))
    assert "FAULT_DECLARED" not in without.files["plant.h"]
    assert "LOCKED_OUT" not in without.files["plant.c"]
    assert "PLANT_LOCKED_OUT = 3" in tested.files["plant.h"]


def test_a_refused_sample_changes_nothing_and_is_no_rejection():
    plant = plant_of("llr")
    y, u = trial(plant)
    filtering = fkgen.build(plant)
    filtering.step(y[0], u[0])
    before = filtering.snapshot()
    with pytest.raises(StepRefused, match="INPUT_NOT_FINITE"):
        filtering.step([np.inf, 0.0], u[0])
    after = filtering.snapshot()
    for port in ports(plant):
        np.testing.assert_array_equal(before[port.name], after[port.name])


def ports(plant):
    return family("mjls_lmmse").build(plant).ports


def test_a_step_costs_no_more_than_it_should():
    """Three modes of three states, one row; F z counts the zeros of A, as everything does."""
    assert generated(spec_of(EXAMPLE_A)).program.flops <= 1286
    assert generated(spec_of(EXAMPLE_A, arrival_rate=0.85)).program.flops <= 1301
    dense = random_table(72, 3, 3, 1)
    assert generated(fkgen.Spec.from_dict(dense)).program.flops <= 2800


def test_a_step_with_a_stationary_gain_costs_little_beside_the_product_with_F():
    law = np.linalg.matrix_power(np.array(EXAMPLE_A["faults"]["jump"]["transition"]), 4000)[0]
    at_rest = spec_of(EXAMPLE_A, gain="stationary", initial=law.tolist())  # no law to move on
    product = sum(type(node) is Operate for node in generated(at_rest).program.predict.body)
    program = generated(spec_of(EXAMPLE_A, gain="stationary")).program
    assert program.flops - product <= 60
