"""Claims about filters that linearise: those of linear families where the plant is linear."""

from __future__ import annotations

import equations
import imm_plants
import numpy as np
import pytest
from nonlinear_plants import robot_f, robot_h, system
from plants import SENSED, independent, motor
from sensor_specs import PROBLEMS, SWITCHING, VARYING, sensed, shaken

import fkgen
from fkgen.oracle.claims import gaussian, nonlinear, sensor
from fkgen.oracle.claims.claim import Record
from fkgen.oracle.sampled import draw_record
from fkgen.oracle.textbook.nonlinear import Extended, Iterated, Unscented
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
        spec = sensed(VARYING, PROBLEMS["4"], parameters={"dt": 0.1, "angle": 0.7}, **SWITCHING[name])
        one_step = SWITCHING[name]["family"] == "one_step"
        forms = (sensor.ONE_STEP, nonlinear.LINEARISED_ONE_STEP)
        return spec, *(forms if one_step else (sensor.IMM, nonlinear.LINEARISED_IMM))
    model = SENSED | {"B": [[0.02, 0.01], [0.0, 0.03]], "D": [[0.0, 0.5], [1.0, 0.0]]}
    rates = {"hypotheses": [[0.2, 0.9], [0.6, 0.5]], "actuator": {"dependence": "independent"}}
    return {
        "mkf": (motor(model=model, actuator=independent([0.7, 0.4])), gaussian.BATCH, nonlinear.EXTENDED),
        "gated": (motor(gate=0.8), gaussian.BATCH, nonlinear.EXTENDED),
        "genie": (
            sensed(VARYING, {"noise_factor": 7.0, "rows": [1]}, family="genie",
                   parameters={"dt": 0.1, "angle": 0.7}),
            gaussian.BATCH, nonlinear.EXTENDED,
        ),
        "mme": (motor("mme"), gaussian.MME_TEXTBOOK, nonlinear.LINEARISED_BANK),
        "mme2": (motor("mme", model, **rates), gaussian.MME_TEXTBOOK, nonlinear.LINEARISED_BANK),
        "modes": (imm_plants.plant("everything"), sensor.IMM, nonlinear.LINEARISED_IMM),
    }[name]  # fmt: skip


@pytest.mark.parametrize("name", [*SWITCHING, "mkf", "gated", "genie", "mme", "mme2", "modes"])
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
