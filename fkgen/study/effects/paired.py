"""The effect of a fault by two runs, with and without it, that differ in nothing else.

A filter that is linear in y but whose gains depend on u and x0 needs one pair, of any record. Where
the filter is not linear, pairs are simulated, and the answer is their mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.oracle import draw_record, simulate
from fkgen.pipeline import build
from fkgen.problem import Code, Spec
from fkgen.problem.numbers import whole
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.effects.effect import FaultEffect, Kind
from fkgen.study.effects.question import Question

Array = NDArray[np.float64]

#: Pairs, unless somebody asks for more: the standard error is then a sixteenth of the spread.
RUNS = 256

_PORTS = ("filtered_state", "filtered_covariance", "innovation", "innovation_covariance", "nis")


def paired_response(question: Question, runs: int, seed: int) -> FaultEffect:
    """Answer a question about any family by simulated pairs.

    Parameters
    ----------
    question : Question
    runs, seed : int
        Number of pairs, and where their random numbers start: pair m has its own stream.

    Raises
    ------
    DataError
        If the filter refuses a sample, or the plant of the family cannot be driven here.
    """
    whole("runs", runs, least=2, expected="a number of pairs, at least 2")
    built = _built(question.spec)
    question.system(question.spec.first_rates)  # refuses what no record can be drawn from
    reached = question.mode != "filter" and bool(question.anomaly.any())
    streams = [np.random.SeedSequence((seed, m)) for m in range(runs)]
    arrived = question.anomaly if reached else np.zeros_like(question.anomaly)
    healthy = np.array([_measured(question, question.u, each) for each in streams])
    faulty = healthy
    if reached:
        driven = question.u + arrived
        faulty = np.array([_measured(question, driven, each) for each in streams])
    plant = np.zeros((runs, question.samples, question.spec.model.nx))
    if reached:
        plant = np.array([_moved(question, arrived, each) for each in streams])
    before = _run(built, healthy, question.u, question)
    after = _run(built, faulty + question.sensor, question.told, question)
    return _difference(question, before, after, plant, "paired")


def differenced_response(question: Question) -> FaultEffect:
    """Answer a question about a sensor fault under a filter that is linear in y: one pair, y = 0.

    Raises
    ------
    DataError
        If the filter refuses a sample.
    """
    built = _built(question.spec)
    healthy = np.where(question.missing, np.nan, np.zeros_like(question.sensor))[np.newaxis]
    before = _run(built, healthy, question.u, question)
    after = _run(built, healthy + question.sensor, question.told, question)
    plant = np.zeros((1, question.samples, question.spec.model.nx))
    return _difference(question, before, after, plant, "exact")


def _built(spec: Spec) -> CompiledFilter:
    built = build(replace(spec, code=Code("double", spec.code.update)))
    lacking = [name for name in _PORTS if name not in built.ports]
    if lacking:
        expected = f"a family with the ports {', '.join(_PORTS)}"
        given = f"{spec.filter.family}, which has no {lacking[0]}: the question has no answer there"
        raise DataError("fault_effect", given=given, expected=expected)
    return built


def _measured(question: Question, u: Array, stream: np.random.SeedSequence) -> Array:
    """One record of the plant, (T, p); the same stream gives the same noise, whatever u is."""
    spec, T = question.spec, question.samples
    given = {**spec.defaults, **question.params}
    params = {n: np.broadcast_to(np.asarray(v, dtype=float), (T,)) for n, v in given.items()}
    y, _ = draw_record(spec, params, u, np.random.default_rng(stream))
    y[question.missing] = np.nan
    return np.asarray(y)


def _moved(question: Question, anomaly: Array, stream: np.random.SeedSequence) -> Array:
    """What an input anomaly changes in the state, (T, n): the same commands are lost as in y."""
    spec, T = question.spec, question.samples
    if spec.faults.jump is not None:
        given = f"an input fault under the family {spec.filter.family}"
        raise DataError("input", given=given, expected="faults of sensors: its plant jumps itself")
    system = question.system(spec.first_rates)
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
    return np.asarray(simulate(quiet, anomaly, np.random.default_rng(stream)))


def _run(built: CompiledFilter, y: Array, u: Array, question: Question) -> Run:
    given = u if question.spec.model.nu else None
    run = built.run_batch(y, given, question.params, keep=_PORTS)
    if run.refused.any():
        k = int(np.argmax(run.refused.any(axis=0)))
        expected = f"at most {k}: the filter refuses sample {k}, where numbers overflow"
        raise DataError("steps", given=f"{question.samples} samples", expected=expected)
    return run


def _difference(
    question: Question, before: Run, after: Run, plant: Array, kind: Kind
) -> FaultEffect:
    change = after.filtered_state - before.filtered_state
    innovation = (after.innovation - before.innovation).mean(axis=0)
    if kind == "exact":
        S = after.innovation_covariance[0]
        noncentrality = np.array(list(map(_quadratic, innovation, S)))
    else:
        noncentrality = (after.nis - before.nis).mean(axis=0)
    variance = np.diagonal(after.filtered_covariance, axis1=-2, axis2=-1).mean(axis=0)
    count = len(change)
    spread = change.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else 0.0 * change[0]
    return FaultEffect(
        state_deviation=change.mean(axis=0),
        error_deviation=(plant - change).mean(axis=0),
        innovation_deviation=innovation,
        noncentrality=noncentrality,
        state_sd=np.sqrt(np.maximum(variance, 0.0)),
        degrees=np.sum(~question.missing, axis=1),
        kind=kind,
        standard_error=spread,
        runs=count if kind == "paired" else 0,
        gaussian=False,
    )


def _quadratic(deviation: Array, covariance: Array) -> float:
    rows = np.flatnonzero(~np.isnan(deviation))
    if not rows.size:
        return 0.0
    each = deviation[rows]
    return float(each @ np.linalg.pinv(covariance[np.ix_(rows, rows)], hermitian=True) @ each)
