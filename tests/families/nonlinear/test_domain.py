"""Plants whose f or h has values in a part of the states and inputs alone: proved, built, run."""

from __future__ import annotations

import dataclasses
from functools import cache

import equations
import numpy as np
import pytest
from mutants import proved, recursion, refusals, rewritten
from plants import built, distance
from toolchain import needs_compiler

import fkgen
from fkgen.errors import SpecError
from fkgen.oracle.claims import nonlinear
from fkgen.oracle.claims.claim import Record
from fkgen.oracle.sampled import draw_record
from fkgen.proof import agreement
from fkgen.proof.records import PLAIN, record_for, trial
from fkgen.symbolic import plant as plants

FORMS = {
    "ekf": nonlinear.EXTENDED,
    "iekf": nonlinear.ITERATED,
    "ukf": nonlinear.UNSCENTED,
    "imm": nonlinear.LINEARISED_IMM,
    "mkf": nonlinear.LINEARISED,
}
ONE = {"states": [{"name": "a"}], "inputs": [{"name": "u"}], "outputs": [{"name": "y"}]}
ONE |= {"Q": [[1e-4]], "R": [[0.01]], "x0": [0.4], "P0": [[0.01]]}
TWO = ONE | {"states": [{"name": "a"}, {"name": "b"}], "x0": [0.5, 1.0]}
TWO |= {"Q": [[1e-2, 0.0], [0.0, 1e-2]], "P0": [[0.01, 0.0], [0.0, 0.01]]}
#: Models, and the input at which they may be run for ten samples and more.
PLANTS = {
    "a tank": (ONE | {"f": {"a": "a + u - 0.1*sqrt(a)"}, "h": {"y": "a"}}, 0.06),
    "a root of an input": (
        ONE | {"f": {"a": "0.9*a + sqrt(1 + u)"}, "h": {"y": "a + 0.1*sin(a)"}}, 0.0,
    ),
    "a logarithm of an input": (
        ONE | {"f": {"a": "0.9*a + 0.1*log(u)"}, "h": {"y": "a + 0.1*sin(a)"}}, 1.0,
    ),
    "a logarithm of the state": (
        ONE | {"f": {"a": "0.9*a + 0.1 + 0.1*u"}, "h": {"y": "log(a)"}, "x0": [1.0]}, 0.0,
    ),
    "the arcsine of a ratio": (
        TWO | {"f": {"a": "0.9*a", "b": "b + 0.01*u"}, "h": {"y": "asin(a/b)"}}, 0.0,
    ),
    "a division by the state": (
        TWO | {"f": {"a": "0.9*a + u/b"}, "h": {"y": "a + b"}, "Q": [[1e-4, 0.0], [0.0, 1e-4]]},
        0.0,
    ),
}  # fmt: skip
#: Plants and families that are built: every family once, and every plant with a few.
BUILT = [("a tank", family) for family in FORMS]
BUILT += [(name, "ekf") for name in PLANTS if name != "a tank"]
BUILT += [("a root of an input", "mkf"), ("a logarithm of the state", "ukf")]
BUILT += [("the arcsine of a ratio", "iekf"), ("a division by the state", "imm")]


@cache
def plant(name, family):
    faults = {}
    if family == "imm":
        modes = [{}, {"R": [[1.0]]}]
        law = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5], "modes": modes}
        faults = {"jump": law}
    if family == "mkf":
        faults = {"actuator": {"success_rate": 0.9}}
    return fkgen.Spec.from_dict(equations.table(PLANTS[name][0], {}, family, faults=faults))


def record_of(name, spec, T=12):
    rng = np.random.default_rng(4)
    u = PLANTS[name][1] + 0.01 * rng.normal(size=(T, 1))
    y, told = draw_record(spec, {}, u, rng, scale=0.2)
    y[rng.random(y.shape) < 0.2] = np.nan
    return Record(y=y, u=u, parameters=told, P0=spec.model.P0.values())


@needs_compiler()
@pytest.mark.parametrize(("name", "family"), BUILT)
def test_a_plant_with_a_domain_is_built_and_right_within_it(name, family):
    spec = plant(name, family)
    record = record_of(name, spec)
    found = built(spec).run(record.y, record.u)
    assert (found.status >= 0).all()
    form = FORMS[family]
    expected = form.expected(spec, record)
    for port, value in expected.items():
        error = distance(found[port][: len(value)], value)
        assert error <= form.tolerance(spec, record), port
    trials = fkgen.simulate(spec, 2, 12, 1, u=record.u if name == "a tank" else record.u * 0 + 1)
    assert np.isfinite(trials.y).all()


@pytest.mark.parametrize("family", FORMS)
@pytest.mark.parametrize("name", ["a tank", "a logarithm of an input", "a root of an input"])
def test_the_whole_record_of_a_proof_has_values_and_its_inputs_do_something(name, family):
    spec = plant(name, family)
    found = record_for(spec, [FORMS[family]])
    assert not found.is_cut
    assert np.isfinite(found.whole.y).sum() >= 2
    assert np.ptp(found.whole.u) > 1e-3
    assert not np.array_equal(found.whole.u, trial(spec, PLAIN)[0].u)


@pytest.mark.parametrize("family", FORMS)
@pytest.mark.parametrize("port", ["filtered_state", "filtered_covariance", "predicted_state"])
def test_a_mistake_is_found_with_gentle_records_too(port, family):
    whole = recursion(plant("a tank", family))
    phase = "predict" if port == "predicted_state" else "update"
    if family == "imm" and phase == "predict":
        port = "mode_state"
    assert refusals(rewritten(whole, port, lambda _, v, __: 1.000001 * v, phase=phase))


@pytest.mark.parametrize("family", ["ekf", "mkf"])
def test_a_wrong_derivative_by_the_input_is_found_where_inputs_are_small(family, monkeypatch):
    original = plants.lift_equations

    def lift(*given):
        found = original(*given)
        moved = found.moved + 1e-3 * (found.u if family == "ekf" else 0.0)
        return dataclasses.replace(found, moved=moved, B=1.001 * found.B)

    monkeypatch.setattr(plants, "lift_equations", lift)
    assert refusals(recursion(plant("a tank", family)))


def emptied(by, family="ekf", **other):
    """The level sinks by the same at every sample, and its root is seen."""
    model = ONE | {"Q": [[1e-8]], "R": [[1e-4]], "P0": [[1e-6]], "x0": [1.0]}
    model |= {"f": {"a": f"a - {by}"}, "h": {"y": "sqrt(a) + 0*u"}} | other
    return fkgen.Spec.from_dict(equations.table(model, {}, family))


@pytest.mark.parametrize("family", ["ekf", "iekf", "ukf"])
def test_what_leaves_its_domain_is_proved_up_to_there_and_refused_there(family):
    claims = {each.claim: each for each in proved(recursion(emptied(0.22, family))).claims}
    end = claims["the sample at which equations have no value is refused, none before it"]
    assert (end.error, end.source) == (0.0, "5 samples from x0 on")
    mutant = rewritten(recursion(emptied(0.22, family)), "filtered_st", lambda _, v, __: 1.001 * v)
    assert refusals(mutant)


@pytest.mark.parametrize("family", ["ekf", "ukf"])
def test_what_leaves_its_domain_at_once_is_refused_with_the_expression(family):
    with pytest.raises(SpecError) as caught:
        fkgen.validate(emptied(0.6, family))
    assert caught.value.key == "model.h.y"
    assert "sqrt(a) + 0*u" in caught.value.given
    assert "within 3 samples (a = -0." in caught.value.given
    assert "max(...)" in caught.value.expected
    assert "\n" not in str(caught.value)


def test_points_that_lie_out_of_the_domain_are_named_too():
    with pytest.raises(SpecError) as caught:
        fkgen.validate(emptied(0.0, "ukf", P0=[[4.0]], R=[[4.0]]))
    assert "within 1 samples (a = -1" in caught.value.given
    assert "a smaller P0" in caught.value.expected


def test_modes_are_named_by_their_own_equations():
    modes = [{}, {"f": {"a": "a - 0.6"}}]
    law = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5], "modes": modes}
    model = ONE | {"Q": [[1e-8]], "R": [[100.0]], "P0": [[1e-6]], "x0": [1.0]}
    model |= {"f": {"a": "a - 0.01*sqrt(a)"}, "h": {"y": "a"}}
    modes[1]["f"]["a"] = "a - 0.6*sqrt(a - 0.5)"
    table = equations.table(model, {}, "imm", faults={"jump": law})
    with pytest.raises(SpecError) as caught:
        fkgen.validate(fkgen.Spec.from_dict(table))
    assert caught.value.key == "faults.jump.modes[1].f.a"


@needs_compiler()
def test_the_compiled_code_is_tried_with_measurements_of_the_whole_trial():
    y = agreement.trial(plant("a tank", "ekf")).y
    assert np.isfinite(y).sum() > 30


DECIDED = {
    "a comparison": "if(log(a) > 0, a, a + 1e-9)",
    "the larger one": "a + 1e-9*max(log(a), -50)",
    "a sign": "a + 1e-9*sign(log(a))",
    "a place in a table": "a + 1e-9*interp(log(a), 'curve')",
}


@pytest.mark.parametrize("name", DECIDED)
def test_the_oracle_of_iekf_takes_no_step_to_where_h_decides_by_what_has_no_value(name):
    model = ONE | {"P0": [[10.0]], "R": [[0.1]], "x0": [1.0], "f": {}, "h": {"y": DECIDED[name]}}
    curve = {"curve": {"x": [0.0, 1.0], "y": [0.0, 1.0]}}
    spec = fkgen.Spec.from_dict(equations.table(model, {}, "iekf", tables=curve))
    one = np.zeros((1, 1))
    record = Record(y=one - 3.0, u=one, parameters={}, P0=one + 10.0)
    found = nonlinear.ITERATED.expected(spec, record)
    assert found["filtered_state"][0, 0] == 1.0
    assert found["stayed"].tolist() == [1.0]
    inside = nonlinear.ITERATED.expected(spec, dataclasses.replace(record, y=one + 3.0))
    assert inside["filtered_state"][0, 0] == pytest.approx(1.0 + 2.0 * 10.0 / 10.1, abs=1e-6)
