"""Specs with equations that no example has, records of them, and the filters in NumPy."""

from __future__ import annotations

import equations
import numpy as np
from plants import covariance

import fkgen
from fkgen.oracle.plants.equations import system_of
from fkgen.oracle.plants.nonlinear import simulate_nonlinear
from fkgen.oracle.textbook.nonlinear import Extended, Iterated, Unscented

FILTERS = {"ekf": Extended, "iekf": Iterated, "ukf": Unscented}
WORLD = {"g": [0.3, -0.2, 9.8], "m": [0.5, 0.1, -0.8]}


def signals(*names):
    return [{"name": name} for name in names]


def polynomial(rng):
    """Three states that feed each other by squares and products; rows that share their noise."""
    a = rng.uniform(-0.3, 0.3, 6)
    return {
        "states": signals("a", "b", "c"),
        "inputs": signals("u"),
        "outputs": signals("p", "r", "s"),
        "noises": [{"name": "w", "variance": "0.02*k"}],
        "Q": covariance(rng, 3) * 0.05,
        "R": covariance(rng, 3) * 0.3,
        "x0": rng.normal(size=3),
        "P0": covariance(rng, 3) * 0.3,
        "f": {
            "a": f"0.8*a + {a[0]:.3f}*b*c*k + u + w*(1 + 0.3*b)",
            "b": f"0.7*b + {a[1]:.3f}*a**2 - {a[2]:.3f}*c",
            "c": f"0.6*c + {a[3]:.3f}*(a + b)*u",
        },
        "h": {
            "p": f"a + 0.2*b**2 + {a[4]:.3f}*u*c",
            "r": "b*(1 + 0.1*a) - c",
            "s": f"c + {a[5]:.3f}*a**3",
        },
    }, {"k": 0.9}


def circle(rng):
    """Two angles that wrap, seen by their sum and by a length; noises turn and stretch."""
    return {
        "states": [{"name": "phi", "wrap": True}, {"name": "psi", "wrap": True}, {"name": "l"}],
        "outputs": [{"name": "sum", "wrap": True}, {"name": "far"}],
        "noises": [{"name": "w", "variance": 0.04}, {"name": "v", "variance": "0.01*dt"}],
        "R": [[0.05, 0.01], [0.01, 0.1]],
        "x0": [3.0, rng.uniform(-3.0, 3.0), 2.0],
        "P0": covariance(rng, 3) * 0.1,
        "let": {"turn": "(1.2 + w)*dt", "s": "sin(phi - psi)"},
        "f": {
            "phi": "phi + turn + 0.2*s", "psi": "psi - turn*0.7 - 0.1*s*l", "l": "l*exp(v) + 0.1*s",
        },
        "h": {"sum": "phi + psi + 0.1*l", "far": "hypot(l*cos(phi), 1 + sin(psi))"},
    }, {"dt": 0.7}  # fmt: skip


def pendulum(rng):
    """In continuous time, Runge and Kutta twice a sample, with noise of a rate and of the state."""
    return {
        "time": "continuous",
        "substeps": 2,
        "sample_time": "dt",
        "states": [{"name": "phi", "unit": "rad", "wrap": True}, {"name": "rate"}],
        "inputs": signals("torque"),
        "outputs": signals("height"),
        "noises": [{"name": "push", "variance": 0.05}],
        "Q": [[1e-3, 0.0], [0.0, 2e-3]],
        "R": [[0.02]],
        "x0": [2.8, rng.uniform(-0.5, 0.5)],
        "P0": [[0.1, 0.02], [0.02, 0.2]],
        "f": {
            "phi": "rate",
            "rate": "-4*sin(phi) - 0.2*rate*abs(rate) + torque + push*(1 + phi**2)",
        },
        "h": {"height": "cos(phi) + 0.1*rate"},
    }, {"dt": 0.1}  # fmt: skip


def attitude(rng):
    """Attitude and bias, gravity and a field in body axes; noise of the rates, and of the bias."""
    return equations.ATTITUDE | {
        "outputs": signals("ax", "ay", "az", "mx", "my", "mz"),
        "noises": [{"name": f"n{i}", "variance": 2e-3} for i in "xyz"],
        "Q": np.diag([1e-3, 2e-3, 1e-3, 1e-4, 2e-4, 1e-4]),
        "R": covariance(rng, 6) * 0.3,
        "x0": [0.8, 0.36, -0.48, 0.0, 0.1, -0.1, 0.05],
        "P0": covariance(rng, 6) * 0.1,
        "let": {
            "rate": "([gx + nx, gy + ny*0.5, gz + nz] - [bx, by, bz])*dt",
            "a": "rotate_back(q, g)",
            "b": "rotate_back(q, m)",
        },
        "f": {"q": "q * rate", "bx": "0.9*bx + 0.1*nx"},
        "h": {
            f"{of}{i}": f"{seen}[{k}]"
            for of, seen in (("a", "a"), ("m", "b")) for k, i in enumerate("xyz")
        },
    }, {"dt": 0.3, **WORLD}  # fmt: skip


def turning(rng):
    """The same in continuous time, where f is a body rate that depends on the attitude itself."""
    model, parameters = attitude(rng)
    return model | {
        "time": "continuous",
        "sample_time": "dt",
        "let": {"a": "rotate_back(q, g)", "b": "rotate_back(q, m)"},
        "f": {"q": "[gx + nx, gy + ny + 0.02*a[0], gz + nz] - [bx, by, bz]", "bx": "-bx + nx"},
    }, parameters


CASES = {each.__name__: each for each in (polynomial, circle, pendulum, attitude, turning)}


def spec_of(case, family="ekf", *, seed=1, code=None, model=None, **options):
    found, parameters = CASES[case](np.random.default_rng(seed))
    plain = {
        k: np.asarray(v).tolist() if k in {"Q", "R", "P0", "x0"} else v for k, v in found.items()
    }
    table = equations.table(plain | (model or {}), parameters, family, code=code or {})
    table["filter"] |= options
    return fkgen.Spec.from_dict(table)


def record_of(spec, T=12, *, seed=2, missing=0.2):
    """A record of the plant itself with gaps: y, u, parameters that change."""
    rng = np.random.default_rng(seed)
    params = {name: value * rng.uniform(0.8, 1.2, T) for name, value in spec.defaults.items()}
    u = 0.3 * rng.normal(size=(T, spec.model.nu))
    y, _ = simulate_nonlinear(system_of(spec, T, params), u, rng)
    y[rng.random(y.shape) < missing] = np.nan
    y[4:5] = np.nan
    return y, u, params


def in_numpy(spec, y, u, params):
    """The ports of the filter that the oracle writes as matrices, points or steps."""
    options = spec.filter.options
    given = {
        name: getattr(options, name) for name in ("iterations", "kappa") if hasattr(options, name)
    }
    system = system_of(spec, len(y), params)
    return FILTERS[spec.filter.family](system=system, **given).run(y, u)
