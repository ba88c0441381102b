"""Compile contenders: each a step in a translation unit of its own, and the same loop around it."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from harness import models
from rivals import hand

import fkgen

HERE = Path(__file__).resolve().parent
FLAGS = ("-std=c99", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden")
COMPILERS = {"gcc": ("gcc",), "clang": ("clang",)}


@dataclass(frozen=True)
class Contender:
    """A step in C that can be compiled in several ways.

    Attributes
    ----------
    source : Path
        The translation unit that holds the step.
    header : str
        What the loop includes: the macros TYPE, INIT, STEP, RESULT.
    defines : mapping of str to object
        Macros for both units.
    """

    source: Path
    header: str
    defines: Mapping[str, object] = field(default_factory=dict)
    real: str = "double"

    def commands(self, out: Path, cc: str, level: str, extra: tuple[str, ...]) -> list[list[str]]:
        """Compile the step and the loop, and link them."""
        header = out.with_suffix(".h")
        header.write_text(self.header)
        defines = [f"-D{name}={value}" for name, value in self.defines.items()]
        include = [f"-I{HERE / 'c'}", f"-I{self.source.parent}"]
        if self.source.suffix == ".cpp":
            driver = {"gcc": "g++", "clang": "clang++"}[cc]
            flags = [f for f in FLAGS if not f.startswith("-std")] + [
                "-DNDEBUG",
                "-I/usr/include/eigen3",
            ]
        else:
            driver, flags = COMPILERS[cc][0], list(FLAGS)
        step, loop = out.with_suffix(".step.o"), out.with_suffix(".loop.o")
        around = ["-O2", f'-DCONTENDER="{header}"', f"-DREAL={self.real}", *extra]
        body = HERE / "c" / "loop.c"
        kind = () if extra else ("-shared",)
        return [
            [driver, *flags, level, *defines, *include, "-c", str(self.source), "-o", str(step)],
            [cc, *FLAGS, *around, *defines, *include, "-c", str(body), "-o", str(loop)],
            [driver, *kind, str(step), str(loop), "-lm", "-o", str(out)],
        ]


def library(
    contender: Contender, out: Path, cc: str = "gcc", level: str = "-O2"
) -> Callable[[models.Array, models.Array], float]:
    """A function of (y, u) that runs the loop over a record."""
    for command in contender.commands(out.with_suffix(".so"), cc, level, ()):
        subprocess.run(command, check=True)
    run: Any = ctypes.CDLL(str(out.with_suffix(".so"))).run
    run.argtypes = [ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p]
    run.restype = ctypes.c_double if contender.real == "double" else ctypes.c_float
    dtype = np.float64 if contender.real == "double" else np.float32

    def call(y: models.Array, u: models.Array) -> float:
        assert y.dtype == dtype  # noqa: S101 - a slip here would measure nonsense
        return float(run(len(y), y.ctypes.data, u.ctypes.data))

    return call


def program(contender: Contender, out: Path, cc: str = "gcc", level: str = "-O2") -> Path:
    """An executable that runs as many steps as its argument says."""
    for command in contender.commands(out.with_suffix(".exe"), cc, level, ("-DMAIN",)):
        subprocess.run(command, check=True)
    return out.with_suffix(".exe")


def of_fkgen(spec: models.Spec, folder: Path) -> Contender:
    """What fkgen generates for a spec as a table."""
    return of_spec(fkgen.Spec.from_dict(spec), folder)


def of_spec(spec: fkgen.Spec, folder: Path) -> Contender:
    """What fkgen generates for a spec."""
    source, name = fkgen.generate(fkgen.validate(spec)), spec.name
    source.write(folder / name)
    p, q = spec.model.ny, spec.model.nu
    u = "u, " if q else ""
    header = f'#include "{name}.h"\n'
    if source.program.parameters:
        u = "&defaults, " + u
        values = ", ".join(repr(value) for _, value in source.program.parameters)
        header += f"static const {name}_params_t defaults = {{ {values} }};\n"
    header += (
        f"#define TYPE {name}_t\n#define INIT(f) {name}_init(f)\n"
        f"#define STEP(f, u, y) {name}_step(f, {u}y, 0xffffffffu)\n"
        "#define RESULT(f) ((f)->filtered_state[0])\n"
    )
    defines = {"NY": p, "NU": q}
    return Contender(folder / name / f"{name}.c", header, defines, spec.code.scalar)


def of_hand(spec: models.Spec, folder: Path, *, checks: bool) -> Contender:
    """The reference: a file of ours where there is one, else the emitter's."""
    written = HERE / "c" / f"hand_{spec['name']}.c"
    if not written.exists():
        written = folder / f"hand_{spec['name']}.c"
        written.write_text(hand.kalman(spec["model"]))
    return Contender(written, _header("hand.h"), _defines(spec, CHECKS=int(checks)))


def of_eigen(spec: models.Spec, folder: Path) -> Contender:
    """Eigen with fixed sizes, in the textbook form."""
    table = folder / f"eigen_{spec['name']}.inc"
    lines = []
    for name in ("A", "C", "Q", "R", "P0"):
        values = ", ".join(repr(v) for row in spec["model"][name] for v in row)
        lines.append(f"static const double {name}_[] = {{ {values} }};")
    table.write_text("\n".join(lines) + "\n")
    return Contender(
        HERE / "c" / "eigen.cpp", _header("eigen.h"), _defines(spec, MODEL=f'"{table}"')
    )


def _header(name: str) -> str:
    return (
        f'#include "{name}"\n#define TYPE hand_t\n#define INIT(f) hand_init(f)\n'
        "#define STEP(f, u, y) hand_step(f, y)\n#define RESULT(f) ((f)->xf[0])\n"
    )


def _defines(spec: models.Spec, **more: object) -> dict[str, object]:
    n, p, q = models.width(spec)
    return {"NX": n, "NY": p, "NU": q, **more}
