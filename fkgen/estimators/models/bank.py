"""Multiple model estimation of an unknown fault rate: a bank of modified Kalman filters.

Strandt, Schneider & Yaz, sec. 3. One hypothesis per success rate; weights by Bayes' rule (14)-(16)
with the mixture likelihood (exact in gamma[k]) or the paper's Gaussian (15). Estimates are combined
coherently: x(k|k) and x(k+1|k) with weights given y[0..k]; ``paper_state`` is (18) as printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.actuation import Actuation, intermittent
from fkgen.estimators.gaussian.decorrelation import correlated_rows, whiten
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    correct,
    demand_finite,
    demand_positive,
    expected,
    finite,
    has_factors,
    propagate,
    propagate_factors,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, Prior
from fkgen.estimators.gaussian.ud import (
    Factors,
    factors_note,
    order_of,
    packed_factors,
    started,
)
from fkgen.estimators.models.merge import Chart, Gaussian, combined_innovation, mixture
from fkgen.estimators.models.weights import log_prior, log_sum_exp, patterns, reweigh
from fkgen.faults import ActuatorFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.lifting.linearise import moved_from, seen_from
from fkgen.symbolic.linalg import (
    by_rows,
    congruence,
    from_rows,
    pack,
    split_estimates,
    unpack,
    weighted_sum,
)
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import (
    carried,
    innovation_ports,
    mode_estimate_ports,
    mode_factor_ports,
    shown,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: With more independent inputs than this the mixture has too many terms; the Gaussian is used
#: instead.
LARGEST_MIXTURE = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Bank:
    """The hypotheses side by side; ``random[i]`` components of gamma[k] are learnt from y[k]."""

    spec: Spec
    plant: Plant
    faults: ActuatorFaults
    symbols: dict[str, ca.SX]
    random: tuple[int, ...]
    form: Form
    mixture: bool
    order: tuple[int, ...] = ()  # of rows of factors, if there are any

    def prior(self, i: int) -> Prior:
        """The prediction of hypothesis i."""
        states, packed = self.symbols["mode_state"], self.symbols["mode_covariance"]
        state, covariance = split_estimates(states, packed, self.plant.nx)[i]
        if not self.order:
            return state, covariance
        held = ca.vertsplit(self.symbols["mode_factors"], covariance.numel())[i]
        return state, Factors.of(held, self.order, self.plant.scalar)

    def held(self, i: int) -> Factors | None:
        """The factors of what is filtered by hypothesis i, read back from the ports."""
        if not self.order:
            return None
        n = self.plant.ne
        sizes = [len(triangle(n + r)) for r in self.random]
        at, order = sum(sizes[:i]), (*self.order, *range(n, n + self.random[i]))
        packed = self.symbols["mode_filtered_factors"][at : at + sizes[i]]
        return Factors.of(packed, order, self.plant.scalar)

    def actuation(self, i: int) -> Actuation:
        """Inputs under hypothesis i."""
        rates = [ca.SX(rate) for rate in self.spec.filter.options.hypotheses[i]]
        return intermittent(self.faults, rates, self.symbols["u"], self.plant)

    def filtered(self, i: int) -> Posterior:
        """The filtered estimate of hypothesis i, read back from the ports."""
        states, packed = (self.symbols[f"mode_filtered_{of}"] for of in ("state", "covariance"))
        state, covariance = split_estimates(states, packed, self.plant.nx)[i]
        if not (r := self.random[i]):
            return Posterior(state, covariance)
        begin, n = sum(self.random[:i]), self.plant.ne
        sizes = [s * (s + 1) // 2 for s in self.random]
        at = sum(sizes[:i])
        cross = self.symbols["mode_deviation_cross"][begin * n : (begin + r) * n]
        return Posterior(
            state=state,
            covariance=covariance,
            deviation=self.symbols["mode_deviation"][begin : begin + r],
            deviation_covariance=self.symbols["mode_deviation_covariance"][at : at + sizes[i]],
            cross_covariance=from_rows(cross, r),
        )


def _random_rates(rates: tuple[float, ...]) -> list[float]:
    """Success rates of the components whose outcome is uncertain."""
    return [rate for rate in rates if rate * (1.0 - rate) > 0.0]


def multiple_model_bank(spec: Spec) -> Recursion:
    """Build the bank: N corrections, one reweighing, the combination, N predictions."""
    faults, plant, options = spec.faults.actuator, plant_of(spec), spec.filter.options
    if faults is None:
        raise InternalError("mme without actuator faults")
    sensed = plant.D.nnz() > 0
    random = tuple(len(_random_rates(rates)) if sensed else 0 for rates in options.hypotheses)
    form = update_form(
        spec, plant, augmented=any(random), factored=has_factors(plant), many=len(random)
    )
    ports, start = _ports(spec, random), None
    order: tuple[int, ...] = ()
    if form == "ud":
        ports, order = (*mode_factor_ports(plant.ne, random), *ports), order_of((plant,))
    symbols = symbols_of(spec, plant, ports)
    if order:
        names = ("mode_factors", *(() if any(random) else ("mode_filtered_factors",)))
        start = started(spec, symbols, dict.fromkeys(names, len(random)), order)
    fits = faults.dependence != "independent" or plant.nu <= LARGEST_MIXTURE
    bank = Bank(
        spec=spec,
        plant=plant,
        faults=faults,
        symbols=symbols,
        random=random,
        form=form,
        order=order,
        mixture=any(random) and fits and options.likelihood == "mixture",
    )
    return Recursion(
        spec=spec,
        source="Strandt, Schneider & Yaz, eqs. (4), (9)-(18)",
        ports=ports,
        start=start,
        update=_update(bank),
        predict=_predict(bank),
        form=bank.form,
        factor_order=order,
        beside=(
            {"mode_filtered_covariance": ("mode_deviation_cross", random)} if any(random) else {}
        ),
        repeats=None if any(random) else correlated_rows((plant.R,)),
        notes=(
            f"likelihood: {'mixture' if bank.mixture else 'Gaussian'}",
            f"weight floor: {options.weight_floor:g}",
            *factors_note(order, spec),
        ),
    )


def _ports(spec: Spec, random: tuple[int, ...]) -> tuple[Port, ...]:
    """Ports of the hypotheses; what each makes of gamma[k] stands one after the other."""
    n, ne, options = spec.model.nx, spec.model.ne, spec.filter.options
    count, rates = len(options.hypotheses), len(options.hypotheses[0])
    paper = "(18) as printed: predictions for k with weights given y[0..k]"
    rate = (rates,) if rates > 1 else ()
    held = "probability of each hypothesis given y[0..k]"
    logarithms = log_prior(options.prior, spec.code.scalar)
    means = "x(k+1|k) under each hypothesis", "x(k|k) under each hypothesis"
    ports = (
        *state_ports(spec),
        *innovation_ports(spec),
        carried("mode_probability", (count,), held, start=options.prior),
        shown("success_rate_estimate", rate, "mean success rate given y[0..k]"),
        shown("paper_state", (n,), paper, unit="x"),
        *_weight_ports(logarithms, floored=options.weight_floor > 0.0 and not any(random)),
        *mode_estimate_ports(spec, count, means),
    )
    about = "of gamma[k] minus its mean under each hypothesis, given y[0..k]"
    packed, r = sum(s * (s + 1) // 2 for s in random), sum(random)
    deviations = (
        carried("mode_deviation", (r,), f"mean {about}"),
        carried("mode_deviation_covariance", (packed,), f"covariance {about}"),
        carried("mode_deviation_cross", (r * ne,), f"covariance {about}, with the state"),
    )
    return (*ports, *deviations) if r else ports


def _weight_ports(start: tuple[float, ...], *, floored: bool) -> tuple[Port, ...]:
    """Logarithms of the weights; what a second update goes on from has no floor yet."""
    weight, shape = "logarithm of mode_probability", (len(start),)
    if not floored:
        return (carried("log_weight", shape, weight, start=start),)
    return (
        carried("log_weight", shape, weight, start=start, corrected="log_weight_unfloored"),
        carried("log_weight_unfloored", shape, f"{weight} before the floor", start=start),
    )


def _held(builder: PhaseBuilder, symbols: dict[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Probabilities before this sample and their logarithms: copies, as the ports change."""
    with builder.titled("probabilities before this sample"):
        return (
            builder.define("held_probability", symbols["mode_probability"]),
            builder.define("held_logarithm", symbols["log_weight"]),
        )


def _update(bank: Bank) -> Phase:
    builder, symbols, spec = PhaseBuilder(bank.symbols), bank.symbols, bank.spec
    y, held = symbols["y"], _held(builder, symbols)
    priors = [bank.prior(i) for i in range(len(bank.random))]
    for _, covariance in priors:
        demand_positive(builder, covariance)
    bank = replace(bank, plant=bound(builder, bank.plant, "CDRd"))
    each = [_corrected(builder, bank, i, prior) for i, prior in enumerate(priors)]
    plants, found, posteriors = zip(*each, strict=True)
    with builder.titled("weights of the hypotheses"):
        logs = [
            _log_likelihood(builder, replace(bank, plant=plants[i]), i, priors[i], each)
            for i, each in enumerate(found)
        ]
        weights = reweigh(builder, held, logs, spec.filter.options.weight_floor, spec.code.scalar)
    with builder.titled("combination"):
        predicted = [
            builder.define(f"predicted_y_h{i}", expected(plants[i], mean, bank.actuation(i).mean))
            for i, (mean, _) in enumerate(priors)
        ]
        angles = bank.plant.wraps, y
        results = combined_innovation(
            builder, held[0], predicted, found, angles, scalar=bank.spec.code.scalar
        )
        w, parts = weights.probability, [(each.state, each.covariance) for each in posteriors]
        state, covariance = _merged(builder, bank, w, parts, "merged")
        before = split_estimates(symbols["mode_state"], symbols["mode_covariance"], bank.plant.nx)
        rates = [ca.SX(list(rates)) for rates in spec.filter.options.hypotheses]
        results |= {
            "filtered_state": state,
            "filtered_covariance": covariance,
            "paper_state": _merged(builder, bank, w, before, "paper")[0],
            "success_rate_estimate": weighted_sum(w, rates),
            "mode_filtered_state": ca.vertcat(*(mean for mean, _ in parts)),
            "mode_filtered_covariance": ca.vertcat(*(packed for _, packed in parts)),
            "mode_deviation": ca.vertcat(*(p.deviation for p in posteriors)),
            "mode_deviation_covariance": ca.vertcat(*(p.deviation_covariance for p in posteriors)),
            "mode_deviation_cross": ca.vertcat(*(by_rows(p.cross_covariance) for p in posteriors)),
            **weights.ports(),
        }
        if bank.order:
            results["mode_filtered_factors"] = packed_factors(p.factors for p in posteriors)
        if "log_weight_unfloored" in symbols:
            results["log_weight_unfloored"] = weights.unfloored
        builder.assign({name: value for name, value in results.items() if value.numel()})
    return builder.phase()


def _corrected(
    builder: PhaseBuilder, bank: Bank, i: int, prior: Prior
) -> tuple[Plant, Conditioned, Posterior]:
    """What hypothesis i makes of y[k], and the plant where it is."""
    inputs, tag = bank.actuation(i), f"_h{i}"
    with builder.titled(f"hypothesis {i}"):
        (plant,) = seen_from(builder, [bank.plant], [prior[0]], inputs.mean, tag)
        y = bank.symbols["y"]
        found, posterior = correct(builder, plant, inputs, prior, y=y, form=bank.form, tag=tag)
    demand_finite(builder, posterior.state)
    return plant, found, posterior


def _log_likelihood(
    builder: PhaseBuilder, bank: Bank, i: int, prior: Prior, found: Conditioned
) -> ca.SX:
    """Gaussian (15), or the mixture over gamma[k]: sum_g P(g) N(y; C x + D g u, S0)."""
    if not bank.mixture or not bank.random[i]:
        return builder.define(f"log_likelihood_h{i}", found.log_likelihood)
    plant, through = bank.plant, bank.plant.D @ bank.actuation(i).through
    rates = _random_rates(bank.spec.filter.options.hypotheses[i])
    healthless = found.innovation + through @ ca.SX(rates)
    held = prior[1]
    if isinstance(held, Factors):
        S = held.seen(plant.C) + pack(plant.R)
    else:
        S = congruence(plant.C, unpack(held, plant.ne)) + pack(plant.R)
    S = builder.define(f"share_variance_h{i}", S)
    whitened = whiten(builder, S, ca.horzcat(healthless, through), f"_h{i}")
    terms = [
        builder.define(
            f"log_pattern_h{i}_{at}",
            log_chance - 0.5 * whitened.quadratic(ca.SX([1.0, *(-float(w) for w in works)])),
        )
        for at, (works, log_chance) in enumerate(patterns(rates))
    ]
    return builder.define(
        f"log_likelihood_h{i}", log_sum_exp(terms) - 0.5 * whitened.log_determinant
    )


def _merged(
    builder: PhaseBuilder, bank: Bank, weights: ca.SX, parts: Sequence[Gaussian], name: str
) -> Gaussian:
    """The one estimate of all hypotheses."""
    chart = Chart(builder, bank.plant, name, parts[0][0])
    return mixture(chart, weights, parts, named=name == "combined")


def _predict(bank: Bank) -> Phase:
    builder = PhaseBuilder(bank.symbols)
    plant = bound(builder, bank.plant, "ABQc")
    moved, factors = [], []
    for i in range(len(bank.random)):
        inputs, filtered, held = bank.actuation(i), bank.filtered(i), bank.held(i)
        (own,) = moved_from(builder, [plant], [filtered.state], inputs.mean, f"_h{i}")
        if held is None:
            moved.append(propagate(builder, own, inputs, filtered, f"_h{i}")[:2])
            continue
        state, held, _ = propagate_factors(own, inputs, filtered, held)
        with builder.titled(f"hypothesis {i}: factors of the next covariance"):
            factors.append(held.named(builder, f"next_factors_h{i}"))
        moved.append((state, factors[-1].covariance()))
    with builder.titled("prediction of every hypothesis"):
        states = builder.define("moved_state", ca.vertcat(*(state for state, _ in moved)))
        covariances = builder.define("moved_covariance", ca.vertcat(*(P for _, P in moved)))
    parts = split_estimates(states, covariances, plant.nx)
    w = bank.symbols["mode_probability"]
    with builder.titled("combined prediction"):
        state, covariance = _merged(builder, bank, w, parts, "combined")
        builder.assign(
            ({"mode_factors": packed_factors(factors)} if factors else {})
            | {
                "mode_state": states,
                "mode_covariance": covariances,
                "predicted_state": state,
                "predicted_covariance": covariance,
            },
            [finite(*each) for each in ((state, covariance), *parts)],
        )
    return builder.phase()
