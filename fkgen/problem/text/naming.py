"""Names that become C identifiers."""

from __future__ import annotations

import re
from collections.abc import Iterable

from fkgen.problem.table.place import Place, describe, show
from fkgen.problem.text.expression import FUNCTIONS

MAX_LENGTH = 40
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

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

KEYWORDS = frozenset((_C + _CPP).split())
RESERVED = frozenset(_MACROS.split()) | frozenset(f"{stem}_t" for stem in _TYPES.split())
PREFIX_RESERVED = frozenset(_TYPES.split()) | frozenset(_HEADERS.split())


def read_name(value: object, place: Place) -> str:
    """Return a text that is safe as a C and C++ identifier."""
    expected = f"a C identifier: letters, digits and _, at most {MAX_LENGTH} characters"
    if not isinstance(value, str):
        raise place.error(describe(value), expected)
    if not _IDENTIFIER.fullmatch(value):
        raise place.error(show(value), expected)
    if len(value) > MAX_LENGTH:
        raise place.error(f"{show(value)} with {len(value)} characters", expected)
    if value in KEYWORDS:
        raise place.error(show(value), "a name that is not a keyword of C or C++")
    if value.startswith("_") or value.endswith("_") or "__" in value:
        raise place.error(show(value), "a name without leading, trailing or double underscores")
    if value in RESERVED:
        raise place.error(show(value), "a name that C and its library do not reserve")
    return str(value)


def read_prefix(value: object, place: Place) -> str:
    """Return the name of the filter: the prefix of its files, types and functions."""
    name = read_name(value, place)
    if name in PREFIX_RESERVED:
        raise place.error(
            show(name), f"another name: '{name}.h' or '{name}_t' belongs to the C library"
        )
    return name


def read_parameter_name(value: object, place: Place) -> str:
    """Return the name of a parameter, which is a name in expressions too."""
    name = read_name(value, place)
    if name == "I":
        raise place.error(show(name), "a name that is not a macro of <complex.h>")
    if name in FUNCTIONS:
        raise place.error(show(name), "a name that is not a function of the expression language")
    return name


def check_distinct(names: Iterable[str], place: Place, what: str) -> None:
    """Refuse names that are equal, or equal but for case: C macros write them in capitals."""
    seen: dict[str, str] = {}
    for name in names:
        first = seen.get(name.lower())
        if first is not None:
            given = f"'{name}' twice" if first == name else f"'{first}' and '{name}'"
            raise place.error(given, f"{what} with distinct names (capitals do not distinguish)")
        seen[name.lower()] = name
