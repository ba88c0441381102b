"""The linear filter with one mean and one covariance: kf, mkf and genie."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.gaussian.actuation import Actuation, actuation_of, rates_of
from fkgen.estimators.gaussian.decorrelation import correlated_rows
from fkgen.estimators.gaussian.estimate import (
    Posterior,
    bound,
    correct,
    demand_finite,
    demand_positive,
    finite,
    has_factors,
    moved_by_noise,
    propagate,
    propagate_factors,
    update_form,
)
from fkgen.estimators.gaussian.gate import (
    Gate,
    gate_notes,
    gate_outcomes,
    gate_ports,
    gate_results,
)
from fkgen.estimators.gaussian.rows import Form
from fkgen.estimators.gaussian.sequential import Conditioned, Prior
from fkgen.estimators.gaussian.ud import Factors, factors_note, order_of, started
from fkgen.estimators.hindsight.delays import FILTERED, PREDICTED, Delays
from fkgen.estimators.hindsight.lagged import Lagged
from fkgen.estimators.hindsight.replay import Replay
from fkgen.estimators.lmmse.parts import in_parts, of_parts_only
from fkgen.faults import SensorFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Port, Status
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.lifting.linearise import moved_from, seen_from
from fkgen.symbolic.linalg import between, by_rows, cleared, from_rows, sparse
from fkgen.symbolic.plant import Plant, mode_plants, plant_of
from fkgen.symbolic.ports import (
    carried,
    factor_ports,
    innovation_ports,
    shown,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion


@dataclass(frozen=True, slots=True)
class Hindsight:
    """What a filter remembers of past samples, for rows that come late and for a fixed lag."""

    replay: Replay | None
    delays: Delays
    lagged: Lagged

    @classmethod
    def of(cls, spec: Spec, plant: Plant) -> Hindsight:
        """What a spec asks for; the lag with what y tells of beside x."""
        replay = replay_of(spec, plant)
        beside = len(moved_by_noise(plant)) if plant.S.nnz() else 0
        if not beside and plant.D.nnz():
            beside = actuation_of(spec, plant, ca.SX.sym("u", plant.nu)).size
        delays = Delays.of(spec, replayed=replay is not None)
        return cls(replay, delays, Lagged.of(spec, beside))

    @property
    def anything(self) -> bool:
        """Whether there is anything."""
        return bool(self.delays.rows or self.lagged.lag)

    def notes(self, *, curved: bool) -> tuple[str, ...]:
        """What the header says."""
        notes = (*self.delays.notes, *(self.replay.notes if self.replay else ()))
        past = {"late rows": self.delays.rows, "lagged estimates": self.lagged.lag}
        marks = (
            f"{e} are approximate: f and h are linearised"
            for e, there in past.items()
            if curved and there
        )
        return (*notes, *self.lagged.notes, *marks)

    def ports(self, p: int) -> tuple[Port, ...]:
        """What is kept, of p rows."""
        replayed = self.replay.ports() if self.replay else ()
        return (*self.delays.ports(p), *replayed, *self.lagged.ports())


def linear_filter(spec: Spec, *, source: str, with_gain: bool) -> Recursion:
    """Build the recursion of ``kf``, ``mkf`` or ``genie``: what the faults of the spec say."""
    plant = plant_of(spec)
    past = Hindsight.of(spec, plant)
    if spec.code.decoupled and not past.anything:
        plant = in_parts(spec, plant, _sensed(spec, plant))
    size = actuation_of(spec, plant, ca.SX.sym("u", plant.nu)).size if plant.D.nnz() else 0
    ports = _ports(spec, plant, size, past, with_gain=with_gain)
    beside = size + len(moved_by_noise(plant))
    factored = has_factors(plant) and not (past.anything or (beside and spec.model.ranged))
    form = update_form(spec, plant, augmented=size > 0, factored=factored)
    notes = (*gate_notes(spec), *past.notes(curved=plant.lifted is not None))
    order = order_of((plant,)) if form == "ud" else ()
    if form == "ud":
        ports = (*factor_ports(plant.ne, beside), *ports)
    symbols = symbols_of(spec, plant, ports)
    start = past.lagged.start(spec, symbols)
    if form == "ud":
        begun = {"predicted_factors": 1} | ({} if beside else {"filtered_factors": 1})
        start = started(spec, symbols, begun, order)
        notes += factors_note(order, spec)
    if plant.parts:
        start = of_parts_only(spec, plant, symbols, start)
        notes += (f"{len(set(plant.parts))} parts of the state without covariances between them",)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        start=start,
        update=_update(spec, (plant, past), symbols, (form, order), with_gain=with_gain),
        predict=prediction(spec, plant, symbols, with_gain=with_gain, order=order, past=past),
        form=form,
        factor_order=order,
        outcomes=(*gate_outcomes(spec), *past.delays.outcomes),
        notes=notes,
        repeats=None if size or plant.S.nnz() or past.replay else correlated_rows((plant.R,)),
    )


def _ports(
    spec: Spec, plant: Plant, r: int, past: Hindsight, *, with_gain: bool
) -> tuple[Port, ...]:
    """What every filter has, of the r random inputs that y depends on, and gains."""
    n, p, missing = plant.ne, plant.ny, "columns of missing rows are 0"
    whole = n + past.delays.size  # with what is remembered of past samples
    deviation = "E[gamma[k] | y[0..k]] minus the success rate, per random component"
    covariance = "covariance of gamma[k] given y[0..k]"
    cross = "covariance of gamma[k] with the state given y[0..k]"
    inputs = (
        carried("actuation_deviation", (r,), deviation),
        carried("actuation_covariance", (r, r), covariance, symmetric=True),
        carried("actuation_cross_covariance", (r, whole), cross),
    )
    gains = (
        shown("gain", (n, p), f"K: d x(k+1|k) / d y[k]; {missing}", unit="x/y"),
        shown("filtered_gain", (n, p), f"Kf: d x(k|k) / d y[k]; {missing}", unit="x/y"),
        shown("actuation_gain", (r, p), f"d E[gamma[k] | y[0..k]] / d y[k]; {missing}"),
    )
    r = len(moved_by_noise(plant))
    noises = (
        carried("noise_mean", (r,), "E[w[k] | y[k]] of the states whose noise v[k] tells of"),
        carried("noise_covariance", (r, r), "covariance of the same", symmetric=True),
        carried("noise_cross_covariance", (r, whole), "covariance of the same with the state"),
    )
    shared = (*noises, *innovation_ports(spec, given=past.delays.given), *past.ports(p))
    gated = gate_ports(spec)
    ports = (*state_ports(spec), *inputs, *shared, *(gains if with_gain else ()), *gated)
    return tuple(port for port in ports if port.size)


def _deviation_ports(plant: Plant) -> tuple[str, str, str]:
    """Where mean, covariance and covariance with x of what y tells of beside x are kept."""
    if plant.S.nnz():
        return "noise_mean", "noise_covariance", "noise_cross_covariance"
    return "actuation_deviation", "actuation_covariance", "actuation_cross_covariance"


def _demand_rates(builder: PhaseBuilder, spec: Spec, plant: Plant) -> None:
    """Refuse success rates outside [0, 1] that come from run-time parameters."""
    if spec.faults.actuator is not None:
        for rate in rates_of(spec.faults.actuator, plant):
            builder.demand(Kind.NONNEGATIVE, [rate, 1 - rate], Status.PARAMETER_OUT_OF_RANGE)


def _demand_indicators(builder: PhaseBuilder, plant: Plant, faults: SensorFaults) -> None:
    """Refuse a gamma that is neither 0 nor 1, and a delta that is neither 1 nor C."""
    gamma, delta = plant.parameters["gamma"], plant.parameters["delta"]
    factor, slack = ca.SX(faults.noise_factor), ca.SX(0)
    if faults.factor is not None:  # who computes C as well may round it in another way
        factor = lift_expression(faults.factor, plant.parameters)
        slack = 1e-6 * factor * factor
    for value, other, room in ((gamma, ca.SX(0), ca.SX(0)), (delta, factor, slack)):
        zero = (value - 1) * (value - other)
        builder.demand(Kind.NONNEGATIVE, [zero + room, room - zero], Status.PARAMETER_OUT_OF_RANGE)


def replay_of(spec: Spec, plant: Plant) -> Replay | None:
    """What is kept of past samples for late rows, where their noises are their own.

    Where R ties them to others, or y tells of noises and inputs of x, or of what a gate decides,
    they are part of the state instead: see `Delays`.
    """
    delays = Delays.of(spec, replayed=True)
    rows, R = [row for row, _, _ in delays.rows], plant.R
    tied = not R.sparsity().is_diag() or plant.S.nnz() or plant.noise_free
    random = spec.faults.actuator is not None and plant.D.nnz()
    curved, gated = plant.lifted is not None, Gate.of(spec) is not None
    if not rows or tied or random or curved or gated:
        return None
    if update_form(spec, plant, augmented=False) != "short":
        return None
    return Replay(delays, _sensed(spec, plant))


def _sensed(spec: Spec, plant: Plant) -> Plant:
    """The plant as its rows are measured, of one who is told how."""
    faults = spec.faults.sensor
    if faults is None:
        return plant
    (told,) = mode_plants(spec, [faults.told(spec.model)], plant)
    return replace(plant, C=told.C, D=told.D, R=told.R, d=told.d, lifted=told.lifted)


def _measured(
    builder: PhaseBuilder, spec: Spec, plant: Plant, symbols: dict[str, ca.SX]
) -> tuple[Plant, Actuation]:
    """The plant as its rows are measured about the prediction, and what acts on it."""
    _demand_rates(builder, spec, plant)
    if spec.faults.sensor is not None:
        _demand_indicators(builder, plant, spec.faults.sensor)
    plant = _sensed(spec, plant)
    plant = bound(builder, plant, "CDRdQS" if plant.S.nnz() else "CDRd")
    actuation = actuation_of(spec, plant, symbols["u"])
    (plant,) = seen_from(builder, [plant], [symbols["predicted_state"]], actuation.mean)
    return plant, actuation


def _update(
    spec: Spec,
    of: tuple[Plant, Hindsight],
    symbols: dict[str, ca.SX],
    how: tuple[Form, tuple[int, ...]],
    *,
    with_gain: bool,
) -> Phase:
    """Correct the prediction; ``how`` is the form of the update, and the order of its factors."""
    builder, (plant, past) = PhaseBuilder(symbols), of
    delays, replay, passage = past.delays, past.replay, None
    prior: Prior = delays.joint(symbols, PREDICTED)
    if how[1]:
        prior = prior[0], _factors(plant, symbols["predicted_factors"], how[1])
    elif isinstance(prior[1], ca.SX):
        prior = prior[0], cleared(prior[1], between(plant.parts))
    demand_positive(builder, prior[1] if how[1] else symbols["predicted_covariance"])
    plant, actuation = _measured(builder, spec, plant, symbols)
    if replay is None:
        plant, kept = delays.measured(builder, plant, symbols)
    else:
        passage = replay.corrected(builder, plant, replay.kept(builder, plant, symbols))
        prior, kept = passage.prior(), tuple(map(passage.counts, range(plant.ny)))
    found, posterior = correct(
        builder,
        plant,
        actuation,
        prior,
        y=symbols["y"],
        form=how[0],
        with_gain=with_gain,
        gate=Gate.of(spec),
        kept=kept,
    )
    demand_finite(builder, posterior.state)
    assign = _filtered(plant, delays, symbols, (found, posterior))
    before = symbols["predicted_covariance"]
    past.lagged.corrected(builder, (plant, actuation), found, before)
    if passage is not None:
        assign |= passage.results(found, symbols)
        kept = tuple(passage.counted(row) for row in range(plant.ny))
    with builder.titled("results of the update"):
        assign |= delays.counted(builder, kept)
        builder.assign({name: value for name, value in assign.items() if value.numel()})
    return builder.phase()


def _filtered(
    plant: Plant, delays: Delays, symbols: dict[str, ca.SX], known: tuple[Conditioned, Posterior]
) -> dict[str, ca.SX]:
    """What ports are after an update."""
    found, posterior = known
    of_both = by_rows(posterior.cross_covariance)
    deviation = posterior.deviation, posterior.deviation_covariance, of_both
    assign = {
        **delays.split(posterior.state, posterior.covariance, FILTERED),
        **delays.aged(symbols, predicted=False),
        **dict(zip(_deviation_ports(plant), deviation, strict=True)),
        **innovation_results(found),
        **gate_results(found.rejected),
    }
    if posterior.factors is not None:
        assign["filtered_factors"] = posterior.factors.packed
    if found.gain is not None:
        assign["filtered_gain"] = by_rows(found.gain[: delays.n, :])
        assign["actuation_gain"] = by_rows(found.gain[plant.ne :, :])
    return assign


def _factors(plant: Plant, packed: ca.SX, order: tuple[int, ...]) -> Factors:
    """Those of a covariance, 0 between parts of the state."""
    return Factors.of(cleared(packed, between(plant.parts, order)), order, plant.scalar)


def _posterior(plant: Plant, delays: Delays, symbols: dict[str, ca.SX]) -> Posterior:
    """What an update left known, of x and of what y told of beside it."""
    state, covariance = delays.joint(symbols, FILTERED)
    posterior = Posterior(state, cleared(covariance, between(plant.parts)))
    deviation, own, cross = _deviation_ports(plant)
    if deviation not in symbols:
        return posterior
    return replace(
        posterior,
        deviation=symbols[deviation],
        deviation_covariance=symbols[own],
        cross_covariance=from_rows(symbols[cross], symbols[deviation].numel()),
    )


def prediction(
    spec: Spec,
    plant: Plant,
    symbols: dict[str, ca.SX],
    *,
    with_gain: bool,
    order: tuple[int, ...] = (),
    past: Hindsight | None = None,
) -> Phase:
    """Propagate what is known, in factors of this order if there are any, to the next sample."""
    past = Hindsight.of(spec, plant) if past is None else past
    builder, delays = PhaseBuilder(symbols), past.delays
    _demand_rates(builder, spec, plant)
    letters = "ABQc"
    if delays.size:
        if spec.faults.sensor is not None:
            _demand_indicators(builder, plant, spec.faults.sensor)
        plant, letters = _sensed(spec, plant), "ABQcCDd"
    plant = bound(builder, plant, letters)
    actuation = actuation_of(spec, plant, symbols["u"])
    (plant,) = moved_from(builder, [plant], [symbols["filtered_state"]], actuation.mean)
    if delays.size:
        (plant,) = seen_from(builder, [plant], [symbols["filtered_state"]], actuation.mean)
    plant = delays.moving(plant, symbols)
    posterior = _posterior(plant, delays, symbols)
    assign = {}
    if order:
        order = (*order, *range(plant.ne, plant.ne + posterior.deviation.numel()))
        held = _factors(plant, symbols["filtered_factors"], order)
        state, held, through = propagate_factors(plant, actuation, posterior, held)
        with builder.titled("factors of the next covariance"):
            held = held.named(builder, "next_factors")
        covariance, assign["predicted_factors"] = held.covariance(), held.packed
    else:
        state, covariance, through = propagate(builder, plant, actuation, posterior)
        if plant.noise_free:
            covariance = delays.not_negative(covariance)
    assign |= delays.split(state, covariance, PREDICTED)
    assign |= delays.aged(symbols, predicted=True)
    if with_gain:
        n, whole = delays.n, plant.ne
        gain = through[:n, :n] @ from_rows(symbols["filtered_gain"], n)
        if r := posterior.deviation.numel():
            gain += through[:n, whole:] @ from_rows(symbols["actuation_gain"], r)
        assign["gain"] = by_rows(gain)
    past.lagged.moved(builder, posterior, through)
    with builder.titled("prediction of the next sample"):
        builder.assign(assign, [finite(state, covariance)])
    return builder.phase()


def innovation_results(found: Conditioned) -> dict[str, ca.SX]:
    """The ports about the innovation."""
    return {
        "innovation": found.innovation,
        "innovation_covariance": found.innovation_covariance,
        "nis": found.nis,
        "log_likelihood": found.log_likelihood,
    }


def constant(values: NDArray[np.floating]) -> ca.SX:
    """A constant matrix whose zeros are structural."""
    return sparse(ca.SX(ca.DM(values)))
