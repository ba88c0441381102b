"""Names that become C identifiers, and units: of states, inputs and outputs above all."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from fkgen.problem.table.place import Place, describe, show, suggestion
from fkgen.problem.table.section import Section, as_list, as_number
from fkgen.problem.text.expression import WORDS

MAX_LENGTH = 40
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

Refused = tuple[tuple[frozenset[str], str], ...]  # sets of names, and what is expected instead

_C = """
auto break case char const continue default do double else enum extern float for goto if inline int
long register restrict return short signed sizeof static struct switch typedef union unsigned void
volatile while alignas alignof constexpr nullptr static_assert thread_local typeof typeof_unqual
"""
_CPP = """
and and_eq asm bitand bitor bool catch char8_t char16_t char32_t class compl concept consteval
constinit const_cast co_await co_return co_yield decltype delete dynamic_cast explicit export false
final friend import module mutable namespace new noexcept not not_eq operator or or_eq override
private protected public reinterpret_cast requires static_cast template this throw true try typeid
typename using virtual wchar_t xor xor_eq
"""
_MACROS = "NULL EOF NAN INFINITY complex imaginary errno assert offsetof linux unix i386 main std"
_TYPES = """
int8 int16 int32 int64 uint8 uint16 uint32 uint64 intptr uintptr intmax uintmax int_least8
int_least16 int_least32 int_least64 uint_least8 uint_least16 uint_least32 uint_least64 int_fast8
int_fast16 int_fast32 int_fast64 uint_fast8 uint_fast16 uint_fast32 uint_fast64 size ssize ptrdiff
max_align wchar wint wctype wctrans mbstate char8 char16 char32 float double time clock div ldiv
lldiv imaxdiv fpos fenv fexcept sig_atomic cnd mtx thrd tss nullptr errno rsize off pid uid gid
mode dev ino nlink key id blkcnt blksize clockid timer useconds suseconds sigset pthread sem
"""
_HEADERS = """
assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign
stdarg stdatomic stdbool stdckdint stdbit stddef stdint stdio stdlib stdnoreturn string strings
tgmath threads time uchar unistd wchar wctype
"""

_RESERVED = frozenset([*_MACROS.split(), *(f"{stem}_t" for stem in _TYPES.split())])
_REFUSED = (
    (frozenset((_C + _CPP).split()), "a name that is not a keyword of C or C++"),
    (_RESERVED, "a name that C and its library do not reserve"),
)
#: What the name of the filter cannot be: it is the prefix of its files, types and functions.
PREFIX = (
    (
        frozenset((_TYPES + _HEADERS).split()),
        "another name: '{0}.h' or '{0}_t' belongs to the C library",
    ),
)
#: Macros of <stdint.h>, <stddef.h>, <float.h> and <math.h>, which members of a struct cannot be.
_MACRO = re.compile(
    r"U?INT(8|16|32|64|MAX|PTR|_(LEAST|FAST)(8|16|32|64))_(MIN|MAX|WIDTH|C)"
    r"|(PTRDIFF|SIZE|RSIZE|SIG_ATOMIC|WCHAR|WINT)_(MIN|MAX|WIDTH)"
    r"|(FLT|DBL|LDBL|DEC)[0-9]*X?_[A-Z0-9_]+|(CR_)?DECIMAL_DIG"
    r"|HUGE(_VAL[FL]?)?|FP_[A-Z0-9]+|MATH_ERR[A-Z]+|math_errhandling|[DS]?NANF?L?"
    r"|M_(E|LOG2E|LOG10E|LN2|LN10|PI|PI_2|PI_4|1_PI|2_PI|2_SQRTPI|SQRT2|SQRT1_2)"
    r"|DOMAIN|SING|OVERFLOW|UNDERFLOW|PLOSS|TLOSS|X_TLOSS|MAXFLOAT"
)


def parameter_words(name: str, given: Iterable[object]) -> Refused:
    """What the given names of parameters of a filter cannot be, for it is a name in C and in text.

    The generated header has macros and constants that begin with the name of the filter.
    """
    names = [each for each in given if isinstance(each, str)]
    prefix = f"{name.upper()}_"
    own = frozenset(each for each in names if each.startswith(prefix) and each.isupper())
    return (
        (frozenset("I"), "a name that is not a macro of <complex.h>"),
        (WORDS, "a name that is not a word of the expression language"),
        (frozenset(keyword.kwlist), "a name that is not a keyword of Python"),
        (frozenset(filter(_MACRO.fullmatch, names)), "a name that is not a macro of C's headers"),
        (own, f"a name that does not begin as the macros of {name}.h do, with {prefix}"),
    )


def read_name(value: object, place: Place, refused: Refused = ()) -> str:
    """Return a text that is safe as a C and C++ identifier, and not refused for another reason."""
    expected = f"a C identifier: letters, digits and _, at most {MAX_LENGTH} characters"
    if not isinstance(value, str):
        raise place.error(describe(value), expected)
    if not _IDENTIFIER.fullmatch(value):
        raise place.error(show(value), expected)
    if len(value) > MAX_LENGTH:
        raise place.error(f"{show(value)} with {len(value)} characters", expected)
    if value.startswith("_") or value.endswith("_") or "__" in value:
        raise place.error(show(value), "a name without leading, trailing or double underscores")
    for words, allowed in (*_REFUSED, *refused):
        if value in words:
            raise place.error(show(value), allowed.format(value))
    return str(value)


def check_distinct(names: Iterable[str], place: Place, what: str) -> None:
    """Refuse names that are equal, or equal but for case: C macros write them in capitals."""
    seen: dict[str, str] = {}
    for name in names:
        first = seen.get(name.lower())
        if first is not None:
            given = f"'{name}' twice" if first == name else f"'{first}' and '{name}'"
            raise place.error(given, f"{what} with distinct names (capitals do not distinguish)")
        seen[name.lower()] = name


MAX_UNIT = 40

#: Samples by which a row of y may be late at most, each of which costs memory.
MAX_DELAY = 100
_DELAY = f"a whole number of samples, 0..{MAX_DELAY}"

Manifold = Literal["", "SO3"]
Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Signal:
    """One component of x, u or y; an attitude is one state of four numbers."""

    name: str  # A C identifier
    unit: str = ""  # Such as "rad/s"; empty if not stated
    wrap: bool = False  # An angle in radians, whose differences lie in (-pi, pi]
    manifold: Manifold = ""  # "SO3": a unit quaternion (w, x, y, z), body to world
    range: Range | None = None  # Least and largest value that it has in normal operation
    max_delay: int = 0  # Samples by which a row of y may be late

    @property
    def delay(self) -> str:
        """The run-time parameter that says how late the row is."""
        return f"delay_{self.name}"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"name": self.name, "unit": self.unit}
        table |= {"wrap": True} if self.wrap else {}
        table |= {"max_delay": self.max_delay} if self.max_delay else {}
        table |= {} if self.range is None else {"range": list(self.range)}
        return table | ({"manifold": self.manifold} if self.manifold else {})


#: Names after <NAME>_INPUT_ and <NAME>_VALID_ that are those of statuses and sizes.
_TAKEN = {
    "inputs": frozenset(("not_finite", "out_of_range")),
    "outputs": frozenset(("words",)),
}
#: What a signal may state besides its name and unit.
_ABOUT: dict[str, tuple[str, ...]] = {
    "states": ("wrap", "manifold"),
    "outputs": ("wrap", "max_delay"),
}


def read_signals(section: Section, key: str, letter: str, count: int | None) -> tuple[Signal, ...]:
    """Return the signals under ``key``, or ``x0, x1, ...`` without units.

    Without a count there are as many as are stated.
    """
    if key not in section:
        return tuple(Signal(f"{letter}{index}") for index in range(count or 0))
    place = section.place.entry(key)
    shown = "" if count is None else f"{count} "
    expected = f"a list of {shown}tables, such as {{name = 'speed', unit = 'rad/s'}}"
    entries = as_list(section.table[key], place, expected)
    if count not in {None, len(entries)}:
        raise place.error(f"{len(entries)} entries", f"{count}: the model has {count} {key}")
    about = ("name", "unit", "range", *_ABOUT.get(key, ()))
    refused = ((_TAKEN.get(key, frozenset()), "a name whose constant the header has not already"),)
    signals = tuple(
        _signal(each, place.item(index), about, refused) for index, each in enumerate(entries)
    )
    check_distinct((signal.name for signal in signals), place, key)
    return signals


def _signal(entry: object, place: Place, about: tuple[str, ...], refused: Refused) -> Signal:
    section = Section(entry, place, known=about)
    given = section.require("name", "a C identifier")
    name = read_name(given, place.entry("name"), refused)
    unit, wrap = read_unit(section), section.flag("wrap", default=False)
    manifold: Manifold = (
        section.choice("manifold", ("SO3",), "SO3") if "manifold" in section else ""
    )
    span = _range(section)
    if span is not None and (manifold or (wrap and "manifold" in about)):
        beside = "manifold = 'SO3'" if manifold else "wrap = true"
        expected = "none: an estimate that turns round has no least and no largest value"
        raise section.error("range", f"a range beside {beside}", expected)
    if wrap and manifold:
        raise section.error("wrap", "wrap beside manifold = 'SO3'", "one of the two")
    delay = section.number("max_delay", _DELAY, _is_delay, 0) if "max_delay" in section else 0
    return Signal(name, unit, wrap, manifold, span, int(delay))


def _is_delay(number: float) -> bool:
    return number in range(MAX_DELAY + 1)


def _range(section: Section) -> Range | None:
    """Least and largest value, if they are stated."""
    if "range" not in section:
        return None
    place = section.place.entry("range")
    expected = "a list of two finite numbers [low, high], low < high"
    found = as_list(section.table["range"], place, expected)
    if len(found) != 2:
        raise place.error(f"{len(found)} entries", expected)
    low, high = (as_number(each, place.item(i), expected) for i, each in enumerate(found))
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise place.error(f"[{low:g}, {high:g}]", expected)
    return low, high


def read_unit(section: Section) -> str:
    """Return a unit, which may stand in a comment of C; none if nothing is stated."""
    unit = section.table.get("unit", "")
    if not isinstance(unit, str):
        raise section.error("unit", describe(unit), "a text, such as 'rad/s'")
    forbidden = any(part in unit for part in ("*/", "/*", "\\", "??"))
    if forbidden or len(unit) > MAX_UNIT or not unit.isprintable():
        expected = f"at most {MAX_UNIT} printable characters that can stand in a C comment"
        raise section.error("unit", show(unit), expected)
    return str(unit)


def read_rows(
    section: Section, key: str, outputs: Sequence[Signal], which: str = "", empty: str = ""
) -> tuple[int, ...]:
    """Return rows of y under a key that must be there; ``empty``: what to do if there are none."""
    names = ", ".join(signal.name for signal in outputs)
    expected = f"a list of rows of y, out of 0..{len(outputs) - 1} ({names}){which}"
    rows = as_rows(section.require(key, expected), section.place.entry(key), expected, outputs)
    if not rows and empty:
        raise section.error(key, "an empty list", f"{expected}; {empty}")
    return rows


def as_rows(
    entries: object, place: Place, expected: str, outputs: Sequence[Signal]
) -> tuple[int, ...]:
    """Return indices of rows of y, ascending, each given once, by number or by name."""
    rows: list[int] = []
    for i, entry in enumerate(as_list(entries, place, expected)):
        row = _row(entry, place.item(i), [signal.name for signal in outputs])
        if row in rows:
            raise place.item(i).error(f"row {row} a second time", "every row once")
        rows.append(row)
    return tuple(sorted(rows))


def _row(entry: object, place: Place, names: list[str]) -> int:
    expected = f"a row of y, 0..{len(names) - 1}, or its name ({', '.join(names)})"
    if isinstance(entry, str):
        if entry not in names:
            raise place.error(show(entry), expected + suggestion(entry, names))
        return names.index(entry)
    number = as_number(entry, place, expected)
    if number not in range(len(names)):
        raise place.error(show(entry), expected)
    return int(number)
