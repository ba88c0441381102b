"""The experiment behind the paper's tables: the motor, its random faults, and its filters.

References
----------
Strandt, Schneider, Yaz, "State Estimation in the Presence of Intermittent Actuator Faults",
equations (26) to (30) and section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fkgen

Floats = NDArray[np.floating[Any]]
HERE = Path(__file__).resolve().parent
RATES = (0.1, 0.3, 0.5, 0.7, 0.75, 0.85, 0.9)  # of both tables
RUNS = 2000  # independent runs per rate
SAMPLES = 1000  # 10 s
PERIOD = 0.01  # s
SEED = 1


@dataclass(frozen=True)
class Runs:
    """Independent runs of the motor at u = 1.

    Attributes
    ----------
    acted : (M, T) ndarray
        1 where the input acted, 0 where it failed.
    state : (M, T, 2) ndarray
        Current (A) and speed (rad/s) at each sample, from (1, 1).
    """

    acted: Floats
    state: Floats

    def first(self, count: int) -> Runs:
        """Return the first runs alone."""
        return Runs(self.acted[:count], self.state[:count])

    @property
    def speed(self) -> Floats:
        """(M, T, 1): what is measured when the success rate is known."""
        return np.ascontiguousarray(self.state[:, :, 1:])

    @property
    def speed_and_voltage(self) -> Floats:
        """(M, T, 2): what is measured when the success rate is unknown."""
        return np.stack([self.state[:, :, 1], self.acted], axis=2)


def simulate(rate: float, runs: int = RUNS, samples: int = SAMPLES, noise: float = 0.0) -> Runs:
    """Run the motor.

    Parameters
    ----------
    rate : float
        Success rate of the input.
    runs, samples : int
        M and T.
    noise : float
        Variance of the process noise of each state; the paper's experiment has none.
    """
    model = specification("known_rate").model
    A, B = model.A.values(), model.B.values()
    random = np.random.default_rng([SEED, round(100 * rate)])
    acted = (random.random((runs, samples)) < rate).astype(float)
    state = np.ones((runs, samples, 2))
    for k in range(samples - 1):
        state[:, k + 1] = state[:, k] @ A.T + acted[:, k, np.newaxis] * B[:, 0]
        if noise:
            state[:, k + 1] += np.sqrt(noise) * random.standard_normal((runs, 2))
    return Runs(acted, state)


def specification(name: str, **changes: dict[str, Any]) -> fkgen.Spec:
    """Load one of the two files; ``section={key: value}`` replaces an entry, None removes it."""
    spec = fkgen.load(HERE / f"{name}.toml")
    if not changes:
        return spec
    content: dict[str, Any] = spec.to_dict()
    for section, entries in changes.items():
        for key, value in entries.items():
            if value is None:
                content[section].pop(key, None)
            else:
                content[section][key] = value
    return fkgen.Spec.from_dict(content, file=f"{name}.toml")


def mode_probability(bank: fkgen.CompiledFilter, y: Floats) -> Floats:
    """Posterior probabilities (M, T, N) of the hypotheses for measurements (M, T, p) at u = 1."""
    u = np.ones((y.shape[1], 1))
    runs = (bank.run(record, u, keep=["mode_probability"]) for record in y)
    return np.stack([run.mode_probability for run in runs])
