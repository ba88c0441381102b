"""What is random in a plant: Bernoulli variables, drawn anew in every sample, and a chain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.actuation import rates_of
from fkgen.faults import ActuatorFaults, JumpFaults, Moments, SensorFaults
from fkgen.faults.actuator import pattern_law
from fkgen.problem import Matrix, Spec
from fkgen.problem.probability import Distribution
from fkgen.problem.table.place import Place
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.lifting.expressions import lift, lift_expression
from fkgen.symbolic.linalg import column, sparse
from fkgen.symbolic.plant import Plant

_COUNTED = 255  # codes of conditions and hypotheses fit a byte


@dataclass(frozen=True, slots=True)
class Draw:
    """One decision per sample: which pattern some of the Bernoulli variables show."""

    coins: tuple[int, ...]
    patterns: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """Everything random besides noise; empty where there is nothing of the kind."""

    coins: int = 0  # number of Bernoulli variables
    draws: tuple[Draw, ...] = ()  # how they are drawn
    prior: tuple[float, ...] = ()  # of hypotheses, one of which is true throughout a trial
    initial: tuple[float, ...] = ()  # probabilities of the chain at sample 0
    kernel: tuple[tuple[float, ...], ...] = ()
    moving: bool = False  # each sample has a kernel of its own, in place of this one
    indicators: tuple[tuple[float, ...], ...] = ()  # what each condition hands to the plant
    modes: tuple[int, ...] = ()  # the mode of each condition: several if their past matters
    lost: tuple[int, ...] = ()  # whether the sample is lost, by condition
    plants: int = 0  # N: the first N indicators say which plant measures; 0 if there is one
    entering: bool = False  # the last N say which plant moves, otherwise the first
    held: tuple[tuple[int, ...], ...] = ()  # by condition, 1 for each state that is not 0 in it
    rows: tuple[int, ...] = ()  # of y: signal times the next indicator, noise times the one after


def conditions_of(spec: Spec) -> Conditions:
    """What is random in the plant of a spec, which has to say how its faults come about."""
    faults, found = spec.faults, Conditions()
    if faults.actuator is not None:
        found = _of_actuators(spec, faults.actuator)
    elif faults.sensor is not None:
        found = _of_sensors(spec, faults.sensor)
    elif faults.jump is not None:
        found = _of_jumps(spec, faults.jump)
    for key, count in (("hypotheses", len(found.prior)), ("modes", len(found.initial))):
        if count > _COUNTED:
            raise Place(spec.file, key).error(
                f"{count} to draw from", f"at most {_COUNTED} for a simulation"
            )
    return found


def _of_actuators(spec: Spec, faults: ActuatorFaults) -> Conditions:
    q = spec.model.nu
    prior = () if faults.success_rate else spec.filter.option("prior", ())
    everyone, both = tuple(range(q)), ((1,), (0,))
    match faults.dependence:
        case "independent":
            draws = tuple(Draw((i,), both) for i in everyone)
        case "common":
            draws = (Draw(everyone, ((1,) * q, (0,) * q)),)
        case "covariance":
            draws = (Draw(everyone, tuple(product((1, 0), repeat=q))),)
    return Conditions(coins=q, draws=draws, prior=prior)


def _of_jumps(spec: Spec, faults: JumpFaults) -> Conditions:
    """The modes; with a channel both states of it in every mode, a lost sample first."""
    if faults.unequal:
        return _of_pairs(spec, faults)
    chain, channel, count = faults.chain(spec.model), faults.channel, len(faults.modes)
    order = np.arange(count)
    if channel is not None:
        chain = chain.times(channel)
        order = np.column_stack([order + count, order]).ravel()
    states, at = np.eye(count)[order % count], order < count
    return Conditions(
        initial=tuple(np.array(chain.initial)[order].tolist()),
        kernel=tuple(map(tuple, np.array(chain.transition)[np.ix_(order, order)].tolist())),
        moving=any(each is not None for each in (faults.law, faults.rate, faults.arrivals)),
        indicators=tuple(map(tuple, np.column_stack([states, at, at >= 0]).tolist())),
        modes=tuple((order % count).tolist()),
        lost=() if channel is None else tuple((order >= count).astype(int).tolist()),
        plants=count,
        rows=tuple(range(spec.model.ny)),
    )


def _of_pairs(spec: Spec, faults: JumpFaults) -> Conditions:
    """Pairs of a mode and the next one, which drives the step: what it leaves out is 0 after it."""
    P, N = np.array(faults.transition), len(faults.modes)
    now, after = (each.ravel() for each in np.indices((N, N)))
    measured = np.column_stack([np.eye(N)[now], np.ones((N * N, 2))])
    follows = after[:, np.newaxis] == now
    return Conditions(
        initial=tuple((np.array(faults.initial)[now] * P[now, after]).tolist()),
        kernel=tuple(map(tuple, (follows * P[now, after]).tolist())),
        indicators=tuple(map(tuple, np.hstack([measured, np.eye(N)[after]]).tolist())),
        modes=tuple(now.tolist()),
        plants=N,
        rows=tuple(range(spec.model.ny)),
        moving=faults.law is not None,
        entering=True,
        held=tuple(faults.held[mode] for mode in now),
    )


def _of_sensors(spec: Spec, faults: SensorFaults) -> Conditions:
    initial, kernel = faults.initial, faults.kernel
    modes: tuple[int, ...] = (0, 1, 2, 3)
    if not kernel:
        if faults.moments is None:
            place = Place(spec.file, "faults.sensor.problem")
            expected = "problem 1, 2, 3 or 4: the law that faults are drawn from"
            raise place.error("nothing (the key is missing)", expected)
        initial, kernel = _law_of_moments(faults.moments)
        modes = (*modes, 2, 3)
    numbers = [(gamma, math.sqrt(delta)) for gamma, delta in faults.conditions]
    if faults.factor is not None:  # whether the noise is larger; how much is for each sample to say
        numbers = [(gamma, float(i % 2)) for i, (gamma, _) in enumerate(faults.conditions)]
    return Conditions(
        initial=initial,
        kernel=kernel,
        moving=faults.law is not None,
        indicators=tuple(numbers[mode] for mode in modes),
        modes=modes,
        rows=faults.rows,
    )


def moving_kernel(spec: Spec, before: Mapping[str, ca.SX], now: Mapping[str, ca.SX]) -> ca.SX:
    """The kernel into a sample, with parameters of the sample before it and of its own."""
    sensor, jump = spec.faults.sensor, spec.faults.jump
    if sensor is not None and sensor.law is not None:
        return law_of(sensor.law, now if sensor.independent else before)
    if jump is None:
        raise InternalError("no chain with a kernel of each sample")
    P = law_of(jump.law or Matrix.of(jump.transition), now if jump.unequal else before)
    if jump.unequal:  # the next mode is part of the pair
        first, second = (each.ravel() for each in np.indices(P.shape))
        following = [P[int(i), int(j)] for i, j in zip(first, second, strict=True)]
        return sparse(
            ca.DM(second[:, np.newaxis] == first) * ca.repmat(column(following).T, second.size, 1)
        )
    channel, count = jump.channel, len(jump.modes)
    if channel is None:
        return P
    if jump.rate is None:
        arrival = law_of(channel.law or Matrix.of(channel.transition), before)
    else:
        rate = lift_expression(jump.rate, now)
        arrival = ca.blockcat([[1 - rate, rate], [1 - rate, rate]])
    order = [count * i + m for m in range(count) for i in (0, 1)]  # lost and arrived, mode by mode
    return ca.SX(ca.kron(arrival, P)[order, order])


def _law_of_moments(moments: Moments) -> tuple[Distribution, tuple[Distribution, ...]]:
    """A process with E[gamma], p11 and E[delta] as stated: it is not the only one.

    With probability E[gamma] / p11 the sensor works, with rate p11 and independently from sample to
    sample; else it is dead throughout. Then Pr(gamma_k = 1 | gamma_i = 1) = p11 for all i < k.
    """
    p, d = moments.gamma_persistence, moments.delta_nominal_rate
    works = min(1.0, moments.gamma_rate / p) if p > 0.0 else 0.0
    working = (p * d, p * (1.0 - d), (1.0 - p) * d, (1.0 - p) * (1.0 - d))
    dead = (d, 1.0 - d)
    kernel = ((*working, 0.0, 0.0),) * 4 + ((0.0,) * 4 + dead,) * 2
    return (*(works * each for each in working), *((1.0 - works) * each for each in dead)), kernel


def probabilities_of(
    spec: Spec, plant: Plant, conditions: Conditions, hypothesis: ca.SX
) -> list[list[ca.SX]]:
    """Probability of every pattern but the last, draw by draw."""
    faults = spec.faults.actuator
    if faults is None:
        return []
    rates = rates_of(faults, plant)
    if conditions.prior:
        options = ca.SX(list(zip(*spec.filter.options.hypotheses, strict=True)))
        rates = ca.vertsplit(options @ hypothesis)
    if faults.covariance is None:
        return [[rate] for rate in rates]
    return [_joint(spec, rates, lift(faults.covariance, plant.parameters))]


def _joint(spec: Spec, rates: list[ca.SX], covariance: ca.SX) -> list[ca.SX]:
    """Probabilities of the patterns of correlated inputs, (1, 1, ..) first."""
    place = Place(spec.file, "faults.actuator.covariance")
    if len(rates) == 2:
        both = covariance[0, 1] + rates[0] * rates[1]
        return [both, rates[0] - both, rates[1] - both]
    if not (covariance.is_constant() and all(rate.is_constant() for rate in rates)):
        given = f"parameters in the joint law of {len(rates)} inputs"
        expected = "numbers: the law of more than two inputs is found before the code is generated"
        raise place.error(given, expected)
    law = pattern_law([float(rate) for rate in rates], ca.DM(covariance).full())
    if law is None:
        expected = f"pairwise covariances of {len(rates)} inputs that work or fail"
        raise place.error("a covariance that no joint law has", expected)
    return [ca.SX(value) for value in law[:-1]]
