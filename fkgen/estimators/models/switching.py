"""Filters over modes that follow a Markov chain: what they share.

Under each mode the correction is that of a Kalman filter; its density weighs the mode by Bayes'
rule, eq. (8) of Sigalov & Oshman. What is kept of the corrections is in ``one_step.py`` and
``interacting.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.estimate import (
    bound_all,
    correct,
    demand_positive,
    expected,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, Prior
from fkgen.estimators.gaussian.ud import (
    Factors,
    begun,
    merged,
    order_of,
)
from fkgen.estimators.models.merge import (
    Chart,
    Gaussian,
    combined_innovation,
    mixture,
)
from fkgen.estimators.models.modes import Modes, of_states
from fkgen.estimators.models.start import first_law
from fkgen.estimators.models.weights import (
    log_prior,
    log_sum_exp,
    logarithm_of,
    prior_of_sample,
    reweigh,
)
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.lifting.linearise import seen_from
from fkgen.symbolic.linalg import (
    column,
    split_estimates,
    weighted_sum,
)
from fkgen.symbolic.plant import Plant, mode_plants
from fkgen.symbolic.ports import (
    innovation_ports,
    prior_symbols,
    state_ports,
    symbols_of,
    twins,
)
from fkgen.symbolic.recursion import Phase, Recursion

_EVIDENCE = "log density of the rows of {k} in each mode, where every sample has its own law"

#: From probabilities and corrections of the modes to the ports that keep an estimate.
Combination = Callable[[PhaseBuilder, ca.SX, list[Conditioned]], dict[str, ca.SX]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Switching:
    """What a switching filter is built from, with the correction under one mode."""

    spec: Spec
    plants: tuple[Plant, ...]
    modes: Modes
    ports: tuple[Port, ...]
    symbols: dict[str, ca.SX]
    form: Form
    order: tuple[int, ...]  # of rows of factors, if there are any
    merges_errors: bool = False  # Corrections stay errors about one prediction

    @classmethod
    def of(
        cls,
        spec: Spec,
        own: tuple[Port, ...],
        factors: tuple[Port, ...],
        *,
        merges_errors: bool = False,
    ) -> Switching:
        """Lay out the ports of a filter: ``own``, and ``factors`` of covariances if it has them."""
        plants = mode_plants(spec, spec.faults.chain(spec.model).modes)
        many = max(port.size for port in factors) // len(triangle(plants[0].ne))
        factored = not plants[0].attitudes
        form = update_form(spec, plants[0], augmented=False, factored=factored, many=many)
        own += factors if form == "ud" else ()
        modes = Modes.of(spec, plants)
        law, shape = modes.initial, (len(modes.initial),)
        probability = "probability of each mode at {k} given y[0..k]"
        logarithm = "logarithm of {of}mode_probability"
        ports = (
            *state_ports(spec),
            *innovation_ports(spec),
            *twins("mode_probability", shape, probability, start=law),
            *twins("log_weight", shape, logarithm, start=log_prior(law, spec.code.scalar)),
            *(twins("mode_evidence", shape, _EVIDENCE) if modes.chain.independent else ()),
            *own,
        )
        return cls(
            spec=spec,
            plants=plants,
            modes=modes,
            ports=ports,
            symbols=symbols_of(spec, plants[0], ports),
            form=form,
            order=order_of(plants) if form == "ud" else (),
            merges_errors=merges_errors and bool(plants[0].attitudes),
        )

    def start(self) -> Phase | None:
        """The law of the mode at sample 0 where it depends on parameters, and what each mode has.

        Under a mode 0, known, is in place of the states that it does not have.
        """
        chain, scalar, faults = self.modes.chain, self.spec.code.scalar, self.spec.faults.jump
        given, values = prior_symbols(self.spec.model), dict[str, ca.SX]()
        builder = PhaseBuilder({**self.symbols, **given})
        if faults is not None and faults.unequal:
            priors = [of_states((given["x"], given["P"]), mode.kept) for mode in faults.modes]
            states, covariances = (ca.vertcat(*each) for each in zip(*priors, strict=True))
            values |= {"mode_state": states, "mode_covariance": covariances}
        for port in self.ports if self.order else ():
            if port.name.endswith("factors"):
                own = [None] * (port.size // given["P"].numel())
                modes = faults.modes if faults is not None and len(own) > 1 else None
                kept = own if modes is None else [mode.kept for mode in modes]
                how = self.order, scalar
                each = {rows: begun(builder, given["P"], how, rows) for rows in dict.fromkeys(kept)}
                values[port.name] = ca.vertcat(*(each[rows] for rows in kept))
        if chain.first is not None:
            law = first_law(builder, self.spec, chain, self.plants[0].parameters)
            logs = column([logarithm_of(each, scalar) for each in ca.vertsplit(law)])
            of = {"mode_probability": law, "log_weight": logs}
            values |= of | {f"predicted_{name}": value for name, value in of.items()}
        if not values:
            return None
        builder.assign(values)
        return builder.phase()

    def recursion(
        self,
        source: str,
        phases: tuple[Phase, Phase],
        *notes: str,
        repeats: tuple[tuple[int, ...], ...] | None = None,
    ) -> Recursion:
        """The recursion of these two phases."""
        return Recursion(
            spec=self.spec,
            source=source,
            ports=self.ports,
            start=self.start(),
            update=phases[0],
            predict=phases[1],
            form=self.form,
            factor_order=self.order,
            notes=notes,
            repeats=repeats,
        )

    def bound(self, builder: PhaseBuilder, letters: str) -> Modes:
        """The modes for one phase: computed entries of these matrices are named."""
        return Modes.of(self.spec, bound_all(builder, self.plants, letters))

    def factors(self, name: str) -> list[Factors]:
        """The factors that a port holds."""
        count = len(triangle(self.spec.model.ne))
        each = ca.vertsplit(self.symbols[name], count)
        return [Factors.of(packed, self.order, self.spec.code.scalar) for packed in each]

    def filtered(self) -> list[Gaussian]:
        """What imm keeps of every mode after y[k]."""
        states, packed = (self.symbols[f"mode_filtered_{of}"] for of in ("state", "covariance"))
        return split_estimates(states, packed, self.spec.model.nx)

    def update(self, priors: Sequence[Prior], combined: Combination) -> Phase:
        """A correction of its prior under each mode, then Bayes' rule (8)."""
        builder, symbols = PhaseBuilder(self.symbols), self.symbols
        for covariance in {id(each): each for _, each in priors}.values():
            demand_positive(builder, covariance)
        modes = self.seen_from(builder, self.bound(builder, "CDRd"), priors)
        each = [self.corrected(builder, modes, j, prior) for j, prior in enumerate(priors)]
        with builder.titled("probabilities of the modes"):
            held, logs = self.held(builder, modes), [one.log_likelihood for one in each]
            weights = reweigh(builder, held, logs, 0.0, self.spec.code.scalar)
        with builder.titled("innovation of the mixture"):
            predicted = []
            for j, (prior, variants) in enumerate(zip(priors, modes.variants, strict=True)):
                y = expected(variants[0].plant, prior[0], symbols["u"])
                predicted.append(builder.define(f"predicted_y_m{j}", y))
            angles = self.plants[0].wraps, symbols["y"]
            results = combined_innovation(
                builder, held[0], predicted, each, angles, scalar=self.spec.code.scalar
            )
        with builder.titled("combination"):
            if modes.chain.independent:
                said = symbols["predicted_mode_evidence"] + column(logs)
                results["mode_evidence"] = said
            builder.assign(results | weights.ports() | combined(builder, weights.probability, each))
        return builder.phase()

    def seen_from(self, builder: PhaseBuilder, modes: Modes, priors: Sequence[Prior]) -> Modes:
        """The modes, with functions h linearised where each mode is."""
        flat = [
            (variant.plant, prior[0])
            for variants, prior in zip(modes.variants, priors, strict=True)
            for variant in variants
        ]
        plants, states = zip(*flat, strict=True)
        ready = iter(seen_from(builder, plants, states, self.symbols["u"]))
        variants = tuple(
            tuple(replace(variant, plant=next(ready)) for variant in mode)
            for mode in modes.variants
        )
        return replace(modes, variants=variants)

    def held(self, builder: PhaseBuilder, modes: Modes) -> tuple[ca.SX, ca.SX]:
        """Probability and logarithm of the modes before y[k]; a sample may have its own law."""
        symbols = self.symbols
        if modes.chain.independent:
            (law,) = modes.varying(builder)
            said = symbols["predicted_mode_evidence"]
            return prior_of_sample(builder, law, said, self.spec.code.scalar)
        return symbols["predicted_mode_probability"], symbols["predicted_log_weight"]

    def anew(self) -> dict[str, ca.SX]:
        """What a prediction forgets."""
        if not self.modes.chain.independent:
            return {}
        return {"predicted_mode_evidence": ca.SX.zeros(len(self.modes.initial))}

    def corrected(
        self, builder: PhaseBuilder, modes: Modes, mode: int, prior: Prior
    ) -> Conditioned:
        """What a mode makes of y[k]: the mixture of its variants."""
        variants, u, y = modes.variants[mode], self.symbols["u"], self.symbols["y"]
        each = []
        for at, variant in enumerate(variants):
            tag = f"_m{mode}_{at}" if at else f"_m{mode}"
            with builder.titled(f"mode {mode}: {variant.title}"):
                found, _ = correct(
                    builder,
                    variant.plant,
                    certain(u),
                    prior,
                    y=y,
                    form=self.form,
                    tag=tag,
                    as_errors=self.merges_errors,
                )
                density = builder.define(f"log_density{tag}", found.log_likelihood)
            each.append(replace(found, log_likelihood=density))
        if len(each) == 1:
            return each[0]
        joint = [
            one.log_likelihood + math.log(variant.share)
            for one, variant in zip(each, variants, strict=True)
        ]
        total = builder.define(f"log_mixture_m{mode}", log_sum_exp(joint))
        shares = ca.SX([variant.share for variant in variants])
        S = weighted_sum(shares, [one.innovation_covariance for one in each])
        whole = replace(each[0], log_likelihood=total, innovation_covariance=S)
        if not modes.entangled:
            return whole
        weights = builder.define(f"variant_weight_m{mode}", ca.exp(ca.vertcat(*joint) - total))
        parts = [(one.mean, one.covariance) for one in each]
        if self.order:
            state, held = self.merged(builder, ca.vertsplit(weights), each, f"_m{mode}")
            return replace(whole, mean=state, covariance=held.covariance(), factors=held)
        chart = Chart(builder, self.plants[0], "merged", each[0].mean)
        state, covariance = mixture(chart, weights, parts, f"_m{mode}", lasting=True)
        covariance = builder.define(f"merged_covariance_m{mode}", covariance)
        return replace(whole, mean=state, covariance=covariance)

    def merged(
        self,
        builder: PhaseBuilder,
        weights: Sequence[ca.SX],
        each: Sequence[Conditioned],
        tag: str = "",
        *,
        spread: bool = True,
    ) -> tuple[ca.SX, Factors]:
        """Corrections as one estimate, its covariance in factors."""
        parts = [(one.mean, one.factors) for one in each if one.factors is not None]
        chart = Chart(builder, self.plants[0], "merged", parts[0][0])
        flat = chart.inward([(mean, ca.SX()) for mean, _ in parts])
        own = [(mean, held) for (mean, _), (_, held) in zip(flat, parts, strict=True)]
        mean, wide = merged(weights, own, spread=spread)
        state, _ = chart.outward((mean, ca.SX()), tag)
        return state, wide.narrow().named(builder, f"merged_factors{tag}")
