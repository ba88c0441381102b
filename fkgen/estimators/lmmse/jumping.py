"""A jumping plant as a linear filter sees it: which modes, which coordinates, which ports.

The filter estimates z^i = x 1{mode = i}, Costa 1994, in the coordinates (z^1, ..., z^(N-1), x): x
itself in place of the last part. Where the second moments of the state grow without bound, those of
all z^i do, and x as their sum would lose its digits; here its error never meets them unless the
modes differ. With known offsets every part is (x, 1) 1{mode = i}, and the sum of the ones is known.

The plant of every mode of a jumping plant, as CasADi matrices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.errors import InternalError
from fkgen.faults import JumpFaults
from fkgen.problem import Matrix, Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.probability import stationary_law
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.linalg import sparse
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant, lift, plant_of


@dataclass(frozen=True, slots=True)
class JumpModes:
    """A plant with several modes.

    Attributes
    ----------
    base : Plant
        The plant of ``[model]``: parameters and names; all modes share them.
    plants : tuple of Plant
        Mode by mode, with matrices of its own.
    offsets : tuple of (n, 1) SX
        c of every mode.
    """

    base: Plant
    plants: tuple[Plant, ...]
    offsets: tuple[ca.SX, ...]


def jump_faults_of(spec: Spec) -> JumpFaults:
    """The jump faults of a spec that has some."""
    if spec.faults.jump is None:
        raise InternalError(f"{spec.filter.family} without jump faults")
    return spec.faults.jump


def jump_modes_of(spec: Spec) -> JumpModes:
    """Lift the modes of a spec to CasADi; they share the symbols of the parameters.

    Matrices that modes have in common are the same object.
    """
    base, faults = plant_of(spec), jump_faults_of(spec)
    known: dict[tuple[str, Matrix], ca.SX] = {}
    plants = []
    for mode in faults.modes:
        lifted: dict[str, Any] = {}
        for letter in ("A", "B", "C", "D", "Q", "R", "c"):
            key = letter, getattr(mode, letter)
            if key not in known:
                known[key] = lift(key[1], base.parameters)
            lifted[letter] = known[key]
        exact = mode.R.is_constant and is_singular(mode.R.values())
        plants.append(replace(base, noise_free=exact, **lifted))
    return JumpModes(base, tuple(plants), tuple(plant.c for plant in plants))


Array = NDArray[np.float64]

#: Largest change by one step of a law that counts as stationary.
STATIONARY = 1e-13


@dataclass(frozen=True, slots=True, kw_only=True)
class Jumping:
    """The split of one spec.

    The parts of the state belong to pairs (gamma, mode) where gamma is a Markov chain that is not
    observed, first all with gamma = 1; else to modes.

    Attributes
    ----------
    spec, faults
        What was asked for.
    plants : tuple of N Plant
        Mode by mode.
    kernel : (N, N) ndarray
        Transition of the modes.
    arrival : (G, G) ndarray
        Transition of gamma, states (1, 0); of size 1 where gamma is no part of the mode.
    shares : tuple of G float
        Its stationary law.
    rate : float
        Pr(gamma = 1) as far as it is not a part of the mode.
    ones : bool
        Whether the parts are (x, 1) 1{mode}: something known is added to the state, or to y.
    """

    spec: Spec
    faults: JumpFaults
    plants: tuple[Plant, ...]
    kernel: Array
    arrival: Array
    shares: tuple[float, ...]
    rate: float
    ones: bool

    @classmethod
    def of(cls, spec: Spec) -> Jumping:
        """Read the arrivals of a spec: what a detector decides is no longer random."""
        faults = jump_faults_of(spec)
        rate, arrival, shares = 1.0, np.eye(1), (1.0,)
        if faults.arrival == "unknown" and spec.filter.options.detector == "none":
            if faults.arrival_chain:
                arrival = np.array(faults.arrival_chain)[::-1, ::-1]
                law = stationary_law(arrival)
                shares = (1.0,) if law is None else tuple(law.tolist())
            elif faults.arrival_rate is not None:
                rate = faults.arrival_rate
        return cls(
            spec=spec,
            faults=faults,
            plants=jump_modes_of(spec).plants,
            kernel=np.array(faults.transition),
            arrival=arrival,
            shares=shares,
            rate=rate,
            ones=faults.has_offsets,
        )

    @property
    def base(self) -> Plant:
        """Any plant: for names and sizes, which all modes share."""
        return self.plants[0]

    @property
    def modes(self) -> int:
        """Number N of modes."""
        return len(self.plants)

    @property
    def parts(self) -> int:
        """Number of parts of the state."""
        return len(self.shares) * self.modes

    @property
    def width(self) -> int:
        """Length of a part: that of x, or of (x, 1)."""
        return self.base.nx + (1 if self.ones else 0)

    @property
    def size(self) -> int:
        """Length of the split state: all parts but the last, then x."""
        return (self.parts - 1) * self.width + self.base.nx

    @property
    def own(self) -> slice:
        """Where x stands in the split state."""
        return slice(self.size - self.base.nx, self.size)

    @property
    def transition(self) -> Array:
        """Transition of the parts."""
        return np.asarray(np.kron(self.arrival, self.kernel))

    @property
    def settled(self) -> bool:
        """Whether the law of the mode never changes."""
        law = np.array(self.faults.initial)
        return bool(np.abs(law @ self.kernel - law).max() <= STATIONARY)

    @property
    def restarts(self) -> bool:
        """Whether a lock-out starts the filter again."""
        options = self.spec.filter.options
        return bool(options.detector != "none" and options.reinitialise)

    @property
    def means(self) -> bool:
        """Whether the first moments of the parts are carried along."""
        return self.ones or self.restarts

    def law(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """Law of the mode at the sample that is corrected, (N,)."""
        constant = ca.SX(list(self.faults.initial))
        return constant if self.settled else symbols["predicted_mode_law"]

    def plant(self, plants: tuple[Plant, ...], part: int) -> Plant:
        """The plant of a part."""
        return plants[part % self.modes]

    def signal(self, part: int) -> bool:
        """Whether a part has a signal."""
        return part < self.modes


def split_ports(split: Jumping, *, covariances: bool) -> tuple[Port, ...]:
    """Estimate and moments of the split state; with a constant gain there are no covariances."""
    n, M = split.base.nx, split.size
    member = "(x, 1) 1{mode}" if split.ones else "x 1{mode}"
    what = f"{member} for all parts but the last, then of x"
    ports = [
        _state("augmented_state", (M,), f"estimate of {what}, at k+1 given y[0..k]"),
        _state("augmented_filtered_state", (M,), "the same at k given y[0..k]"),
    ]
    if covariances:
        ports += [
            _state("augmented_covariance", (M, M), "error covariance of augmented_state"),
            _state("augmented_filtered_covariance", (M, M), "the same at k given y[0..k]"),
        ]
    for prefix, k in (("", "k"), ("predicted_", "k+1")):
        if covariances:
            meaning = f"E[x x' 1{{mode}}] at {k}, unconditional"
            name = f"{prefix}mode_second_moment"
            ports.append(_state(name, (split.modes, n, n), meaning))
        if split.means if covariances else split.restarts:
            meaning = f"E[x 1{{mode}}] at {k}, unconditional"
            ports.append(_state(f"{prefix}mode_first_moment", (split.modes, n), meaning))
    return tuple(ports)


def law_ports(split: Jumping) -> tuple[Port, ...]:
    """The unconditional law of the mode."""
    N, meaning = split.modes, "Pr(mode), unconditional, at"
    now = _state("mode_law", (N,), f"{meaning} k")
    return (now,) if split.settled else (now, _state("predicted_mode_law", (N,), f"{meaning} k+1"))


def _state(name: str, shape: tuple[int, ...], meaning: str) -> Port:
    symmetric = name.endswith(("covariance", "second_moment"))
    return Port(name=name, shape=shape, role=Role.STATE, meaning=meaning, symmetric=symmetric)


def split_start(split: Jumping) -> dict[str, tuple[float, ...]]:
    """Start values of `split_ports` and `law_ports`: the prior, split by the law of the mode."""
    model, law = split.spec.model, np.array(split.faults.initial)
    x0, P0 = model.x0.values().ravel(), model.P0.values()
    second = P0 + np.outer(x0, x0)
    state, covariance = _split_prior(split, x0, P0)
    start: dict[str, Any] = {"predicted_mode_law": law, "mode_law": law}
    for of in ("", "filtered_"):
        start[f"augmented_{of}state"] = state
        start[f"augmented_{of}covariance"] = _packed(covariance)
    for of in ("", "predicted_"):
        start[f"{of}mode_second_moment"] = np.concatenate([p * _packed(second) for p in law])
        start[f"{of}mode_first_moment"] = np.kron(law, x0)
    return {name: tuple(np.asarray(value, float).tolist()) for name, value in start.items()}


def _split_prior(split: Jumping, x0: Array, P0: Array) -> tuple[Array, Array]:
    """Mean and covariance of the split state: x has P0, and that is in every part by its share."""
    share = np.kron(split.shares, split.faults.initial)[:-1]
    mean = np.append(x0, 1.0)[: split.width]
    outer = np.outer(mean, mean)
    spread = np.zeros_like(outer)
    spread[: len(x0), : len(x0)] = P0
    X = np.zeros((split.size, split.size))
    inner = slice(0, split.size - len(x0))
    # 1{i} - share: covariance of the indicators; times the mean on both sides.
    X[inner, inner] = np.kron(np.diag(share), spread) + np.kron(
        np.diag(share) - np.outer(share, share), outer
    )
    X[split.own, split.own] = P0
    X[inner, split.own] = np.kron(share[:, None], spread[:, : len(x0)])
    X[split.own, inner] = X[inner, split.own].T
    return np.concatenate([np.kron(share, mean), x0]), X


def _packed(matrix: Array) -> Array:
    return np.array([matrix[i, j] for i, j in triangle(len(matrix))])


def measured(split: Jumping, plants: tuple[Plant, ...], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """L and what is known: E[y | split state] = L (split state) + offset, without the rate."""

    def signal(part: int) -> ca.SX:
        plant = split.plant(plants, part)
        row = ca.horzcat(plant.C, plant.D @ u) if split.ones else plant.C
        return row if split.signal(part) else ca.SX(*row.shape)

    last, n = signal(split.parts - 1), split.base.nx
    blocks = [signal(part) - last for part in range(split.parts - 1)]
    offset = last[:, n:] if split.ones else ca.SX(split.base.ny, 1)
    return sparse(ca.horzcat(*blocks, last[:, :n])), offset
