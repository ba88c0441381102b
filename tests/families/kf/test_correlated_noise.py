"""Noise of the state that is correlated with that of y: kf with model.S."""

from __future__ import annotations

import numpy as np
import pytest
from plants import covariance, distance, random_model, record, spec

import fkgen
from fkgen.families import NAMES, family

ROUNDED = 1e-10


def correlated(seed, n, p, q=0, *, rows=None, **options):
    """A plant with a dense covariance of (w, v); S only in some ``rows``."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, n, p, q, **options)
    joint = covariance(rng, n + p, smallest=0.1)
    if rows is not None:
        joint[np.ix_([i for i in range(n) if i not in rows], range(n, n + p))] = 0.0
        joint = np.tril(joint[::-1, ::-1])[::-1, ::-1]
        joint = joint + joint.T - np.diag(np.diag(joint))
        joint[:n, :n] += 2.0 * np.eye(n)
    noise = {"Q": joint[:n, :n], "S": joint[:n, n:], "R": joint[n:, n:]}
    return model | {key: value.tolist() for key, value in noise.items()}


def decorrelated(model, y, u):
    """x+ = A x + B u + S R^-1 v + w~ with w~ free of v, over rows that are there, in matrices.

    Anderson & Moore 1979, sec. 5.4; what v tells of is not known of rows that are missing.
    """
    A, C, Q, R, S = (np.array(model[letter]) for letter in "ACQRS")
    B, D = (np.array(model.get(x, np.zeros((len(M), 0)))) for x, M in (("B", A), ("D", C)))
    x, P, rows = np.array(model["x0"]), np.array(model["P0"]), []
    for now, w in zip(y, u, strict=True):
        at = np.flatnonzero(np.isfinite(now))
        Ra, Ca = R[np.ix_(at, at)], C[at]
        nu, Se = now[at] - Ca @ x - D[at] @ w, Ca @ P @ Ca.T + Ra
        K = np.linalg.solve(Se, Ca @ P).T
        filtered, F = x + K @ nu, P - K @ Se @ K.T
        J = np.linalg.solve(Ra, S[:, at].T).T if at.size else np.zeros((len(A), 0))
        moved = A - J @ Ca
        x = moved @ filtered + B @ w + J @ (now[at] - D[at] @ w)
        P = moved @ F @ moved.T + Q - J @ S[:, at].T
        rows.append((filtered, F, x, P))
    names = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


PLANTS = {
    "dense": correlated(1, 3, 2, 1, direct=True),
    "one state": correlated(2, 4, 3, rows=[2]),
    "diagonal R": correlated(3, 2, 2) | {"R": [[3.0, 0.0], [0.0, 2.0]]},
}


#: One state whose noise is correlated with those of others and with y has no factors.
FORMS = [(name, form) for name in PLANTS for form in ("short", "joseph", "ud")]
FORMS.remove(("one state", "ud"))


@pytest.mark.parametrize(("name", "update"), FORMS)
def test_it_is_the_filter_of_decorrelated_noise(name, update):
    model = PLANTS[name]
    stated = spec(model, code={"update": update})
    y, u = record(stated, 40, seed=4, missing=0.3)
    y[7] = np.nan
    found = fkgen.build(stated).run(y, u if u.size else None)
    for port, values in decorrelated(model, y, u).items():
        assert distance(found[port], values) <= ROUNDED, port


def test_a_constant_gain_takes_it_too():
    y = np.random.default_rng(5).standard_normal((300, 3))
    model = PLANTS["one state"]
    constant, varying = (
        fkgen.build(spec(model, **options)).run(y) for options in ({"gain": "stationary"}, {})
    )
    for port in ("filtered_state", "predicted_state", "predicted_covariance"):
        assert distance(constant[port][250:], varying[port][250:]) <= 1e-9


def test_a_gate_leaves_out_what_a_row_tells_of_the_noise():
    stated = spec(PLANTS["dense"], gate=0.99)
    y, u = record(stated, 40, seed=6)
    y[3::5, 0] += 60.0
    gated = fkgen.build(stated).run(y, u)
    assert gated.rejected[3::5, 0].all()
    kept = np.where(gated.rejected, np.nan, y)
    for port, values in decorrelated(PLANTS["dense"], kept, u).items():
        assert distance(gated[port], values) <= ROUNDED, port


def test_trials_have_noises_that_are_correlated():
    model = PLANTS["dense"] | {"A": np.zeros((3, 3)).tolist(), "C": np.zeros((2, 3)).tolist()}
    drawn = fkgen.simulate(spec(model), 4000, 3, u=0.0)
    w, v = drawn.state[:, 2], drawn.y[:, 1]
    size = np.sqrt(np.outer(np.diag(model["Q"]), np.diag(model["R"])))
    found = (w[:, :, None] * v[:, None, :]).mean(axis=0)
    # 4000 products of two normal numbers: four standard deviations are 0.09.
    np.testing.assert_allclose(found / size, np.array(model["S"]) / size, atol=0.09)
    before = (drawn.state[:, 1, :, None] * v[:, None, :]).mean(axis=0)
    np.testing.assert_allclose(before / size, 0.0, atol=0.09)


def test_noise_that_moves_other_states_too_has_no_factors():
    with pytest.raises(fkgen.SpecError, match="this filter has no factored form"):
        fkgen.validate(spec(PLANTS["one state"], code={"update": "ud"}))


def test_a_second_update_is_refused_rather_than_wrong():
    header = fkgen.generate(fkgen.validate(spec(PLANTS["one state"]))).files["plant.h"]
    assert "an update after an update is refused" in " ".join(header.replace("*", " ").split())


@pytest.mark.parametrize(
    ("S", "what"),
    [
        ([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]], "negative eigenvalue"),
        ([[0.1], [0.0], [0.0]], "shape"),
        ([[0.1, "x"], [0.0, 0.0], [0.0, 0.0]], "x"),
    ],
)
def test_what_q_and_r_do_not_allow_is_refused_where_it_stands(S, what):
    model = random_model(1, 3, 2) | {"Q": np.eye(3).tolist(), "R": np.eye(2).tolist()}
    with pytest.raises(fkgen.SpecError, match=what) as fault:
        spec(model | {"S": S})
    assert fault.value.key.startswith("model.S")
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("name", [name for name in NAMES if not family(name).traits.correlated])
def test_other_families_say_that_they_do_not_take_it(name):
    import tomllib

    from fkgen.study.reports.starters import starter

    table = tomllib.loads(starter(name))
    n, p = len(table["model"]["P0"]), len(table["model"]["R"])
    table["model"]["S"] = np.full((n, p), 1e-12).tolist()
    table["model"].setdefault("Q", (1e-6 * np.eye(n)).tolist())
    with pytest.raises(fkgen.SpecError, match="only the family kf") as fault:
        fkgen.Spec.from_dict(table)
    assert fault.value.key == "model.S"


def test_it_is_written_back():
    stated = spec(PLANTS["dense"])
    assert fkgen.Spec.from_dict(stated.to_dict()) == stated
    assert "S" not in spec(random_model(1, 2, 1)).to_dict()["model"]
