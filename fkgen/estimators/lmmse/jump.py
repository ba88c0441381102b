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

from fkgen.estimators.gaussian.estimate import (
    bound_all,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.sequential import Conditioned, Form, condition
from fkgen.estimators.lmmse.loss_tests import LossTest, Verdict, loss_outcomes, loss_ports
from fkgen.faults.chain import Groups
from fkgen.faults.sensor import EQUAL
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import (
    column,
    congruence,
    outer_lower,
    pack,
    row_congruence,
    sparse,
    split_packed,
    total,
    unpack,
)
from fkgen.symbolic.packing import triangle
from fkgen.symbolic.plant import Plant, mode_plants
from fkgen.symbolic.ports import carried, innovation_ports, shown, start_of, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

Array = NDArray[np.float64]

#: Largest change by one step of probabilities that count as stationary.
STATIONARY = 1e-13


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentedState:
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
    def of(cls, spec: Spec) -> AugmentedState:
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
        return judges(self.spec) and bool(self.spec.filter.options.reinitialise)

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
    return spec.faults.jump is not None and spec.filter.options.detector != "none"


def augmented_ports(z: AugmentedState, *, covariances: bool) -> tuple[Port, ...]:
    """Estimate and moments of the augmented state; a constant gain needs no covariances."""
    n, M = z.base.nx, z.size
    member = "(x, 1) 1{mode}" if z.ones else "x 1{mode}"
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
            ports.append(_state(name, (z.modes, n, n), meaning))
        if z.means if covariances else z.restarts:
            meaning = f"E[x 1{{mode}}] at {k}, unconditional"
            ports.append(_state(f"{prefix}mode_first_moment", (z.modes, n), meaning))
    if z.spec.faults.sensor is not None:
        meaning = "E[x[k] x[k]'], unconditional"
        ports.append(shown("state_second_moment", (n, n), meaning, unit="xx", symmetric=True))
    return tuple(ports)


def law_ports(z: AugmentedState) -> tuple[Port, ...]:
    """The unconditional law of the mode."""
    size, meaning = (len(z.modes_initial),), "Pr(mode), unconditional, at"
    now = _state("mode_law", size, f"{meaning} k")
    if z.settled:  # modes of a sensor have no port for what is known beforehand
        return () if z.spec.faults.jump is None else (now,)
    return now, _state("predicted_mode_law", size, f"{meaning} k+1")


def _state(name: str, shape: tuple[int, ...], meaning: str) -> Port:
    symmetric = name.endswith(("covariance", "second_moment"))
    return carried(name, shape, meaning, symmetric=symmetric)


def augmented_start(z: AugmentedState) -> dict[str, tuple[float, ...]]:
    """Start values of both sets of ports: the prior, shared out by the law of the mode."""
    model, law = z.spec.model, np.array(z.modes_initial)
    groups = np.array([law[list(group)].sum() for group in z.groups])
    x0, P0 = model.x0.values().ravel(), model.P0.values()
    second = P0 + np.outer(x0, x0)
    state, covariance = _prior(z, groups, x0, P0)
    start: dict[str, Any] = {"predicted_mode_law": law, "mode_law": law}
    for of in ("", "filtered_"):
        start[f"augmented_{of}state"] = state
        start[f"augmented_{of}covariance"] = _packed(covariance)
    for of in ("", "predicted_"):
        start[f"{of}mode_second_moment"] = np.concatenate([p * _packed(second) for p in groups])
        start[f"{of}mode_first_moment"] = np.kron(groups, x0)
    return {name: tuple(np.asarray(value, float).tolist()) for name, value in start.items()}


def _prior(z: AugmentedState, law: Array, x0: Array, P0: Array) -> tuple[Array, Array]:
    """Mean and covariance of the augmented state: x has P0, every part its share of it."""
    share = np.kron(z.shares, law)[:-1]
    mean = np.append(x0, 1.0)[: z.width]
    outer = np.outer(mean, mean)
    spread = np.zeros_like(outer)
    spread[: len(x0), : len(x0)] = P0
    X = np.zeros((z.size, z.size))
    inner = slice(0, z.size - len(x0))
    # 1{i} - share: covariance of the indicators; times the mean on both sides.
    X[inner, inner] = np.kron(np.diag(share), spread) + np.kron(
        np.diag(share) - np.outer(share, share), outer
    )
    X[z.own, z.own] = P0
    X[inner, z.own] = np.kron(share[:, None], spread[:, : len(x0)])
    X[z.own, inner] = X[inner, z.own].T
    return np.concatenate([np.kron(share, mean), x0]), X


def _packed(matrix: Array) -> Array:
    return np.array([matrix[i, j] for i, j in triangle(len(matrix))])


def measured(z: AugmentedState, plants: tuple[Plant, ...], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """L and what is known: E[y | z] = L z + offset, without the rate."""

    def signal(part: int) -> ca.SX:
        plant = z.plant(plants, part)
        return ca.horzcat(plant.C, plant.D @ u) if z.ones else plant.C

    last, n = signal(z.parts - 1), z.base.nx
    blocks = [signal(part) - last for part in range(z.parts - 1)]
    offset = last[:, n:] if z.ones else ca.SX(z.base.ny, 1)
    return sparse(ca.horzcat(*blocks, last[:, :n])), offset


@dataclass(frozen=True, slots=True)
class Moments:
    """E[x x' 1{mode}], E[x 1{mode}] and Pr(mode), mode by mode; no first moments if not needed."""

    second: tuple[ca.SX, ...]
    first: tuple[ca.SX, ...]
    law: ca.SX


def moments_of(z: AugmentedState, symbols: dict[str, ca.SX], prefix: str) -> Moments:
    """The moments that are carried along, as matrices and columns."""
    n = z.base.nx
    second = split_packed(symbols[f"{prefix}mode_second_moment"], n)
    first: tuple[ca.SX, ...] = ()
    if z.means:
        first = tuple(ca.vertsplit(symbols[f"{prefix}mode_first_moment"], n))
    law = z.grouped(law_now(z, symbols, prefix))
    return Moments(tuple(unpack(each, n) for each in second), first, law)


def law_now(z: AugmentedState, symbols: dict[str, ca.SX], prefix: str) -> ca.SX:
    """Probabilities of the modes: predicted, or those of the sample that was corrected."""
    return z.law(symbols) if prefix or z.settled else symbols["mode_law"]


def next_law(z: AugmentedState, law: ca.SX) -> ca.SX:
    """Probabilities of the modes one sample later, their rounding taken out of the sum."""
    if z.settled:
        return law
    moved = ca.SX(ca.DM(z.modes_kernel)).T @ law
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
    script: Script, z: AugmentedState, plants: tuple[Plant, ...], now: Moments, u: ca.SX
) -> list[ca.SX]:
    """Second moment of (A x + b, 1) 1{mode}, or of A x 1{mode}, mode by mode."""
    n, result = z.base.nx, []
    for i in range(z.modes):
        plant = z.plant(plants, i)
        if z.ones:
            last = ca.horzcat(ca.SX(1, n), ca.SX(1))
            through = sparse(ca.vertcat(ca.horzcat(plant.A, offset_of(plant, u)), last))
            q = now.first[i]
            before = ca.blockcat(now.second[i], q, q.T, now.law[i])
        else:
            through, before = plant.A, now.second[i]
        moved = script.let(f"moved_moment_{i}", congruence(through, before))
        result.append(unpack(moved, z.width))
    return result


def plant_noise(z: AugmentedState, plants: tuple[Plant, ...], law: ca.SX) -> list[ca.SX]:
    """sum_i p_ij pi_i Q_i: what the plant's own noise adds in the step to each mode."""
    P, modes = z.kernel, range(z.modes)
    Q = [z.plant(plants, i).Q for i in modes]
    return [shared(Q, [float(P[i, j]) * law[i] for i in modes]) for j in modes]


def later_moments(
    z: AugmentedState, moved: list[ca.SX], noise: list[ca.SX]
) -> tuple[list[ca.SX], list[ca.SX]]:
    """Packed second and first moments one sample later."""
    P, n, N = z.kernel, z.base.nx, z.modes
    mixed = [
        total([float(P[i, j]) * moved[i] for i in range(N) if P[i, j]] or [0 * moved[0]])
        for j in range(N)
    ]
    second = [pack(mixed[j][:n, :n] + noise[j]) for j in range(N)]
    return second, [ca.densify(each[:n, n]) for each in mixed] if z.ones else []


def augmented_noise(z: AugmentedState, moved: list[ca.SX], noise: list[ca.SX]) -> ca.SX:
    """Covariance of the noise of the augmented state; the lower half counts."""
    P, w, n = z.transition, z.width, z.base.nx
    count = z.parts
    parts = [share * moment for share in z.shares for moment in moved]
    own = [share * each for share in z.shares for each in noise]
    W = ca.SX(z.size, z.size)
    for j in range(count - 1):
        at = slice(j * w, j * w + n)
        W[z.own, at] = own[j]
        for k in range(j + 1):
            shares = [P[i, j] * ((1.0 - P[i, j]) if j == k else -P[i, k]) for i in range(count)]
            terms = [float(s) * part for s, part in zip(shares, parts, strict=True) if s]
            block = total(terms) if terms else ca.SX(w, w)
            if j == k:
                block[:n, :n] = block[:n, :n] + own[j]
            W[j * w : j * w + w, k * w : k * w + w] = block
    W[z.own, z.own] = total(noise)
    return sparse(W)


def unconditional(z: AugmentedState, now: Moments) -> tuple[ca.SX, ca.SX]:
    """Mean and packed covariance of the augmented state without any measurement."""
    n, w = z.base.nx, z.width
    mean = ca.SX(z.size, 1)
    X = ca.SX(z.size, z.size)
    means, seconds = [], []
    for share in z.shares:
        for i in range(z.modes):
            q, pi = share * now.first[i], share * now.law[i]
            Z = share * now.second[i]
            means.append(ca.vertcat(q, pi) if z.ones else q)
            seconds.append(ca.blockcat(Z, q, q.T, pi) if z.ones else Z)
    for i in range(z.parts - 1):
        mean[i * w : (i + 1) * w] = means[i]
        X[i * w : (i + 1) * w, i * w : (i + 1) * w] = seconds[i]
        X[z.own, i * w : (i + 1) * w] = seconds[i][:n, :]
    mean[z.own] = total([each[:n] for each in means])
    X[z.own, z.own] = total([each[:n, :n] for each in seconds])
    return mean, pack(X) - outer_lower(mean, mean)


def steps(z: AugmentedState, plants: tuple[Plant, ...], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant of (t, u): what every mode makes of the augmented state."""
    w, n, last = z.width, z.base.nx, z.plant(plants, z.parts - 1)
    G = ca.SX(z.size, z.size)
    known = offset_of(last, u)
    for i in range(z.parts - 1):
        plant, at = z.plant(plants, i), slice(i * w, i * w + n)
        G[at, at] = plant.A
        G[z.own, at] = plant.A - last.A
        if z.ones:
            one = i * w + n
            G[at, one] = offset_of(plant, u)
            G[one, one] = 1
            G[z.own, one] = offset_of(plant, u) - known
    G[z.own, z.own] = last.A
    constant = ca.SX(z.size, 1)
    constant[z.own] = known
    return sparse(G), sparse(constant)


def mixing(z: AugmentedState) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant that make the next augmented state of (t, u)."""
    P, w, n, last = z.transition, z.width, z.base.nx, z.parts - 1
    M, constant = ca.SX(z.size, z.size), ca.SX(z.size, 1)
    for j in range(last):
        to = slice(j * w, j * w + w)
        M[slice(j * w, j * w + n), z.own] = float(P[last, j]) * ca.SX.eye(n)
        for i in range(last):
            share = float(P[i, j] - P[last, j])
            M[to, slice(i * w, i * w + w)] = share * ca.SX.eye(w)
        if z.ones:
            constant[j * w + n] = float(P[last, j])
    M[z.own, z.own] = ca.SX.eye(n)
    return sparse(M), sparse(constant)


def _predict(z: AugmentedState, symbols: dict[str, ca.SX]) -> Phase:
    """The phase ``predict`` of a gain that follows the moments."""
    script, n = Script(symbols), z.base.nx
    u = symbols["u"]
    plants = bound_all(script, z.plants, "ABQc")
    now = moments_of(z, symbols, "")
    with script.titled("second moments, mode by mode"):
        moved = moved_moments(script, z, plants, now, u)
        law = next_law(z, law_now(z, symbols, ""))
        noise = [
            unpack(script.let(f"plant_noise_{j}", pack(each)), n)
            for j, each in enumerate(plant_noise(z, plants, now.law))
        ]
        second, first = later_moments(z, moved, noise)
        if z.restarts and not z.ones:
            first = moved_means(z, plants, now.first, now.law)
        results = {"predicted_mode_second_moment": ca.vertcat(*second)}
        if z.means:
            results["predicted_mode_first_moment"] = ca.vertcat(*first)
        if not z.settled:
            results["predicted_mode_law"] = law
    with script.titled("every mode's step"):
        G, known = steps(z, plants, u)
        moved_state = script.let("moved_state", G @ symbols["augmented_filtered_state"] + known)
        filtered = unpack(symbols["augmented_filtered_covariance"], z.size)
        packed = script.let("moved_covariance", row_congruence(G, filtered))
    with script.titled("mixing by the chain"):
        M, constant = mixing(z)
        state = M @ moved_state + constant
        covariance = row_congruence(M, unpack(packed, z.size))
        covariance += pack(augmented_noise(z, moved, noise))
    with script.titled("prediction of the next sample"):
        results |= {"augmented_state": state, "augmented_covariance": covariance}
        results |= whole(z, state, covariance, "predicted")
        guards = [finite(state, covariance)]
        guards += [finite(column([each[0]]), each) for each in second]
        script.put(results, guards)
    return script.phase()


def moved_means(
    z: AugmentedState, plants: tuple[Plant, ...], means: tuple[ca.SX, ...], law: ca.SX
) -> list[ca.SX]:
    """E[x 1{mode}] one sample later, without inputs."""
    own = [z.plant(plants, i) for i in range(z.modes)]
    each = [plant.A @ means[i] + law[i] * plant.c for i, plant in enumerate(own)]
    mixed = ca.SX(ca.DM(z.kernel)).T @ ca.horzcat(*each).T
    return [ca.densify(mixed[j, :].T) for j in range(z.modes)]


def whole(z: AugmentedState, state: ca.SX, packed: ca.SX, prefix: str) -> dict[str, ca.SX]:
    """State and covariance of x, which the augmented state ends with."""
    X = unpack(packed, z.size)
    return {
        f"{prefix}_state": state[z.own],
        f"{prefix}_covariance": pack(X[z.own, z.own]),
    }


def jump_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion with a gain that follows the moments."""
    z = AugmentedState.of(spec)
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        *(loss_ports(spec) if judges(spec) else ()),
        *law_ports(z),
        *augmented_ports(z, covariances=True),
    )
    symbols = symbols_of(spec, z.base, ports)
    form = update_form(spec, noisy(z), augmented=False)
    start = augmented_start(z) | start_of(spec)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        initial={port.name: start[port.name] for port in ports if port.name in start},
        update=_update(z, symbols, form),
        predict=_predict(z, symbols),
        form=form,
        notes=notes_of(z),
        outcomes=loss_outcomes(spec) if judges(spec) else (),
    )


def noisy(z: AugmentedState) -> Plant:
    """A plant with the names of the rows, and whether a mode may measure without noise."""
    return replace(z.base, noise_free=any(plant.noise_free for plant in z.plants))


def notes_of(z: AugmentedState) -> tuple[str, ...]:
    """What the header says about modes and arrivals."""
    options, faults = z.spec.filter.options, z.spec.faults.jump
    notes = [f"state split by {z.parts} modes"]
    if judges(z.spec):
        notes.append(
            f"a sample that the test {options.detector} rejects is replaced by its prediction;"
            f" status LOCKED_OUT from {options.lock_out} in a row on"
        )
    elif faults is not None and faults.arrival == "unknown":
        law = "a Markov chain" if faults.arrival_chain else f"the rate {faults.arrival_rate:g}"
        notes.append(f"of arrivals only {law} is known")
    return tuple(notes)


def mean_noise(script: Script, z: AugmentedState, plants: tuple[Plant, ...], law: ca.SX) -> ca.SX:
    """sum_i pi_i R_i, its computed entries named."""
    weights = ca.vertsplit(law)
    noises = [plant.R for plant in plants[: len(z.modes_initial)]]
    return script.name_entries("mean_noise", sparse(shared(noises, weights)))


def signal_moment(z: AugmentedState, plants: tuple[Plant, ...], now: Moments, u: ca.SX) -> ca.SX:
    """Packed E[s s'] of the signal s = C x + D u; modes that measure alike are added first."""
    groups: dict[tuple[int, int], list[int]] = {}
    for i in range(z.modes):
        plant = z.plant(plants, i)
        groups.setdefault((id(plant.C), id(plant.D)), []).append(i)
    terms = []
    for members in groups.values():
        plant = z.plant(plants, members[0])
        second = total([now.second[i] for i in members])
        if plant.D.nnz():
            first = total([now.first[i] for i in members])
            law = total([now.law[i] for i in members])
            whole_moment = ca.blockcat(second, first, first.T, law)
            terms.append(congruence(ca.horzcat(plant.C, plant.D @ u), whole_moment))
        else:
            terms.append(congruence(plant.C, second))
    return total(terms)


def _update(z: AugmentedState, symbols: dict[str, ca.SX], form: Form) -> Phase:
    script, u = Script(symbols), symbols["u"]
    demand_positive(script, symbols["augmented_covariance"], z.size)
    plants = bound_all(script, z.plants, "CDR")
    now = moments_of(z, symbols, "predicted_")
    noise = mean_noise(script, z, plants, z.law(symbols))
    prior = (symbols["augmented_state"], unpack(symbols["augmented_covariance"], z.size))
    L, offset = measured(z, plants, u)
    measurement = measurement_of(
        noisy(z),
        scalar=z.spec.code.scalar,
        y=symbols["y"],
        C=sparse(z.rate * L),
        offset=z.rate * offset,
        R=_with_doubt(script, z, noise, lambda: signal_moment(z, plants, now, u)),
    )
    found = condition(script, prior, measurement, form=form)
    demand_finite(script, found.mean)
    state, covariance, results = found.mean, found.covariance, {}
    if judges(z.spec):
        test = LossTest(script, symbols, z.spec)
        verdict = test.verdict(found, measurement, noise)
        state, covariance = _kept(script, z, symbols, (found, verdict, test), now)
        results = verdict.results
    results |= {
        "augmented_filtered_state": state,
        "augmented_filtered_covariance": covariance,
        **whole(z, state, covariance, "filtered"),
        **innovation_results(found),
        **unchanged(z, symbols),
    }
    with script.titled("results of the update"):
        script.put(results)
    return script.phase()


def _with_doubt(
    script: Script, z: AugmentedState, noise: ca.SX, moment: Callable[[], ca.SX]
) -> ca.SX:
    """R, and p (1 - p) E[s s'] where nobody knows whether y holds the signal s: Nahi 1969."""
    doubt = z.rate * (1.0 - z.rate)
    if not doubt:
        return noise
    p = z.base.ny
    signal = unpack(script.let("signal_moment", moment()), p)
    return script.name_entries("noise_and_doubt", sparse(noise + doubt * signal))


def _kept(
    script: Script,
    z: AugmentedState,
    symbols: dict[str, ca.SX],
    judged: tuple[Conditioned, Verdict, LossTest],
    now: Moments,
) -> tuple[ca.SX, ca.SX]:
    """The corrected estimate, its prediction if the sample was rejected, or a new start."""
    found, verdict, test = judged
    state = script.local("kept_state", z.size)
    covariance = script.local("kept_covariance", found.covariance.numel())
    names = ("kept_state", "kept_covariance")
    prior = symbols["augmented_state"], symbols["augmented_covariance"]
    with script.titled("a rejected sample is replaced by its prediction"):
        script.put(dict(zip(names, (found.mean, found.covariance), strict=True)))
        with script.when(None, verdict.excess):
            script.put(dict(zip(names, prior, strict=True)))
    if z.restarts:
        with script.titled("after too many rejections in a row: a new start"):
            locked = ca.fmin(test.locked(verdict.rejections), verdict.excess)
            with script.when(None, locked):
                script.put(dict(zip(names, unconditional(z, now), strict=True)))
    return state, covariance


def innovation_results(found: Conditioned) -> dict[str, ca.SX]:
    """The ports about the innovation."""
    return {
        "innovation": found.innovation,
        "innovation_covariance": found.innovation_covariance,
        "nis": found.nis,
        "log_likelihood": found.log_likelihood,
    }


def unchanged(z: AugmentedState, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
    """What y[k] does not change: unconditional moments."""
    moments = ("mode_second_moment", "mode_first_moment")
    result = {name: symbols[f"predicted_{name}"] for name in moments if name in symbols}
    if "mode_law" in symbols:
        result["mode_law"] = z.law(symbols)
    if "state_second_moment" in symbols:
        now = moments_of(z, symbols, "predicted_")
        result["state_second_moment"] = pack(total(list(now.second)))
    return result
