"""No line of generated C is longer than 100 characters: statements and comments are folded."""

from __future__ import annotations

import re
import textwrap

WIDTH = 100

#: Where a statement may go on in the next line: after a comma or an operator, before a question.
_JOINTS = re.compile(r"(?<=,) |(?<=\+) |(?<=&&) |(?<=\|\|) |(?<==) | (?=[?:] )")
_ELSEWHERE = re.compile(r"(?<=[ (])(?=\S)")
_WHOLE = re.compile(r"\[[^][]{1,60}\]|\([^()]{1,40}\)")
_REMARK = re.compile(r"^(?P<code> *\S.*?)(?P<open>/\*\*?<?) (?P<text>.*) \*/$")
_COMMENT = re.compile(r"^(?P<open> *(?:/\*\*?|\*)) (?P<text>.*)$")


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
