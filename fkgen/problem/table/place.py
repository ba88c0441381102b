"""Where in a spec something stands, and how it is shown in a message."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches

from fkgen.errors import SpecError

WHOLE = "spec"
_SHOWN = 60
_NAMES = {dict: "table", list: "list", tuple: "list", str: "text", bool: "boolean"}


@dataclass(frozen=True, slots=True)
class Place:
    """A dotted path in a spec file: everything an error has to name."""

    file: str = "<dict>"  # The spec file, or "<dict>"
    key: str = WHOLE  # Dotted path, such as model.A[0][1]; "spec" is the whole of it

    def entry(self, name: str) -> Place:
        """Return the place of one key of this table."""
        shown = name if name.isprintable() and 0 < len(name) <= _SHOWN else show(name)
        return Place(self.file, shown if self.key == WHOLE else f"{self.key}.{shown}")

    def item(self, *indices: int) -> Place:
        """Return the place of one element of this list or matrix."""
        return Place(self.file, self.key + "".join(f"[{index}]" for index in indices))

    def error(self, given: str, expected: str) -> SpecError:
        """Return (not raise) the error that names this place."""
        return SpecError(self.key, given=given, expected=expected, file=self.file)


def show(value: object) -> str:
    """Return a value as one short line, whatever it is."""
    try:
        text = repr(value) if isinstance(value, str) else " ".join(repr(value).split())
    except (ValueError, RecursionError):  # more digits, or more nesting, than Python prints
        noun = type(value).__name__
        return f"{'an' if noun[:1].lower() in 'aeiou' else 'a'} {noun} too long to print"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def describe(value: object) -> str:
    """Return a value with its type in front, for errors about types."""
    return f"the {_NAMES.get(type(value), type(value).__name__)} {show(value)}"


def suggestion(given: str, choices: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` if one of the choices is close, else nothing."""
    by_lower = {choice.lower(): choice for choice in choices}
    close = get_close_matches(given.lower(), by_lower, n=1)
    return f"; did you mean '{by_lower[close[0]]}'?" if close else ""
