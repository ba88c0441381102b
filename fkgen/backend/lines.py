"""Lines of generated C: at most 100 characters each, and the model as lines of a comment."""

from __future__ import annotations

import re
import textwrap

from fkgen.backend.ir import CProgram, Listing, Signal

WIDTH = 100
#: Longest list of units that is written out.
_LONGEST = 60
#: Widest matrix whose entries stand below each other.
_ALIGNED = 80

#: Where a statement may go on in the next line: after a comma or an operator, before a question.
_JOINTS = re.compile(r"(?<=,) |(?<=\+) |(?<=&&) |(?<=\|\|) |(?<==) | (?=[?:] )")
_ELSEWHERE = re.compile(r"(?<=[ (])(?=\S)")
_WHOLE = re.compile(r"\[[^][]{1,60}\]|\([^()]{1,40}\)")
_REMARK = re.compile(r"^(?P<code> *\S.*?)(?P<open>/\*\*?<?) (?P<text>.*) \*/$")
_COMMENT = re.compile(r"^(?P<open> *(?:/\*\*?|\*)) (?P<text>.*)$")


#: ``if (...)``, and nothing but a return in its braces.
_GUARD = re.compile(r"^( *)(if \(.*\))\n\1\{\n *(return .*;)\n\1\}$", re.MULTILINE)


def guards_joined(text: str) -> str:
    """Text with every guard clause on one line, where it fits."""

    def joined(match: re.Match[str]) -> str:
        line = f"{match[1]}{match[2]} {{ {match[3]} }}"
        return line if len(line) <= WIDTH else match[0]

    return _GUARD.sub(joined, text)


def folded(line: str) -> list[str]:
    """One line of C as lines of at most 100 characters."""
    if len(line) <= WIDTH or line.startswith("#"):
        return [line]
    if comment := _COMMENT.match(line):
        return _comment(comment["open"], comment["text"])
    if remark := _REMARK.match(line):
        hanging = " " * len(remark["code"] + remark["open"] + " ")
        first = f"{remark['code']}{remark['open']} "
        return _words(f"{remark['text']}\0*/", first, hanging)
    return _statement(line)


def _comment(opening: str, text: str) -> list[str]:
    """Lines of a comment, each after its asterisk, and as far in as its first."""
    bare = opening.lstrip(" ")
    margin = " " * (len(opening) - len(bare) + (bare != "*")) + "*"
    inner = " " * (len(text) - len(text.lstrip(" ")) + 1)
    extra = "  " if inner != " " else ""
    hanging = margin + inner + extra if bare == "*" else margin + " " * (len(bare) - 1)
    text = text.strip().removesuffix(" */") + ("\0*/" if text.endswith(" */") else "")
    return _words(text, opening + inner, hanging)


def _words(text: str, first: str, hanging: str) -> list[str]:
    """Words as lines; units and shapes, such as ``[m, m/s]`` and ``(2 x 1)``, stay whole."""
    lines = textwrap.wrap(
        _WHOLE.sub(lambda match: match[0].replace(" ", "\0"), text),
        WIDTH,
        initial_indent=first,
        subsequent_indent=hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]


def _statement(line: str) -> list[str]:
    """Lines of a statement, the later ones further in."""
    indent = " " * (len(line) - len(line.lstrip(" ")) + 4)
    lines, rest = [], line
    while len(rest) > WIDTH:
        places = next(filter(None, (_places(j, rest, indent) for j in (_JOINTS, _ELSEWHERE))), [])
        if not places:
            break
        lines.append(rest[: places[-1].start()].rstrip())
        rest = indent + rest[places[-1].end() :]
    return [*lines, rest]


def _places(joint: re.Pattern[str], line: str, indent: str) -> list[re.Match[str]]:
    return [match for match in joint.finditer(line) if len(indent) < match.start() <= WIDTH]


def filled_lines(items: list[str], indent: str) -> str:
    """Items with commas between them, as many to a line as it holds."""
    lines = [indent]
    for item in items:
        if len(lines[-1]) + len(item) >= WIDTH and lines[-1] != indent:
            lines.append(indent)
        lines[-1] += f"{item}, "
    return "\n".join(line.rstrip() for line in lines).rstrip(",")


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
