"""Programs as linkers write them: what is loaded where, and where symbols are."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from fkgen.errors import CompilerError

_EXECUTED, _WRITTEN, _LOADED, _SYMBOLS = 1, 2, 1, 2


@dataclass(frozen=True, slots=True)
class Symbol:
    """A function or a variable."""

    address: int
    size: int


@dataclass(frozen=True, slots=True)
class Segment:
    """What is loaded as one."""

    address: int
    data: bytes  # As it is in the file
    size: int  # In memory, where zeros follow
    written: bool  # Memory, not flash


@dataclass(frozen=True, slots=True)
class Image:
    """A linked program."""

    segments: tuple[Segment, ...]
    symbols: dict[str, Symbol]

    @property
    def flash(self) -> int:
        """Bytes of code and constants, and of what memory starts with."""
        return sum(len(each.data) for each in self.segments)

    @property
    def memory(self) -> int:
        """Bytes of variables."""
        return sum(each.size for each in self.segments if each.written)


def read_image(path: Path) -> Image:
    """Read an ELF file, little endian, of 32 or 64 bits."""
    data = path.read_bytes()
    if data[:4] != b"\x7fELF" or data[5] != 1:
        raise CompilerError(f"{path.name} is no little-endian ELF file")
    wide = data[4] == 2
    header = struct.unpack_from("<16xHHIQQQIHHHHHH" if wide else "<16xHHIIIIIHHHHHH", data)
    (*_, segments_at, sections_at, _, _, segment, count, section, sections, _) = header
    found = []
    for i in range(count):
        at = segments_at + i * segment
        if wide:
            kind, flags, offset, address, _, stored, size, _ = struct.unpack_from(
                "<IIQQQQQQ", data, at
            )
        else:
            kind, offset, address, _, stored, size, flags, _ = struct.unpack_from(
                "<IIIIIIII", data, at
            )
        if kind == _LOADED and size:
            content = data[offset : offset + stored]
            found.append(Segment(address, content, size, bool(flags & _WRITTEN)))
    tables = [_section(data, sections_at + i * section, wide=wide) for i in range(sections)]
    symbols: dict[str, Symbol] = {}
    for kind, offset, size, link in tables:
        if kind == _SYMBOLS:
            symbols |= _symbols(data, offset, size, tables[link][1], wide=wide)
    return Image(tuple(found), symbols)


def _section(data: bytes, at: int, *, wide: bool) -> tuple[int, int, int, int]:
    """Kind, offset, size and link of a section."""
    names = "<IIQQQQII" if wide else "<IIIIIIII"
    _, kind, _, _, offset, size, link, _ = struct.unpack_from(names, data, at)
    return kind, offset, size, link


def _symbols(data: bytes, at: int, size: int, names: int, *, wide: bool) -> dict[str, Symbol]:
    found = {}
    for place in range(at, at + size, 24 if wide else 16):
        if wide:
            name, _, _, _, value, length = struct.unpack_from("<IBBHQQ", data, place)
        else:
            name, value, length, *_ = struct.unpack_from("<IIIBBH", data, place)
        text = data[names + name : data.index(b"\0", names + name)].decode("latin-1")
        if text:
            found[text] = Symbol(value, length)
    return found
