"""Compiled C gives the bits of the recursion in double, and those of the IR in both types."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import spread
from plants import built, generated, interpreted, run

import fkgen
from fkgen.backend.execute import Machine

ROOT = Path(__file__).resolve().parents[2]

#: Exponentials and logarithms are fkgen's own in C and those of libm in the interpreter: they
#: differ in the last bits, which weights and all that is combined by them inherit.
OWN_LOG = 1e-14
OWN_EXP = 1e-12


def bits(values):
    """Integers of the same bits: -0.0 is not 0.0."""
    array = np.atleast_1d(np.asarray(values))
    return array.view(np.uint64 if array.dtype == np.float64 else np.uint32)


@pytest.mark.parametrize("name", [n for n in spread.NAMES if n[:3] != "mme"])
def test_double_c_equals_the_interpreter_bit_for_bit(name):
    plant = spread.specs()[name]
    y, u, params = spread.trial(plant)
    compiled, expected = run(plant, y, u, params), interpreted(plant, y, u, params)
    assert set(compiled.ports) == set(expected)
    for port, value in expected.items():
        if name == "kf_functions":
            # exp, sin and so on of a parameter are fkgen's own too.
            np.testing.assert_allclose(compiled[port], value, rtol=OWN_EXP, atol=OWN_EXP)
        elif port == "log_likelihood":
            np.testing.assert_allclose(compiled[port], value, rtol=OWN_LOG, atol=OWN_LOG)
        else:
            np.testing.assert_array_equal(bits(compiled[port] + 0.0), bits(value + 0.0))


@pytest.mark.parametrize("name", [n for n in spread.NAMES if n[:3] == "mme"])
def test_a_double_bank_equals_the_interpreter_up_to_its_own_exponential(name):
    plant = spread.specs()[name]
    y, u, params = spread.trial(plant)
    compiled, expected = run(plant, y, u, params), interpreted(plant, y, u, params)
    assert set(compiled.ports) == set(expected)
    for port, value in expected.items():
        if port == "log_weight":
            held = value > -1e200  # what stands for the logarithm of zero drifts by likelihoods
            np.testing.assert_array_equal(compiled[port] > -1e200, held)
            np.testing.assert_allclose(compiled[port][held], value[held], rtol=OWN_EXP)
            continue
        scale = np.nanmax(np.abs(value), initial=1e-300)
        np.testing.assert_allclose(compiled[port], value, rtol=0.0, atol=OWN_EXP * scale)


@pytest.mark.parametrize("scalar", ["double", "float"])
@pytest.mark.parametrize("name", spread.NAMES)
def test_compiled_c_equals_the_program_as_data_bit_for_bit(name, scalar):
    plant = spread.specs(scalar)[name]
    y, u, params = spread.trial(plant)
    machine = Machine(generated(plant).program)
    compiled = built(plant)
    compiled.reset()
    for k in range(len(y)):
        now = {key: value[k] for key, value in params.items()}
        status = machine.step(u[k], y[k], now)
        snapshot = compiled.step(y[k], u[k] if u.shape[1] else None, now)
        assert snapshot.status == status.value
        for port, values in machine.ports.items():
            np.testing.assert_array_equal(
                bits(compiled.state(port)), bits(np.array(values)), err_msg=f"{port}[{k}]"
            )


#: Sums over ports, sets of functions, several words, hypotheses: where an order could slip in.
DELICATE = ("kf_functions", "kf_wide", "mkf_correlated", "mme_independent")

GENERATE = f"""
import hashlib, spread, fkgen
for name in {DELICATE}:
    files = fkgen.generate(fkgen.validate(spread.specs()[name])).files
    print(name, hashlib.sha256(repr(list(files.items())).encode()).hexdigest())
"""


def test_another_process_with_another_hash_seed_generates_the_same_bytes():
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "models")])
    environment = os.environ | {"PYTHONPATH": path, "PYTHONHASHSEED": "4711", "TZ": "Asia/Tokyo"}
    done = subprocess.run(
        [sys.executable, "-c", GENERATE],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    here = {
        name: hashlib.sha256(repr(list(files.items())).encode()).hexdigest()
        for name in DELICATE
        if (files := generated(spread.specs()[name]).files)
    }
    assert dict(line.split() for line in done.stdout.splitlines()) == here


def test_equal_specs_from_differently_ordered_tables_generate_the_same_bytes():
    given = spread.specs()["mkf_rate"].to_dict()
    turned = {key: given[key] for key in reversed(given)}
    turned["model"] = {key: given["model"][key] for key in reversed(given["model"])}
    other = fkgen.Spec.from_dict(turned)
    files = generated(spread.specs()["mkf_rate"]).files
    assert fkgen.generate(fkgen.validate(other)).files == files
