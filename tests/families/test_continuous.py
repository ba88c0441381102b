"""Continuous plants against matrix exponentials in 60 digits, in Python and in C."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

import fkgen

#: A lightly damped oscillator that pushes a slow state, which an integrator adds up; stiff.
OSCILLATOR = {
    "A": [
        [-3.0, 20.0, 0.0, 0.0],
        [-20.0, -3.0, "k", 0.0],
        [0.0, 0.0, -0.02, 0.0],
        [0.0, 0.0, 1.0, 0.0],
    ],
    "B": [[0.0], [1.0], [0.3], [0.0]],
    "c": [0.0, -9.81, 0.0, "0.1*k"],
    "Q": [[0.1, 0.02, 0, 0], [0.02, 0.3, 0, 0], [0, 0, 0.2, 0.0], [0, 0, 0, 0]],
}
TRACK = {
    "A": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]],
    "B": [[0.0], [1.0], [0.0]],
    "c": [0.0, -9.81, 0.0],
    "Q": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, "k"]],
}
PLANTS = {"oscillator": OSCILLATOR, "track": TRACK}
PRECISE = 1e-12


def table(plant, *, time=0.1, k=1.7, **more):
    n = len(plant["A"])
    model = {
        **plant,
        "C": np.eye(1, n).tolist(),
        "R": [[0.5]],
        "x0": [1.0, *[0.0] * (n - 1)],
        "P0": np.eye(n).tolist(),
        "time": "continuous",
        "sample_time": time,
    }
    parameters = {"k": k, "dt": 0.1} if isinstance(time, str) else {"k": k}
    spec = {"name": "plant", "model": model, "parameters": parameters, "filter": {"family": "kf"}}
    return spec | more


def exact(plant, dt, k):
    """A, B, c and Q from sample to sample, in 60 digits."""
    known = {"k": k, "-k": -k, "0.1*k": 0.1 * k}
    values = {
        letter: [
            [mpmath.mpf(repr(known.get(e, e))) for e in row]
            for row in (plant[letter] if letter != "c" else [[e] for e in plant["c"]])
        ]
        for letter in ("A", "B", "c", "Q")
    }
    with mpmath.workdps(120):
        A, B, c, Q = (mpmath.matrix(values[letter]) for letter in ("A", "B", "c", "Q"))
        n, T = A.rows, mpmath.mpf(dt)
        wide = mpmath.zeros(3 * n)
        for i in range(n):
            for j in range(n):
                wide[i, j], wide[i, n + j] = -A[i, j], Q[i, j]
                wide[n + i, n + j] = A[j, i]
        noise = mpmath.expm(wide[: 2 * n, : 2 * n] * T, method="taylor")
        F = noise[n:, n:].T
        held = mpmath.zeros(2 * n)
        for i in range(n):
            held[i, n + i] = 1
            for j in range(n):
                held[i, j] = A[i, j]
        G = mpmath.expm(held * T, method="taylor")[:n, n:]
        found = {"A": F, "B": G * B, "c": G * c, "Q": F * noise[:n, n:]}
        return {x: np.array(M.tolist(), dtype=float) for x, M in found.items()}


def off(found, expected):
    """Largest error relative to the size of an entry, or of its row and column in a covariance."""
    return np.abs(found - expected).max() / max(np.abs(expected).max(), 1e-300)


def entrywise(found, expected):
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    return np.max(np.abs(found - expected)[size > 0] / size[size > 0])


@pytest.mark.parametrize("dt", [1e-4, 0.1, 3.0])
@pytest.mark.parametrize("name", PLANTS)
def test_numbers_are_those_of_the_exponential(name, dt):
    plant = PLANTS[name]
    numbers = {
        x: [[1.7 if e == "k" else 0.17 if e == "0.1*k" else e for e in row] for row in plant[x]]
        for x in ("A", "B", "Q")
    }
    numbers["c"] = [0.17 if e == "0.1*k" else e for e in plant["c"]]
    model = fkgen.Spec.from_dict(table(numbers, time=dt)).model
    for letter, expected in exact(numbers, dt, 1.7).items():
        found = getattr(model, letter)
        assert found.is_constant
        assert off(found.values(), expected) <= PRECISE, letter
    assert entrywise(model.Q.values(), exact(numbers, dt, 1.7)["Q"]) <= PRECISE


@pytest.mark.parametrize("name", PLANTS)
def test_the_c_code_computes_them_for_every_sample_time(name):
    plant = PLANTS[name]
    spec = fkgen.Spec.from_dict(table(plant, time="dt"))
    times, rates = [1e-6, 1e-3, 0.03, 0.1, 0.4, 0.7], [1.0, 2.0, 0.5, 1.7, 1.2, 1.9]
    n, motor = len(plant["A"]), fkgen.build(spec)
    for dt, k in zip(times, rates, strict=True):
        run = motor.run([[np.nan]], [[0.6]], {"dt": dt, "k": k})
        now = exact(plant, dt, k)
        x0 = np.eye(n)[0]
        x = now["A"] @ x0 + (now["B"] * 0.6 + now["c"]).ravel()
        P = now["A"] @ now["A"].T + now["Q"]
        assert run.status[0] == 1
        assert off(run.predicted_state[0], x) <= PRECISE
        assert entrywise(run.predicted_covariance[0], P) <= PRECISE
        for letter in ("A", "B", "c", "Q"):
            values = getattr(spec.model, letter).values({"dt": dt, "k": k})
            assert off(values, now[letter]) <= PRECISE


def test_a_time_beyond_what_the_series_hold_is_refused():
    motor = fkgen.build(fkgen.Spec.from_dict(table(OSCILLATOR, time="dt")))
    run = motor.run([[0.1], [0.1]], [[0.6], [0.6]], {"dt": [2.0, 0.1], "k": 1.7})
    assert run.status.tolist() == [-4, 0]


def test_a_mode_is_discretised_with_what_it_leaves_out_of_the_model():
    other = {"A": [[0.0, 1.0, 0.0], [0.0, -0.4, 1.0], [0.0, 0.0, "-k"]], "c": [0.0, 1.0, 0.0]}
    faults = {"transition": [[0.9, 0.1], [0.2, 0.8]], "modes": [{}, other]}
    for family in ("imm", "mjls_lmmse"):
        stated = table(TRACK, time="dt", faults={"jump": faults})
        stated["filter"] = {"family": family}
        spec = fkgen.Spec.from_dict(stated)
        assert fkgen.Spec.from_dict(spec.to_dict()) == spec
        for mode, own in zip(spec.faults.jump.modes, ({}, other), strict=True):
            for letter, expected in exact(TRACK | own, 0.3, 0.6).items():
                values = getattr(mode, letter).values({"dt": 0.3, "k": 0.6})
                assert off(values, expected) <= PRECISE
        assert fkgen.build(spec).run(np.zeros((5, 1)), np.ones((5, 1))).status.max() == 0


def test_a_continuous_system_of_python_control_is_taken():
    import control

    A, B = [[-1.0, 2.0], [0.0, -0.5]], [[0.0], [1.0]]
    system = control.ss(A, B, [[1.0, 0.0]], [[0.3]])
    model = {"system": system, "Q": [[0.1, 0.0], [0.0, 0.2]], "R": [[1.0]], "x0": [0.0, 0.0]}
    model |= {"P0": np.eye(2), "time": "continuous", "sample_time": 0.25}
    spec = fkgen.Spec.from_dict({"name": "plant", "model": model, "filter": {"family": "kf"}})
    sampled = control.sample_system(system, 0.25)
    np.testing.assert_allclose(spec.model.A.values(), sampled.A, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(spec.model.B.values(), sampled.B, rtol=1e-12, atol=1e-15)
    assert spec.model.D.values() == 0.3


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"sample_time": None}, "model.sample_time"),
        ({"time": "sampled"}, "model.time"),
        ({"sample_time": -0.1}, "model.sample_time"),
        ({"A": [[1e4, 0, 0], [0, 1e4, 0], [0, 0, 1e4]]}, "model.sample_time"),
    ],
)
def test_what_cannot_be_discretised_is_refused_where_it_stands(change, key):
    stated = table(TRACK)
    stated["model"] |= change
    stated["model"] = {k: v for k, v in stated["model"].items() if v is not None}
    with pytest.raises(fkgen.SpecError) as fault:
        fkgen.Spec.from_dict(stated)
    assert fault.value.key == key
    assert "\n" not in str(fault.value)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("time", [0.2, "dt"])
def test_it_is_written_back_as_it_was_stated(name, time):
    spec = fkgen.Spec.from_dict(table(PLANTS[name], time=time))
    written = spec.to_dict()["model"]
    assert written["time"] == "continuous"
    assert written["A"] == PLANTS[name]["A"]
    assert fkgen.Spec.from_dict(spec.to_dict()) == spec
