"""A whole spec: plant, parameters, faults, filter and code options, frozen and checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fkgen.problem.code import Code, read_code
from fkgen.problem.covariance import is_singular
from fkgen.problem.filter import Filter, filter_section, read_filter
from fkgen.problem.magnitude import check_magnitudes
from fkgen.problem.model import Model, read_model
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section, as_number, as_table
from fkgen.problem.text.naming import check_distinct, read_parameter_name, read_prefix

if TYPE_CHECKING:
    from fkgen.faults.chain import Mode
    from fkgen.faults.section import Faults

_KEYS = ("name", "model", "parameters", "faults", "filter", "code")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that can change at run time.

    Parameters
    ----------
    name : str
        A C identifier, usable in the expressions of the spec.
    default : float
        Its value where the user of the filter states none.
    """

    name: str
    default: float


#: Parameters that a family has of its own: the indicators that only a genie knows.
IMPLIED = {"genie": (Parameter("gamma", 1.0), Parameter("delta", 1.0))}


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
        In the order of the file, then those of the family (``gamma`` and ``delta`` of ``genie``).
    faults : Faults
        What can fail.
    filter : Filter
        The family and its options.
    code : Code
        Options of the generated code.
    file : str
        Where it comes from.
    """

    name: str
    model: Model
    parameters: tuple[Parameter, ...]
    faults: Faults
    filter: Filter
    code: Code
    file: str = field(default="<dict>", compare=False)

    @classmethod
    def from_dict(cls, table: object, file: str = "<dict>") -> Spec:
        """Return the spec that a nested dict describes, as a TOML file would.

        Parameters
        ----------
        table : mapping
            The sections of the spec file. Matrices may also be NumPy arrays, SymPy or CasADi
            matrices; ``model.system`` may be a discrete-time ``control.StateSpace``. It is
            neither changed nor kept.
        file : str, optional
            For messages.

        Raises
        ------
        SpecError
            If anything in it is missing, unknown, of the wrong type or shape, or impossible.
        """
        from fkgen.faults.jump_filter import check_jumps  # noqa: PLC0415
        from fkgen.faults.linear_optimal import check_linear_filter  # noqa: PLC0415
        from fkgen.faults.section import read_faults  # noqa: PLC0415

        place = Place(file)
        section = _whole(table, place)
        given_name = section.require("name", "a C identifier")
        given_filter = section.require("filter", "a table with the family of the filter")
        options = filter_section(given_filter, place.entry("filter"))
        family = str(options.table["family"])
        parameters = _read_parameters(section, place, family)
        defaults = {parameter.name: parameter.default for parameter in parameters}
        model_place = place.entry("model")
        given_model = section.require("model", "a table with the plant")
        model = read_model(given_model, model_place, defaults)
        _check_inputs(model, model_place, family)
        given_faults = section.table.get("faults", {})
        faults = read_faults(given_faults, place.entry("faults"), defaults, family, model)
        reading = read_filter(options, faults, model.nu)
        code = read_code(section.table.get("code", {}), place.entry("code"))
        check_magnitudes(model, model_place, defaults, code.scalar)
        if faults.sensor is not None:
            check_linear_filter(model, place, faults.sensor, reading)
        if faults.jump is not None:
            check_jumps(faults.jump, place, reading, defaults, code.scalar)
        else:
            _check_noise(model, model_place, family, defaults)
        return cls(
            name=read_prefix(given_name, place.entry("name")),
            model=model,
            parameters=parameters,
            faults=faults,
            filter=reading,
            code=code,
            file=file,
        )

    @property
    def defaults(self) -> dict[str, float]:
        """The default value of every parameter."""
        return {parameter.name: parameter.default for parameter in self.parameters}

    @property
    def plants(self) -> tuple[Model | Mode, ...]:
        """The model, or every mode in place of it where the plant jumps."""
        return (self.model,) if self.faults.jump is None else self.faults.jump.modes

    @property
    def stated_parameters(self) -> tuple[Parameter, ...]:
        """The parameters of the file, without those that the family brings along."""
        implied = IMPLIED.get(self.filter.family, ())
        return tuple(item for item in self.parameters if item not in implied)

    def to_dict(self) -> dict[str, object]:
        """Return plain dicts, lists, numbers and texts; `from_dict` gives an equal spec back."""
        return {
            "name": self.name,
            "model": self.model.plain(),
            "parameters": {item.name: item.default for item in self.stated_parameters},
            "faults": self.faults.plain(),
            "filter": self.filter.plain(),
            "code": self.code.plain(),
        }

    def canonical(self) -> str:
        """Return a JSON text that is equal for equal specs and different for different ones."""
        table = self.to_dict()
        table["parameters"] = [[item.name, item.default] for item in self.stated_parameters]
        return json.dumps(table, sort_keys=True, allow_nan=False, separators=(",", ":"))


def _whole(table: object, place: Place) -> Section:
    """Return the top level of a spec, which must not be empty."""
    if not as_table(table, place, "a table (a dict) with a spec in it"):
        raise place.error("an empty spec", f"a table with {', '.join(_KEYS)}")
    return Section(table, place, known=_KEYS)


def _read_parameters(whole: Section, place: Place, family: str) -> tuple[Parameter, ...]:
    place = place.entry("parameters")
    table = whole.table.get("parameters", {})
    entries = as_table(table, place, "a table of default values, such as tau = 0.05")
    parameters = tuple(
        Parameter(
            read_parameter_name(name, place.entry(name)),
            as_number(value, place.entry(name), "a finite number, the default"),
        )
        for name, value in entries.items()
    )
    for implied in IMPLIED.get(family, ()):
        if implied.name in entries:
            raise place.entry(implied.name).error(
                f"a parameter {implied.name}",
                f"another name: the family {family} has a parameter {implied.name} of its own",
            )
    parameters += IMPLIED.get(family, ())
    check_distinct((parameter.name for parameter in parameters), place, "parameters")
    return parameters


def _check_inputs(model: Model, place: Place, family: str) -> None:
    """Refuse plants without what the family is about."""
    if family in {"mkf", "mme"} and model.nu == 0:
        raise place.entry("B").error(
            "nothing (no input)", f"B: the family {family} is about faults of the input"
        )


def _check_noise(model: Model, place: Place, family: str, defaults: Mapping[str, float]) -> None:
    """Refuse exact measurements where the family compares densities, or nothing is random."""
    if not is_singular(model.R.values(defaults)):
        return
    if family in {"mme", "one_step", "imm"}:
        raise place.entry("R").error(
            "a singular matrix",
            f"a positive definite R for the family {family}: it compares densities",
        )
    if not model.Q.values(defaults).any():
        raise place.entry("R").error(
            "a singular matrix, and Q = 0",
            "a positive definite R where there is no process noise, or some process noise",
        )
