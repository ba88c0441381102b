"""The filter families. Each is one module with a ``FAMILY``; this is the only list of them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module

from fkgen.families.family import Family
from fkgen.faults import Faults
from fkgen.faults.section import KINDS
from fkgen.problem import Model
from fkgen.problem.table.place import Place, show, suggestion
from fkgen.problem.table.section import Section, as_table

#: Names in the order of ``fkgen families``.
NAMES = (
    "kf",
    "ekf",
    "iekf",
    "ukf",
    "mkf",
    "mme",
    "linear_optimal",
    "one_step",
    "imm",
    "genie",
    "mjls_lmmse",
    "compression_full",
    "dfcf",
    "cpcf",
)

#: Other names of the literature.
ALIASES = {"gpb1": "one_step", "mmae": "mme"}

#: What names a family that is not in the list.
EXPECTED = "module:NAME, a Family in an importable module"


@cache
def family(name: str) -> Family:
    """The family of this name, or that in ``module:NAME``."""
    return find(name, Place().entry("filter").entry("family"))


def find(given: object, place: Place) -> Family:
    """The family that a spec asks for."""
    if isinstance(given, str) and ":" in given:
        module, _, value = given.partition(":")
        if not all(part.isidentifier() for part in (*module.split("."), value)):
            raise place.error(show(given), EXPECTED)
        return _value(module, value, place)
    name = ALIASES.get(given, given) if isinstance(given, str) else given
    if not isinstance(name, str) or name not in NAMES:
        hint = suggestion(name, NAMES) if isinstance(name, str) else ""
        raise place.error(show(given), f"one of {', '.join(NAMES)}{hint}")
    return _value(f"fkgen.families.{name}", "FAMILY", place)


def _value(module: str, name: str, place: Place) -> Family:
    """The value of this name in a module, which has to be a family."""
    given = show(f"{module}:{name}")
    try:
        found = getattr(import_module(module), name, None)
    except Exception as fault:
        reason = " ".join(str(fault).split())
        raise place.error(f"{given}: {type(fault).__name__}, {reason}", EXPECTED) from fault
    if not isinstance(found, Family):
        what = "has no such name" if found is None else f"is of type {type(found).__name__}"
        raise place.error(f"{given}, which {what}", EXPECTED)
    return found


def section_of(table: object, place: Place) -> tuple[Family, Section]:
    """The section ``filter`` and the family that it names; its keys are those of the family."""
    entries = as_table(table, place, "a table with family and its options")
    section = Section(entries, place, known=tuple(entries))
    given = section.require("family", f"one of {', '.join(NAMES)}")
    found = find(given, place.entry("family"))
    section.table["family"] = ALIASES.get(str(given), given)
    for key in section.table:
        if key != "family" and key not in found.keys:
            raise _foreign_key(key, found, place)
    return found, section


def _foreign_key(key: str, found: Family, place: Place) -> Exception:
    """The error for an option of another family, or of none."""
    everyone = {name: family(name).keys for name in NAMES}
    owners = [name for name, keys in everyone.items() if key in keys]
    if owners:
        able = f"the family {owners[0]}" if len(owners) == 1 else ", ".join(owners)
        return place.entry(key).error(
            f"{key} for the family {found.name}", f"{key} only for {able}"
        )
    known = tuple(dict.fromkeys(("family", *found.keys, *sum(everyone.values(), ()))))
    hint = suggestion(key, known)
    return place.entry(key).error("an unknown key", f"one of {', '.join(known)}{hint}")


def read_faults(
    found: Family, table: object, place: Place, defaults: Mapping[str, float], model: Model
) -> Faults:
    """The faults that a family is about: of the sections that it accepts, the one that is there."""
    given = Section(table, place, known=tuple(KINDS))
    for kind in given.table:
        if kind not in found.accepts:
            able = ", ".join(name for name in NAMES if kind in family(name).accepts)
            raise place.entry(kind).error(
                f"{kind} faults", f"none for the family {found.name}; {able} handle {kind} faults"
            )
    if not found.accepts:
        return Faults()
    present = list(given.table)
    if len(present) > 1:
        first, second = [kind for kind in found.accepts if kind in given][:2]
        raise place.entry(second).error(
            f"{second} faults beside {first} faults", f"one of them for the family {found.name}"
        )
    if not present and not found.optional_faults:
        raise place.entry(next(iter(found.accepts))).error(
            "nothing (the section is missing)",
            f"{' or '.join(found.accepts)} faults for the family {found.name}",
        )
    kind = (present or list(found.accepts))[0]
    entries, where = given.table.get(kind, {}), place.entry(kind)
    section = Section(entries, where, known=KINDS[kind], defaults=defaults)
    return Faults(**{kind: found.accepts[kind](section, model, found.name)})
