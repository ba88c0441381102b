"""Which filters are compared, and what each of them is given of a simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError, UserError
from fkgen.families import ALIASES, NAMES, family
from fkgen.faults import JumpFaults
from fkgen.faults.chain import Mode
from fkgen.faults.jump import ENTERED, INDICATOR
from fkgen.problem import Spec
from fkgen.problem.functions.reading import plain_equations
from fkgen.problem.table.place import Place
from fkgen.trials.simulation import Simulation

Array = NDArray[np.floating]

#: Label of the genie-aided filter.
GENIE = "genie"


def fault_section(spec: Spec) -> str:
    """Which faults the plant of a spec has: ``actuator``, ``sensor`` or none."""
    return next(iter(spec.faults.plain()), "")


def candidates_of(specs: Sequence[Spec], families: Sequence[str]) -> dict[str, Spec]:
    """All filters that take part, by label: the specs as they stand, families for the first plant.

    The first spec is the truth; if there are several, each is a filter as well. A family is
    ``family`` or ``family:key=value``; the options are those of ``[filter]``.
    """
    truth, found = specs[0], dict[str, Spec]()
    if len(specs) > 1 or not families:
        found = {_label(spec, specs): spec for spec in specs}
    for each in families:
        found.setdefault(each, derived(truth, each))
    for spec in found.values():
        sizes = [(s.model.nx, s.model.nu, s.model.ny) for s in (spec, truth)]
        if sizes[0] != sizes[1]:
            given, wanted = (f"{n} states, {q} inputs, {p} measurements" for n, q, p in sizes)
            raise DataError(spec.file, given=given, expected=f"{wanted}, as the first spec has")
    return found


def default_families(spec: Spec) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Every family that the faults of a spec fit, and a sentence for each that does not take it."""
    own, everyone = fault_section(spec), {name: family(name) for name in NAMES}
    able = [n for n, f in everyone.items() if own in f.accepts and not f.traits.told]
    found, left_out = [], []
    plain = [n for n, f in everyone.items() if not f.accepts]
    plain = [n for n in plain if everyone[n].traits.nonlinear == spec.filter.linearises]
    for name in (*able, *(plain[:1] if own else plain)):
        try:
            derived(spec, name)
        except UserError as error:
            left_out.append(f"{name} does not take part: {error}")
        else:
            found.append(name)
    return tuple(found), tuple(left_out)


def derived(truth: Spec, text: str, *, inherits: bool = True) -> Spec:
    """The spec of a family, stated as in `candidates_of`, for the plant of another spec.

    Options of the family are those of the truth if it is of the same family, unless stated, and
    where it ``inherits`` them. A
    family that is about no faults is for the same plant with its faults left out: it takes every
    sensor and actuator to be good.
    """
    parts, own = text.split(":"), fault_section(truth)
    name = ":".join(part for part in parts if "=" not in part)  # may be module:NAME
    fitting = [each for each in NAMES if not (takes := family(each).accepts) or own in takes]
    if ":" not in name and ALIASES.get(name, name) not in fitting:
        about = f"{own} faults" if own else "a plant without faults"
        curved = truth.filter.linearises
        meant = [n for n in fitting if family(n).accepts or family(n).traits.nonlinear == curved]
        expected = f"of {about}: {', '.join(meant)}"
        raise DataError("families", given=repr(name), expected=expected)
    found, table = family(name), truth.to_dict()
    same = inherits and family(truth.filter.family) is found
    options = _options([part for part in parts if "=" in part])
    table["filter"] = (truth.filter.plain() if same else {"family": name}) | options
    if not found.accepts:
        table["faults"] = {}
    return Spec.from_dict(found.adopt(table, truth), file=truth.file)


def _options(texts: Sequence[str]) -> dict[str, object]:
    options: dict[str, object] = {}
    for text in texts:
        key, _, value = text.partition("=")
        options[key] = value
        with suppress(ValueError):
            options[key] = float(value)
    return options


def _label(spec: Spec, specs: Sequence[Spec]) -> str:
    """The family, or the file too, or the place in the list too: what tells the filters apart."""
    family, file = spec.filter.family, Path(spec.file).stem
    if sum(other.filter.family == family for other in specs) == 1:
        return family
    if sum(Path(other.file).stem == file for other in specs) == 1:
        return f"{family} ({file})"
    return f"{family} ({next(i for i, other in enumerate(specs, 1) if other is spec)})"


def genie_of(truth: Spec) -> Spec:
    """The genie-aided filter, which is told every fault: the lower bound of all others.

    For sensor faults the family ``genie``; for actuator faults a Kalman filter that is told what
    reaches the plant; for jumps one that is told modes and losses; without faults the Kalman filter
    itself, without a gate and with a gain that follows the covariance. Of a plant with f and h it
    is the extended Kalman filter: no bound, but what the others are compared with.
    """
    if truth.faults.jump is not None:
        return _mode_aided(truth, truth.faults.jump)
    name = "ekf" if truth.filter.linearises else "kf"
    name = "genie" if truth.faults.sensor is not None else name
    return derived(truth, name, inherits=False)


@dataclass(frozen=True, slots=True, eq=False)
class FilterInputs:
    """What a filter is given: measurements, inputs, parameters; and the rows its NIS is about."""

    y: Array
    u: Array | None
    params: Mapping[str, Array]
    tested: tuple[int, ...]


def filter_inputs(simulation: Simulation, spec: Spec, *, genie: bool) -> FilterInputs:
    """What a filter is given of a simulation; everything, if it is the genie-aided one."""
    truth, soft = simulation.spec, spec.faults.soft
    u = simulation.u if spec.model.nu else None
    names = {parameter.name for parameter in spec.stated_parameters}
    params: dict[str, Array] = {n: value for n, value in simulation.params.items() if n in names}
    rows = tuple(range(spec.model.ny)) if soft is None else soft.host
    if not genie:
        return FilterInputs(simulation.y, u, params, rows)
    y, driving = simulation.trials.measurement, simulation.driving
    gamma, delta = simulation.gamma, simulation.delta
    if truth.faults.jump is not None and simulation.mode is not None:
        if simulation.arrival is not None:
            y = np.where(simulation.arrival[..., None], y, np.nan)
        for i in range(len(truth.faults.jump.modes)):
            params[INDICATOR.format(i)] = (simulation.mode == i).astype(float)
            if truth.faults.jump.unequal:
                entered = np.roll(simulation.mode, -1, axis=1)  # nothing is asked after the last
                params[ENTERED.format(i)] = (entered == i).astype(float)
        u = driving if spec.model.nu else None
        if not truth.filter.linearises:  # what a mode adds is driven by an input that is 1
            u = np.concatenate([driving, np.ones((*driving.shape[:-1], 1))], axis=-1)
    elif gamma is not None and delta is not None:
        params |= {"gamma": gamma, "delta": delta}
        u = None if u is None else driving
    elif u is not None:
        u = driving if gamma is None else gamma * driving
    return FilterInputs(y, u, params, rows)


def _demand_sampled(truth: Spec) -> None:
    """Refuse modes with states of their own whose steps are computed at run time."""
    if truth.model.source is not None and not truth.model.A.is_constant:
        moving = ", ".join(sorted(truth.model.A.names))
        raise Place(truth.file, "model.sample_time").error(
            f"a step that depends on {moving}, where modes leave states out",
            "a number, and constants: the filter that is told the mode needs every mode's own step",
        )


def _mode_aided(truth: Spec, faults: JumpFaults) -> Spec:
    """The spec of a Kalman filter that is told the mode.

    What a mode adds to the state and to y is the coefficient of one more input, which is 1.
    """
    table: dict[str, Any] = truth.to_dict()
    told = faults.told()
    if told.equations is not None:
        return _mode_aided_equations(truth, table, told)
    added = {
        "B": [[*row, *extra] for row, extra in zip(told.B.plain(), told.c.plain(), strict=True)],
        "D": [[*row, *extra] for row, extra in zip(told.D.plain(), told.d.plain(), strict=True)],
    }
    table["model"] |= {"c": [0.0] * truth.model.nx, "d": [0.0] * truth.model.ny}
    kept = {letter: getattr(told, letter).plain() for letter in ("A", "C", "Q", "R")}
    table["model"] |= kept | added
    table["model"].pop("inputs", None)
    if faults.unequal:  # what is left out does not stay as it is, as continuous time would have it
        table["model"].pop("time", None)
        _demand_sampled(truth)
    for name in (INDICATOR, ENTERED) if faults.unequal else (INDICATOR,):
        table["parameters"] |= {name.format(i): float(i == 0) for i in range(len(faults.modes))}
    return Spec.from_dict(table | {"faults": {}, "filter": {"family": "kf"}}, file=truth.file)


def _mode_aided_equations(truth: Spec, table: dict[str, Any], told: Mode) -> Spec:
    """The same of a plant with f and h, which read the mode."""
    model = truth.model
    kept = ("states", "inputs", "outputs", "x0", "P0", "sample_time")
    stated = {key: value for key, value in table["model"].items() if key in kept}
    if told.equations is not None:
        stated |= plain_equations(told.equations, model.states, model.outputs)
    stated |= {letter: getattr(told, letter).plain() for letter in "QR"}
    modes = () if truth.faults.jump is None else truth.faults.jump.modes
    table["parameters"] |= {INDICATOR.format(i): float(i == 0) for i in range(len(modes))}
    changed = {"model": stated, "faults": {}, "filter": {"family": "ekf"}}
    return Spec.from_dict(table | changed, file=truth.file)
