"""What a filter costs on a target: operations, memory of an instance, bytes of code."""

from __future__ import annotations

import json
import subprocess
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fkgen.backend.source import MANIFEST
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.compiler import LARGE, find_compiler

#: Operations that a call of exp, log, sqrt or their kin is counted as: what its C does.
CALL = 25

_CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")


@dataclass(frozen=True, slots=True)
class Footprint:
    """Costs of one filter."""

    operations: int  # Floating-point operations of a step, without those inside calls
    calls: int  # Calls of elementary functions
    state: int  # Bytes of an instance
    #: Bytes of code and constants by target; what could not be compiled or measured is missing
    flash: dict[str, int]

    @property
    def cost(self) -> int:
        """Operations of a step with every call counted as `CALL`."""
        return self.operations + CALL * self.calls


def footprint(compiled: CompiledFilter) -> Footprint:
    """Measure a compiled filter."""
    layout, host = compiled.layout, find_compiler().command
    fast = "-O2" if layout.statements <= LARGE else "-O1"
    attempts = {
        "host -Os": ("size", *host, "-Os"),
        f"host {fast}": ("size", *host, fast),
        "Cortex-M4F -Os": ("arm-none-eabi-size", "arm-none-eabi-gcc", *_CORTEX, "-Os"),
    }
    code = compiled.folder / f"{compiled.name}.c"
    sizes = {name: _text_bytes(code, *tools) for name, tools in attempts.items()}
    calls = json.loads((compiled.folder / MANIFEST).read_text(encoding="utf-8"))["calls"]
    scalars = sum(port.size for port in layout.ports)
    flash = {name: size for name, size in sizes.items() if size is not None}
    return Footprint(layout.flops, sum(calls.values()), scalars * layout.dtype().itemsize, flash)


def _text_bytes(code: Path, size: str, *compiler: str) -> int | None:
    """Code and constants of one object file; None if a tool is missing or refuses."""
    run = partial(subprocess.check_output, text=True, stderr=subprocess.DEVNULL, timeout=600)
    failures = (OSError, subprocess.SubprocessError, IndexError, ValueError)
    with tempfile.TemporaryDirectory(prefix="fkgen-") as folder, suppress(*failures):
        target = f"{folder}/filter.o"
        run([*compiler, "-std=c99", "-ffp-contract=off", "-c", str(code), "-o", target])
        return int(run([size, target]).splitlines()[1].split()[0])
    return None
