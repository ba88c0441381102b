"""The unscented Kalman filter: points of an estimate go through f and h, and give moments back.

Julier & Uhlmann 1997. Points lie at plus and minus the columns of s L, P = L L', and in the centre
if it has a weight: all have weights 1 / (2 s^2) but for the centre, s^2 = N + kappa. With the half
differences b and the deviations a of the middles of opposite points, moments are M = b / s, the
derivative by errors in units of L, and a a' / s^2, which acts like noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.decorrelation import correlated_rows
from fkgen.estimators.gaussian.estimate import (
    bound,
    correct,
    demand_finite,
    demand_positive,
    finite,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, condition
from fkgen.estimators.lmmse.kalman import innovation_results, prediction
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.lifting.equations import Lifted, box_minus, box_plus, shifted, turned_by
from fkgen.symbolic.lifting.linearise import demand_decided, demand_variances, seen_from
from fkgen.symbolic.linalg import (
    congruence,
    outer_lower,
    pack,
    reduced,
    row_congruence,
    sparse,
    total,
    unpack,
)
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import innovation_ports, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

#: A pivot of a covariance below this share of its variance is the zero of a semidefinite one.
NO_PIVOT = {"double": 1e-14, "float": 1e-6}

#: Below this share of the square of what is seen a variance of its noise is none.
ROUNDED = {"double": 1e-28, "float": 1e-12}


def unscented_filter(spec: Spec, *, source: str) -> Recursion:
    """Build the recursion of ``ukf``."""
    plant = plant_of(spec)
    ports = (*state_ports(spec), *innovation_ports(spec))
    symbols = symbols_of(spec, plant, ports)
    form = update_form(spec, plant, augmented=False)
    lifted, kappa = plant.lifted, spec.filter.options.kappa
    if lifted is None or lifted.plain[0]:  # moments of sums are exact without points
        predict = prediction(spec, plant, symbols, with_gain=False)
    else:
        predict = _predict(plant, symbols, lifted, kappa)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        update=_update(plant, symbols, form, kappa),
        predict=predict,
        form=form,
        repeats=correlated_rows((plant.R,)),
    )


@dataclass(frozen=True, slots=True)
class Points:
    """What errors there are: opposite pairs of equal weights, and maybe a centre."""

    columns: tuple[ca.SX, ...]  # (N,) each, N of them: plus; minus is their negative
    kappa: float

    @classmethod
    def of(cls, builder: PhaseBuilder, root: ca.SX, kappa: float) -> Points:
        """The points of a covariance with this root, (N, N)."""
        spread = math.sqrt(root.shape[0] + kappa)
        (scaled,) = builder.name_all("spread", (spread * root,))
        return cls(tuple(sparse(each) for each in ca.horzsplit(scaled)), kappa)

    @property
    def square(self) -> float:
        """S^2 = N + kappa."""
        return len(self.columns) + self.kappa

    @property
    def errors(self) -> list[ca.SX]:
        """All points in their order: the centre, if there is one, plus, then minus."""
        centre = [ca.SX(self.columns[0].numel(), 1)] if self.kappa else []
        return [*centre, *self.columns, *(-each for each in self.columns)]

    def mean(self, values: Sequence[ca.SX]) -> ca.SX:
        """The mean of what the points become."""
        around = total(values[1:] if self.kappa else values) * (0.5 / self.square)
        return around + (self.kappa / self.square) * values[0] if self.kappa else around

    def covariance(self, deviations: Sequence[ca.SX]) -> ca.SX:
        """Packed covariance of what the points become, from deviations from the mean."""
        squares = [outer_lower(each, each) for each in deviations]
        return self.mean(squares)

    def halves(self, deviations: Sequence[ca.SX]) -> tuple[ca.SX, ca.SX]:
        """M', (p, N), and the packed covariance of what M does not say."""
        left = list(deviations)
        curved = ca.SX(0)
        if self.kappa:
            centre = left.pop(0)
            curved = (self.kappa / self.square) * outer_lower(centre, centre)
        pairs = [*zip(left[: len(self.columns)], left[len(self.columns) :], strict=True)]
        slopes = [(0.5 / math.sqrt(self.square)) * (a - b) for a, b in pairs]
        middles = [0.5 * (a + b) for a, b in pairs]
        curved += total(outer_lower(a, a) for a in middles) * (1.0 / self.square)
        return sparse(ca.horzcat(*slopes)), curved


def _update(plant: Plant, symbols: dict[str, ca.SX], form: Form, kappa: float) -> Phase:
    builder = PhaseBuilder(symbols)
    prior, y, u = (
        (symbols["predicted_state"], symbols["predicted_covariance"]),
        symbols["y"],
        symbols["u"],
    )
    demand_positive(builder, prior[1])
    plant = bound(builder, plant, "CDRd")
    if plant.lifted is None or plant.lifted.plain[1]:
        (plant,) = seen_from(builder, [plant], prior[:1], u)
        found, posterior = correct(builder, plant, certain(u), prior, y=y, form=form)
        state, covariance = posterior.state, posterior.covariance
    else:
        root = lower_root(builder, prior[1], NO_PIVOT[plant.scalar])
        given = plant.lifted, (prior[0], root), (y, u)
        found = _seen(builder, plant, given, (form, kappa))
        state, covariance = _corrected(builder, plant, prior[0], root, found)
    demand_finite(builder, state)
    results = {"filtered_state": state, "filtered_covariance": covariance}
    with builder.titled("results of the update"):
        builder.assign(results | innovation_results(found))
    return builder.phase()


def _seen(
    builder: PhaseBuilder,
    plant: Plant,
    given: tuple[Lifted, tuple[ca.SX, ca.SX], tuple[ca.SX, ca.SX]],
    how: tuple[Form, float],
) -> Conditioned:
    """Errors in units of the root of the covariance, given y."""
    lifted, (state, root), (y, u) = given
    points = Points.of(builder, root, how[1])
    with builder.titled("h of the points"):
        each = [box_plus(state, e, plant.attitudes) for e in points.errors]
        by = [lifted.x, lifted.u]
        places = builder.name_distinct("point", each)
        sent = [ca.substitute([lifted.seen], by, [x, u])[0] for x in places]
        demand_decided(builder, [ca.substitute([lifted.seen_by], by, [x, u])[0] for x in places])
        values = builder.name_distinct("seen", sent)
    with builder.titled("moments of y"):
        mean = points.mean(values)
        for i in plant.wraps:
            mean[i] = values[0][i] + points.mean([reduced(z[i] - values[0][i]) for z in values])
        mean = builder.define("expected", mean)
        builder.demand(Kind.FINITE, ca.vertsplit(mean), Status.RESULT_NOT_FINITE)
        deviations = [_difference(z, mean, plant.wraps) for z in values]
        M, curved = points.halves(builder.name_distinct("deviation", deviations))
        M, R = builder.name_all("M", (M, sparse(unpack(pack(plant.R) + curved, plant.ny))))
    n, S = plant.ne, None
    if plant.noise_free:  # what rounding leaves of a a' is no noise: only S tells what is none
        S, R, M = M.T, unpack(congruence(M, ca.SX.eye(n)) + pack(R), plant.ny), ca.SX(*M.shape)
    elif not plant.R.is_constant():
        _demand_noise(builder, plant, (M, R, mean))
    stated = measurement_of(plant, y=y, C=M, offset=ca.SX.zeros(plant.ny), R=R)
    stated = replace(stated, predicted=mean, S=S)
    return condition(builder, (ca.SX.zeros(n), ca.SX.eye(n)), stated, form=how[0])


def _demand_noise(builder: PhaseBuilder, plant: Plant, moments: tuple[ca.SX, ca.SX, ca.SX]) -> None:
    """Refuse rows of which a parameter takes the noise away: rounding would be in its place."""
    M, R, mean = moments
    for i in range(plant.ny if plant.ny > 1 else 0):
        least = ROUNDED[plant.scalar] * (mean[i] * mean[i] + ca.sumsqr(M[i, :]))
        with builder.if_present(i):
            builder.demand(Kind.POSITIVE, [R[i, i] - least], Status.NOT_POSITIVE_DEFINITE)


def _corrected(
    builder: PhaseBuilder, plant: Plant, state: ca.SX, root: ca.SX, found: Conditioned
) -> tuple[ca.SX, ca.SX]:
    """The state moved by errors, and its packed covariance, turned with it."""
    errors = builder.define("correction", root @ found.mean)
    state = shifted(state, errors, plant.attitudes)
    if plant.attitudes:
        (root,) = builder.name_all("turned", (turned_by(plant.attitudes, errors) @ root,))
    return state, row_congruence(root, unpack(found.covariance, plant.ne))


def _predict(plant: Plant, symbols: dict[str, ca.SX], lifted: Lifted, kappa: float) -> Phase:
    builder = PhaseBuilder(symbols)
    plant = bound(builder, plant, "Q")
    x, u = symbols["filtered_state"], symbols["u"]
    root = lower_root(builder, symbols["filtered_covariance"], NO_PIVOT[plant.scalar])
    demand_variances(builder, lifted)
    deviations = sparse(ca.diag(ca.sqrt(lifted.variances)))
    points = Points.of(builder, ca.diagcat(root, deviations), kappa)
    n = plant.ne
    with builder.titled("f of the points"):
        each = [box_plus(x, e[:n], plant.attitudes) for e in points.errors]
        by = [lifted.x, lifted.u, lifted.w]
        places = zip(builder.name_distinct("point", each), points.errors, strict=True)
        drawn = lifted.w.numel()
        given = [[x, u, ca.densify(e[n:]) if drawn else lifted.w] for x, e in places]
        sent = [ca.substitute([lifted.stirred], by, values)[0] for values in given]
        demand_decided(builder, [ca.substitute([lifted.moved_by], by, v)[0] for v in given])
        values = builder.name_distinct("moved", sent)
    first = values[0]
    with builder.titled("moments of the next state"):
        shift = points.mean([box_minus(z, first, lifted) for z in values])
        mean = shifted(first, shift, plant.attitudes)
        mean = builder.define("mean", mean)
        apart = [box_minus(z, mean, lifted) for z in values]
        spread = builder.name_distinct("deviation", apart)
        covariance = points.covariance(spread) + pack(plant.Q)
    with builder.titled("prediction of the next sample"):
        builder.assign(
            {"predicted_state": mean, "predicted_covariance": covariance},
            [finite(mean, covariance)],
        )
    return builder.phase()


def _difference(value: ca.SX, other: ca.SX, wraps: Sequence[int]) -> ca.SX:
    """Of measurements, that of angles reduced."""
    apart = value - other
    for i in wraps:
        apart[i] = reduced(apart[i])
    return apart


def lower_root(builder: PhaseBuilder, packed: ca.SX, tolerance: float) -> ca.SX:
    """Cholesky's factor of a semidefinite matrix: a pivot that is zero leaves a column of zeros."""
    n = (math.isqrt(8 * packed.numel() + 1) - 1) // 2
    P, L = unpack(packed, n), ca.SX(n, n)
    for j in range(n):
        left = P[j:, j] - L[j:, :j] @ L[j, :j].T
        left = builder.define(f"left_{j}", ca.densify(left)) if j else left
        inverse = builder.local(f"inverse_root_{j}", 1, 0.0)
        positive = left[0] - tolerance * P[j, j]
        with builder.titled("root of the covariance"), builder.if_positive(positive):
            builder.assign({f"inverse_root_{j}": 1 / ca.sqrt(left[0])})
        (L[j:, j],) = builder.name_all(f"root_{j}", (left * inverse,))
    return L
