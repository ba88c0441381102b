"""A plant that jumps between modes over a record, its channel, and its simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.oracle.exact.gaussian import Array, square_root
from fkgen.oracle.plants.actuator import Plant, first_sample, parameter_samples
from fkgen.problem import Matrix, Spec, evaluate
from fkgen.problem.probability import FirstLaw


@dataclass(frozen=True, eq=False, kw_only=True)
class JumpSystem(Plant):
    """x[k+1] = A_i x + B_i u + c_i + w, y[k] = gamma (C_i x + D_i u + d_i) + v, i = mode[k]."""

    VARYING = (*Plant.VARYING, "transitions")

    #: transitions, initial: (T, N, N), (N,): Pr(j at k+1 | i at k), and the law of mode[0]
    transitions: Array
    initial: Array
    #: arrival, arrival_initial: (2, 2), (2,): The same for gamma, states (0, 1); independent of
    #: the modes
    arrival: Array
    arrival_initial: Array
    #: (T, N): Pr(j at k+1) as sample k has it, where sample k+1 has its own; None elsewhere
    announced: Array | None = None
    arrival_rates: Array | None = None  # (T,): Pr(gamma = 1) where it depends on the sample
    arrivals: Array | None = None  # (T, 2, 2): arrival of each sample, where they differ
    kept: Array | None = None  # (N, n): 1 for the states that a mode has; None for all

    @property
    def count(self) -> int:
        """Number of modes, N."""
        return int(self.A.shape[1])

    @property
    def transition(self) -> Array:
        """The transition matrix where all samples have the same, (N, N)."""
        if np.ptp(self.transitions, axis=0).any():
            raise DataError("transitions", given="several", expected="one for all samples")
        return np.asarray(self.transitions[0])

    @property
    def channel(self) -> Array:
        """Transition of gamma from each sample to the next, (T, 2, 2)."""
        if self.arrivals is not None:
            return self.arrivals
        if self.arrival_rates is None:
            return np.broadcast_to(self.arrival, (self.length, 2, 2))
        rates = np.append(self.arrival_rates[1:], self.arrival_rates[-1])
        return np.stack([[1.0 - rates, rates]] * 2, axis=0).transpose(2, 0, 1)

    def over(self, piece: slice) -> Self:
        """The same plant over a piece of its samples, its prior unchanged."""
        names = ("announced", "arrival_rates", "arrivals")
        own = {name: getattr(self, name) for name in names}
        cut: dict[str, Any] = {k: None if v is None else v[piece] for k, v in own.items()}
        return replace(super().over(piece), **cut)

    def offsets(self, u: Array) -> tuple[Array, Array]:
        """What is known beside the state: B_i u + c_i, (T, N, n), and D_i u + d_i, (T, N, p)."""
        added, sensed = (np.einsum("kiab,kb->kia", each, u) for each in (self.B, self.D))
        return added + self.c, sensed + self.d

    @property
    def priors(self) -> tuple[Array, Array]:
        """Mean and covariance of x[0] in each mode, (N, n) and (N, n, n)."""
        kept = np.ones((self.count, self.nx)) if self.kept is None else self.kept
        return kept * self.x0, kept[:, :, None] * self.P0 * kept[:, None, :]

    def mode_law(self) -> Array:
        """Law of mode[k], (T, N)."""
        laws = [self.initial]
        for P in self.transitions[:-1]:
            laws.append(laws[-1] @ P)
        return np.array(laws)

    def without_inputs(self) -> Self:
        """The same plant at u = 0."""
        return replace(self, B=self.B[..., :0], D=self.D[..., :0])

    def always_arriving(self) -> Self:
        """The same plant without losses."""
        always = np.array([[0.0, 1.0]] * 2)
        none: dict[str, Any] = {"arrival_rates": None, "arrivals": None}
        return replace(self, arrival=always, arrival_initial=always[0], **none)

    @classmethod
    def from_spec(
        cls, spec: Spec, T: int, params: Mapping[str, Array | float] | None = None
    ) -> Self:
        """Sample the plant of a spec; params (T,)."""
        faults = spec.faults.jump
        if faults is None:
            raise DataError("faults.jump", given="nothing", expected="modes and their chain")
        samples, which = parameter_samples(spec, T, params)
        plant = {
            name: np.array(
                [[getattr(mode, name).values(at) for mode in faults.modes] for at in samples]
            )[which]
            for name in Plant.VARYING
        }
        plant |= {name: plant[name][..., 0] for name in ("c", "d")}
        rate = 1.0 if faults.arrival_rate is None else faults.arrival_rate
        rates = None
        if faults.rate is not None:
            rates = np.array([evaluate(faults.rate, at) for at in samples])[which]
        moving, first = faults.arrivals, first_sample(spec, params)
        arrival = np.array(faults.arrival_chain or [[1.0 - rate, rate]] * 2)
        arrivals = None
        if moving is not None:
            arrivals = np.array([moving.values(at) for at in samples])[which]
            arrival = moving.values(first)
        start = lasting_law(arrival) if faults.arrival_chain else arrival[0]
        every = tuple(range(spec.model.nx))
        has = [every if mode.kept is None else mode.kept for mode in faults.modes]
        return cls(
            **plant,
            kept=np.array([[float(i in states) for i in every] for states in has]),
            x0=spec.model.x0.values(first)[:, 0],
            P0=spec.model.P0.values(first),
            **chain_of(spec, T, params),
            arrival=arrival,
            arrival_initial=start if rates is None else np.array([1.0 - rates[0], rates[0]]),
            arrival_rates=rates,
            arrivals=arrivals,
        )


def chain_of(
    spec: Spec, T: int, params: Mapping[str, Array | float] | None = None
) -> dict[str, Array]:
    """The chain of the modes of a spec: transitions (T, N, N) and initial (N,)."""
    faults = spec.faults.jump
    if faults is None:
        raise DataError("faults.jump", given="nothing", expected="modes and their chain")
    chain = Matrix.of(faults.transition) if faults.law is None else faults.law
    samples, which = parameter_samples(spec, T, params)
    first = samples[which[0]] if len(which) else dict(spec.defaults)
    return {
        "transitions": np.array([chain.values(at) for at in samples])[which],
        "initial": initial_of(faults.initial, faults.first, chain, first),
    }


def initial_of(
    stated: tuple[float, ...], first: FirstLaw | None, law: Matrix, at: Mapping[str, float]
) -> Array:
    """The law of the mode at sample 0, with the parameters of that sample."""
    if first is None:
        return np.array(stated)
    if first.stated:
        return np.array([evaluate(each, at) for each in first.stated])
    return lasting_law(law.values(at))


def lasting_law(transition: Array) -> Array:
    """The law that a chain keeps: the solution of law (P - I) = 0 that sums to one."""
    N = len(transition)
    equations = np.vstack([transition.T - np.eye(N), np.ones(N)])
    law = np.linalg.lstsq(equations, np.append(np.zeros(N), 1.0), rcond=None)[0]
    return np.asarray(np.maximum(law, 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class JumpRecord:
    """A simulated record."""

    #: y, x: (T, p), (T, n): Measurements and the states behind them; a lost sample is noise
    #: alone
    y: Array
    x: Array
    mode: NDArray[np.int64]  # (T,)
    arrived: NDArray[np.bool_]  # (T,): gamma


def simulate_jumps(system: JumpSystem, u: Array, rng: np.random.Generator) -> JumpRecord:
    """Draw one record; u (T, q)."""
    T, n, p = system.length, system.nx, system.ny
    mode = draw_chain(system.transitions, system.initial, T, rng)
    arrived = draw_chain(system.channel, system.arrival_initial, T, rng) == 1
    added, sensed = system.offsets(u)
    x, y = np.empty((T + 1, n)), np.empty((T, p))
    x[0] = system.x0 + square_root(system.P0) @ rng.standard_normal(n)
    at = (np.arange(T), mode)
    x[0] *= 1.0 if system.kept is None else system.kept[mode[0]]
    # modes with states of their own are entered by a step of their own
    moves = mode if system.kept is None or system.kept.all() else np.append(mode[1:], mode[-1])
    R, Q = square_root(system.R[at]), square_root(system.Q[np.arange(T), moves])
    for k, (i, j) in enumerate(zip(mode, moves, strict=True)):
        noise = R[k] @ rng.standard_normal(p)
        y[k] = arrived[k] * (system.C[k, i] @ x[k] + sensed[k, i]) + noise
        x[k + 1] = system.A[k, j] @ x[k] + added[k, j] + Q[k] @ rng.standard_normal(n)
    return JumpRecord(y=y, x=x[:T], mode=mode, arrived=arrived)


def draw_chain(
    transitions: Array, initial: Array, T: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draw a path of T states of a Markov chain; transitions (T, N, N)."""
    path, law = np.zeros(T, dtype=np.int64), initial
    for k in range(T):
        path[k] = rng.choice(len(law), p=law / law.sum())
        law = transitions[k, path[k]]
    return path
