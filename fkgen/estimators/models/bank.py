"""Multiple model estimation of an unknown fault rate: a bank of modified Kalman filters.

Strandt, Schneider & Yaz, sec. 3. One hypothesis per success rate; weights by Bayes' rule (14)-(16)
with the mixture likelihood (exact in gamma[k]) or the paper's Gaussian (15). Estimates are combined
coherently: x(k|k) and x(k+1|k) with weights given y[0..k]; ``paper_state`` is (18) as printed.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.actuation import Actuation, intermittent
from fkgen.estimators.gaussian.conditioning import Conditioned
from fkgen.estimators.gaussian.elimination import whiten
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    correct,
    demand_finite,
    demand_positive,
    finite,
    propagate,
    senses_actuation,
    update_form,
)
from fkgen.estimators.gaussian.sequential import Form
from fkgen.estimators.lmmse.kalman import by_rows, from_rows
from fkgen.estimators.models.merge import combined_innovation
from fkgen.estimators.models.weights import Weights, log_prior, log_sum_exp, patterns, reweigh
from fkgen.faults import ActuatorFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import congruence, pack, split_packed, spread, unpack, weighted_sum
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import (
    carried,
    estimate_ports,
    innovation_ports,
    prior_of,
    shown,
    start_of,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: With more independent inputs than this the mixture has too many terms; the Gaussian is used
#: instead.
LARGEST_MIXTURE = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Bank:
    """The hypotheses side by side: sizes, slices of the stacked ports, symbols."""

    spec: Spec
    plant: Plant
    faults: ActuatorFaults
    ports: tuple[Port, ...]
    symbols: dict[str, ca.SX]
    random: tuple[int, ...]
    form: Form
    mixture: bool

    @classmethod
    def of(cls, spec: Spec) -> Bank:
        """Lay out the hypotheses of a spec."""
        faults = spec.faults.actuator
        if faults is None:
            raise InternalError("mme without actuator faults")
        plant = plant_of(spec)
        u = ca.SX.sym("u", plant.nu)
        actuations = [
            _actuation(faults, rates, u, plant) for rates in spec.filter.options.hypotheses
        ]
        sensed = [a.size if senses_actuation(plant, a) else 0 for a in actuations]
        ports = _ports(spec, sensed)
        independent = faults.dependence == "independent" and plant.nu > 1
        fits = not independent or plant.nu <= LARGEST_MIXTURE
        return cls(
            spec=spec,
            plant=plant,
            faults=faults,
            ports=ports,
            symbols=symbols_of(spec, plant, ports),
            random=tuple(sensed),
            form=update_form(spec, plant, augmented=any(sensed)),
            mixture=any(sensed) and fits and spec.filter.options.likelihood == "mixture",
        )

    @property
    def size(self) -> int:
        """Number N of hypotheses."""
        return len(self.spec.filter.options.hypotheses)

    def part(self, port: str, i: int) -> ca.SX:
        """Share of hypothesis i in a port that stacks equal shares."""
        symbol = self.symbols[port]
        width = symbol.numel() // self.size
        return symbol[i * width : (i + 1) * width]

    def actuation(self, i: int) -> Actuation:
        """Inputs under hypothesis i."""
        rates = self.spec.filter.options.hypotheses[i]
        return _actuation(self.faults, rates, self.symbols["u"], self.plant)

    def deviation(self, i: int) -> Posterior:
        """The filtered estimate of hypothesis i, read back from the ports."""
        n, r = self.plant.nx, self.random[i]
        none = ca.SX(0, 1)
        begin = sum(self.random[:i])
        packed = [s * (s + 1) // 2 for s in self.random]
        covariance = slice(sum(packed[:i]), sum(packed[: i + 1]))
        cross = slice(begin * n, (begin + r) * n)
        return Posterior(
            state=self.part("mode_filtered_state", i),
            covariance=self.part("mode_filtered_covariance", i),
            deviation=self.symbols["mode_deviation"][begin : begin + r] if r else none,
            deviation_covariance=self.symbols["mode_deviation_covariance"][covariance]
            if r
            else none,
            cross_covariance=from_rows(self.symbols["mode_deviation_cross"][cross], r)
            if r
            else none,
        )


def _actuation(
    faults: ActuatorFaults, rates: tuple[float, ...], u: ca.SX, plant: Plant
) -> Actuation:
    return intermittent(faults, [ca.SX(rate) for rate in rates], u, plant)


def _ports(spec: Spec, random: list[int]) -> tuple[Port, ...]:
    n, count = spec.model.nx, len(spec.filter.options.hypotheses)
    rates = len(spec.filter.options.hypotheses[0])
    paper = "(18) as printed: predictions for k with weights given y[0..k]"
    rate = (rates,) if rates > 1 else ()
    ports = [
        *state_ports(spec),
        *innovation_ports(spec),
        carried("mode_probability", (count,), "probability of each hypothesis given y[0..k]"),
        shown("success_rate_estimate", rate, "mean success rate given y[0..k]"),
        shown("paper_state", (n,), paper, unit="x"),
        carried("log_weight", (count,), "logarithm of mode_probability"),
    ]
    for name, when in (("mode_", "x(k+1|k)"), ("mode_filtered_", "x(k|k)")):
        meanings = f"{when} under each hypothesis", "its error covariance"
        ports += estimate_ports(name, (count, n), meanings)
    return (*ports, *(_deviation_ports(n, random) if any(random) else ()))


def _deviation_ports(n: int, random: list[int]) -> tuple[Port, ...]:
    """What each hypothesis makes of gamma[k], one after the other: sizes differ between them."""
    about = "of gamma[k] minus its mean under each hypothesis, given y[0..k]"
    packed = sum(r * (r + 1) // 2 for r in random)
    return (
        carried("mode_deviation", (sum(random),), f"mean {about}"),
        carried("mode_deviation_covariance", (packed,), f"covariance {about}"),
        carried("mode_deviation_cross", (sum(random) * n,), f"covariance {about}, with the state"),
    )


def multiple_model_bank(spec: Spec) -> Recursion:
    """Build the bank: N corrections, one reweighing, the combination, N predictions."""
    bank = Bank.of(spec)
    count = len(spec.filter.options.hypotheses)
    x0, packed = prior_of(spec)
    initial = start_of(spec)
    initial |= {"mode_state": x0 * count, "mode_filtered_state": x0 * count}
    initial |= {"mode_covariance": packed * count, "mode_filtered_covariance": packed * count}
    initial["mode_probability"] = spec.filter.options.prior
    initial["log_weight"] = log_prior(spec.filter.options.prior, spec.code.scalar)
    return Recursion(
        spec=spec,
        source="Strandt, Schneider & Yaz, eqs. (4), (9)-(18)",
        ports=bank.ports,
        initial=initial,
        update=_update(bank),
        predict=_predict(bank),
        form=bank.form,
        notes=(
            f"likelihood: {'mixture' if bank.mixture else 'Gaussian'}",
            f"weight floor: {spec.filter.options.weight_floor:g}",
        ),
    )


def _update(bank: Bank) -> Phase:
    script, spec, n = Script(bank.symbols), bank.spec, bank.plant.nx
    for i in range(bank.size):
        demand_positive(script, bank.part("mode_covariance", i), n)
    plant = bound(script, bank.plant, "CDR")
    found: list[Conditioned] = []
    posteriors: list[Posterior] = []
    for i in range(bank.size):
        with script.titled(f"hypothesis {i}"):
            conditioned, posterior = correct(
                script,
                plant,
                bank.actuation(i),
                (bank.part("mode_state", i), bank.part("mode_covariance", i)),
                y=bank.symbols["y"],
                scalar=spec.code.scalar,
                form=bank.form,
                tag=f"_h{i}",
            )
        demand_finite(script, posterior.state)
        found.append(conditioned)
        posteriors.append(posterior)
    with script.titled("weights of the hypotheses"):
        logs = [_log_likelihood(script, bank, plant, i, found[i]) for i in range(bank.size)]
        held = (bank.symbols["mode_probability"], bank.symbols["log_weight"])
        weights = reweigh(script, held, logs, spec.filter.options.weight_floor, spec.code.scalar)
    with script.titled("combination"):
        predicted = [
            script.let(
                f"predicted_y_h{i}",
                plant.C @ bank.part("mode_state", i) + plant.D @ bank.actuation(i).mean,
            )
            for i in range(bank.size)
        ]
        results = combined_innovation(script, bank.symbols["mode_probability"], predicted, found)
        results |= _combined_state(bank, posteriors, weights)
        results |= {
            "mode_probability": weights.probability,
            "log_weight": weights.logarithm,
            "log_likelihood": weights.log_likelihood,
        }
        script.put(results)
    return script.phase()


def _log_likelihood(script: Script, bank: Bank, plant: Plant, i: int, found: Conditioned) -> ca.SX:
    """Gaussian (15), or the mixture over gamma[k]: sum_g P(g) N(y; C x + D g u, S0)."""
    if not bank.mixture or not bank.random[i]:
        return script.let(f"log_likelihood_h{i}", found.log_likelihood)
    actuation = bank.actuation(i)
    through = plant.D @ actuation.through
    rates = _random_rates(bank, i)
    healthless = found.innovation + through @ ca.SX(rates)
    S = congruence(plant.C, unpack(bank.part("mode_covariance", i), plant.nx)) + pack(plant.R)
    S = script.let(f"share_variance_h{i}", S)
    whitened = whiten(script, S, ca.horzcat(healthless, through), f"_h{i}")
    terms = [
        script.let(
            f"log_pattern_h{i}_{at}",
            log_chance - 0.5 * whitened.quadratic(ca.SX([1.0, *(-float(w) for w in works)])),
        )
        for at, (works, log_chance) in enumerate(patterns(rates))
    ]
    return script.let(f"log_likelihood_h{i}", log_sum_exp(terms) - 0.5 * whitened.log_determinant)


def _random_rates(bank: Bank, i: int) -> list[float]:
    """Success rates of the components whose outcome is uncertain under hypothesis i."""
    return [rate for rate in bank.spec.filter.options.hypotheses[i] if rate * (1.0 - rate) > 0.0]


def _combined_state(bank: Bank, posteriors: list[Posterior], weights: Weights) -> dict[str, ca.SX]:
    """Coherent filter, (18) as printed, and the estimate of the success rate."""
    w = weights.probability
    states = [posterior.state for posterior in posteriors]
    covariances = [posterior.covariance for posterior in posteriors]
    state = weighted_sum(w, states)
    rates = [ca.SX(list(rates)) for rates in bank.spec.filter.options.hypotheses]
    result = {
        "filtered_state": state,
        "filtered_covariance": weighted_sum(w, covariances) + spread(w, states, state),
        "paper_state": weighted_sum(w, [bank.part("mode_state", i) for i in range(bank.size)]),
        "success_rate_estimate": weighted_sum(w, rates),
        "mode_filtered_state": ca.vertcat(*states),
        "mode_filtered_covariance": ca.vertcat(*covariances),
        "mode_deviation": ca.vertcat(*(p.deviation for p in posteriors)),
        "mode_deviation_covariance": ca.vertcat(*(p.deviation_covariance for p in posteriors)),
        "mode_deviation_cross": ca.vertcat(*(by_rows(p.cross_covariance) for p in posteriors)),
    }
    return {name: value for name, value in result.items() if value.numel()}


def _predict(bank: Bank) -> Phase:
    script = Script(bank.symbols)
    plant = bound(script, bank.plant, "ABQ")
    moved = [propagate(plant, bank.actuation(i), bank.deviation(i)) for i in range(bank.size)]
    with script.titled("prediction of every hypothesis"):
        states = script.let("moved_state", ca.vertcat(*(state for state, _, _ in moved)))
        covariances = script.let("moved_covariance", ca.vertcat(*(P for _, P, _ in moved)))
    each = list(ca.vertsplit(states, plant.nx))
    packed = split_packed(covariances, plant.nx)
    w = bank.symbols["mode_probability"]
    with script.titled("combined prediction"):
        state = script.let("combined_state", weighted_sum(w, each))
        covariance = weighted_sum(w, packed) + spread(w, each, state)
        script.put(
            {
                "mode_state": states,
                "mode_covariance": covariances,
                "predicted_state": state,
                "predicted_covariance": covariance,
            },
            [finite(*of) for of in ((state, covariance), *zip(each, packed, strict=True))],
        )
    return script.phase()
