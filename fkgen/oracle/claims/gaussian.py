"""Closed forms of Gaussian filters and banks of them; the digits that a record leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fkgen.faults.chain import Mode
from fkgen.oracle.claims.claim import Array, ClosedForm, Ports, Record, of_matrices, ports
from fkgen.oracle.exact.batch import Delays, batch_lmmse, joint_distribution
from fkgen.oracle.exact.gate import batch_gated
from fkgen.oracle.exact.hindsight import given_so_far
from fkgen.oracle.exact.hypotheses import batch_posterior, textbook_mme
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.sampled import informed
from fkgen.oracle.textbook.riccati import (
    constant_gain,
    constant_input_noise,
    stationary_prediction,
)
from fkgen.problem import Model, Spec
from fkgen.problem.covariance import is_singular

PAPER = "Strandt, Schneider & Yaz"

#: Relative error that well-conditioned double arithmetic stays far below and no wrong formula does.
EXACT = 1e-9

#: Where S may be singular, both sides decide on a rank, and a rank decision has a tolerance.
RANK_DEFICIENT = 1e-6


def _plants(spec: Spec) -> tuple[Model | Mode, ...]:
    """The matrices of every mode."""
    return (spec.model,) if spec.faults.jump is None else spec.faults.jump.modes


def has_exact_rows(spec: Spec) -> bool:
    """Whether some combination of the rows of y carries no noise."""
    return any(is_singular(each.R.values(spec.defaults)) for each in _plants(spec))


def undecided(spec: Spec) -> tuple[str, ...]:
    """Ports left out: a density on a subspace depends on the coordinates chosen there."""
    return ("log_likelihood",) if has_exact_rows(spec) else ()


def system_of(spec: Spec, record: Record, rates: tuple[float, ...] | None = None) -> LinearSystem:
    """The linear system of a record, with the record's prior."""
    system = LinearSystem.from_spec(spec, len(record.y), record.parameters, rates)
    faults = spec.faults.sensor
    if faults is not None and spec.filter.traits.told:
        gamma, delta = (np.asarray(record.parameters[name]) for name in ("gamma", "delta"))
        system = informed(system, faults, gamma, delta)
    return replace(system, P0=record.P0)


def delays_of(spec: Spec, record: Record) -> Delays | None:
    """By how many samples rows are late, (T, p); None if none can be."""
    late = {i: signal.delay for i, signal in enumerate(spec.model.outputs) if signal.max_delay}
    if not late:
        return None
    delays = np.zeros(record.y.shape, np.intp)
    for i, name in late.items():
        delays[:, i] = record.parameters[name]
    return delays


def digits_at_stake(spec: Spec, record: Record) -> float:
    """`EXACT`, or what the ratio of state to measurement noise leaves of double precision."""
    if has_exact_rows(spec):
        return RANK_DEFICIENT
    ratio = max(_state_to_noise(spec, each, record.P0) for each in _plants(spec))
    growth = _growth(spec) ** (2 * len(record.y))
    return float(max(EXACT, 1e3 * np.finfo(float).eps * ratio * growth))


def _state_to_noise(spec: Spec, plant: Model | Mode, P0: Array) -> float:
    C, Q, R = (getattr(plant, letter).values(spec.defaults) for letter in ("C", "Q", "R"))
    return float(np.max(np.diag(C @ (P0 + Q) @ C.T) / np.diag(R)))


def _growth(spec: Spec) -> float:
    """By how much an unstable plant amplifies in a sample what is not known exactly."""
    dynamics = [each.A.values(spec.defaults) for each in _plants(spec)]
    return float(max(1.0, *(np.abs(np.linalg.eigvals(A)).max() for A in dynamics)))


def _batch(spec: Spec, record: Record) -> Ports | None:
    return None if _is_constant(spec) else _estimates(spec, record)


def _is_constant(spec: Spec) -> bool:
    """Whether the gain is that of the steady state."""
    return bool(spec.filter.option("gain", None) == "stationary")


def _estimates(spec: Spec, record: Record) -> Ports:
    system, gate = system_of(spec, record), spec.filter.option("gate", None)
    delays = delays_of(spec, record)
    result = batch_lmmse(system, record.y, record.u, delays)
    if gate is not None:
        together = spec.filter.options.gate_by == "sample"
        result = batch_gated(system, record.y, record.u, gate, together=together, delays=delays)
    return ports(result, *undecided(spec))


def used(spec: Spec, record: Record) -> Array:
    """The measurements of a record that a gate lets pass, the others NaN."""
    if spec.filter.option("gate", None) is None:
        return record.y
    return np.where(_estimates(spec, record)["rejected"] > 0.0, np.nan, record.y)


def _lagged(spec: Spec, record: Record) -> Ports | None:
    lag = spec.filter.option("lag", None)
    if lag is None:
        return None
    joint = joint_distribution(system_of(spec, record), record.u)
    found = given_so_far(joint, used(spec, record), lag)
    return dict(zip(("lagged_state", "lagged_covariance"), found, strict=True))


def _stationary(spec: Spec, record: Record) -> dict[str, Array]:
    system = system_of(spec, record)
    A, C = system.A[0], system.C[0]
    Q, R, S = constant_input_noise(system, record.u[0])
    found = stationary_prediction(A, C, Q, R, S)
    if found is None:
        return {}
    P = found[0]
    return {"predicted_covariance": P, "innovation_covariance": C @ P @ C.T + R}


def _constant_gain(spec: Spec, record: Record) -> Ports | None:
    if not _is_constant(spec) or spec.filter.option("gate", None) is not None:
        return None
    system = system_of(spec, record)
    return constant_gain(system, record.y, system.inputs(record.u))


def _fixed_point(spec: Spec, record: Record) -> Ports | None:
    if spec.filter.option("gate", None) is not None:
        return None  # the covariance does not rest where rows are left out
    repeated = (len(record.y), 1, 1)
    return {name: np.tile(P, repeated) for name, P in _stationary(spec, record).items()} or None


def _at_the_fixed_point(spec: Spec, record: Record) -> Ports:
    found = _stationary(spec, record)
    found.pop("innovation_covariance", None)
    return found


def _riccati_tolerance(spec: Spec, record: Record) -> float:
    """A Riccati solver keeps about half of the digits of an ill-conditioned equation."""
    return max(1e-7 * _growth(spec) ** 4, digits_at_stake(spec, record))


def _optimal_gain(spec: Spec, record: Record) -> Ports | None:
    """Solve (11), K Om = A P C' + B N D', with P from the batch estimate of the past."""
    delays = delays_of(spec, record)
    if delays is not None and delays.any():
        return None
    system, measured = system_of(spec, record), used(spec, record)
    batch = batch_lmmse(system, measured, record.u)
    P = np.concatenate([record.P0[np.newaxis], batch.predicted_covariance[:-1]])
    gains = np.zeros((len(record.y), system.nx, system.ny))
    for k, y in enumerate(measured):
        rows = np.flatnonzero(~np.isnan(y))
        _, R, S = constant_input_noise(system, record.u[k], k)
        C = system.C[k][rows]
        cross = system.A[k] @ P[k] @ C.T + S[:, rows]
        Om = C @ P[k] @ C.T + R[np.ix_(rows, rows)]
        if rows.size:
            if np.linalg.matrix_rank(Om, hermitian=True) < rows.size:
                return None
            gains[k][:, rows] = np.linalg.solve(Om, cross.T).T
    return {"gain": gains}


def _systems(spec: Spec, record: Record) -> list[LinearSystem]:
    return [system_of(spec, record, rates) for rates in spec.filter.options.hypotheses]


def _bank(spec: Spec, record: Record) -> Ports:
    options, T = spec.filter.options, len(record.y)
    found = ports(
        textbook_mme(
            _systems(spec, record),
            np.array(options.prior),
            record.y,
            record.u,
            weight_floor=options.weight_floor,
            likelihood=options.likelihood,
        )
    )
    rates = len(options.hypotheses[0])
    if rates > 1:
        estimate = found["success_rate_estimate"].reshape(T, -1)
        found["success_rate_estimate"] = np.broadcast_to(estimate, (T, rates))
    return found


def _posterior(spec: Spec, record: Record) -> Ports | None:
    D, options = spec.model.D, spec.filter.options
    direct = not D.is_constant or D.values().any()
    if options.weight_floor > 0.0 or (direct and options.likelihood != "gaussian"):
        return None
    prior = np.array(options.prior)
    return {"mode_probability": batch_posterior(_systems(spec, record), prior, record.y, record.u)}


def likelihood_tolerance(spec: Spec, record: Record) -> float:
    """Weights are exponentials: they lose the digits that the exponent has before the point."""
    return 1e2 * digits_at_stake(spec, record)


BATCH = ClosedForm(
    claim="estimates, innovations and likelihoods are those of the joint distribution",
    source="linear minimum mean square error estimate from second moments",
    tolerance=digits_at_stake,
    expected=of_matrices(_batch),
)
LAGGED = ClosedForm(
    claim="estimates of past samples are those of the joint distribution",
    source="linear minimum mean square error estimate from second moments",
    tolerance=digits_at_stake,
    expected=of_matrices(_lagged),
)
RICCATI = ClosedForm(
    claim="the stabilising solution of the Riccati equation is where the covariance comes to rest",
    source="Anderson & Moore 1979, sec. 4.4; (12) and (22) in the limit",
    tolerance=_riccati_tolerance,
    expected=of_matrices(_fixed_point),
    start=_at_the_fixed_point,
    steady=True,
)
CONSTANT_GAIN = ClosedForm(
    claim="the estimate is that of an observer with the gain of the steady state",
    source="Anderson & Moore 1979, sec. 4.4, in matrices",
    tolerance=_riccati_tolerance,
    expected=_constant_gain,
)
OPTIMAL_GAIN = ClosedForm(
    claim="the gain is K = (A P C' + B N D') Om^-1, which minimises the error covariance",
    source=f"{PAPER}, eqs. (9)-(11)",
    tolerance=digits_at_stake,
    expected=of_matrices(_optimal_gain),
)
MME_TEXTBOOK = ClosedForm(
    claim="estimates and weights are those of matrix filters with plain probabilities",
    source=f"{PAPER}, eqs. (4), (9)-(18)",
    tolerance=likelihood_tolerance,
    expected=of_matrices(_bank),
)
MME_BATCH = ClosedForm(
    claim="weights are the posterior from the joint density of all samples",
    source=f"{PAPER}, eqs. (14)-(16), without recursion",
    tolerance=likelihood_tolerance,
    expected=of_matrices(_posterior),
)
