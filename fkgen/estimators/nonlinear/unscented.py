"""The unscented Kalman filter: points of an estimate go through f and h, and give moments back.

Julier & Uhlmann 1997. Points lie at plus and minus the columns of s L, P = L L', and in the centre
if it has a weight: all have weights 1 / (2 s^2) but for the centre, s^2 = N + kappa. With the half
differences b and the deviations a of the middles of opposite points, moments are M = b / s, the
derivative by errors in units of L, and a a' / s^2, which acts like noise.

In factors P = U D U' with rows from the last state to the first, L is U sqrt(D). What y says is
about errors in units of the columns of U, and the deviations of points are put into factors.
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
    has_factors,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, Prior, condition
from fkgen.estimators.gaussian.ud import (
    Factors,
    factors_note,
    noise_columns,
    order_of,
    reciprocal,
    started,
)
from fkgen.estimators.lmmse.kalman import innovation_results, prediction
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.lifting.equations import Lifted, box_minus, box_plus, shifted, turned_by
from fkgen.symbolic.lifting.linearise import demand_decided, demand_variances, seen_from
from fkgen.symbolic.linalg import (
    column,
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
from fkgen.symbolic.ports import factor_ports, innovation_ports, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion

#: A pivot of a covariance below this share of its variance is the zero of a semidefinite one.
NO_PIVOT = {"double": 1e-14, "float": 1e-6}

#: Below this share of the square of what is seen a variance of its noise is none.
ROUNDED = {"double": 1e-28, "float": 1e-12}


def unscented_filter(spec: Spec, *, source: str) -> Recursion:
    """Build the recursion of ``ukf``."""
    plant, kappa = plant_of(spec), spec.filter.options.kappa
    factored = has_factors(plant) and (_is_plain(plant)[1] or not plant.noise_free)
    form = update_form(spec, plant, augmented=False, factored=factored)
    order: tuple[int, ...] = ()
    if form == "ud":  # that of Cholesky's factor where points are drawn
        order = order_of((plant,)) if all(_is_plain(plant)) else tuple(reversed(range(plant.ne)))
    ports = (*state_ports(spec), *innovation_ports(spec))
    ports = (*factor_ports(plant.ne), *ports) if order else ports
    symbols, start = symbols_of(spec, plant, ports), None
    if order:
        begun = {"predicted_factors": 1, "filtered_factors": 1}
        start = started(spec, symbols, begun, order)
    if plant.lifted is None or _is_plain(plant)[0]:  # moments of sums are exact without points
        predict = prediction(spec, plant, symbols, with_gain=False, order=order)
    else:
        predict = _predict(plant, symbols, plant.lifted, (kappa, order))
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        start=start,
        update=_update(plant, symbols, (form, order), kappa),
        predict=predict,
        form=form,
        factor_order=order,
        notes=factors_note(order, spec),
        repeats=correlated_rows((plant.R,)),
    )


def _is_plain(plant: Plant) -> tuple[bool, bool]:
    """Whether f and h are sums of multiples of the state."""
    return (True, True) if plant.lifted is None else plant.lifted.plain


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

    def factors(
        self, deviations: Sequence[ca.SX], noise: tuple[ca.SX, ca.SX], like: Factors
    ) -> Factors:
        """The same as factors, with columns of noise and their weights added."""
        weights = [ca.SX(0.5 / self.square)] * len(deviations)
        if self.kappa:
            weights[0] = ca.SX(self.kappa / self.square)
        nothing = replace(like, unit=ca.SX.eye(like.size), scale=ca.SX(like.size, 1))
        columns = ca.horzcat(*deviations, noise[0])
        return nothing.moved(ca.SX(like.size, like.size), columns, ca.vertcat(*weights, noise[1]))

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


def _update(
    plant: Plant, symbols: dict[str, ca.SX], how: tuple[Form, tuple[int, ...]], kappa: float
) -> Phase:
    builder, (form, order) = PhaseBuilder(symbols), how
    x, y, u = (symbols[name] for name in ("predicted_state", "y", "u"))
    held: ca.SX | Factors = symbols["predicted_covariance"]
    if order:
        held = Factors.of(symbols["predicted_factors"], order, plant.scalar)
    demand_positive(builder, held)
    plant = bound(builder, plant, "CDRd")
    if plant.lifted is None or plant.lifted.plain[1]:
        (plant,) = seen_from(builder, [plant], (x,), u)
        found, posterior = correct(builder, plant, certain(u), (x, held), y=y, form=form)
        state, covariance, factors = posterior.state, posterior.covariance, posterior.factors
    else:
        root = _root(builder, held, plant.scalar)
        found = _seen(builder, plant, (plant.lifted, (x, held, root), (y, u)), (form, kappa))
        units = held.in_rows()[:, list(order)] if isinstance(held, Factors) else root
        state, covariance, factors = _corrected(builder, plant, x, units, found)
    demand_finite(builder, state)
    results = {"filtered_state": state, "filtered_covariance": covariance}
    if factors is not None:
        results["filtered_factors"] = factors.packed
    with builder.titled("results of the update"):
        builder.assign(results | innovation_results(found))
    return builder.phase()


def _seen(
    builder: PhaseBuilder,
    plant: Plant,
    given: tuple[Lifted, tuple[ca.SX, ca.SX | Factors, ca.SX], tuple[ca.SX, ca.SX]],
    how: tuple[Form, float],
) -> Conditioned:
    """Errors given y, in units of the root of the covariance, or of the columns of U."""
    lifted, (state, held, root), (y, u) = given
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
    prior: Prior = ca.SX.zeros(n), ca.SX.eye(n)
    if isinstance(held, Factors):
        prior = prior[0], replace(held, unit=ca.SX.eye(n))
        scales = (held.scale[held.order.index(i)] for i in range(n))
        inverses = [reciprocal(ca.sqrt(each), held.scalar)[0] for each in scales]
        (M,) = builder.name_all("M_of_units", (M @ ca.diag(column(inverses)),))
    stated = measurement_of(plant, y=y, C=M, offset=ca.SX.zeros(plant.ny), R=R)
    stated = replace(stated, predicted=mean, S=S)
    return condition(builder, prior, stated, form=how[0])


def _demand_noise(builder: PhaseBuilder, plant: Plant, moments: tuple[ca.SX, ca.SX, ca.SX]) -> None:
    """Refuse rows of which a parameter takes the noise away: rounding would be in its place."""
    M, R, mean = moments
    for i in range(plant.ny if plant.ny > 1 else 0):
        least = ROUNDED[plant.scalar] * (mean[i] * mean[i] + ca.sumsqr(M[i, :]))
        with builder.if_present(i):
            builder.demand(Kind.POSITIVE, [R[i, i] - least], Status.NOT_POSITIVE_DEFINITE)


def _corrected(
    builder: PhaseBuilder, plant: Plant, state: ca.SX, units: ca.SX, found: Conditioned
) -> tuple[ca.SX, ca.SX, Factors | None]:
    """The state moved by errors, its packed covariance, turned with it, and factors if any."""
    errors = builder.define("correction", units @ found.mean)
    state = shifted(state, errors, plant.attitudes)
    if plant.attitudes:
        (units,) = builder.name_all("turned", (turned_by(plant.attitudes, errors) @ units,))
    if found.factors is None:
        return state, row_congruence(units, unpack(found.covariance, plant.ne)), None
    factors = found.factors.moved(units, ca.SX(plant.ne, 0), ca.SX(0, 1))
    factors = factors.named(builder, "corrected_factors")
    return state, factors.covariance(), factors


def _root(builder: PhaseBuilder, held: ca.SX | Factors, scalar: str) -> ca.SX:
    """Cholesky's factor of a packed covariance, or of factors from the last state to the first."""
    if not isinstance(held, Factors):
        return lower_root(builder, held, NO_PIVOT[scalar])
    scaled = held.in_rows() @ ca.diag(ca.sqrt(held.scale))
    return builder.name_all("root", (sparse(scaled[:, list(held.order)]),))[0]


def _predict(
    plant: Plant,
    symbols: dict[str, ca.SX],
    lifted: Lifted,
    how: tuple[float, tuple[int, ...]],
) -> Phase:
    builder, (kappa, order) = PhaseBuilder(symbols), how
    plant = bound(builder, plant, "Q")
    x, u = symbols["filtered_state"], symbols["u"]
    held: ca.SX | Factors = symbols["filtered_covariance"]
    if order:
        held = Factors.of(symbols["filtered_factors"], order, plant.scalar)
    root = _root(builder, held, plant.scalar)
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
        found: dict[str, ca.SX] = {}
        if isinstance(held, Factors):
            factors = points.factors(spread, noise_columns(plant.Q, order, plant.scalar), held)
            factors = factors.named(builder, "next_factors")
            found, covariance = {"predicted_factors": factors.packed}, factors.covariance()
        else:
            covariance = points.covariance(spread) + pack(plant.Q)
    with builder.titled("prediction of the next sample"):
        builder.assign(
            {"predicted_state": mean, "predicted_covariance": covariance} | found,
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
