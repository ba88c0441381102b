"""A plant whose sensors lose their signal (gamma) or gain noise (delta), eq. (1)-(2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.oracle.plants.actuator import LinearSystem, first_sample, parameter_samples
from fkgen.oracle.plants.jump import JumpSystem, draw_chain, initial_of, lasting_law
from fkgen.problem import Matrix, Spec, evaluate

#: gamma of the four modes.
GAMMA = np.array([1.0, 1.0, 0.0, 0.0])

#: Probabilities closer than this are the same: rounding of sums of four numbers up to one.
SAME_PROBABILITY = 1e-12


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorLaw:
    """Markov law of the modes (gamma, delta) = (1, 1), (1, C), (0, 1), (0, C), and its rows of y.

    Sigalov, Oshman, A New Formulation of Fault-Tolerant Estimation Problems and Some Solutions, II.
    """

    #: (4, 4): Pr(mode at k+1 is j | mode at k is i), eq. (14); (11)-(13) are special cases
    kernel: Array
    initial: Array  # (4,): Law of the mode at sample 0, before y[0]
    noise_factor: float  # The value C that delta takes beside 1
    rows: tuple[int, ...]  # Rows of y that are subject to faults
    #: (T, 4, 4), (T,), (T, 4): The kernel of each step, C and what sample k says of Pr(mode at
    #: k+1), where they depend on the sample
    kernels: Array | None = None
    factors: Array | None = None
    announced: Array | None = None

    def __post_init__(self) -> None:
        """Refuse what is not a law of four modes."""
        for name, expected in {"kernel": (4, 4), "initial": (4,)}.items():
            values = getattr(self, name)
            if values.shape != expected:
                raise DataError(
                    f"{name} of a SensorLaw", given=f"shape {values.shape}", expected=f"{expected}"
                )
            if (values < 0.0).any() or not np.allclose(values.sum(axis=-1), 1.0, rtol=1e-9):
                raise DataError(
                    f"{name} of a SensorLaw", given=f"{values}", expected="probabilities"
                )

    def steps(self, T: int) -> Array:
        """The kernels of T steps, (T, 4, 4)."""
        return np.broadcast_to(self.kernel, (T, 4, 4)) if self.kernels is None else self.kernels

    @classmethod
    def over(cls, spec: Spec, T: int, params: Mapping[str, Array | float] | None = None) -> Self:
        """The law over a record, with the parameters of each sample, (T,)."""
        law, faults = cls.from_spec(spec), spec.faults.sensor
        law = replace(law, factors=factors_of(spec, T, params))
        if faults is not None and faults.first is not None:
            at = first_sample(spec, params)
            chain = faults.law or Matrix.of(faults.kernel)
            own = initial_of(faults.initial, faults.first, chain, at)
            law = replace(law, initial=own / own.sum())
        if faults is None or faults.law is None or not T:
            return law
        samples, which = parameter_samples(spec, T, params)
        kernels = np.array([faults.law.values(at) for at in samples])[which]
        if not faults.independent:
            return replace(law, kernels=kernels)
        later = np.concatenate([kernels[1:], kernels[-1:]])  # the mode follows from its own sample
        return replace(law, kernels=later, initial=kernels[0, 0], announced=kernels[:, 0])

    @classmethod
    def from_spec(cls, spec: Spec) -> Self:
        """Take the law from ``faults.sensor``; what depends on parameters has the defaults."""
        faults = spec.faults.sensor
        if faults is None or not faults.kernel:
            raise DataError(
                "faults.sensor", given="no law of the modes", expected="problem 1, 2, 3 or 4"
            )
        return cls(
            kernel=np.array(faults.kernel),
            initial=np.array(faults.initial),
            noise_factor=faults.noise_factor,
            rows=faults.rows,
        )


def factors_of(spec: Spec, T: int, params: Mapping[str, Array | float] | None) -> Array | None:
    """C of each of T samples where it depends on parameters."""
    faults = spec.faults.sensor
    if faults is None or faults.factor is None:
        return None
    samples, which = parameter_samples(spec, T, params)
    return np.array([evaluate(faults.factor, at) for at in samples])[which]


def mode_plant(
    system: LinearSystem, law: SensorLaw, k: int, mode: int
) -> tuple[Array, Array, Array, Array]:
    """The measurement of one mode: y = G C x + G D u + G d + v with Cov v = T R T, eq. (2)."""
    gamma, delta = gamma_delta(law, np.array([mode]), slice(k, k + 1))
    signal, noise = np.ones((2, system.ny, 1))
    signal[list(law.rows)], noise[list(law.rows)] = gamma, np.sqrt(delta)
    R = noise * system.R[k] * noise.T
    return signal * system.C[k], signal * system.D[k], R, signal[:, 0] * system.d[k]


def sensed_modes(system: LinearSystem, law: SensorLaw) -> JumpSystem:
    """The four conditions of the sensor as modes that all move alike."""
    T = system.length
    plants = [[mode_plant(system, law, k, mode) for mode in range(4)] for k in range(T)]
    return JumpSystem(
        **{
            name: np.array([[each[at] for each in row] for row in plants])
            for at, name in enumerate("CDRd")
        },
        **{name: np.repeat(getattr(system, name)[:, np.newaxis], 4, axis=1) for name in "ABQc"},
        x0=system.x0,
        P0=system.P0,
        transitions=law.steps(T),
        initial=law.initial,
        announced=law.announced,
        arrival=np.array([[0.0, 1.0]] * 2),
        arrival_initial=np.array([0.0, 1.0]),
    )


def gamma_delta(
    law: SensorLaw, modes: NDArray[np.int64], samples: slice = slice(None)
) -> tuple[Array, Array]:
    """The fault indicators of modes at some samples, (T,) each."""
    factor = law.noise_factor if law.factors is None else law.factors[samples]
    return GAMMA[modes], np.where(modes % 2 == 1, factor, 1.0)


def draw_modes(law: SensorLaw, T: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw the modes of T samples."""
    return draw_chain(law.steps(T), law.initial, T, rng)


def simulate_sensor(
    system: LinearSystem, law: SensorLaw, u: Array | None, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Draw one record of measurements and the modes behind it, eq. (1)-(2); u (T, q)."""
    T, n, p = system.length, system.nx, system.ny
    u = system.inputs(u)
    modes = draw_modes(law, T, rng)
    x = system.x0 + square_root(system.P0) @ rng.standard_normal(n)
    y = np.empty((T, p))
    for k in range(T):
        C, D, R, d = mode_plant(system, law, k, int(modes[k]))
        y[k] = C @ x + D @ u[k] + d + square_root(R) @ rng.standard_normal(p)
        noise = square_root(system.Q[k]) @ rng.standard_normal(n)
        x = system.A[k] @ x + system.B[k] @ u[k] + system.c[k] + noise
    return y, modes


def nominal_share(law: SensorLaw) -> float:
    """Pr(delta = 1 | gamma = 0) under the stationary law: the constant that three modes need.

    Where there is no such law with gamma = 0 the initial one takes its place, then the sum of all
    ways from visited modes to gamma = 0, then 1.
    """
    ways = law.kernel[_visited(law)].sum(axis=0)
    for now in (_stationary_law(law.kernel), law.initial, ways):
        if now is not None and now[2] + now[3] > 0.0:
            return float(now[2] / (now[2] + now[3]))
    return 1.0


def aggregate(law: SensorLaw) -> tuple[Array, Array]:
    """Kernel and initial law of the three modes (1, 1), (1, C) and {gamma = 0}, sec. IV."""
    share = nominal_share(law)
    within = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, share, 1.0 - share]])
    members = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]])
    return within @ law.kernel @ members, law.initial @ members


def is_lumpable(law: SensorLaw) -> tuple[bool, float]:
    """Whether delta is of no account while gamma = 0, so that three modes do as well as four.

    (0, 1) and (0, C) have the same successors, and gamma = 0 comes with delta = 1 in the same share
    whatever the mode before it, and at the start. Modes that cannot be reached are not asked.
    """
    share, visited = nominal_share(law), _visited(law)
    laws = np.vstack([law.initial, law.kernel[visited]])
    size = float(np.abs(laws[:, 2] - share * (laws[:, 2] + laws[:, 3])).max())
    if visited[2] and visited[3]:
        size = max(size, float(np.abs(law.kernel[2] - law.kernel[3]).max()))
    return size <= SAME_PROBABILITY, size


def _visited(law: SensorLaw) -> NDArray[np.bool_]:
    """Modes that can be reached from the initial law."""
    return np.atleast_1d(_reaches(law.kernel)[law.initial > 0.0].any(axis=0))


def _stationary_law(kernel: Array) -> Array | None:
    """The law with law @ kernel == law; None if there are several."""
    common = np.asarray(_reaches(kernel).all(axis=0))  # the class that no start avoids for ever
    if not common.any():
        return None
    law = np.zeros(4)
    law[common] = lasting_law(kernel[np.ix_(common, common)])
    return law


def _reaches(kernel: Array) -> NDArray[np.bool_]:
    """Whether mode j can follow mode i in any number of samples, none included."""
    paths = np.linalg.matrix_power(np.eye(4) + (kernel > 0.0), 4)
    return np.asarray(paths > 0.0)
