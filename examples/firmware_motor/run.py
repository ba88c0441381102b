"""Build the firmware of a motor's filter, and run it on an emulated Cortex-M4F: ``python run.py``.

Needs fkgen[target], nothing else: ziglang compiles where there is no arm-none-eabi-gcc, unicorn is
the processor, and this script answers its calls for files of the host.
"""

from __future__ import annotations

import shutil
import struct
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import fkgen
from fkgen.target.boards import board
from fkgen.target.elf import read_image
from fkgen.target.emulator import unicorn
from fkgen.target.toolchain import toolchain

HERE = Path(__file__).resolve().parent
OWN = ("main.c", "startup.c", "semihosting.h", "m4f.ld")
FLAGS = ("-std=gnu99", "-O2", "-ffp-contract=off", "-ffunction-sections", "-Wall", "-Wextra")
ESTIMATE = np.dtype([("state", "<f4", 2), ("speed_variance", "<f4"), ("status", "<i4")])

#: What unicorn calls the exception of a breakpoint, and pages that hold all there is.
_BREAKPOINT, _PAGES = 7, ((0x00000000, 0x10000), (0x20000000, 0x2000), (0xE000E000, 0x1000))


class Host:
    """A processor, and the files that it asks for."""

    def __init__(self, elf: Path, folder: Path) -> None:
        library, self.folder = unicorn(), folder
        arm_const = self.names = import_module("unicorn.arm_const")
        mode = library.UC_MODE_THUMB | library.UC_MODE_MCLASS
        self.machine = library.Uc(library.UC_ARCH_ARM, mode)
        self.machine.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)
        self.machine.reg_write(arm_const.UC_ARM_REG_FPEXC, 0x40000000)  # CPACR is a page of memory
        for address, size in _PAGES:
            self.machine.mem_map(address, size)
        self.size = 0
        for each in read_image(elf).segments:
            self.machine.mem_write(each.address, each.data)
            self.size += len(each.data)
        self.machine.hook_add(library.UC_HOOK_INTR, self._interrupt)
        self.files: list[Any] = []
        self.exit: int | None = None
        self.said = ""

    def run(self, seconds: float = 60.0) -> int:
        """From reset to the exit; its code."""
        stack, reset = struct.unpack("<II", self.machine.mem_read(0, 8))
        self.machine.reg_write(self.names.UC_ARM_REG_SP, stack)
        self.machine.emu_start(reset, 0xFFFFFFFE, int(seconds * 1e6))
        for file in self.files:
            file.close()
        if self.exit is None:
            sys.exit(f"the firmware did not end within {seconds:g} s")
        return self.exit

    def _interrupt(self, machine: Any, number: int, _: object) -> None:
        if number != _BREAKPOINT:
            machine.emu_stop()
            return
        operation = machine.reg_read(self.names.UC_ARM_REG_R0)
        at = machine.reg_read(self.names.UC_ARM_REG_R1)
        answer = self._answer(operation, at)
        machine.reg_write(self.names.UC_ARM_REG_R0, answer & 0xFFFFFFFF)
        place = machine.reg_read(self.names.UC_ARM_REG_PC)
        machine.reg_write(self.names.UC_ARM_REG_PC, (place + 2) | 1)

    def _answer(self, operation: int, at: int) -> int:
        if operation == 0x04:
            text = bytes(self.machine.mem_read(at, 64)).split(b"\0")[0]
            self.said += text.decode("ascii")
            return 0
        first, second, third = struct.unpack("<III", self.machine.mem_read(at, 12))
        if operation == 0x01:
            name = bytes(self.machine.mem_read(first, third)).decode("ascii")
            self.files.append((self.folder / name).open("rb" if second < 4 else "wb"))
            return len(self.files) - 1
        if operation == 0x05:
            self.files[first].write(self.machine.mem_read(second, third))
            return 0
        if operation == 0x06:
            data = self.files[first].read(third)
            self.machine.mem_write(second, data)
            return third - len(data)
        self.exit = second
        self.machine.emu_stop()
        return 0


def firmware(source: Any, folder: Path) -> Path:
    """The program, built as a project would do it."""
    tools = toolchain(board("cortex-m4f"))
    for name in OWN:
        shutil.copy(HERE / name, folder)
    for name, text in source.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    files = ("main.c", "startup.c", "motor.c", "motor_selftest.c")
    objects = [name.replace(".c", ".o") for name in files]
    for name, target in zip(files, objects, strict=True):
        tools.run(*FLAGS, "-c", name, "-o", target, folder=folder)
    linked = ("-nostdlib", "-Wl,--gc-sections", "-T", "m4f.ld", *objects, *tools.libraries)
    tools.run(*linked, "-o", "firmware.elf", folder=folder)
    return folder / "firmware.elf"


def samples(spec: Any) -> tuple[np.ndarray, np.ndarray]:
    """Ten seconds of the motor, with pulses missing and a cable torn for a while."""
    u = np.where(np.arange(1000) // 250 % 2, -6.0, 12.0)[:, None]
    y = fkgen.simulate(spec, 1, len(u), seed=4, u=u).y[0]
    y[100:130] = np.nan
    y[400:450] = 99.0
    return u, y


def main() -> int:
    """Build, run, compare; the exit status."""
    spec = fkgen.load(HERE / "spec.toml")
    source = fkgen.generate(fkgen.validate(spec))
    u, y = samples(spec)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        host = Host(firmware(source, folder), folder)
        np.hstack((u, y)).astype("<f4").tofile(folder / "samples.bin")
        code = host.run()
        found = np.fromfile(folder / "estimates.bin", ESTIMATE)
    run = fkgen.compile(source).run(y, u)
    same = [
        np.array_equal(found["state"], run.filtered_state),
        np.array_equal(found["speed_variance"], run.filtered_covariance[:, 1, 1]),
        np.array_equal(found["status"], run.status),
    ]
    print(f"firmware of {host.size} bytes says {host.said!r} and ends with {code}")
    print(f"{len(found)} samples, {(run.status == 2).sum()} of them out of range")
    print(f"the same bits as on this machine: {'yes' if all(same) else 'NO'}")
    return 0 if all(same) and code == 0 and len(found) == len(y) else 1


if __name__ == "__main__":
    sys.exit(main())
