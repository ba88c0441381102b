"""Factored covariances: what float keeps against 60 digits, and what the ports say of factors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from digits import exact, kalman, shortfall, unscented, windows
from plants import built

import fkgen
from fkgen.errors import SpecError

#: What is promised of float: standard deviations, C P C' and S, and states in deviations.
PROMISED = {"deviation": 1e-3, "seen": 1e-3, "variance": 1e-3, "state": 5e-3}
#: Of states that no row sees but in a sum.
VAGUE = 1e-1


def stored(values):
    """Numbers that float holds: both filters are given the same."""
    return np.asarray(values, np.float32).astype(float)


def spec(model, family="kf", update="auto", scalar="float", **rest):
    code = {"scalar": scalar, "update": update}
    filter_ = {"family": family, **rest.pop("filter", {})}
    return fkgen.Spec.from_dict(
        {"name": "held", "model": model, "filter": filter_, "code": code, **rest}
    )


def drawn(model, samples, missing, seed=1):
    """A record from the model, some rows missing, and the model in numbers that float holds."""
    rng, held = np.random.default_rng(seed), {k: stored(v).tolist() for k, v in model.items()}
    A, C, Q, R = (np.array(held[name]) for name in "ACQR")
    values, vectors = np.linalg.eigh(Q)
    through = vectors * np.sqrt(values.clip(0.0))
    x, y, measured = rng.normal(size=len(A)), [], np.linalg.cholesky(R)
    for _ in range(samples):
        y.append(C @ x + measured @ rng.normal(size=len(C)))
        x = A @ x + through @ rng.normal(size=len(A))
    y = stored(y)
    y[rng.random(y.shape) < missing] = np.nan
    return held, y


def laser():
    """A position known to 1e-3 whose prior is 1e3: P0 / R = 1e12."""
    return {
        "A": [[0.99, 0.125], [0.0, 0.9]],
        "C": [[1.0, 0.0]],
        "Q": [[1e-7, 1e-6], [1e-6, 2e-5]],
        "R": [[1e-6]],
        "x0": [0.0, 0.0],
        "P0": [[1e6, 0.0], [0.0, 1e6]],
    }


def dense(ratio, n=3, p=2, seed=7):
    """Every entry there, noises of rows correlated."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= 0.97 / np.abs(np.linalg.eigvals(A)).max()
    Q, R = (
        L @ L.T / len(L) + 0.1 * np.eye(len(L))
        for L in map(rng.normal, *zip(*[(0, 1, (n, n)), (0, 1, (p, p))], strict=True))
    )
    return {
        "A": A,
        "C": rng.normal(size=(p, n)),
        "Q": 0.1 * Q,
        "R": R,
        "x0": np.zeros(n),
        "P0": ratio * np.eye(n),
    }


def seasons(prior):
    """A trend with seasons: seven states, of which a row sees one sum."""
    A, C = np.zeros((7, 7)), np.zeros((1, 7))
    A[0, 0] = A[0, 1] = A[1, 1] = C[0, 0] = C[0, 2] = 1.0
    A[2, 2:] = -1.0
    A[range(3, 7), range(2, 6)] = 1.0
    Q = np.diag([1e-2, 1e-4, 1e-3, 0.0, 0.0, 0.0, 0.0])
    return {"A": A, "C": C, "Q": Q, "R": [[0.5]], "x0": np.zeros(7), "P0": prior * np.eye(7)}


RECORDS = {
    "laser": ("kf", laser(), 20_000, 0.4),
    "dense": ("kf", dense(1.7e6), 2000, 0.3),
    "dense, wide": ("kf", dense(1e11), 500, 0.3),
    "dense, steps": ("iekf", dense(1e8), 300, 0.3),
    "dense, points": ("ukf", dense(1e8), 300, 0.2),
    "seasons": ("kf", seasons(1e10), 300, 0.1),
}


@pytest.mark.parametrize("name", list(RECORDS))
def test_float_keeps_what_is_promised_of_it(name):
    family, *record = RECORDS[name]
    model, y = drawn(*record)
    run = built(spec(model, family)).run(y)
    found = shortfall(run, kalman(model, y), np.array(model["C"]))
    assert found["refused"] == 0
    assert found["least"] > 0.0
    promised = PROMISED | ({"state": VAGUE} if name == "seasons" else {})
    assert {key: found[key] for key in promised if not found[key] < promised[key]} == {}


def chain(ratio):
    """Position, velocity and acceleration, of which two rows see the first and the last."""
    return {
        "A": [[1.0, 0.125, 0.0], [0.0, 1.0, 0.125], [0.0, 0.0, 0.95]],
        "C": [[1.0, 0.0, 0.0], [1.0, 0.0, 1.0]],
        "Q": np.diag([1e-4, 1e-3, 1e-2]),
        "R": np.diag([1.0, 4.0]),
        "x0": np.zeros(3),
        "P0": ratio * np.eye(3),
    }


@pytest.mark.parametrize(
    ("family", "ratio", "host"),
    [("dfcf", 1e12, [0]), ("compression_full", 1e10, [1]), ("compression_full", 1e10, [])],
)
def test_float_keeps_it_where_a_host_takes_over_at_the_end_of_windows(family, ratio, host):
    model, y = drawn(chain(ratio), 2000, 0.2)
    soft = {"host": host, "window": 20, "false_alarm": 0.05}
    plant = spec(model, family, faults={"soft": soft}, filter={"test": False})
    run = built(plant).run(y)
    found = shortfall(run, windows(model, y, soft["host"], 20), np.array(model["C"]))
    assert found["refused"] == 0
    assert found["least"] > 0.0
    assert {key: found[key] for key in PROMISED if not found[key] < PROMISED[key]} == {}


def curved(bent, seen):
    """The chain with squares in f and h of these shares; f and h of arrays of objects."""
    names = {"states": ("a", "b", "c"), "outputs": ("p", "r")}
    model = {what: [{"name": each} for each in own] for what, own in names.items()}
    model |= {name: chain(1e8)[name] for name in ("Q", "x0", "P0")} | {
        "R": [[1.0, 0.25], [0.25, 4.0]]
    }
    model["f"] = {"a": f"a + 0.125*b - {bent}*a*a", "b": "b + 0.125*c", "c": "0.9375*c"}
    model["h"] = {"p": f"a + {seen}*a*a", "r": f"a + c + {seen}*b*c"}
    steps, one, bent, seen = (
        exact([0.125, 0.9375]),
        exact(1.0)[()],
        exact(bent)[()],
        exact(seen)[()],
    )

    def f(x):
        a, b, c = x
        return np.array([a + steps[0] * b - bent * a * a, b + steps[0] * c, steps[1] * c]) * one

    def h(x):
        a, b, c = x
        return np.array([a + seen * a * a, a + c + seen * b * c]) * one

    return model, f, h


@pytest.mark.parametrize(
    ("bent", "seen", "kappa"), [(0.0, 2.0**-20, 0), (2.0**-20, 2.0**-20, 1), (2.0**-20, 0.0, 0)]
)
def test_float_keeps_it_where_points_go_through_curves(bent, seen, kappa):
    model, f, h = curved(bent, seen)
    model |= {name: stored(model[name]).tolist() for name in ("Q", "R", "x0", "P0")}
    rng, x, y = np.random.default_rng(3), exact(np.zeros(3)), []
    for _ in range(300):
        y.append(h(x).astype(float) + rng.normal(size=2))
        x = f(x) + exact(rng.normal(size=3) * np.sqrt(np.diag(model["Q"])))
    y = stored(y)
    y[rng.random(y.shape) < 0.2] = np.nan
    run = built(spec(model, "ukf", filter={"kappa": float(kappa)})).run(y)
    found = shortfall(run, unscented(model, y, f, h, kappa), np.array(chain(1.0)["C"]))
    assert found["refused"] == 0
    assert found["least"] > 0.0
    assert {key: found[key] for key in PROMISED if not found[key] < PROMISED[key]} == {}


@pytest.mark.parametrize(
    "options", [{}, {"groups": [[1], [2]]}, {"missing": 0.3}], ids=["one", "two groups", "missing"]
)
def test_float_tests_as_many_degrees_of_freedom_as_double(options):
    """Speed seen at once, positions that wait: they tell of 1e-9 of the variance of the speed."""
    F, groups = np.array([[2.0**-5], [0.25]]), options.get("groups", [[1]])
    model = {
        "A": [[1.0, 0.25], [0.0, 1.0]],
        "C": [[0.0, 1.0], *([[1.0, 0.0]] * len(groups))],
        "Q": 16.0 * F @ F.T,
        "R": np.diag([0.01, *([100.0] * len(groups))]),
        "x0": np.zeros(2),
        "P0": np.diag([1.0, 0.01]),
    }
    model, y = drawn(model, 3000, options.get("missing", 0.0))
    y[np.arange(len(y)) % 5 > 0, 1:] = np.nan
    y[900:1200, 1] += 40.0
    soft = {"host": [0], "groups": groups, "window": 150, "false_alarm": 0.05}
    runs = {
        scalar: built(spec(model, "dfcf", scalar=scalar, faults={"soft": soft})).run(y)
        for scalar in ("double", "float")
    }
    for port in ("test_dof", "fault_declared", "status"):
        np.testing.assert_array_equal(runs["float"][port], runs["double"][port])
    assert (runs["float"].test_dof[150::150] == 2).mean() > 0.5  # 1 where samples are missing
    assert 1 <= runs["float"].fault_declared.sum() < 10 * len(groups)
    expected = runs["double"].test_statistic
    # The direction of the speed has 3e-5 of its deviation: what d is there is right to 2e-3.
    np.testing.assert_allclose(runs["float"].test_statistic, expected, rtol=1e-2, atol=1e-2)


def test_ports_are_what_the_factors_hold():
    model, y = drawn(dense(1e6, n=5, p=2), 400, 0.3)
    run = built(spec(model)).run(y)
    for of in ("filtered", "predicted"):
        packed, P = (run[f"{of}_{what}"].astype(float) for what in ("factors", "covariance"))
        rows, columns = np.tril_indices(5)
        U = np.zeros((len(y), 5, 5))
        U[:, columns, rows] = packed
        D = np.diagonal(U, axis1=1, axis2=2).copy()
        U[:, range(5), range(5)] = 1.0
        held = np.einsum("kij,kj,klj->kil", U, D, U)
        sd = np.sqrt(np.diagonal(held, axis1=1, axis2=2))
        unit = np.spacing((sd[:, :, None] * sd[:, None, :]).astype(np.float32))
        assert (np.abs(P - held) / unit).max() <= 2.0
        assert D.min() > 0.0


@pytest.mark.parametrize("scalar", ["float", "double"])
def test_a_semidefinite_prior_is_a_prior(scalar):
    model = dense(1.0)
    half = np.array([[2.0, 0.0], [1.0, 1.0], [-1.0, 0.5]])
    model |= {"P0": half @ half.T, "Q": np.diag([0.0, 0.0, 0.1])}
    model, y = drawn(model, 60, 0.3)
    filter_ = built(spec(model, update="ud", scalar=scalar))
    expected, tolerance = kalman(model, y), 1e-3 if scalar == "float" else 1e-12
    unchanged = filter_.run(y)
    other = filter_.run(y, start={"x0": np.zeros(3), "P0": np.array(model["P0"])})
    for run in (unchanged, other):
        assert (run.status >= 0).all()
        np.testing.assert_allclose(run.filtered_state, expected[0], atol=tolerance * 5.0)
        np.testing.assert_allclose(run.filtered_covariance, expected[1], atol=tolerance)


def test_a_start_that_is_no_covariance_is_refused():
    filter_ = built(spec(drawn(dense(1.0), 1, 0.0)[0]))
    before = filter_.snapshot()
    with pytest.raises(fkgen.DataError):
        filter_.reset(P0=np.diag([1.0, -1.0, 1.0]))
    assert filter_.snapshot() == before


def test_two_updates_are_one_with_both_and_missing_samples_pass():
    model, _ = drawn(dense(1.0) | {"R": np.eye(2)}, 1, 0.0)
    filter_ = built(spec(model, update="ud", scalar="double"))
    y, nothing = np.array([0.3, -0.7]), [np.nan, np.nan]
    whole = filter_.update(y)
    filter_.reset()
    filter_.update([y[0], np.nan])
    parts = filter_.update([np.nan, y[1]])
    for port in ("filtered_covariance", "filtered_factors", "filtered_state"):
        np.testing.assert_allclose(parts[port], whole[port], rtol=1e-12, atol=1e-14)
    filter_.predict()
    later = filter_.predict()
    filter_.reset()
    filter_.step(y)
    np.testing.assert_allclose(
        filter_.step(nothing).predicted_covariance, later.predicted_covariance, rtol=1e-13
    )


def test_what_has_no_factors_says_so():
    model, _ = drawn(dense(1.0), 1, 0.0)
    with pytest.raises(SpecError, match=r"code\.update.*ud"):
        fkgen.validate(spec(model, update="ud", filter={"lag": 2}))
    looped = spec(model, update="ud")
    with pytest.raises(SpecError, match="loops"):
        fkgen.validate(replace(looped, code=replace(looped.code, form="loops")))
