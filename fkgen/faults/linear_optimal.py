"""What the linear filter of Sigalov & Oshman, sec. V, demands of plant and fault law."""

from __future__ import annotations

import numpy as np

from fkgen.faults.sensor import SensorFaults
from fkgen.problem.filter import Filter
from fkgen.problem.model import Model
from fkgen.problem.probability import visited
from fkgen.problem.table.place import Place

#: Largest difference of conditional probabilities that are meant to be the same.
EQUAL = 1e-12


def is_white(faults: SensorFaults) -> bool:
    """Whether gamma is independent of its past: E[gamma_k] = p11(k) for every k."""
    if faults.moments is not None:
        return abs(faults.moments.gamma_rate - faults.moments.gamma_persistence) <= EQUAL
    kernel = np.array(faults.kernel)
    rates = kernel[visited(kernel, faults.initial), :2].sum(axis=1)
    return bool(np.ptp(rates) <= EQUAL)


def check_linear_filter(model: Model, place: Place, faults: SensorFaults, options: Filter) -> None:
    """Refuse what equations (23), or their augmented form, do not cover.

    Raises
    ------
    SpecError
        If a state that is not zero in the mean meets a gamma that depends on its past (the linear
        filter has no constant term), or the augmented form is asked for without a law.
    """
    if options.family != "linear_optimal":
        return
    if options.form == "augmented":
        if faults.moments is not None:
            raise (
                place.entry("filter")
                .entry("form")
                .error('"augmented" with problem "moments"', "a law: problem 1, 2, 3 or 4")
            )
        return
    if is_white(faults):
        return
    way_out = (
        "filter.form = 'augmented' has one"
        if faults.moments is None
        else "with problem 3 or 4, filter.form = 'augmented' has one"
    )
    because = f"where gamma depends on its past: the filter has no constant term; {way_out}"
    if model.x0.values().any():
        raise place.entry("model").entry("x0").error("a start that is not zero", f"zero {because}")
    if model.nu:
        raise place.entry("model").entry("B").error("known inputs", f"none {because}")
