"""Does the filter keep its digits from the prior on: the recursion in float beside that in double.

Both run, statement by statement, over one record that is drawn from the spec: the start from the
prior, with its vague covariances, is where float loses most, and no bound at rest shows it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fkgen.backend.execute import Machine, self_test_vectors
from fkgen.backend.lower import lower, unfit_spec
from fkgen.errors import UnfitError
from fkgen.families import family
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Spec
from fkgen.problem.code import Scalar
from fkgen.study.diagnostics.subject import Array, Subject
from fkgen.trials.errors import error_sizes, errors_of

SAMPLES = 1000

#: y (T, p), u (T, q), and parameters by name, (T,) each.
_Record = tuple[Array, Array, dict[str, Array]]

#: Share of a standard deviation that rounding may take without anybody noticing, and beyond which
#: the estimate is another one.
_SMALL, _LOST = 0.1, 1.0


def start(model: Subject) -> None:
    """Run the self-test; hold the filter in float against itself in double, from the prior on."""
    try:
        self_test_vectors(lower(family(model.spec.filter.family).build(model.spec)))
    except UnfitError as unfit:
        remedy = unfit_spec(model.spec, unfit).expected
        model.add("start.unfit", what=unfit.what, scalar=model.spec.code.scalar, remedy=remedy)
    if not model.is_float:
        return
    record = _drawn(model.spec)
    found = _estimates(model.spec, "float", record)
    exact = _estimates(model.spec, "double", record)
    alike = exact.accepted & found.accepted
    refused = np.flatnonzero(exact.accepted & ~found.accepted)
    if refused.size:
        model.add("start.refused", refused.size, samples=SAMPLES, first=int(refused[0]))
    below = (found.variance < np.minimum(exact.variance, 0.0)).any(axis=1)
    negative = np.flatnonzero(alike & below)
    if negative.size:
        model.add("start.negative", negative.size, samples=SAMPLES, first=int(negative[0]))
    deviation = np.sqrt(np.maximum(exact.variance, 0.0))
    states = model.spec.model.states
    apart = np.abs(errors_of(states, found.state, exact.state))
    off = np.maximum(apart - 2.0 * error_sizes(states, _spacing(exact.state)), 0.0)
    shares = np.divide(off, deviation, out=np.zeros_like(off), where=deviation > 0.0)
    shares[~alike] = 0.0
    at, worst = np.unravel_index(int(np.argmax(shares)), shares.shape)
    share = float(shares[at, worst])
    model.values["float_start_to_sd"] = share
    code = "start.lost" if share > _LOST else "start.off" if share > _SMALL else "start"
    if code != "start" or not refused.size:
        model.add(code, share, name=model.states[worst], at=int(at), samples=SAMPLES)


@dataclass(frozen=True, slots=True, eq=False)
class _Estimates:
    """Filtered states (T, n) and their variances (T, ne), and which samples were accepted, (T,)."""

    state: Array
    variance: Array
    accepted: Any


def _spacing(values: Array) -> Array:
    """Units in the last place of float."""
    return np.spacing(np.abs(values).astype(np.float32)).astype(float)


def _drawn(spec: Spec) -> _Record:
    """A record of the plant: y, u and parameters."""
    rng = np.random.default_rng(20130905)
    u = rng.normal(size=(SAMPLES, spec.model.nu))
    stated = {each.name: np.full(SAMPLES, each.default) for each in spec.stated_parameters}
    with np.errstate(all="ignore"):
        y, parameters = draw_record(spec, stated, u, rng)
    return y, u, parameters


def _estimates(spec: Spec, scalar: Scalar, record: _Record) -> _Estimates:
    """Run the filter of a spec in one scalar type over a record."""
    asked = spec.code.ports
    ports = None if asked is None else (*asked, "filtered_covariance")
    code = replace(spec.code, scalar=scalar, ports=ports)
    machine = Machine(lower(family(spec.filter.family).build(replace(spec, code=code))))
    y, u, parameters = record
    n, ne = spec.model.nx, spec.model.ne
    diagonal = [i * (i + 3) // 2 for i in range(ne)]
    state, variance, accepted = np.zeros((SAMPLES, n)), np.zeros((SAMPLES, ne)), []
    # what float rounds of y is no defect of the filter: both are given the same numbers
    measured = y.astype(np.float32).astype(float)
    driven = u.astype(np.float32).astype(float)
    for k in range(SAMPLES):
        told = {name: float(values[k]) for name, values in parameters.items()}
        accepted.append(machine.step(driven[k], measured[k], told).value >= 0)
        state[k] = machine.ports["filtered_state"]
        variance[k] = np.array(machine.ports["filtered_covariance"])[diagonal]
    return _Estimates(state, variance, np.array(accepted, bool))
