"""Draw trials of a plant with its faults: what happened, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import progressing
from fkgen.errors import DataError
from fkgen.problem import Matrix, Spec, evaluate
from fkgen.problem.covariance import SEMIDEFINITE, negative_direction
from fkgen.problem.spec import as_spec
from fkgen.runtime import record
from fkgen.runtime.blocks import in_blocks
from fkgen.runtime.record import whole
from fkgen.trials.sampler import CompiledSampler, Trials, sampler

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
        sensor, mode = self.spec.faults.sensor, self.mode
        if sensor is None or sensor.factor is None or mode is None:
            return self._condition(1)
        given = {k: np.broadcast_to(v, self.request.steps).tolist() for k, v in self.params.items()}
        samples = (dict(zip(given, row, strict=True)) for row in zip(*given.values(), strict=True))
        factor = np.array([evaluate(sensor.factor, sample) for sample in samples])
        return np.where(mode % 2 == 1, factor, 1.0)

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
    ready = drawing_of(Request(spec, runs, steps, seed, first), u, params, input=input)
    found = ready.draw(0, runs, shown=progress)
    trials = replace(found.trials, measurement=_measured(found.y, present))
    y = _added("sensor", trials.measurement, sensor, trials.measurement.shape)
    return replace(found, y=y, trials=trials)


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What the trials of a request have in common: checked, compiled, and ready to be drawn."""

    request: Request
    told: Array  # (T, q) or (M, T, q), inputs as commanded
    driving: Array  # the same with the fault of the inputs
    params: Mapping[str, Array]
    compiled: CompiledSampler

    def draw(self, start: int, stop: int, *, shown: bool = False) -> Simulation:
        """Trials ``start`` to ``stop - 1`` of the request."""
        request = replace(self.request, runs=stop - start, first=self.request.first + start)
        told, driving = (u if u.ndim == 2 else u[start:stop] for u in (self.told, self.driving))
        values = tuple(self.params.values())
        trials = _drawn(request, self.compiled, driving, values, shown=shown)
        return Simulation(
            request,
            y=trials.measurement,
            u=told,
            driving=driving,
            params=self.params,
            trials=trials,
        )


def drawing_of(
    request: Request,
    u: ArrayLike | None,
    params: Mapping[str, ArrayLike] | None,
    *,
    input: ArrayLike | None = None,  # noqa: A002 - as in `simulate`
) -> Drawing:
    """The plant of a request with its inputs and parameters, as `simulate` takes them."""
    spec, shape = request.spec, (request.runs, request.steps)
    told = _inputs(spec, u, *shape)
    driving = _added("input", told, input, (*shape, spec.model.nu))
    given = _parameters(spec, params, request.steps)
    drawn = _with_laws(_with_start(spec, given), given)
    return Drawing(replace(request, spec=drawn), told, driving, given, sampler(drawn))


def _parameters(spec: Spec, params: Mapping[str, ArrayLike] | None, steps: int) -> dict[str, Array]:
    """Every parameter of the file, one number or (T,)."""
    named = {item.name: item.default for item in spec.stated_parameters}
    values = record.values_of(tuple(named.items()), params, steps, np.float64)
    return {name: np.asarray(v, float) for name, v in zip(named, values, strict=True)}


def _with_start(spec: Spec, given: Mapping[str, Array]) -> Spec:
    """The spec whose prior has the parameters of sample 0."""
    model = spec.model
    if model.x0.is_constant and model.P0.is_constant:
        return spec
    at = spec.defaults | {name: float(values.flat[0]) for name, values in given.items()}
    try:
        x0, P0 = (Matrix.of(each.values(at)) for each in (model.x0, model.P0))
    except ArithmeticError as fault:
        raise DataError("params", given=str(fault), expected="values that x0 and P0 have") from None
    if found := negative_direction(P0.values()):
        raise DataError("params", given=f"P0 with {found}", expected=SEMIDEFINITE)
    return replace(spec, model=replace(model, x0=x0, P0=P0))


def _with_laws(spec: Spec, given: Mapping[str, Array]) -> Spec:
    """The spec whose laws have the parameters of all samples, or begin with those of sample 0."""
    wanted = spec.faults.law_names
    if not wanted:
        return spec
    at = spec.defaults | {name: float(values.flat[0]) for name, values in given.items()}
    if not spec.faults.in_domain(at):
        values = ", ".join(f"{name} = {at[name]:g}" for name in sorted(wanted))
        expected = "values with which faults have probabilities, and a positive noise_factor"
        raise DataError("params", given=values, expected=expected)
    moving = any(np.ptp(given[name]) > 0.0 for name in wanted & given.keys())
    return replace(spec, faults=spec.faults.begun(at) if moving else spec.faults.at(at))


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


def _measured(y: Array, present: ArrayLike | None) -> Array:
    """Measurements; NaN in rows that are not there."""
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


def _drawn(
    request: Request,
    compiled: CompiledSampler,
    u: Array,
    parameters: tuple[Array, ...],
    *,
    shown: bool,
) -> Trials:
    """The trials; NaN in samples that are known to be lost."""
    room = compiled.empty(request.runs, request.steps)

    def work(start: int, stop: int) -> None:
        inputs = u if u.ndim == 2 else u[start:stop]
        first = request.first + start
        compiled.draw(request.seed, first, inputs, parameters, room.part(start, stop))

    with progressing("simulate", request.runs, shown=shown) as advance:
        in_blocks(work, request.runs, max(1, BLOCK // request.steps), advance)
    jump = request.spec.faults.jump
    if jump is not None and jump.arrival == "known" and room.lost.size:
        room.measurement[room.lost[room.condition] > 0] = np.nan
    return room
