"""A filter on a processor: the bits of the host, and what a step takes there."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from fkgen.backend.lines import environment, filled
from fkgen.backend.lower import generate
from fkgen.backend.render import context_of
from fkgen.backend.source import Source
from fkgen.errors import OutputError, StepRefused
from fkgen.oracle.claims.claim import Record
from fkgen.problem import Spec
from fkgen.proof import agreement
from fkgen.proof.validate import validate
from fkgen.proof.verify import Step
from fkgen.runtime.compiler import compile_source
from fkgen.runtime.layout import layout_of
from fkgen.symbolic.validated import Claim
from fkgen.target.boards import Board, board
from fkgen.target.elf import read_image
from fkgen.target.emulator import AnyEmulator, emulator
from fkgen.target.toolchain import Toolchain, compiled, linked, optimisation, toolchain

#: Steps on a target.
STEPS = 200

#: What the emulator calls: of a product, and of its test.
_LEAN = ("fkgen_step", "fkgen_init")
_WHOLE = (*_LEAN, "fkgen_selftest")

#: What it gives a step.
_GIVEN = frozenset(("fkgen_params", "fkgen_u", "fkgen_y", "fkgen_valid"))

#: Status and instance after every sample.
Trace = list[tuple[int, bytes]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What a filter takes on a processor."""

    target: str
    compiler: str  # With its version and level
    scalar: str
    instructions_min: int  # Of a step
    instructions_max: int
    flash: int  # Bytes of init and step with all that they call, and of constants
    ram: int  # Bytes of an instance, and of what else is in memory
    stack: int  # Bytes of it that a step or an init has used at most


def steps(spec: Spec, targets: Sequence[str], found: list[Figures]) -> tuple[Step, ...]:
    """What is done for these targets, one after the other; figures are added to ``found``.

    Raises
    ------
    DataError
        If a target is not known, or has no numbers of the scalar type of the spec.
    CompilerError
        If a compiler or an emulator is missing; it says how to install it.
    """
    boards = [board(name, spec.code.scalar) for name in dict.fromkeys(targets)]
    tools = {each.name: toolchain(each) for each in boards}
    for each in boards:
        emulator(each)

    @cache
    def host() -> tuple[Source, Record, Trace]:
        source, record = generate(validate(spec)), agreement.trial(spec, STEPS)
        return source, record, on_host(source, record)

    def run(each: Board) -> tuple[Claim, ...]:
        claims, figures = tried(each, tools[each.name], *host())
        found.append(figures)
        return claims

    return tuple(Step(f"emulated {each.name}", partial(run, each)) for each in boards)


def on_host(source: Source, record: Record) -> Trace:
    """What this machine makes of a record."""
    built, found = compile_source(source), []
    parameters = {name: values.tolist() for name, values in record.parameters.items()}
    built.reset(params={name: values[0] for name, values in parameters.items()} or None)
    for k, y in enumerate(record.y):
        now = {name: values[k] for name, values in parameters.items()} or None
        try:
            status = built.step(y, record.u[k] if record.u.shape[1] else None, now).status
        except StepRefused as refused:
            status = refused.status
        found.append((status, built.snapshot().data))
    return found


def tried(
    where: Board, tools: Toolchain, source: Source, record: Record, expected: Trace
) -> tuple[tuple[Claim, ...], Figures]:
    """Build a filter for a board and run it there: what holds, and figures."""
    try:
        with tempfile.TemporaryDirectory(prefix="fkgen-") as place:
            folder = Path(place)
            board_c = filled("board.c.j2", context_of(source.program))
            script = environment().get_template("board.ld").render()
            objects = compiled(tools, source, (("board.c", board_c), ("board.ld", script)), folder)
            lean = read_image(linked(tools, objects, _LEAN, folder / "lean.elf"))
            whole = read_image(linked(tools, objects, _WHOLE, folder / "whole.elf"))
    except OSError as error:
        reason, needed = (error.strerror or str(error)).lower(), "a folder for temporary files"
        raise OutputError(tempfile.gettempdir(), given=reason, expected=needed) from None
    counts: list[int] = []
    machine = emulator(where)(where, whole)
    trace = _run(machine, source, record, len(expected[0][1]), counts)
    stack = machine.stack
    passed = machine.call("fkgen_selftest") == 0
    around = sum(lean.symbols[name].size for name in _LEAN)
    given = sum(symbol.size for name, symbol in lean.symbols.items() if name in _GIVEN)
    figures = Figures(
        target=where.name,
        compiler=f"{tools.name} {optimisation(source)}",
        scalar=source.program.scalar,
        instructions_min=min(counts),
        instructions_max=max(counts),
        flash=lean.flash - around,
        ram=lean.memory - given,
        stack=stack,
    )
    return _claims(figures, passed=passed, trace=trace, expected=expected), figures


def _run(
    machine: AnyEmulator, source: Source, record: Record, size: int, counts: list[int]
) -> Trace:
    """Statuses and instances of a record on a board, and how long each step was."""
    program, kind = source.program, layout_of(source.program, ()).dtype
    machine.write("fkgen_valid", b"\xff" * (4 * -(-len(program.outputs) // 32)))
    trace = []
    for k, y in enumerate(record.y):
        now = [record.parameters[name][k] for name, _ in program.parameters]
        for name, values in (("fkgen_params", now), ("fkgen_u", record.u[k]), ("fkgen_y", y)):
            with np.errstate(over="ignore"):
                machine.write(name, np.asarray(values, kind).tobytes())
        if k == 0:
            machine.call("fkgen_init")
        status = machine.call("fkgen_step")
        counts.append(machine.instructions)
        trace.append((status, machine.read("fkgen_filter", size)))
    return trace


def _claims(figures: Figures, *, passed: bool, trace: Trace, expected: Trace) -> tuple[Claim, ...]:
    wrong = sum(a != b for a, b in zip(trace, expected, strict=True))
    of, where = f"{figures.scalar} code", figures.target
    what = f"{len(expected)} drawn steps, statuses and all of the instance"
    return (
        Claim(
            claim=f"the {of} gives the host's bits on {where}",
            source=f"{what}; {figures.compiler}",
            error=wrong / len(expected),
            tolerance=0.0,
        ),
        Claim(
            claim=f"the self-test gives the recorded bits on {where}",
            source=figures.compiler,
            error=0.0 if passed else float("inf"),
            tolerance=0.0,
        ),
    )
