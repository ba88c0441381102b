"""The two halves of every filter here: correct with y[k], propagate to k + 1.

The Kalman filter is the case in which no input is random.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from fkgen.estimators.gaussian.actuation import Actuation
from fkgen.estimators.gaussian.blocked import moved_covariance, moved_mean
from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.gate import Gate
from fkgen.estimators.gaussian.rolled import is_rolled
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import (
    PIVOTS_PER_LOG,
    RANK_TOLERANCE,
    Conditioned,
    Prior,
    condition,
)
from fkgen.estimators.gaussian.ud import Factors, Wide, columns_of, noise_columns
from fkgen.problem import Spec
from fkgen.problem.table.place import Place
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status, triangle
from fkgen.symbolic.lifting.equations import shifted, turned_by
from fkgen.symbolic.linalg import (
    between,
    congruence,
    diagonal,
    is_zero,
    least_congruence,
    pack,
    sparse,
    unpack,
)
from fkgen.symbolic.plant import Plant, sensed_at_prior
from fkgen.symbolic.recursion import Guard

#: Beyond this ratio of prior to noise variance the short form loses more than ten digits in double.
SHORT_FORM_RATIO = 1e6

#: Beyond this one, which is a choice, factors are carried in double: the Joseph form may lose
#: positivity there, with several rows and sparse A.
JOSEPH_FORM_RATIO = 1e10

#: Factors are written in straight lines, for as many states at most.
FACTORED_STATES = 12

#: Smallest eigenvalue of a correlation matrix that is taken for positive.
CERTAIN = 1e-9

#: The same as the first for families whose statistic divides by a difference of two covariances.
DIFFERENCE_RATIO = 1e2


@dataclass(frozen=True, slots=True)
class Posterior:
    """(x, gamma - xi) given y[0..k]; the deviation is empty unless y depends on gamma."""

    state: ca.SX  # (n,)
    covariance: ca.SX  # packed
    deviation: ca.SX = field(default_factory=lambda: ca.SX(0, 1))  # (r,)
    deviation_covariance: ca.SX = field(default_factory=lambda: ca.SX(0, 1))  # packed
    cross_covariance: ca.SX = field(default_factory=lambda: ca.SX(0, 1))  # (r, n)
    factors: Factors | None = None  # of the covariance of both, if it is carried so


def update_form(
    spec: Spec, plant: Plant, *, augmented: bool, factored: bool = False, many: int = 1
) -> Form:
    """The covariance update of ``code.update``; "auto" decides on the digits at stake.

    ``factored`` says that the filter has the form "ud" for this plant, ``many`` how many
    covariances it carries.
    """
    float_, stated, size = spec.code.scalar == "float", spec.code.update, FACTORED_STATES
    rows = measurement_of(
        plant, y=ca.SX(plant.ny, 1), C=plant.C, offset=ca.SX(plant.ny, 1), R=plant.R
    )
    parts = Counter(plant.parts).values() or (plant.ne,)
    small = spec.code.form != "loops" and many * sum(n**3 for n in parts) <= size**3
    small = small and not is_rolled(rows, with_gain=False)
    if stated == "ud" and not (factored and small):
        why = f"{many} x {plant.ne} states, {plant.ny} rows" if factored else spec.filter.family
        expected = f"code.form without loops, {size} states at most and few rows of y"
        expected = expected if factored else '"joseph": this filter has no factored form here'
        at = Place(spec.file, "code").entry("update")
        raise at.error(f'"ud" for {why}', expected)
    if stated != "auto":
        return stated
    ratio = DIFFERENCE_RATIO if spec.filter.traits.windows == "full" else SHORT_FORM_RATIO
    at_stake = prior_to_noise(spec)
    if factored and small and (float_ or JOSEPH_FORM_RATIO < at_stake < np.inf):
        return "ud"
    if float_ or plant.noise_free or augmented:
        return "joseph"
    return "short" if at_stake <= ratio else "joseph"


def prior_to_noise(spec: Spec) -> float:
    """Largest ratio of state to noise variance over the rows of y: what a short update loses."""
    P0, ratios = spec.model.P0.values(spec.defaults), [0.0]
    for plant in spec.plants:
        Q, R = (getattr(plant, letter).values(spec.defaults) for letter in "QR")
        C = sensed_at_prior(spec, plant)
        for prior, noise in zip(np.diag(C @ (P0 + Q) @ C.T), np.diag(R), strict=True):
            if noise > 0.0:
                ratios.append(float(prior / noise))
            elif prior > 0.0:
                ratios.append(float("inf"))
    return max(ratios)


def correct(
    builder: PhaseBuilder,
    plant: Plant,
    actuation: Actuation,
    prior: Prior,
    *,
    y: ca.SX,
    form: Form,
    tag: str = "",
    with_gain: bool = False,
    gate: Gate | None = None,
    as_errors: bool = False,
    kept: tuple[ca.SX | None, ...] = (),
) -> tuple[Conditioned, Posterior]:
    """Condition the prediction on y[k]: Strandt et al., (10), (11).

    The prediction is a state and a packed covariance, or factors. A plant with f and h is
    linearised there. ``as_errors`` leaves corrections of a state with attitudes as errors about it.
    ``kept`` is what is positive where rows count.
    """
    joint, measurement = _augmented(plant, actuation, prior, y)
    order = joint[1].order if isinstance(joint[1], Factors) else None
    measurement = replace(measurement, kept=kept, apart=between(plant.parts, order))
    found = condition(
        builder, joint, measurement, tag=tag, form=form, with_gain=with_gain, gate=gate
    )
    n, turns = plant.ne, bool(plant.attitudes) and not as_errors
    if turns:
        found = _turned(builder, plant, prior[0], found, tag)
    P, count = unpack(found.covariance, joint[0].numel()), plant.nx if turns else n
    posterior = Posterior(
        state=found.mean[:count, 0],
        covariance=pack(P[:n, :n]),
        deviation=found.mean[count:, 0],
        deviation_covariance=pack(P[n:, n:]),
        cross_covariance=P[n:, :n],
        factors=found.factors,
    )
    return found, posterior


def _augmented(
    plant: Plant, actuation: Actuation, prior: Prior, y: ca.SX
) -> tuple[Prior, Measurement]:
    """What y[k] is about, mean and covariance, and how: x, gamma - xi and noise that v tells of."""
    n, C, R, held = plant.ne, plant.C, plant.R, prior[1]
    covariance: ca.SX | Factors = held if isinstance(held, Factors) else unpack(held, n)
    state = ca.SX.zeros(n) if plant.attitudes else prior[0]
    if actuation.size and plant.D.nnz():  # y depends on the random part of the input
        state = ca.vertcat(state, ca.SX.zeros(actuation.size))
        covariance = _beside(covariance, actuation.covariance)
        C = ca.horzcat(C, plant.D @ actuation.through)
    offset, S = plant.D @ actuation.mean + plant.d, None
    if plant.seen is not None:  # h has all of it
        offset = ca.SX(plant.ny, 1)
    if moved := moved_by_noise(plant):  # the noise of x that v tells of is estimated with x
        state = ca.vertcat(state, ca.SX.zeros(len(moved)))
        through = ca.SX(plant.ny, len(moved))
        if isinstance(covariance, Factors):
            through, R = told_by_noise(plant)
        else:
            S = ca.vertcat(ca.SX(n, plant.ny), plant.S[moved, :])
        C = ca.horzcat(C, through)
        covariance = _beside(covariance, plant.Q[moved, moved])
    measurement = measurement_of(plant, y=y, C=C, offset=offset, R=R)
    return (state, covariance), replace(measurement, S=S)


def _beside(covariance: ca.SX | Factors, other: ca.SX) -> ca.SX | Factors:
    """The covariance of two things that know nothing of each other."""
    if isinstance(covariance, Factors):
        return covariance.joined(other)
    return ca.diagcat(covariance, other)


def told_by_noise(plant: Plant) -> tuple[ca.SX, ca.SX]:
    """T and what is left of R where v = T w + v' for the noise w of the states that v tells of."""
    moved = moved_by_noise(plant)
    S, Q = (np.array(ca.DM(each)) for each in (plant.S[moved, :], plant.Q[moved, moved]))
    T = S.T @ np.linalg.pinv(Q, hermitian=True)
    left = np.array(ca.DM(plant.R)) - T @ Q @ T.T
    return sparse(ca.SX(ca.DM(T))), sparse(ca.SX(ca.DM((left + left.T) / 2.0)))


def has_factors(plant: Plant) -> bool:
    """Whether the covariance of this plant can be carried as U D U'."""
    if not plant.S.nnz():
        return True
    moved = moved_by_noise(plant)
    others = [i for i in range(plant.ne) if i not in moved]
    if plant.Q[moved, others].nnz() or not all(
        each.is_constant() for each in (plant.S, plant.Q, plant.R)
    ):
        return False
    left = np.array(ca.DM(told_by_noise(plant)[1]))
    least = float(np.linalg.eigvalsh(left / np.sqrt(np.outer(np.diag(left), np.diag(left))))[0])
    return bool((np.diag(left) > 0.0).all()) and least > CERTAIN


def _turned(
    builder: PhaseBuilder, plant: Plant, prior: ca.SX, found: Conditioned, tag: str
) -> Conditioned:
    """An estimate of errors as one of the state; attitudes take the axes of errors with them."""
    n, m = plant.ne, found.mean.numel()
    errors = builder.define(f"correction{tag}", found.mean[:n])
    state, turn = off_by(builder, plant, prior, errors, tag)
    turn = ca.diagcat(turn, ca.SX.eye(m - n))
    mean = ca.vertcat(state, found.mean[n:])
    gain = None if found.gain is None else turn @ found.gain
    if found.factors is not None:
        turned = found.factors.moved(turn, ca.SX(m, 0), ca.SX(0, 1))
        turned = turned.named(builder, f"turned_factors{tag}")
        covariance = turned.covariance()
        return replace(found, mean=mean, covariance=covariance, gain=gain, factors=turned)
    return replace(
        found, mean=mean, covariance=congruence(turn, unpack(found.covariance, m)), gain=gain
    )


def off_by(
    builder: PhaseBuilder, plant: Plant, origin: ca.SX, errors: ca.SX, tag: str = ""
) -> tuple[ca.SX, ca.SX]:
    """The state that lies off by errors, and by what small errors turn on the way, named."""
    state = shifted(origin, errors, plant.attitudes)
    both = builder.name_all(f"turn{tag}", (state, turned_by(plant.attitudes, errors)))
    return both[0], both[1]


def expected(plant: Plant, state: ca.SX, u: ca.SX) -> ca.SX:
    """What is expected of y at a state, where the plant is linearised if it has functions."""
    return plant.C @ state + plant.D @ u + plant.d if plant.seen is None else plant.seen


def moved_by_noise(plant: Plant) -> list[int]:
    """The states whose noise is correlated with that of y."""
    return sorted(set(plant.S.sparsity().get_triplet()[0]))


def measurement_of(plant: Plant, *, y: ca.SX, C: ca.SX, offset: ca.SX, R: ca.SX) -> Measurement:
    """Y = C z + offset + w as this plant measures it, with what rank and logarithms need."""
    return Measurement(
        C=C,
        offset=offset,
        R=R,
        y=y,
        rows=plant.rows,
        at=tuple(range(plant.ny)),
        predicted=plant.seen,
        wraps=plant.wraps,
        rank_tolerance=RANK_TOLERANCE[plant.scalar] if plant.noise_free else None,
        shows_variance=plant.shows_variance,
        pivots_per_log=1 if plant.wide else PIVOTS_PER_LOG[plant.scalar],
        code_form=plant.code_form,
    )


def propagate(
    builder: PhaseBuilder,
    plant: Plant,
    actuation: Actuation,
    posterior: Posterior,
    tag: str = "",
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Predicted state, packed covariance and the map [A, B u~]: Strandt et al., eqs. (4), (12).

    Where products of whole matrices are loops they are written right here, under this ``tag``.
    """
    n, moved = plant.ne, moved_by_noise(plant)
    B, Q = plant.B @ actuation.through, ca.SX(plant.Q)
    if moved:  # their noise is part of what was estimated
        B, Q[moved, moved] = ca.SX.eye(n)[:, moved], 0
    looped = posterior.deviation.numel() == 0 and plant.code_form == "loops"
    state = plant.moved
    if state is None:
        moved_state = (
            moved_mean(builder, plant.A, posterior.state, tag)
            if looped
            else plant.A @ posterior.state
        )
        state = moved_state + plant.B @ actuation.mean + plant.c
    spread = ca.SX.zeros(len(triangle(n))) if plant.spread is None else plant.spread
    if looped:
        noise = pack(plant.Q) + spread
        if actuation.size:
            noise += congruence(B, actuation.covariance)
        Q = unpack(noise, n)
        covariance = moved_covariance(builder, plant.A, Q, posterior.covariance, tag)
        return state, covariance, plant.A
    P = unpack(posterior.covariance, n)
    if posterior.deviation.numel() == 0:
        carried = congruence if plant.moved is None else least_congruence
        covariance = carried(plant.A, P) + pack(plant.Q) + spread
        if actuation.size:
            covariance += congruence(B, actuation.covariance)
        return state, covariance, plant.A
    r = posterior.deviation.numel()
    cross = posterior.cross_covariance
    joint = ca.blockcat(P, cross.T, cross, unpack(posterior.deviation_covariance, r))
    through = ca.horzcat(plant.A, B)
    covariance = congruence(through, joint) + pack(sparse(Q)) + spread
    shift = B @ posterior.deviation
    if not plant.attitudes:
        return state + shift, covariance, through
    turn = turned_by(plant.attitudes, shift)
    state = shifted(state, shift, plant.attitudes)
    return state, congruence(turn, unpack(covariance, n)), turn @ through


def propagate_factors(
    plant: Plant, actuation: Actuation, posterior: Posterior, factors: Factors | Wide
) -> tuple[ca.SX, Factors, ca.SX]:
    """The same with the factors of all that ``posterior`` is about: Thornton 1976."""
    n, moved, order = plant.ne, moved_by_noise(plant), factors.order[: plant.ne]
    B, Q, through = plant.B @ actuation.through, ca.SX(plant.Q), plant.A
    state = plant.moved
    if state is None:
        state = plant.A @ posterior.state + plant.B @ actuation.mean + plant.c
    joint = posterior.deviation.numel() > 0
    if moved:  # their noise is part of what was estimated
        B, Q[moved, moved] = ca.SX.eye(n)[:, moved], 0
    columns = [noise_columns(Q, order, factors.scalar)]
    if plant.G is not None and plant.lifted is not None:
        columns.append((plant.G, plant.lifted.variances))
    if joint:
        through = ca.horzcat(plant.A, B)
    elif actuation.size:
        own, weights = columns_of(actuation.covariance, factors.scalar)
        columns.append((sparse(B @ own), weights))
    noise, weights = (
        ca.horzcat(*(each for each, _ in columns)),
        ca.vertcat(*(w for _, w in columns)),
    )
    found = factors.moved(through, noise, weights, order)
    if joint:
        shift = B @ posterior.deviation
        if not plant.attitudes:
            return state + shift, found, through
        turn = turned_by(plant.attitudes, shift)
        state = shifted(state, shift, plant.attitudes)
        return state, found.moved(turn, ca.SX(n, 0), ca.SX(0, 1)), turn @ through
    return state, found, through


def bound(builder: PhaseBuilder, plant: Plant, letters: str) -> Plant:
    """The plant with its computed entries named; variances below zero are refused."""
    return bound_all(builder, (plant,), letters)[0]


def bound_all(builder: PhaseBuilder, plants: Sequence[Plant], letters: str) -> tuple[Plant, ...]:
    """The same for several plants; a matrix that is the same object in some is named once."""
    named: dict[int, Any] = {}
    if plants[0].lifted is not None:  # what depends on the state is named where it is linearised
        letters = "".join(letter for letter in letters if letter not in "ABCDcd")
    if "A" in letters and plants[0].limits:
        builder.demand(Kind.NONNEGATIVE, plants[0].limits, Status.PARAMETER_OUT_OF_RANGE)
    for letter in letters:
        own = {id(matrix): matrix for matrix in (getattr(plant, letter) for plant in plants)}
        named |= zip(own, builder.name_all(letter, [*own.values()]), strict=True)
        for matrix in (named[key] for key in own if letter in "QR"):
            diagonal = [matrix[i, i] for i in range(matrix.shape[0])]
            variances = [value for value in diagonal if not is_zero(value)]
            builder.demand(Kind.NONNEGATIVE, variances, Status.PARAMETER_OUT_OF_RANGE)
    return tuple(
        replace(plant, **{letter: named[id(getattr(plant, letter))] for letter in letters})
        for plant in plants
    )


def finite(state: ca.SX, packed: ca.SX) -> Guard:
    """Refuse the sample unless the state and the variances are finite."""
    values = ca.vertcat(state, *diagonal(packed))
    return Guard(ca.densify(values), Kind.FINITE, Status.RESULT_NOT_FINITE)


def demand_finite(builder: PhaseBuilder, state: ca.SX) -> None:
    """Refuse the sample unless the corrected state is finite.

    Its variances are then finite too: none is larger than before the correction, and a pivot whose
    reciprocal overflows spoils the state along with them.
    """
    builder.demand(Kind.FINITE, ca.vertsplit(state), Status.RESULT_NOT_FINITE)


def demand_positive(builder: PhaseBuilder, held: ca.SX | Factors) -> None:
    """Refuse to go on from a covariance, packed or as factors, with a negative variance."""
    variances = ca.vertsplit(held.scale) if isinstance(held, Factors) else diagonal(held)
    builder.demand(Kind.NONNEGATIVE, variances, Status.NOT_POSITIVE_DEFINITE)
