"""A processor in this process, by unicorn: functions of a program are called one by one.

Instructions are counted before each block of them by a function in C, since there are millions.
The stack is painted, and what was written of it is seen afterwards.
"""

from __future__ import annotations

import ctypes
from functools import cache
from importlib import import_module
from typing import Any

from fkgen.errors import CompilerError
from fkgen.target.avr import AvrEmulator, library
from fkgen.target.boards import Board
from fkgen.target.elf import Image
from fkgen.target.toolchain import on_this_machine

#: Where a function returns to, and where the stack is.
_RETURN, _STACK, _STACK_SIZE = 0x8000, 0x30000000, 0x40000
_PAGE, _PAINT = 0x1000, b"\xa5"

#: Modes in a register of a unit for floats: Arm's is switched on, RISC-V's is clean.
_ARM_UNIT_ON, _RISCV_UNIT_ON = 0x40000000, 0x6000


class _Watch(ctypes.Structure):
    """What the counting function is given, as in ``count.c``."""

    _fields_ = (
        ("image", ctypes.c_char_p),
        *((name, ctypes.c_uint64) for name in ("base", "size", "skip", "skip_end", "count")),
        ("thumb", ctypes.c_int32),
    )


def unicorn() -> Any:
    """The emulator, if it is installed."""
    try:
        return import_module("unicorn")
    except ImportError:
        message = "unicorn, an emulator, is not installed: pip install unicorn (or fkgen[target])"
        raise CompilerError(message) from None


class Emulator:
    """A processor with a program in its memory."""

    def __init__(self, board: Board, image: Image, *, seconds: float = 60.0) -> None:
        self.board, self.image, self.seconds = board, image, seconds
        self._arm = board.machine == "arm"
        self._machine, self._registers = self._made()
        around = image.symbols["fkgen_step"]
        begin = around.address & ~1
        code = next(e for e in image.segments if 0 <= begin - e.address < len(e.data))
        self._watch = _Watch(
            code.data, code.address, len(code.data), begin, begin + around.size, 0, self._arm
        )
        self._load()

    def call(self, name: str) -> int:
        """Call a function without arguments: what it returns, as a signed 32-bit number.

        Raises
        ------
        CompilerError
            If it does not return within the time, or if the processor meets a fault.
        """
        where, registers = self.image.symbols[name].address, self._registers
        self._machine.reg_write(registers["sp"], _STACK + _STACK_SIZE - 64)
        self._machine.reg_write(registers["link"], _RETURN | int(self._arm))
        self._watch.count = 0
        try:
            self._machine.emu_start(where, _RETURN, int(self.seconds * 1e6))
        except unicorn().UcError as fault:
            at = self._machine.reg_read(registers["pc"])
            text = f"{self.board.name}: {name} met a fault at {at:#x}: {fault}"
            raise CompilerError(text) from None
        if self._machine.reg_read(registers["pc"]) != _RETURN:
            text = f"{self.board.name}: {name} did not return within {self.seconds:g} s: stopped"
            raise CompilerError(text)
        value = self._machine.reg_read(registers["result"]) & 0xFFFFFFFF
        return int(value - (value >> 31 << 32))

    @property
    def instructions(self) -> int:
        """Those of the latest call, but for what stands around the filter."""
        return int(self._watch.count)

    @property
    def stack(self) -> int:
        """Bytes of the stack that were ever used."""
        painted = bytes(self._machine.mem_read(_STACK, _STACK_SIZE))
        return _STACK_SIZE - 64 - (len(painted) - len(painted.lstrip(_PAINT)))

    def read(self, name: str, size: int) -> bytes:
        """The first bytes of a variable."""
        return bytes(self._machine.mem_read(self.image.symbols[name].address, size))

    def write(self, name: str, data: bytes) -> None:
        """Set the first bytes of a variable."""
        if data:
            self._machine.mem_write(self.image.symbols[name].address, data)

    def _made(self) -> tuple[Any, dict[str, int]]:
        """The processor, its unit for floats switched on, and the numbers of its registers."""
        library = unicorn()
        if self._arm:
            names = import_module("unicorn.arm_const")
            kind = library.UC_MODE_MCLASS if "CORTEX_M" in self.board.core else 0
            machine = library.Uc(library.UC_ARCH_ARM, library.UC_MODE_THUMB | kind)
            prefix, unit = "UC_ARM_REG_", ("FPEXC", _ARM_UNIT_ON)
            registers = {"sp": "SP", "link": "LR", "pc": "PC", "result": "R0"}
        else:
            names = import_module("unicorn.riscv_const")
            wide = self.board.machine == "riscv64"
            mode = library.UC_MODE_RISCV64 if wide else library.UC_MODE_RISCV32
            machine = library.Uc(library.UC_ARCH_RISCV, mode)
            prefix, unit = "UC_RISCV_REG_", ("MSTATUS", _RISCV_UNIT_ON)
            registers = {"sp": "SP", "link": "RA", "pc": "PC", "result": "A0"}
        machine.ctl_set_cpu_model(getattr(names, self.board.core))
        machine.reg_write(getattr(names, prefix + unit[0]), unit[1])
        found = {role: getattr(names, prefix + name) for role, name in registers.items()}
        return machine, found

    def _load(self) -> None:
        """The program, the stack, and the function that counts."""
        machine, library = self._machine, unicorn()
        machine.mem_map(_RETURN, _PAGE)
        machine.mem_map(_STACK, _STACK_SIZE)
        machine.mem_write(_STACK, _PAINT * (_STACK_SIZE - 64))
        pages = {
            page
            for each in self.image.segments
            for page in range(each.address // _PAGE, (each.address + each.size - 1) // _PAGE + 1)
        }
        for page in sorted(pages):
            machine.mem_map(page * _PAGE, _PAGE)
        for each in self.image.segments:
            machine.mem_write(each.address, each.data)
        binding = import_module("unicorn.unicorn_py3.unicorn")
        hook = ctypes.c_size_t()
        status = binding.uclib.uc_hook_add(
            machine._uch,  # noqa: SLF001 - its hook_add takes functions in Python alone
            ctypes.byref(hook),
            library.UC_HOOK_BLOCK,
            ctypes.cast(counter().count, ctypes.c_void_p),
            ctypes.byref(self._watch),
            ctypes.c_uint64(1),
            ctypes.c_uint64(0),
        )
        if status != library.UC_ERR_OK:
            raise CompilerError(f"unicorn takes no hook: {library.UcError(status)}")


AnyEmulator = Emulator | AvrEmulator


def emulator(board: Board) -> type[AnyEmulator]:
    """What emulates a board.

    Raises
    ------
    CompilerError
        If it is missing; it says how to install it.
    """
    if board.machine == "avr":
        library()
        return AvrEmulator
    unicorn()
    return Emulator


@cache
def counter() -> ctypes.CDLL:
    """The function that counts, compiled for this machine."""
    return on_this_machine("count.c")
