"""A fault, where it enters, and the record that it falls on: checked and completed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError
from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.problem import Signal, Spec
from fkgen.runtime.record import choice, numbers, signal

Array = NDArray[np.float64]

#: Who gets the anomaly of an input: the plant, the filter (a wrong readback), or both of them.
Mode = Literal["both", "plant", "filter"]
MODES: tuple[Mode, ...] = get_args(Mode)


@dataclass(frozen=True, eq=False, kw_only=True)
class FaultScenario:
    """A fault on a record of T samples."""

    spec: Spec
    sensor: Array  # (T, p), what is added to y
    anomaly: Array  # (T, q), what is added to u
    mode: Mode  # who gets the anomaly
    u: Array  # (T, q), the inputs without it
    params: Mapping[str, ArrayLike]  # run-time parameters, numbers or (T,)
    missing: NDArray[np.bool_]  # (T, p), entries of y that are missing

    @property
    def samples(self) -> int:
        """Length T of the record."""
        return len(self.sensor)

    @property
    def known_inputs(self) -> Array:
        """The inputs that the filter is told, (T, q)."""
        return self.u if self.mode == "plant" else self.u + self.anomaly

    def system(self, rates: tuple[float, ...] | None = None) -> LinearSystem:
        """The plant over the record; with one hypothesis in place of its success rates."""
        params = {name: np.asarray(value, dtype=float) for name, value in self.params.items()}
        try:
            found = LinearSystem.from_spec(self.spec, self.samples, params, rates)
        except ArithmeticError as fault:
            expected = f"values at which every entry of the model is a number, but {fault}"
            raise DataError("params", given="these values", expected=expected) from None
        wrong = np.flatnonzero(np.any((found.rate < 0.0) | (found.rate > 1.0), axis=1))
        if wrong.size:
            given = f"a success rate of {found.rate[wrong[0]]} at sample {wrong[0]}"
            raise DataError("params", given=given, expected="rates in [0, 1]")
        return found


def scenario_of(
    spec: Spec,
    faults: tuple[ArrayLike | None, ArrayLike | None],
    mode: str,
    steps: int | None,
    *,
    params: Mapping[str, ArrayLike] | None,
    u: ArrayLike | None,
    y: ArrayLike | None,
) -> FaultScenario:
    """Check and complete what a user states; ``faults`` is added to y and to u."""
    if mode not in MODES:
        raise DataError("mode", given=repr(mode), expected=choice(str(mode), MODES))
    sensor, anomaly = faults
    if sensor is None and anomaly is None:
        expected = "sensor (T, p) or input (T, q): see fkgen.profiles"
        raise DataError("the fault", given="nothing", expected=expected)
    model = spec.model
    if anomaly is not None and not model.nu:
        raise DataError("input", given="a profile", expected="none: the model has no B")
    T = _length(sensor if anomaly is None else anomaly)
    if steps is not None and steps != T:
        raise DataError("steps", given=repr(steps), expected=f"{T}, the length of the profile")
    record = _finite("y", y, model.outputs, T, may_miss=True)
    return FaultScenario(
        spec=spec,
        sensor=_finite("sensor", sensor, model.outputs, T),
        anomaly=_finite("input", anomaly, model.inputs, T),
        mode=mode,
        u=_inputs(spec, u, T),
        params=_parameters(spec, params or {}, T),
        missing=np.isnan(record),
    )


def _length(profile: ArrayLike | None) -> int:
    """Number of samples of a profile, at least one."""
    try:
        length = len(np.atleast_1d(np.asarray(profile)))
    except ValueError:
        given = "rows of different lengths"
        raise DataError("the fault", given=given, expected="a matrix, one row per sample") from None
    if not length:
        raise DataError("the fault", given="a profile without samples", expected="at least one")
    return length


def _parameters(
    spec: Spec, params: Mapping[str, ArrayLike], samples: int
) -> dict[str, NDArray[np.floating]]:
    """Parameters by name, each a number or one per sample."""
    known = [parameter.name for parameter in spec.parameters]
    result = {}
    for name, value in params.items():
        where = f"params.{name}"
        if name not in known:
            raise DataError(where, given="an unknown name", expected=choice(name, known))
        result[name] = numbers(where, value, np.float64)
        shape = result[name].shape
        if shape not in {(), (1,), (samples,)}:
            raise DataError(where, given=f"shape {shape}", expected=f"a number or ({samples},)")
        if not np.isfinite(result[name]).all():
            raise DataError(where, given="NaN or an infinity", expected="finite numbers")
    return result


def _inputs(spec: Spec, u: ArrayLike | None, samples: int) -> Array:
    """The inputs of the record; needed only where the gain of the filter depends on them."""
    faults = spec.faults
    if u is None and spec.model.nu and any((faults.actuator, faults.jump, faults.soft)):
        names = ", ".join(each.name for each in spec.model.inputs)
        family = spec.filter.family
        expected = f"shape ({samples}, {spec.model.nu}): {names}; the gain of {family} depends on u"
        raise DataError("u", given="nothing", expected=expected)
    return _finite("u", u, spec.model.inputs, samples)


def _finite(
    name: str,
    value: ArrayLike | None,
    signals: Sequence[Signal],
    samples: int,
    *,
    may_miss: bool = False,
) -> Array:
    """A record of finite numbers; zeros if nothing is given."""
    width = len(signals)
    if value is None:
        return np.zeros((samples, width))
    array = np.asarray(signal(name, value, width, np.float64), dtype=float)
    if len(array) != samples:
        raise DataError(name, given=f"{len(array)} samples", expected=f"{samples}")
    wrong = np.argwhere(np.isinf(array) if may_miss else ~np.isfinite(array))
    if wrong.size:
        k, i = wrong[0]
        what = f"{name}[{k}], {signals[i].name}"
        raise DataError(what, given=str(array[k, i]), expected="a finite number")
    return array
