"""Switching filters: modes of a sensor or of the plant that follow a Markov chain.

``one_step`` (GPB1; Sigalov & Oshman, sec. III) has one Gaussian before every sample; given the mode
its correction is that of a Kalman filter, and the corrections are weighted by Bayes' rule (8) and
reduced to one Gaussian again. How the covariance (7) is carried on is an option, because the
paper's equation holds without faults only.

``imm`` (Blom & Bar-Shalom 1988; sec. IV) has one estimate per mode; before each sample they are
mixed by what the chain says about the mode before, eqs. (17), (18). The mode of sample k drives the
step into x[k], and y[k].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import casadi as ca
import numpy as np

from fkgen.estimators.gaussian.actuation import certain
from fkgen.estimators.gaussian.decorrelation import correlated_rows
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    bound_all,
    correct,
    demand_finite,
    demand_positive,
    expected,
    finite,
    off_by,
    propagate,
    propagate_factors,
    update_form,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, Prior
from fkgen.estimators.gaussian.ud import (
    Factors,
    Wide,
    begun,
    factors_note,
    merged,
    order_of,
    packed_factors,
)
from fkgen.estimators.models.merge import (
    Chart,
    Gaussian,
    Mixer,
    combined_innovation,
    mixture,
    mixture_covariance,
    spread_weights,
)
from fkgen.estimators.models.start import first_law
from fkgen.estimators.models.weights import (
    Kernel,
    Prediction,
    advance,
    advance_varying,
    drawn_anew,
    log_prior,
    log_sum_exp,
    logarithm_of,
    prior_of_sample,
    reweigh,
)
from fkgen.faults.chain import ModeChain
from fkgen.problem import Spec
from fkgen.problem.probability import visited
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.domain import law_of
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.lifting.linearise import moved_from, seen_from
from fkgen.symbolic.linalg import (
    column,
    congruence,
    is_zero,
    pack,
    split_estimates,
    split_packed,
    unpack,
    weighted_sum,
)
from fkgen.symbolic.plant import Plant, mode_plants
from fkgen.symbolic.ports import (
    carried,
    factor_ports,
    innovation_ports,
    mode_estimate_ports,
    mode_factor_ports,
    prior_symbols,
    state_ports,
    symbols_of,
    twins,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: How many covariances of one_step run beside the estimate, as if no signal were ever lost.
RICCATIS = {"moment_matched": 0, "weighted": 0, "paper": 2, "paper_nominal": 1}

_EVIDENCE = "log density of the rows of {k} in each mode, where every sample has its own law"

#: Timing of the modes where they move the state.
JUMPING = "the mode of sample k drives the step from x(k-1) to x(k), with parameters k-1, and y(k)"

#: From probabilities and corrections of the modes to the ports that keep an estimate.
Combination = Callable[[PhaseBuilder, ca.SX, list[Conditioned]], dict[str, ca.SX]]


@dataclass(frozen=True, slots=True)
class Variant:
    """One condition of the plant within a mode: its share of the mode, and the plant in it."""

    title: str
    share: float
    plant: Plant


@dataclass(frozen=True, slots=True)
class Modes:
    """The modes of a switching filter.

    A mode has several variants where it lumps conditions together that only the density tells
    apart; they move alike. They are entangled where they lead to different estimates, because R
    correlates the rows that they differ in with others.
    """

    variants: tuple[tuple[Variant, ...], ...]
    kernel: Kernel
    initial: tuple[float, ...]  # at sample 0
    entangled: bool
    chain: ModeChain

    @classmethod
    def of(cls, spec: Spec, plants: Sequence[Plant]) -> Modes:
        """The modes that a spec states, made of the plants of its chain.

        Three modes for four conditions of a sensor: the mixture of both noises at gamma = 0.
        """
        chain, sensor = spec.faults.chain(spec.model), spec.faults.sensor
        count = len(chain.modes)
        lumps = sensor if sensor is not None and spec.filter.option("modes", 4) < count else None
        found = chain.lumped(tuple((i,) for i in range(count))) if lumps is None else lumps.lumped()
        variants = tuple(
            tuple(
                Variant(chain.modes[i].title, share, plants[i])
                for i, share in zip(group, shares, strict=True)
                if share > 0.0
            )
            for group, shares in zip(found.groups, found.shares, strict=True)
        )
        entangled = lumps is not None and lumps.entangles(spec.model.R)
        return cls(variants, found.transition, found.initial, entangled, chain)

    def varying(self, builder: PhaseBuilder) -> tuple[tuple[ca.SX, ...], ...]:
        """The kernel of a sample where it depends on parameters, named once."""
        if self.chain.law is None:
            return ()
        law = law_of(self.chain.law, self.variants[0][0].plant.parameters)
        named = builder.name_entries("kernel", law[:1, :] if self.chain.independent else law)
        return tuple(tuple(ca.horzsplit(row)) for row in ca.vertsplit(named))

    def advanced(
        self, builder: PhaseBuilder, now: tuple[ca.SX, ca.SX], scalar: str, *, mixing: bool
    ) -> Prediction:
        """The law of the next mode from ``now`` = (probability, logarithm)."""
        rows = self.varying(builder)
        if self.chain.independent:
            return drawn_anew(rows[0], now[0], scalar)
        if rows:
            return advance_varying(builder, rows, now, scalar)
        return advance(builder, self.kernel, now, scalar, mixing=mixing)

    @property
    def forgets(self) -> bool:
        """Whether some mode comes after every mode alike: it goes on from what all say together."""
        rows = zip(*self.kernel, strict=True)
        return self.chain.independent or any(len(set(entries)) == 1 for entries in rows)

    @property
    def note(self) -> str:
        """What the modes are, in their order."""
        names = [" or ".join(each.title for each in mode) for mode in self.variants]
        return "modes: " + "; ".join(f"{i} = {name}" for i, name in enumerate(names))

    @property
    def predicted_as(self) -> tuple[int, ...]:
        """Index of the mode whose prediction each mode uses.

        Unreachable modes reuse a reachable one so that their covariance cannot overflow.
        """
        constant = self.chain.law is None
        begun = self.initial if self.chain.first is None else self.chain.begun
        possible = visited(self.kernel if constant else self.chain.possible, begun)
        first = int(np.argmax(possible))
        return tuple(j if seen else first for j, seen in enumerate(possible))

    @property
    def motions(self) -> tuple[Plant, ...]:
        """Per mode a plant that moves as in this mode; modes that move alike have the same one."""
        known: dict[tuple[int, ...], Plant] = {}
        plants = [mode[0].plant for mode in self.variants]
        return tuple(known.setdefault(_identity(each, "ABcQ"), each) for each in plants)


def move_alike(plants: Sequence[Plant]) -> bool:
    """Whether plants differ in nothing but Q as far as x[k+1] is concerned."""
    return len({_identity(each, "ABc") for each in plants}) == 1


def mean_noise(plants: Sequence[Plant], probability: ca.SX) -> ca.SX:
    """Q if each of the plants has a probability."""
    distinct = {id(each.Q): each.Q for each in plants}
    if len(distinct) == 1:
        return plants[0].Q
    total = ca.SX(*plants[0].Q.shape)
    for key, Q in distinct.items():
        total += sum(probability[j] for j, each in enumerate(plants) if id(each.Q) == key) * Q
    return total


def _identity(plant: Plant, letters: str) -> tuple[int, ...]:
    """What tells two plants apart: matrices that are equal are the same object."""
    return tuple(id(getattr(plant, letter)) for letter in letters)


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
            priors = [_of_states((given["x"], given["P"]), mode.kept) for mode in faults.modes]
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


# ------------------------------------------------------------------------------------- one_step


def one_step_optimal(spec: Spec) -> Recursion:
    """Build ``one_step``: corrections of one prior, Bayes' rule, one Gaussian."""
    option = spec.filter.options.covariance
    beside = RICCATIS[option]
    ports, factors = _riccati_ports(spec, beside)
    filtering = Switching.of(spec, ports, factors, merges_errors=True)
    symbols, plant = filtering.symbols, filtering.plants[0]

    def combined(
        builder: PhaseBuilder, weights: ca.SX, each: list[Conditioned]
    ) -> dict[str, ca.SX]:
        parts = [(one.mean, one.covariance) for one in each]
        covariances = [packed for _, packed in parts]
        state = builder.define("combined_state", weighted_sum(weights, [mean for mean, _ in parts]))
        demand_finite(builder, state)
        covariance = weighted_sum(weights, covariances)
        if option == "moment_matched":
            scalar = spec.code.scalar
            outer = spread_weights(builder, "combined", weights, parts, state, scalar=scalar)
            covariance = mixture_covariance(weights, parts, state, outer)
        alone = covariances[:beside]
        if plant.attitudes:
            errors, n = state, plant.ne
            state, turn = off_by(builder, plant, symbols["predicted_state"], errors)
            covariance = congruence(turn, unpack(covariance, n))
            alone = [congruence(turn, unpack(each, n)) for each in alone]
        results = {"filtered_state": state, "filtered_covariance": covariance}
        if beside:
            results["riccati_filtered_covariance"] = ca.vertcat(*alone)
        return results

    name = "riccati_{}" if beside else "predicted_{}"
    known: Sequence[ca.SX | Factors] = split_packed(
        symbols[name.format("covariance")], spec.model.ne
    )
    if filtering.order:
        known = filtering.factors(name.format("factors"))
    priors = [(symbols["predicted_state"], known[j % len(known)]) for j in range(4)]
    factored = partial(_merged_factors, filtering, beside, matched=option == "moment_matched")
    update = filtering.update(priors, factored if filtering.order else combined)
    phases = update, _one_prediction(filtering, beside)
    notes = f"covariance: {option}", filtering.modes.note, *factors_note(filtering.order, spec)
    return filtering.recursion("Sigalov & Oshman, sec. III, eqs. (3)-(14)", phases, *notes)


def _merged_factors(
    filtering: Switching,
    beside: int,
    builder: PhaseBuilder,
    weights: ca.SX,
    each: list[Conditioned],
    *,
    matched: bool,
) -> dict[str, ca.SX]:
    """What ``one_step`` keeps of four corrections, with the factors of its covariances."""
    state, held = filtering.merged(builder, ca.vertsplit(weights), each, spread=matched)
    state = builder.define("combined_state", state)
    demand_finite(builder, state)
    results = {
        "filtered_state": state,
        "filtered_covariance": held.covariance(),
        "filtered_factors": held.packed,
    }
    if beside:
        alone = [one.factors for one in each[:beside] if one.factors is not None]
        results["riccati_filtered_covariance"] = ca.vertcat(*(a.covariance() for a in alone))
        results["riccati_filtered_factors"] = packed_factors(alone)
    return results


def _riccati_ports(spec: Spec, count: int) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """Covariances beside that of x, and factors of all of them."""
    n = spec.model.ne
    shape = (count, n, n) if count > 1 else (n, n)
    what = f"as if gamma were always 1, for delta = 1{' and C' if count > 1 else ''}"
    covariance = partial(carried, unit="xx", symmetric=True, prior="P")
    ports = (
        covariance("riccati_covariance", shape, f"P(k+1|k) {what}"),
        covariance("riccati_filtered_covariance", shape, f"P(k|k) {what}"),
    )
    factors = factor_ports(n)
    if not count:
        return (), factors
    size = (count, len(triangle(n))) if count > 1 else (len(triangle(n)),)
    names = "riccati_factors", "riccati_filtered_factors"
    beside = (carried(f, size, f"factors of {p.name}") for f, p in zip(names, ports, strict=True))
    return ports, (*factors, *beside)


def _one_prediction(filtering: Switching, beside: int) -> Phase:
    builder, symbols, spec = PhaseBuilder(filtering.symbols), filtering.symbols, filtering.spec
    plant = bound(builder, filtering.plants[0], "ABQc")
    now = (symbols["mode_probability"], symbols["log_weight"])
    with builder.titled("law of the next mode"):
        law = filtering.modes.advanced(builder, now, spec.code.scalar, mixing=False)
    packed = [symbols["filtered_covariance"]]
    if beside:
        packed += split_packed(symbols["riccati_filtered_covariance"], spec.model.ne)
    inputs, mean = certain(symbols["u"]), symbols["filtered_state"]
    (plant,) = moved_from(builder, [plant], [mean], symbols["u"])
    results: dict[str, ca.SX] = {}
    if filtering.order:
        moved, results = _moved_factors(builder, filtering, plant, beside)
    else:
        moved = [
            propagate(builder, plant, inputs, Posterior(mean, each), f"_{at}")[:2]
            for at, each in enumerate(packed)
        ]
    state = moved[0][0]
    results |= {
        "predicted_mode_probability": law.probability,
        "predicted_log_weight": law.logarithm,
        "predicted_state": state,
        "predicted_covariance": moved[0][1],
        **filtering.anew(),
    }
    if beside:
        results["riccati_covariance"] = ca.vertcat(*(each for _, each in moved[1:]))
    with builder.titled("prediction of the next sample"):
        builder.assign(results, [finite(state, each) for _, each in moved])
    return builder.phase()


def _moved_factors(
    builder: PhaseBuilder, filtering: Switching, plant: Plant, beside: int
) -> tuple[list[Gaussian], dict[str, ca.SX]]:
    """Predictions of one mean with the covariances there are, and the ports of their factors."""
    symbols, moved, ports = filtering.symbols, list[Gaussian](), dict[str, ca.SX]()
    estimate = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
    names = {"filtered_factors": "predicted_factors"}
    names |= {"riccati_filtered_factors": "riccati_factors"} if beside else {}
    for name, later in names.items():
        found = []
        for at, held in enumerate(filtering.factors(name)):
            state, next_, _ = propagate_factors(plant, certain(symbols["u"]), estimate, held)
            found.append(next_.named(builder, f"next_{later}_{at}"))
            moved.append((state, found[-1].covariance()))
        ports[later] = packed_factors(found)
    return moved, ports


# ------------------------------------------------------------------------------------------ imm


def interacting_models(spec: Spec) -> Recursion:
    """Build ``imm``: a correction per mode, Bayes' rule, mixing, a prediction per mode."""
    means = "x(k+1|k), mixed, under each mode", "x(k|k) under each mode"
    count = spec.filter.options.modes
    factors = mode_factor_ports(spec.model.ne, [0] * count)
    filtering = Switching.of(spec, mode_estimate_ports(spec, count, means), factors)
    order = filtering.order

    def combined(
        builder: PhaseBuilder, weights: ca.SX, each: list[Conditioned]
    ) -> dict[str, ca.SX]:
        parts = [(one.mean, one.covariance) for one in each]
        chart = Chart(builder, filtering.plants[0], "combination", parts[0][0])
        flat = chart.inward(parts)
        lasting = filtering.modes.forgets and not order
        mixer = Mixer(builder, "combined", flat, spec.code.scalar, lasting=lasting)
        state, covariance = chart.outward(mixer.under(weights))
        demand_finite(builder, state)
        held = packed_factors(one.factors for one in each)
        return ({"mode_filtered_factors": held} if order else {}) | {
            "filtered_state": state,
            "filtered_covariance": covariance,
            "mode_filtered_state": ca.vertcat(*(mean for mean, _ in parts)),
            "mode_filtered_covariance": ca.vertcat(*(packed for _, packed in parts)),
        }

    symbols = filtering.symbols
    own = split_estimates(symbols["mode_state"], symbols["mode_covariance"], spec.model.nx)
    priors: list[Prior] = [*own]
    if order:
        means_ = [mean for mean, _ in own]
        priors = [*zip(means_, filtering.factors("mode_factors"), strict=True)]
    elif spec.faults.jump is not None:
        pairs = zip(own, spec.faults.jump.modes, strict=True)
        priors = [_of_states(prior, mode.kept) for prior, mode in pairs]
    phases = filtering.update(priors, combined), _predictions(filtering)
    source, notes = "Sigalov & Oshman, sec. IV, eqs. (8), (15)-(18)", [filtering.modes.note]
    notes += factors_note(order, spec)
    if spec.faults.jump is not None:
        source = "Blom & Bar-Shalom 1988, IEEE Trans. Automatic Control 33(8)"
        notes.append(JUMPING)
    lumped = any(len(variants) > 1 for variants in filtering.modes.variants)
    repeats = None if lumped else correlated_rows([plant.R for plant in filtering.plants])
    return filtering.recursion(source, phases, *notes, repeats=repeats)


def _of_states(prior: Gaussian, kept: tuple[int, ...] | None) -> Gaussian:
    """A prediction with 0, known, in place of the states that its mode does not have."""
    if kept is None:
        return prior
    which, n = list(kept), prior[0].numel()
    state, covariance = ca.SX(n, 1), ca.SX(n, n)
    state[which] = prior[0][which]
    covariance[which, which] = unpack(prior[1], n)[which, which]
    return ca.densify(state), pack(covariance)


def _predictions(filtering: Switching) -> Phase:
    builder, symbols, spec = PhaseBuilder(filtering.symbols), filtering.symbols, filtering.spec
    modes = filtering.bound(builder, "ABcQ")
    with builder.titled("law of the next mode, and mixing weights"):
        now = (symbols["mode_probability"], symbols["log_weight"])
        law = modes.advanced(builder, now, spec.code.scalar, mixing=True)
    factors: list[Factors] = []
    with builder.titled("mixing and prediction of every mode"):
        if filtering.order:
            moved, which, factors = _moved_in_factors(builder, filtering, modes, law)
        else:
            moved, which = _moved(builder, filtering, modes, law)
    with builder.titled("combined prediction"):
        motions = modes.motions
        combined = _combined(builder, filtering, motions, (moved, which), law.probability)
        held = packed_factors(factors[at] for at in which) if factors else ca.SX(0, 1)
        builder.assign(
            ({"mode_factors": held} if factors else {})
            | {
                "predicted_mode_probability": law.probability,
                "predicted_log_weight": law.logarithm,
                "mode_state": ca.vertcat(*(moved[at][0] for at in which)),
                "mode_covariance": ca.vertcat(*(moved[at][1] for at in which)),
                "predicted_state": combined[0],
                "predicted_covariance": combined[1],
                **filtering.anew(),
            }
        )
    return builder.phase()


def _moved(
    builder: PhaseBuilder, filtering: Switching, modes: Modes, law: Prediction
) -> tuple[list[Gaussian], list[int]]:
    """Estimates mixed by (17), (18), then moved as the mode does, and which is that of each mode.

    What is the same is computed once.
    """
    symbols, motions = filtering.symbols, modes.motions
    filtered = filtering.filtered()
    chart = Chart(builder, motions[0], "mixing", filtered[0][0])
    mixer = Mixer(builder, "mixed", chart.inward(filtered), filtering.spec.code.scalar)
    mixed: dict[int, Gaussian] = {}
    known: dict[tuple[int, int], int] = {}
    moved: list[Gaussian] = []
    which = []
    for j in modes.predicted_as:
        group, plant = law.group[j], motions[j]
        if law.mixing[group] is symbols["mode_probability"]:  # says nothing of the mode before
            mixed[group] = (symbols["filtered_state"], symbols["filtered_covariance"])
        elif group not in mixed:
            merged = mixer.under(law.mixing[group], f"_{group}", law.columns[group])
            mixed[group] = chart.outward(merged, f"_{group}")
        at = known.setdefault((group, id(plant)), len(moved))
        if at == len(moved):
            (plant,) = moved_from(builder, [plant], [mixed[group][0]], symbols["u"], f"_{at}")
            inputs, tag = certain(symbols["u"]), f"_{at}"
            state, packed, _ = propagate(builder, plant, inputs, Posterior(*mixed[group]), tag)
            state = builder.define(f"moved_state_{at}", state)
            moved.append((state, builder.define(f"moved_covariance_{at}", packed)))
        which.append(at)
    return moved, which


def _moved_in_factors(
    builder: PhaseBuilder, filtering: Switching, modes: Modes, law: Prediction
) -> tuple[list[Gaussian], list[int], list[Factors]]:
    """The same in factors: mixing and prediction are one orthogonalisation for each mode."""
    symbols, motions, u = filtering.symbols, modes.motions, filtering.symbols["u"]
    filtered, factors = filtering.filtered(), filtering.factors("mode_filtered_factors")
    chart = Chart(builder, motions[0], "mixing", filtered[0][0])
    parts = [(mean, each) for (mean, _), each in zip(chart.inward(filtered), factors, strict=True)]
    mixed: dict[int, tuple[ca.SX, Wide]] = {}
    known: dict[tuple[int, int], int] = {}
    moved, held, which = list[Gaussian](), list[Factors](), list[int]()
    for j in modes.predicted_as:
        group, plant = law.group[j], motions[j]
        if group not in mixed:
            weights = law.mixing[group]
            alive = [i for i in range(len(parts)) if not is_zero(weights[i])] or [0]
            shares = [weights[i] for i in alive] if len(alive) > 1 else [ca.SX(1)]
            mean, wide = merged(shares, [parts[i] for i in alive])
            mean = builder.define(f"mixed_{group}_mean", mean)
            mixed[group] = chart.outward((mean, ca.SX()), f"_{group}")[0], wide
        at = known.setdefault((group, id(plant)), len(moved))
        if at == len(moved):
            state, wide = mixed[group]
            (plant,) = moved_from(builder, [plant], [state], u, f"_{at}")
            estimate = Posterior(state, symbols["filtered_covariance"])
            state, next_, _ = propagate_factors(plant, certain(u), estimate, wide)
            held.append(next_.named(builder, f"next_factors_{at}"))
            state = builder.define(f"moved_state_{at}", state)
            covariance = builder.define(f"moved_covariance_{at}", held[-1].covariance())
            moved.append((state, covariance))
        which.append(at)
    return moved, which, held


def _combined(
    builder: PhaseBuilder,
    filtering: Switching,
    motions: tuple[Plant, ...],
    moved: tuple[list[Gaussian], list[int]],
    probability: ca.SX,
) -> Gaussian:
    """x(k+1|k) whatever the mode; where modes differ in nothing but Q, from x(k|k)."""
    symbols = filtering.symbols
    if motions[0].lifted is None and move_alike(motions) and not filtering.order:
        plant = replace(motions[0], Q=mean_noise(motions, probability))
        estimate = Posterior(symbols["filtered_state"], symbols["filtered_covariance"])
        return propagate(builder, plant, certain(symbols["u"]), estimate, "_combined")[:2]
    masses = [ca.SX(0) for _ in moved[0]]
    for j, at in enumerate(moved[1]):
        masses[at] += probability[j]
    chart = Chart(builder, motions[0], "prediction", moved[0][0][0])
    parts = chart.inward(moved[0])
    mixer = Mixer(builder, "predicted", parts, filtering.spec.code.scalar, lasting=False)
    return chart.outward(mixer.under(column(masses)))
