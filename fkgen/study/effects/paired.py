"""The effect of a fault by two runs, with and without it, that differ in nothing else.

A filter that is linear in y but whose gains depend on u and x0 needs one pair, of any record. Where
the filter is not linear, pairs are simulated, and the answer is their mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.oracle.plants.actuator import simulate
from fkgen.oracle.sampled import draw_record
from fkgen.pipeline import build
from fkgen.problem import Code
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.record import whole
from fkgen.runtime.results import Run
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.effects.scenario import FaultScenario

Array = NDArray[np.float64]

#: Pairs, unless somebody asks for more: the standard error is then a sixteenth of the spread.
RUNS = 256

_PORTS = ("filtered_state", "filtered_covariance", "innovation", "innovation_covariance", "nis")


def paired_response(scenario: FaultScenario, runs: int, seed: int) -> FaultEffect:
    """The effect on any filter by simulated pairs; pair m of a seed has its own stream."""
    whole("runs", runs, least=2, expected="a number of pairs, at least 2")
    spec, anomaly = scenario.spec, scenario.anomaly
    built = _built(scenario)
    scenario.system(spec.first_rates)  # refuses what no record can be drawn from
    streams = [np.random.SeedSequence((seed, m)) for m in range(runs)]
    healthy = np.array([_measured(scenario, scenario.u, each) for each in streams])
    faulty, plant = healthy, np.zeros((runs, scenario.samples, spec.model.nx))
    if scenario.mode != "filter" and anomaly.any():
        driven = scenario.u + anomaly
        faulty = np.array([_measured(scenario, driven, each) for each in streams])
        plant = np.array([_moved(scenario, each) for each in streams])
    before = _run(built, healthy, scenario.u, scenario)
    after = _run(built, faulty + scenario.sensor, scenario.known_inputs, scenario)
    change = after.filtered_state - before.filtered_state
    return replace(
        _difference(scenario, before, after, plant),
        standard_error=change.std(axis=0, ddof=1) / np.sqrt(runs),
        kind="paired",
        runs=runs,
    )


def differenced_response(scenario: FaultScenario) -> FaultEffect:
    """The effect of a sensor fault on a filter that is linear in y: by one pair, y = 0."""
    built = _built(scenario)
    healthy = np.where(scenario.missing, np.nan, np.zeros_like(scenario.sensor))[np.newaxis]
    before = _run(built, healthy, scenario.u, scenario)
    after = _run(built, healthy + scenario.sensor, scenario.known_inputs, scenario)
    effect = _difference(scenario, before, after, np.zeros_like(before.filtered_state))
    S = after.innovation_covariance[0]
    exact = np.array(list(map(_quadratic, effect.innovation_deviation, S)))
    return replace(effect, noncentrality=exact)


def _built(scenario: FaultScenario) -> CompiledFilter:
    spec = scenario.spec
    built = build(replace(spec, code=Code("double", spec.code.update)))
    lacking = [name for name in _PORTS if name not in built.ports]
    if lacking:
        expected = f"a family with the ports {', '.join(_PORTS)}"
        given = f"{spec.filter.family}, which has no {lacking[0]}: the question has no answer there"
        raise DataError("fault_effect", given=given, expected=expected)
    return built


def _measured(scenario: FaultScenario, u: Array, stream: np.random.SeedSequence) -> Array:
    """One record of the plant, (T, p); the same stream gives the same noise, whatever u is."""
    spec, T = scenario.spec, scenario.samples
    given = {**spec.defaults, **scenario.params}
    params = {n: np.broadcast_to(np.asarray(v, dtype=float), (T,)) for n, v in given.items()}
    y, _ = draw_record(spec, params, u, np.random.default_rng(stream))
    y[scenario.missing] = np.nan
    return np.asarray(y)


def _moved(scenario: FaultScenario, stream: np.random.SeedSequence) -> Array:
    """What an input anomaly changes in the state, (T, n): the same commands are lost as in y."""
    spec, T = scenario.spec, scenario.samples
    if spec.faults.jump is not None:
        given = f"an input fault under the family {spec.filter.family}"
        raise DataError("input", given=given, expected="faults of sensors: its plant jumps itself")
    system = scenario.system(spec.first_rates)
    n = system.nx
    quiet = replace(
        system,
        C=np.broadcast_to(np.eye(n), (T, n, n)),
        D=np.zeros((T, n, system.nu)),
        Q=np.zeros_like(system.Q),
        R=np.zeros((T, n, n)),
        x0=np.zeros(n),
        P0=np.zeros((n, n)),
    )
    return np.asarray(simulate(quiet, scenario.anomaly, np.random.default_rng(stream)))


def _run(built: CompiledFilter, y: Array, u: Array, scenario: FaultScenario) -> Run:
    given = u if scenario.spec.model.nu else None
    run = built.run_batch(y, given, scenario.params, keep=_PORTS)
    if run.refused.any():
        k = int(np.argmax(run.refused.any(axis=0)))
        expected = f"at most {k}: the filter refuses sample {k}, where numbers overflow"
        raise DataError("steps", given=f"{scenario.samples} samples", expected=expected)
    return run


def _difference(scenario: FaultScenario, before: Run, after: Run, plant: Array) -> FaultEffect:
    """The mean difference of the runs of all pairs, as if it were exact."""
    change = after.filtered_state - before.filtered_state
    variance = np.diagonal(after.filtered_covariance, axis1=-2, axis2=-1).mean(axis=0)
    return FaultEffect(
        state_deviation=change.mean(axis=0),
        error_deviation=(plant - change).mean(axis=0),
        innovation_deviation=(after.innovation - before.innovation).mean(axis=0),
        noncentrality=(after.nis - before.nis).mean(axis=0),
        state_sd=np.sqrt(np.maximum(variance, 0.0)),
        degrees=np.sum(~scenario.missing, axis=1),
        kind="exact",
        standard_error=0.0 * change[0],
        gaussian=False,
    )


def _quadratic(deviation: Array, covariance: Array) -> float:
    rows = np.flatnonzero(~np.isnan(deviation))
    if not rows.size:
        return 0.0
    each = deviation[rows]
    return float(each @ np.linalg.pinv(covariance[np.ix_(rows, rows)], hermitian=True) @ each)
