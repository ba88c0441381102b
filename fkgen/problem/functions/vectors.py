"""Texts of equations: expressions with vectors and rotations, written out as scalars.

What an expansion needs more than once becomes a definition with a name that no user can write,
such as "f.q:1", so that trees stay small. The nine entries of the rotation matrix of an attitude q
are the definitions "q.R:00" to "q.R:22", from body to world axes.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from fkgen.problem.equations import Arithmetic, Definition, Increment, turned
from fkgen.problem.table.place import suggestion
from fkgen.problem.text.expression import (
    BINARY,
    CONSTANTS,
    FUNCTIONS,
    MAX_DEPTH,
    Expression,
    Name,
    Number,
    Reader,
    Scope,
    Unfit,
    operation,
    syntax,
    total,
)

Vector = tuple[Expression, ...]
Value = Expression | Vector

#: The functions of vectors and the number of their arguments.
OF_VECTORS = {"cross": 2, "dot": 2, "norm": 1, "rotate": 2, "rotate_back": 2}

_ALLOWED = re.compile(r"[A-Za-z0-9_.,+\-*/()<>=!\"' \[\]]")
#: A hidden name, or the part of a definition that is a vector; a name that Python can read of it.
HIDDEN = re.compile(r"[A-Za-z_]\w*(?:\.\w+)*:\d+")
PART = re.compile(r"([A-Za-z_]\w*)\[(\d+)\]")
_DOT, _COLON = "\N{MIDDLE DOT}", "\N{MIDDLE DOT}\N{MIDDLE DOT}"


@dataclass(frozen=True, slots=True)
class Known:
    """What equations may name; it grows by definitions."""

    scope: Scope  # parameters and tables
    scalars: dict[str, str]  # name -> what it is
    vectors: dict[str, Vector]
    #: By which names every attitude goes, with the place of its first number in x
    attitudes: dict[str, int]
    let: list[Definition] = field(default_factory=list)
    #: Definitions that are still to come, with the reason why they are none yet
    later: dict[str, str] = field(default_factory=dict)
    shared: dict[Expression, Name] = field(default_factory=dict)
    given: set[str] = field(default_factory=set)  # Definitions that the table itself states
    written: dict[str, str] = field(default_factory=dict)  # Texts by key, such as "h.range"

    def define(self, name: str, tree: Expression) -> Name:
        """Put a definition behind the others."""
        self.let.append((name, tree))
        self.scalars[name] = "a definition"
        return Name(name)

    def note(self, key: str, entry: object) -> None:
        """Keep what was written under a key, if it was a text."""
        parts = entry if isinstance(entry, list | tuple) else [entry]
        self.written.pop(key, None)
        if all(isinstance(part, str | int | float) for part in parts):
            texts = [" ".join(str(part).split()) for part in parts]
            self.written[key] = f"[{', '.join(texts)}]" if parts is entry else texts[0]

    def adopt(self, name: str, tree: Expression) -> None:
        """Take over a definition of another table."""
        if name in self.scalars:  # a rotation matrix that a definition before it needed
            return
        defined = self.define(name, tree)
        if found := PART.fullmatch(name):
            self.vectors[found[1]] = (*self.vectors.get(found[1], ()), defined)

    @property
    def words(self) -> list[str]:
        """The names, as an error lists them."""
        hidden = {part.identifier for parts in self.vectors.values() for part in _names(parts)}
        scalars = [name for name in self.scalars if name not in hidden and ":" not in name]
        return [*scalars, *self.vectors]


def _names(parts: Vector) -> Iterable[Name]:
    return (part for part in parts if isinstance(part, Name))


class EquationReader(Reader):
    """Reads one text; what it shares is named after it."""

    def __init__(self, known: Known, label: str) -> None:
        super().__init__(known.scope)
        self.known, self.label, self.count = known, label, 0

    def motion(self, text: str) -> Value | Increment:
        """Read what an attitude becomes: an increment, where the text says q * [..]."""
        match _tree(text):
            case ast.BinOp(ast.Name(q), ast.Mult(), right) if q in self.known.attitudes:
                by = self.value(right, 2)
                if isinstance(by, tuple) and len(by) == 3:
                    return Increment(self.known.attitudes[q], (by[0], by[1], by[2]))
        return self.read(text)

    def read(self, text: str) -> Value:
        """Read a number or a vector."""
        return self.value(_tree(text), 1)

    def value(self, node: ast.expr, level: int) -> Value:  # noqa: PLR0911 - one per node
        """The number or the vector that a node stands for."""
        if level > MAX_DEPTH:
            raise Unfit(f"at most {MAX_DEPTH} levels of nesting")
        match node:
            case ast.List(entries):
                return tuple(self.scalar(entry, level + 1) for entry in entries)
            case ast.Subscript(whole, index):
                return self.part(whole, index, level)
            case ast.Name(identifier) if identifier in self.known.vectors:
                return self.known.vectors[identifier]
            case ast.UnaryOp(ast.UAdd() | ast.USub() as sign, operand):
                inner = self.value(operand, level + 1)
                if isinstance(inner, tuple):
                    negative = isinstance(sign, ast.USub)
                    return tuple(operation("neg", e) for e in inner) if negative else inner
                return super().scalar(node, level)
            case ast.BinOp(left, kind, right) if type(kind) in BINARY:
                sides = self.value(left, level + 1), self.value(right, level + 1)
                return self.combined(BINARY[type(kind)], *sides)
            case ast.Call(ast.Name(function), arguments, []) if function in OF_VECTORS:
                return self.vector_call(function, arguments, level)
        return super().scalar(node, level)

    def scalar(self, node: ast.expr, level: int) -> Expression:
        """The number that a node stands for; a vector is refused."""
        found = self.value(node, level)
        if isinstance(found, tuple):
            raise Unfit(f"a number, not a vector of {len(found)} (take an entry: [..][0])")
        return found

    def name(self, identifier: str) -> Expression:
        """What a name stands for."""
        plain = identifier.replace(_COLON, ":").replace(_DOT, ".")
        if plain in CONSTANTS:
            return Number(CONSTANTS[plain])
        if plain in self.known.scalars:
            return Name(plain)
        if plain in self.known.later:
            raise Unfit(self.known.later[plain])
        if plain in FUNCTIONS or plain in OF_VECTORS:
            raise Unfit(f"arguments in parentheses after the function '{plain}'")
        words = self.known.words
        hint = suggestion(plain, words)
        raise Unfit(f"names out of {', '.join(words)}, not the name '{plain}'{hint}")

    def part(self, whole: ast.expr, index: ast.expr, level: int) -> Expression:
        """An entry of a vector."""
        vector = self.value(whole, level + 1)
        if not isinstance(vector, tuple):
            raise Unfit("an index behind a vector, not behind a number")
        match index:
            case ast.Constant(int() as at) if at in range(len(vector)) and at is not True:
                return vector[at]
        largest = len(vector) - 1
        raise Unfit(f"an index 0..{largest} of a vector of {len(vector)}, in [ ]")

    def combined(self, operator: str, left: Value, right: Value) -> Value:
        """The result of + - * / ** for numbers and vectors."""
        if isinstance(left, tuple) and isinstance(right, tuple):
            if operator == "*" and (len(left), len(right)) == (4, 3):
                return self.increment(left, right)
            if len(left) != len(right):
                raise Unfit(f"vectors of one length, not {len(left)} {operator} {len(right)}")
            if operator not in {"+", "-"}:
                raise Unfit(
                    f"no {operator} of two vectors: dot(a, b), cross(a, b) or entry by entry"
                )
            return tuple(operation(operator, *pair) for pair in zip(left, right, strict=True))
        if isinstance(left, tuple) and not isinstance(right, tuple) and operator in {"*", "/"}:
            factor = self.share(right)
            return tuple(operation(operator, each, factor) for each in left)
        if isinstance(right, tuple) and not isinstance(left, tuple) and operator == "*":
            factor = self.share(left)
            return tuple(operation(operator, factor, each) for each in right)
        if isinstance(left, tuple) or isinstance(right, tuple):
            raise Unfit(f"no {operator} of a number and a vector in this order")
        return operation(operator, left, right)

    def vector_call(self, function: str, arguments: list[ast.expr], level: int) -> Value:
        """The value of a function of vectors."""
        count = OF_VECTORS[function]
        if len(arguments) != count:
            raise Unfit(
                f"{count} argument{'s' * (count > 1)} of '{function}', not {len(arguments)}"
            )
        values = [self.value(each, level + 1) for each in arguments]
        for each in values:
            if not isinstance(each, tuple):
                raise Unfit(f"vectors such as [a, b, c] as arguments of '{function}'")
        vectors = [each for each in values if isinstance(each, tuple)]
        if function in {"rotate", "rotate_back"}:
            return self.rotated(function, *vectors)
        if function == "cross" and [len(each) for each in vectors] != [3, 3]:
            raise Unfit("vectors of 3 as arguments of 'cross'")
        if len({len(each) for each in vectors}) > 1:
            raise Unfit(f"vectors of one length as arguments of '{function}'")
        if function == "dot":
            return _dot(*vectors)
        shared = [tuple(map(self.share, each)) for each in vectors]
        if function == "norm":
            return operation("sqrt", _dot(shared[0], shared[0]))
        a, b = shared
        return tuple(
            operation("-", operation("*", a[i], b[j]), operation("*", a[j], b[i]))
            for i, j in ((1, 2), (2, 0), (0, 1))
        )

    def rotated(self, function: str, q: Vector, v: Vector) -> Vector:
        """R(q) v or R(q)' v."""
        if len(q) != 4 or len(v) != 3:
            raise Unfit(f"a quaternion and a vector of 3 as arguments of '{function}'")
        v = tuple(map(self.share, v))
        matrix = self.rotation(q)
        rows = matrix if function == "rotate" else list(zip(*matrix, strict=True))
        return tuple(_dot(tuple(row), v) for row in rows)

    def rotation(self, q: Vector) -> list[list[Expression]]:
        """The entries of the rotation matrix, defined once for each quaternion."""
        w, x, y, z = parts = tuple(map(self.share, q))
        base = self._base(parts)
        if f"{base}.R:00" not in self.known.scalars:
            self._define_rotation(base, (w, x, y, z))
        return [[Name(f"{base}.R:{i}{j}") for j in range(3)] for i in range(3)]

    def _base(self, parts: Vector) -> str:
        for name, vector in self.known.vectors.items():
            if vector == parts:
                return name
        key = operation("+", Name(":rotation"), total([*parts]))
        if key not in self.known.shared:
            self.count += 1
            self.known.shared[key] = Name(f"{self.label}.{self.count}")
        return self.known.shared[key].identifier

    def _define_rotation(self, base: str, q: Vector) -> None:
        define = self.known.define

        def times(a: Expression, b: Expression) -> Expression:
            return operation("*", a, b)

        twice = [
            define(f"{base}.T:{i}", times(Number(2.0), part)) for i, part in enumerate(q[1:], 1)
        ]
        products = {
            (i, j): define(f"{base}.P:{i}{j}", times(q[i], twice[j - 1]))
            for i in range(4)
            for j in range(max(i, 1), 4)
        }
        for i in range(3):
            for j in range(3):
                k, low, high = 3 - i - j, min(i, j) + 1, max(i, j) + 1
                if i == j:
                    a, b = (each for each in (1, 2, 3) if each != i + 1)
                    both = operation("+", products[a, a], products[b, b])
                    entry = operation("-", Number(1.0), both)
                else:
                    sign = "-" if (j - i) % 3 == 1 else "+"
                    entry = operation(sign, products[low, high], products[0, k + 1])
                define(f"{base}.R:{i}{j}", entry)

    def increment(self, q: Vector, by: Vector) -> Vector:
        """Q * exp(by), written out."""
        parts = tuple(_Shared(self, each) for each in q)
        vector = tuple(_Shared(self, each) for each in by)
        return tuple(each.tree for each in turned(parts, vector, _written(self)))

    def share(self, tree: Expression) -> Expression:
        """A tree that is needed more than once: a name for it."""
        if isinstance(tree, Number | Name):
            return tree
        if tree not in self.known.shared:
            self.count += 1
            name = f"{self.label}:{self.count}"
            while name in self.known.scalars:
                self.count += 1
                name = f"{self.label}:{self.count}"
            self.known.shared[tree] = self.known.define(name, tree)
        return self.known.shared[tree]


class _Shared:
    """A number of a formula that is written out, operation by operation."""

    def __init__(self, reader: EquationReader, tree: Expression) -> None:
        self.reader, self.tree = reader, tree

    def __add__(self, other: object) -> _Shared:
        return self.combined("+", self, other)

    def __radd__(self, other: object) -> _Shared:
        return self.combined("+", other, self)

    def __sub__(self, other: object) -> _Shared:
        return self.combined("-", self, other)

    def __rsub__(self, other: object) -> _Shared:
        return self.combined("-", other, self)

    def __mul__(self, other: object) -> _Shared:
        return self.combined("*", self, other)

    def __truediv__(self, other: object) -> _Shared:
        return self.combined("/", self, other)

    def combined(self, operator: str, *sides: object) -> _Shared:
        trees = [
            self.reader.share(each.tree) if isinstance(each, _Shared) else Number(float(each))  # type: ignore[arg-type]
            for each in sides
        ]
        return _Shared(self.reader, operation(operator, *trees))


def _written(reader: EquationReader) -> Arithmetic:
    """The functions of `turned`, as trees."""

    def function(name: str) -> Callable[..., _Shared]:
        return lambda *given: _Shared(reader, Number(0.0)).combined(name, *given)

    return {name: function(name) for name in ("<", "if", "sqrt", "sin", "cos")}


def _dot(a: Sequence[Expression], b: Sequence[Expression]) -> Expression:
    return total([operation("*", *pair) for pair in zip(a, b, strict=True)])


def _tree(text: str) -> ast.expr:
    mangled = HIDDEN.sub(lambda found: found.group().replace(":", _COLON).replace(".", _DOT), text)
    return syntax(mangled, _MANGLED if mangled != text else _ALLOWED)


_MANGLED = re.compile(_ALLOWED.pattern[:-1] + _DOT + "]")
