"""What a fault does to the estimate, for how long, and whether the innovation shows it.

A filter whose gain does not depend on y maps (x0, u, y) to its estimate linearly. So the deviation
obeys the recursion of the filter itself, driven by the fault and started at zero:

    Delta[k] = (I - K[k] C) A Delta[k-1] + K[k] f[k],    Delta[-1] = 0.

Other filters run with and without the fault on records that differ in nothing else: one pair where
the filter is linear in y, else simulated pairs with the same noise; their mean is the answer.
Of a plant with f and h each of a pair has its own state: what a fault does depends on where it is.

References
----------
Song & Hu 2019, *Effect of Faults on Kalman Filter of State Vectors in Linear Systems*, eqs.
(6)-(26), with the errata of docs/fault-effects.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError, of_type
from fkgen.faults import Faults
from fkgen.oracle.exact.gaussian import square_root
from fkgen.oracle.plants.actuator import LinearSystem, simulate
from fkgen.oracle.sampled import draw_record
from fkgen.pipeline import build
from fkgen.problem import Filter, Matrix, Name, Parameter, Signal, Spec
from fkgen.problem.spec import as_spec
from fkgen.problem.text.expression import ZERO
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.record import choice, numbers, signal, whole
from fkgen.runtime.results import Run
from fkgen.study.effects.effect import FaultEffect
from fkgen.symbolic.interface import Status
from fkgen.trials.errors import errors_of, reduced
from fkgen.trials.simulation import simulate as draw_trials

Array = NDArray[np.float64]
_Records = tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None, ArrayLike | None]

#: Who gets the anomaly of an input, and its sign in the error of the filter: one that is told
#: everything, nothing, or too much (a wrong readback).
_SIGN = {"both": 0.0, "plant": 1.0, "filter": -1.0}

#: Value at which the proof tries a parameter of the companion: any number but zero will do.
_TRIED = 0.5

_PORTS = ("filtered_state", "filtered_covariance", "innovation", "innovation_covariance", "nis")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scenario:
    """A fault on a record of T samples, checked and completed."""

    spec: Spec  # in double
    sensor: Array  # (T, p), what is added to y
    anomaly: Array  # (T, q), what is added to u
    mode: str  # who gets the anomaly, a key of `_SIGN`
    u: Array  # (T, q), the inputs without it
    params: Mapping[str, Array]  # (T,) each, run-time parameters
    missing: NDArray[np.bool_]  # (T, p), entries of y that are missing

    @property
    def known_inputs(self) -> Array:
        """The inputs that the filter is told, (T, q)."""
        return self.u if self.mode == "plant" else self.u + self.anomaly

    def system(self, rates: tuple[float, ...] | None = None) -> LinearSystem:
        """The plant over the record; with one hypothesis in place of its success rates."""
        try:
            found = LinearSystem.from_spec(self.spec, len(self.sensor), self.params, rates)
        except ArithmeticError as fault:
            expected = f"values at which every entry of the model is a number, but {fault}"
            raise DataError("params", given="these values", expected=expected) from None
        wrong = np.flatnonzero(np.any((found.rate < 0.0) | (found.rate > 1.0), axis=1))
        if wrong.size:
            given = f"a success rate of {found.rate[wrong[0]]} at sample {wrong[0]}"
            raise DataError("params", given=given, expected="rates in [0, 1]")
        return found


def fault_effect(
    spec: Spec,
    sensor: ArrayLike | None = None,
    input: ArrayLike | None = None,  # noqa: A002 - the word of the contract
    mode: str = "both",
    steps: int | None = None,
    *,
    params: Mapping[str, ArrayLike] | None = None,
    u: ArrayLike | None = None,
    y: ArrayLike | None = None,
    runs: int = 256,
    seed: int = 0,
) -> FaultEffect:
    """Say what a fault changes in the estimate, the error and the innovation.

    ``kf``, ``mkf``, ``genie``: by the recursion of the filter, driven by the fault and started at
    zero, in C. ``linear_optimal`` with sensor faults: by two runs, whose difference no record
    changes. Others: by simulated pairs with the same noise. ``kind`` of the result says which.

    Parameters
    ----------
    spec : Spec
    sensor, input : (T, p), (T, q) array_like, optional
        What is added to y, and to u; see `fkgen.profiles`.
    mode : str
        Who gets the input anomaly: ``"both"``, ``"plant"`` (actuator fault), ``"filter"``.
    steps : int, optional
        T, to be checked against the profile.
    params : mapping of numbers or (T,), optional
    u : (T, q) array_like, optional
        Inputs without the fault; needed where the gain depends on them (``mkf``, ``mme``).
    y : (T, p) array_like, optional
        A record of which only the missing entries (NaN) matter.
    runs, seed : int
        Of the simulated pairs; with 256 the standard error is a sixteenth of the spread.

    Raises
    ------
    DataError
        If a profile does not fit the model, or the plant is unstable and numbers overflow.
    """
    scenario = _checked(as_spec(spec), (sensor, input, u, y), params, mode, steps)
    if spec.filter.linearises:
        return _simulated_response(scenario, runs, seed)
    traits = spec.filter.traits
    if traits.linear and spec.model.S.is_zero:
        return _linear_response(scenario)
    if traits.moments and spec.faults.sensor is not None and not scenario.anomaly.any():
        return _differenced_response(scenario)
    return _paired_response(scenario, runs, seed)


def _checked(
    spec: Spec,
    records: _Records,
    params: Mapping[str, ArrayLike] | None,
    mode: str,
    steps: int | None,
) -> _Scenario:
    model, faults = spec.model, spec.faults
    sensor, anomaly, u, y = records
    of_type("mode", mode, str, "both, plant or filter")
    if mode not in _SIGN:
        raise DataError("mode", given=repr(mode), expected=choice(str(mode), list(_SIGN)))
    if sensor is None and anomaly is None:
        expected = "sensor (T, p) or input (T, q): see fkgen.profiles"
        raise DataError("the fault", given="nothing", expected=expected)
    if anomaly is not None and not model.nu:
        raise DataError("input", given="a profile", expected="none: the model has no B")
    try:
        T = len(np.atleast_1d(np.asarray(sensor if anomaly is None else anomaly)))
    except ValueError:
        given = "rows of different lengths"
        raise DataError("the fault", given=given, expected="a matrix, one row per sample") from None
    if not T:
        raise DataError("the fault", given="a profile without samples", expected="at least one")
    if steps is not None:
        whole("steps", steps, least=T, most=T, expected=f"{T}, the length of the profile")
    moved = spec.filter.linearises or any((faults.actuator, faults.jump, faults.soft))
    if u is None and model.nu and moved:
        names, family = ", ".join(each.name for each in model.inputs), spec.filter.family
        expected = f"shape ({T}, {model.nu}): {names}; the gain of {family} depends on u"
        raise DataError("u", given="nothing", expected=expected)
    return _Scenario(
        spec=replace(spec.whole, code=replace(spec.whole.code, scalar="double")),
        sensor=_record("sensor", sensor, model.outputs, T),
        anomaly=_record("input", anomaly, model.inputs, T),
        mode=mode,
        u=_record("u", u, model.inputs, T),
        params=_parameters(spec, {} if params is None else params, T),
        missing=np.isnan(_record("y", y, model.outputs, T)),
    )


def _parameters(spec: Spec, params: Mapping[str, ArrayLike], samples: int) -> dict[str, Array]:
    """All parameters by name, (T,) each; stated as a number or one per sample."""
    of_type("params", params, Mapping, "a mapping of names to numbers or (T,) arrays")
    result = {name: np.full(samples, default) for name, default in spec.defaults.items()}
    for name, value in params.items():
        where = f"params.{name}"
        if name not in result:
            raise DataError(where, given="an unknown name", expected=choice(name, list(result)))
        array = numbers(where, value, np.float64)
        if array.shape not in {(), (1,), (samples,)}:
            expected = f"a number or ({samples},)"
            raise DataError(where, given=f"shape {array.shape}", expected=expected)
        if not np.isfinite(array).all():
            raise DataError(where, given="NaN or an infinity", expected="finite numbers")
        result[name][:] = array
    return result


def _record(name: str, value: ArrayLike | None, signals: Sequence[Signal], samples: int) -> Array:
    """A record of finite numbers, (T, ...), in which y alone may miss some; zeros if not given."""
    if value is None:
        return np.zeros((samples, len(signals)))
    array = np.asarray(signal(name, value, len(signals), np.float64), dtype=float)
    if len(array) != samples:
        raise DataError(name, given=f"{len(array)} samples", expected=f"{samples}")
    wrong = np.argwhere(np.isinf(array) if name == "y" else ~np.isfinite(array))
    if wrong.size:
        k, i = wrong[0]
        what = f"{name}[{k}], {signals[i].name}"
        raise DataError(what, given=str(array[k, i]), expected="a finite number")
    return array


def _linear_response(scenario: _Scenario) -> FaultEffect:
    """The effect on a filter that is linear in y: proved and compiled like every other."""
    spec, n, lossy = (
        scenario.spec,
        scenario.spec.model.nx,
        scenario.spec.faults.actuator is not None,
    )
    # its prior mean is zero, and its first n states are those of the filter
    companion = replace(spec, model=replace(spec.model, x0=Matrix.zeros(n, 1)))
    params, anomaly, u = scenario.params, scenario.anomaly, scenario.known_inputs
    if lossy:
        system = scenario.system()
        root = square_root(u[:, :, np.newaxis] * system.fault_covariance * u[:, np.newaxis, :])
        root = root[:, :, np.abs(root).max(axis=(0, 1), initial=0.0) > 0.0]
        companion, more = _with_lost_commands(
            companion, np.hstack([system.B @ root, system.D @ root])
        )
        params, anomaly = {**params, **more}, system.rate * anomaly  # what arrives on average
    built = build(companion)
    # The error deviates by what the filter makes of -f in y, and of the part of the anomaly that
    # only the plant (+) or only the filter (-) has got.
    y = np.where(scenario.missing, np.nan, -scenario.sensor)[np.newaxis]
    own = _run(built, y, _SIGN[scenario.mode] * anomaly, params)
    error = np.asarray(own.filtered_state[0, :, :n], dtype=float)
    plant = np.zeros_like(error)
    if scenario.mode != "filter" and anomaly.any():  # nothing is measured: the plant, left alone
        plant = _run(built, np.full_like(y, np.nan), anomaly, params).filtered_state[0, :, :n]
    direct = any(entry != ZERO for entry in chain(*spec.model.D.rows))
    return FaultEffect(
        state_deviation=plant - error,
        error_deviation=error + 0.0,  # no -0.0
        innovation_deviation=0.0 - own.innovation[0],
        noncentrality=own.nis[0],
        state_sd=_deviation(own)[:, :n],
        degrees=np.sum(~scenario.missing, axis=1),
        kind="mean" if lossy and anomaly.any() else "exact",
        standard_error=np.zeros_like(error),
        # y shows which commands were lost
        gaussian=not (lossy and direct and u.any()),
    )


def _run(built: CompiledFilter, y: Array, u: Array, params: Mapping[str, Array]) -> Run:
    """Filter records (M, T, p); u (T, q)."""
    run = built.run_batch(y, u if u.shape[1] else None, params, keep=_PORTS)
    if run.refused.any():
        k = int(np.argmax(run.refused.any(axis=0)))
        status = Status(int(run.status[:, k].min()))
        if status is Status.RESULT_NOT_FINITE:
            expected = f"at most {k}: then numbers overflow, because the plant is unstable"
            raise DataError("steps", given=f"{y.shape[1]} samples", expected=expected)
        given = f"a record that the filter refuses at sample {k}"
        raise DataError("params", given=given, expected=f"no sample at which {status.meaning}")
    return run


def _deviation(run: Run) -> Array:
    """Standard deviations (T, n) of the mean variance over all runs."""
    variance = np.diagonal(run.filtered_covariance, axis1=-2, axis2=-1).mean(axis=0)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _with_lost_commands(spec: Spec, roots: Array) -> tuple[Spec, dict[str, Array]]:
    """The Kalman filter that ``mkf`` is, with the lost part of u as r more states.

    Strandt, Schneider & Yaz, (1): g u = xi u + (g - xi) u, where the second part is noise in x and
    in y at once. It is a white state e with covariance I, through (B N^1/2) e and (D N^1/2) e with
    N = diag(u) Cov(g) diag(u): what of these ``roots`` (T, n + p, r) is not 0 becomes a parameter.
    """
    model, n, r = spec.model, spec.model.nx, roots.shape[2]
    prefix = "lost"
    while any(parameter.name.startswith(prefix) for parameter in spec.parameters):
        prefix += "_"
    names = [[f"{prefix}_{i}_{j}" for j in range(r)] for i in range(roots.shape[1])]
    params = {names[i][j]: roots[:, i, j].copy() for i, j in np.argwhere(roots.any(axis=0))}
    entries = [tuple(Name(name) if name in params else ZERO for name in row) for row in names]
    into_x, into_y = Matrix(tuple(entries[:n])), Matrix(tuple(entries[n:]))
    noise = Matrix.of(np.eye(r)) if r else Matrix(())
    above, below = Matrix.zeros(n, r), Matrix.zeros(r, n)
    wide = replace(
        model,
        A=_blocks((model.A, into_x), (Matrix.zeros(r, n + r),)),
        B=_blocks((model.B,), (Matrix.zeros(r, model.nu),)),
        C=_blocks((model.C, into_y)),
        Q=_blocks((model.Q, above), (below, noise)),
        S=Matrix.zeros(n + r, model.ny),
        c=_blocks((model.c,), (Matrix.zeros(r, 1),)),
        P0=_blocks((model.P0, above), (below, noise)),
        x0=Matrix.zeros(n + r, 1),
        states=(*model.states, *(Signal(f"{prefix}_{j}") for j in range(r))),
    )
    parameters = (*spec.parameters, *(Parameter(name, _TRIED) for name in params))
    family = Filter("kf")
    return replace(spec, model=wide, parameters=parameters, faults=Faults(), filter=family), params


def _blocks(*grid: Sequence[Matrix]) -> Matrix:
    """A matrix of matrices, row by row."""
    rows = (zip(*(block.rows for block in blocks), strict=True) for blocks in grid)
    return Matrix(tuple(tuple(chain(*parts)) for parts in chain(*rows)))


def _paired_response(scenario: _Scenario, runs: int, seed: int) -> FaultEffect:
    """The effect on any filter by simulated pairs; pair m of a seed has its own stream."""
    whole("runs", runs, least=2, expected="a number of pairs, at least 2")
    spec, anomaly = scenario.spec, scenario.anomaly
    system = scenario.system(spec.first_rates)  # refuses what no record can be drawn from
    streams = [np.random.SeedSequence((seed, m)) for m in range(runs)]

    def measured(u: Array) -> Array:  # with the same noise, whatever u is
        rngs = map(np.random.default_rng, streams)
        drawn = [draw_record(spec, scenario.params, u, rng)[0] for rng in rngs]
        return np.where(scenario.missing, np.nan, drawn)

    healthy = measured(scenario.u)
    faulty, plant = healthy, np.zeros((*healthy.shape[:2], system.nx))
    if scenario.mode != "filter" and anomaly.any():
        if spec.faults.jump is not None:
            given = f"an input fault under the family {spec.filter.family}"
            expected = "faults of sensors: its plant jumps itself"
            raise DataError("input", given=given, expected=expected)
        faulty, quiet = measured(scenario.u + anomaly), _silent(system)
        plant = np.array([simulate(quiet, anomaly, np.random.default_rng(s)) for s in streams])
    return _difference(scenario, healthy, faulty, plant)


def _silent(system: LinearSystem) -> LinearSystem:
    """The plant from rest, without noise, measuring every state; the same commands are lost."""
    zeros = {name: np.zeros_like(getattr(system, name)) for name in ("Q", "c", "x0", "P0")}
    rows = (("d", system.c), ("D", system.B), ("R", system.A))
    zeros |= {name: np.zeros_like(like) for name, like in rows}
    return replace(system, C=np.broadcast_to(np.eye(system.nx), system.A.shape), **zeros)


def _differenced_response(scenario: _Scenario) -> FaultEffect:
    """The effect of a sensor fault on a filter that is linear in y: by one pair, y = 0."""
    y = np.where(scenario.missing, np.nan, 0.0)[np.newaxis]
    return _difference(scenario, y, y, np.zeros((*y.shape[:2], scenario.spec.model.nx)))


def _simulated_response(scenario: _Scenario, runs: int, seed: int) -> FaultEffect:
    """The effect on a plant with f and h: by pairs of trials, each with its own state."""
    whole("runs", runs, least=2, expected="a number of pairs, at least 2")
    spec, told = scenario.spec, scenario.spec.filter.traits.told
    for item in told:
        if (scenario.params[item.name] != item.default).any():
            expected = f"{item.default:g} at all samples: pairs are drawn with working sensors"
            raise DataError(f"params.{item.name}", given="other values", expected=expected)
    truth = replace(spec, faults=Faults()) if told else spec
    params = {item.name: scenario.params[item.name] for item in spec.stated_parameters}
    built, states = _with_ports(spec), spec.model.states

    def run(u: Array, known: Array, added: Array) -> tuple[Run, Array]:
        inputs = u if u.shape[1] else None
        drawn = draw_trials(truth, runs, len(added), seed, inputs, params=params)
        y = np.where(scenario.missing, np.nan, drawn.y) + added
        found = _run(built, y, known, scenario.params)
        return found, errors_of(states, drawn.state, found.filtered_state)

    moved = scenario.u if scenario.mode == "filter" else scenario.u + scenario.anomaly
    before, healthy = run(scenario.u, scenario.u, np.zeros_like(scenario.sensor))
    after, faulty = run(moved, scenario.known_inputs, scenario.sensor)
    change = errors_of(states, after.filtered_state, before.filtered_state)
    innovation = after.innovation - before.innovation
    wraps = [row for row, each in enumerate(spec.model.outputs) if each.wrap]
    innovation[..., wraps] = reduced(innovation[..., wraps])
    return FaultEffect(
        state_deviation=change.mean(axis=0),
        error_deviation=(faulty - healthy).mean(axis=0),
        innovation_deviation=innovation.mean(axis=0),
        noncentrality=(after.nis - before.nis).mean(axis=0),
        state_sd=_deviation(after),
        degrees=np.sum(~scenario.missing, axis=1),
        kind="paired",
        standard_error=change.std(axis=0, ddof=1) / np.sqrt(runs),
        runs=runs,
        gaussian=False,
    )


def _with_ports(spec: Spec) -> CompiledFilter:
    """The filter, which has to have the ports that say what a fault does."""
    built = build(spec)
    lacking = [name for name in _PORTS if name not in built.ports]
    if lacking:
        expected = f"a family with the ports {', '.join(_PORTS)}"
        given = f"{spec.filter.family}, which has no {lacking[0]}: the question has no answer there"
        raise DataError("fault_effect", given=given, expected=expected)
    return built


def _difference(scenario: _Scenario, healthy: Array, faulty: Array, plant: Array) -> FaultEffect:
    """The mean over M pairs of records (M, T, p), or what one pair says exactly."""
    runs, built = len(healthy), _with_ports(scenario.spec)
    before = _run(built, healthy, scenario.u, scenario.params)
    after = _run(built, faulty + scenario.sensor, scenario.known_inputs, scenario.params)
    change = after.filtered_state - before.filtered_state
    innovation = (after.innovation - before.innovation).mean(axis=0)
    if runs > 1:
        seen = (after.nis - before.nis).mean(axis=0)
        error = change.std(axis=0, ddof=1) / np.sqrt(runs)
    else:
        there, moved = ~np.isnan(innovation), np.nan_to_num(innovation)
        both = there[:, :, np.newaxis] & there[:, np.newaxis, :]
        S = np.where(both, after.innovation_covariance[0], 0.0)
        seen = np.einsum("ti,tij,tj->t", moved, np.linalg.pinv(S, hermitian=True), moved)
        error = np.zeros_like(change[0])
    return FaultEffect(
        state_deviation=change.mean(axis=0),
        error_deviation=(plant - change).mean(axis=0),
        innovation_deviation=innovation,
        noncentrality=seen,
        state_sd=_deviation(after),
        degrees=np.sum(~scenario.missing, axis=1),
        kind="paired" if runs > 1 else "exact",
        standard_error=error,
        runs=runs if runs > 1 else 0,
        gaussian=False,
    )
