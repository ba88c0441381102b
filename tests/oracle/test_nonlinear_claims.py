"""Claims about filters that linearise: those of linear families where the plant is linear."""

from __future__ import annotations

from dataclasses import replace

import equations
import imm_plants
import numpy as np
import pytest
from nonlinear_plants import robot_f, robot_h, system
from plants import SENSED, independent, motor, random_model
from sensor_specs import PROBLEMS, SWITCHING, VARYING, sensed, shaken

from fkgen.families.one_step import OneStepOptions
from fkgen.oracle.claims import gaussian, nonlinear, sensor
from fkgen.oracle.claims.claim import Record
from fkgen.oracle.sampled import draw_record
from fkgen.oracle.textbook.nonlinear import Extended, Iterated, Unscented
from fkgen.oracle.textbook.nonlinear_modes import (
    Modes,
    sensor_modes,
    textbook_gpb1,
    textbook_interacting,
)
from fkgen.proof.validate import distance

T = 6


def record_of(spec, *, params=None, seed=1):
    """A record of the spec's own plant, with missing rows."""
    rng = np.random.default_rng(seed)
    params = {name: np.full(T, value) for name, value in spec.defaults.items()} | (params or {})
    stated = {item.name: params[item.name] for item in spec.stated_parameters}
    u = rng.normal(size=(T, spec.model.nu))
    y, told = draw_record(spec, stated, u, rng)
    y[1, 0], y[3] = np.nan, np.nan
    return Record(y=y, u=u, parameters=told, P0=spec.model.P0.values())


def linear(name):
    """A linear spec, the claim about it, and the same by functions."""
    if name in SWITCHING:
        spec = sensed(
            VARYING, PROBLEMS["4"], parameters={"dt": 0.1, "angle": 0.7}, **SWITCHING[name]
        )
        one_step = SWITCHING[name]["family"] == "one_step"
        forms = (sensor.ONE_STEP, nonlinear.LINEARISED_ONE_STEP)
        return spec, *(forms if one_step else (sensor.IMM, nonlinear.LINEARISED_IMM))
    model = SENSED | {"B": [[0.02, 0.01], [0.0, 0.03]], "D": [[0.0, 0.5], [1.0, 0.0]]}
    rates = {"hypotheses": [[0.2, 0.9], [0.6, 0.5]], "actuator": {"dependence": "independent"}}
    return {
        "mkf": (
            motor(model=model, actuator=independent([0.7, 0.4])),
            gaussian.BATCH, nonlinear.LINEARISED,
        ),
        "gated": (motor(gate=0.8), gaussian.BATCH, nonlinear.LINEARISED),
        "genie": (
            sensed(VARYING, {"noise_factor": 7.0, "rows": [1]}, family="genie",
                   parameters={"dt": 0.1, "angle": 0.7}),
            gaussian.BATCH, nonlinear.LINEARISED,
        ),
        "mme": (motor("mme"), gaussian.MME_TEXTBOOK, nonlinear.LINEARISED_BANK),
        "mme2": (motor("mme", model, **rates), gaussian.MME_TEXTBOOK, nonlinear.LINEARISED_BANK),
        "unequal": (
            imm_plants.jumping(random_model(3, 2, 2, 1, direct=True), [{}, {"states": ["x1"]}],
                               transition=[[0.7, 0.3], [0.4, 0.6]], initial=[0.5, 0.5]),
            sensor.IMM, nonlinear.LINEARISED_IMM,
        ),
        "modes": (imm_plants.plant("everything"), sensor.IMM, nonlinear.LINEARISED_IMM),
    }[name]  # fmt: skip


@pytest.mark.parametrize(
    "name", [*SWITCHING, "mkf", "gated", "genie", "mme", "mme2", "modes", "unequal"]
)
def test_of_a_linear_plant_the_claims_are_those_of_its_family(name, monkeypatch):
    spec, form, other = linear(name)
    params = shaken(T) if "angle" in spec.defaults else None
    record = record_of(spec, params=params)
    assert other.expected(spec, record) is None
    expected = form.expected(spec, record)
    monkeypatch.setattr(nonlinear, "is_nonlinear", lambda _: True)
    found = other.expected(spec, record)
    assert found.keys() >= expected.keys() - {"log_likelihood"}
    for port in expected.keys() & found.keys():
        assert distance(found[port], expected[port]) < 1e-9, port
    assert other.tolerance(spec, record) < 1e-4


def robot(**given):
    plant = {
        "noises": [{"name": "w_turn", "variance": 0.04}],
        "Q": np.diag([1e-4, 2e-4, 0.0]).tolist(),
    }
    return equations.read(equations.ROBOT | plant | given.pop("model", {}), **given)


def by_hand(spec, record):
    """The robot written in Python."""
    return system(
        robot_f, robot_h, ("line", "line", "circle"), T, R=spec.model.R.values(),
        Q=spec.model.Q.values(), W=[0.04], wraps=np.array([False, True]), nu=2,
        x0=np.array([3.0, 4.0, 0.1]), P0=record.P0, parameters={"dt": 0.1},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("form", "filter_of"),
    [
        (nonlinear.EXTENDED, Extended),
        (nonlinear.ITERATED, Iterated),
        (nonlinear.UNSCENTED, Unscented),
    ],
)
def test_of_equations_they_are_the_filter_of_the_same_functions(form, filter_of):
    spec = robot()
    record = record_of(spec)
    found = form.expected(spec, record)
    expected = filter_of(system=by_hand(spec, record)).run(record.y, record.u)
    assert {"filtered_state", "predicted_covariance", "nis", "log_likelihood"} <= found.keys()
    assert {"doubt", "decided"}.isdisjoint(found)
    for port, value in found.items():
        np.testing.assert_allclose(value, expected[port][: len(value)], rtol=1e-9, atol=1e-12)
    assert form.tolerance(spec, record) < 1e-6


def test_claims_about_matrices_say_nothing_of_equations():
    spec = robot()
    record = record_of(spec)
    forms = [gaussian.BATCH, gaussian.RICCATI, gaussian.OPTIMAL_GAIN, gaussian.MME_TEXTBOOK]
    forms += [gaussian.MME_BATCH, sensor.IMM, sensor.ONE_STEP, sensor.ENUMERATION]
    assert [form.expected(spec, record) for form in forms] == [None] * len(forms)


SENSOR = {
    "sensor": {"problem": 1, "gamma_rate": 0.8, "delta_nominal_rate": 0.9, "noise_factor": 20.0}
}


def test_a_record_of_failing_rows_is_noise_where_there_is_no_signal():
    law = {
        "sensor": {"problem": 1, "gamma_rate": 0.0, "delta_nominal_rate": 1.0, "noise_factor": 2.0}
    }
    spec = robot(faults=law)
    y, _ = draw_record(
        spec, {"dt": np.full(300, 0.1)}, np.zeros((300, 2)), np.random.default_rng(3)
    )
    np.testing.assert_allclose(y.std(axis=0), [0.1, 0.02], rtol=0.2)
    np.testing.assert_allclose(y.mean(axis=0), 0.0, atol=0.03)


def test_modes_of_equations_have_their_own_functions_and_noises():
    """A mode that turns twice as fast, told apart by the record."""
    twice = {"f": {"heading": "heading + 2*(turn + w_turn)*dt"}, "R": [[0.02, 0.0], [0.0, 0.001]]}
    jump = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5], "modes": [{}, twice]}
    spec = robot(faults={"jump": jump})
    record = record_of(spec)
    found = nonlinear.LINEARISED_IMM.expected(spec, record)
    hand = by_hand(spec, record)

    def f(x, u, w, p):
        return [*robot_f(x, u, w, p)[:2], x[2] + 2.0 * (u[1] + w[0]) * p["dt"]]

    other = replace(hand, f=f, R=np.tile(np.diag([0.02, 0.001]), (T, 1, 1)))
    modes = Modes.of([hand, other], np.tile(jump["transition"], (T, 1, 1)), np.array([0.5, 0.5]))
    expected = textbook_interacting(modes, record.y, record.u)
    for port, value in found.items():
        np.testing.assert_allclose(value, expected[port], rtol=1e-9, atol=1e-12, err_msg=port)


@pytest.mark.parametrize("form", [nonlinear.LINEARISED_IMM, nonlinear.LINEARISED_ONE_STEP])
def test_conditions_of_a_sensor_are_those_of_the_law(form):
    spec = robot(faults=SENSOR)
    if form is nonlinear.LINEARISED_ONE_STEP:
        spec = replace(spec, filter=replace(spec.filter, options=OneStepOptions()))
    record = record_of(spec)
    found = form.expected(spec, record)
    law = sensor.law_of(spec, record)
    run = textbook_gpb1 if form is nonlinear.LINEARISED_ONE_STEP else textbook_interacting
    expected = run(sensor_modes(by_hand(spec, record), law), record.y, record.u)
    for port, value in found.items():
        np.testing.assert_allclose(value, expected[port], rtol=1e-9, atol=1e-12, err_msg=port)
