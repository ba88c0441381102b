"""What ships beside the code: spec files to begin with, one per family, and the examples."""

from __future__ import annotations

from pathlib import Path

from fkgen.errors import DataError, InternalError
from fkgen.families import ALIASES, NAMES
from fkgen.families import family as find
from fkgen.runtime.record import choice


def starter(family: str) -> str:
    """The text of a commented spec of a family that loads and validates as it is."""
    if family not in (*NAMES, *ALIASES):
        raise DataError("family", given=repr(family), expected=choice(family, NAMES))
    return resource(f"templates/{find(family).starter}").read_text(encoding="utf-8")


def resource(name: str) -> Path:
    """A file that stands in the package when installed, and beside it in a checkout."""
    package = Path(__file__).resolve().parents[2]
    for place in (package / name, package.parent / name):
        if place.is_file():
            return place
    raise InternalError(f"{name} is missing from this installation of fkgen")
