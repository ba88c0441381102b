"""The partial compression filter in C: the bits of the program as data, refusals, precision."""

from __future__ import annotations

import numpy as np
import pytest
from partial_plants import PAPER, cpcf, dense, record, sparse_positions
from plants import distance, generated, interpreted, run
from toolchain import C_COMPILERS, each, needs_compiler, run_main

import fkgen
from fkgen.backend.execute import Machine
from fkgen.errors import StepRefused

pytestmark = needs_compiler()

#: Logarithms are fkgen's own in C and those of libm in the interpreter.
OWN_LOG = 1e-14


def wide(scalar="double", **options):
    """Two waiting rows, parameters, inputs, windows that are accepted and rejected, inflation."""
    model, parameters, host = dense(31, 3, 2, 1, direct=True, varying=True)
    given = {"false_alarm": 0.5, "reacquire": 2, **options}
    return cpcf(model, host=host, window=3, parameters=parameters, code={"scalar": scalar}, **given)


def small(scalar="double", **options):
    return cpcf(PAPER, window=3, code={"scalar": scalar}, **options)


def bits(values):
    """Integers of the same bits: -0.0 is not 0.0."""
    array = np.atleast_1d(np.asarray(values))
    return array.view(np.uint64 if array.dtype == np.float64 else np.uint32)


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_compiled_c_is_the_program_as_data_bit_for_bit(scalar, compiler, monkeypatch):
    monkeypatch.setenv("FKGEN_CC", " ".join(C_COMPILERS[compiler]))
    filtering = wide(scalar)
    y, u, params = record(filtering, 25)
    machine, compiled = Machine(generated(filtering).program), fkgen.build(filtering)
    for k in range(len(y)):
        now = {key: value[k] for key, value in params.items()}
        status = machine.step(u[k], y[k], now)
        assert compiled.step(y[k], u[k] if u.shape[1] else None, now).status == status.value
        for port, values in machine.ports.items():
            np.testing.assert_array_equal(
                bits(compiled.state(port)), bits(np.array(values)), err_msg=f"{port}[{k}]"
            )


@pytest.mark.parametrize("maintenance", ["optimal", "paper"])
def test_in_double_it_is_the_recursion_bit_for_bit(maintenance):
    filtering = wide(maintenance=maintenance)
    y, u, params = record(filtering, 25)
    compiled, expected = run(filtering, y, u, params), interpreted(filtering, y, u, params)
    assert set(compiled.ports) == set(expected)
    assert expected["test_dof"].any()
    for port, value in expected.items():
        if port == "log_likelihood":
            np.testing.assert_allclose(compiled[port], value, rtol=OWN_LOG, atol=OWN_LOG)
        else:
            np.testing.assert_array_equal(
                bits(compiled[port] + 0.0), bits(value + 0.0), err_msg=port
            )


def test_the_trial_has_windows_of_both_kinds():
    filtering = wide()
    found = run(filtering, *record(filtering, 25))
    assert 0.0 < found.fault_declared.sum() < (found.test_dof > 0.0).sum()


SPLIT = """
#include "plant.h"
#include <math.h>
#include <stdio.h>
#include <string.h>
int main(void)
{
    plant_t a, b;
    int k;
    plant_init(&a); plant_init(&b);
    for (k = 0; k < 20; ++k)
    {
        double y[2];
        y[0] = (k % 5 == 2) ? (double)NAN : 0.3 + 0.01 * k;
        y[1] = (k % 7 == 2) ? (double)NAN : 0.1 * k - 1.0;
        if (plant_step(&a, y, 3u) != plant_update(&b, y, 3u)) printf("status\\n");
        if (plant_update(&b, y, 3u) != PLANT_WRONG_ORDER) printf("again\\n");
        if (plant_predict(&b) != PLANT_OK) printf("predict\\n");
        if (memcmp(&a, &b, sizeof a) != 0) printf("bits %d\\n", k);
    }
    return 0;
}
"""


def test_update_then_predict_is_step_to_the_bit_and_a_repeated_update_is_refused(tmp_path):
    generated(small()).write(tmp_path / "out")
    assert run_main(tmp_path / "out", SPLIT, "plant.c", "plant_selftest.c", flags=["-lm"]) == []


@pytest.mark.parametrize("k", [4, 6], ids=["within a window", "at its end"])
def test_a_refused_sample_changes_nothing(k):
    compiled = fkgen.build(small())
    y = np.ones(2)
    for _ in range(k):
        compiled.step(y)
    before = {port: compiled.state(port).copy() for port in compiled.ports}
    with pytest.raises(StepRefused):
        compiled.step(np.array([np.inf, 1.0]))
    compiled.state("predicted_covariance")[0] = np.nan
    with pytest.raises(StepRefused):
        compiled.step(y)
    compiled.state("predicted_covariance")[0] = before["predicted_covariance"][0]
    for port, values in before.items():
        np.testing.assert_array_equal(compiled.state(port), values)


def test_a_phi_of_zero_cannot_begin_and_says_nothing_later():
    """Windows end at samples 3 and 6: sample 4 would begin, sample 5 adds nothing."""
    filtering = wide()
    y, u, params = record(filtering, 8, missing=0.0)
    without = y.copy()
    without[5, list(filtering.faults.soft.compressed)] = np.nan
    for k, refused in ((4, True), (5, False)):
        scale = params["scale"].copy()
        scale[k] = 0.0
        found = run(filtering, y, u, {**params, "scale": scale})
        assert found.refused.tolist() == [refused and j == k for j in range(8)]
        if refused:
            np.testing.assert_array_equal(found.filtered_state[4], found.predicted_state[3])
            continue
        silent = run(filtering, without, u, {**params, "scale": scale})
        for port in ("filtered_state", "compressed_measurement", "compressed_noise"):
            np.testing.assert_allclose(found[port][5], silent[port][5], rtol=1e-12)


def test_in_float_the_simulation_comes_out_to_five_digits():
    y = sparse_positions(1501)
    y[::5, 0] = 3.0 * np.sin(np.arange(301))
    found, exact = (run(cpcf(PAPER, code={"scalar": s}), y) for s in ("float", "double"))
    for port in ("filtered_covariance", "compressed_noise", "test_statistic", "filtered_state"):
        assert distance(found[port], exact[port]) < 2e-4
    np.testing.assert_array_equal(found.test_dof, exact.test_dof)


def test_a_vague_start_is_no_trouble_in_float():
    model = {**PAPER, "P0": [[1e8, 0.0], [0.0, 1.0]]}
    y = sparse_positions(301)
    found, exact = (run(cpcf(model, code={"scalar": s}), y) for s in ("float", "double"))
    assert not found.refused.any()
    P = found.filtered_covariance[300].astype(float)
    np.testing.assert_allclose(P, exact.filtered_covariance[300], rtol=0.02)
    assert np.linalg.eigvalsh(P)[0] > 0.0
