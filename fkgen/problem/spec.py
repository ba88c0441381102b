"""A whole spec: plant, parameters, faults, filter and code options, frozen and checked."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fkgen.console import html_table
from fkgen.errors import of_type
from fkgen.problem.code import Code, read_code
from fkgen.problem.equations import ABSENT, Equations
from fkgen.problem.filter import Filter, Parameter, registry
from fkgen.problem.model import Model, read_model
from fkgen.problem.scope import (
    check_float,
    delays_of,
    plain_parameters,
    read_parameters,
    read_tables,
    vectors,
)
from fkgen.problem.signals import PREFIX, read_name
from fkgen.problem.table.columns import Columns, read_record
from fkgen.problem.table.place import Place, describe
from fkgen.problem.table.section import Section, as_table
from fkgen.problem.text.expression import Expression, Scope, evaluate
from fkgen.problem.text.lookup import Table
from fkgen.problem.text.matrix import Matrix, expressions
from fkgen.problem.text.metadata import Metadata, read_metadata

if TYPE_CHECKING:  # types alone: faults are read by their families
    from fkgen.faults import Faults, Mode

#: Smallest variance above zero, and largest entry of any matrix: squares and reciprocals still fit.
LIMITS = {"double": (1e-100, 1e100), "float": (1e-30, 1e18)}

_KEYS = ("name", "model", "parameters", "tables", "faults", "filter", "code", "record", "package")


@dataclass(frozen=True, slots=True)
class Spec:
    """What the user wants, checked.

    Equal and of equal hash if they say the same; the file they come from does not count.

    Parameters
    ----------
    name : str
        Prefix of every symbol of the generated code.
    model : Model
        The plant.
    parameters : tuple of Parameter
        In the order of the file, then those of the family (``gamma`` and ``delta`` of ``genie``),
        then the delays of rows that may be late.
    faults : Faults
        What can fail.
    filter : Filter
        The family and its options.
    code : Code
        Options of the generated code.
    tables : tuple of Table
        What expressions may look up.
    record : Columns
        Names of columns in record files.
    package : Metadata
        What packages say about themselves.
    file : str
        Where it comes from.
    """

    name: str
    model: Model
    parameters: tuple[Parameter, ...]
    faults: Faults
    filter: Filter
    code: Code
    tables: tuple[Table, ...] = ()
    record: Columns = field(default_factory=Columns)
    package: Metadata = field(default_factory=Metadata, compare=False)
    file: str = field(default="<dict>", compare=False)

    @classmethod
    def from_dict(cls, table: object, file: str = "<dict>") -> Spec:
        """Return the spec that a nested dict describes, as a TOML file would.

        Parameters
        ----------
        table : mapping
            The sections of the spec file. Matrices may also be NumPy arrays, SymPy or CasADi
            matrices; ``model.system`` may be a ``control.StateSpace``; ``model.f`` and
            ``model.h`` CasADi functions, or callables over CasADi symbols. It is neither changed
            nor kept.
        file : str, optional
            For messages.

        Raises
        ------
        SpecError
            If anything in it is missing, unknown, of the wrong type or shape, or impossible.
        """
        place = Place(of_type("file", file, str, "a text, for messages"))
        if not as_table(table, place, "a table (a dict) with a spec in it"):
            raise place.error("an empty spec", f"a table with {', '.join(_KEYS)}")
        whole = Section(table, place, known=_KEYS)
        given_name = whole.require("name", "a C identifier")
        name = read_name(given_name, place.entry("name"), PREFIX)
        given_filter = whole.require("filter", "a table with the family of the filter")
        families = registry()
        family, options = families.section_of(given_filter, place.entry("filter"))
        parameters, defaults = _read_scope(whole, place, name, family)
        given_model = whole.require("model", "a table with the plant")
        model = read_model(given_model, place.entry("model"), defaults)
        parameters = (*parameters, *delays_of(model, parameters, place.entry("parameters")))
        family.check_model(model, place)
        given_faults, where = whole.table.get("faults", {}), place.entry("faults")
        faults = families.read_faults(family, given_faults, where, defaults, model)
        spec = cls(
            name=name,
            model=model,
            parameters=parameters,
            faults=faults,
            filter=_read_filter(options, family, faults, model),
            code=read_code(whole.table.get("code", {}), place.entry("code")),
            tables=tuple(defaults.tables.values()),
            record=_read_record(whole, model, [each.name for each in parameters]),
            package=read_metadata(whole.table.get("package", {}), place.entry("package")),
            file=file,
        )
        _check_numbers(spec, place)
        _check_ranges(spec, place.entry("model").entry("states"))
        family.check_spec(spec)
        return spec

    @property
    def defaults(self) -> dict[str, float]:
        """The default value of every parameter."""
        return {parameter.name: parameter.default for parameter in self.parameters}

    @property
    def expressions(self) -> Iterator[Expression]:
        """Every entry of the plants and of what is said about faults, the start left out.

        In terms of parameters: equations have trees of their own.
        """
        none, jump = Matrix(()), self.faults.jump
        plants = (replace(self.model, x0=none, P0=none),) if jump is None else jump.modes
        noises = tuple(each.noises for each in self.equations)
        return expressions((plants, self.faults.lasting, noises))

    @property
    def start_expressions(self) -> Iterator[Expression]:
        """Every entry of what sample 0 begins with."""
        return expressions((self.model.x0, self.model.P0, self.faults.firsts))

    @property
    def equations(self) -> tuple[Equations, ...]:
        """What plants have in place of matrices."""
        return tuple(each.equations for each in self.plants if each.equations is not None)

    @property
    def trees(self) -> Iterator[Expression]:
        """Every tree of equations, in terms of states, inputs, noises and parameters."""
        return (tree for each in self.equations for tree in each.trees)

    @property
    def period(self) -> float | None:
        """The sample time in seconds; that of the defaults where it is a parameter."""
        stated = self.model.sample_time
        return self.defaults[stated] if isinstance(stated, str) else stated

    @property
    def placed_plants(self) -> tuple[tuple[Model | Mode, Place], ...]:
        """The model, or every mode in place of it where the plant jumps, and where it is stated."""
        if self.faults.jump is None:
            return ((self.model, Place(self.file, "model")),)
        place = Place(self.file, "faults.jump.modes")
        return tuple((mode, place.item(i)) for i, mode in enumerate(self.faults.jump.modes))

    @property
    def plants(self) -> tuple[Model | Mode, ...]:
        """The same without places."""
        return tuple(plant for plant, _ in self.placed_plants)

    @property
    def first_rates(self) -> tuple[float, ...] | None:
        """Of hypotheses about success rates the first, which is true where a record is drawn."""
        hypotheses: tuple[tuple[float, ...], ...] = self.filter.option("hypotheses", ())
        return hypotheses[0] if hypotheses else None

    @property
    def stated_parameters(self) -> tuple[Parameter, ...]:
        """The parameters of the file, without those of the family, and the delays of rows."""
        told = [item.name for item in self.filter.traits.told]
        told += [signal.delay for signal in self.model.outputs if signal.max_delay]
        return tuple(item for item in self.parameters if item.name not in told)

    @property
    def whole(self) -> Spec:
        """The same filter with all its ports, for those who look into it."""
        return replace(self, code=replace(self.code, ports=None))

    def to_dict(self) -> dict[str, object]:
        """Return plain dicts, lists, numbers and texts; `from_dict` gives an equal spec back."""
        table: dict[str, object] = {
            "name": self.name,
            "model": self.model.plain(),
            "parameters": plain_parameters(self.stated_parameters),
            "faults": self.faults.plain(),
            "filter": self.filter.plain(),
            "code": self.code.plain(),
        }
        tables = {each.name: each.plain() for each in self.tables}
        optional = {"tables": tables, "record": self.record.plain()}
        optional |= {"package": self.package.plain()}
        return table | {key: value for key, value in optional.items() if value}

    def canonical(self) -> str:
        """Return a JSON text that is equal for equal specs and different for different ones."""
        table: Any = self.to_dict()
        table.pop("package", None)
        table["parameters"] = [list(pair) for pair in table["parameters"].items()]
        if found := [[list(pair) for pair in each.plain_let] for each in self.equations]:
            table["let"] = found
        return json.dumps(table, sort_keys=True, allow_nan=False, separators=(",", ":"))

    def _repr_html_(self) -> str:
        """Signals and parameters, for a notebook."""
        model = self.model
        roles = {"state": model.states, "input": model.inputs, "measurement": model.outputs}
        rows = [(role, each.name, each.unit) for role, signals in roles.items() for each in signals]
        rows += [("parameter", each.name, f"{each.default:g}") for each in self.stated_parameters]
        caption = f"{self.name}: {self.filter.family}"
        return html_table(caption, ("role", "name", "unit or default"), rows)


def _read_filter(options: Section, family: Any, faults: Faults, model: Model) -> Filter:
    """The family with its options, and whether there is anything to linearise."""
    plants: list[Model | Mode] = [model]
    plants += [] if faults.jump is None else faults.jump.modes
    return Filter(
        str(options.table["family"]),
        family.options.read(options, faults, model),
        linearises=any(plant.equations is not None for plant in plants),
    )


def _read_record(whole: Section, model: Model, parameters: Sequence[str]) -> Columns:
    """Where signals and parameters stand in record files."""
    place, known = whole.place.entry("record"), (*model.outputs, *model.inputs)
    given = whole.table.get("record", {})
    return read_record(given, place, [*(signal.name for signal in known), *parameters])


def _check_numbers(spec: Spec, place: Place) -> None:
    """Refuse numbers that the scalar type of the code cannot hold, or work with."""
    largest = float(np.finfo("f4" if spec.code.scalar == "float" else "f8").max)
    check_float(spec.parameters, spec.tables, largest, place)
    for plant, at in ((spec.model, place.entry("model")), *spec.placed_plants):
        _check_magnitudes(plant, at, spec)


def _check_ranges(spec: Spec, place: Place) -> None:
    """Refuse ranges of states that the start lies outside of, or that say nothing of what is kept.

    The states that a mode leaves out are 0 in it.
    """
    traits, jump = spec.filter.traits, spec.faults.jump
    x0 = spec.model.x0.values(spec.defaults).ravel().tolist()
    for each in spec.model.ranged:
        start, where = x0[each.at], place.entry(each.name).entry("range")
        given = f"[{each.low:g}, {each.high:g}]"
        if traits.moments or traits.windows != "none":
            kept = "moments" if traits.moments else "windows"
            expected = (
                f"none for the family {spec.filter.family}: besides estimates it keeps {kept}"
            )
            raise where.error(given, expected)
        if not each.low <= start <= each.high:
            expected = f"a range around x0[{each.at}] = {start:g}, where the filter starts"
            raise where.error(given, expected)
        absent = jump is not None and not all(held[each.at] for held in jump.held)
        if absent and not each.low <= 0.0 <= each.high:
            raise where.error(given, "a range around 0: modes that leave this state out have 0")


def as_spec(value: object, what: str = "spec") -> Spec:
    """Return what was given as a spec.

    Raises
    ------
    DataError
        If it is none.
    """
    expected = "a Spec: fkgen.load(path) or fkgen.Spec.from_dict(table)"
    spec: Spec = of_type(what, value, Spec, expected)
    return spec


def _check_magnitudes(plant: Model | Mode, place: Place, spec: Spec) -> None:
    """Refuse entries beyond `LIMITS`; parameters have their default values."""
    scalar = spec.code.scalar
    smallest, largest = LIMITS[scalar]
    for i, noise in enumerate(() if plant.equations is None else plant.equations.noises):
        variance = evaluate(noise.variance, spec.defaults)
        if not (variance == 0.0 or smallest <= variance <= largest):
            where = Place(spec.file, "model.noises").item(i).entry("variance")
            expected = f"0, or {smallest:g} to {largest:g} with scalar {scalar!r}"
            raise where.error(f"{variance:g}", expected)
    for name in ("A", "B", "C", "D", "Q", "R", "x0", "P0", "c", "d", "S"):
        found = getattr(plant, name, ABSENT)
        values = () if found is ABSENT else found.values(spec.defaults)
        for at, value in np.ndenumerate(values):
            expected = ""
            if abs(value) > largest:
                expected = f"at most {largest:g} in magnitude"
            elif name in {"Q", "R", "P0"} and at[0] == at[1] and 0.0 < value < smallest:
                expected = f"0 or at least {smallest:g}"
            if expected:
                indices = at[:1] if name in {"x0", "c", "d"} else at
                where = place.entry(name).item(*indices)
                raise where.error(f"{value:g}", f"{expected} with scalar {scalar!r}")


def _read_scope(
    whole: Section, place: Place, name: str, family: Any
) -> tuple[tuple[Parameter, ...], Scope]:
    """The parameters, and what expressions may name."""
    given, told = whole.table.get("parameters", {}), family.traits.told
    parameters = read_parameters(given, place.entry("parameters"), name, told, family.name)
    tables = read_tables(whole.table.get("tables", {}), place.entry("tables"))
    defaults = {each.name: each.default for each in parameters}
    return parameters, Scope(defaults, tables, vectors(parameters), [each.name for each in told])


def load(path: str | os.PathLike[str]) -> Spec:
    """Return the spec in a TOML file.

    Parameters
    ----------
    path : str or path
        The file.

    Raises
    ------
    SpecError
        If the file cannot be read, is not UTF-8 or not TOML, or does not hold a spec.
    """
    if not isinstance(path, str | os.PathLike):
        raise Place().entry("path").error(describe(path), "the path of a spec file")
    file = str(path)
    place = Place(file, "file")
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        given = f"bytes that are not UTF-8 at offset {fault.start}"
        raise place.error(given, "a UTF-8 text") from None
    except OSError as fault:
        reason = (fault.strerror or type(fault).__name__).lower()
        raise place.error(f"a path that cannot be read ({reason})", "a readable file") from None
    except ValueError:
        raise place.error("a path with a null character", "a readable file") from None
    try:
        table = tomllib.loads(text)
    except RecursionError:
        raise place.error("arrays or tables nested too deeply", "a spec in TOML") from None
    except ValueError as fault:
        last = text.count("\n") + 1
        end = f"at line {last}, the end of the document"
        reason = " ".join(str(fault).split()).replace("at end of document", end)
        raise place.error(f"invalid TOML: {reason}", "a spec in TOML") from None
    return Spec.from_dict(table, file=file)
