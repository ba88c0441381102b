"""Closed forms for the partial compression filter: errors in primitive noises, the host alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from fkgen.faults.partial_state import similarity, typical_deviation
from fkgen.oracle.claims.claim import Array, ClosedForm, Record
from fkgen.oracle.claims.compression import contradiction, soft_faults_of
from fkgen.oracle.claims.gaussian import digits_at_stake, has_exact_rows, system_of
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.partial_compression import PartialCompression, partial_compression
from fkgen.problem import Spec

#: Sample of a short record at which its first window ends, if the window of the spec is longer.
FIRST_END = 4


def _first_end(spec: Spec) -> int:
    return min(soft_faults_of(spec).window, FIRST_END)


def _countdown(spec: Spec, _: Record) -> Mapping[str, Array]:
    return {"predicted_window_left": np.array([float(_first_end(spec))])}


def design_of(spec: Spec, first: int) -> PartialCompression:
    """What the spec says about host and compression filter, with a first window of its own."""
    soft, options = soft_faults_of(spec), spec.filter.options
    rows = spec.model.C.values(spec.defaults)[list(soft.compressed)]
    return PartialCompression(
        host=soft.host,
        T=similarity(rows, typical_deviation(spec.model, spec.defaults)),
        window=soft.window,
        first=first,
        false_alarm=soft.false_alarm if options.test else None,
        maintenance=options.maintenance,
        reacquire=options.reacquire,
    )


def _primitive(spec: Spec, record: Record, start: Array | None = None) -> Mapping[str, Array]:
    system = system_of(spec, record)
    if start is not None:
        system = dataclasses.replace(system, x0=start)
    result = partial_compression(system, design_of(spec, _first_end(spec)), record.y, record.u)
    ports = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    if has_exact_rows(spec):  # a density on a subspace depends on the coordinates chosen there
        del ports["log_likelihood"]
    return ports


PRIMITIVE_NOISES = ClosedForm(
    claim="P, R and S are the moments of errors that are written out in the primitive noises",
    source="Lee & Lee, Theorem 4 and (40), (D1)-(D4); no recursion for a covariance",
    tolerance=digits_at_stake,
    expected=_primitive,
    start=_countdown,
)


def _countdown_and_off(spec: Spec, record: Record) -> Mapping[str, Array]:
    return {**_countdown(spec, record), "predicted_state": contradiction(spec, record)}


def _contradicted(spec: Spec, record: Record) -> Mapping[str, Array]:
    return _primitive(spec, record, contradiction(spec, record))


CONTRADICTED = ClosedForm(
    claim="the same where the rows contradict the host, and are rejected if they are tested",
    source="Lee & Lee, (50), (51)",
    tolerance=digits_at_stake,
    expected=_contradicted,
    start=_countdown_and_off,
)


def _host(spec: Spec, record: Record) -> Mapping[str, Array]:
    """The samples before the first window ends."""
    samples, others = _first_end(spec), list(soft_faults_of(spec).compressed)
    y = record.y[:samples].copy()
    y[:, others] = np.nan
    result = batch_lmmse(system_of(spec, record).first(samples), y, record.u[:samples])
    names = ("filtered_state", "filtered_covariance", "innovation_covariance", "nis")
    return {name: getattr(result, name) for name in names}


HOST_ALONE = ClosedForm(
    claim="until a window ends, the host is the Kalman filter of its own rows",
    source="linear minimum mean square error estimate from second moments",
    tolerance=digits_at_stake,
    expected=_host,
    start=_countdown,
)
