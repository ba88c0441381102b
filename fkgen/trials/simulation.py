"""Draw trials of a plant with its faults: what happened, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import Advance, progressing
from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.runtime import record
from fkgen.runtime.blocks import in_blocks
from fkgen.runtime.record import whole
from fkgen.symbolic.interface import Status
from fkgen.trials.sampler import Overflow, Trials, sampler

Array = NDArray[np.float64]

#: Samples that one thread draws at a stretch.
BLOCK = 50_000
LARGEST_SEED, LARGEST_TRIAL = 2**64, 2**32
LARGEST_STEPS = 2**31


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be drawn, checked: trials ``first`` to ``first + runs - 1`` of a seed."""

    spec: Spec
    runs: int
    steps: int
    seed: int
    first: int

    def __post_init__(self) -> None:
        """Refuse numbers of trials, samples and seeds that cannot be."""
        counted("runs", self.runs)
        counted("steps", self.steps, LARGEST_STEPS)
        counted("seed", self.seed, LARGEST_SEED, least=0)
        counted("first", self.first, LARGEST_TRIAL - self.runs + 1, least=0)


@dataclass(frozen=True, eq=False)
class Simulation:
    """M trials of T samples: truth, measurements and fault indicators.

    Attributes
    ----------
    request : Request
        ``spec``, ``runs``, ``steps``, ``seed`` and ``first``: trial i is trial ``first + i`` of
        the seed.
    y : (M, T, p) ndarray
        Measurements.
    u : (T, q) or (M, T, q) ndarray
        Inputs as commanded, which is what a filter is told.
    driving : (T, q) or (M, T, q) ndarray
        The same with the fault of the inputs, before gamma.
    params : mapping of str to (1,) or (T,) ndarray
        Run-time parameters.
    trials : Trials
        The truth, and codes of what was drawn.
    """

    request: Request
    y: Array
    u: Array
    driving: Array = field(repr=False)
    params: Mapping[str, Array] = field(repr=False)
    trials: Trials = field(repr=False)

    @property
    def spec(self) -> Spec:
        """The plant and its faults."""
        return self.request.spec

    @property
    def state(self) -> Array:
        """(M, T, n): x[k]."""
        return self.trials.state

    @cached_property
    def mode(self) -> NDArray[np.uint8] | None:
        """(M, T): the sensor's, 0 to 3 as (1, 1) (1, C) (0, 1) (0, C), or the plant's, if any."""
        modes = self.trials.modes
        return modes[self.trials.condition] if modes.size else None

    @cached_property
    def gamma(self) -> Array | None:
        """Whether it works: (M, T, q) per input, or (M, T) for the sensor; None without faults."""
        if self.spec.faults.actuator is not None:
            return self.trials.coin.astype(np.float64)
        if self.mode is None or self.spec.faults.sensor is None:
            return None
        return np.array(self.spec.faults.sensor.conditions)[:, 0][self.mode]

    @cached_property
    def delta(self) -> Array | None:
        """(M, T): noise variance over R of the rows that can fail, 1 or C, for sensor faults."""
        if self.mode is None or self.spec.faults.sensor is None:
            return None
        return np.array(self.spec.faults.sensor.conditions)[:, 1][self.mode]

    @cached_property
    def arrival(self) -> NDArray[np.bool_] | None:
        """(M, T): whether the sample holds a signal, where samples of a jumping plant get lost."""
        lost = self.trials.lost
        return np.logical_not(lost[self.trials.condition]) if lost.size else None

    @property
    def hypothesis(self) -> NDArray[np.uint8] | None:
        """(M,): which hypothesis of ``mme`` is true, where the spec states no rate."""
        return self.trials.hypothesis if self.trials.hypothesis.size else None

    def __repr__(self) -> str:
        of = self.request
        return f"<Simulation of {of.spec.name}: {of.runs} x {of.steps} samples, seed {of.seed}>"


def simulate(
    spec: Spec,
    runs: int,
    steps: int,
    seed: int = 0,
    u: ArrayLike | None = None,
    *,
    params: Mapping[str, ArrayLike] | None = None,
    sensor: ArrayLike | None = None,
    input: ArrayLike | None = None,  # noqa: A002 - the field's word, as in `fault_effect`
    present: ArrayLike | None = None,
    first: int = 0,
    progress: bool = False,
) -> Simulation:
    """Draw M trials of T samples of the plant of a spec, with its noise and its faults, in C.

    A trial is the same whatever the number of trials, samples or cores, bit for bit.

    Parameters
    ----------
    spec : Spec
        Its filter plays no part, but where ``mme`` states no rate each trial has a hypothesis.
    runs, steps, seed, first : int
        M, T, in [0, 2**64), and the number of the first trial.
    u : number, (q,), (T, q) or (M, T, q) array_like
        Inputs as commanded, if the model has any.
    params : mapping of str to float or (T,) array_like
        Run-time parameters; those left out keep their defaults.
    sensor, input : (T, p) or (M, T, p), (T, q) or (M, T, q) array_like
        Soft faults: added to y, and to what the plant gets as u and the filter is not told.
    present : (T, p) or (M, T, p) array_like of bool
        Which rows of y are measured (default: all); the others are NaN.
    progress : bool
        Show how far it is, on stderr.

    Raises
    ------
    SpecError, DataError
        If faults have no law, a number or shape does not fit, or an unstable plant overflows.
    """
    request = Request(spec, runs, steps, seed, first)
    told = inputs_of(spec, u, request.runs, request.steps)
    driving = added("input", told, input, (request.runs, request.steps, spec.model.nu))
    given = _parameters(spec, params, request.steps)
    with progressing("simulate", request.runs, shown=progress) as advance:
        trials = _drawn(request, driving, tuple(given.values()), advance)
    measured = _measured(spec, trials, present)
    y = added("sensor", measured, sensor, measured.shape)
    trials = replace(trials, measurement=measured)
    return Simulation(request, y=y, u=told, driving=driving, params=given, trials=trials)


def counted(what: str, value: object, beyond: int = LARGEST_TRIAL, *, least: int = 1) -> int:
    """A whole number from ``least`` up, below ``beyond``."""
    expected = f"a whole number from {least} to {beyond - 1}"
    return whole(what, value, least=least, most=beyond - 1, expected=expected)


def inputs_of(spec: Spec, u: ArrayLike | None, runs: int, steps: int) -> Array:
    """Inputs of shape (T, q) or (M, T, q), finite."""
    q = spec.model.nu
    names = ", ".join(signal.name for signal in spec.model.inputs)
    if u is None:
        if q:
            expected = f"a number, or shape ({steps}, {q}): {names}"
            raise DataError("u", given="nothing", expected=expected)
        return np.zeros((steps, 0))
    if not q:
        raise DataError("u", given="inputs", expected="none: the model has no B")
    array = np.asarray(record.numbers("u", u, np.float64))
    if (array.ndim < 2 and array.size == 1) or (array.ndim == 1 and array.size == q > 1):
        array = np.array(np.broadcast_to(array, (steps, q)))
    if array.ndim == 1 and q == 1:
        array = array[:, np.newaxis]
    if array.shape not in ((steps, q), (runs, steps, q)):
        expected = f"a number, shape ({q},), ({steps}, {q}) or ({runs}, {steps}, {q})"
        raise DataError("u", given=f"shape {array.shape}", expected=expected)
    if not np.isfinite(array).all():
        raise DataError("u", given="NaN or an infinity", expected="finite numbers")
    return np.ascontiguousarray(array)


def added(what: str, signal: Array, profile: ArrayLike | None, shape: tuple[int, ...]) -> Array:
    """A signal with a fault on top of it."""
    if profile is None:
        return signal
    extra = record.numbers(what, profile, np.float64)
    if extra.ndim == 1 and shape[2] == 1:
        extra = extra[:, np.newaxis]
    if extra.shape not in (shape[1:], shape):
        given, expected = f"shape {extra.shape}", f"shape {shape[1:]} or {shape}"
        raise DataError(what, given=given, expected=expected)
    if not np.isfinite(extra).all():
        raise DataError(what, given="NaN or an infinity", expected="finite numbers; 0 is no fault")
    return np.ascontiguousarray(signal + extra, np.float64)


def _measured(spec: Spec, trials: Trials, present: ArrayLike | None) -> Array:
    """Measurements; NaN in rows that are not there, and in samples that are known to be lost."""
    y = trials.measurement
    if spec.faults.jump is not None and spec.faults.jump.arrival == "known" and trials.lost.size:
        y[trials.lost[trials.condition] > 0] = np.nan
    if present is None:
        return y
    mask, shapes = np.asarray(present), (y.shape[1:], y.shape)
    if mask.dtype != np.bool_ or mask.shape not in shapes:
        given = f"shape {mask.shape} of {mask.dtype.name}"
        expected = f"booleans of shape {shapes[0]} or {shapes[1]}"
        raise DataError("present", given=given, expected=expected)
    return np.where(mask, y, np.nan)


def _parameters(spec: Spec, given: Mapping[str, ArrayLike] | None, steps: int) -> dict[str, Array]:
    """Every parameter that the file states, as one number or T."""
    named = tuple((item.name, item.default) for item in spec.stated_parameters)
    arrays = record.values_of(named, given, steps, np.float64)
    return {name: np.asarray(array) for (name, _), array in zip(named, arrays, strict=True)}


def _drawn(request: Request, u: Array, parameters: tuple[Array, ...], advance: Advance) -> Trials:
    compiled = sampler(request.spec)
    room = compiled.empty(request.runs, request.steps)

    def work(start: int, stop: int) -> None:
        block = room.part(start, stop)
        inputs = u if u.ndim == 2 else u[start:stop]
        compiled.draw(request.seed, request.first + start, inputs, parameters, block)

    try:
        in_blocks(work, request.runs, max(1, BLOCK // request.steps), advance)
    except Overflow as stopped:
        raise _explained(stopped, request.steps) from None
    return room


def _explained(stopped: Overflow, steps: int) -> DataError:
    """What to do about a sample that C refused."""
    at = f"at sample {stopped.sample} of trial {stopped.trial}"
    if stopped.status is Status.PARAMETER_OUT_OF_RANGE:
        return DataError(
            "params",
            given=f"a variance below 0, or a rate outside [0, 1], {at}",
            expected="values with which Q and R are covariances and rates are probabilities",
        )
    return DataError(
        "steps",
        given=f"{steps}, and numbers that overflow {at}",
        expected="fewer steps: the plant is not stable, and its state grows without bounds",
    )
