"""The simulation of section 4: its plant, its fault, and every filter that is compared.

References
----------
H. K. Lee, J. G. Lee, "Fault-Tolerant Compression Filters by Time-Propagated Measurement Fusion",
equations (48) to (51).
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
STEP = 0.2  # s
EVERY = 5  # samples from one position to the next
WINDOW = 30  # s
END, FAULT = 990, 700  # s
RAMP = 0.1  # m/s
SAMPLES = 1 + round(END / STEP)
SEED = 2024
BATCHES, RUNS = 20, 360  # the paper has one batch
FALSE_ALARM, PAPER_FALSE_ALARM = 0.05, 0.025  # its 7.38 for two degrees of freedom is 2.5 %

KF, KF_TEST, DFCF = "kf, no test", "kf, every position tested", "dfcf"
CPCF, PAPER = "cpcf", "cpcf, maintenance (44)"
LESS = "dfcf, threshold 7.38"
NO_TEST = (f"{DFCF}, no test", f"{CPCF}, no test", f"{PAPER}, no test")


@dataclass(frozen=True)
class Runs:
    """Independent runs.

    Attributes
    ----------
    state : (M, T, 2) ndarray
        Position and velocity.
    measured : (M, T, 2) ndarray
        What the filters see; NaN where there is no position.
    """

    state: Floats
    measured: Floats


def seconds(samples: int = SAMPLES) -> Floats:
    """(T,): the time of every sample, s."""
    return np.arange(samples) * STEP


def fault(samples: int = SAMPLES) -> Floats:
    """(T,): the error (49) of the position, zero up to 700 s, m."""
    return RAMP * np.maximum(0.0, np.round(seconds(samples) - FAULT, 9))


def has_position(samples: int = SAMPLES) -> NDArray[np.bool_]:
    """(T,): every fifth sample, from the first."""
    return np.arange(samples) % EVERY == 0


def simulate(
    runs: int, batch: int, *, faulty: bool = True, samples: int = SAMPLES, seed: int = SEED
) -> Runs:
    """Run plant and sensors (48), (49) from x0 drawn from the prior of the filters."""
    random = np.random.default_rng([seed, batch])
    start = random.standard_normal((runs, 2)) * np.sqrt([1.0, 0.01])
    acceleration = 5.0 * random.standard_normal((runs, samples - 1))
    noise = random.standard_normal((runs, samples, 2)) * np.sqrt([100.0, 0.01])
    state = np.empty((runs, samples, 2))
    state[:, 0] = start
    state[:, 1:, 1] = start[:, 1:] + np.cumsum(STEP * acceleration, axis=1)
    moved = STEP * state[:, :-1, 1] + STEP**2 / 2 * acceleration
    state[:, 1:, 0] = start[:, :1] + np.cumsum(moved, axis=1)
    measured = state + noise
    if faulty:
        measured[:, :, 0] += fault(samples)
    measured[:, ~has_position(samples), 0] = np.nan
    return Runs(state, measured)


def specification(**sections: Mapping[str, Any] | None) -> fkgen.Spec:
    """Load cpcf.toml; a table given as keyword changes entries, None removes a section."""
    content = tomllib.loads((HERE / "cpcf.toml").read_text(encoding="utf-8"))
    return fkgen.Spec.from_dict(changed(content, sections), file="cpcf.toml")


def changed(table: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested tables; None removes an entry."""
    result = dict(table)
    for key, value in changes.items():
        if isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = changed(result[key], value)
        else:
            result[key] = value
    return {key: value for key, value in result.items() if value is not None}


def specifications() -> dict[str, fkgen.Spec]:
    """Return the specification of every filter that is compared, by name.

    A compression filter whose window is one sample is a Kalman filter that tests every position
    before it uses it.
    """
    dfcf, printed = {"family": "dfcf"}, {"maintenance": "paper"}
    no_test = {"test": False}
    changes: dict[str, dict[str, Any]] = {
        KF: {"filter": {"family": "kf"}, "faults": None},
        KF_TEST: {"filter": dfcf, "faults": {"soft": {"window": 1}}},
        DFCF: {"filter": dfcf},
        CPCF: {},
        PAPER: {"filter": printed},
        LESS: {"filter": dfcf, "faults": {"soft": {"false_alarm": PAPER_FALSE_ALARM}}},
        NO_TEST[0]: {"filter": dfcf | no_test},
        NO_TEST[1]: {"filter": no_test},
        NO_TEST[2]: {"filter": printed | no_test},
    }
    return {name: specification(**change) for name, change in changes.items()}
