"""The iterated extended Kalman filter: Gauss and Newton's steps to the most probable state.

Bell & Cathey 1993. A step is taken only where it lowers the cost d' P^-1 d + r' R^-1 r of the
errors d about the prediction, r = y - h(x (+) d). A step that is not taken is found again, and not
taken again, by the iterations after it: so their number is fixed, and nothing branches but a copy.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.decorrelation import correlated_rows
from fkgen.estimators.gaussian.estimate import (
    bound,
    correct,
    demand_finite,
    demand_positive,
    has_factors,
    measurement_of,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, Prior, condition
from fkgen.estimators.gaussian.ud import (
    Factors,
    factors_note,
    order_of,
    seen_through,
    started,
    unpacked,
)
from fkgen.estimators.lmmse.kalman import innovation_results, prediction
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.lifting.equations import Lifted, shifted, turned_by
from fkgen.symbolic.lifting.linearise import evaluated, seen_from
from fkgen.symbolic.linalg import column, congruence, is_zero, pack, reduced, sparse, total, unpack
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import factor_ports, innovation_ports, shown, state_ports, symbols_of
from fkgen.symbolic.recursion import Phase, Recursion


def iterated_filter(spec: Spec, *, source: str) -> Recursion:
    """Build the recursion of ``iekf``."""
    plant = plant_of(spec)
    stayed = shown("stayed", (), "1 where a step did not lower the cost, so the estimate stayed")
    ports = (*state_ports(spec), *innovation_ports(spec), stayed)
    form = update_form(spec, plant, augmented=False, factored=has_factors(plant))
    order = order_of((plant,)) if form == "ud" else ()
    ports = (*factor_ports(plant.ne), *ports) if order else ports
    symbols, start = symbols_of(spec, plant, ports), None
    if order:
        begun = {"predicted_factors": 1, "filtered_factors": 1}
        start = started(spec, symbols, begun, order)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        start=start,
        update=_update(spec, plant, symbols, (form, order)),
        predict=prediction(spec, plant, symbols, with_gain=False, order=order),
        form=form,
        factor_order=order,
        notes=factors_note(order, spec),
        repeats=correlated_rows((plant.R,)),
    )


def _update(
    spec: Spec, plant: Plant, symbols: dict[str, ca.SX], how: tuple[Form, tuple[int, ...]]
) -> Phase:
    builder, y, (form, order) = PhaseBuilder(symbols), symbols["y"], how
    held: ca.SX | Factors = symbols["predicted_covariance"]
    if order:
        held = Factors.of(symbols["predicted_factors"], order, plant.scalar)
    prior: Prior = symbols["predicted_state"], held
    demand_positive(builder, held)
    plant = bound(builder, plant, "CDRd")
    (plant,) = seen_from(builder, [plant], prior[:1], symbols["u"])
    stayed = ca.SX(0)
    if plant.lifted is None or plant.lifted.plain[1]:  # the first step ends where the cost is least
        found, posterior = correct(builder, plant, certain(symbols["u"]), prior, y=y, form=form)
        state, covariance, factors = posterior.state, posterior.covariance, posterior.factors
    else:
        search = Search(
            builder=builder,
            plant=plant,
            lifted=plant.lifted,
            prior=prior,
            u=symbols["u"],
            y=y,
            form=form,
        )
        found, state, covariance, factors = search.run(spec.filter.options.iterations)
        stayed = search.kept["stays"]
    demand_finite(builder, state)
    results = {"filtered_state": state, "filtered_covariance": covariance, "stayed": stayed}
    if factors is not None:
        results["filtered_factors"] = factors.packed
    with builder.titled("results of the update"):
        builder.assign(results | innovation_results(found))
    return builder.phase()


class Independent:
    """Rows of y as combinations whose noises are independent: L^-1 of R = L E L'."""

    def __init__(self, builder: PhaseBuilder, R: ca.SX) -> None:
        p = R.shape[0]
        left = {(i, j): R[i, j] for i in range(p) for j in range(i + 1)}
        self.shares: dict[tuple[int, int], ca.SX] = {}
        self.variances: list[ca.SX] = []
        self.inverses: list[ca.SX] = []  # 0 where a row is missing
        for j in range(p):
            self.variances.append(left[j, j])
            self.inverses.append(builder.local(f"weight_of_row_{j}", 1, 0.0))
            with builder.if_present(j):
                builder.demand(Kind.POSITIVE, [left[j, j]], Status.NOT_POSITIVE_DEFINITE)
                builder.assign({f"weight_of_row_{j}": 1 / left[j, j]})
            later = [i for i in range(j + 1, p) if not is_zero(left[i, j])]
            for i in later:
                share = builder.define(f"share_{j}_{i}", left[i, j] * self.inverses[j])
                for k in (k for k in later if k <= i):
                    left[i, k] = builder.define(
                        f"noise_{j}_{i}_{k}", left[i, k] - share * left[k, j]
                    )
                self.shares[j, i] = share

    def __call__(self, rows: ca.SX) -> ca.SX:
        """The combinations of rows of a matrix."""
        found = ca.vertsplit(rows)
        for (j, i), share in self.shares.items():
            found[i] = found[i] - share * found[j]
        return sparse(ca.vertcat(*found))


@dataclass(slots=True, kw_only=True)
class Search:
    """Builder of the iterations; what the last step that was taken leaves behind is in locals."""

    builder: PhaseBuilder
    plant: Plant  # With h linearised at the prediction
    lifted: Lifted
    prior: Prior  # State, and covariance, packed or as factors
    u: ca.SX
    y: ca.SX
    form: Form
    independent: Independent = field(init=False)
    kept: dict[str, ca.SX] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """No step is taken yet, and h is linearised at the prediction."""
        builder, plant = self.builder, self.plant
        self.independent = Independent(builder, plant.R)
        expected = ca.SX(plant.ny, 1) if plant.seen is None else plant.seen
        residual = self._residual(expected, "innovation")
        seen = self.independent(residual)
        start = {"residual": residual, "cost": self._square(seen), "sensed": self._moving(plant.C)}
        for name in ("step", "stays", *(["corrected"] if plant.attitudes else [])):
            size = {"step": plant.ne, "stays": 1, "corrected": plant.nx}[name]
            self.kept[name] = builder.local(name, size, 0.0)
        for name, value in start.items():
            self.kept[name] = builder.local(name, value.numel())
        with builder.titled("cost of the prediction"):
            builder.assign(start | ({"corrected": self.prior[0]} if plant.attitudes else {}))

    def run(self, iterations: int) -> tuple[Conditioned, ca.SX, ca.SX, Factors | None]:
        """What the prediction says of y; corrected state, packed covariance, its factors if any."""
        builder, plant, ne = self.builder, self.plant, self.plant.ne
        innovation = column([builder.symbol(f"innovation_{i}") for i in range(plant.ny)])
        first = found = self._iterate(0, last=iterations == 1)
        for i in range(1, iterations):
            found = self._iterate(i, last=i + 1 == iterations)
        S = first.innovation_covariance
        if self.independent.shares:
            S = seen_through(plant.C, unpacked(self.prior[1], ne)) + pack(plant.R)
        first = replace(first, innovation=innovation, innovation_covariance=S)
        if not plant.attitudes:
            state = self.prior[0] + self.kept["step"]
            return first, state, found.covariance, found.factors
        (turn,) = builder.name_all("turn", (turned_by(plant.attitudes, self.kept["step"]),))
        if found.factors is not None:
            turned = found.factors.moved(turn, ca.SX(ne, 0), ca.SX(0, 1))
            turned = turned.named(builder, "turned_factors")
            return first, self.kept["corrected"], turned.covariance(), turned
        covariance = congruence(turn, unpack(found.covariance, ne))
        return first, self.kept["corrected"], covariance, None

    def _iterate(self, i: int, *, last: bool) -> Conditioned:
        """Find the next step with H of the last one taken, and take it if it lowers the cost."""
        builder, plant, kept = self.builder, self.plant, self.kept
        tag = f"_{i}"
        H = self.independent(self._sensed(kept["sensed"]))
        (H,) = builder.name_all(f"H{tag}", (H,))
        expected = H @ kept["step"] if i else ca.SX(plant.ny, 1)
        target = self.independent(kept["residual"]) + expected
        target = builder.define(f"target{tag}", ca.densify(target))
        found = self._conditioned(H, target, tag)
        along = builder.define(f"along{tag}", ca.densify(H @ found.mean))
        weights = zip(ca.vertsplit(target - along), ca.vertsplit(along), strict=True)
        inverses = self.independent.inverses
        price = total(a * b * w for (a, b), w in zip(weights, inverses, strict=True))
        state = shifted(self.prior[0], found.mean, plant.attitudes)
        state = builder.define(f"trial{tag}", state)
        letters = ("seen", "seen_by") if last else ("seen", "seen_by", "C")
        seen, decided, *C = evaluated(builder, plant, state, self.u, (f"seen{tag}", letters))
        residual = self._residual(seen, f"residual{tag}")
        cost = builder.define(f"cost{tag}", price + self._square(self.independent(residual)))
        new = {"step": found.mean, "cost": cost, "stays": ca.SX(0)}
        new |= {"corrected": state} if plant.attitudes else {}
        if not last:
            new |= {
                "residual": residual,
                "sensed": self._moving(C[0] @ turned_by(plant.attitudes, found.mean)),
            }
        with builder.titled(f"iteration {i + 1}: the step is taken if it lowers the cost"):
            with builder.if_present(None):
                builder.assign({"stays": ca.SX(1)})
            with builder.if_positive(_lowered(kept["cost"] - cost, decided)):
                builder.assign({name: value for name, value in new.items() if value.numel()})
        return found

    def _conditioned(self, H: ca.SX, target: ca.SX, tag: str) -> Conditioned:
        """Errors given y, for an h that is a line through the last step."""
        builder, plant = self.builder, self.plant
        zero, R = ca.SX.zeros(plant.ny), ca.diag(column(self.independent.variances))
        stated = measurement_of(plant, y=self.y, C=H, offset=zero, R=R)
        prior = ca.SX.zeros(plant.ne), unpacked(self.prior[1], plant.ne)
        rows = ca.vertsplit(target)
        return condition(builder, prior, stated, tag=tag, form=self.form, innovation=rows)

    def _residual(self, seen: ca.SX, name: str) -> ca.SX:
        """Y less what is seen of a state, 0 where a row is missing."""
        builder, rows = self.builder, []
        for i in range(self.plant.ny):
            rows.append(builder.local(f"{name}_{i}", 1, 0.0))
            value = self.y[i] - seen[i]
            with builder.if_present(i):
                builder.assign({f"{name}_{i}": reduced(value) if i in self.plant.wraps else value})
        return column(rows)

    def _square(self, rows: ca.SX) -> ca.SX:
        """R' R^-1 r of the rows present."""
        inverses = self.independent.inverses
        return total(r * r * w for r, w in zip(ca.vertsplit(rows), inverses, strict=True))

    @property
    def _pattern(self) -> tuple[ca.SX, list[tuple[int, int]]]:
        """H about any step, and where its entries differ from step to step."""
        H = sparse(self.lifted.C @ turned_by(self.plant.attitudes, ca.SX.sym("d", self.plant.ne)))
        places = zip(*H.sparsity().get_triplet(), strict=True)
        return H, [place for place in places if not H[place].is_constant()]

    def _moving(self, H: ca.SX) -> ca.SX:
        """The entries of H that differ from step to step."""
        return column([H[place] for place in self._pattern[1]])

    def _sensed(self, moving: ca.SX) -> ca.SX:
        """H of these entries."""
        H, places = self._pattern
        for k, place in enumerate(places):
            H[place] = moving[k]
        return H


def _lowered(by: ca.SX, decided: ca.SX) -> ca.SX:
    """What is positive where a cost is lowered, and is so by an h that decides by values.

    A decision by NaN would be "no" and leave a cost that is none; with it the quotient is NaN, and
    0 with one by an infinity.
    """
    sizes = [ca.fabs(each) for each in ca.vertsplit(ca.densify(decided)) if not each.is_constant()]
    return by / (1.0 + total(sizes)) if sizes else by
