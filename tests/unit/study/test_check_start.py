"""What `check` says of the start in float: held against compiled filters and exact arithmetic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sensor_specs
import spread
from plants import built, generated
from toolchain import needs_compiler

import fkgen
from fkgen.backend.execute import Machine
from fkgen.study.diagnostics import start
from fkgen.study.diagnostics.start import Replay

SPECS = spread.specs("float") | sensor_specs.every("float")
KINDS = ("kf_functions", "kf_exact", "kf_wide", "mme_certain", "dfcf_groups", "imm_zeros", "genie")


def encoder(variance, prior, scalar="float"):
    dt, q = 0.01, 0.1
    model = {
        "A": [[1.0, dt], [0.0, 1.0]],
        "C": [[1.0, 0.0]],
        "Q": [[q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]],
        "R": [[variance]],
        "x0": [0.0, 0.0],
        "P0": [[prior, 0.0], [0.0, prior]],
        "states": [{"name": "angle"}, {"name": "rate"}],
    }
    table = {"name": "encoder", "model": model, "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table | {"code": {"scalar": scalar}})


def trend(prior, scalar="float"):
    """A level, its slope and a season of six."""
    A = np.zeros((7, 7))
    A[0, :2], A[1, 1], A[2, 2:] = 1.0, 1.0, -1.0
    A[[3, 4, 5, 6], [2, 3, 4, 5]] = 1.0
    model = {
        "A": A.tolist(),
        "C": [[1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]],
        "Q": np.diag([1e-2, 1e-4, 1e-3, 0.0, 0.0, 0.0, 0.0]).tolist(),
        "R": [[0.5]],
        "x0": [0.0] * 7,
        "P0": (prior * np.eye(7)).tolist(),
    }
    table = {"name": "trend", "model": model, "filter": {"family": "kf"}}
    return fkgen.Spec.from_dict(table | {"code": {"scalar": scalar}})


def found(spec):
    return [f for f in fkgen.check(spec).findings if f.code == "start"]


@pytest.mark.parametrize("name", KINDS)
def test_a_replay_gives_the_bits_of_the_machine(name):
    program = generated(SPECS[name]).program
    machine, replay, rng = Machine(program), Replay(program), np.random.default_rng(4)
    for k in range(9):
        y, u = rng.normal(size=len(program.outputs)), rng.normal(size=len(program.inputs))
        y[rng.random(y.shape) < 0.2] = np.nan
        y[:] = np.inf if k == 6 else y
        status = machine.step(u.tolist(), y.tolist(), dict(program.parameters))
        assert replay.step(u, y, dict(program.parameters)) == (status.value >= 0)
        for port, values in machine.ports.items():
            assert [v.tobytes() for v in replay.port(port)] == [v.tobytes() for v in values], port


@needs_compiler()
@pytest.mark.parametrize(
    ("spec", "severity"),
    [
        (encoder(1e-2, 1.0), "note"),
        (encoder(1e-12, 1e3), "warning"),
        (encoder(1e-12, 1e6), "error"),
        (trend(1e6), "refused"),
    ],
    ids=["mild", "tight", "wide", "refused"],
)
def test_it_says_what_the_compiled_filters_do(spec, severity):
    y, _, _ = start._drawn(spec)
    y = y.astype(np.float32).astype(float)
    exact = replace(spec, code=replace(spec.code, scalar="double"))
    single, double = built(spec).run(y), built(exact).run(y)
    assert not double.refused.any()
    assert single.refused.any() == (severity == "refused")
    findings = found(spec)
    if single.refused.any():
        first = int(np.flatnonzero(single.refused)[0])
        assert findings[0].value == single.refused.sum()
        assert f"sample {first}:" in findings[0].message
        return
    sd = np.sqrt(np.diagonal(double.filtered_covariance, axis1=1, axis2=2))
    ulp = np.spacing(np.abs(double.filtered_state).astype(np.float32))
    off = np.maximum(np.abs(single.filtered_state - double.filtered_state) - 2.0 * ulp, 0.0) / sd
    at, worst = np.unravel_index(np.argmax(off), off.shape)
    (finding,) = findings
    assert (finding.value, finding.severity) == (pytest.approx(off[at, worst], rel=1e-6), severity)
    assert ("angle", "rate")[worst] in finding.message
    assert f"sample {at}" in finding.message
    assert fkgen.check(spec).values["float_start_to_sd"] == finding.value


def test_a_wide_prior_that_float_cannot_hold_is_not_sound():
    assert not fkgen.check(encoder(1e-8, 1e4)).sound
    assert fkgen.check(encoder(1e-8, 1e4, "double")).sound
    assert fkgen.check(encoder(1e-2, 1.0)).sound


def test_double_says_nothing_about_float():
    assert found(encoder(1e-8, 1e4, "double")) == []


def test_jumping_plants_are_held_to_it_as_well():
    (finding,) = found(SPECS["imm_jump"])
    assert finding.severity == "note"
    vague = replace(SPECS["imm_jump"].model, P0=fkgen.problem.Matrix.of(1e12 * np.eye(2)))
    assert found(replace(SPECS["imm_jump"], model=vague))[0].severity in {"warning", "error"}
