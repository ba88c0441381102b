"""What ships beside the code: spec files to begin with, one per family, and the examples."""

from __future__ import annotations

from pathlib import Path

from fkgen.errors import DataError, InternalError
from fkgen.families import ALIASES, NAMES
from fkgen.families import family as find
from fkgen.runtime.record import choice
from fkgen.study.records.reading import Reading


def begun(family: str | None, record: Reading | None, inputs: str, output: str) -> tuple[str, str]:
    """The text of a spec to begin with, and the command to go on with."""
    if record is None:
        if family is None:
            expected = f"the name of a family ({', '.join(NAMES)}), or --from RECORD"
            raise DataError("FAMILY", given="nothing", expected=expected)
        return starter(family), f"fkgen check {output}"
    from fkgen.study.reports.first_spec import first_spec  # noqa: PLC0415 - slow to import

    text = first_spec(record, inputs)
    if family is not None and f'family = "{family}"' not in text:
        expected = "none: the spec from a record is a Kalman filter to begin with"
        raise DataError("FAMILY", given=f"{family!r} beside --from", expected=expected)
    return text, f"fkgen run {output} {record.path}"


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
