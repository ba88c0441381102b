"""f and h from Python: CasADi functions and expressions, SymPy, and callables over CasADi symbols.

An instruction of CasADi is one operation; what several others need becomes a definition.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

from fkgen.problem.functions.named import Named
from fkgen.problem.functions.vectors import EquationReader, Known
from fkgen.problem.table.place import Place, describe, show, suggestion
from fkgen.problem.text.expression import Expression, Name, names, renamed
from fkgen.problem.text.foreign import casadi_trees, library

#: Characters of what a user's function raised.
LONGEST = 200
#: What a function is given, in order.
ARGUMENTS = {"f": "xuwp", "h": "xup"}


class Symbols:
    """CasADi symbols by name, as attributes; as a vector by index."""

    def __init__(self, groups: Mapping[str, Any], vector: Any, letter: str) -> None:
        self._groups, self._vector, self._letter = dict(groups), vector, letter

    def __getattr__(self, name: str) -> Any:
        """One of them, or the vector of those that belong together."""
        if name.startswith("_") or name not in self._groups:
            known = ", ".join(self._groups) or "nothing"
            hint = suggestion(name, self._groups)
            raise AttributeError(f"{self._letter} has {known}, not '{name}'{hint}")
        return self._groups[name]

    def __getitem__(self, index: Any) -> Any:
        """One number, or several."""
        return self._vector[index]

    def __len__(self) -> int:
        """How many numbers."""
        return int(self._vector.numel())

    def __iter__(self) -> Iterator[Any]:
        """One number after the other."""
        return (self._vector[i] for i in range(len(self)))


def is_source(value: object) -> bool:
    """Whether a value states all of f or of h at once, and is no list or table."""
    if library(value) == "casadi":
        return True
    return callable(value) and not isinstance(value, type | Mapping)


def read_source(value: Any, key: str, place: Place, named: Named, known: Known) -> object:
    """What a function or a column of CasADi states, as a table or a list of trees."""
    casadi = import_module("casadi")
    if library(value) == "casadi" and not isinstance(value, casadi.Function):
        return trees(value, place, EquationReader(known, key))
    symbols = {letter: _symbols(letter, named, casadi) for letter in ARGUMENTS[key]}
    if isinstance(value, casadi.Function):
        column = _called(value, [symbols[each][1] for each in ARGUMENTS[key]], place, casadi)
    else:
        given = [Symbols(*symbols[each], each) for each in ARGUMENTS[key]]
        column = _returned(value, given, place)
    if isinstance(column, Mapping):
        return dict(column)
    if isinstance(column, list | tuple) or library(column) == "numpy":
        column = _stacked(column, place, casadi)
    if library(column) != "casadi":
        expected = f"a function that returns the rows of {key}: a list, a dict by name or a column"
        raise place.error(f"a function that returns {describe(column)}", expected)
    return trees(column, place, EquationReader(known, key))


def _stacked(column: Any, place: Place, casadi: Any) -> Any:
    try:
        return casadi.vertcat(*(casadi.SX(each) for each in column))
    except Exception as fault:  # noqa: BLE001 - whatever a list may hold
        reason = show(" ".join(str(fault).split()))
        raise place.error(f"a function whose list is no column ({reason})", "numbers") from None


def _symbols(letter: str, named: Named, casadi: Any) -> tuple[dict[str, Any], Any]:
    """Symbols by name, those of an attitude or a vector together, and all of them as a column."""
    groups: dict[str, tuple[str, ...]] = {}
    if letter == "x":
        at, left = 0, named.coordinates
        for each in named.states:
            count = 4 if each.manifold else 1
            groups[each.name], at = left[at : at + count], at + count
    elif letter == "p":
        vectors = named.scope.vectors
        parts = {name: vector for vector, several in vectors.items() for name in several}
        for name in (each for each in named.scope if each not in named.scope.told):
            vector = parts.get(name, name)
            groups[vector] = vectors.get(vector, (name,))
    else:
        signals: Sequence[Any] = named.inputs if letter == "u" else named.noises
        groups = {each.name: (each.name,) for each in signals}
    made = {
        name: casadi.vertcat(*(casadi.SX.sym(each) for each in several))
        for name, several in groups.items()
    }
    return made, casadi.vertcat(casadi.SX(0, 1), *made.values())


def _called(function: Any, columns: Sequence[Any], place: Place, casadi: Any) -> Any:
    """The one output of a CasADi function, whose inputs have the sizes of the columns."""
    sizes = [int(each.numel()) for each in columns]
    given = [int(function.numel_in(i)) for i in range(function.n_in())]
    if given != sizes or function.n_out() != 1:
        shown = f"a function of {given} numbers with {function.n_out()} outputs"
        letters = ", ".join(ARGUMENTS["f" if len(columns) == 4 else "h"])
        raise place.error(shown, f"one of ({letters}) with {sizes} numbers and one column")
    shaped = [casadi.reshape(column, *function.size_in(i)) for i, column in enumerate(columns)]
    try:
        return function.call(shaped)[0]
    except Exception as fault:  # noqa: BLE001 - what CasADi raises
        reason = show(" ".join(str(fault).split()))
        expected = "a function that CasADi can expand to SX"
        raise place.error(f"the function {show(function.name())} ({reason})", expected) from None


def _returned(function: Callable[..., Any], given: Sequence[Any], place: Place) -> Any:
    """What a callable makes of symbols."""
    letters = ", ".join(ARGUMENTS["f" if len(given) == 4 else "h"])
    try:
        inspect.signature(function).bind(*given)
    except (TypeError, ValueError):
        raise place.error(describe(function), f"a function of ({letters})") from None
    try:
        return function(*given)
    except Exception as fault:  # noqa: BLE001 - a user's code raises what it likes
        reason = " ".join(f"{type(fault).__name__}: {fault}".split())
        shown = getattr(function, "__name__", type(function).__name__)
        given_ = f"the function {show(shown)}, which raised {reason[:LONGEST]}"
        expected = f"a function of ({letters}) over CasADi symbols, such as casadi.sin(x.angle)"
        raise place.error(given_, expected) from None


def trees(value: Any, place: Place, reader: EquationReader) -> list[Expression]:
    """The entries of an SX column, over the names of a spec."""
    rows = casadi_trees(value, place, lambda name: symbol(name, place, reader), reader.share)
    return [tree for row in rows for tree in row]


def checked(tree: Expression, place: Place, reader: EquationReader) -> Expression:
    """A tree of another library, over the names of a spec."""
    found = {name: symbol(name, place, reader).identifier for name in sorted(names(tree))}
    return renamed(tree, found)


def symbol(name: str, place: Place, reader: EquationReader) -> Name:
    """What a symbol of another library stands for: q_0 is the first part of a vector q."""
    known = reader.known
    if name in known.scalars:
        return Name(name)
    vector, _, index = name.rpartition("_")
    parts = known.vectors.get(vector, ())
    if index.isdecimal() and int(index) < len(parts):
        part = parts[int(index)]
        if isinstance(part, Name):
            return part
    expected = f"symbols out of {', '.join(known.words)}"
    raise place.error(f"the symbol '{name}'", expected + suggestion(name, known.words))
