"""``code.ports``: what is left out of the instance goes with its arithmetic; the rest stays."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
import sensor_specs
import spread
from plants import generated
from toolchain import ANY, BITS, C_ONLY, FLAGS, call, check_only, needs_compiler

import fkgen
from fkgen.backend import ir
from fkgen.backend.execute import Machine
from fkgen.errors import SpecError
from fkgen.families import NAMES
from fkgen.study.records import filtering
from fkgen.study.records.reading import Reading
from fkgen.study.reports.starters import starter

SPECS = spread.specs() | sensor_specs.every()
SPECS |= {f"starter_{n}": fkgen.Spec.from_dict(tomllib.loads(starter(n))) for n in NAMES}
#: The others, which differ in numbers rather than in what they do, are for test-all.
FEW = ("kf_correlated", "kf_wide", "mkf_independent", "imm", "one_step", "dfcf")
SHOWN = ("innovation", "innovation_covariance", "nis", "log_likelihood")


def chosen(names):
    return [n if n in FEW else pytest.param(n, marks=pytest.mark.exhaustive) for n in sorted(names)]


def selecting(spec, *ports):
    return replace(spec, code=replace(spec.code, ports=ports))


def program(name, *ports):
    return generated(selecting(SPECS[name], *ports)).program


def trial(program):
    """Ports after every sample and statuses, over a record with gaps and an outlier."""
    rng, machine, found = np.random.default_rng(8), Machine(program), []
    y = rng.normal(size=(14, len(program.outputs)))
    y[rng.random(y.shape) < 0.2] = np.nan
    y[5] = np.nan
    y[11, 0] = 1e3
    for k in range(len(y)):
        u = rng.normal(size=len(program.inputs)).tolist()
        status = machine.step(u, y[k].tolist(), dict(program.parameters))
        found.append((status, {name: np.array(v, float) for name, v in machine.ports.items()}))
    return found


@pytest.mark.parametrize("name", SPECS)
def test_what_stays_is_the_same_and_what_is_not_needed_goes(name):
    whole, bare = generated(SPECS[name]).program, program(name)
    names = {port.name for port in bare.ports}
    assert names < {port.name for port in whole.ports}
    assert names.isdisjoint(SHOWN)
    assert bare.flops < whole.flops
    for (told, expected), (status, found) in zip(trial(whole), trial(bare), strict=True):
        assert (status, found.keys()) == (told, names)
        for port in names:
            np.testing.assert_allclose(
                found[port], expected[port], rtol=1e-9, atol=1e-9, err_msg=port
            )


@pytest.mark.parametrize("name", chosen(set(SPECS) - {"starter_mjls_lmmse"}))
def test_beside_the_covariance_of_the_innovation_every_bit_stays(name):
    whole, some = generated(SPECS[name]).program, program(name, SHOWN[1])
    assert SHOWN[1] in {port.name for port in some.ports}
    assert "nis" not in {port.name for port in some.ports}
    for (told, expected), (status, found) in zip(trial(whole), trial(some), strict=True):
        assert status == told
        for port, value in found.items():
            np.testing.assert_array_equal(value, expected[port], err_msg=port)


@pytest.mark.parametrize("name", SPECS)
def test_nothing_is_computed_that_nobody_reads(name):
    found = program(name)
    kept = {port.name for port in found.ports}
    for phase in found.phases:
        used = set(ir.read(ir.Temp, phase.body)) | set(ir.read(ir.Element, phase.body))
        moving = {e.name for e in used if isinstance(e, ir.Element) and e.moves}
        for node in ir.walk(phase.body):
            if isinstance(node, ir.Operate | ir.Copy):
                assert node.target in used
            if isinstance(node, ir.Product | ir.Triangle):
                assert node.target.name in {e.name for e in used if isinstance(e, ir.Element)}
            if isinstance(node, ir.Assign):
                read = node.target in used or node.target.name in moving
                assert read or node.target.space is ir.Space.NEXT
                assert node.target.space is not ir.Space.NEXT or node.target.name in kept
    carried = {
        e.name
        for p in found.phases
        for e in ir.read(ir.Element, p.body)
        if e.space is ir.Space.SELF
    }
    decisive = {"filtered_state", *(outcome.port for outcome in found.outcomes)}
    decisive |= {phase.unless for phase in found.phases if phase.unless}
    assert kept <= carried | decisive | {p.given for p in found.ports} | {
        p.corrected for p in found.ports
    }


@needs_compiler()
@pytest.mark.parametrize("name", chosen(SPECS))
def test_the_c_of_it_has_no_warning(name, tmp_path):
    source = generated(selecting(SPECS[name]))
    source.write(tmp_path)
    units = sorted(path.name for path in tmp_path.glob("*.c"))
    call(*ANY, "-std=c99", *FLAGS, *C_ONLY, BITS, check_only("gcc"), *units, cwd=tmp_path)


@needs_compiler()
@pytest.mark.parametrize("name", ["kf_correlated", "mme", "imm_zeros", "starter_dfcf"])
def test_the_self_test_passes_and_python_shows_what_c_has(name, tmp_path):
    spec = selecting(SPECS[name], "nis")
    generated(spec).write(tmp_path)
    units = sorted(path.name for path in tmp_path.glob("*.c"))
    call(*ANY, "-std=c99", "-O2", *FLAGS, *C_ONLY, BITS, *units, "-o", "selftest", cwd=tmp_path)
    assert call(tmp_path / "selftest", cwd=tmp_path, check=False).returncode == 0
    built = fkgen.build(spec)
    assert built.ports == tuple(port.name for port in generated(spec).program.ports)
    y, u = np.ones((3, spec.model.ny)), np.ones((3, spec.model.nu)) if spec.model.nu else None
    assert np.isfinite(built.run(y, u).nis).all()


def test_a_spec_with_ports_survives_a_round_trip_and_has_a_hash_of_its_own():
    spec = selecting(SPECS["kf"], "nis")
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
    assert spec.canonical() != SPECS["kf"].canonical()
    assert "ports" not in SPECS["kf"].canonical()


@pytest.mark.parametrize(
    ("ports", "message"),
    [
        (["niss"], r"code\.ports\[0\]: given 'niss'.*one of predicted_state, .*did you mean 'nis'"),
        (["nis", 3], r"code\.ports\[1\]: given .*3.*; expected the name of a port"),
        ("nis", r"code\.ports: given .*; expected a list of names"),
    ],
)
def test_a_port_that_does_not_exist_is_an_error_at_its_key(ports, message):
    table = SPECS["kf"].to_dict()
    table["code"]["ports"] = ports
    with pytest.raises(SpecError, match=message):
        fkgen.validate(fkgen.Spec.from_dict(table))


@needs_compiler()
def test_who_looks_into_a_filter_sees_all_of_it(tmp_path, capsys):
    spec, whole = selecting(SPECS["kf_correlated"]), SPECS["kf_correlated"]
    assert spec.whole == whole
    u = np.ones((9, whole.model.nu))
    assert (
        fkgen.compare(spec, runs=2, steps=9, u=u).to_json()
        == fkgen.compare(whole, runs=2, steps=9, u=u).to_json()
    )
    fault = np.ones((5, whole.model.ny))
    found, expected = (fkgen.fault_effect(each, fault) for each in (spec, whole))
    np.testing.assert_array_equal(found.innovation_deviation, expected.innovation_deviation)
    assert fkgen.check(spec).values["flops_per_step"] < fkgen.check(whole).values["flops_per_step"]
    record = "\n".join(["y0,y1,u0,u1"] + ["1.0,2.0,0.5,0.5"] * 8)
    names = [s.name for s in (*whole.model.outputs, *whole.model.inputs)]
    (tmp_path / "r.csv").write_text(record.replace("y0,y1,u0,u1", ",".join(names)))
    filtering.run(
        spec,
        Reading(path=tmp_path / "r.csv"),
        output=None,
        plot=tmp_path / "a.svg",
        keep="",
        force=False,
    )
    assert capsys.readouterr().out.startswith("filtered_state")
    assert (tmp_path / "a.svg").stat().st_size > 0
