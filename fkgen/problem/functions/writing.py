"""Equations as text: as they were written, and what was no text as its tree is."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fkgen.problem.equations import Definition, Equations, Increment, Motion, needed, trees_of
from fkgen.problem.functions.named import coordinates
from fkgen.problem.functions.reading import part_of
from fkgen.problem.functions.vectors import HIDDEN
from fkgen.problem.signals import Signal
from fkgen.problem.text.expression import Expression, to_text

#: Characters of a word that stays as it is; and where blanks come into a longer one.
_WORD = 60
_JOINT = re.compile(r"(?<=[\w)\]])(?<![\d.][eE])(,|\*\*|[-+*/])(?=[\w(\[.-])")


@dataclass(frozen=True, slots=True)
class Statement:
    """What one line says."""

    key: str  # where it was written, such as "let.c", "f.x" or "h.range"
    name: str  # of what is stated
    text: str
    trees: tuple[Expression, ...]
    hidden: tuple[Definition, ...]  # those among the definitions they need that nobody wrote

    @property
    def line(self) -> str:
        """Name and text."""
        return f"{self.key.partition('.')[0]}: {self.name} = {self.text}"


@dataclass(frozen=True, slots=True)
class Row:
    """A tree, the key of where it was written, and the name of what it states."""

    key: str
    name: str
    tree: Expression


#: A key, the name of what it states, and each of its parts by name.
_Group = tuple[str, str, list[tuple[str, Motion]]]


def statements(
    equations: Equations, states: Sequence[Signal], outputs: Sequence[Signal]
) -> list[Statement]:
    """let, f and h in order, without what f leaves as it is.

    Definitions that nobody wrote are among them where a tree is shown that names them.
    """
    written, hidden = dict(equations.written), _hidden(equations)
    groups = [*_definitions(equations, written), *_motions(equations, states)]
    rows = zip(outputs, equations.h, strict=True)
    groups += [(f"h.{each.name}", each.name, [(each.name, tree)]) for each, tree in rows]
    seen = [group for group in groups if group[0] not in written and group[0][4:] not in hidden]
    bare = trees_of(motion for _, _, parts in seen for _, motion in parts)
    shown = {f"let.{name}" for name, _ in needed([*hidden.items()], bare)}
    found = []
    for key, name, parts in groups:
        if key in written:
            parts = [(name, motion) for _, motion in parts]  # noqa: PLW2901 - one line for all
            texts = [(name, spaced(written[key]), trees_of(motion for _, motion in parts))]
        elif key[4:] in hidden and key not in shown:
            continue
        else:
            texts = [(part, _text(part, motion), trees_of([motion])) for part, motion in parts]
        for stated, text, trees in texts:
            if key[0] != "f" or equations.continuous or text != stated:  # else it stays as it is
                own = needed([*hidden.items()], trees)
                found.append(Statement(key, stated, text, trees, own))
    return found


def rows_of(
    equations: Equations, states: Sequence[Signal], outputs: Sequence[Signal], part: str
) -> list[Row]:
    """The rows of "f" or of "h", an increment by its three trees."""
    if part == "h":
        pairs = zip(outputs, equations.h, strict=True)
        return [Row(f"h.{each.name}", each.name, tree) for each, tree in pairs]
    return [
        Row(key, name, tree)
        for key, _, parts in _motions(equations, states)
        for name, motion in parts
        for tree in trees_of([motion])
    ]


def text_of(row: Row, equations: Equations) -> str:
    """What is written where a row comes from."""
    written = dict(equations.written)
    return written.get(row.key) or written.get(part_of(row.key)) or to_text(row.tree)


def _hidden(equations: Equations) -> dict[str, Expression]:
    return {name: tree for name, tree in equations.let if HIDDEN.fullmatch(name)}


def _definitions(equations: Equations, written: dict[str, str]) -> Iterator[_Group]:
    """The definitions in order, those of a vector that was written as one together."""
    found: dict[str, list[tuple[str, Motion]]] = {}
    for name, tree in equations.let:
        whole = f"let.{part_of(name)}"
        found.setdefault(whole if whole in written else f"let.{name}", []).append((name, tree))
    return ((key, key.removeprefix("let."), parts) for key, parts in found.items())


def _motions(equations: Equations, states: Sequence[Signal]) -> Iterator[_Group]:
    """The rows of f by state: an attitude that turns by an increment has one."""
    left, at = iter(equations.f), 0
    for signal in states:
        parts = coordinates(signal)
        names = (signal.name,) if at in equations.turning else parts
        yield f"f.{signal.name}", signal.name, [(name, next(left)) for name in names]
        at += len(parts)


def _text(name: str, motion: Motion) -> str:
    if isinstance(motion, Increment):
        return f"{name} * [{', '.join(map(to_text, motion.by))}]"
    return to_text(motion)


def spaced(text: str) -> str:
    """A text with blanks in words that are too long for a line."""
    words = (word if len(word) <= _WORD else _JOINT.sub(_apart, word) for word in text.split(" "))
    return " ".join(words)


def _apart(joint: re.Match[str]) -> str:
    return ", " if joint[1] == "," else f" {joint[1]} "
