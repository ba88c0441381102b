"""What `check` says of the start in float: held against compiled filters and exact arithmetic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sensor_specs
import spread
from plants import built
from toolchain import needs_compiler

import fkgen
from fkgen.estimators.gaussian import estimate
from fkgen.estimators.lmmse import kalman
from fkgen.study.diagnostics import start

SPECS = spread.specs("float") | sensor_specs.every("float")
KINDS = ("kf_functions", "kf_exact", "kf_wide", "mme_certain", "dfcf_groups", "imm_zeros", "genie")


def encoder(variance, prior, scalar="float", update="auto"):
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
    return fkgen.Spec.from_dict(table | {"code": {"scalar": scalar, "update": update}})


def trend(prior, update="auto"):
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
    return fkgen.Spec.from_dict(table | {"code": {"scalar": "float", "update": update}})


def found(spec):
    return [f for f in fkgen.check(spec).findings if f.code == "start"]


@needs_compiler()
@pytest.mark.parametrize(
    ("spec", "severity"),
    [
        (encoder(1e-2, 1.0), "note"),
        (encoder(1e-2, 1.0, update="joseph"), "note"),
        (encoder(1e-12, 1e3, update="joseph"), "warning"),
        (encoder(1e-12, 1e6, update="joseph"), "error"),
        (trend(1e6, "joseph"), "refused"),
    ],
    ids=["factors", "mild", "tight", "wide", "refused"],
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
    assert not fkgen.check(encoder(1e-8, 1e4, update="joseph")).sound
    assert fkgen.check(encoder(1e-8, 1e4)).sound
    assert fkgen.check(encoder(1e-8, 1e4, "double")).sound
    assert fkgen.check(encoder(1e-2, 1.0)).sound


def test_double_says_nothing_about_float():
    assert found(encoder(1e-8, 1e4, "double")) == []


def test_jumping_plants_are_held_to_it_as_well():
    (finding,) = found(SPECS["imm_jump"])
    assert finding.severity == "note"
    vague = replace(SPECS["imm_jump"].model, P0=fkgen.problem.Matrix.of(1e12 * np.eye(2)))
    vague = replace(SPECS["imm_jump"], model=vague)
    assert found(vague)[0].severity == "note"
    vague = replace(vague, code=replace(vague.code, update="joseph"))
    assert found(vague)[0].severity in {"warning", "error"}


LOST = {"noise_factor": 4.0, "problem": 3, "delta_chain": [[0.8, 0.2], [0.8, 0.2]]}


def scalar_plant(family, faults, scalar="double", update="auto", **model):
    plant = {"A": [[-0.8]], "C": [[1.0]], "Q": [[1.0]], "R": [[1.0]], "x0": [0.0]} | model
    table = {"name": "plant", "model": plant, "faults": faults, "filter": {"family": family}}
    return fkgen.Spec.from_dict(table | {"code": {"scalar": scalar, "update": update}})


def alternating(prior, scalar="double"):
    """A signal that comes and goes in turn: without Lemma 2, C - V need not be a covariance."""
    faults = {"sensor": LOST | {"gamma_chain": [[0.1, 0.9], [0.9, 0.1]]}}
    return scalar_plant("linear_optimal", faults, scalar, P0=[[prior]])


@pytest.mark.parametrize(
    ("spec", "key", "remedy"),
    [
        (encoder(1e-8, 1e4, update="joseph"), "code.scalar", 'scalar = "double"'),
        (encoder(1e-10, 1e4, update="joseph"), "code.scalar", 'scalar = "double"'),
        (alternating(100.0), "model.P0", 'filter.form = "augmented"'),
        (alternating(1e8), "model.P0", 'filter.form = "augmented"'),
        (alternating(1e8, "float"), "code.scalar", 'filter.form = "augmented"'),
    ],
)
def test_numbers_with_which_the_self_test_is_refused_are_said_where_they_stand(spec, key, remedy):
    with pytest.raises(fkgen.SpecError, match="of the self-test is refused") as fault:
        fkgen.build(spec)
    assert fault.value.key == key
    assert remedy in fault.value.expected
    assert "\n" not in str(fault.value)
    report = fkgen.check(spec)
    assert not report.sound
    (finding,) = [f for f in report.findings if "no code can be generated" in f.message]
    assert remedy in finding.remedy
    assert fault.value.given.removeprefix("numbers with which, ") in finding.message


def test_where_the_self_test_passes_nobody_speaks_of_it():
    assert fkgen.check(alternating(10.0)).sound
    assert found(alternating(10.0)) == []


#: More digits than there are, in the filter and in what it is held against.
WITHOUT_DIGITS = {
    "one_step": (
        scalar_plant(
            "one_step",
            {"sensor": LOST | {"gamma_chain": [[0.6, 0.4], [0.2, 0.8]]}},
            A=[[1.0, 0.01], [0.0, 1.0]],
            C=[[-0.31, -1.22], [0.69, -1.33]],
            Q=[[6.1e-13, -1.06e-12], [-1.06e-12, 2.61e-12]],
            R=[[1e-9, 0.0], [0.0, 1e-15]],
            x0=[-1.1e5, -3.4e4],
            P0=[[1e5, 0.0], [0.0, 1e5]],
        ),
        "model.P0",
    ),
    "float": (
        scalar_plant(
            "dfcf",
            {"soft": {"host": [0], "window": 4}},
            "float",
            "joseph",  # factors hold these digits
            C=[[1.0], [0.5]],
            R=[[1e8, 0.0], [0.0, 1e8]],
            P0=[[1e2]],
        ),
        "code.scalar",
    ),
}


@pytest.mark.parametrize("case", WITHOUT_DIGITS)
def test_numbers_that_leave_nothing_to_prove_with_are_no_defect_of_the_filter(case):
    spec, key = WITHOUT_DIGITS[case]
    with pytest.raises(fkgen.SpecError, match="leave no digits to prove the filter") as fault:
        fkgen.validate(spec)
    assert fault.value.key == key
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("update", ["joseph", "ud"])
@pytest.mark.parametrize("numbers", [(1e-2, 1.0, "float"), (1e-12, 1e6, "double")])
def test_a_mistake_in_the_filter_is_its_defect_whatever_the_numbers(monkeypatch, numbers, update):
    name, at = {"joseph": ("propagate", 1), "ud": ("propagate_factors", 0)}[update]
    right = getattr(estimate, name)

    def wrong(*given):
        plant = replace(given[at], A=given[at].A.T)
        return right(*given[:at], plant, *given[at + 1 :])

    monkeypatch.setattr(kalman, name, wrong)
    with pytest.raises(fkgen.InternalError, match="joint distribution"):
        fkgen.validate(encoder(*numbers, update))
