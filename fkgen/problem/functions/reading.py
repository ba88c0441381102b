"""The tables let, f, h and noises of a model, or of a mode of it, as equations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, get_args

from fkgen.errors import InternalError
from fkgen.problem.equations import (
    Definition,
    Equations,
    Increment,
    Integrator,
    Motion,
    needed,
    trees_of,
)
from fkgen.problem.functions.affine import rows
from fkgen.problem.functions.named import REFUSED, Named
from fkgen.problem.functions.sources import checked, is_source, read_source, symbol, trees
from fkgen.problem.functions.vectors import HIDDEN, PART, EquationReader, Known, Value
from fkgen.problem.signals import Signal, read_name
from fkgen.problem.table.place import Place, show, suggestion
from fkgen.problem.table.section import Section, as_entry, as_list, as_table
from fkgen.problem.text.expression import (
    MAX_NODES,
    Expression,
    Name,
    Number,
    Operation,
    is_large,
    names,
    placed,
    to_text,
    total,
)
from fkgen.problem.text.foreign import library, plain_entry, sympy_tree
from fkgen.problem.text.matrix import plain

#: What only a model with equations has.
KEYS = ("f", "h", "let", "noises", "integrator", "substeps")

#: Matrices that state what f or h states.
_LETTERS = {"f": ("A", "B", "c"), "h": ("C", "D", "d")}


def has_equations(section: Section) -> bool:
    """Whether matrices are not all that a model is made of."""
    if any(key in section for key in KEYS):
        return True
    for key in ("states", "outputs"):
        given = section.table.get(key)
        for entry in given if isinstance(given, list | tuple) else ():
            if isinstance(entry, Mapping) and (entry.get("wrap") or "manifold" in entry):
                return True
    return False


def read_equations(section: Section, named: Named, timing: dict[str, Any]) -> Equations:
    """The equations that a section states; in place of f or h there may be matrices."""
    known = named.known()
    for define in read_definitions(section, known).values():
        define()
    f: Sequence[Motion] | None = _by_matrices(section, named, "f")
    f = read_motion(section, named, known) if f is None else f
    h = _by_matrices(section, named, "h")
    h = read_measurement(section, named, known) if h is None else h
    found = Equations(
        states=named.coordinates,
        inputs=tuple(each.name for each in named.inputs),
        noises=named.noises,
        let=kept(known, [*trees_of(f), *h]),
        f=tuple(f),
        h=tuple(h),
        written=tuple(known.written.items()),
        attitudes=tuple(named.attitudes.values()),
        **timing,
    )
    check_noise_free(found, section.place, [each.name for each in named.outputs])
    return found


def _by_matrices(section: Section, named: Named, key: str) -> list[Expression] | None:
    """The rows of f or of h that matrices state, if they do."""
    first, second, offset = _LETTERS[key]
    if key in section or first not in section:
        for letter in (first, second, offset):
            if letter in section:
                beside = f"beside {key}" if key in section else f"without {first}"
                raise section.error(letter, f"{letter} {beside}", f"either {first} or {key}")
        return None
    if key == "f" and named.attitudes:
        raise section.error(first, "A for a model with an attitude", "f: an attitude is not linear")
    count = len(named.coordinates if key == "f" else named.outputs)
    sizes = ((first, named.coordinates), (second, tuple(each.name for each in named.inputs)))
    terms: list[list[Expression]] = [[] for _ in range(count)]
    for letter, columns in sizes:
        if letter in section:
            matrix = section.matrix(letter, (count, len(columns)), "as many as there are signals")
            terms = [a + b for a, b in zip(terms, rows(matrix, columns), strict=True)]
    if offset in section:
        added = section.column(offset, count, "numbers or expressions").rows
        terms = [a + list(b) for a, b in zip(terms, added, strict=True)]
    return [total(each) for each in terms]


def read_timing(section: Section, period: Expression | None) -> dict[str, Any]:
    """Integrator and its steps where time is continuous; ``period``: from sample to sample."""
    if period is None:
        for key in ("integrator", "substeps"):
            if key in section:
                expected = 'none, or time = "continuous": it moves a model of dx/dt over a sample'
                raise section.error(key, f"{key} for a model in discrete time", expected)
        return {}
    integrator: Integrator = section.choice("integrator", get_args(Integrator), "rk4")
    steps = section.count("substeps", 1, 100, "substeps")
    return {"continuous": True, "integrator": integrator, "substeps": steps, "period": period}


def read_definitions(section: Section, known: Known) -> dict[str, Callable[[], None]]:
    """What defines each of the names in let, to be called in order."""
    place = section.place.entry("let")
    expected = 'a table of definitions in order, such as c = "cos(heading)"'
    table = as_table(section.table.get("let", {}), place, expected)
    parts: dict[str, list[str]] = {}
    for key in table:
        _check_new(key, known, place.entry(key))
        parts.setdefault(part_of(key), []).append(key)
        known.later[part_of(key)] = (
            f"only what stands before it: '{part_of(key)}' is defined by itself or further below"
            " (a definition may use those above it; a cycle has no order)"
        )

    def define(name: str) -> None:
        for key in parts[name]:
            reader = EquationReader(known, f"let.{name}")
            value = read_value(table[key], place.entry(key), reader)
            known.note(f"let.{key}", table[key])
            known.later.pop(name, None)
            known.given.add(name)
            if isinstance(value, tuple):
                for i, each in enumerate(value):
                    known.adopt(f"{key}[{i}]", each)
            else:
                known.adopt(key, value)

    return {name: partial(define, name) for name in parts}


def part_of(key: str) -> str:
    """The vector that a definition is a part of, or its own name."""
    found = PART.fullmatch(key)
    return found[1] if found else key


def _check_new(key: str, known: Known, place: Place) -> None:
    """Refuse a definition whose name is taken, or is none."""
    if HIDDEN.fullmatch(key):
        return
    name = read_name(part_of(key), place, REFUSED)
    if name in known.scalars or name in known.vectors:
        what = known.scalars.get(name, "a vector")
        raise place.error(f"a definition of '{name}', which is {what}", "a name that is not taken")


def read_value(entry: object, place: Place, reader: EquationReader) -> Value:
    """A number or vector out of a text, a list, or an object of another library."""
    if library(entry) == "casadi":
        found = trees(entry, place, reader)
        return found[0] if len(found) == 1 else tuple(found)
    if library(entry) == "sympy" and not hasattr(entry, "tolist"):
        return sympy_tree(entry, place, lambda name: symbol(name, place, reader), reader.share)
    plain = plain_entry(entry, place)
    if isinstance(plain, str):
        value = placed(lambda: reader.read(plain), plain, place)
    elif isinstance(plain, list | tuple):
        parts = [read_value(each, place.item(i), reader) for i, each in enumerate(plain)]
        for i, each in enumerate(parts):
            if isinstance(each, tuple):
                raise place.item(i).error("a vector in a vector", "numbers or expressions")
        value = tuple(each for each in parts if not isinstance(each, tuple))
    elif isinstance(plain, Number | Name | Operation):
        value = checked(plain, place, reader)
    else:
        expected = "a finite number, or an expression of states, inputs and parameters"
        value = as_entry(plain, place, reader.known.scope, expected)
    for each in value if isinstance(value, tuple) else (value,):
        if is_large(each):
            raise place.error("a very large expression", f"at most {MAX_NODES} operations; use let")
    return value


def _entries(
    section: Section, key: str, named: Named, known: Known
) -> dict[str, tuple[object, Place]]:
    """What is stated for states or outputs, with its place."""
    place, given = section.place.entry(key), section.table.get(key, {})
    signals, what = (named.states, "state") if key == "f" else (named.outputs, "output")
    words = [each.name for each in signals]
    if is_source(given):
        given = read_source(given, key, place, named, known)
        if isinstance(given, list):
            given = _grouped(given, signals, place, continuous=named.continuous)
    if isinstance(given, Mapping):
        for name in as_table(given, place, f"a table of expressions by {what}"):
            if name not in words:
                expected = f"names of {what}s: {', '.join(words)}{suggestion(name, words)}"
                raise place.entry(name).error(f"an equation for no {what}", expected)
        return {name: (entry, place.entry(name)) for name, entry in given.items()}
    expected = f"a table of expressions by {what}, or a list of {len(words)} in order"
    entries = as_list(given, place, expected, len(words), "expressions")
    plain = [each[0] if isinstance(each, list) and len(each) == 1 else each for each in entries]
    return {name: (plain[i], place.item(i)) for i, name in enumerate(words)}


def _grouped(
    column: list[object], signals: Sequence[Signal], place: Place, *, continuous: bool
) -> list[object]:
    """A column of numbers, those of one signal together."""
    sizes = [(3 if continuous else 4) if each.manifold else 1 for each in signals]
    if len(column) != sum(sizes):
        shown = ", ".join(f"{s.name} ({n})" for s, n in zip(signals, sizes, strict=True))
        raise place.error(f"a column of {len(column)} numbers", f"{sum(sizes)}: {shown}")
    left = iter(column)
    return [next(left) if n == 1 else [next(left) for _ in range(n)] for n in sizes]


def kept(known: Known, trees: Sequence[Expression]) -> tuple[Definition, ...]:
    """All definitions but hidden ones that nobody needs."""
    own = [tree for name, tree in known.let if not HIDDEN.fullmatch(name)]
    found = {name for name, _ in needed(known.let, [*trees, *own])}
    return tuple(each for each in known.let if each[0] in found or not HIDDEN.fullmatch(each[0]))


def read_motion(
    section: Section, named: Named, known: Known, base: Sequence[Motion] = ()
) -> list[Motion]:
    """F by component; what is left out stays as it is, or as it is in the base."""
    entries = _entries(section, "f", named, known)
    found: list[Motion] = []
    left = list(base)
    for signal in named.states:
        count = 4 if signal.manifold and left and not isinstance(left[0], Increment) else 1
        before, left = left[:count], left[count:]
        if signal.name not in entries:
            found += before or _still(signal, named)
            continue
        entry, place = entries[signal.name]
        reader = EquationReader(known, f"f.{signal.name}")
        known.note(reader.label, entry)
        if signal.manifold:
            found += _turning(entry, place, reader, (signal, named.continuous))
        else:
            found.append(_number(read_value(entry, place, reader), place))
    return found


def _still(signal: Signal, named: Named) -> list[Motion]:
    zero = Number(0.0)
    if signal.manifold:
        return [Increment(named.attitudes[signal.name], (zero, zero, zero))]
    return [zero if named.continuous else Name(signal.name)]


def _turning(
    entry: object, place: Place, reader: EquationReader, of: tuple[Signal, bool]
) -> list[Motion]:
    """How an attitude moves: by an increment, by four numbers, or by a body rate."""
    signal, continuous = of
    at = reader.known.attitudes[signal.name]
    if isinstance(entry, str) and not continuous:
        value: Value | Increment = placed(lambda: reader.motion(entry), entry, place)
    else:
        value = read_value(entry, place, reader)
    if isinstance(value, Increment):
        if value.at == at:
            return [value]
        value = read_value(entry, place, reader)
    size = len(value) if isinstance(value, tuple) else 1
    if continuous and isinstance(value, tuple) and size == 3:
        return [Increment(at, (value[0], value[1], value[2]))]
    if not continuous and isinstance(value, tuple) and size == 4:
        return list(value)
    expected = (
        f"the body rate of {signal.name}, a vector of 3"
        if continuous
        else f"{signal.name} * [a, b, c], or four numbers"
    )
    raise place.error("a number" if size == 1 else f"a vector of {size}", expected)


def _number(value: Value, place: Place) -> Expression:
    if isinstance(value, tuple):
        raise place.error(f"a vector of {len(value)}", "a number (take an entry: [..][0])")
    return value


def read_measurement(
    section: Section, named: Named, known: Known, base: Sequence[Expression] = ()
) -> list[Expression]:
    """H by output; every one of them has an equation, if not in the base."""
    entries = _entries(section, "h", named, known)
    found = []
    for i, signal in enumerate(named.outputs):
        place = section.place.entry("h").entry(signal.name)
        if signal.name not in entries and base:
            found.append(base[i])
            continue
        if signal.name not in entries:
            raise place.error("nothing (the key is missing)", "an expression of states and inputs")
        entry, place = entries[signal.name]
        reader = EquationReader(known, f"h.{signal.name}")
        known.note(reader.label, entry)
        found.append(_number(read_value(entry, place, reader), place))
    return found


def check_noise_free(found: Equations, place: Place, outputs: Sequence[str]) -> None:
    """Refuse noises in h: R is the noise of y."""
    noisy = {each.name for each in found.noises}
    for name, tree in found.let:
        if names(tree) & noisy:
            noisy.add(name)
    for output, tree in zip(outputs, found.h, strict=True):
        if culprit := sorted(names(tree) & noisy):
            expected = "states, inputs and parameters: noises enter through f, that of y is R"
            where = place.entry("h").entry(output)
            raise where.error(f"{show(to_text(tree))} with the noise '{culprit[0]}'", expected)


def plain_mode(equations: Equations) -> dict[str, object]:
    """The keys of a mode that say the same."""
    table: dict[str, object] = {"let": dict(equations.plain_let)} if equations.let else {}
    f: list[object] = []
    left, at = list(equations.f), 0
    while left:
        if at not in equations.attitudes:
            f.append(plain(left.pop(0)))
            at += 1
            continue
        first = left[0]
        if isinstance(first, Increment):
            f.append(_plain_increment(left.pop(0), equations))
        else:
            f.append([plain(left.pop(0)) for _ in range(4)])
        at += 4
    return table | {"f": f, "h": [plain(tree) for tree in equations.h]}


def plain_equations(
    equations: Equations, states: Sequence[Signal], outputs: Sequence[Signal]
) -> dict[str, object]:
    """The keys of a model that say the same."""
    table: dict[str, Any] = plain_mode(equations)
    for key, signals in (("f", states), ("h", outputs)):
        names_ = [each.name for each in signals]
        table[key] = dict(zip(names_, table[key], strict=True))
    if equations.noises:
        table["noises"] = [plain(noise) for noise in equations.noises]
    if equations.continuous:
        table |= {"time": "continuous", "integrator": equations.integrator}
        table |= {"substeps": equations.substeps}
    return table


def _plain_increment(motion: Motion, equations: Equations) -> object:
    if not isinstance(motion, Increment):
        raise InternalError("an increment is no tree")
    if equations.continuous:
        return [plain(each) for each in motion.by]
    q = part_of(equations.states[motion.at])
    return f"{q} * [{', '.join(map(to_text, motion.by))}]"
