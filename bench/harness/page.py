"""docs/benchmarks.md: a section for each table; measuring some of them replaces these alone."""

from __future__ import annotations

import re
from collections.abc import Sequence

_LOST = "Where we lose"


def sections(page: str) -> dict[str, str]:
    """Text of each section by its title, in order; the head of the page is not among them."""
    parts = re.split(r"^## (.+)\n", page, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def renewed(page: str, head: str, measured: Sequence[tuple[str, str]]) -> str:
    """The page with these sections; what is new comes first, what was there stays in its place."""
    there = sections(page)
    there.pop(_LOST, None)
    new = {title: text for title, text in measured if title not in there}
    body = {**new, **there, **dict(measured)}
    lines = ["", "Every target that is missed in the tables below.", ""]
    for title, text in body.items():
        missed = _missed(text)
        lines += [f"- {title}", *[f"    - {line}" for line in missed]] if missed else []
    lost = "\n".join([*lines, "", ""])
    every = {_LOST: lost, **body}
    text = "".join(f"## {title}\n{section}" for title, section in every.items())
    return f"{head}\n{text}".rstrip() + "\n"


def _missed(section: str) -> list[str]:
    """A line for each row in which a target is missed."""
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("|") and not line.startswith("| ---")
    ]
    lines = []
    for row in rows[1:]:
        cells = [
            f"{column} {cell.removesuffix(' (missed)')}"
            for column, cell in zip(rows[0][1:], row[1:], strict=True)
            if cell.endswith("(missed)")
        ]
        if "missed" in row:
            numbers = zip(rows[0][1:], row[1:], strict=True)
            cells += [f"{column} {cell}" for column, cell in numbers if _is_number(cell)]
        if cells:
            name = row[0] if _is_number(row[1]) else f"{row[0]}, {row[1]}"
            lines.append(f"{name}: {'; '.join(cells)}")
    return lines


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"[\d.]+", cell) is not None
