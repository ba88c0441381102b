"""An ATmega2560 in this process, by libsimavr, which a few functions in C lead step by step."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

from fkgen.errors import CompilerError
from fkgen.target.boards import Board
from fkgen.target.elf import Image
from fkgen.target.toolchain import on_this_machine

#: Instructions per second of patience: about what the emulator does.
_SPEED = 20_000_000
_PAINT = 0xA5


class AvrEmulator:
    """A processor with a program in its memory; called as `Emulator` is."""

    def __init__(self, board: Board, image: Image, *, seconds: float = 60.0) -> None:
        self.board, self.image, self.seconds = board, image, seconds
        self.instructions = 0
        self._library = library()
        self._machine = ctypes.c_void_p(self._library.avr_new())
        around = image.symbols["fkgen_step"]
        self._skipped = (ctypes.c_uint32 * 2)(around.address, around.address + around.size)
        for each in image.segments:
            self._put(each.address, each.data + bytes(each.size - len(each.data)))
        used = [each.address + each.size for each in image.segments if each.written]
        self._bottom, self._top = max(used), int(self._library.avr_top(self._machine)) + 1
        self._put(self._bottom, bytes([_PAINT]) * (self._top - self._bottom))

    def call(self, name: str) -> int:
        """Call a function without arguments: what it returns, as a signed 16-bit number."""
        result, where = ctypes.c_int(), self.image.symbols[name].address
        most = ctypes.c_int64(int(self.seconds * _SPEED))
        count = self._library.avr_call(
            self._machine, where, self._skipped, most, ctypes.byref(result)
        )
        if count < 0:
            why = "did not return: stopped" if count == -1 else "met a fault"
            raise CompilerError(f"{self.board.name}: {name} {why}")
        self.instructions = int(count)
        return result.value

    @property
    def stack(self) -> int:
        """Bytes of the stack that were ever used."""
        painted = self._get(self._bottom, self._top - self._bottom)
        return len(painted.lstrip(bytes([_PAINT])))

    def read(self, name: str, size: int) -> bytes:
        """The first bytes of a variable."""
        return self._get(self.image.symbols[name].address, size)

    def write(self, name: str, data: bytes) -> None:
        """Set the first bytes of a variable."""
        if data:
            self._put(self.image.symbols[name].address, data)

    def _put(self, address: int, data: bytes) -> None:
        if not self._library.avr_put(self._machine, address, data, len(data)):
            room = f"{len(data)} bytes at {address:#x}"
            text = f"the program does not fit on {self.board.name} (ATmega2560): {room}"
            raise CompilerError(text)

    def _get(self, address: int, size: int) -> bytes:
        found = ctypes.create_string_buffer(size)
        self._library.avr_get(self._machine, address, found, size)
        return found.raw


@cache
def library() -> Any:
    """Functions that lead the emulator, compiled for this machine.

    Raises
    ------
    CompilerError
        If the emulator is missing.
    """
    try:
        found = on_this_machine("avr.c", "-lsimavr")
    except CompilerError:
        message = "libsimavr, an emulator, is not installed: apt install libsimavr-dev"
        raise CompilerError(message) from None
    found.avr_new.restype = ctypes.c_void_p
    found.avr_top.restype = ctypes.c_uint32
    found.avr_call.restype = ctypes.c_int64
    return found
