"""Filters with fused multiply-adds: one arithmetic in C, in the program as data and in the test."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import nonlinear_specs
import numpy as np
import pytest
import sensor_specs
import spread
from jump_plants import random_table, record_of, spec_of
from plants import distance, generated, motor, random_model, record, run, spec
from toolchain import (
    ANY,
    BITS,
    C_COMPILERS,
    C_ONLY,
    FLAGS,
    call,
    each,
    needs_compiler,
    thorough,
)

import fkgen
from fkgen.backend.execute import Machine
from fkgen.backend.fused import products
from fkgen.backend.ir import Operator
from fkgen.errors import SpecError, StepRefused
from fkgen.families import family
from fkgen.proof import agreement
from fkgen.symbolic.interpreter import Interpreter

pytestmark = needs_compiler()

SCALARS = ("double", "float")
NONLINEAR = [f"{f}_{case}" for f in ("ekf", "iekf", "ukf") for case in ("attitude", "pendulum")]
EVERY = [*spread.NAMES, *sensor_specs.EVERY, *NONLINEAR, "jump", "dense"]

#: One of each family.
FEW = [
    ("dense", "double"),
    ("dense", "float"),
    ("kf_correlated", "double"),
    ("kf_joseph", "float"),
    ("mkf_sensed", "double"),
    ("mme_speed", "float"),
    ("compression_full", "double"),
    ("dfcf", "double"),
    ("cpcf", "float"),
    ("linear_moments", "double"),
    ("one_step", "float"),
    ("imm_white", "double"),
    ("genie", "double"),
    ("ekf_pendulum", "double"),
    ("iekf_pendulum", "float"),
    ("ukf_attitude", "double"),
    ("jump", "double"),
]

#: Both compute in double; the sums of a step differ in the last digit, which gains multiply.
ROUNDED = 1e-11


@cache
def plant_of(name, scalar="double", *, fma=True):
    """A spec of one of the collections, with fused products or without."""
    start, _, case = name.partition("_")
    if name in NONLINEAR:
        plant = nonlinear_specs.spec_of(case, start, code={"scalar": scalar})
    elif name == "dense":  # products of matrices as statements
        plant = spec(random_model(91, 9, 3, 1), family="kf", code={"scalar": scalar})
    elif name == "jump":
        table = random_table(71, 2, 2, 2, q=1, offsets=True, correlated=True)
        plant = spec_of(table | {"code": {"scalar": scalar}})
    else:
        known = spread.specs if name in spread.NAMES else sensor_specs.every
        plant = known(scalar)[name]
    return replace(plant, code=replace(plant.code, fma=fma))


def trial(plant, T=9):
    """A record with missing rows; parameters that change."""
    if plant.model.equations is not None:
        return nonlinear_specs.record_of(plant, T)
    if plant.faults.jump is not None and plant.faults.sensor is None:
        y, u = record_of(plant, T, missing=0.2)
        return y, u, {}
    if plant.faults.sensor is None:
        return spread.trial(plant, T)
    rng = np.random.default_rng(5)
    y, u = rng.standard_normal((T, plant.model.ny)), rng.standard_normal((T, plant.model.nu))
    y[2, 1] = y[5, 0] = np.nan
    y[4] = np.nan
    told = {"gamma": rng.integers(0, 2, T).astype(float), "delta": rng.choice([1.0, 10.0], T)}
    return y, u, told if plant.filter.family == "genie" else {}


#: Every spec once, scalars and compilers by turns; and all of both for those of each family.
CASES = [
    (name, scalar, compiler)
    for at, name in enumerate(EVERY)
    for i, scalar in enumerate(SCALARS)
    for j, compiler in enumerate(C_COMPILERS)
    if (name, scalar) in FEW or (i == at % 2 and j == at // 2 % len(C_COMPILERS))
]
QUICK = [
    case
    for case in CASES
    if case[:2] in FEW and (C_COMPILERS[case[2]] == ANY or case[:2] in FEW[:4])
]


@pytest.mark.parametrize(("name", "scalar", "compiler"), thorough(CASES, QUICK))
def test_compiled_c_is_the_program_as_data_bit_for_bit(name, scalar, compiler, monkeypatch):
    monkeypatch.setenv("FKGEN_CC", " ".join(C_COMPILERS[compiler]))
    plant = plant_of(name, scalar)
    y, u, params = trial(plant)
    source = generated(plant)
    assert source.program.fused > 0
    machine, compiled = Machine(source.program), fkgen.compile(source)
    machine.start({k: float(v[0]) for k, v in params.items()})
    compiled.reset(params={k: float(v[0]) for k, v in params.items()})
    for k, row in enumerate(y):
        now = {key: float(value[k]) for key, value in params.items()}
        status = machine.step(u[k], row, now)
        try:
            given = compiled.step(row, u[k] if u.shape[1] else None, now).status
        except StepRefused as refused:
            given = refused.status
        assert given == status.value
        for port, values in machine.ports.items():
            assert compiled.state(port).tobytes() == np.array(values).tobytes(), (port, k)


@pytest.mark.parametrize("name", dict.fromkeys(name for name, _ in FEW))
def test_fused_products_change_the_last_digits_and_no_status(name):
    plant = plant_of(name)
    y, u, params = trial(plant)
    fused, apart = (run(each, y, u, params) for each in (plant, plant_of(name, fma=False)))
    np.testing.assert_array_equal(fused.status, apart.status)
    ports = [port for port in fused.ports if not port.endswith("log_weight")]
    errors = {port: distance(fused[port], apart[port]) for port in ports}
    assert max(errors.values()) < ROUNDED
    assert max(errors.values()) > 0.0


@pytest.mark.parametrize("update", ["short", "joseph"])
def test_float_is_no_further_from_double_than_without(update):
    """Root mean squares over eight plants: each of them may go either way."""
    errors = {True: [], False: []}
    for seed in range(8):
        model = random_model(200 + seed, 6, 3)
        exact = run(spec(model, family="kf", code={"update": update}), (y := _noise(seed)))
        for fma, found_errors in errors.items():
            code = {"scalar": "float", "update": update, "fma": fma}
            found = run(spec(model, family="kf", code=code), y.astype(np.float32))
            for port in ("filtered_state", "filtered_covariance"):
                off = found[port].astype(float) - exact[port]
                found_errors.append(np.sqrt((off**2).mean() / (exact[port] ** 2).mean()))
    assert np.mean(errors[True]) < np.mean(errors[False])


def _noise(seed):
    """Measurements that float holds."""
    y = np.random.default_rng(seed).standard_normal((60, 3))
    return y.astype(np.float32).astype(float)


# ---------------------------------------------------------------------------- who notices


def claims(plant):
    """What the compiled code is held against: itself as data, and CasADi."""
    design = fkgen.validate(plant)
    same = agreement.with_machine(fkgen.generate(design), agreement.trial(plant))
    return same, agreement.with_interpreter(design)


@pytest.mark.parametrize("name", ["kf_correlated", "mkf_sensed", "dfcf"])
@pytest.mark.parametrize("scalar", SCALARS)
def test_fused_code_agrees_with_casadi_which_does_not_fuse(name, scalar):
    same, close = claims(plant_of(name, scalar))
    assert all(each.holds for each in (*same, *close))
    assert [each.tolerance for each in same] == [0.0]
    assert all(0.0 < each.tolerance < 1e-10 for each in close)


@pytest.mark.parametrize(
    ("operator", "wrong"),
    [
        (Operator.ADD, (Operator.FNMA, Operator.FMA)),
        (Operator.SUB, (Operator.FMA, Operator.FMS)),
    ],
)
def test_a_product_that_is_fused_with_the_wrong_sign_is_caught(operator, wrong, monkeypatch):
    monkeypatch.setitem(products._WITH_PRODUCT, operator, wrong)
    _, close = claims(plant_of("kf_correlated"))
    assert not all(each.holds for each in close)


def test_a_difference_that_is_turned_around_does_not_get_through_the_self_test(monkeypatch):
    turned = (Operator.FMS, Operator.FMS)
    monkeypatch.setitem(products._WITH_PRODUCT, Operator.SUB, turned)
    with pytest.raises(SpecError, match="lost its positivity"):
        claims(plant_of("kf_correlated"))


def test_a_compiled_sum_in_two_roundings_is_caught(monkeypatch):
    """The bits are those of one rounding: a machine that rounds twice is not what C does."""
    from fkgen.backend import execute

    twice = {Operator.FMA: lambda a, b, c: a * b + c}
    monkeypatch.setattr(execute, "ARITHMETIC", execute.ARITHMETIC | twice)
    same, _ = claims(plant_of("kf_correlated"))
    assert not all(each.holds for each in same)


def test_ports_that_are_left_out_change_no_bit_of_the_others():
    whole = spec(random_model(77, 4, 3, correlated=True), family="kf", code={"fma": True})
    few = replace(whole, code=replace(whole.code, ports=()))
    y, _ = record(whole, 20, missing=0.2)
    known, found = (run(each, y) for each in (whole, few))
    for port in found.ports:
        assert found[port].tobytes() == known[port].tobytes(), port
    assert set(found.ports) < set(known.ports)


def test_a_linear_plant_by_equations_has_the_bits_of_its_matrices():
    model = {
        "states": [{"name": "x"}, {"name": "v"}],
        "outputs": [{"name": "y"}],
        "Q": [[0.1, 0.02], [0.02, 0.2]],
        "R": [[0.5]],
        "x0": [0.3, -0.2],
        "P0": [[1.0, 0.1], [0.1, 2.0]],
    }
    A, C = [[0.9, 0.1], [-0.2, 0.8]], [[1.0, 0.5]]
    by_matrices = spec(model | {"A": A, "C": C}, family="kf", code={"fma": True})
    equations = {"f": {"x": "0.9*x + 0.1*v", "v": "-0.2*x + 0.8*v"}, "h": {"y": "x + 0.5*v"}}
    by_equations = spec(model | equations, family="ekf", code={"fma": True})
    y, _ = record(by_matrices, 20, missing=0.2)
    known, found = run(by_matrices, y), run(by_equations, y)
    for port in known.ports:
        assert found[port].tobytes() == known[port].tobytes(), port


def test_the_interpreter_of_the_recursion_is_within_rounding():
    plant = plant_of("imm_white")
    y, u, params = trial(plant)
    found = Interpreter(family(plant.filter.family).build(plant)).run(y, u, params)
    compiled = run(plant, y, u, params)
    assert distance(compiled.filtered_state, found["filtered_state"]) < ROUNDED


# ------------------------------------------------------------------------------- the files


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize("scalar", SCALARS)
def test_the_files_compile_silently_and_their_self_test_passes(compiler, scalar, tmp_path):
    generated(plant_of("mkf_sensed", scalar)).write(tmp_path)
    units = sorted(path.name for path in tmp_path.glob("*.c"))
    command = [*C_COMPILERS[compiler], "-std=c99", "-O2", *FLAGS, *C_ONLY, BITS]
    call(*command, *units, "-lm", "-o", "selftest", cwd=tmp_path)
    assert call(tmp_path / "selftest", cwd=tmp_path, check=False).returncode == 0


#: What libraries for small targets have in place of fma(): two roundings, or one too many.
TWICE = {
    "double": "double fma(double a, double b, double c) { return a * b + c; }",
    "float": "float fmaf(float a, float b, float c) { return (float)((double)a * b + c); }",
}


@pytest.mark.parametrize("compiler", each(C_COMPILERS))
@pytest.mark.parametrize("scalar", SCALARS)
def test_the_self_test_fails_where_fma_rounds_twice(compiler, scalar, tmp_path):
    generated(plant_of("mkf_sensed", scalar)).write(tmp_path)
    (tmp_path / "twice.c").write_text(TWICE[scalar])
    units = sorted(path.name for path in tmp_path.glob("*.c"))
    command = [*C_COMPILERS[compiler], "-std=c99", "-O1", "-fno-builtin", BITS]
    call(*command, *units, "-lm", "-o", "selftest", cwd=tmp_path)
    assert call(tmp_path / "selftest", cwd=tmp_path, check=False).returncode != 0


def test_a_folder_links_libm_to_the_filters_that_need_it(tmp_path):
    for name, fma in (("plain", False), ("joint", True)):
        fkgen.generate(fkgen.validate(motor("kf", name=name, code={"fma": fma}))).write(tmp_path)
    text = (tmp_path / "CMakeLists.txt").read_text()
    assert "target_link_libraries(joint PUBLIC" in text
    assert "target_link_libraries(plain PUBLIC" not in text
