"""Closed forms for compression filters: joint distributions, window by window and as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np

from fkgen.errors import InternalError
from fkgen.faults import SoftFaults
from fkgen.oracle.claims.claim import Array, ClosedForm, Record
from fkgen.oracle.claims.gaussian import digits_at_stake, system_of
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.compression import Policy, accepted_rows, batch_compression
from fkgen.problem import Spec

PAPER = "Lee & Lee"

#: The records of a proof are short: their first window ends at this sample.
FIRST = 2

#: By so many standard deviations the host is wrong where everything has to be rejected.
OFF = 30.0

#: So much smaller than P may pivots of P - P* be on the short record of a proof.
FAINT = 1e3


#: Share of a variance below which rounding of the scalar may be all that there is.
NEGLIGIBLE = {"double": 1e-11, "float": 1e-4}


def soft_faults_of(spec: Spec) -> SoftFaults:
    """The soft faults that a family of compression filters must have."""
    soft = spec.faults.soft
    if soft is None:
        raise InternalError("a compression filter without soft faults")
    return soft


def _soon(_: Spec, __: Record) -> Mapping[str, Array]:
    return {"predicted_window_left": np.array([float(FIRST)])}


def contradiction(spec: Spec, record: Record) -> Array:
    """A start that the rows of y contradict."""
    x0 = spec.model.x0.values().ravel()
    return np.asarray(x0 + OFF * np.sqrt(np.diag(record.P0)))


def _windows(spec: Spec, record: Record, start: Array | None = None) -> Mapping[str, Array]:
    options = spec.filter.options
    policy = Policy(
        first=FIRST,
        test=options.test,
        reacquire=options.reacquire,
        negligible=NEGLIGIBLE[spec.code.scalar],
    )
    law, system = soft_faults_of(spec), system_of(spec, record)
    if start is not None:
        system = replace(system, x0=start)
    result = batch_compression(system, law, policy, record.y, record.u)
    ports = {f.name: getattr(result, f.name) for f in fields(result) if f.name != "faintest"}
    if len(law.groups) == 1:
        single = ("test_statistic", "test_dof", "fault_declared")
        for name in (*single, "compression_deviation", "compression_covariance"):
            ports[name] = ports[name][:, 0]
    return ports


def _statistic_tolerance(spec: Spec, record: Record) -> float:
    """D = P - P* carries rounding of the size of P; the statistic divides by its pivots."""
    return FAINT * digits_at_stake(spec, record)


WINDOWS = ClosedForm(
    claim="host, compression filters, statistic and verdicts are those of the joint distribution of"
    " each window",
    source=f"{PAPER}, Theorems 2 and 3, eqs. (50), (51)",
    tolerance=_statistic_tolerance,
    expected=_windows,
    start=_soon,
)


def _soon_and_off(spec: Spec, record: Record) -> Mapping[str, Array]:
    return {**_soon(spec, record), "predicted_state": contradiction(spec, record)}


def _rejected(spec: Spec, record: Record) -> Mapping[str, Array]:
    return _windows(spec, record, contradiction(spec, record))


REJECTED = ClosedForm(
    claim="the same where the rows contradict the host, and are rejected if they are tested",
    source=f"{PAPER}, eqs. (50), (51)",
    tolerance=_statistic_tolerance,
    expected=_rejected,
    start=_soon_and_off,
)


def _accepted(spec: Spec, record: Record) -> Mapping[str, Array] | None:
    """After the window the host is the filter of all rows, if the test lets them pass."""
    windows = _windows(spec, record)
    if np.any(windows["fault_declared"]):
        return None
    law, system, T = soft_faults_of(spec), system_of(spec, record), len(record.y)
    ends = list(range(FIRST, T, law.window))
    names = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
    pieces: list[Mapping[str, Array]] = []
    for done, begin in enumerate([0, *ends]):
        flags = np.ones((done, len(law.groups)), bool)
        seen = accepted_rows(law, record.y, ends[:done], flags)
        found = batch_lmmse(system, seen, record.u)
        part = slice(begin, [*ends, T][done])
        pieces.append({name: getattr(found, name)[part] for name in names})
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


ACCEPTED = ClosedForm(
    claim="the host that accepts a window is the Kalman filter that took every row",
    source=f"{PAPER}, Theorems 2 and 3: the best linear estimate of the whole record",
    tolerance=digits_at_stake,
    expected=_accepted,
    start=_soon,
)
