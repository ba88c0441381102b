"""Linear optimal filter for measurements that may carry no signal or more noise.

Sigalov & Oshman, sec. V: the best linear filter in terms of E[gamma], p11 and E[delta] (Nahi 1969
and Hadidi & Schwartz 1979 are special cases), exact under Lemma 2; with ``form = "augmented"`` the
best linear filter for any Markov gamma (Costa 1994).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, Self, get_args

import numpy as np

from fkgen.families.family import Family, built_by, by_option, proved_by
from fkgen.faults import Faults, SensorFaults
from fkgen.faults.sensor import is_white, read_sensor_faults
from fkgen.problem import Model, Spec
from fkgen.problem.filter import Options, Traits
from fkgen.problem.finding import Finding
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

LinearForm = Literal["lemma2", "augmented"]

#: Samples after which the errors are compared.
HORIZON = 200

REMEDY = 'filter.form = "augmented", the best linear filter for any Markov gamma, or family = "imm"'


@dataclass(frozen=True, slots=True)
class LinearOptions(Options):
    """The form: ``"lemma2"`` (23) or ``"augmented"``."""

    form: LinearForm = "lemma2"

    @classmethod
    def read(cls, section: Section, _: Faults, __: Model) -> Self:
        """The form, by default that of the paper."""
        return cls(section.choice("form", get_args(LinearForm), "lemma2"))


def check(spec: Spec) -> None:
    """Refuse what equations (23), or their augmented form, do not cover.

    The linear filter has no constant term: a state that is not zero in the mean must not meet a
    gamma that depends on its past. The augmented form needs a law.
    """
    faults, place = spec.faults.sensor, Place(spec.file)
    if faults is None:
        return
    if spec.filter.options.form == "augmented":
        _check_augmented(faults, place.entry("filter").entry("form"))
        return
    if is_white(faults):
        return
    way_out = "filter.form = 'augmented' has one"
    if faults.moments is not None:
        way_out = f"with problem 3 or 4, {way_out}"
    because = f"where gamma depends on its past: the filter has no constant term; {way_out}"
    if not spec.model.x0.is_zero:
        raise place.entry("model").entry("x0").error("a start that is not zero", f"zero {because}")
    if spec.model.nu:
        raise place.entry("model").entry("B").error("known inputs", f"none {because}")
    for key in "cd":
        if not getattr(spec.model, key).is_zero:
            raise place.entry("model").entry(key).error("a known offset", f"none {because}")


def _check_augmented(faults: SensorFaults, place: Place) -> None:
    """Refuse what the augmented form does not cover."""
    if faults.moments is not None:
        given = '"augmented" with problem "moments"'
        raise place.error(given, "a law: problem 1, 2, 3 or 4")
    if faults.law is not None:
        given = '"augmented" with probabilities that depend on parameters'
        expected = '"lemma2", which is exact in problem 1 and 2, or numbers'
        raise place.error(given, expected)


def lemma_2(spec: Spec) -> tuple[Finding, ...]:
    """Sigalov & Oshman, Lemma 2: without it (23) is neither the LMMSE nor knows its error."""
    from fkgen.oracle.claims.sensor import lemma_2_holds
    from fkgen.oracle.exact.moments import satisfies_lemma_2
    from fkgen.oracle.plants.sensor import SensorLaw

    faults = spec.faults.sensor
    if faults is None or spec.filter.options.form != "lemma2" or lemma_2_holds(spec):
        return ()
    reason = (
        "some rows of y never fail, and gamma depends on its past: their signal does not carry"
        " gamma, so it predicts the others with E[gamma], not with p11"
    )
    if faults.moments is None and (faults.law or faults.first) is None:
        law = SensorLaw.from_spec(spec)
        holds, difference = satisfies_lemma_2(law.kernel, law.initial)
        if not holds:
            reason = (
                "Pr(gamma_k = 1 | gamma_i = 1) is not the same for all i < k, it differs by up to"
                f" {difference:.3g} (for a Markov gamma, either p11 = 1 or equal rows are needed)"
            )
    message = (
        f"Lemma 2 fails: {reason}; the estimate is not the best linear one and its covariance not"
        " that of its error"
    )
    believed, true = _errors(spec)
    if true is not None:
        message += (
            f": after {HORIZON} samples it believes a mean square error of {believed:.4g} (trace),"
            f" the true one is {true:.4g}"
        )
    return (Finding("lemma-2", "warning", message, true, REMEDY),)


def _errors(spec: Spec) -> tuple[float | None, float | None]:
    """Trace of the believed and of the true error covariance, where both can be computed."""
    from fkgen.oracle.exact.moments import FaultMoments
    from fkgen.oracle.plants.actuator import LinearSystem
    from fkgen.oracle.plants.sensor import SensorLaw
    from fkgen.oracle.textbook.linear_optimal import linear_optimal, true_covariance

    faults = spec.faults.sensor
    if faults is None or not faults.kernel or (faults.law or faults.first) is not None:
        return None, None
    with np.errstate(all="ignore"):
        system = LinearSystem.from_spec(spec, HORIZON)
        y = np.zeros((HORIZON, spec.model.ny))
        found = linear_optimal(system, FaultMoments.from_spec(spec, HORIZON), y, None)
        gains = found.state_gain, found.measurement_gain
        true = true_covariance(system, SensorLaw.from_spec(spec), gains)
    believed, actual = (float(np.trace(P[-1])) for P in (found.filtered_covariance, true))
    second = float(np.trace(found.state_second_moment[-1]))
    if not (np.isfinite(actual) and believed > 0.0 and second * 1e-9 < believed):
        return None, None  # an unstable plant: C - V has cancelled
    return believed, actual


FAMILY = Family(
    name="linear_optimal",
    title="sensors that lose their signal or gain noise: linear optimal filter",
    build=by_option(
        "form",
        lemma2=built_by(
            "lmmse.lemma2:uncertain_filter",
            source="Sigalov & Oshman, sec. V, eqs. (19)-(23), covariance form",
        ),
        augmented=built_by(
            "lmmse.jump:jump_filter", source="Costa 1994; Sigalov & Oshman, sec. V without Lemma 2"
        ),
    ),
    proof=proved_by(
        "sensor", "LEMMA_2_FORM", "LINEAR_BATCH", theorems="linear_optimal:LINEAR_IDENTITIES"
    ),
    traits=Traits(moments=True),
    instead="one_step, imm or genie",
    options=LinearOptions,
    accepts={"sensor": partial(read_sensor_faults, law="moments")},
    check=check,
    caveats=lemma_2,
    starter="starter_linear_optimal.toml",
)
