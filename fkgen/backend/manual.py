"""What the header says about the model, as lines of a comment."""

from __future__ import annotations

from fkgen.backend.columns import WIDTH
from fkgen.backend.ir import CProgram, Listing, Signal

#: Longest list of units that is written out.
_LONGEST = 60
#: Widest matrix whose entries stand below each other.
_ALIGNED = 80


def unit_of(signals: tuple[Signal, ...]) -> str:
    """Units of a vector, such as ``[m, m/s]``; empty if none is stated, or they are too many."""
    units = [signal.unit or "-" for signal in signals]
    if set(units) == {"-"} or not units:
        return ""
    text = f"[{', '.join(units if len(set(units)) > 1 else units[:1])}]"
    return text if len(text) <= _LONGEST else ""


def unit_text(program: CProgram, unit: str) -> str:
    """A unit in those of the signals, such as ``[m, m/s] squared``; empty if none is stated."""
    units = {
        "x": unit_of(program.states),
        "u": unit_of(program.inputs),
        "y": unit_of(program.outputs),
    }
    match tuple(unit):
        case (letter,) if units[letter]:
            return units[letter]
        case (letter, _) if units[letter]:
            return f"{units[letter]} squared"
        case (above, "/", below) if units[above] and units[below]:
            return f"{units[above]} per {units[below]}"
    return ""


def model_lines(program: CProgram) -> list[str]:
    """The model as lines of a comment: titles, then ``A = [[...], ...]`` with units."""
    lines = []
    for part in program.stated.parts:
        lines.append(f" * {part.title}.")
        for listing in part.listings:
            lines += _listing_lines(listing, unit_text(program, listing.unit))
        lines.append(" *")
    return lines


def _listing_lines(listing: Listing, unit: str) -> list[str]:
    row = ", ".join(listing.rows[0]) if listing.rows else ""
    head = f" *   {listing.name} = "
    if listing.form == "matrix":
        texts = _aligned(listing.rows)
        pieces = [f"[{text}]" for text in texts]
        pieces = [f"{'[' if i == 0 else ' '}{piece}" for i, piece in enumerate(pieces)]
        pieces = [f"{piece}," for piece in pieces[:-1]] + [f"{pieces[-1]}]"]
    else:
        opening, closing = {"vector": "[]", "diagonal": ("diag(", ")"), "zeros": ("zeros(", ")")}[
            listing.form
        ]
        pieces = [f"{opening}{row}{closing}"]
    margin = " *" + " " * (len(head) - 2)
    lines = []
    for i, piece in enumerate(pieces):
        lines += _split(head if i == 0 else margin, piece)
    if not unit:
        return lines
    if len(lines[-1]) + len(unit) + 3 <= WIDTH:
        return [*lines[:-1], f"{lines[-1]}   {unit}"]
    return [*lines, f"{margin}{unit}"]


def _aligned(rows: tuple[tuple[str, ...], ...]) -> list[str]:
    """Rows with their entries below each other, if they are short enough for it."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if sum(widths) + 2 * len(widths) > _ALIGNED:
        return [", ".join(row) for row in rows]
    return [
        ", ".join(text.rjust(width) for text, width in zip(row, widths, strict=True))
        for row in rows
    ]


def _split(start: str, text: str) -> list[str]:
    """One row, on as many lines as it needs."""
    lines, line = [], start
    for part in text.replace(", ", ",\0 ").split("\0"):
        if len(line) + len(part) > WIDTH and line.strip(" *"):
            lines.append(line.rstrip())
            line = " *" + " " * len(start[2:]) + "  "
        line += part
    return [*lines, line]
