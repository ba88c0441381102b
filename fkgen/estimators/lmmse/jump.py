"""The LMMSE filter of a plant whose matrices follow a Markov chain; the gain follows the moments.

Costa 1994; Costa, Fragoso & Marques 2005, sec. 5.4; Nahi 1969 for arrivals of which only the rate
is known; Sun, Zhao & Yin for samples that a test rejects.

The filter estimates z^i = x 1{mode = i} in the coordinates (z^1, ..., z^(N-1), x): x itself in
place of the last part. Where the second moments of the state grow without bound, those of all z^i
do, and x as their sum would lose its digits; here its error never meets them unless the modes
differ. With known offsets every part is (x, 1) 1{mode = i}, and the sum of the ones is known.
Covariances of the indicators are written as second moments around their prediction, so that nothing
cancels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.gaussian.conditioning import Conditioned, condition
from fkgen.estimators.gaussian.estimate import (
    bound_all,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.sequential import Form
from fkgen.estimators.lmmse.loss_tests import LossTest, Verdict, loss_outcomes, loss_ports
from fkgen.faults.chain import Groups
from fkgen.faults.linear_optimal import EQUAL
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.linalg import column, congruence, outer_lower, pack, sparse, total, unpack
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant, mode_plants
from fkgen.symbolic.ports import innovation_ports, prior_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

Array = NDArray[np.float64]

#: Largest change by one step of probabilities that count as stationary.
STATIONARY = 1e-13


@dataclass(frozen=True, slots=True, kw_only=True)
class Jumping:
    """The augmented state of one spec: its parts, their chain, and what is carried along.

    A part belongs to a group of modes that differ in nothing but R; where losses are a Markov
    chain that is not observed, to such a pair of both, first all that arrive.
    """

    spec: Spec
    plants: tuple[Plant, ...]  # of every mode, then of every mode without a signal
    groups: Groups  # the modes that share a part
    kernel: Array  # (N, N), transition of the groups
    modes_kernel: Array  # (M, M), transition of the modes
    modes_initial: tuple[float, ...]
    arrival: Array  # transition of (arrived, lost); of size 1 where losses are no part of the mode
    shares: tuple[float, ...]  # its stationary law
    rate: float  # Pr(a sample arrives) as far as it is no part of the mode
    ones: bool  # parts are (x, 1) 1{mode}: something known is added to the state, or to y

    @classmethod
    def of(cls, spec: Spec) -> Jumping:
        """Read the chain of a spec: what a detector decides is no longer random."""
        chain, faults = spec.faults.chain(spec.model), spec.faults.jump
        rate, arrival, modes = 1.0, np.eye(1), chain.modes
        shares: tuple[float, ...] = (1.0,)
        if faults is not None and faults.arrival == "unknown" and not judges(spec):
            channel = faults.channel
            if faults.arrival_rate is not None:
                rate = faults.arrival_rate
            elif channel is not None:
                arrival = np.array(channel.transition)[::-1, ::-1]
                shares, modes = channel.initial[::-1], chain.times(channel).modes
        lumping = chain.lumped(tuple((i,) for i in range(len(chain.modes))))
        if faults is None:  # modes of jump faults are the user's: each has its part
            lumped = chain.lumped(chain.alike("ABCDQc"))
            lumping = lumped if lumped.unequal_successors <= EQUAL else lumping
        plants = mode_plants(spec, modes)
        return cls(
            spec=spec,
            plants=plants,
            groups=lumping.groups,
            kernel=np.array(lumping.transition),
            modes_kernel=np.array(chain.transition),
            modes_initial=chain.initial,
            arrival=arrival,
            shares=shares,
            rate=rate,
            ones=bool(spec.model.nu) or any(plant.c.nnz() for plant in plants),
        )

    @property
    def base(self) -> Plant:
        """Any plant: for names and sizes, which all modes share."""
        return self.plants[0]

    @property
    def modes(self) -> int:
        """Number N of groups of modes."""
        return len(self.groups)

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
        """Length of the augmented state: all parts but the last, then x."""
        return (self.parts - 1) * self.width + self.base.nx

    @property
    def own(self) -> slice:
        """Where x stands in the augmented state."""
        return slice(self.size - self.base.nx, self.size)

    @property
    def transition(self) -> Array:
        """Transition of the parts."""
        return np.asarray(np.kron(self.arrival, self.kernel))

    @property
    def settled(self) -> bool:
        """Whether the probabilities of the modes never change."""
        law = np.array(self.modes_initial)
        return bool(np.abs(law @ self.modes_kernel - law).max() <= STATIONARY)

    @property
    def restarts(self) -> bool:
        """Whether a lock-out starts the filter again."""
        return judges(self.spec) and self.spec.filter.reinitialise

    @property
    def means(self) -> bool:
        """Whether the first moments of the parts are carried along."""
        return self.ones or self.restarts

    def law(self, symbols: dict[str, ca.SX]) -> ca.SX:
        """Probabilities of the modes at the sample that is corrected, (M,)."""
        constant = ca.SX(list(self.modes_initial))
        return constant if self.settled else symbols["predicted_mode_law"]

    def grouped(self, law: ca.SX) -> ca.SX:
        """Probabilities of the groups from those of the modes, (N,)."""
        return column([total([law[i] for i in group]) for group in self.groups])

    def plant(self, plants: tuple[Plant, ...], part: int) -> Plant:
        """The plant of a part."""
        arrived, group = divmod(part, self.modes)
        return plants[(arrived * len(self.modes_initial) + self.groups[group][0]) % len(plants)]


def judges(spec: Spec) -> bool:
    """Whether a test decides which samples are lost."""
    return spec.faults.jump is not None and spec.filter.detector != "none"


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
    if split.spec.faults.sensor is not None:
        meaning = "E[x[k] x[k]'], unconditional"
        own = _state("state_second_moment", (n, n), meaning)
        ports.append(replace(own, role=Role.OUTPUT, unit="xx"))
    return tuple(ports)


def law_ports(split: Jumping) -> tuple[Port, ...]:
    """The unconditional law of the mode."""
    size, meaning = (len(split.modes_initial),), "Pr(mode), unconditional, at"
    now = _state("mode_law", size, f"{meaning} k")
    if split.settled:  # modes of a sensor have no port for what is known beforehand
        return () if split.spec.faults.jump is None else (now,)
    return now, _state("predicted_mode_law", size, f"{meaning} k+1")


def _state(name: str, shape: tuple[int, ...], meaning: str) -> Port:
    symmetric = name.endswith(("covariance", "second_moment"))
    return Port(name=name, shape=shape, role=Role.STATE, meaning=meaning, symmetric=symmetric)


def split_start(split: Jumping) -> dict[str, tuple[float, ...]]:
    """Start values of `split_ports` and `law_ports`: the prior, split by the law of the mode."""
    model, law = split.spec.model, np.array(split.modes_initial)
    groups = np.array([law[list(group)].sum() for group in split.groups])
    x0, P0 = model.x0.values().ravel(), model.P0.values()
    second = P0 + np.outer(x0, x0)
    state, covariance = _split_prior(split, groups, x0, P0)
    start: dict[str, Any] = {"predicted_mode_law": law, "mode_law": law}
    for of in ("", "filtered_"):
        start[f"augmented_{of}state"] = state
        start[f"augmented_{of}covariance"] = _packed(covariance)
    for of in ("", "predicted_"):
        start[f"{of}mode_second_moment"] = np.concatenate([p * _packed(second) for p in groups])
        start[f"{of}mode_first_moment"] = np.kron(groups, x0)
    return {name: tuple(np.asarray(value, float).tolist()) for name, value in start.items()}


def _split_prior(split: Jumping, law: Array, x0: Array, P0: Array) -> tuple[Array, Array]:
    """Mean and covariance of the split state: x has P0, and that is in every part by its share."""
    share = np.kron(split.shares, law)[:-1]
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
        return ca.horzcat(plant.C, plant.D @ u) if split.ones else plant.C

    last, n = signal(split.parts - 1), split.base.nx
    blocks = [signal(part) - last for part in range(split.parts - 1)]
    offset = last[:, n:] if split.ones else ca.SX(split.base.ny, 1)
    return sparse(ca.horzcat(*blocks, last[:, :n])), offset


@dataclass(frozen=True, slots=True)
class Moments:
    """E[x x' 1{mode}], E[x 1{mode}] and Pr(mode), mode by mode; no first moments if not needed."""

    second: tuple[ca.SX, ...]
    first: tuple[ca.SX, ...]
    law: ca.SX


def moments_of(split: Jumping, symbols: dict[str, ca.SX], prefix: str) -> Moments:
    """The moments that are carried along, as matrices and columns."""
    n = split.base.nx
    second = ca.vertsplit(symbols[f"{prefix}mode_second_moment"], n * (n + 1) // 2)
    first: tuple[ca.SX, ...] = ()
    if split.means:
        first = tuple(ca.vertsplit(symbols[f"{prefix}mode_first_moment"], n))
    law = split.grouped(law_now(split, symbols, prefix))
    return Moments(tuple(unpack(each, n) for each in second), first, law)


def law_now(split: Jumping, symbols: dict[str, ca.SX], prefix: str) -> ca.SX:
    """Probabilities of the modes: predicted, or those of the sample that was corrected."""
    return split.law(symbols) if prefix or split.settled else symbols["mode_law"]


def next_law(split: Jumping, law: ca.SX) -> ca.SX:
    """Probabilities of the modes one sample later, their rounding taken out of the sum."""
    if split.settled:
        return law
    moved = ca.SX(ca.DM(split.modes_kernel)).T @ law
    return moved / ca.sum1(moved)


def shared(matrices: list[ca.SX], weights: list[ca.SX]) -> ca.SX:
    """Weighted sum; weights of a matrix that several modes have in common are added first."""
    distinct: dict[int, tuple[ca.SX, ca.SX]] = {}
    for matrix, weight in zip(matrices, weights, strict=True):
        known = distinct.get(id(matrix))
        distinct[id(matrix)] = (matrix, weight if known is None else known[1] + weight)
    return total([weight * matrix for matrix, weight in distinct.values()])


def offset_of(plant: Plant, u: ca.SX) -> ca.SX:
    """What is known and added to the state: B u + c."""
    return plant.B @ u + plant.c


def moved_moments(
    script: Script, split: Jumping, plants: tuple[Plant, ...], now: Moments, u: ca.SX
) -> list[ca.SX]:
    """Second moment of (A x + b, 1) 1{mode}, or of A x 1{mode}, mode by mode."""
    n, result = split.base.nx, []
    for i in range(split.modes):
        plant = split.plant(plants, i)
        if split.ones:
            last = ca.horzcat(ca.SX(1, n), ca.SX(1))
            through = sparse(ca.vertcat(ca.horzcat(plant.A, offset_of(plant, u)), last))
            q = now.first[i]
            before = ca.blockcat(now.second[i], q, q.T, now.law[i])
        else:
            through, before = plant.A, now.second[i]
        moved = script.let(f"moved_moment_{i}", congruence(through, before))
        result.append(unpack(moved, split.width))
    return result


def plant_noise(split: Jumping, plants: tuple[Plant, ...], law: ca.SX) -> list[ca.SX]:
    """sum_i p_ij pi_i Q_i: what the plant's own noise adds in the step to each mode."""
    P, modes = split.kernel, range(split.modes)
    Q = [split.plant(plants, i).Q for i in modes]
    return [shared(Q, [float(P[i, j]) * law[i] for i in modes]) for j in modes]


def later_moments(
    split: Jumping, moved: list[ca.SX], noise: list[ca.SX]
) -> tuple[list[ca.SX], list[ca.SX]]:
    """Packed second and first moments one sample later."""
    P, n, N = split.kernel, split.base.nx, split.modes
    mixed = [
        total([float(P[i, j]) * moved[i] for i in range(N) if P[i, j]] or [0 * moved[0]])
        for j in range(N)
    ]
    second = [pack(mixed[j][:n, :n] + noise[j]) for j in range(N)]
    return second, [ca.densify(each[:n, n]) for each in mixed] if split.ones else []


def split_noise(split: Jumping, moved: list[ca.SX], noise: list[ca.SX]) -> ca.SX:
    """Covariance of the noise of the split state, as a matrix of which the lower half counts."""
    P, w, n = split.transition, split.width, split.base.nx
    count = split.parts
    parts = [share * moment for share in split.shares for moment in moved]
    own = [share * each for share in split.shares for each in noise]
    W = ca.SX(split.size, split.size)
    for j in range(count - 1):
        at = slice(j * w, j * w + n)
        W[split.own, at] = own[j]
        for k in range(j + 1):
            shares = [P[i, j] * ((1.0 - P[i, j]) if j == k else -P[i, k]) for i in range(count)]
            terms = [float(s) * part for s, part in zip(shares, parts, strict=True) if s]
            block = total(terms) if terms else ca.SX(w, w)
            if j == k:
                block[:n, :n] = block[:n, :n] + own[j]
            W[j * w : j * w + w, k * w : k * w + w] = block
    W[split.own, split.own] = total(noise)
    return sparse(W)


def unconditional(split: Jumping, now: Moments) -> tuple[ca.SX, ca.SX]:
    """Mean and packed covariance of the split state without any measurement."""
    n, w = split.base.nx, split.width
    mean = ca.SX(split.size, 1)
    X = ca.SX(split.size, split.size)
    means, seconds = [], []
    for share in split.shares:
        for i in range(split.modes):
            q, pi = share * now.first[i], share * now.law[i]
            Z = share * now.second[i]
            means.append(ca.vertcat(q, pi) if split.ones else q)
            seconds.append(ca.blockcat(Z, q, q.T, pi) if split.ones else Z)
    for i in range(split.parts - 1):
        mean[i * w : (i + 1) * w] = means[i]
        X[i * w : (i + 1) * w, i * w : (i + 1) * w] = seconds[i]
        X[split.own, i * w : (i + 1) * w] = seconds[i][:n, :]
    mean[split.own] = total([each[:n] for each in means])
    X[split.own, split.own] = total([each[:n, :n] for each in seconds])
    spread = outer_lower(mean, mean)
    lower = [X[i, j] for i, j in triangle(split.size)]
    return mean, ca.densify(ca.vertcat(*lower)) - spread


def steps(split: Jumping, plants: tuple[Plant, ...], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant of (t, u): what every mode makes of the split state."""
    w, n, last = split.width, split.base.nx, split.plant(plants, split.parts - 1)
    G = ca.SX(split.size, split.size)
    known = offset_of(last, u)
    for i in range(split.parts - 1):
        plant, at = split.plant(plants, i), slice(i * w, i * w + n)
        G[at, at] = plant.A
        G[split.own, at] = plant.A - last.A
        if split.ones:
            one = i * w + n
            G[at, one] = offset_of(plant, u)
            G[one, one] = 1
            G[split.own, one] = offset_of(plant, u) - known
    G[split.own, split.own] = last.A
    constant = ca.SX(split.size, 1)
    constant[split.own] = known
    return sparse(G), sparse(constant)


def mixing(split: Jumping) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant that make the next split state of (t, u)."""
    P, w, n, last = split.transition, split.width, split.base.nx, split.parts - 1
    M, constant = ca.SX(split.size, split.size), ca.SX(split.size, 1)
    for j in range(last):
        to = slice(j * w, j * w + w)
        M[slice(j * w, j * w + n), split.own] = float(P[last, j]) * ca.SX.eye(n)
        for i in range(last):
            share = float(P[i, j] - P[last, j])
            M[to, slice(i * w, i * w + w)] = share * ca.SX.eye(w)
        if split.ones:
            constant[j * w + n] = float(P[last, j])
    M[split.own, split.own] = ca.SX.eye(n)
    return sparse(M), sparse(constant)


def lean_congruence(M: ca.SX, P: ca.SX) -> ca.SX:
    """Packed ``M P M'``, the second product of each entry along the emptier of its two rows."""
    T = M @ P
    rows = [sparse(M[i, :].T) for i in range(M.shape[0])]
    entries = []
    for i, j in triangle(len(rows)):
        a, b = (i, j) if rows[j].nnz() <= rows[i].nnz() else (j, i)
        entries.append(ca.mtimes(T[a, :], rows[b]))
    return column(entries)


def predict_split(split: Jumping, symbols: dict[str, ca.SX]) -> Phase:
    """The phase ``predict`` of a gain that follows the moments."""
    script, n = Script(symbols), split.base.nx
    u = symbols["u"]
    plants = bound_all(script, split.plants, "ABQc")
    now = moments_of(split, symbols, "")
    with script.titled("second moments, mode by mode"):
        moved = moved_moments(script, split, plants, now, u)
        law = next_law(split, law_now(split, symbols, ""))
        noise = [
            unpack(script.let(f"plant_noise_{j}", pack(each)), n)
            for j, each in enumerate(plant_noise(split, plants, now.law))
        ]
        second, first = later_moments(split, moved, noise)
        if split.restarts and not split.ones:
            first = moved_means(split, plants, now.first, now.law)
        results = {"predicted_mode_second_moment": ca.vertcat(*second)}
        if split.means:
            results["predicted_mode_first_moment"] = ca.vertcat(*first)
        if not split.settled:
            results["predicted_mode_law"] = law
    with script.titled("every mode's step"):
        G, known = steps(split, plants, u)
        moved_state = script.let("moved_state", G @ symbols["augmented_filtered_state"] + known)
        filtered = unpack(symbols["augmented_filtered_covariance"], split.size)
        packed = script.let("moved_covariance", lean_congruence(G, filtered))
    with script.titled("mixing by the chain"):
        M, constant = mixing(split)
        state = M @ moved_state + constant
        covariance = lean_congruence(M, unpack(packed, split.size))
        covariance += pack(split_noise(split, moved, noise))
    with script.titled("prediction of the next sample"):
        results |= {"augmented_state": state, "augmented_covariance": covariance}
        results |= whole(split, state, covariance, "predicted")
        guards = [finite(state, covariance)]
        guards += [finite(column([each[0]]), each) for each in second]
        script.put(results, guards)
    return script.phase()


def moved_means(
    split: Jumping, plants: tuple[Plant, ...], means: tuple[ca.SX, ...], law: ca.SX
) -> list[ca.SX]:
    """E[x 1{mode}] one sample later, without inputs."""
    own = [split.plant(plants, i) for i in range(split.modes)]
    each = [plant.A @ means[i] + law[i] * plant.c for i, plant in enumerate(own)]
    mixed = ca.SX(ca.DM(split.kernel)).T @ ca.horzcat(*each).T
    return [ca.densify(mixed[j, :].T) for j in range(split.modes)]


def whole(split: Jumping, state: ca.SX, packed: ca.SX, prefix: str) -> dict[str, ca.SX]:
    """State and covariance of x, which the split state ends with."""
    X = unpack(packed, split.size)
    return {
        f"{prefix}_state": state[split.own],
        f"{prefix}_covariance": pack(X[split.own, split.own]),
    }


def jump_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion with a gain that follows the moments."""
    split = Jumping.of(spec)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *(loss_ports(spec) if judges(spec) else ()),
        *law_ports(split),
        *split_ports(split, covariances=True),
    )
    symbols = symbols_of(spec, split.base, ports)
    form = update_form(spec, noisy(split), augmented=False)
    x0, packed = prior_of(spec)
    start = split_start(split)
    start |= {f"{of}_state": x0 for of in ("predicted", "filtered")}
    start |= {f"{of}_covariance": packed for of in ("predicted", "filtered")}
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial={port.name: start[port.name] for port in ports if port.name in start},
        update=_update(split, symbols, form),
        predict=predict_split(split, symbols),
        notes=(f"covariance update: {form} form", *notes_of(split)),
        outcomes=loss_outcomes(spec) if judges(spec) else (),
    )


def noisy(split: Jumping) -> Plant:
    """A plant with the names of the rows, and whether a mode may measure without noise."""
    return replace(split.base, noise_free=any(plant.noise_free for plant in split.plants))


def notes_of(split: Jumping) -> tuple[str, ...]:
    """What the header says about modes and arrivals."""
    options, faults = split.spec.filter, split.spec.faults.jump
    notes = [f"state split by {split.parts} modes"]
    if judges(split.spec):
        notes.append(
            f"a sample that the test {options.detector} rejects is replaced by its prediction;"
            f" status LOCKED_OUT from {options.lock_out} in a row on"
        )
    elif faults is not None and faults.arrival == "unknown":
        law = "a Markov chain" if faults.arrival_chain else f"the rate {faults.arrival_rate:g}"
        notes.append(f"of arrivals only {law} is known")
    return tuple(notes)


def mean_noise(script: Script, split: Jumping, plants: tuple[Plant, ...], law: ca.SX) -> ca.SX:
    """sum_i pi_i R_i, its computed entries named."""
    weights = ca.vertsplit(law)
    noises = [plant.R for plant in plants[: len(split.modes_initial)]]
    return script.name_entries("mean_noise", sparse(shared(noises, weights)))


def signal_moment(split: Jumping, plants: tuple[Plant, ...], now: Moments, u: ca.SX) -> ca.SX:
    """Packed E[s s'] of the signal s = C x + D u; modes that measure alike are added first."""
    groups: dict[tuple[int, int], list[int]] = {}
    for i in range(split.modes):
        plant = split.plant(plants, i)
        groups.setdefault((id(plant.C), id(plant.D)), []).append(i)
    terms = []
    for members in groups.values():
        plant = split.plant(plants, members[0])
        second = total([now.second[i] for i in members])
        if plant.D.nnz():
            first = total([now.first[i] for i in members])
            law = total([now.law[i] for i in members])
            whole_moment = ca.blockcat(second, first, first.T, law)
            terms.append(congruence(ca.horzcat(plant.C, plant.D @ u), whole_moment))
        else:
            terms.append(congruence(plant.C, second))
    return total(terms)


def _update(split: Jumping, symbols: dict[str, ca.SX], form: Form) -> Phase:
    script, u = Script(symbols), symbols["u"]
    demand_positive(script, symbols["augmented_covariance"], split.size)
    plants = bound_all(script, split.plants, "CDR")
    now = moments_of(split, symbols, "predicted_")
    noise = mean_noise(script, split, plants, split.law(symbols))
    prior = (symbols["augmented_state"], unpack(symbols["augmented_covariance"], split.size))
    L, offset = measured(split, plants, u)
    measurement = measurement_of(
        noisy(split),
        scalar=split.spec.code.scalar,
        y=symbols["y"],
        C=sparse(split.rate * L),
        offset=split.rate * offset,
        R=_with_doubt(script, split, noise, lambda: signal_moment(split, plants, now, u)),
    )
    found = condition(script, prior, measurement, form=form)
    demand_finite(script, found.mean)
    state, covariance, results = found.mean, found.covariance, {}
    if judges(split.spec):
        test = LossTest(script, symbols, split.spec)
        verdict = test.verdict(found, measurement, noise)
        state, covariance = _kept(script, split, symbols, (found, verdict, test), now)
        results = verdict.results
    results |= {
        "augmented_filtered_state": state,
        "augmented_filtered_covariance": covariance,
        **whole(split, state, covariance, "filtered"),
        **innovation_results(found),
        **carried(split, symbols),
    }
    with script.titled("results of the update"):
        script.put(results)
    return script.phase()


def _with_doubt(script: Script, split: Jumping, noise: ca.SX, moment: Callable[[], ca.SX]) -> ca.SX:
    """R, and p (1 - p) E[s s'] where nobody knows whether y holds the signal s: Nahi 1969."""
    doubt = split.rate * (1.0 - split.rate)
    if not doubt:
        return noise
    p = split.base.ny
    signal = unpack(script.let("signal_moment", moment()), p)
    return script.name_entries("noise_and_doubt", sparse(noise + doubt * signal))


def _kept(
    script: Script,
    split: Jumping,
    symbols: dict[str, ca.SX],
    judged: tuple[Conditioned, Verdict, LossTest],
    now: Moments,
) -> tuple[ca.SX, ca.SX]:
    """The corrected estimate, its prediction if the sample was rejected, or a new start."""
    found, verdict, test = judged
    state = script.local("kept_state", split.size)
    covariance = script.local("kept_covariance", found.covariance.numel())
    names = ("kept_state", "kept_covariance")
    prior = symbols["augmented_state"], symbols["augmented_covariance"]
    with script.titled("a rejected sample is replaced by its prediction"):
        script.put(dict(zip(names, (found.mean, found.covariance), strict=True)))
        with script.when(None, verdict.excess):
            script.put(dict(zip(names, prior, strict=True)))
    if split.restarts:
        with script.titled("after too many rejections in a row: a new start"):
            locked = ca.fmin(test.locked(verdict.rejections), verdict.excess)
            with script.when(None, locked):
                script.put(dict(zip(names, unconditional(split, now), strict=True)))
    return state, covariance


def innovation_results(found: Conditioned) -> dict[str, ca.SX]:
    """The ports about the innovation."""
    return {
        "innovation": found.innovation,
        "innovation_covariance": found.innovation_covariance,
        "nis": found.nis,
        "log_likelihood": found.log_likelihood,
    }


def carried(split: Jumping, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
    """What y[k] does not change: unconditional moments."""
    moments = ("mode_second_moment", "mode_first_moment")
    result = {name: symbols[f"predicted_{name}"] for name in moments if name in symbols}
    if "mode_law" in symbols:
        result["mode_law"] = split.law(symbols)
    if "state_second_moment" in symbols:
        now = moments_of(split, symbols, "predicted_")
        result["state_second_moment"] = pack(total(list(now.second)))
    return result
