"""The processors that a filter can be tried on, and how a compiler is told of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fkgen.errors import DataError

Machine = Literal["arm", "riscv32", "riscv64", "avr"]


@dataclass(frozen=True, slots=True)
class Board:
    """A processor."""

    name: str
    machine: Machine
    gcc: tuple[str, ...] = ()  # Flags of the GNU compiler for it
    zig: tuple[str, ...] = ()  # Flags of zig's; none where it has no such processor
    core: str = ""  # The name of the core in the emulator's constants
    script: tuple[str, ...] = ("-T", "board.ld")  # Rules of the linker; the compiler's own for AVR


def _arm(name: str, core: str, gcc: str, zig: str, unit: str = "") -> Board:
    floats = ("-mfloat-abi=hard", f"-mfpu={unit}") if unit else ("-mfloat-abi=soft",)
    abi = "eabihf" if unit else "eabi"
    return Board(
        name=name,
        machine="arm",
        gcc=("-mthumb", f"-mcpu={gcc}", *floats),
        zig=("-target", f"thumb-freestanding-{abi}", f"-mcpu={zig}"),
        core=f"UC_CPU_ARM_{core}",
    )


def _riscv(name: str, bits: Literal[32, 64], abi: str, extensions: str) -> Board:
    features = "".join(f"+{each}" for each in extensions)
    return Board(
        name=name,
        machine="riscv32" if bits == 32 else "riscv64",
        zig=(
            "-target",
            f"riscv{bits}-freestanding",
            f"-mcpu=generic_rv{bits}{features}",
            f"-mabi={abi}",
        ),
        core=f"UC_CPU_RISCV{bits}_ANY",
    )


#: The emulator's Cortex-M7 has no unit for double; its largest core has, and runs the same code.
BOARDS = {
    board.name: board
    for board in (
        _arm("cortex-m0plus", "CORTEX_M0", "cortex-m0plus", "cortex_m0plus"),
        _arm("cortex-m3", "CORTEX_M3", "cortex-m3", "cortex_m3"),
        _arm("cortex-m4f", "CORTEX_M4", "cortex-m4", "cortex_m4+vfp4d16sp", "fpv4-sp-d16"),
        _arm("cortex-m7", "MAX", "cortex-m7", "cortex_m7+fp_armv8d16", "fpv5-d16"),
        _arm("cortex-m33", "CORTEX_M33", "cortex-m33", "cortex_m33+fp_armv8d16sp", "fpv5-sp-d16"),
        _riscv("rv32imac", 32, "ilp32", "mac"),
        _riscv("rv32imafc", 32, "ilp32f", "mafc"),
        _riscv("rv64gc", 64, "lp64d", "mafdc"),
        Board("avr", "avr", ("-mmcu=atmega2560",), script=()),
    )
}


def board(name: str, scalar: str = "float") -> Board:
    """The processor of this name.

    Raises
    ------
    DataError
        If there is none, or if it has no numbers of this scalar type.
    """
    if name not in BOARDS:
        raise DataError("target", given=repr(name), expected=f"one of {', '.join(BOARDS)}")
    if name == "avr" and scalar == "double":
        expected = 'code.scalar = "float": double has 32 bits there'
        raise DataError("target", given="avr for a filter in double", expected=expected)
    return BOARDS[name]
