"""The linear filter with one mean and one covariance: kf, mkf and genie."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from fkgen.estimators.gaussian.actuation import Actuation, certain, intermittent, rates_of
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
from fkgen.estimators.gaussian.sequential import Conditioned
from fkgen.estimators.gaussian.ud import Factors, factors_note, order_of, started
from fkgen.faults import SensorFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Port, Status
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.lifting.linearise import moved_from, seen_from
from fkgen.symbolic.linalg import sparse
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


def linear_filter(spec: Spec, *, source: str, with_gain: bool) -> Recursion:
    """Build the recursion of ``kf``, ``mkf`` or ``genie``: what the faults of the spec say."""
    plant = plant_of(spec)
    size = _actuation(spec, plant, ca.SX.sym("u", plant.nu)).size if plant.D.nnz() else 0
    ports = _ports(spec, plant, size, with_gain=with_gain)
    form = update_form(spec, plant, augmented=size > 0, factored=has_factors(plant))
    beside, start, notes = size + len(moved_by_noise(plant)), None, gate_notes(spec)
    order = order_of((plant,)) if form == "ud" else ()
    if form == "ud":
        ports = (*factor_ports(plant.ne, beside), *ports)
    symbols = symbols_of(spec, plant, ports)
    if form == "ud":
        begun = {"predicted_factors": 1} | ({} if beside else {"filtered_factors": 1})
        start = started(spec, symbols, begun, order)
        notes += factors_note(order, spec)
    return Recursion(
        spec=spec,
        source=source,
        ports=ports,
        start=start,
        update=_update(spec, plant, symbols, (form, order), with_gain=with_gain),
        predict=prediction(spec, plant, symbols, with_gain=with_gain, order=order),
        form=form,
        outcomes=gate_outcomes(spec),
        notes=notes,
        repeats=None if size or plant.S.nnz() else correlated_rows((plant.R,)),
    )


def _ports(spec: Spec, plant: Plant, r: int, *, with_gain: bool) -> tuple[Port, ...]:
    """What every filter has, of the r random inputs that y depends on, and gains."""
    n, p, missing = plant.ne, plant.ny, "columns of missing rows are 0"
    deviation = "E[gamma[k] | y[0..k]] minus the success rate, per random component"
    covariance = "covariance of gamma[k] given y[0..k]"
    cross = "covariance of gamma[k] with the state given y[0..k]"
    inputs = (
        carried("actuation_deviation", (r,), deviation),
        carried("actuation_covariance", (r, r), covariance, symmetric=True),
        carried("actuation_cross_covariance", (r, n), cross),
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
        carried("noise_cross_covariance", (r, n), "covariance of the same with the state"),
    )
    shared = (*noises, *innovation_ports(spec))
    gated = gate_ports(spec)
    ports = (*state_ports(spec), *inputs, *shared, *(gains if with_gain else ()), *gated)
    return tuple(port for port in ports if port.size)


def _deviation_ports(plant: Plant) -> tuple[str, str, str]:
    """Where mean, covariance and covariance with x of what y tells of beside x are kept."""
    if plant.S.nnz():
        return "noise_mean", "noise_covariance", "noise_cross_covariance"
    return "actuation_deviation", "actuation_covariance", "actuation_cross_covariance"


def _actuation(spec: Spec, plant: Plant, u: ca.SX) -> Actuation:
    faults = spec.faults.actuator
    return certain(u) if faults is None else intermittent(faults, rates_of(faults, plant), u, plant)


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


def _update(
    spec: Spec,
    plant: Plant,
    symbols: dict[str, ca.SX],
    how: tuple[Form, tuple[int, ...]],
    *,
    with_gain: bool,
) -> Phase:
    """Correct the prediction; ``how`` is the form of the update, and the order of its factors."""
    builder = PhaseBuilder(symbols)
    prior: ca.SX | Factors = symbols["predicted_covariance"]
    if how[1]:
        prior = Factors.of(symbols["predicted_factors"], how[1], plant.scalar)
    demand_positive(builder, prior)
    _demand_rates(builder, spec, plant)
    if spec.faults.sensor is not None:
        _demand_indicators(builder, plant, spec.faults.sensor)
        (told,) = mode_plants(spec, [spec.faults.sensor.told(spec.model)], plant)
        plant = replace(plant, C=told.C, D=told.D, R=told.R, d=told.d, lifted=told.lifted)
    plant = bound(builder, plant, "CDRdQS" if plant.S.nnz() else "CDRd")
    actuation = _actuation(spec, plant, symbols["u"])
    (plant,) = seen_from(builder, [plant], [symbols["predicted_state"]], actuation.mean)
    found, posterior = correct(
        builder,
        plant,
        actuation,
        (symbols["predicted_state"], prior),
        y=symbols["y"],
        form=how[0],
        with_gain=with_gain,
        gate=Gate.of(spec),
    )
    demand_finite(builder, posterior.state)
    of_both = by_rows(posterior.cross_covariance)
    deviation = posterior.deviation, posterior.deviation_covariance, of_both
    assign = {
        "filtered_state": posterior.state,
        "filtered_covariance": posterior.covariance,
        **dict(zip(_deviation_ports(plant), deviation, strict=True)),
        **innovation_results(found),
        **gate_results(found.rejected),
    }
    if posterior.factors is not None:
        assign["filtered_factors"] = posterior.factors.packed
    if found.gain is not None:
        assign["filtered_gain"] = by_rows(found.gain[: plant.ne, :])
        assign["actuation_gain"] = by_rows(found.gain[plant.ne :, :])
    with builder.titled("results of the update"):
        builder.assign({name: value for name, value in assign.items() if value.numel()})
    return builder.phase()


def prediction(
    spec: Spec,
    plant: Plant,
    symbols: dict[str, ca.SX],
    *,
    with_gain: bool,
    order: tuple[int, ...] = (),
) -> Phase:
    """Propagate what is known of x, and of inputs and noise, to the next sample.

    ``order`` is that of factors, if there are any.
    """
    builder = PhaseBuilder(symbols)
    _demand_rates(builder, spec, plant)
    plant = bound(builder, plant, "ABQc")
    actuation = _actuation(spec, plant, symbols["u"])
    (plant,) = moved_from(builder, [plant], [symbols["filtered_state"]], actuation.mean)
    posterior, r = Posterior(symbols["filtered_state"], symbols["filtered_covariance"]), 0
    deviation, own, cross = _deviation_ports(plant)
    if deviation in symbols:
        r = symbols[deviation].numel()
        posterior = replace(
            posterior,
            deviation=symbols[deviation],
            deviation_covariance=symbols[own],
            cross_covariance=from_rows(symbols[cross], r),
        )
    assign = {}
    if order:
        order = (*order, *range(plant.ne, plant.ne + r))
        held = Factors.of(symbols["filtered_factors"], order, plant.scalar)
        state, held, through = propagate_factors(plant, actuation, posterior, held)
        with builder.titled("factors of the next covariance"):
            held = held.named(builder, "next_factors")
        covariance, assign["predicted_factors"] = held.covariance(), held.packed
    else:
        state, covariance, through = propagate(builder, plant, actuation, posterior)
    assign |= {"predicted_state": state, "predicted_covariance": covariance}
    if with_gain:
        gain = from_rows(symbols["filtered_gain"], plant.ne)
        if r:
            gain = ca.vertcat(gain, from_rows(symbols["actuation_gain"], r))
        assign["gain"] = by_rows(through @ gain)
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


def by_rows(matrix: ca.SX) -> ca.SX:
    """Entries of a matrix row by row: the one place where CasADi's column order is turned."""
    return ca.densify(ca.reshape(matrix.T, matrix.numel(), 1))


def from_rows(values: ca.SX, rows: int) -> ca.SX:
    """The matrix with this many rows whose entries are given row by row."""
    return ca.reshape(values, values.numel() // rows, rows).T
