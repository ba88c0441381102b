"""Specs of the imm over modes of the plant, records of them, and the answers of oracles."""

from __future__ import annotations

import itertools

import numpy as np
from plants import covariance, random_model
from scipy.special import softmax

import fkgen
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.jump import JumpSystem, simulate_jumps

DENSE = [[0.6, 0.3, 0.1], [0.2, 0.5, 0.3], [0.25, 0.15, 0.6]]
HOLES = [[0.7, 0.3, 0.0], [0.0, 0.4, 0.6], [1.0, 0.0, 0.0]]
ALIKE = [[0.4, 0.4, 0.2], [0.25, 0.5, 0.25], [0.1, 0.6, 0.3]]  # column 1 is twice column 2
TURN = np.eye(3)[[1, 2, 0]].tolist()
START = [0.5, 0.2, 0.3]

KALMAN = (
    "filtered_state",
    "filtered_covariance",
    "predicted_state",
    "predicted_covariance",
    "innovation",
    "innovation_covariance",
    "nis",
    "log_likelihood",
)
PORTS = (*KALMAN, "mode_probability", "predicted_mode_probability")
BAYES = tuple(port for port in PORTS if port != "nis")
SINGLE = ("mode_filtered_state", "mode_filtered_covariance", "mode_state", "mode_covariance")

#: Two double computations: roundings of 1e-16 that exponents of some ten multiply.
EXACT = 1e-9

#: n, p, q, matrices that modes have of their own, transition.
PLANTS = {
    "everything": (2, 2, 1, "ABCDQRc", DENSE),
    "dynamics": (3, 1, 0, "A", DENSE),
    "process noise": (2, 1, 1, "Q", DENSE),
    "offsets": (2, 1, 0, "c", HOLES),
    "inputs": (2, 1, 2, "B", DENSE),
    "measurement": (2, 3, 1, "CDR", HOLES),
    "no memory": (2, 1, 0, "AQ", [START] * 3),
    "columns alike": (2, 1, 0, "AC", ALIKE),
}


def jumping(model, modes, *, transition=DENSE, initial=START, **sections):
    """A spec of the imm; ``modes`` are tables of what each has of its own."""
    law = {"transition": np.asarray(transition).tolist(), "initial": np.asarray(initial).tolist()}
    own = [{key: _plain(value) for key, value in mode.items()} for mode in modes]
    return fkgen.Spec.from_dict(
        {
            "name": "plant",
            "model": {key: _plain(value) for key, value in model.items()},
            "faults": {"jump": {**law, "modes": own}},
            "filter": {"family": "imm"},
            **sections,
        }
    )


def _plain(value):
    return value.tolist() if isinstance(value, np.ndarray) else value


def any_modes(seed, n, p, q=0, *, letters="ABCDQRc", count=3):
    """Modes without structure; the first is the model."""
    rng = np.random.default_rng(seed)
    modes = [{}]
    for at in range(1, count):
        every = random_model(1000 * seed + at, n, p, q, direct=q > 0, correlated=True)
        every |= {"c": rng.standard_normal(n), "Q": covariance(rng, n)}
        modes.append({letter: every[letter] for letter in letters if letter in every})
    return modes


def plant(name, **options):
    n, p, q, letters, transition = PLANTS[name]
    model = random_model(50 + 10 * n + p, n, p, q, direct=q > 0, correlated=True)
    modes = any_modes(len(name), n, p, q, letters=letters)
    return jumping(model, modes, **{"transition": transition, **options})


def system_of(spec, T, params=None):
    return JumpSystem.from_spec(spec, T, params)


def seen(spec, T, *, seed=1, missing=0.0, params=None):
    """A record that jumps as the spec says, but for the sample at which it does: (y, u)."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((T, spec.model.nu))
    y = simulate_jumps(system_of(spec, T, params), u, rng).y
    y[rng.random(y.shape) < missing] = np.nan
    return y, u


def told(system, path, u, *, leaving=False):
    """The plant and inputs of one who is told the modes: mode k + 1 moves x[k] to x[k+1].

    ``path`` has a mode more than there are samples; ``leaving``: it is mode k instead. Offsets are
    an input that is always one.
    """
    T, k = system.length, np.arange(system.length)
    now, after = np.asarray(path[:-1]), np.asarray(path[:-1] if leaving else path[1:])
    q = u.shape[1] + 1
    plant = LinearSystem(
        A=system.A[k, after],
        B=np.concatenate([system.B[k, after], system.c[k, after, :, np.newaxis]], axis=2),
        C=system.C[k, now],
        D=np.concatenate([system.D[k, now], np.zeros((T, system.ny, 1))], axis=2),
        Q=system.Q[k, after],
        R=system.R[k, now],
        x0=system.x0,
        P0=system.P0,
        rate=np.ones((T, q)),
        fault_covariance=np.zeros((T, q, q)),
    )
    return plant, np.hstack([u, np.ones((T, 1))])


def by_histories(system, y, u, *, leaving=False):
    """Bayes' rule over all paths of T + 1 modes, each by the joint density of its record.

    Returns mean and covariance of x[T-1] and x[T], the law of the last two modes, and log p(y).
    """
    T, law = system.length, {}
    for path in itertools.product(range(system.count), repeat=T + 1):
        steps = [system.transition[i, j] for i, j in itertools.pairwise(path)]
        chance = system.initial[path[0]] * np.prod(steps)
        if chance > 0.0:
            plant, inputs = told(system, path, u, leaving=leaving)
            result = batch_lmmse(plant, y, inputs)
            law[path] = np.log(chance) + result.log_likelihood.sum(), result
    logs = np.array([log for log, _ in law.values()])
    weights = softmax(logs)
    answer = {"log_likelihood": np.logaddexp.reduce(logs)}
    for of in ("filtered", "predicted"):
        means = np.array([getattr(r, f"{of}_state")[-1] for _, r in law.values()])
        covariances = np.array([getattr(r, f"{of}_covariance")[-1] for _, r in law.values()])
        mean = weights @ means
        apart = means - mean
        spread = np.einsum("i,ij,ik->jk", weights, apart, apart)
        answer[f"{of}_state"] = mean
        answer[f"{of}_covariance"] = np.einsum("i,ijk->jk", weights, covariances) + spread
    for name, at in {"mode_probability": -2, "predicted_mode_probability": -1}.items():
        last = np.array([path[at] for path in law])
        answer[name] = np.array([weights[last == j].sum() for j in range(system.count)])
    return answer
