"""Verification says yes to what is right and no to what is not."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

import fkgen
from fkgen.proof import agreement, selftest, steady_state
from fkgen.proof.verify import steps, verify
from fkgen.study.reports.starters import starter

pytestmark = pytest.mark.compiled


@pytest.fixture(scope="module")
def specs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("specs")
    found = {}
    for family in ("kf", "mkf", "mme"):
        path = folder / f"{family}.toml"
        path.write_text(starter(family), encoding="utf-8")
        found[family] = fkgen.load(path)
    return found


def of(spec, **changes):
    return fkgen.Spec.from_dict(spec.to_dict() | changes)


def test_all_claims_about_a_starter_hold(specs):
    claims = verify(specs["kf"])
    assert all(claim.holds for claim in claims), [str(c) for c in claims if not c.holds]
    text = " ".join(claim.claim for claim in claims)
    for part in ("rest", "NumPy", "CasADi", "self-test", "C99"):
        assert part in text


def test_every_theorem_of_the_family_is_a_step(specs):
    titles = [step.title for step in steps(specs["mkf"])]
    assert sum(title.startswith("theorem: ") for title in titles) >= 10


@pytest.mark.parametrize("family", ["kf", "mkf", "mme"])
@pytest.mark.parametrize("scalar", ["double", "float"])
def test_compiled_code_agrees_with_everyone(specs, family, scalar):
    spec = of(specs[family], code={"scalar": scalar})
    design = fkgen.validate(spec)
    record = agreement.trial(spec)
    claims = [
        *agreement.with_machine(fkgen.generate(design), record),
        *agreement.with_interpreter(design),
    ]
    assert all(claim.holds for claim in claims), [str(c) for c in claims]
    assert claims[0].tolerance == 0.0
    assert claims[1].tolerance == 0.0


def test_entries_with_functions_get_a_tolerance(specs):
    table = specs["mkf"].to_dict()
    table["parameters"] |= {"tau": 0.5}
    table["model"]["A"] = [["exp(-0.01/tau)", -0.0002], [0.0094, 0.9048]]
    (claim,) = agreement.with_interpreter(fkgen.validate(fkgen.Spec.from_dict(table)))
    assert claim.holds
    assert 0.0 < claim.tolerance < 1e-6


def test_a_bit_that_differs_is_seen():
    value = np.array([1.0, np.nan])
    assert agreement._difference(value, value) == 0.0
    assert agreement._difference(value, np.nextafter(value, 2.0)) > 0.0
    assert agreement._difference(np.array([0.0]), np.array([-0.0])) > 0.0
    assert agreement._difference(value, np.array([1.0, 2.0])) == np.inf


def test_the_trial_record_has_missing_rows_and_missing_samples(specs):
    y = agreement.trial(specs["kf"]).y
    assert y.shape == (50, 2)
    assert np.isnan(y).all(axis=1).any()
    assert (np.isnan(y).any(axis=1) & ~np.isnan(y).all(axis=1)).any()


@pytest.mark.parametrize(("family", "count"), [("kf", 1), ("mkf", 1), ("mme", 2)])
def test_the_covariance_rests_where_python_control_says(specs, family, count):
    spec = specs[family]
    if family == "mme":
        spec = of(spec, filter={"family": "mme", "hypotheses": [0.2, 0.7]})
    claims = steady_state.claims(fkgen.validate(spec).recursion)
    assert len(claims) == count
    assert all(claim.holds for claim in claims)


def test_another_process_noise_rests_elsewhere(specs):
    table = specs["mkf"].to_dict()
    table["model"]["Q"] = [[1.001e-4, 0.0], [0.0, 1.001e-4]]
    recursion = fkgen.validate(fkgen.Spec.from_dict(table)).recursion
    (claim,) = steady_state.claims(dataclasses.replace(recursion, spec=specs["mkf"]))
    assert not claim.holds


def test_a_filter_that_never_rests_makes_no_claim(specs):
    table = specs["kf"].to_dict()
    table["model"]["Q"] = [[0.0, 0.0], [0.0, 0.0]]
    recursion = fkgen.validate(fkgen.Spec.from_dict(table)).recursion
    assert steady_state.claims(recursion) == ()


def test_compilers_are_different_ones():
    found = selftest.compilers()
    assert found
    assert all(a.command != b.command for a, b in pairwise(found))


def test_an_edited_source_fails_its_self_test(specs):
    source = fkgen.generate(fkgen.validate(specs["kf"]))
    name = "my_filter.c"
    text = source.files[name]
    assert "0.04" in text
    wrong = dataclasses.replace(source, files={**source.files, name: text.replace("0.04", "0.05")})
    clean, passed = selftest.claims(wrong, selftest.compilers()[0])
    assert clean.holds
    assert not passed.holds


def test_a_warning_fails_the_claim_and_is_quoted(specs):
    source = fkgen.generate(fkgen.validate(specs["kf"]))
    text = source.files["my_filter.c"] + "static int unused_thing;\n"
    wrong = dataclasses.replace(source, files={**source.files, "my_filter.c": text})
    clean, passed = selftest.claims(wrong, selftest.compilers()[0])
    assert not clean.holds
    assert not passed.holds
    assert "unused_thing" in clean.source


def test_theorems_that_fail_are_seen():
    from fkgen.oracle.theorems.identity import Identity
    from fkgen.proof import verify as module

    def false():
        import sympy

        return ((sympy.ones(1), sympy.zeros(1)),)

    identity = Identity(claim="one is zero", source="nowhere", equations=false)
    (claim,) = module._theorem(identity)
    assert not claim.holds
