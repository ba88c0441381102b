"""What a spec says of a plant as functions over a record, of equations as of matrices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, wraps
from typing import Any, Literal

import numpy as np

from fkgen.faults.chain import Mode
from fkgen.oracle.exact.gaussian import Array
from fkgen.oracle.plants.actuator import Plant, parameter_samples
from fkgen.oracle.plants.dual import Dual, Number, value_of
from fkgen.oracle.plants.manifold import Kind, Space
from fkgen.oracle.plants.nonlinear import Flow, NonlinearSystem, by_functions
from fkgen.problem import Matrix, Model, Signal, Spec, evaluate
from fkgen.problem.equations import Equations

#: Functions of the expression language that NumPy has by another name.
_RENAMED = {"asin": "arcsin", "acos": "arccos", "atan2": "arctan2", "min": "minimum"}
_RENAMED |= {"max": "maximum", "abs": "absolute", "+": "add", "-": "subtract", "*": "multiply"}
_RENAMED |= {"/": "divide", "**": "power", "neg": "negative", "<": "less", "<=": "less_equal"}
_RENAMED |= {">": "greater", ">=": "greater_equal", "==": "equal", "!=": "not_equal"}
_SAME = ("exp", "log", "sqrt", "sin", "cos", "tan", "sinh", "cosh", "tanh", "sign", "hypot")
#: Functions that would hide that an argument has no value, as "no" or as the other one.
_DECIDING = ("<", "<=", ">", ">=", "==", "!=", "min", "max", "sign")


def decided(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that decides by its arguments: without a value where one of them has none."""

    @wraps(function)
    def found(*arguments: Number) -> Number:
        return function(*arguments) if _are_finite(*arguments) else np.nan

    return found


def _are_finite(*numbers: Number) -> bool:
    return all(np.isfinite(value_of(each)) for each in numbers)


def chosen(condition: Number, first: Number, second: Number) -> Number:
    """One of two numbers; the other may have no value."""
    if not _are_finite(condition):
        return np.nan
    return first if value_of(condition) else second


def looked_up(table: Any, at: Number) -> Number:
    """The value of a table by SciPy, with its slope; held at the ends, with slope 0."""
    from scipy.interpolate import PchipInterpolator, PPoly  # noqa: PLC0415 - slow to import

    if not _are_finite(at):
        return np.nan
    place, x, y = float(value_of(at)), np.array(table.x), np.array(table.y)
    if place < x[0] or place >= x[-1]:
        return y[0] if place < x[0] else y[-1]
    if table.kind == "pchip" and len(x) > 2:
        curve: Any = PchipInterpolator(x, y)
    else:
        curve = PPoly(np.array([np.diff(y) / np.diff(x), y[:-1]]), x)
    value, slope = float(curve(place)), float(curve(place, 1))
    return Dual(value, slope * at.slopes) if isinstance(at, Dual) else value


#: The expression language on floats and duals.
ARITHMETIC: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in _SAME},
    **{name: getattr(np, renamed) for name, renamed in _RENAMED.items()},
    **{name: decided(getattr(np, _RENAMED.get(name, name))) for name in _DECIDING},
    "if": chosen,
    "interp": looked_up,
}


def is_nonlinear(spec: Spec) -> bool:
    """Whether the plant, or one of its modes, is stated by equations that are not linear."""
    return any(plant.equations is not None for plant in (spec.model, *spec.plants))


def space_of(states: tuple[Signal, ...]) -> Space:
    """What the states are."""
    kinds: dict[bool, Kind] = {True: "circle", False: "line"}
    return Space(tuple("SO3" if each.manifold else kinds[each.wrap] for each in states))


def system_of(
    spec: Spec,
    T: int,
    params: Mapping[str, Array | float],
    plant: Model | Mode | None = None,
    P0: Array | None = None,
) -> NonlinearSystem:
    """The plant of a spec over T samples, or one of its modes; params (T,), P0 if not its own."""
    model = spec.model
    plant = model if plant is None else plant
    samples, which = parameter_samples(spec, T, params)

    def over(matrix: Matrix) -> Array:
        return np.array([matrix.values(each) for each in samples])[which]

    space, ny = space_of(model.states), model.ny
    has: Array = np.ones(model.nx)
    if isinstance(plant, Mode) and plant.kept is not None:  # the other states are 0
        has = np.isin(np.arange(model.nx), plant.kept).astype(float)
    first = samples[which[0]] if len(which) else spec.defaults
    P0 = model.P0.values(first) if P0 is None else P0
    given = {"x0": has * model.x0.values(first)[:, 0], "S": over(model.S)}
    given["P0"] = P0 if has.all() else has[:, None] * P0 * has
    given |= {"Q": over(plant.Q), "R": over(plant.R)}
    wraps = np.array([each.wrap for each in model.outputs], bool)
    if plant.equations is None:
        matrices = {name: over(getattr(plant, name)) for name in "ABCDcd"}
        columns = {name: matrices.pop(name)[..., 0] for name in "cd"}
        S = given.pop("S")
        linear = by_functions(Plant(**matrices, **columns, **given))
        return replace(linear, S=S, space=space, wraps=wraps)
    equations, parameters = plant.equations, tuple(samples[i] for i in which)
    variances = [[evaluate(each.variance, p) for each in equations.noises] for p in parameters]
    return NonlinearSystem(
        f=partial(equations.stated, arithmetic=ARITHMETIC),
        h=partial(equations.seen, arithmetic=ARITHMETIC),
        space=space,
        wraps=wraps.reshape(ny),
        parameters=parameters,
        W=np.array(variances, float).reshape(T, len(equations.noises)),
        nu=model.nu,
        increments=_increments(equations, space),
        flow=_flow(equations, parameters),
        **given,
    )


def _increments(equations: Equations, space: Space) -> frozenset[int]:
    """The attitudes that f turns by a rotation vector."""
    pieces = enumerate(space.pieces())
    return frozenset(signal for signal, (_, at, _) in pieces if at.start in equations.turning)


def _flow(equations: Equations, parameters: tuple[Mapping[str, Any], ...]) -> Flow | None:
    period = equations.period
    if period is None:
        return None
    periods = np.array([evaluate(period, each) for each in parameters])
    integrator: Literal["rk4", "euler"] = equations.integrator
    return Flow(periods, integrator, equations.substeps)
