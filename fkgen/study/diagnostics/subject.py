"""The plant of a spec as numbers, the steady state of its filter, and what is found in them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.faults.chain import LETTERS
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.textbook.riccati import constant_input_noise, stationary_prediction
from fkgen.problem import Spec, names
from fkgen.problem.finding import Finding
from fkgen.study.diagnostics.findings import FINDINGS
from fkgen.trials.errors import error_signals

Array = NDArray[np.float64]

#: Singular values of scaled matrices that count as zero: they have about ten digits at best.
RANK_TOLERANCE = 1e-10


@dataclass(frozen=True, slots=True, eq=False)
class SteadyFilter:
    """A filter in its steady state."""

    predicted: Array  # (n, n), error covariance before the measurement
    filtered: Array  # (n, n), and after it
    innovation: Array  # (p, p), covariance
    gain: Array  # (n, p), K of x(k+1|k)
    filtered_gain: Array  # (n, p), Kf of x(k|k)
    radius: float  # spectral radius of A - K C


class Subject:
    """A spec at the default parameters (and the first hypothesis), with findings and values."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.findings: list[Finding] = []
        self.values: dict[str, float] = {}
        self.Q, self.R = (each.values(spec.defaults) for each in (spec.model.Q, spec.model.R))
        self.x0, self.P0 = spec.model.x0.values()[:, 0], spec.model.P0.values()
        self.curved = spec.filter.linearises  # f and h in place of matrices
        if not self.curved:
            self._read_matrices(LinearSystem.from_spec(spec, 1, None, spec.first_rates))
        self.states = [signal.name for signal in error_signals(spec.model.states)]
        self.outputs = [signal.name for signal in spec.model.outputs]
        self.has_faults = spec.faults.actuator is not None  # inputs fail
        self.is_float = spec.code.scalar == "float"

    def _read_matrices(self, one: LinearSystem) -> None:
        self.system = one
        self.A, self.B, self.C, self.D, self.Q, self.R = (
            np.asarray(of_samples[0]) for of_samples in (one.A, one.B, one.C, one.D, one.Q, one.R)
        )

    @cached_property
    def spectral_radius(self) -> float:
        """Of A."""
        return float(np.abs(np.linalg.eigvals(self.A)).max())

    @cached_property
    def used(self) -> frozenset[str]:
        """Names of the parameters on which the filter depends."""
        actuator, plants = self.spec.faults.actuator, self.spec.plants
        letters = "QR" if self.curved else LETTERS
        matrices = [getattr(plant, letter) for plant in plants for letter in letters]
        used: frozenset[str] = frozenset().union(*(matrix.names for matrix in matrices))
        used = used.union(*(each.names for each in self.spec.equations))
        if actuator is not None and self.spec.first_rates is None:
            used = used.union(*(names(rate) for rate in actuator.success_rate))
            used |= frozenset() if actuator.covariance is None else actuator.covariance.names
        return used

    @cached_property
    def steady(self) -> SteadyFilter | None:
        """The steady state of the filter at u = 0, if it reaches one."""
        return self.steady_at(np.zeros(self.spec.model.nu))

    def steady_at(self, u: Array) -> SteadyFilter | None:
        """The steady state of the filter at constant inputs u (q,), if it reaches one."""
        Q, R, S = constant_input_noise(self.system, u)
        with warnings.catch_warnings():
            # what is ill-conditioned fails the tests of the solution
            warnings.simplefilter("ignore")
            found = stationary_prediction(self.A, self.C, Q, R, S)
        if found is None:
            return None
        P, radius = found
        Om = self.C @ P @ self.C.T + R
        inverse = np.linalg.pinv(Om, hermitian=True)
        gain, own = (self.A @ P @ self.C.T + S) @ inverse, P @ self.C.T @ inverse
        filtered = P - own @ Om @ own.T
        return SteadyFilter(P, 0.5 * (filtered + filtered.T), Om, gain, own, radius)

    def lasting_innovation(self, steady: SteadyFilter, bias: Array) -> Array:
        """Of a bias b that stays: (I - C (I - A + K C)^-1 K) b, limit of Song & Hu 2019, (12)."""
        F = self.A - steady.gain @ self.C
        state = np.linalg.solve(np.eye(len(F)) - F, steady.gain @ bias)
        return np.asarray(bias - self.C @ state)

    def add(self, code: str, value: float | None = None, **facts: Any) -> None:
        """Add a finding; ``value`` and the facts are filled into its texts."""
        severity, *texts = FINDINGS[code]
        message, remedy = (text.format(value=value, **facts) for text in texts)
        number = None if value is None else float(value)
        self.findings.append(Finding(code.partition(".")[0], severity, message, number, remedy))

    def ranks(self, covariances: dict[str, Array], where: dict[str, str]) -> None:
        """Ranks of the innovation covariance by name; the lowest one is a finding if not full."""
        ranks = {name: numerical_rank(covariance) for name, covariance in covariances.items()}
        self.values |= {name: float(rank) for name, rank in ranks.items()}
        lowest, rows = min(ranks, key=ranks.__getitem__), self.spec.model.ny
        if ranks[lowest] < rows:
            self.add("innovation_rank", ranks[lowest], rows=rows, where=where.get(lowest, ""))

    def put(self, name: str, places: Iterable[object], numbers: Iterable[float]) -> None:
        """Values ``name.place``, one for each place."""
        self.values |= {f"{name}.{p}": float(v) for p, v in zip(places, numbers, strict=True)}


def listed(names: list[str]) -> str:
    """Names in a sentence."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def numerical_rank(covariance: Array) -> int:
    """Rank of a covariance, decided on correlations: units do not matter."""
    _, correlation = correlations(covariance)
    return int(np.count_nonzero(np.linalg.eigvalsh(correlation) > RANK_TOLERANCE))


def correlations(covariance: Array) -> tuple[Array, Array]:
    """Standard deviations and correlations; zero rows where there is no variance."""
    size = np.sqrt(np.diag(covariance).clip(0.0))
    outer = np.outer(size, size)
    return size, np.divide(covariance, outer, out=np.zeros_like(covariance), where=outer > 0.0)
