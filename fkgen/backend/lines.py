"""Text of generated files: templates filled in, lines of at most 100 characters, units in them."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

WIDTH = 100
#: Longest list of units that is written out.
_LONGEST = 55

#: Where a statement may go on in the next line: after a comma or an operator, before a question.
_JOINTS = re.compile(r"(?<=,) |(?<=\+) |(?<=&&) |(?<=\|\|) |(?<==) | (?=[?:] )")
_ELSEWHERE = re.compile(r"(?<=[ (])(?=\S)")
_WHOLE = re.compile(r"\[[^][]{1,60}\]|\([^()]{1,40}\)")
_REMARK = re.compile(r"^(?P<code> *\S.*?)(?P<open>/\*\*?<?) (?P<text>.*) \*/$")
_COMMENT = re.compile(r"^(?P<open> *(?:/\*\*?|\*)) (?P<text>.*)$")


@cache
def environment() -> jinja2.Environment:
    """Templates from the wheel, or from the source tree."""
    here = Path(__file__).resolve().parents[1]
    folders = [here / "templates", here.parent / "templates"]
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701 - C, not HTML
    )


#: What generated files may be used for, as SPDX names it: anything, without conditions.
LICENSE = "MIT-0"

#: What says so, and how each kind of file remarks it.
SPDX = f"SPDX-License-Identifier: {LICENSE}"
_REMARKS = {
    **dict.fromkeys(("c", "h", "hpp", "ino"), f"/* {SPDX} */\n"),
    **dict.fromkeys(("txt", "cmake", "Kconfig"), f"# {SPDX}\n"),
}


def filled(template: str, context: dict[str, object]) -> str:
    """A template filled in, without gaps, blanks at the end of lines and long lines."""
    kind = re.split(r"[./]", template.removesuffix(".j2"))[-1]
    text = _REMARKS.get(kind, "") + environment().get_template(template).render(context)
    code = template.endswith((".c.j2", ".h.j2"))
    lines = [line.rstrip() for line in (guards_joined(text) if code else text).splitlines()]
    if code:
        lines = [part for line in lines for part in folded(line)]
    kept = [line for i, line in enumerate(lines) if line or (i and lines[i - 1] not in ("", "{"))]
    return "\n".join(kept).rstrip() + "\n"


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
    return wrapped(_WHOLE.sub(lambda match: match[0].replace(" ", "\0"), text), first, hanging)


def wrapped(text: str, first: str, hanging: str) -> list[str]:
    """Text as lines, with NUL for blanks at which no line ends."""
    lines = textwrap.wrap(
        text,
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


def filled_lines(items: Iterable[str], indent: str) -> str:
    """Items with commas between them, as many to a line as it holds."""
    text = ", ".join(item.replace(" ", "\0") for item in items)
    return "\n".join(wrapped(f"{text},", indent, indent)).removesuffix(",")


def units_of(model: Any) -> dict[str, str]:
    """Units of the states, inputs and outputs of a model or program, such as ``[m, m/s]``.

    ``e`` are those of the errors of the states: of an attitude three angles.
    """
    numbers: list[str] = []
    for (
        each
    ) in model.states:  # one state of a model has four numbers, each of them one in a program
        numbers += [""] * 4 if getattr(each, "manifold", "") else [each.unit]
    errors = list(numbers)
    for at in reversed(model.attitudes):
        errors[at : at + 4] = ["rad"] * 3
    others = {
        letter: [each.unit for each in signals]
        for letter, signals in (("u", model.inputs), ("y", model.outputs))
    }
    return {letter: _units(each) for letter, each in {"x": numbers, "e": errors, **others}.items()}


def _units(stated: Iterable[str]) -> str:
    """Empty if no unit is stated, or they are too many."""
    units = [unit or "-" for unit in stated]
    if not set(units) - {"-"}:
        return ""
    text = f"[{', '.join(units if len(set(units)) > 1 else units[:1])}]"
    return text if len(text) <= _LONGEST else ""


def unit_text(units: Mapping[str, str], unit: str) -> str:
    """A unit in those of the signals, such as ``[m, m/s] squared``; empty if none is stated."""
    if len(unit) == 1:
        return units[unit]
    match tuple(unit.replace("x", "e")):
        case (letter, _) if units[letter]:
            return f"{units[letter]} squared"
        case (above, "/", below) if units[above] and units[below]:
            return f"{units[above]} per {units[below]}"
    return ""
