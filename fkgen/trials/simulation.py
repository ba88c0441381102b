"""Draw trials of a plant with its faults: what happened, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import progressing
from fkgen.errors import DataError
from fkgen.problem import Spec
from fkgen.problem.spec import as_spec
from fkgen.runtime import record
from fkgen.runtime.blocks import in_blocks
from fkgen.runtime.record import whole
from fkgen.trials.sampler import Trials, sampler

Array = NDArray[np.float64]

BLOCK = 50_000  # samples that one thread draws at a stretch
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
        as_spec(self.spec)
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
    driving: Array
    params: Mapping[str, Array]
    trials: Trials

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
        return self._condition(0)

    @cached_property
    def delta(self) -> Array | None:
        """(M, T): noise variance over R of the rows that can fail, 1 or C, for sensor faults."""
        return self._condition(1)

    def _condition(self, part: int) -> Array | None:
        if self.mode is None or self.spec.faults.sensor is None:
            return None
        return np.array(self.spec.faults.sensor.conditions)[:, part][self.mode]

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
    progress : bool, on stderr

    Raises
    ------
    SpecError, DataError
        If faults have no law, a number or shape does not fit, or an unstable plant overflows.
    """
    request = Request(spec, runs, steps, seed, first)
    told = _inputs(spec, u, runs, steps)
    driving = _added("input", told, input, (runs, steps, spec.model.nu))
    given = _parameters(spec, params, steps)
    request = replace(request, spec=_with_laws(spec, given))
    trials = _drawn(request, driving, tuple(given.values()), shown=progress)
    trials = replace(trials, measurement=_measured(spec, trials, present))
    y = _added("sensor", trials.measurement, sensor, trials.measurement.shape)
    return Simulation(request, y=y, u=told, driving=driving, params=given, trials=trials)


def _parameters(spec: Spec, params: Mapping[str, ArrayLike] | None, steps: int) -> dict[str, Array]:
    """Run-time parameters by name, (1,) or (T,)."""
    named = {item.name: item.default for item in spec.stated_parameters}
    values = record.values_of(tuple(named.items()), params, steps, np.float64)
    return {name: np.asarray(v, float) for name, v in zip(named, values, strict=True)}


def _with_laws(spec: Spec, given: Mapping[str, Array]) -> Spec:
    """The spec whose laws have the parameters of all samples, which have to be the same."""
    wanted = spec.faults.law_names
    if not wanted:
        return spec
    for name in sorted(wanted & given.keys()):
        if np.ptp(given[name]) > 0.0:
            expected = "one number for all samples: probabilities of faults depend on it"
            raise DataError(f"params.{name}", given="several values", expected=expected)
    at = spec.defaults | {name: float(values.flat[0]) for name, values in given.items()}
    if not spec.faults.in_domain(at):
        values = ", ".join(f"{name} = {at[name]:g}" for name in sorted(wanted))
        expected = "values with which faults have probabilities, and a positive noise_factor"
        raise DataError("params", given=values, expected=expected)
    return replace(spec, faults=spec.faults.at(at))


def counted(what: str, value: object, beyond: int = LARGEST_TRIAL, *, least: int = 1) -> int:
    """A whole number from ``least`` up, below ``beyond``."""
    expected = f"a whole number from {least} to {beyond - 1}"
    return whole(what, value, least=least, most=beyond - 1, expected=expected)


def _inputs(spec: Spec, u: ArrayLike | None, runs: int, steps: int) -> Array:
    """Inputs of shape (T, q) or (M, T, q), finite."""
    q = spec.model.nu
    if u is None:
        if q:
            names = ", ".join(signal.name for signal in spec.model.inputs)
            expected = f"a number, or shape ({steps}, {q}): {names}"
            raise DataError("u", given="nothing", expected=expected)
        return np.zeros((steps, 0))
    if not q:
        raise DataError("u", given="inputs", expected="none: the model has no B")
    array = record.numbers("u", u, np.float64)
    if (array.ndim < 2 and array.size == 1) or (array.ndim == 1 and array.size == q > 1):
        array = np.broadcast_to(array, (steps, q))
    expected = f"a number, shape ({q},), ({steps}, {q}) or ({runs}, {steps}, {q})"
    return _profile("u", array, (runs, steps, q), expected, "finite numbers")


def _profile(
    what: str, values: ArrayLike, shape: tuple[int, ...], expected: str, finite: str
) -> Array:
    """Finite numbers of shape (T, w) or (M, T, w), where (T,) is one column."""
    array = record.numbers(what, values, np.float64)
    if array.ndim == 1 and shape[2] == 1:
        array = array[:, np.newaxis]
    if array.shape not in (shape[1:], shape):
        raise DataError(what, given=f"shape {array.shape}", expected=expected)
    if not np.isfinite(array).all():
        raise DataError(what, given="NaN or an infinity", expected=finite)
    return np.ascontiguousarray(array, np.float64)


def _added(what: str, signal: Array, profile: ArrayLike | None, shape: tuple[int, ...]) -> Array:
    """A signal with a fault on top of it."""
    if profile is None:
        return signal
    shapes, finite = f"shape {shape[1:]} or {shape}", "finite numbers; 0 is no fault"
    return signal + _profile(what, profile, shape, shapes, finite)


def _measured(spec: Spec, trials: Trials, present: ArrayLike | None) -> Array:
    """Measurements; NaN in rows that are not there, and in samples that are known to be lost."""
    y = trials.measurement
    if spec.faults.jump is not None and spec.faults.jump.arrival == "known" and trials.lost.size:
        y[trials.lost[trials.condition] > 0] = np.nan
    if present is None:
        return y
    shapes = y.shape[1:], y.shape
    try:
        mask = np.asarray(present)
    except ValueError:  # rows of different lengths
        mask = np.asarray(present, object)
    if mask.dtype != np.bool_ or mask.shape not in shapes:
        given = f"shape {mask.shape} of {mask.dtype.name}"
        expected = f"booleans of shape {shapes[0]} or {shapes[1]}"
        raise DataError("present", given=given, expected=expected)
    return np.where(mask, y, np.nan)


def _drawn(request: Request, u: Array, parameters: tuple[Array, ...], *, shown: bool) -> Trials:
    compiled = sampler(request.spec)
    room = compiled.empty(request.runs, request.steps)

    def work(start: int, stop: int) -> None:
        inputs = u if u.ndim == 2 else u[start:stop]
        first = request.first + start
        compiled.draw(request.seed, first, inputs, parameters, room.part(start, stop))

    with progressing("simulate", request.runs, shown=shown) as advance:
        in_blocks(work, request.runs, max(1, BLOCK // request.steps), advance)
    return room
