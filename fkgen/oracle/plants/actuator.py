"""A plant over a record, one whose actuators fail (gamma in {0, 1}^q), and its simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from typing import ClassVar, Self

import numpy as np

from fkgen.errors import DataError
from fkgen.faults import ActuatorFaults
from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.problem import Spec, evaluate


@dataclass(frozen=True, eq=False, kw_only=True)
class Plant:
    """Matrices of T samples, (T, ...) or (T, N, ...) where there are N modes."""

    #: What has one value for each sample
    VARYING: ClassVar[tuple[str, ...]] = ("A", "B", "C", "D", "Q", "R", "c", "d")

    A: Array  # A, B, C, D: (..., n, n), (..., n, q), (..., p, n), (..., p, q); q may be 0
    B: Array
    C: Array
    D: Array
    Q: Array  # Q, R: (..., n, n), (..., p, p): Covariances of the noises as they enter x and y
    R: Array
    x0: Array  # x0, P0: (n,), (n, n): Mean and covariance of x[0], eq. (2)
    P0: Array
    #: c, d: (..., n), (..., p): Known offsets; zeros if left out
    c: Array = field(default_factory=lambda: np.zeros(0))
    d: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Put zeros in place of offsets that are left out."""
        for name, like in (("c", self.A), ("d", self.C)):
            if not getattr(self, name).size:
                object.__setattr__(self, name, np.zeros(like.shape[:-1]))

    @property
    def length(self) -> int:
        """Number of samples, T."""
        return int(self.A.shape[0])

    @property
    def nx(self) -> int:
        """Number of states, n."""
        return int(self.A.shape[-1])

    @property
    def ny(self) -> int:
        """Number of measurements, p."""
        return int(self.C.shape[-2])

    @property
    def nu(self) -> int:
        """Number of inputs, q."""
        return int(self.B.shape[-1])

    def over(self, piece: slice) -> Self:
        """The same plant over a piece of its samples, its prior unchanged."""
        return replace(self, **{name: getattr(self, name)[piece] for name in self.VARYING})


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearSystem(Plant):
    """x[k+1] = A x + B g u + c + v,  y[k] = C x + D g u + d + w with one g = diag(gamma) for both.

    Strandt, Schneider, Yaz, State Estimation in the Presence of Intermittent Actuator Faults, (1).
    """

    VARYING = (*Plant.VARYING, "rate", "fault_covariance", "S")

    #: (T, n, p): Covariance of the noise of x[k+1] with that of y[k]; zeros if left out
    S: Array = field(default_factory=lambda: np.zeros(0))
    rate: Array  # (T, q): Mean of gamma; ones where nothing fails
    fault_covariance: Array  # (T, q, q): Covariance of gamma; zeros where nothing fails

    def __post_init__(self) -> None:
        """Refuse shapes that do not fit, which NumPy would broadcast in silence."""
        super().__post_init__()
        if not self.S.any():
            object.__setattr__(self, "S", np.zeros((self.length, self.nx, self.ny)))
        T, n, p, q = self.length, self.nx, self.ny, self.nu
        for name, expected in {
            "A": (T, n, n), "B": (T, n, q), "C": (T, p, n), "D": (T, p, q),
            "Q": (T, n, n), "R": (T, p, p), "x0": (n,), "P0": (n, n),
            "c": (T, n), "d": (T, p), "S": (T, n, p),
            "rate": (T, q), "fault_covariance": (T, q, q),
        }.items():  # fmt: skip
            actual = getattr(self, name).shape
            if actual != expected:
                raise DataError(
                    f"{name} of a LinearSystem", given=f"shape {actual}", expected=f"{expected}"
                )

    def noise_root(self) -> Array:
        """Square roots of the joint covariance of both noises, (T, n + p, n + p)."""
        above = np.concatenate([self.Q, self.S], axis=2)
        below = np.concatenate([self.S.transpose(0, 2, 1), self.R], axis=2)
        return square_root(np.concatenate([above, below], axis=1))

    def inputs(self, u: Array | None) -> Array:
        """Inputs of a record as checked, (T, q); supplied for a plant that has none."""
        expected = (self.length, self.nu)
        record = np.zeros((self.length, 0)) if u is None else np.asarray(u, dtype=float)
        if record.shape != expected:
            raise DataError("u", given=f"shape {record.shape}", expected=f"shape {expected}")
        return record

    @classmethod
    def from_spec(
        cls,
        spec: Spec,
        T: int,
        params: Mapping[str, Array | float] | None = None,
        rates: tuple[float, ...] | None = None,
    ) -> Self:
        """Sample the plant of a spec; params (T,)."""
        samples, which = parameter_samples(spec, T, params)
        model, first = spec.model, first_sample(spec, params)
        plant = {
            name: np.array([getattr(model, name).values(sample) for sample in samples])[which]
            for name in (*Plant.VARYING, "S")
        }
        plant |= {name: plant[name][..., 0] for name in ("c", "d")}
        rate, covariance = actuation_of(spec, T, params, rates)
        return cls(
            **plant,
            x0=model.x0.values(first)[:, 0],
            P0=model.P0.values(first),
            rate=rate,
            fault_covariance=covariance,
        )


def actuation_of(
    spec: Spec,
    T: int,
    params: Mapping[str, Array | float] | None = None,
    rates: tuple[float, ...] | None = None,
) -> tuple[Array, Array]:
    """Mean (T, q) and covariance (T, q, q) of gamma: ones and zeros where nothing fails."""
    samples, which = parameter_samples(spec, T, params)
    found = [_fault_moments(spec.faults.actuator, spec.model.nu, each, rates) for each in samples]
    means, covariances = ([each[i] for each in found] for i in (0, 1))
    return np.array(means)[which], np.array(covariances)[which]


def parameter_samples(
    spec: Spec, T: int, params: Mapping[str, Array | float] | None
) -> tuple[list[dict[str, float]], list[int]]:
    """Distinct values of all parameters, and which of them holds at each of T samples."""
    given = {**spec.defaults, **(params or {})}
    records = [np.broadcast_to(np.asarray(value, dtype=float), (T,)) for value in given.values()]
    rows = [tuple(float(record[k]) for record in records) for k in range(T)]
    position = {row: index for index, row in enumerate(dict.fromkeys(rows))}
    return [dict(zip(given, row, strict=True)) for row in position], [position[row] for row in rows]


def first_sample(spec: Spec, params: Mapping[str, Array | float] | None) -> dict[str, float]:
    """All parameters as sample 0 has them."""
    given = {**spec.defaults, **(params or {})}
    return {name: float(np.ravel(value)[0]) for name, value in given.items()}


def _fault_moments(
    faults: ActuatorFaults | None,
    q: int,
    sample: Mapping[str, float],
    rates: tuple[float, ...] | None,
) -> tuple[Array, Array]:
    """Mean (q,) and covariance (q, q) of gamma at one sample."""
    if faults is None and rates is None:
        return np.ones(q), np.zeros((q, q))
    if rates is None and faults is not None:
        rates = tuple(evaluate(expression, sample) for expression in faults.success_rate)
    if not rates:
        raise DataError(
            "success rate", given="none", expected="a rate in the spec or one hypothesis in `rates`"
        )
    rate = np.array(np.broadcast_to(np.asarray(rates, dtype=float), (q,)))
    variance = rate * (1.0 - rate)
    if faults is None or faults.dependence == "common":
        return rate, np.tile(variance[:1], (q, q))
    if faults.covariance is not None and faults.dependence == "covariance":
        return rate, faults.covariance.values(sample)
    return rate, np.diag(variance)


def simulate(
    system: LinearSystem, u: Array | None, rng: np.random.Generator, *, missing: float = 0.0
) -> Array:
    """Draw measurements (T, p), entries NaN with probability `missing`; u (T, q) as commanded."""
    T, n, p = system.length, system.nx, system.ny
    effective = draw_gamma(system, rng) * system.inputs(u)
    v = np.einsum("kij,kj->ki", square_root(system.Q), rng.standard_normal((T, n)))
    w = np.einsum("kij,kj->ki", square_root(system.R), rng.standard_normal((T, p)))
    if system.S.any():
        both = np.einsum("kij,kj->ki", system.noise_root(), rng.standard_normal((T, n + p)))
        v, w = both[:, :n], both[:, n:]
    x = system.x0 + square_root(system.P0) @ rng.standard_normal(n)
    y = np.empty((T, p))
    for k in range(T):
        y[k] = system.C[k] @ x + system.D[k] @ effective[k] + system.d[k] + w[k]
        x = system.A[k] @ x + system.B[k] @ effective[k] + system.c[k] + v[k]
    y[rng.random(y.shape) < missing] = np.nan
    return y


def draw_gamma(system: LinearSystem, rng: np.random.Generator) -> Array:
    """Draw which actuators work in each sample, (T, q)."""
    return draw_patterns(system.rate, system.fault_covariance, rng)


def draw_patterns(rate: Array, covariance: Array, rng: np.random.Generator) -> Array:
    """Draw gamma of mean (T, q) and covariance (T, q, q).

    For more than two correlated inputs mean and covariance do not determine the binary
    distribution: a Gaussian of the same moments takes its place, alike for a linear filter.
    """
    T, q = rate.shape
    moments = np.hstack([rate, covariance.reshape(T, q * q)])
    distinct, group = np.unique(moments, axis=0, return_inverse=True)
    gamma = np.empty((T, q))
    for index, row in enumerate(distinct):
        chosen = np.flatnonzero(group.ravel() == index)
        gamma[chosen] = _draw(row[:q], row[q:].reshape(q, q), chosen.size, rng)
    return gamma


def _draw(rate: Array, covariance: Array, count: int, rng: np.random.Generator) -> Array:
    """Draw `count` vectors gamma of one distribution, (count, q)."""
    q = rate.size
    if q == 0 or not covariance.any():
        return np.broadcast_to(rate, (count, q))
    if is_independent(covariance):
        return (rng.random((count, q)) < rate).astype(float)
    if is_common(rate, covariance):
        return np.repeat((rng.random((count, 1)) < rate[0]).astype(float), q, axis=1)
    if q == 2:  # the last case that two moments determine
        patterns, chance = pair_patterns(rate, covariance)
        return np.asarray(patterns[rng.choice(len(patterns), size=count, p=chance / chance.sum())])
    return rate + rng.standard_normal((count, q)) @ square_root(covariance).T


def is_common(rate: Array, covariance: Array) -> bool:
    """Whether one coin decides for all inputs; true also if equal rates leave nothing to chance."""
    return bool(np.all(rate == rate[:1]) and np.all(covariance == covariance[:1, :1]))


def is_independent(covariance: Array) -> bool:
    """Whether the inputs fail independently: no covariance off the diagonal."""
    return bool(np.all(covariance == np.diag(np.diagonal(covariance))))


def common_patterns(rate: Array) -> tuple[Array, Array]:
    """Both states of inputs that fail together, and their probabilities; rate (q,)."""
    return np.array([np.zeros(rate.size), np.ones(rate.size)]), np.array([1.0 - rate[0], rate[0]])


def independent_patterns(rate: Array) -> tuple[Array, Array]:
    """All states of inputs that fail independently; rate (q,)."""
    patterns = np.array(list(product((0.0, 1.0), repeat=rate.size))).reshape(-1, rate.size)
    return patterns, np.prod(np.where(patterns > 0.0, rate, 1.0 - rate), axis=1)


def pair_patterns(rate: Array, covariance: Array) -> tuple[Array, Array]:
    """Enumerate two correlated inputs: Pr(both work) = Cov_12 + xi_1 xi_2."""
    both = covariance[0, 1] + rate[0] * rate[1]
    patterns = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    probabilities = np.array([1.0 - rate.sum() + both, rate[1] - both, rate[0] - both, both])
    # A boundary case (say both = xi_1) may round to -1e-17, which is no probability.
    return patterns, np.clip(probabilities, 0.0, 1.0)
