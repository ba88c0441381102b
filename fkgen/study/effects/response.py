"""The effect of a fault on a filter whose gain does not depend on y: by its own recursion, in C.

Such a filter maps (x0, u, y) to its estimate linearly, with gains that the record does not change.
So the deviation obeys the recursion of the filter itself,

    Delta[k] = (I - K[k] C) A Delta[k-1] + K[k] f[k],    Delta[-1] = 0,

driven by the fault and started at zero: generated, proved and compiled like every filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError
from fkgen.faults import Faults
from fkgen.oracle.exact.gaussian import square_root
from fkgen.pipeline import build
from fkgen.problem import Code, Expression, Filter, Matrix, Name, Number, Parameter, Signal, Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.effects.scenario import FaultScenario, Mode
from fkgen.symbolic.interface import Status

Array = NDArray[np.float64]

#: Sign of the anomaly in the error of a filter that is told nothing, everything, or too much.
_SIGN: dict[Mode, float] = {"plant": 1.0, "both": 0.0, "filter": -1.0}

#: Value at which the proof tries a parameter of the companion: any number but zero will do.
_TRIED = 0.5


def linear_response(scenario: FaultScenario) -> FaultEffect:
    """The effect on a filter that is linear in y."""
    spec, n = scenario.spec, scenario.spec.model.nx
    companion, params, rate = _companion(scenario)
    built = build(companion)
    anomaly = rate * scenario.anomaly
    # The error deviates by what the filter makes of -f in y, and of the part of the anomaly that
    # only the plant (+) or only the filter (-) has got.
    y = np.where(scenario.missing, np.nan, -scenario.sensor)
    own = _run(built, y, _SIGN[scenario.mode] * anomaly, params)
    error = np.asarray(own.filtered_state[:, :n], dtype=float)
    plant = np.zeros_like(error)
    if scenario.mode != "filter" and anomaly.any():  # nothing is measured: the plant, left alone
        plant = _run(built, np.full_like(y, np.nan), anomaly, params).filtered_state[:, :n]
    variance = np.diagonal(own.filtered_covariance, axis1=1, axis2=2)[:, :n]
    random = spec.faults.actuator is not None and anomaly.any()
    direct = any(entry != Number(0.0) for row in spec.model.D.rows for entry in row)
    # y shows which commands were lost
    mixture = spec.faults.actuator is not None and scenario.known_inputs.any() and direct
    return FaultEffect(
        state_deviation=plant - error,
        error_deviation=error + 0.0,  # no -0.0
        innovation_deviation=np.asarray(0.0 - own.innovation, dtype=float),
        noncentrality=np.asarray(own.nis, dtype=float),
        state_sd=np.sqrt(np.maximum(variance, 0.0)),
        degrees=np.sum(~scenario.missing, axis=1),
        kind="mean" if random else "exact",
        standard_error=np.zeros_like(error),
        gaussian=not mixture,
    )


def _run(built: CompiledFilter, y: Array, u: Array, params: Mapping[str, ArrayLike]) -> Run:
    run = built.run(y, u if u.shape[1] else None, params)
    if run.refused.any():
        k = int(np.argmax(run.refused))
        status = Status(int(run.status[k]))
        if status is Status.RESULT_NOT_FINITE:
            expected = f"at most {k}: then numbers overflow, because the plant is unstable"
            raise DataError("steps", given=f"{len(y)} samples", expected=expected)
        given = f"a record that the filter refuses at sample {k}"
        raise DataError("params", given=given, expected=f"no sample at which {status.meaning}")
    return run


def _companion(scenario: FaultScenario) -> tuple[Spec, Mapping[str, ArrayLike], Array]:
    """The filter for deviations, its parameters, and the share (T, q) of u that arrives on average.

    Its prior mean is zero, it is in double, and its first n states are those of the filter.
    """
    spec, T = scenario.spec, scenario.samples
    model = replace(spec.model, x0=Matrix.zeros(spec.model.nx, 1))
    still = replace(spec, model=model, code=Code("double", spec.code.update))
    if spec.faults.actuator is None:
        return still, scenario.params, np.ones((T, spec.model.nu))
    system, u = scenario.system(), scenario.known_inputs
    root = square_root(u[:, :, np.newaxis] * system.fault_covariance * u[:, np.newaxis, :])
    root = root[:, :, np.abs(root).max(axis=(0, 1), initial=0.0) > 0.0]
    wide, params = _with_lost_commands(still, system.B @ root, system.D @ root)
    return wide, {**scenario.params, **params}, system.rate


def _with_lost_commands(spec: Spec, driven: Array, sensed: Array) -> tuple[Spec, dict[str, Array]]:
    """The Kalman filter that ``mkf`` is, with the lost part of u as r more states.

    Strandt, Schneider & Yaz, (1): g u = xi u + (g - xi) u, where the second part is noise in x and
    in y at once. It is a white state e with covariance I, through (B N^1/2) e and (D N^1/2) e with
    N = diag(u) Cov(g) diag(u): ``driven`` (T, n, r) and ``sensed`` (T, p, r) become parameters.
    """
    model, r = spec.model, driven.shape[2]
    prefix = "lost"
    while any(parameter.name.startswith(prefix) for parameter in spec.parameters):
        prefix += "_"
    into_x, params = _named(f"{prefix}_x", driven)
    into_y, more = _named(f"{prefix}_y", sensed)
    params |= more
    noise = Matrix.of(np.eye(r)) if r else Matrix(())
    wide = replace(
        model,
        A=Matrix((*_beside(model.A, into_x), *Matrix.zeros(r, model.nx + r).rows)),
        B=Matrix((*model.B.rows, *Matrix.zeros(r, model.nu).rows)),
        C=Matrix(_beside(model.C, into_y)),
        Q=_diagonal(model.Q, noise),
        P0=_diagonal(model.P0, noise),
        x0=Matrix.zeros(model.nx + r, 1),
        states=(*model.states, *(Signal(f"{prefix}_{j}") for j in range(r))),
    )
    parameters = (*spec.parameters, *(Parameter(name, _TRIED) for name in params))
    family = Filter("kf")
    result = replace(spec, model=wide, parameters=parameters, faults=Faults(), filter=family)
    return result, params


def _named(prefix: str, values: Array) -> tuple[Matrix, dict[str, Array]]:
    """A matrix of parameters with these values (T, rows, r); zeros stay zeros."""
    params: dict[str, Array] = {}

    def entry(i: int, j: int) -> Expression:
        if not values[:, i, j].any():
            return Number(0.0)
        name = f"{prefix}_{i}_{j}"
        params[name] = np.ascontiguousarray(values[:, i, j])
        return Name(name)

    _, rows, r = values.shape
    return Matrix(tuple(tuple(entry(i, j) for j in range(r)) for i in range(rows))), params


def _beside(left: Matrix, right: Matrix) -> tuple[tuple[Expression, ...], ...]:
    return tuple((*a, *b) for a, b in zip(left.rows, right.rows, strict=True))


def _diagonal(first: Matrix, second: Matrix) -> Matrix:
    n, r = len(first.rows), len(second.rows)
    upper = _beside(first, Matrix.zeros(n, r))
    return Matrix((*upper, *_beside(Matrix.zeros(r, n), second)))
