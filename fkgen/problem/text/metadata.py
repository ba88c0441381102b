"""What packages say about themselves: version, author and the like. No part of the filter."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields

from fkgen.problem.table.place import Place, describe, show
from fkgen.problem.table.section import Section

_VERSION = re.compile(r"(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)")


@dataclass(frozen=True, slots=True)
class Metadata:
    """Texts for build systems; empty where nothing is stated."""

    version: str = ""  # major.minor.patch
    author: str = ""
    email: str = ""
    url: str = ""
    license: str = ""  # An SPDX identifier
    description: str = ""

    def plain(self) -> dict[str, object]:
        """The table of a spec file."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: text for name, text in found.items() if text}

    def require(self, key: str, kind: str, file: str) -> str:
        """What is stated for a key.

        Raises
        ------
        SpecError
            If it is missing.
        """
        text = str(getattr(self, key))
        if not text:
            example = {"version": "1.0.0", "author": "Jane Doe"}.get(key, "...")
            expected = f'[package] {key} = "{example}": a package for {kind} needs it'
            raise Place(file, "package").entry(key).error("nothing (the key is missing)", expected)
        return text


def read_metadata(table: object, place: Place) -> Metadata:
    """Return what a table says; an empty mapping says nothing."""
    known = tuple(each.name for each in fields(Metadata))
    section = Section(table, place, known=known)
    found: dict[str, str] = {}
    for key, value in section.table.items():
        if not isinstance(value, str):
            raise section.error(key, describe(value), "a text")
        if not value.strip() or not value.isprintable():
            raise section.error(key, show(value), "a text of one line that is not empty")
        found[key] = value.strip()
    if "version" in found and not _VERSION.fullmatch(found["version"]):
        expected = "three whole numbers, such as '1.0.0'"
        raise section.error("version", show(found["version"]), expected)
    return Metadata(**found)
