"""The update that one_step and imm share: a correction per mode, then Bayes' rule, eq. (8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import casadi as ca

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.conditioning import Conditioned
from fkgen.estimators.gaussian.estimate import bound_all, correct, update_form
from fkgen.estimators.gaussian.sequential import Form
from fkgen.estimators.models.merge import combined_innovation
from fkgen.estimators.models.modes import Modes, Variant, modes_of, plants_of
from fkgen.estimators.models.weights import Weights, log_prior, log_sum_exp, reweigh
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Port
from fkgen.symbolic.linalg import spread, weighted_sum
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import carried, innovation_ports, start_of, state_ports, symbols_of


@dataclass(frozen=True, slots=True)
class ModeUpdate:
    """What one mode makes of y[k]: its estimate (mean, packed covariance) and likelihood."""

    state: ca.SX
    covariance: ca.SX
    log_likelihood: ca.SX
    found: Conditioned
    predicted: ca.SX


@dataclass(frozen=True, slots=True, kw_only=True)
class Switching:
    """What a switching filter is built from, with the correction under one mode."""

    spec: Spec
    plants: tuple[Plant, ...]
    modes: Modes
    ports: tuple[Port, ...]
    symbols: dict[str, ca.SX]
    form: Form

    @classmethod
    def of(cls, spec: Spec, own: tuple[Port, ...]) -> Switching:
        """Lay out the ports of a filter; ``own`` are those of its family."""
        plants = plants_of(spec)
        modes = modes_of(spec, plants)
        ports = (*state_ports(spec), *innovation_ports(spec), *mode_ports(modes.size), *own)
        return cls(
            spec=spec,
            plants=plants,
            modes=modes,
            ports=ports,
            symbols=symbols_of(spec, plants[0], ports),
            form=update_form(spec, plants[0], augmented=False),
        )

    def bound(self, script: Script, letters: str) -> Modes:
        """The modes for one phase: computed entries of these matrices are named."""
        return modes_of(self.spec, bound_all(script, self.plants, letters))

    def start(self) -> dict[str, tuple[float, ...]]:
        """Start values of the shared ports: (x0, P0) and the law of the mode before y[0]."""
        initial = self.modes.initial
        logarithm = log_prior(initial, self.spec.code.scalar)
        return {
            **start_of(self.spec),
            **{f"{of}mode_probability": initial for of in ("", "predicted_")},
            **{f"{of}log_weight": logarithm for of in ("", "predicted_")},
        }

    def weigh(self, script: Script, each: list[ModeUpdate]) -> tuple[Weights, dict[str, ca.SX]]:
        """Bayes' rule (8) for the modes, with the ports that it gives and those of y[k]."""
        held = (self.symbols["predicted_mode_probability"], self.symbols["predicted_log_weight"])
        with script.titled("probabilities of the modes"):
            logs = [one.log_likelihood for one in each]
            weights = reweigh(script, held, logs, 0.0, self.spec.code.scalar)
        with script.titled("innovation of the mixture"):
            predicted = [script.let(f"predicted_y_m{j}", m.predicted) for j, m in enumerate(each)]
            results = combined_innovation(script, held[0], predicted, [one.found for one in each])
        return weights, {
            **results,
            "mode_probability": weights.probability,
            "log_weight": weights.logarithm,
            "log_likelihood": weights.log_likelihood,
        }

    def variants(
        self,
        script: Script,
        mode: int,
        variants: tuple[Variant, ...],
        prior: tuple[ca.SX, ca.SX],
    ) -> list[ModeUpdate]:
        """The correction of ``prior`` under each variant of a mode."""
        result = []
        for at, variant in enumerate(variants):
            tag = f"_m{mode}_{at}" if at else f"_m{mode}"
            plant = variant.plant
            with script.titled(f"mode {mode}: {variant.title}"):
                found, posterior = correct(
                    script, plant, certain(self.symbols["u"]), prior,
                    y=self.symbols["y"], scalar=self.spec.code.scalar, form=self.form, tag=tag,
                )  # fmt: skip
                density = script.let(f"log_density{tag}", found.log_likelihood)
            predicted = plant.C @ prior[0] + plant.D @ self.symbols["u"]
            result.append(
                ModeUpdate(posterior.state, posterior.covariance, density, found, predicted)
            )
        return result

    def update(
        self, script: Script, modes: Modes, mode: int, prior: tuple[ca.SX, ca.SX]
    ) -> ModeUpdate:
        """The same for a mode as a whole."""
        variants = modes.variants[mode]
        each = self.variants(script, mode, variants, prior)
        first = each[0]
        if len(each) == 1:
            return first
        joint = [
            one.log_likelihood + math.log(variant.share)
            for one, variant in zip(each, variants, strict=True)
        ]
        total = script.let(f"log_mixture_m{mode}", log_sum_exp(joint))
        shares = ca.SX([variant.share for variant in variants])
        S = weighted_sum(shares, [one.found.innovation_covariance for one in each])
        whole = replace(
            first, log_likelihood=total, found=replace(first.found, innovation_covariance=S)
        )
        if not modes.entangled:
            return whole
        weights = script.let(f"variant_weight_m{mode}", ca.exp(ca.vertcat(*joint) - total))
        states = [one.state for one in each]
        state = script.let(f"merged_state_m{mode}", weighted_sum(weights, states))
        covariance = weighted_sum(weights, [one.covariance for one in each])
        covariance += spread(weights, states, state)
        covariance = script.let(f"merged_covariance_m{mode}", covariance)
        return replace(whole, state=state, covariance=covariance)


def mode_ports(count: int) -> tuple[Port, ...]:
    """Probabilities of the modes, posterior and predicted, with their logarithms."""
    meanings = {
        "mode_probability": "probability of each mode at k given y[0..k]",
        "predicted_mode_probability": "probability of each mode at k+1 given y[0..k]",
        "log_weight": "logarithm of mode_probability",
        "predicted_log_weight": "logarithm of predicted_mode_probability",
    }
    return tuple(carried(name, (count,), meaning) for name, meaning in meanings.items())
