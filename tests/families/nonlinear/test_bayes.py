"""Compiled filters of nonlinear plants against Bayes' rule by brute force, on grids."""

from __future__ import annotations

import equations
import grids
import numpy as np
import pytest
from grids import Mode, Plant
from plants import built
from toolchain import needs_compiler

import fkgen

pytestmark = needs_compiler()

SAMPLES = 8
LAW = np.array([[0.8, 0.2], [0.3, 0.7]])
INITIAL = np.array([0.6, 0.4])
#: Deviations of the state: small beside the radius at which f and h bend, which is about 1.
COARSE, FINE = 0.06, 0.03
E2 = np.eye(2)


def named(states, outputs):
    names = {"states": states, "outputs": outputs}
    return {key: [{"name": each} for each in of] for key, of in names.items()}


def spec(model, plant, family, **faults):
    shown = {"x0": plant.x0.tolist(), "P0": plant.P0.tolist()}
    shown |= {letter: getattr(plant.modes[0], letter).tolist() for letter in "QR"}
    return fkgen.Spec.from_dict(equations.table(model | shown, {}, family, faults=faults))


def one(s):
    """One state, seen by an exponential."""
    mode = Mode(
        f=lambda x: x + 0.3 * np.sin(x), h=lambda x: np.exp(0.4 * x),
        Q=np.array([[0.3 * s**2]]), R=np.array([[0.2 * s**2]]),
    )  # fmt: skip
    text = {"f": {"a": "a + 0.3*sin(a)"}, "h": {"y": "exp(0.4*a)"}}
    plant = Plant([mode], np.array([1.0]), np.array([[s**2]]))
    return named("a", "y") | text, plant


def two(s):
    """Two states, seen by range and bearing."""
    mode = Mode(
        f=lambda x: np.stack([x[:, 0] * np.cos(0.2 * x[:, 1]), x[:, 1] + 0.2 * x[:, 0] ** 2], 1),
        h=lambda x: np.stack([np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0])], 1),
        Q=s**2 * (0.4 * E2 + 0.1), R=s**2 * np.diag([0.5, 0.4]),
    )  # fmt: skip
    text = {
        "f": {"a": "a*cos(0.2*b)", "b": "b + 0.2*a**2"},
        "h": {"r": "hypot(a, b)", "t": "atan2(b, a)"},
    }
    plant = Plant([mode], np.array([1.5, 0.7]), s**2 * (0.8 * E2 + 0.2))
    return named("ab", "rt") | text, plant


def drawn(plant, seed=5):
    """A record along a path of the first mode and, from the middle on, the last one."""
    rng = np.random.default_rng(seed)
    x, rows = plant.x0 + np.linalg.cholesky(plant.P0) @ rng.normal(size=len(plant.x0)), []
    for k in range(SAMPLES):
        mode = plant.modes[-1 if k >= SAMPLES // 2 else 0]
        rows.append(mode.h(x[None])[0] + np.linalg.cholesky(mode.R) @ rng.normal(size=len(mode.R)))
        x = mode.f(x[None])[0] + np.linalg.cholesky(mode.Q) @ rng.normal(size=len(x))
    y = np.array(rows)
    y[2] = np.nan
    y[5, 0] = np.nan
    return y


def errors(found, exact):
    """Of states in deviations, of covariances as shares of variances, of the others as they are."""
    result = {}
    for when in ("filtered", "predicted"):
        P = exact[f"{when}_covariance"]
        deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        apart = found[f"{when}_state"] - exact[f"{when}_state"]
        result[f"{when}_state"] = np.abs(apart / deviation).max()
        share = (found[f"{when}_covariance"] - P) / deviation[:, :, None] / deviation[:, None, :]
        result[f"{when}_covariance"] = np.abs(share).max()
    apart = found["log_likelihood"] - exact["log_likelihood"]
    result["log_likelihood"] = np.abs(apart[np.isfinite(exact["log_likelihood"])]).max()
    return result


@pytest.mark.parametrize("family", ["ekf", "iekf", "ukf"])
@pytest.mark.parametrize(("case", "points"), [(one, 301), (two, 45)])
def test_as_noises_shrink_a_filter_comes_to_the_posterior_on_a_grid(case, points, family):
    found = []
    for s in (COARSE, FINE):
        model, plant = case(s)
        y = drawn(plant)
        run = built(spec(model, plant, family)).run(y)
        found.append(errors(run, grids.bayes(plant, y, points)))
    for port, coarse in found[0].items():
        # What bends over a deviation is of the size of the deviations, and errs by its share.
        assert found[1][port] < 2.0 * FINE, port
        assert found[1][port] < 0.65 * coarse + 1e-6, port


def jumping(s):
    """Modes that move apart by a deviation and have different noise: little is seen of each."""

    def mode(shift, noise):
        return Mode(
            f=lambda x: x + 0.3 * np.sin(x) + shift, h=lambda x: np.exp(0.4 * x),
            Q=np.array([[0.3 * s**2]]), R=np.array([[noise]]),
        )  # fmt: skip

    texts = [
        {"f": {"a": f"a + 0.3*sin(a) + {shift!r}"}, "R": [[noise]]}
        for shift, noise in ((0.0, 0.04), (s, 0.36))
    ]
    model = named("a", "y") | {"f": texts[0]["f"], "h": {"y": "exp(0.4*a)"}}
    modes = [mode(0.0, 0.04), mode(s, 0.36)]
    law = {"transition": LAW.tolist(), "initial": INITIAL.tolist(), "modes": texts}
    return model, Plant(modes, np.array([1.0]), np.array([[s**2]]), LAW, INITIAL), law


def test_as_noises_shrink_imm_comes_to_the_posterior_of_states_and_modes():
    found = []
    for s in (COARSE, FINE):
        model, plant, law = jumping(s)
        y = drawn(plant, seed=6)
        run = built(spec(model, plant, "imm", jump=law)).run(y)
        exact = grids.bayes(plant, y, 301)
        each = errors(run, exact)
        apart = run["mode_probability"] - exact["mode_probability"]
        each["mode_probability"] = np.abs(apart).max()
        assert np.ptp(exact["mode_probability"][:, 0]) > 0.3  # the record tells them apart
        found.append(each)
    for port, coarse in found[0].items():
        # Merging keeps two moments of a mode; the third is of the order of one, and comes back
        # into the covariance by the gain, which shrinks with P / R and not from here on alone.
        assert found[1][port] < 2.0 * FINE, port
        if "covariance" not in port:
            assert found[1][port] < 0.65 * coarse + 1e-6, port
