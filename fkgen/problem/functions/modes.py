"""Equations of modes: those of the model, but for what a mode states itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from fkgen.problem.equations import Equations, Increment, Motion, trees_of
from fkgen.problem.functions.affine import rows
from fkgen.problem.functions.named import Named
from fkgen.problem.functions.reading import (
    check_noise_free,
    kept,
    part_of,
    read_definitions,
    read_measurement,
    read_motion,
)
from fkgen.problem.table.section import Section
from fkgen.problem.text.expression import (
    Expression,
    Name,
    product,
    renamed,
    total,
)
from fkgen.problem.text.matrix import Matrix

#: What a mode may state of equations.
OF_MODES = ("f", "h", "let")


def of_matrices(named: Named, matrices: Mapping[str, Matrix]) -> Equations:
    """The equations that matrices stand for."""
    states, inputs = named.coordinates, tuple(each.name for each in named.inputs)

    def written(letters: tuple[str, str, str]) -> tuple[Expression, ...]:
        first, second, offset = (matrices[letter] for letter in letters)
        parts = zip(rows(first, states), rows(second, inputs), offset.rows, strict=True)
        return tuple(total([*a, *b, *c]) for a, b, c in parts)

    f, h = written(("A", "B", "c")), written(("C", "D", "d"))
    return Equations(states=states, inputs=inputs, f=f, h=h)


def mode_equations(section: Section, named: Named, base: Equations) -> Equations:
    """The equations of a mode; what it leaves out is that of the base."""
    known = named.known()
    known.written.update(base.written)
    stated = read_definitions(section, known)
    for name, tree in base.let:
        if part_of(name) not in stated:
            known.adopt(name, tree)
        elif part_of(name) not in known.given:
            stated[part_of(name)]()
    for name, define in stated.items():
        if name not in known.given:
            define()
    f = read_motion(section, named, known, base.f)
    h = read_measurement(section, named, known, base.h)
    let, written = kept(known, [*trees_of(f), *h]), tuple(known.written.items())
    found = replace(base, let=let, f=tuple(f), h=tuple(h), written=written)
    check_noise_free(found, section.place, [each.name for each in named.outputs])
    return found


def chosen(several: Sequence[Equations], indicators: Sequence[Name]) -> Equations:
    """The equations of one who is told the mode: of the indicators one is 1, the others are 0."""
    let: dict[str, Expression] = {}
    motions: list[tuple[Motion, ...]] = []
    seen: list[tuple[Expression, ...]] = []
    for i, each in enumerate(several):
        names: dict[str, str] = {}
        for name, stated in each.let:
            tree = renamed(stated, names)
            if let.get(name, tree) != tree:
                names[name] = f"mode.{i}:{len(let)}"
            let[names.get(name, name)] = tree
        motions.append(tuple(_moved(motion, names) for motion in each.f))
        seen.append(tuple(renamed(tree, names) for tree in each.h))
    f = tuple(_chosen_motion(each, indicators) for each in zip(*motions, strict=True))
    h = tuple(_chosen(each, indicators) for each in zip(*seen, strict=True))
    return replace(several[0], let=tuple(let.items()), f=f, h=h, written=())


def _chosen(trees: Sequence[Expression], indicators: Sequence[Name]) -> Expression:
    if len(set(trees)) == 1:
        return trees[0]
    pairs = zip(indicators, trees, strict=True)
    return total([product(pair) for pair in pairs])


def _chosen_motion(motions: Sequence[Motion], indicators: Sequence[Name]) -> Motion:
    turns = [each for each in motions if isinstance(each, Increment)]
    if not turns:
        return _chosen([each for each in motions if not isinstance(each, Increment)], indicators)
    a, b, c = (_chosen(each, indicators) for each in zip(*(turn.by for turn in turns), strict=True))
    return Increment(turns[0].at, (a, b, c))


def _moved(motion: Motion, names: Mapping[str, str]) -> Motion:
    if not isinstance(motion, Increment):
        return renamed(motion, names)
    a, b, c = (renamed(each, names) for each in motion.by)
    return Increment(motion.at, (a, b, c))
