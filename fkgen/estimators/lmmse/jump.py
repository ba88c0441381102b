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

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.estimate import (
    bound_all,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, condition
from fkgen.estimators.lmmse.kalman import constant, innovation_results
from fkgen.estimators.lmmse.loss_tests import LossTest, judges, loss_outcomes, loss_ports
from fkgen.estimators.models.start import first_law
from fkgen.faults.chain import Channel, Lumping
from fkgen.faults.sensor import EQUAL
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.interface import Port
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.linalg import (
    column,
    congruence,
    is_zero,
    outer_lower,
    pack,
    row_congruence,
    sparse,
    split_packed,
    total,
    unpack,
)
from fkgen.symbolic.plant import Plant, mode_plants
from fkgen.symbolic.ports import (
    carried,
    innovation_ports,
    prior_symbols,
    shown,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion

Array = NDArray[np.float64]

#: Largest change by one step of probabilities that count as stationary.
STATIONARY = 1e-13


def is_settled(law: ArrayLike, transition: ArrayLike) -> bool:
    """Whether probabilities never change."""
    return bool(np.abs(np.asarray(law) @ np.asarray(transition) - law).max() <= STATIONARY)


class AugmentedState:
    """The augmented state of one spec: its parts, their chain, and what is carried along.

    A part belongs to a group of modes that differ in nothing but R; where losses are a Markov
    chain that is not observed, to such a pair of both, first all that arrive. With a stationary
    gain modes that differ in noise alone are one part: the gain of x needs no second moments then,
    which may grow.
    """

    def __init__(self, spec: Spec) -> None:
        chain, faults = spec.faults.chain(spec.model), spec.faults.jump
        self.spec, self.chain, modes = spec, chain, chain.modes
        #: Pr(a sample arrives) as far as it is no part of the mode
        self.rate: float | ca.SX = 1.0
        self.arrival = np.eye(1)  # transition of (arrived, lost), if losses are part of the mode
        self.shares: tuple[float, ...] = (1.0,)  # its stationary law
        self.channel: Channel | None = None  # the same where it depends on parameters
        guesses = faults is not None and faults.arrival == "unknown" and not judges(spec)
        channel = faults.channel if faults is not None and guesses else None
        if faults is not None and channel is not None and faults.arrival_rate is not None:
            self.rate = faults.arrival_rate
        elif channel is not None:
            self.arrival = np.array(channel.transition)[::-1, ::-1]
            self.shares = channel.initial[::-1]
            self.channel = channel if channel.law is not None else None
            modes = chain.times(channel).modes
        lumping = self._lumping()
        self.groups = lumping.groups  # the modes that share a part
        self.kernel = np.array(lumping.transition)  # (N, N), of the groups
        self.plants = mode_plants(spec, modes)  # of every mode, then of every mode without a signal
        exact = any(plant.noise_free for plant in self.plants)
        #: For names and sizes, which all modes share, and whether one may measure without noise
        self.base = replace(self.plants[0], noise_free=exact)
        #: Parts are (x, 1) 1{mode}: something known is added to the state, or to y
        self.ones = bool(spec.model.nu) or any(p.c.nnz() or p.d.nnz() for p in self.plants)
        parameters = self.base.parameters
        if faults is not None and faults.rate is not None and guesses:
            self.rate = lift_expression(faults.rate, parameters)
        #: The chain of the modes where it depends on parameters; then no part is shared
        self.varying = None if chain.law is None else law_of(chain.law, parameters)
        law = None if self.channel is None else self.channel.law
        #: That of (arrived, lost)
        self.arrivals = (
            constant(self.arrival) if law is None else law_of(law, parameters)[::-1, ::-1]
        )
        self.modes = len(self.groups)  # N
        self.parts = len(self.shares) * self.modes
        self.width = self.base.nx + int(self.ones)  # of a part
        inner = (self.parts - 1) * self.width
        self.size = inner + self.base.nx
        self.own = slice(inner, self.size)  # where x stands in the augmented state
        moving = (chain.law or chain.first) is not None
        self.settled = not moving and is_settled(chain.initial, chain.transition)
        self.means = self.ones or self.restarts  # first moments of the parts are carried along
        self.T, self.E, self.e = (constant(each) for each in self._coordinates())

    @property
    def restarts(self) -> bool:
        """Whether a lock-out starts the filter again."""
        return judges(self.spec) and bool(self.spec.filter.options.reinitialise)

    def _lumping(self) -> Lumping:
        """The modes that share a part."""
        faults = self.spec.faults.jump
        lumping = self.chain.lumped(tuple((i,) for i in range(len(self.chain.modes))))
        if faults is None:  # modes of jump faults are the user's: each has its part
            lumped = self.chain.lumped(self.chain.alike("ABCDQcd"))
            lumping = lumped if lumped.unequal_successors <= EQUAL else lumping
        elif self.spec.filter.option("gain", None) == "stationary" and faults.gain_needs_no_moments(
            tested=judges(self.spec)
        ):
            lumping = self.chain.lumped((tuple(range(len(self.chain.modes))),))
        return lumping

    def _coordinates(self) -> tuple[Array, Array, Array]:
        """T, E, e: the augmented state is T z for all parts z, and they are E times it plus e."""
        inner, n, w = self.own.start, self.base.nx, self.width
        T, E = np.eye(self.size, inner + w), np.eye(inner + w, self.size)
        T[self.own] = np.tile(np.eye(n, w), self.parts)
        E[inner:, :inner] = -np.tile(np.eye(w), self.parts - 1)
        return T, E, np.repeat([[0.0], [1.0]], [inner + n, w - n], axis=0)

    @property
    def transition(self) -> Array:
        """Transition of the parts, where it is constant."""
        return np.asarray(np.kron(self.arrival, self.kernel))

    @property
    def moves(self) -> ca.SX:
        """Transition of the parts."""
        if self.varying is None and self.channel is None:
            return constant(self.transition)
        return ca.kron(self.arrivals, self.chances)

    def arrived(self, symbols: dict[str, ca.SX], prefix: str) -> list[ca.SX]:
        """Pr(arrived) and Pr(lost) as far as they are part of the mode."""
        if self.channel is None:
            return [ca.SX(share) for share in self.shares]
        return ca.vertsplit(symbols[f"{prefix}arrival_law"])

    @property
    def chances(self) -> ca.SX:
        """Transition of the groups."""
        return constant(self.kernel) if self.varying is None else self.varying

    def law(self, symbols: dict[str, ca.SX], prefix: str) -> ca.SX:
        """Probabilities of the modes, predicted or at the sample that was corrected, (M,)."""
        settled = ca.SX(list(self.chain.initial))
        return settled if self.settled else symbols[f"{prefix}mode_law"]

    def plant(self, plants: Sequence[Plant], part: int) -> Plant:
        """The plant of a part."""
        arrived, group = divmod(part, self.modes)
        return plants[(arrived * len(self.chain.modes) + self.groups[group][0]) % len(plants)]

    def mixed(self, values: Sequence[ca.SX]) -> list[ca.SX]:
        """sum_i p_ij value_i, mode by mode."""
        P, modes = self.chances, range(self.modes)
        return [
            total([P[i, j] * values[i] for i in modes if not is_zero(P[i, j])] or [0 * values[0]])
            for j in modes
        ]


def ports_of(z: AugmentedState, *, covariances: bool) -> tuple[Port, ...]:
    """Estimates, law and moments; a constant gain needs no covariances."""
    spec, n, size, law = z.spec, z.base.nx, z.size, (len(z.chain.initial),)
    member = "(x, 1) 1{mode}" if z.ones else "x 1{mode}"
    estimate = f"estimate of {member} for all parts but the last, then of x, at k+1 given y[0..k]"
    known = spec.faults.jump is None and z.settled  # of a sensor there is no port for it then
    wanted = [
        (not known, "mode_law", law, "Pr(mode), unconditional, at k"),
        (not z.settled, "predicted_mode_law", law, "Pr(mode), unconditional, at k+1"),
        (z.channel is not None, "arrival_law", (2,), "Pr(arrived) and Pr(lost), at k"),
        (z.channel is not None, "predicted_arrival_law", (2,), "the same at k+1"),
        (True, "augmented_state", (size,), estimate),
        (True, "augmented_filtered_state", (size,), "the same at k given y[0..k]"),
        (covariances, "augmented_covariance", (size,) * 2, "error covariance of augmented_state"),
        (covariances, "augmented_filtered_covariance", (size,) * 2, "the same at k given y[0..k]"),
    ]
    means = z.means if covariances else z.restarts
    for of, k in (("", "k"), ("predicted_", "k+1")):
        second, first = (f"E[{x} 1{{mode}}] at {k}, unconditional" for x in ("x x'", "x"))
        wanted += [
            (covariances, f"{of}mode_second_moment", (z.modes, n, n), second),
            (means, f"{of}mode_first_moment", (z.modes, n), first),
        ]
    ports = [
        carried(name, shape, text, symmetric=name.endswith(("covariance", "second_moment")))
        for there, name, shape, text in wanted
        if there
    ]
    if spec.faults.sensor is not None:
        meaning = "E[x[k] x[k]'], unconditional"
        ports.append(shown("state_second_moment", (n, n), meaning, unit="xx", symmetric=True))
    return (*state_ports(spec), *innovation_ports(spec), *loss_ports(spec), *ports)


def start_of(z: AugmentedState, ports: Sequence[Port], symbols: dict[str, ca.SX]) -> Phase:
    """The prior, shared out by the law of the mode: x has P, every part its share of it."""
    given, parameters = prior_symbols(z.base), z.base.parameters
    builder, x, P = PhaseBuilder({**symbols, **given}), given["x"], unpack(given["P"], z.base.nx)
    law = first_law(builder, z.spec, z.chain, parameters)
    shares = ca.SX(ca.DM(z.shares))
    if z.channel is not None:
        shares = first_law(builder, z.spec, z.channel, parameters, "first_arrival")[::-1]
    groups = column([total([law[i] for i in group]) for group in z.groups])
    share, inner = column(ca.vertsplit(ca.kron(shares, groups))[:-1]), z.own.start
    mean = ca.vertcat(x, 1)[: z.width]
    spread = ca.SX(z.width, z.width)
    spread[: x.numel(), : x.numel()] = P
    X = ca.SX(z.size, z.size)
    # 1{i} - share: covariance of the indicators; times the mean on both sides.
    if inner:
        X[:inner, :inner] = ca.kron(sparse(ca.diag(share)), spread) + ca.kron(
            sparse(ca.diag(share) - share @ share.T), mean @ mean.T
        )
        X[z.own, :inner] = ca.kron(share.T, spread[: x.numel(), :])
    X[z.own, z.own] = P
    start = {
        "augmented_state": ca.vertcat(ca.kron(share, mean), x) if inner else x,
        "augmented_covariance": pack(X),
        "mode_second_moment": ca.kron(groups, given["P"] + outer_lower(x, x)),
        "mode_first_moment": ca.kron(groups, x),
        "arrival_law": shares,
    }
    if z.chain.first is not None:
        start["mode_law"] = law
    of = {port.name: _stem(port) for port in ports}
    values = {name: start[stem] for name, stem in of.items() if stem in start}
    builder.assign(values)
    return builder.phase()


def _stem(port: Port) -> str:
    """The name without what tells a prediction and a filtered estimate apart."""
    return port.name.replace("filtered_", "").replace("predicted_", "")


def measured(z: AugmentedState, plants: Sequence[Plant], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """L and what is known: E[y | z] = L z + offset, without the rate."""
    own = [z.plant(plants, part) for part in range(z.parts)]
    signals = ca.horzcat(
        *[ca.horzcat(each.C, sensed_offset(each, u))[:, : z.width] for each in own]
    )
    return sparse(signals @ z.E), signals @ z.e


@dataclass(frozen=True, slots=True)
class Moments:
    """E[x x' 1{mode}], E[x 1{mode}] and Pr(mode), mode by mode; no first moments if not needed."""

    second: Sequence[ca.SX]
    first: Sequence[ca.SX]
    law: ca.SX

    def joint(self, *modes: int) -> ca.SX:
        """Second moment of (x, 1) 1{one of these modes}."""
        second, first, law = (
            total([of[i] for i in modes]) for of in (self.second, self.first, self.law)
        )
        return ca.blockcat(second, first, first.T, law)


def moments_of(z: AugmentedState, symbols: dict[str, ca.SX], prefix: str) -> Moments:
    """The moments that are carried along, as matrices and columns."""
    n, law = z.base.nx, z.law(symbols, prefix)
    second = split_packed(symbols[f"{prefix}mode_second_moment"], n)
    first = ca.vertsplit(symbols[f"{prefix}mode_first_moment"], n) if z.means else ()
    return Moments([unpack(each, n) for each in second], first, grouped(z, law))


def grouped(z: AugmentedState, law: ca.SX) -> ca.SX:
    """Probabilities of the parts."""
    return column([total([law[i] for i in group]) for group in z.groups])


def next_law(z: AugmentedState, law: ca.SX) -> ca.SX:
    """Probabilities of the modes one sample later, their rounding taken out of the sum."""
    if z.settled:
        return law
    P = ca.SX(ca.DM(np.array(z.chain.transition))) if z.varying is None else z.varying
    moved = P.T @ law
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


def sensed_offset(plant: Plant, u: ca.SX) -> ca.SX:
    """What is known and added to the signal: D u + d."""
    return plant.D @ u + plant.d


def step_of(z: AugmentedState, plant: Plant, u: ca.SX) -> ca.SX:
    """What a mode makes of its part."""
    if not z.ones:
        return plant.A
    last = ca.horzcat(ca.SX(1, z.base.nx), ca.SX(1))
    return sparse(ca.vertcat(ca.horzcat(plant.A, offset_of(plant, u)), last))


def moved_moments(
    builder: PhaseBuilder, z: AugmentedState, plants: Sequence[Plant], now: Moments, u: ca.SX
) -> list[ca.SX]:
    """Second moment of (A x + b, 1) 1{mode}, or of A x 1{mode}, mode by mode."""
    result = []
    for i in range(z.modes):
        before = now.joint(i) if z.ones else now.second[i]
        moved = congruence(step_of(z, z.plant(plants, i), u), before)
        result.append(unpack(builder.define(f"moved_moment_{i}", moved), z.width))
    return result


def moved_means(
    z: AugmentedState, plants: Sequence[Plant], first: Sequence[ca.SX], law: ca.SX, u: ca.SX
) -> list[ca.SX]:
    """E[x 1{mode}] one sample later."""
    own = [z.plant(plants, i) for i in range(z.modes)]
    each = [plant.A @ first[i] + law[i] * offset_of(plant, u) for i, plant in enumerate(own)]
    return [ca.densify(mean) for mean in z.mixed(each)]


def next_arrival(z: AugmentedState, shares: Sequence[ca.SX]) -> list[ca.SX]:
    """Pr(arrived) and Pr(lost) one sample later."""
    if z.channel is None:
        return [*shares]
    moved = z.arrivals.T @ column([*shares])
    return ca.vertsplit(moved / ca.sum1(moved))


def plant_noise(z: AugmentedState, plants: Sequence[Plant], law: ca.SX) -> list[ca.SX]:
    """sum_i p_ij pi_i Q_i: what the plant's own noise adds in the step to each mode."""
    P, modes = z.chances, range(z.modes)
    Q = [z.plant(plants, i).Q for i in modes]
    return [shared(Q, [P[i, j] * law[i] for i in modes]) for j in modes]


def augmented_noise(
    z: AugmentedState, moved: list[ca.SX], noise: list[ca.SX], shares: Sequence[ca.SX]
) -> ca.SX:
    """Covariance of the noise of the augmented state; ``shares`` are of sample k."""
    inner, rest = z.own.start, ca.SX(z.width - z.base.nx, z.width - z.base.nx)
    later = next_arrival(z, shares)
    own = [ca.diagcat(share * each, rest) for share in later for each in noise]
    W = z.T @ ca.diagcat(*own) @ z.T.T
    W[z.own, z.own] = total(noise)
    jumps = ca.SX(inner, inner)
    parts = [share * moment for share in shares for moment in moved]
    for indicators, part in zip(_indicators(z), parts, strict=True):
        jumps += ca.kron(indicators, part)
    W[:inner, :inner] = jumps + W[:inner, :inner]
    return sparse(W)


def _indicators(z: AugmentedState) -> Iterator[ca.SX]:
    """Covariance of the indicators of the next part, given each part; without the last one."""
    if z.varying is None and z.channel is None:
        for p in z.transition[:, :-1]:
            yield constant(np.where(np.eye(len(p)), p * (1.0 - p), -np.outer(p, p)))
        return
    for i in range(z.parts):
        row = z.moves[i, :-1].T
        yield sparse(ca.diag(row) - row @ row.T)


def unconditional_mean(z: AugmentedState, first: Sequence[ca.SX], law: ca.SX) -> ca.SX:
    """Mean of the augmented state without any measurement."""
    return z.T @ ca.vertcat(*[ca.vertcat(q, law[i])[: z.width] for i, q in enumerate(first)])


def unconditional(z: AugmentedState, now: Moments) -> tuple[ca.SX, ca.SX]:
    """Mean and packed covariance of the augmented state without any measurement."""
    mean = unconditional_mean(z, now.first, now.law)
    seconds = [now.joint(i) if z.ones else now.second[i] for i in range(z.modes)]
    X = z.T @ ca.diagcat(*seconds) @ z.T.T
    return mean, pack(X) - outer_lower(mean, mean)


def steps(z: AugmentedState, plants: Sequence[Plant], u: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant of (t, u): what every mode makes of the augmented state."""
    own = [step_of(z, z.plant(plants, part), u) for part in range(z.parts)]
    through = z.T @ ca.diagcat(*own)
    return sparse(through @ z.E), sparse(through @ z.e)


def mixing(z: AugmentedState) -> tuple[ca.SX, ca.SX]:
    """Matrix and constant that make the next augmented state of (t, u)."""
    wide = constant(np.eye(z.width))
    through = z.T @ ca.kron(z.moves.T, wide)
    M = through @ z.E
    M[z.own, :] = 0  # what the parts exchange does not change their sum, not even by rounding
    M[z.own, z.own] = ca.SX.eye(z.base.nx)
    return sparse(M), sparse(through @ z.e)


def _predict(z: AugmentedState, symbols: dict[str, ca.SX]) -> Phase:
    """The phase ``predict`` of a gain that follows the moments."""
    builder, n = PhaseBuilder(symbols), z.base.nx
    u = symbols["u"]
    plants = bound_all(builder, z.plants, "ABQc")
    now = moments_of(z, symbols, "")
    with builder.titled("second moments, mode by mode"):
        moved = moved_moments(builder, z, plants, now, u)
        law = next_law(z, z.law(symbols, ""))
        noise = [
            unpack(builder.define(f"plant_noise_{j}", pack(each)), n)
            for j, each in enumerate(plant_noise(z, plants, now.law))
        ]
        mixed = z.mixed(moved)
        second = [pack(each[:n, :n] + own) for each, own in zip(mixed, noise, strict=True)]
        results = {"predicted_mode_second_moment": ca.vertcat(*second)}
        if z.means:
            first = [ca.densify(each[:n, n]) for each in mixed] if z.ones else []
            first = first or moved_means(z, plants, now.first, now.law, u)
            results["predicted_mode_first_moment"] = ca.vertcat(*first)
        if not z.settled:
            results["predicted_mode_law"] = law
        if z.channel is not None:
            results["predicted_arrival_law"] = column(next_arrival(z, z.arrived(symbols, "")))
    with builder.titled("every mode's step"):
        G, known = steps(z, plants, u)
        moved_state = builder.define("moved_state", G @ symbols["augmented_filtered_state"] + known)
        filtered = unpack(symbols["augmented_filtered_covariance"], z.size)
        packed = builder.define("moved_covariance", row_congruence(G, filtered))
    with builder.titled("mixing by the chain"):
        M, known = mixing(z)
        state = M @ moved_state + known
        covariance = row_congruence(M, unpack(packed, z.size))
        covariance += pack(augmented_noise(z, moved, noise, z.arrived(symbols, "")))
    with builder.titled("prediction of the next sample"):
        results |= {"augmented_state": state, "augmented_covariance": covariance}
        results |= whole(z, state, covariance, "predicted")
        guards = [finite(state, covariance)]
        guards += [finite(column([each[0]]), each) for each in second]
        builder.assign(results, guards)
    return builder.phase()


def whole(z: AugmentedState, state: ca.SX, packed: ca.SX, prefix: str) -> dict[str, ca.SX]:
    """State and covariance of x, which the augmented state ends with."""
    X = unpack(packed, z.size)
    return {
        f"{prefix}_state": state[z.own],
        f"{prefix}_covariance": pack(X[z.own, z.own]),
    }


def jump_filter(spec: Spec, source: str) -> Recursion:
    """Build the recursion with a gain that follows the moments."""
    z = AugmentedState(spec)
    form = update_form(spec, z.base, augmented=False)
    return recursion_of(z, source, partial(_update, form=form), _predict, form=form)


def recursion_of(
    z: AugmentedState,
    source: str,
    update: Callable[[AugmentedState, dict[str, ca.SX]], Phase],
    predict: Callable[[AugmentedState, dict[str, ca.SX]], Phase],
    *,
    form: Form | None = None,
    notes: tuple[str, ...] = (),
) -> Recursion:
    """Write both phases over the ports that they need; without a form the gain is constant."""
    spec = z.spec
    ports = ports_of(z, covariances=form is not None)
    symbols = symbols_of(spec, z.base, ports)
    laws = [port.name for port in ports if _stem(port) == "mode_law" and z.chain.first is None]
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        start=start_of(z, ports, symbols),
        initial=dict.fromkeys(laws, tuple(map(float, z.chain.initial))),
        update=update(z, symbols),
        predict=predict(z, symbols),
        form=form,
        notes=(*notes, *_notes(z)),
        outcomes=loss_outcomes(spec),
    )


def _notes(z: AugmentedState) -> tuple[str, ...]:
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


def mean_noise(
    builder: PhaseBuilder, z: AugmentedState, plants: Sequence[Plant], law: ca.SX
) -> ca.SX:
    """sum_i pi_i R_i, its computed entries named."""
    noises = [plant.R for plant in plants[: len(z.chain.modes)]]
    return builder.name_entries("mean_noise", sparse(shared(noises, ca.vertsplit(law))))


def signal_moment(z: AugmentedState, plants: Sequence[Plant], now: Moments, u: ca.SX) -> ca.SX:
    """Packed E[s s'] of the signal s = C x + D u; modes that measure alike are added first."""
    alike: dict[tuple[int, ...], list[int]] = {}
    for i in range(z.modes):
        plant = z.plant(plants, i)
        alike.setdefault((id(plant.C), id(plant.D), id(plant.d)), []).append(i)
    terms = []
    for modes in alike.values():
        plant = z.plant(plants, modes[0])
        signal, moment = plant.C, total([now.second[i] for i in modes])
        if plant.D.nnz() or plant.d.nnz():
            signal, moment = ca.horzcat(plant.C, sensed_offset(plant, u)), now.joint(*modes)
        terms.append(congruence(signal, moment))
    return total(terms)


def _update(z: AugmentedState, symbols: dict[str, ca.SX], *, form: Form) -> Phase:
    builder, u = PhaseBuilder(symbols), symbols["u"]
    prior = symbols["augmented_state"], symbols["augmented_covariance"]
    demand_positive(builder, prior[1])
    plants = bound_all(builder, z.plants, "CDRd")
    now = moments_of(z, symbols, "predicted_")
    noise = mean_noise(builder, z, plants, z.law(symbols, "predicted_"))
    L, offset = measured(z, plants, u)
    measurement = measurement_of(
        z.base,
        y=symbols["y"],
        C=sparse(z.rate * L),
        offset=z.rate * offset,
        R=_with_doubt(builder, z, noise, lambda: signal_moment(z, plants, now, u)),
    )
    found = condition(builder, (prior[0], unpack(prior[1], z.size)), measurement, form=form)
    demand_finite(builder, found.mean)
    (state, covariance), results = kept(
        builder,
        z,
        (found, measurement, noise),
        corrected=(found.mean, found.covariance),
        prior=prior,
        fresh=lambda: unconditional(z, now),
    )
    results |= {
        "augmented_filtered_state": state,
        "augmented_filtered_covariance": covariance,
        **whole(z, state, covariance, "filtered"),
        **innovation_results(found),
        **unchanged(z, symbols),
    }
    with builder.titled("results of the update"):
        builder.assign(results)
    return builder.phase()


def _with_doubt(
    builder: PhaseBuilder, z: AugmentedState, noise: ca.SX, moment: Callable[[], ca.SX]
) -> ca.SX:
    """R, and p (1 - p) E[s s'] where nobody knows whether y holds the signal s: Nahi 1969."""
    doubt = z.rate * (1.0 - z.rate)
    if isinstance(doubt, float) and not doubt:
        return noise
    signal = unpack(builder.define("signal_moment", moment()), z.base.ny)
    return builder.name_entries("noise_and_doubt", sparse(noise + doubt * signal))


def kept(
    builder: PhaseBuilder,
    z: AugmentedState,
    judged: tuple[Conditioned, Measurement, ca.SX],
    *,
    corrected: tuple[ca.SX, ...],
    prior: tuple[ca.SX, ...],
    fresh: Callable[[], tuple[ca.SX, ...]],
) -> tuple[Sequence[ca.SX], dict[str, ca.SX]]:
    """What is corrected, its prediction if the sample was rejected, or a new start; test results.

    ``judged`` is what a test needs, if there is one: see `LossTest.verdict`.
    """
    if not judges(z.spec):
        return corrected, {}
    verdict = LossTest(builder, z.spec).verdict(*judged)
    names = ("kept_state", "kept_covariance")[: len(corrected)]
    kept = [builder.local(name, each.numel()) for name, each in zip(names, corrected, strict=True)]
    with builder.titled("a rejected sample is replaced by its prediction"):
        builder.assign(dict(zip(names, corrected, strict=True)))
        with builder.if_present(None, verdict.excess):
            builder.assign(dict(zip(names, prior, strict=True)))
    if z.restarts:
        title = "after too many rejections in a row: a new start"
        with builder.titled(title), builder.if_present(None, verdict.locked):
            builder.assign(dict(zip(names, fresh(), strict=True)))
    return kept, verdict.results


def unchanged(z: AugmentedState, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
    """What y[k] does not change: unconditional moments."""
    moments = ("mode_second_moment", "mode_first_moment")
    result = {name: symbols[f"predicted_{name}"] for name in moments if name in symbols}
    if "arrival_law" in symbols:
        result["arrival_law"] = symbols["predicted_arrival_law"]
    if "mode_law" in symbols:
        result["mode_law"] = z.law(symbols, "predicted_")
    if "state_second_moment" in symbols:
        seconds = split_packed(symbols["predicted_mode_second_moment"], z.base.nx)
        result["state_second_moment"] = total(seconds)
    return result
