"""The experiment of section VI: the plant, its faults, and every filter that is compared.

References
----------
Sigalov, Oshman, "A New Formulation of Fault-Tolerant Estimation Problems and Some Solutions",
equations (25) to (29).
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fkgen

Floats = NDArray[np.floating[Any]]
HERE = Path(__file__).resolve().parent
RUNS = 10000  # of the paper
SAMPLES = 101  # 0 to 100
SEED = 1
FACTOR = 10.0  # C of the paper: delta is 1 or C
NOMINAL = 0.8  # r: probability of delta = 1
MEAN_DELTA = NOMINAL + (1.0 - NOMINAL) * FACTOR
A = -0.8  # (25); all variances are 1
P, SWITCH = 0.9, 0.7  # p, and q of example 2
MEAN_GAMMA = 1.0 - SWITCH * (1.0 - P)  # of example 2
P11 = (1.0 - SWITCH * (1.0 - P**2)) / MEAN_GAMMA  # (29)

GENIE, IMM, LINEAR, AUGMENTED = "genie", "imm", "linear_optimal", "linear_optimal, augmented"
ONE_STEP = "one_step"
NAIVE, NAIVE_MEAN = "kf with R", "kf with R E[delta]"
READINGS = ("weighted", "paper", "paper_nominal")  # of (7), besides the default


@dataclass(frozen=True)
class Study:
    """One law of the faults.

    Attributes
    ----------
    title : str
        Its name in tables and figures.
    file : str
        The specification.
    beta : ((float, float), (float, float))
        Transition probabilities of the fault of the second channel, states ordered (0, 1).
    switch : float
        q: probability of the second channel.
    every_sample : bool
        Whether the channel is drawn anew in every sample, not once per run.
    sections : mapping
        Changes of the specification, section by section.
    """

    title: str
    file: str
    beta: tuple[tuple[float, float], tuple[float, float]]
    switch: float = 1.0
    every_sample: bool = False
    sections: Mapping[str, Any] | None = None


ALTERNATING = ((1.0 - P, P), (P, 1.0 - P))
STICKY = ((P, 1.0 - P), (1.0 - P, P))
EQUAL = ((1.0 - P, P), (1.0 - P, P))
EXAMPLE_1 = Study("Example 1", "example1", ALTERNATING)
BURSTS = Study(
    "Example 1 with bursts",
    "example1",
    STICKY,
    sections={"faults": {"sensor": {"gamma_chain": [list(row) for row in STICKY]}}},
)
EXAMPLE_2 = Study("Example 2", "example2", EQUAL, SWITCH)
REDRAWN = Study(
    "Example 2, channel drawn in every sample", "example2", EQUAL, SWITCH, every_sample=True
)
STUDIES = (EXAMPLE_1, BURSTS, EXAMPLE_2)


@dataclass(frozen=True)
class Runs:
    """Independent runs.

    Attributes
    ----------
    state : (M, T) ndarray
        x, 0 at sample 0.
    gamma, delta : (M, T) ndarray
        The faults.
    measured : (M, T, 1) ndarray
        What the filters see.
    """

    state: Floats
    gamma: Floats
    delta: Floats
    measured: Floats


def simulate(study: Study, runs: int = RUNS, samples: int = SAMPLES, seed: int = SEED) -> Runs:
    """Run the plant (25) and the sensor (28); the chain of beta starts in its stationary law."""
    random = np.random.default_rng([seed, *study.title.encode()])
    shape = (runs, samples)
    (_, up), (down, _) = study.beta
    beta, x = np.empty(shape, bool), np.zeros(shape)
    beta[:, 0] = random.random(runs) < up / (up + down)
    for k in range(1, samples):
        beta[:, k] = random.random(runs) < np.where(beta[:, k - 1], 1.0 - down, up)
        x[:, k] = A * x[:, k - 1] + random.standard_normal(runs)
    alpha = random.random(shape if study.every_sample else (runs, 1)) < study.switch
    gamma = np.where(alpha, beta, 1.0)
    delta = np.where(random.random(shape) < NOMINAL, 1.0, FACTOR)
    y = gamma * x + np.sqrt(delta) * random.standard_normal(shape)
    return Runs(x, gamma, delta, y[:, :, np.newaxis])


def specification(study: Study, **sections: Any) -> fkgen.Spec:
    """Load a study's specification; a table given as keyword changes entries, None removes."""
    content = tomllib.loads((HERE / f"{study.file}.toml").read_text(encoding="utf-8"))
    for changes in (study.sections or {}, sections):
        content = changed(content, changes)
    return fkgen.Spec.from_dict(content, file=f"{study.file}.toml")


def changed(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; None removes an entry."""
    result = dict(table)
    for key, value in changes.items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = changed(result[key], value)
        else:
            result[key] = value
    return {key: value for key, value in result.items() if value is not None}


def filters(study: Study) -> dict[str, fkgen.Spec]:
    """Return the specification of every filter that is compared, by name."""
    linear: dict[str, Any] = {"filter": {"family": "linear_optimal"}}
    if study.switch < 1.0:
        moments = {
            "problem": "moments",
            "gamma_rate": MEAN_GAMMA,
            "gamma_persistence": MEAN_GAMMA if study.every_sample else P11,
            "delta_nominal_rate": NOMINAL,
            "gamma_chain": None,
            "delta_chain": None,
        }
        linear["faults"] = {"sensor": moments}
    augmented = {"family": "linear_optimal", "form": "augmented"}
    changes: dict[str, dict[str, Any]] = {
        GENIE: {"filter": {"family": "genie"}},
        IMM: {"filter": {"family": "imm"}},
        f"{IMM}, 3 modes": {"filter": {"family": "imm", "modes": 3}},
        ONE_STEP: {},
        **{f"{ONE_STEP}, {each}": {"filter": {"covariance": each}} for each in READINGS},
        LINEAR: linear,
        AUGMENTED: {"filter": augmented},
        NAIVE_MEAN: {
            "model": {"R": [[MEAN_DELTA]]},
            "filter": {"family": "kf"},
            "faults": None,
        },
        NAIVE: {"filter": {"family": "kf"}, "faults": None},
    }
    return {name: specification(study, **change) for name, change in changes.items()}


def estimates(compiled: fkgen.CompiledFilter, runs: Runs) -> tuple[Floats, Floats]:
    """Filter all runs in C; only the genie is told the faults.

    Returns
    -------
    state, variance : (M, T) ndarray
        x(k|k), and the variance of its error as the filter sees it.
    """
    keep = ("filtered_state", "filtered_covariance")
    told = {"gamma": runs.gamma, "delta": runs.delta} if compiled.family == "genie" else None
    run = compiled.run_batch(runs.measured, params=told, keep=keep)
    return run.filtered_state[..., 0], run.filtered_covariance[..., 0, 0]
