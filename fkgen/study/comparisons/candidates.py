"""Which filters are compared, and what each of them is told of a simulation.

Filters for jumping plants that others derive: told the mode, or with losses as modes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError, UserError
from fkgen.families import ALIASES, NAMES, family
from fkgen.faults import JumpFaults
from fkgen.problem import Spec
from fkgen.trials.simulation import Simulation

Array = NDArray[np.floating]

#: Label of the filter that is told every fault.
YARDSTICK = "genie"


@dataclass(frozen=True, slots=True)
class Contender:
    """A filter that takes part.

    Attributes
    ----------
    label : str
        Its name in tables.
    spec : Spec
    """

    label: str
    spec: Spec


def fault_section(spec: Spec) -> str:
    """Which faults the plant of a spec has: ``actuator``, ``sensor`` or none."""
    return next(iter(spec.faults.plain()), "")


def contenders_of(specs: Sequence[Spec], families: Sequence[str]) -> tuple[Contender, ...]:
    """All filters that take part: the specs as they stand, or families for the first plant.

    Parameters
    ----------
    specs : sequence of Spec
        The first one is the truth. If there are several, each is a filter as well.
    families : sequence of str
        ``family`` or ``family:key=value``; the options are those of ``[filter]``.

    Raises
    ------
    DataError
        If there is nothing to compare, a family is not for these faults, or a filter is for another
        plant.
    """
    truth, found = specs[0], []
    if len(specs) > 1 or not families:
        found = [Contender(_label(spec, specs), spec) for spec in specs]
    found += [Contender(each, derived(truth, each)) for each in families]
    labels = [one.label for one in found]
    found = [one for i, one in enumerate(found) if one.label not in labels[:i]]
    for one in found:
        _refuse_other_plant(truth, one.spec)
    return tuple(found)


def default_families(spec: Spec) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Every family that the faults of a spec fit, and a sentence for each that does not take it."""
    own = fault_section(spec)
    everyone = {name: family(name) for name in NAMES}
    able = [n for n, f in everyone.items() if own in f.accepts and not f.traits.told]
    able += [n for n, f in everyone.items() if not f.accepts]
    found, left_out = [], []
    for name in able:
        try:
            derived(spec, name)
        except UserError as error:
            left_out.append(f"{name} does not take part: {error}")
        else:
            found.append(name)
    return tuple(found), tuple(left_out)


def derived(truth: Spec, text: str) -> Spec:
    """The spec of a family for the plant of another spec.

    Options of the family are those of the truth if it is of the same family, unless stated. A
    family that is about no faults is for the same plant with its faults left out: it takes every
    sensor and actuator to be good.

    Raises
    ------
    DataError
        If the family is not about these faults, or an option does not fit.
    """
    name, options = _wish(text)
    own = fault_section(truth)
    fitting = [each for each in NAMES if not (takes := family(each).accepts) or own in takes]
    if ":" not in name and ALIASES.get(name, name) not in fitting:
        about = f"{own} faults" if own else "a plant without faults"
        expected = f"of {about}: {', '.join(fitting)}"
        raise DataError("families", given=repr(name), expected=expected)
    found, table = family(name), truth.to_dict()
    same = family(truth.filter.family) is found
    table["filter"] = (truth.filter.plain() if same else {"family": name}) | _options(options)
    if not found.accepts:
        table["faults"] = {}
    return Spec.from_dict(found.adopt(table, truth), file=truth.file)


def _wish(text: str) -> tuple[str, list[str]]:
    """The family, which may be ``module:NAME``, and its options ``key=value``."""
    parts = text.split(":")
    name = ":".join(part for part in parts if "=" not in part)
    return name, [part for part in parts if "=" in part]


def healthy_modes(truth: Spec) -> int:
    """How many of the first modes of a filter stand for samples without fault."""
    return 1 if truth.faults.jump is None else len(truth.faults.jump.modes)


def _options(texts: Sequence[str]) -> dict[str, object]:
    options: dict[str, object] = {}
    for text in texts:
        key, _, value = text.partition("=")
        try:
            options[key] = float(value)
        except ValueError:
            options[key] = value
    return options


def _label(spec: Spec, specs: Sequence[Spec]) -> str:
    """The family, or the file too, or the place in the list too: what tells the filters apart."""
    family, files = spec.filter.family, [other.file for other in specs]
    if sum(other.filter.family == family for other in specs) == 1:
        return family
    if files.count(spec.file) == 1:
        return f"{family} ({Path(spec.file).stem})"
    return f"{family} ({next(i for i, other in enumerate(specs, 1) if other is spec)})"


def _refuse_other_plant(truth: Spec, spec: Spec) -> None:
    sizes = [(s.model.nx, s.model.nu, s.model.ny) for s in (spec, truth)]
    if sizes[0] != sizes[1]:
        words = [f"{n} states, {q} inputs, {p} measurements" for n, q, p in sizes]
        raise DataError(spec.file, given=words[0], expected=f"{words[1]}, as the first spec has")


def genie_of(truth: Spec) -> Contender:
    """The yardstick: a filter that is told every fault.

    For sensor faults the family ``genie``; for actuator faults a Kalman filter that is told what
    reaches the plant; for jumps one that is told modes and losses; without faults the Kalman filter
    itself.
    """
    if truth.faults.jump is not None:
        return Contender(YARDSTICK, informed(truth, truth.faults.jump))
    return Contender(
        YARDSTICK, derived(truth, "genie" if fault_section(truth) == "sensor" else "kf")
    )


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What a filter is told: measurements, inputs, parameters; which rows of y its NIS is about."""

    y: Array
    u: Array | None
    params: Mapping[str, Array]
    judged: tuple[int, ...]


def told(simulation: Simulation, spec: Spec, *, everything: bool) -> Told:
    """What a filter is told of a simulation; ``everything`` for the genie."""
    driven = simulation.u if spec.model.nu else None
    names = {parameter.name for parameter in spec.stated_parameters}
    params: dict[str, Array] = {
        name: value for name, value in simulation.params.items() if name in names
    }
    soft = spec.faults.soft
    rows = tuple(range(spec.model.ny)) if soft is None else soft.host
    if not everything:
        return Told(simulation.y, driven, params, rows)
    clean, gamma, delta = simulation.trials.measurement, simulation.gamma, simulation.delta
    if simulation.spec.faults.jump is not None:
        return _told_of_jumps(simulation, params)
    if gamma is not None and delta is not None:
        params |= {"gamma": gamma, "delta": delta}
    if driven is not None:
        driven = simulation.driving
        driven = driven if gamma is None or delta is not None else gamma * driven
    return Told(clean, driven, params, rows)


def _told_of_jumps(simulation: Simulation, params: dict[str, Array]) -> Told:
    """Indicators of the modes, lost samples as missing, and the input that adds offsets."""
    y, arrival = simulation.trials.measurement, simulation.arrival
    if arrival is not None:
        y = np.where(arrival[..., None], y, np.nan)
    driving = simulation.driving
    one = np.ones((*driving.shape[:-1], 1))
    told_u, told_params = np.concatenate([driving, one], axis=-1), params | indicators(simulation)
    return Told(y, told_u, told_params, tuple(range(y.shape[2])))


#: Parameter that is 1 in a mode and 0 in the others.
INDICATOR = "in_mode_{}"


def informed(truth: Spec, faults: JumpFaults) -> Spec:
    """The spec of a Kalman filter whose matrices are chosen by indicators of the modes.

    What a mode adds to the state is the coefficient of one more input, which is 1.

    Parameters
    ----------
    truth : Spec
    faults : JumpFaults
        Of the truth.
    """
    table: dict[str, Any] = truth.to_dict()
    modes: list[dict[str, Any]] = [mode.plain() for mode in faults.modes]
    n, p, q = truth.model.nx, truth.model.ny, truth.model.nu
    model = table["model"]
    for letter in ("A", "C", "Q", "R"):
        model[letter] = _chosen([mode[letter] for mode in modes])
    added = _chosen([[[entry] for entry in mode["c"]] for mode in modes])
    driven = _chosen([mode["B"] for mode in modes]) if q else [[] for _ in range(n)]
    direct = _chosen([mode["D"] for mode in modes]) if q else [[] for _ in range(p)]
    model["B"] = [[*row, *extra] for row, extra in zip(driven, added, strict=True)]
    model["D"] = [[*row, 0.0] for row in direct]
    model.pop("inputs", None)
    indicators = {INDICATOR.format(i): float(i == 0) for i in range(len(modes))}
    table["parameters"] = dict(table["parameters"]) | indicators
    return Spec.from_dict(table | {"faults": {}, "filter": {"family": "kf"}}, file=truth.file)


def _chosen(matrices: Sequence[Any]) -> list[list[Any]]:
    """Entries that differ as a sum over modes, those that do not as they are."""
    rows, columns = len(matrices[0]), len(matrices[0][0])
    return [[_entry([m[i][j] for m in matrices]) for j in range(columns)] for i in range(rows)]


def _entry(values: Sequence[object]) -> object:
    if all(value == values[0] for value in values):
        return values[0]
    return " + ".join(f"{INDICATOR.format(i)}*({value})" for i, value in enumerate(values))


def indicators(simulation: Simulation) -> dict[str, NDArray[np.float64]]:
    """(M, T) per mode: 1 where it is the one."""
    jump, mode = simulation.spec.faults.jump, simulation.mode
    if jump is None or mode is None:
        return {}
    return {INDICATOR.format(i): (mode == i).astype(float) for i in range(len(jump.modes))}
