"""Closed forms of filters that linearise: matrices in NumPy, derivatives by dual numbers.

`EXTENDED`, `ITERATED` and `UNSCENTED` are about any plant; the others, of families that have closed
forms of their own where the plant is linear, about plants by equations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from fkgen.oracle.claims.claim import Array, ClosedForm, Ports, Record
from fkgen.oracle.claims.gaussian import (
    BATCH,
    EXACT,
    RANK_DEFICIENT,
    delays_of,
    has_exact_rows,
    undecided,
)
from fkgen.oracle.claims.sensor import PAPER as SENSOR_PAPER
from fkgen.oracle.claims.sensor import law_of
from fkgen.oracle.plants.actuator import actuation_of
from fkgen.oracle.plants.equations import is_nonlinear, system_of
from fkgen.oracle.plants.jump import chain_of
from fkgen.oracle.plants.nonlinear import NonlinearSystem
from fkgen.oracle.textbook.nonlinear import Extended, Iterated, Unscented
from fkgen.oracle.textbook.nonlinear_modes import (
    Hypotheses,
    Modes,
    sensor_modes,
    textbook_bank,
    textbook_gpb1,
    textbook_interacting,
)
from fkgen.problem import Spec

Run: TypeAlias = Callable[[Spec, Record], dict[str, Array]]

#: What S beside R costs: some hundred roundings of every entry.
LOST_DIGITS = 1e3 * float(np.finfo(float).eps)

#: Weights are exponentials: they lose the digits that the exponent has before the point.
WEIGHTS = 1e2

#: How many times its size a step that rounding decides on is seen in what follows.
STEP = 10.0


def _system(spec: Spec, record: Record) -> NonlinearSystem:
    """The plant of a record, with the record's prior, as it is where faults are told."""
    system = system_of(spec, len(record.y), record.parameters, P0=record.P0)
    faults = spec.faults.sensor
    if faults is None or not spec.filter.traits.told:
        return system
    gamma, delta = (np.asarray(record.parameters[name]) for name in ("gamma", "delta"))
    return system.told(faults.rows, gamma, delta)


def _gate(spec: Spec) -> tuple[float, bool] | None:
    probability = spec.filter.option("gate", None)
    return None if probability is None else (probability, spec.filter.options.gate_by == "sample")


def _extended(spec: Spec, record: Record) -> dict[str, Array]:
    rate, covariance = actuation_of(spec, len(record.y), record.parameters)
    random = {} if spec.faults.actuator is None else {"rate": rate, "fault_covariance": covariance}
    system = _system(spec, record)
    return Extended(system=system, gate=_gate(spec), **random).run(record.y, record.u)


def _iterated(spec: Spec, record: Record) -> dict[str, Array]:
    iterations = spec.filter.option("iterations", 3)
    system = _system(spec, record)
    return Iterated(system=system, gate=_gate(spec), iterations=iterations).run(record.y, record.u)


def _unscented(spec: Spec, record: Record) -> dict[str, Array]:
    kappa = spec.filter.option("kappa", 0.0)
    system = _system(spec, record)
    return Unscented(system=system, gate=_gate(spec), kappa=kappa).run(record.y, record.u)


def _bank(spec: Spec, record: Record) -> dict[str, Array]:
    options, system = spec.filter.options, _system(spec, record)
    T = len(record.y)
    found = [actuation_of(spec, T, record.parameters, rates) for rates in options.hypotheses]
    bank = Hypotheses(
        filters=tuple(
            Extended(system=system, rate=rate, fault_covariance=covariance)
            for rate, covariance in found
        ),
        prior=np.array(options.prior),
        weight_floor=options.weight_floor,
        likelihood=options.likelihood,
        one_rate=len(options.hypotheses[0]) == 1,
    )
    return textbook_bank(bank, record.y, record.u)


def _conditions(spec: Spec, record: Record) -> Modes:
    """The modes of a sensor, or of the plant."""
    T, faults = len(record.y), spec.faults.jump
    if faults is None:
        lumped = spec.filter.option("modes", 4) == 3
        return sensor_modes(_system(spec, record), law_of(spec, record), modes=3 if lumped else 4)
    systems = [system_of(spec, T, record.parameters, mode, record.P0) for mode in faults.modes]
    return Modes.of(systems, **chain_of(spec, T, record.parameters))


def _interacting(spec: Spec, record: Record) -> dict[str, Array]:
    """All ports; without the estimates of single modes if one of them is impossible at times."""
    found = textbook_interacting(_conditions(spec, record), record.y, record.u)
    if not (found["mode_probability"].all() and found["predicted_mode_probability"].all()):
        for port in ("mode_state", "mode_covariance"):
            del found[port], found[port.replace("mode", "mode_filtered")]
    return found


def _one_step(spec: Spec, record: Record) -> dict[str, Array]:
    reading = spec.filter.options.covariance
    return textbook_gpb1(_conditions(spec, record), record.y, record.u, covariance=reading)


def _claimed(run: Run) -> Callable[[Spec, Record], Ports | None]:
    """The ports of a run, of a decision that is rounding's only what stands before it."""

    def expected(spec: Spec, record: Record) -> Ports | None:
        if (delays := delays_of(spec, record)) is not None and delays.any():
            return None  # of linear plants, for which the joint distribution says all
        found = dict(run(spec, record))
        for name in undecided(spec):
            found.pop(name, None)
        found.pop("doubt", None)
        decided = found.pop("decided", np.ones(0)) > 0.0
        if "stayed" in found:
            count = len(decided) if decided.all() else int(decided.argmin())
            found["stayed"] = found["stayed"][:count]
        return found

    return expected


def _tolerated(run: Run, factor: float = 1.0) -> Callable[[Spec, Record], float]:
    """What S costs beside R, and a last step of which rounding decided."""

    def tolerance(spec: Spec, record: Record) -> float:
        if has_exact_rows(spec):
            return RANK_DEFICIENT
        found = run(spec, record)
        doubt = float(found["doubt"].max()) if "doubt" in found else 0.0
        return max(factor * max(EXACT, _lost(spec, found)), STEP * doubt)

    def _lost(spec: Spec, found: Mapping[str, Array]) -> float:
        S = np.diagonal(found["innovation_covariance"], axis1=-2, axis2=-1)
        R = [np.diag(plant.R.values(spec.defaults)) for plant in spec.plants]
        return LOST_DIGITS * float(np.max(S / np.min(R, axis=0)))

    return tolerance


def of_equations(form: ClosedForm) -> ClosedForm:
    """The same statement, which says nothing about plants of matrices."""

    def expected(spec: Spec, record: Record) -> Ports | None:
        return form.expected(spec, record) if is_nonlinear(spec) else None

    return replace(form, expected=expected)


def _form(run: Run, claim: str, source: str, factor: float = 1.0) -> ClosedForm:
    run = lru_cache(maxsize=1)(run)  # what is expected, and then how well, is asked of one record
    return ClosedForm(
        claim=claim, source=source, tolerance=_tolerated(run, factor), expected=_claimed(run)
    )


#: Of a linear plant ekf, iekf and ukf are the best linear estimate.
JOINT = BATCH
EXTENDED = _form(
    _extended,
    "estimates are those of matrices, f and h linearised at the estimate by dual numbers",
    "Jazwinski 1970, sec. 8.3",
)
LINEARISED = of_equations(EXTENDED)
ITERATED = _form(
    _iterated,
    "the update is Gauss and Newton's, each step taken where it lowers the cost",
    "Bell & Cathey 1993",
)
UNSCENTED = _form(
    _unscented,
    "moments are those of points, sent through f and h one by one",
    "Julier & Uhlmann 1997; equal weights",
)
LINEARISED_BANK = of_equations(
    _form(
        _bank,
        "estimates and weights are those of extended filters, one for each hypothesis",
        "Strandt, Schneider & Yaz, eqs. (4), (9)-(18), linearised",
        WEIGHTS,
    )
)
LINEARISED_IMM = of_equations(
    _form(
        _interacting,
        "estimates and probabilities are those of interacting extended filters",
        f"Blom & Bar-Shalom 1988; {SENSOR_PAPER}, sec. IV, eqs. (15)-(18), linearised",
        WEIGHTS,
    )
)
LINEARISED_ONE_STEP = of_equations(
    _form(
        _one_step,
        "estimates are those of extended filters, one for each sensor condition, mixed as errors",
        f"{SENSOR_PAPER}, eqs. (3)-(14), linearised",
        WEIGHTS,
    )
)
