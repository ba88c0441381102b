"""Tell a filter that is wrong from numbers that leave no digits to prove it with.

Who types P0 = 1e16 beside R = 1e-9 asks for more digits than there are, of the filter and of what
it is held against. The same filter with milder numbers tells the two apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from fkgen.errors import SpecError, ValidationError
from fkgen.problem import Spec
from fkgen.problem.code import Code


def without_digits(
    spec: Spec, wrong: ValidationError, prove: Callable[[Spec], object]
) -> SpecError | None:
    """What to say of the numbers of a spec, if they are to blame; ``prove`` raises as it did."""
    given = f"numbers that leave no digits to prove the filter with: {wrong.failed[0]}"
    ways = "a smaller P0, or units in which P0, Q, R and the square of x0 are closer together"
    as_double = replace(spec, code=Code("double", spec.code.update))
    if spec.code.scalar == "float" and _holds(as_double, prove):
        expected = f'scalar = "double", or {ways}'
        return SpecError("code.scalar", given=given, expected=expected, file=spec.file)
    mild = milder(spec)
    if mild == spec or not _holds(mild, prove):
        return None
    return SpecError("model.P0", given=given, expected=ways, file=spec.file)


def _holds(spec: Spec, prove: Callable[[Spec], object]) -> bool:
    try:
        prove(spec)
    except (SpecError, ValidationError):  # equations may have no values with other numbers
        return False
    return True


def milder(spec: Spec) -> Spec:
    """The same spec with variances of one, as far as they are numbers, and a start of that size."""
    table: dict[str, Any] = spec.to_dict()
    for plant in (table["model"], *table.get("faults", {}).get("jump", {}).get("modes", ())):
        sizes = {key: _deviations(plant[key]) for key in ("Q", "R", "P0") if key in plant}
        if "S" in plant:  # no milder where w and v would not fit together any more
            continue
        for key, size in sizes.items():
            if size is not None:
                plant[key] = (np.array(plant[key], float) / np.outer(size, size)).tolist()
    if spec.model.equations is None:  # f and h may have no values elsewhere
        table["model"]["x0"] = [
            float(np.sign(x)) if isinstance(x, int | float) else x for x in table["model"]["x0"]
        ]
    return Spec.from_dict(table, file=spec.file)


def _deviations(entries: Any) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """Standard deviations of a covariance of numbers, 1 where one is 0; None if it is none."""
    try:
        variances = np.diag(np.array(entries, float))
    except ValueError:  # it depends on parameters
        return None
    return np.sqrt(np.where(variances > 0.0, variances, 1.0))
