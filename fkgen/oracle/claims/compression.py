"""Closed forms for compression filters: joint distributions, errors in primitive noises."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from fkgen.errors import InternalError
from fkgen.faults import SoftFaults
from fkgen.faults.partial_state import similarity, typical_deviation
from fkgen.oracle.claims.claim import ClosedForm, Ports, Record, ports
from fkgen.oracle.claims.gaussian import digits_at_stake, system_of, undecided
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.compression import Policy, accepted_rows, batch_compression, only
from fkgen.oracle.exact.partial_compression import PartialCompression, partial_compression
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.problem import Spec

PAPER = "Lee & Lee"

#: The records of a proof are short: their first window ends at this sample; a partial filter's at
#: `FIRST_END`, if the window of the spec is longer.
FIRST, FIRST_END = 2, 4

#: By so many standard deviations the host is wrong where everything has to be rejected.
OFF = 30.0

#: So much smaller than P may pivots of P - P* be on the short record of a proof.
FAINT = 1e3

#: Share of a variance below which rounding of the scalar may be all that there is, where P - P* is
#: a difference; in factors it is that of double.
NEGLIGIBLE = {"double": 1e-11, "float": 1e-4}


def _soft(spec: Spec) -> SoftFaults:
    soft = spec.faults.soft
    if soft is None:
        raise InternalError("a compression filter without soft faults")
    return soft


def _first_end(spec: Spec) -> int:
    whole = spec.filter.traits.windows == "full"
    return FIRST if whole else min(_soft(spec).window, FIRST_END)


def _start(spec: Spec, record: Record, *, off: bool) -> Ports:
    """A window that ends soon, and maybe a prior that the rows of y contradict."""
    left = {"predicted_window_left": np.array([float(_first_end(spec))])}
    return left | {"predicted_state": _system(spec, record, off=off).x0} if off else left


def _system(spec: Spec, record: Record, *, off: bool) -> LinearSystem:
    system = system_of(spec, record)
    return replace(system, x0=system.x0 + off * OFF * np.sqrt(np.diag(record.P0)))


def _windows(spec: Spec, record: Record, *, off: bool = False) -> Ports:
    options, law = spec.filter.options, _soft(spec)
    policy = Policy(
        first=FIRST,
        test=options.test,
        reacquire=options.reacquire,
        negligible=NEGLIGIBLE["double" if spec.code.update == "ud" else spec.code.scalar],
    )
    system = _system(spec, record, off=off)
    found = ports(batch_compression(system, law, policy, record.y, record.u), "faintest")
    if len(law.groups) == 1:
        single = ("test_statistic", "test_dof", "fault_declared")
        for name in (*single, "compression_deviation", "compression_covariance"):
            found[name] = found[name][:, 0]
    return found


def _accepted(spec: Spec, record: Record) -> Ports | None:
    """After the window the host is the filter of all rows, if the test lets them pass."""
    windows = _windows(spec, record)
    if np.any(windows["fault_declared"]):
        return None
    law, system, T = _soft(spec), system_of(spec, record), len(record.y)
    ends = list(range(FIRST, T, law.window))
    names = ("filtered_state", "filtered_covariance", "predicted_state", "predicted_covariance")
    pieces: list[Ports] = []
    for done, begin in enumerate([0, *ends]):
        flags = np.ones((done, len(law.groups)), bool)
        seen = accepted_rows(law, record.y, ends[:done], flags)
        found = batch_lmmse(system, seen, record.u)
        part = slice(begin, [*ends, T][done])
        pieces.append({name: getattr(found, name)[part] for name in names})
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def design_of(spec: Spec, first: int) -> PartialCompression:
    """What the spec says about host and compression filter, with a first window of its own."""
    soft, options = _soft(spec), spec.filter.options
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


def _primitive(spec: Spec, record: Record, *, off: bool = False) -> Ports:
    system, design = _system(spec, record, off=off), design_of(spec, _first_end(spec))
    return ports(partial_compression(system, design, record.y, record.u), *undecided(spec))


def _host(spec: Spec, record: Record) -> Ports:
    """The samples before the first window ends."""
    samples = _first_end(spec)
    y = only(record.y[:samples], _soft(spec).host)
    result = batch_lmmse(system_of(spec, record).over(slice(samples)), y, record.u[:samples])
    names = ("filtered_state", "filtered_covariance", "innovation_covariance", "nis")
    return {name: getattr(result, name) for name in names}


def _statistic_tolerance(spec: Spec, record: Record) -> float:
    """D = P - P* carries rounding of the size of P; the statistic divides by its pivots."""
    return FAINT * digits_at_stake(spec, record)


_SOON, _SOON_AND_OFF = partial(_start, off=False), partial(_start, off=True)

WINDOWS = ClosedForm(
    claim="host, compression filters, statistic and verdicts are those of the joint distribution of"
    " each window",
    source=f"{PAPER}, Theorems 2 and 3, eqs. (50), (51)",
    tolerance=_statistic_tolerance,
    expected=_windows,
    start=_SOON,
)
REJECTED = ClosedForm(
    claim="the same where the rows contradict the host, and are rejected if they are tested",
    source=f"{PAPER}, eqs. (50), (51)",
    tolerance=_statistic_tolerance,
    expected=partial(_windows, off=True),
    start=_SOON_AND_OFF,
)
ACCEPTED = ClosedForm(
    claim="the host that accepts a window is the Kalman filter that took every row",
    source=f"{PAPER}, Theorems 2 and 3: the best linear estimate of the whole record",
    tolerance=digits_at_stake,
    expected=_accepted,
    start=_SOON,
)
PRIMITIVE_NOISES = ClosedForm(
    claim="P, R and S are the moments of errors that are written out in the primitive noises",
    source=f"{PAPER}, Theorem 4 and (40), (D1)-(D4); no recursion for a covariance",
    tolerance=digits_at_stake,
    expected=_primitive,
    start=_SOON,
)
CONTRADICTED = replace(
    REJECTED,
    source=f"{PAPER}, (50), (51)",
    tolerance=digits_at_stake,
    expected=partial(_primitive, off=True),
)
HOST_ALONE = ClosedForm(
    claim="until a window ends, the host is the Kalman filter of its own rows",
    source="linear minimum mean square error estimate from second moments",
    tolerance=digits_at_stake,
    expected=_host,
    start=_SOON,
)
