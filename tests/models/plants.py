"""Plants that several tests filter: random ones by seed, the DC motor, records, distances."""

from __future__ import annotations

from copy import deepcopy
from functools import cache

import numpy as np

import fkgen
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.symbolic.interpreter import Interpreter

MOTOR = {
    "A": [[0.9802, -0.0002], [0.0094, 0.9048]],
    "B": [[0.0198], [0.0001]],
    "C": [[0.0, 1.0]],
    "Q": [[1e-4, 0.0], [0.0, 1e-4]],
    "R": [[5e-6]],
    "x0": [0.0, 0.0],
    "P0": [[1.0, 0.5], [0.5, 1.0]],
}

#: The motor with its voltage measured after the fault: (29) of the paper.
SENSED = MOTOR | {
    "C": [[0.0, 1.0], [0.0, 0.0]],
    "D": [[0.0], [1.0]],
    "R": [[5e-6, 0.0], [0.0, 1e-2]],
}
RATES = (0.1, 0.3, 0.5, 0.7, 0.9)

#: x[k+1] depends on the step dt, y on a bearing; variances grow with time and range.
VARYING = {
    "A": [["exp(-dt/0.5)", "dt"], [0.0, "1 - 0.1*dt**2"]],
    "B": [["dt**2/2"], ["dt"]],
    "C": [["cos(angle)", "sin(angle)"], [1.0, "abs(angle) - 0.5"]],
    "D": [[0.0], ["tan(0.3*angle)"]],
    "Q": [["0.5*dt", "0.1*dt"], ["0.1*dt", "0.2*dt"]],
    "R": [["0.1 + 0.2*sqrt(dt)", "0.02*dt"], ["0.02*dt", "log(2 + dt)"]],
    "x0": [1.0, -1.0],
    "P0": [[2.0, 0.3], [0.3, 1.0]],
}
PARAMETERS = {"dt": 0.1, "angle": 0.7}


def table(model, *, family="kf", name="plant", **sections):
    """A spec as a nested dict; sections and filter options by keyword."""
    faults = {key: sections.pop(key) for key in ("actuator", "sensor", "soft") if key in sections}
    result = {
        "name": name,
        "model": deepcopy(model),
        "parameters": sections.pop("parameters", {}),
        "code": sections.pop("code", {}),
        "filter": {"family": family, **sections},
    }
    if faults:
        result["faults"] = faults
    return result


def spec(model, **sections):
    return fkgen.Spec.from_dict(table(model, **sections))


def common(rate):
    return {"success_rate": rate, "dependence": "common"}


def independent(rate):
    return {"success_rate": rate, "dependence": "independent"}


def motor(family="mkf", model=None, **sections):
    """The DC motor with a success rate of 0.7, or with the paper's five hypotheses."""
    if family == "mkf":
        sections = {"actuator": common(0.7)} | sections
    if family == "mme":
        sections = {"actuator": {"dependence": "common"}, "hypotheses": list(RATES)} | sections
    default = SENSED if family == "mme" else MOTOR
    return spec(default if model is None else model, family=family, **sections)


def covariance(rng, n, *, smallest=0.2):
    """A well-conditioned covariance without zeros."""
    root = rng.standard_normal((n, n)) / np.sqrt(n)
    return root @ root.T + smallest * np.eye(n)


def random_model(seed, n, p, q=0, *, direct=False, correlated=False):
    """A dense, stable plant; ``direct``: D != 0, ``correlated``: R is not diagonal."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    model = {
        "A": 0.95 * A / np.abs(np.linalg.eigvals(A)).max(),
        "C": rng.standard_normal((p, n)),
        "Q": covariance(rng, n),
        "R": covariance(rng, p) if correlated else np.diag(rng.uniform(0.2, 2.0, p)),
        "x0": rng.standard_normal(n),
        "P0": covariance(rng, n),
    }
    if q:
        model["B"] = rng.standard_normal((n, q))
    if direct:
        model["D"] = rng.standard_normal((p, q))
    return {key: value.tolist() for key, value in model.items()}


def system_of(spec, T, params=None, rates=None):
    return LinearSystem.from_spec(spec, T, params, rates)


def record(spec, T, *, seed=1, missing=0.0, params=None, rates=None, u=None):
    """A random input and what the plant answers: (y, u), u of shape (T, q)."""
    rng = np.random.default_rng(seed)
    if u is None:
        u = rng.standard_normal((T, spec.model.nu))
    if rates is None and spec.first_rates is not None:
        rates = spec.filter.options.hypotheses[-1]
    y = simulate(system_of(spec, T, params, rates), u, rng, missing=missing)
    return y, u


@cache
def built(spec):
    """The compiled filter of a spec, loaded once per process; use `run`, not `step`, on it."""
    return fkgen.build(spec)


@cache
def generated(spec):
    return fkgen.generate(fkgen.validate(spec))


def run(spec, y, u=None, params=None, **options):
    return built(spec).run(y, u if spec.model.nu else None, params, **options)


def interpreted(spec, y, u, params=None):
    """Ports by name from the CasADi interpreter of the recursion that C is generated from."""
    from fkgen.families import family

    recursion = family(spec.filter.family).build(spec)
    given = {**spec.defaults, **(params or {})}
    wide = {name: np.broadcast_to(value, (len(y),)) for name, value in given.items()}
    return Interpreter(recursion).run(np.asarray(y, float), np.asarray(u, float), wide)


def distance(actual, expected):
    """Largest error of an entry, relative to the largest value that the port has in the record."""
    actual, expected = np.asarray(actual, float), np.asarray(expected, float)
    assert actual.shape == expected.shape
    np.testing.assert_array_equal(np.isnan(actual), np.isnan(expected))
    if np.isnan(expected).all():
        return 0.0
    return float(np.nanmax(np.abs(actual - expected)) / max(np.nanmax(np.abs(expected)), 1e-300))


def assert_agree(run, expected, ports, tolerance):
    """All ports of ``expected`` (attributes) are those of a run."""
    errors = {name: distance(run[name], getattr(expected, name)) for name in ports}
    wrong = {name: error for name, error in errors.items() if not error <= tolerance}
    assert not wrong
