"""What a fault does to the estimate, for how long, and whether the innovation shows it.

References
----------
Song & Hu 2019, *Effect of Faults on Kalman Filter of State Vectors in Linear Systems*, eqs.
(6)-(26), with the errata of docs/fault-effects.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError
from fkgen.problem import Signal, Spec
from fkgen.runtime.record import choice, numbers, signal
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.effects.response import (
    SIGN,
    FaultScenario,
    differenced_response,
    linear_response,
    paired_response,
)

Array = NDArray[np.float64]


def fault_effect(
    spec: Spec,
    sensor: ArrayLike | None = None,
    input: ArrayLike | None = None,  # noqa: A002 - the word of the contract
    mode: str = "both",
    steps: int | None = None,
    *,
    params: Mapping[str, ArrayLike] | None = None,
    u: ArrayLike | None = None,
    y: ArrayLike | None = None,
    runs: int = 256,
    seed: int = 0,
) -> FaultEffect:
    """Say what a fault changes in the estimate, the error and the innovation.

    ``kf``, ``mkf``, ``genie``: by the recursion of the filter, driven by the fault and started at
    zero, in C. ``linear_optimal`` with sensor faults: by two runs, whose difference no record
    changes. Others: by simulated pairs with the same noise. ``kind`` of the result says which.

    Parameters
    ----------
    spec : Spec
    sensor, input : (T, p), (T, q) array_like, optional
        What is added to y, and to u; see `fkgen.profiles`.
    mode : str
        Who gets the input anomaly: ``"both"``, ``"plant"`` (actuator fault), ``"filter"``.
    steps : int, optional
        T, to be checked against the profile.
    params : mapping, optional
        Run-time parameters, numbers or (T,).
    u : (T, q) array_like, optional
        Inputs without the fault; needed where the gain depends on them (``mkf``, ``mme``).
    y : (T, p) array_like, optional
        A record of which only the missing entries (NaN) matter.
    runs, seed : int
        Of the simulated pairs; with 256 the standard error is a sixteenth of the spread.

    Raises
    ------
    DataError
        If a profile does not fit the model, or the plant is unstable and numbers overflow.
    """
    model, faults, traits = spec.model, spec.faults, spec.filter.traits
    if mode not in SIGN:
        raise DataError("mode", given=repr(mode), expected=choice(str(mode), list(SIGN)))
    if sensor is None and input is None:
        expected = "sensor (T, p) or input (T, q): see fkgen.profiles"
        raise DataError("the fault", given="nothing", expected=expected)
    if input is not None and not model.nu:
        raise DataError("input", given="a profile", expected="none: the model has no B")
    T = _length(sensor if input is None else input)
    if steps is not None and steps != T:
        raise DataError("steps", given=repr(steps), expected=f"{T}, the length of the profile")
    missing = np.isnan(_finite("y", y, model.outputs, T, may_miss=True))
    if u is None and model.nu and any((faults.actuator, faults.jump, faults.soft)):
        names, family = ", ".join(each.name for each in model.inputs), spec.filter.family
        expected = f"shape ({T}, {model.nu}): {names}; the gain of {family} depends on u"
        raise DataError("u", given="nothing", expected=expected)
    scenario = FaultScenario(
        spec=spec,
        sensor=_finite("sensor", sensor, model.outputs, T),
        anomaly=_finite("input", input, model.inputs, T),
        mode=mode,
        u=_finite("u", u, model.inputs, T),
        params=_parameters(spec, params or {}, T),
        missing=missing,
    )
    if traits.linear:
        return linear_response(scenario)
    if traits.moments and faults.sensor is not None and not scenario.anomaly.any():
        return differenced_response(scenario)
    return paired_response(scenario, runs, seed)


def _length(profile: ArrayLike | None) -> int:
    try:
        length = len(np.atleast_1d(np.asarray(profile)))
    except ValueError:
        given = "rows of different lengths"
        raise DataError("the fault", given=given, expected="a matrix, one row per sample") from None
    if not length:
        raise DataError("the fault", given="a profile without samples", expected="at least one")
    return length


def _parameters(spec: Spec, params: Mapping[str, ArrayLike], samples: int) -> dict[str, Array]:
    """Parameters by name, each a number or one per sample."""
    known = [parameter.name for parameter in spec.parameters]
    result = {}
    for name, value in params.items():
        where = f"params.{name}"
        if name not in known:
            raise DataError(where, given="an unknown name", expected=choice(name, known))
        result[name] = np.asarray(numbers(where, value, np.float64), dtype=float)
        shape = result[name].shape
        if shape not in {(), (1,), (samples,)}:
            raise DataError(where, given=f"shape {shape}", expected=f"a number or ({samples},)")
        if not np.isfinite(result[name]).all():
            raise DataError(where, given="NaN or an infinity", expected="finite numbers")
    return result


def _finite(
    name: str,
    value: ArrayLike | None,
    signals: Sequence[Signal],
    samples: int,
    *,
    may_miss: bool = False,
) -> Array:
    """A record of finite numbers; zeros if nothing is given."""
    if value is None:
        return np.zeros((samples, len(signals)))
    array = np.asarray(signal(name, value, len(signals), np.float64), dtype=float)
    if len(array) != samples:
        raise DataError(name, given=f"{len(array)} samples", expected=f"{samples}")
    wrong = np.argwhere(np.isinf(array) if may_miss else ~np.isfinite(array))
    if wrong.size:
        k, i = wrong[0]
        what = f"{name}[{k}], {signals[i].name}"
        raise DataError(what, given=str(array[k, i]), expected="a finite number")
    return array
