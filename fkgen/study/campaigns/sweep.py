"""A grid of campaigns: one filter, and plants that differ from what it was designed for."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.console import progressing
from fkgen.errors import DataError, UserError, of_type
from fkgen.problem import Spec
from fkgen.problem.spec import as_spec
from fkgen.runtime.record import choice, numbers
from fkgen.study.campaigns.campaign import montecarlo
from fkgen.study.campaigns.results import CONSISTENT, Campaign
from fkgen.study.comparisons.ranking import Estimate
from fkgen.study.reports.jsonable import json_text

#: Cells of a grid at most: each plant is compiled.
LARGEST = 10_000
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})(x?):({_NUMBER})(x?):(\d+)")
_FORM = "from:to:count, such as 0.5:0.95:10, or 0.5x:2x:5 for factors of what the spec says"


@dataclass(frozen=True, slots=True)
class Axis:
    """A key of the spec of the plant, and what it takes in its place or as a factor of it."""

    key: str
    values: tuple[float, ...]
    factor: bool

    def label(self, value: float) -> str:
        """A value as it is written."""
        return f"{value:.4g}{'x' if self.factor else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Campaigns over a grid of plants.

    Attributes
    ----------
    name : str
    axes : tuple of Axis
    cells : ndarray of Campaign or str
        One axis for each of ``axes``; the text says why there is no such plant.
    """

    name: str
    axes: tuple[Axis, ...]
    cells: NDArray[Any]

    @property
    def campaigns(self) -> list[Campaign]:
        """Those of plants that there are."""
        return [each for each in self.cells.flat if isinstance(each, Campaign)]

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Where every verdict is "consistent"; False where there is no plant."""
        found = [isinstance(each, Campaign) and each.consistent for each in self.cells.flat]
        return np.array(found, bool).reshape(self.cells.shape)

    def values(self, statistic: str) -> NDArray[np.float64]:
        """A statistic of all cells, (..., shape of the statistic); NaN where there is no plant."""
        shape = np.shape(getattr(self.campaigns[0], statistic).value)
        values = np.full((self.cells.size, *shape), np.nan)
        for i, each in enumerate(self.cells.flat):
            if isinstance(each, Campaign):
                values[i] = getattr(each, statistic).value
        return values.reshape(self.cells.shape + shape)

    def to_json(self) -> str:
        """Axes, and for each cell where it is with its campaign or the reason why there is none."""
        axes = [{"key": a.key, "values": a.values, "factor": a.factor} for a in self.axes]
        cells = []
        for at, each in np.ndenumerate(self.cells):
            of = [axis.values[i] for axis, i in zip(self.axes, at, strict=True)]
            ran = isinstance(each, Campaign)
            found = {"campaign": each.facts if ran else None, "error": None if ran else each}
            cells.append({"at": of, **found})
        return json_text({"name": self.name, "axes": axes, "cells": cells})

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.cells.shape))
        return f"<Sweep of {self.name}: {shape} plants, {self.consistent.sum()} consistent>"


def sweep(
    spec: Spec,
    over: Mapping[str, str | Sequence[float]],
    trials: int,
    steps: int,
    seed: int = 0,
    *,
    truth: Spec | None = None,
    progress: bool = False,
    **options: Any,
) -> Sweep:
    """Run a campaign of one filter for each plant of a grid, on the same random numbers.

    Parameters
    ----------
    spec : Spec
        The filter, which stays as it is.
    over : mapping of str to str or sequence of float
        Dotted keys of the spec of the plant (``model.Q``, ``faults.actuator.success_rate``), and
        what they take: "0.5:0.95:10", ten numbers of equal distance; "0.5x:2x:5", five factors of
        equal ratio; or numbers.
    trials, steps, seed, truth, progress, options
        As for `montecarlo`; the plant that varies is ``truth``, or that of ``spec``.

    Raises
    ------
    DataError
        If a key is unknown or a range none. A plant that cannot be is a cell with the reason.
    """
    plant = as_spec(spec) if truth is None else as_spec(truth, "truth")
    axes = _axes(plant, over)
    cells, errors = np.empty([len(axis.values) for axis in axes], object), list[UserError]()
    with progressing("plants", cells.size, shown=progress) as advance:
        for at in np.ndindex(cells.shape):
            values = [axis.values[i] for axis, i in zip(axes, at, strict=True)]
            try:
                varied = _plant(plant, axes, values)
                cells[at] = montecarlo(spec, trials, steps, seed, truth=varied, **options)
            except UserError as error:
                errors.append(error)
                cells[at] = str(error)
            advance(1)
    if len(errors) == cells.size:
        raise errors[0]
    return Sweep(spec.name, axes, cells)


def _axes(plant: Spec, over: Mapping[str, Any]) -> tuple[Axis, ...]:
    """Keys that the plant has, with what they take."""
    of_type("over", over, Mapping, "a mapping of keys to ranges")
    if not over:
        raise DataError("over", given="nothing", expected=f"a key and a range: {_FORM}")
    axes = tuple(_axis(key, given) for key, given in over.items())
    for axis in axes:
        _changed(plant.to_dict(), axis, 1.0)
    if (count := math.prod(len(axis.values) for axis in axes)) > LARGEST:
        raise DataError("sweep", given=f"{count} plants", expected=f"at most {LARGEST}")
    return axes


def _plant(plant: Spec, axes: Sequence[Axis], values: Sequence[float]) -> Spec:
    table: Any = plant.to_dict()
    for axis, value in zip(axes, values, strict=True):
        table = _changed(table, axis, value)
    return Spec.from_dict(table, file=plant.file)


def _axis(key: str, given: Any) -> Axis:
    of_type("sweep", key, str, "a dotted key of the spec")
    if not isinstance(given, str):
        values = numbers(f"sweep {key}", given, np.float64).ravel().tolist()
        if not values:
            raise DataError(f"sweep {key}", given="no values", expected=f"numbers, or {_FORM}")
        return Axis(key, tuple(values), factor=False)
    found = _RANGE.fullmatch(given.strip())
    if found is None or found[2] != found[4] or int(found[5]) < 1:
        raise DataError(f"sweep {key}", given=repr(given), expected=_FORM)
    low, high, count = float(found[1]), float(found[3]), int(found[5])
    if not found[2]:
        return Axis(key, tuple(np.linspace(low, high, count).tolist()), factor=False)
    if not (low > 0.0 and high > 0.0):
        raise DataError(f"sweep {key}", given=repr(given), expected="factors above zero")
    return Axis(key, tuple(np.geomspace(low, high, count).tolist()), factor=True)


def _changed(table: dict[str, Any], axis: Axis, value: float) -> dict[str, Any]:
    """A spec with another value at a key."""
    parts = axis.key.split(".")

    def inside(found: Any, depth: int) -> Any:
        if depth == len(parts):
            return _scaled(found, value) if axis.factor else _replaced(found, value, axis.key)
        part, here = parts[depth], ".".join(parts[:depth]) or "the spec"
        if isinstance(found, list) and part.isdecimal() and int(part) < len(found):
            i = int(part)
            return [*found[:i], inside(found[i], depth + 1), *found[i + 1 :]]
        if isinstance(found, dict) and part in found:
            return {**found, part: inside(found[part], depth + 1)}
        known = list(found) if isinstance(found, dict) else []
        expected = f"a key of {here}: {choice(part, known)}" if known else f"nothing below {here}"
        raise DataError(f"sweep {axis.key}", given=f"an unknown key {part!r}", expected=expected)

    result: dict[str, Any] = inside(table, 0)
    return result


def _scaled(found: Any, factor: float) -> Any:
    if isinstance(found, list):
        return [_scaled(each, factor) for each in found]
    if isinstance(found, dict) and "default" in found:
        return {**found, "default": _scaled(found["default"], factor)}
    if isinstance(found, int | float) and not isinstance(found, bool):
        return found * factor
    if isinstance(found, str):
        return f"({found})*{factor!r}"
    raise DataError("sweep", given="a factor of no number", expected="the key of numbers")


def _replaced(found: Any, value: float, key: str) -> Any:
    if isinstance(found, dict) and "default" in found:
        return {**found, "default": value}
    if isinstance(found, list) and not any(isinstance(each, list) for each in found):
        return [value] * len(found)
    if isinstance(found, list) and list(np.shape(found)) == [1, 1]:
        return [[value]]
    if isinstance(found, list | dict):
        expected = f"factors of it, such as 0.5x:2x:5, or an entry, such as {key}.0.0"
        raise DataError(f"sweep {key}", given="numbers for a table or a matrix", expected=expected)
    return value


def table_of(found: Sweep) -> tuple[Sequence[str], list[list[str]]]:
    """Head, and a row for each plant."""
    ran = found.campaigns[0]
    head = [*(axis.key for axis in found.axes), *(f"rmse {name}" for name in ran.states)]
    head += ["NEES", "NIS", "verdict"]
    rows = []
    for at, each in np.ndenumerate(found.cells):
        row = [axis.label(axis.values[i]) for axis, i in zip(found.axes, at, strict=True)]
        if not isinstance(each, Campaign):
            rows.append([*row, *("-" for _ in head[len(row) : -1]), f"no such plant: {each}"])
            continue
        pairs = [*zip(*each.rmse, strict=True), each.nees, each.nis]
        rows.append([*row, *(str(Estimate(*pair)) for pair in pairs), _summary(each)])
    return head, rows


def _summary(found: Campaign) -> str:
    """What is not consistent, by verdict."""
    kinds = [kind for kind in dict.fromkeys(found.verdicts.values()) if kind != CONSISTENT]
    keys = {kind: [k for k, each in found.verdicts.items() if each == kind] for kind in kinds}
    return "; ".join(f"{kind}: {', '.join(keys[kind])}" for kind in kinds) or CONSISTENT
