"""IR + templates -> `Source`: templates shape the files, the printer makes the statements."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jinja2

from fkgen.backend.elementary_text import elementary_context
from fkgen.backend.ir import CProgram, Operator, Phase
from fkgen.backend.printer import Printer
from fkgen.backend.source import Source, with_manifest
from fkgen.backend.vectors import self_test_vectors
from fkgen.symbolic.interface import Port, Status
from fkgen.version import API_VERSION, __version__

#: Operations per step up to which update and predict are compiled into step: a copy of the instance
#: between them costs more than the code.
INLINED = 2500


@cache
def environment() -> jinja2.Environment:
    """Templates from the wheel, or from the source tree."""
    here = Path(__file__).resolve().parents[1]
    folders = [here / "templates", here.parent / "templates"]
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folders),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # noqa: S701 - C, not HTML
    )


def render(program: CProgram, claims: tuple[str, ...] = ()) -> Source:
    """Print a program. ``claims`` are what was proved about it, for the manifest."""
    context = _context(program)
    name = program.name
    files = {
        f"{name}.h": filled("header.h.j2", context),
        f"{name}.c": filled("source.c.j2", context),
        f"{name}_selftest.c": filled("selftest.c.j2", context),
        f"{name}_selftest_main.c": filled("selftest_main.c.j2", context),
        "CMakeLists.txt": filled("CMakeLists.txt.j2", context),
    }
    record = filled("record.c.j2", context | {"call": _step_call(program, record=True)})
    complete = with_manifest(files, _facts(program, claims))
    return Source(program=program, files=complete, record=record, claims=claims)


def filled(template: str, context: dict[str, object]) -> str:
    """A template filled in, without blanks at the end of lines and without gaps."""
    text = environment().get_template(template).render(context)
    lines = [line.rstrip() for line in text.splitlines()]
    kept = [line for i, line in enumerate(lines) if line or (i and lines[i - 1] not in ("", "{"))]
    return "\n".join(kept).rstrip() + "\n"


@dataclass(frozen=True, slots=True)
class _PhaseText:
    verb: str
    comment: str
    arguments: str
    program: Phase


@dataclass(frozen=True, slots=True)
class _Function:
    name: str
    calls: tuple[str, ...]
    reads_y: bool
    complete: bool
    null: str
    result: str


def _context(program: CProgram) -> dict[str, object]:
    c = Printer(program)
    vectors = self_test_vectors(program)
    modes = dict.fromkeys(p.shape[0] for p in program.ports if p.name == "mode_probability")
    return elementary_context(c, program.functions) | {
        "program": program,
        "version": __version__,
        "api": API_VERSION,
        "title": _title(program),
        "modes": next(iter(modes), 0),
        "signal_groups": _signal_groups(program),
        "cost": cost(program),
        "scalars": sum(port.size for port in program.ports),
        "statuses": program.statuses,
        "positive": [c.status(status) for status in program.statuses if status.value >= 0],
        "null": Status.NULL_POINTER,
        "bad_input": Status.INPUT_NOT_FINITE,
        "mismatch": Status.SELFTEST_FAILED,
        "shape": _shape_text,
        "full": lambda port: math.prod(port.shape),
        "initial": dict(program.initial),
        "valid_argument": _valid(c),
        "phases": _phases(c),
        "inlined": program.flops <= INLINED,
        "functions": _functions(c),
        "signature": lambda name: signature(c, name),
        "argument_doc": _argument_doc(c),
        "inputs": [_numbers(c, row) for row in vectors.u],
        "measured": [_numbers(c, row) for row in vectors.y],
        "trace": [_numbers(c, row) for row in vectors.trace],
        "final": [(name, _numbers(c, values)) for name, values in vectors.final],
        "masks": [_mask(c, row) for row in vectors.y],
        "sizes": {port.name: len(port.shape) for port in program.ports},
        "call": _step_call(program, record=False),
    }


def _title(program: CProgram) -> str:
    p = len(program.outputs)
    plural = "" if p == 1 else "s"
    return f"{program.family} filter, {len(program.states)} states, {p} measurement{plural}"


def cost(program: CProgram) -> str:
    """Operations of one step in words."""
    calls = {op: n for op, n in program.operations.items() if op.is_function}
    text = [f"{program.flops} floating-point operations"]
    text += [f"{n} {op.value}" for op, n in sorted(calls.items(), key=lambda item: item[0].value)]
    return " and ".join(text)


def signature(c: Printer, name: str) -> str:
    """Prototype of one of the three functions that run a filter."""
    return f"{c.name}_status_t {c.name}_{name}({', '.join(_arguments(c, name))})"


def _arguments(c: Printer, name: str) -> list[str]:
    arguments = [f"{c.name}_t *self"]
    if c.program.parameters:
        arguments.append(f"const {c.name}_params_t *params")
    if c.program.inputs:
        arguments.append(f"const {c.real} u[{len(c.program.inputs)}]")
    if name != "predict":
        arguments += [f"const {c.real} y[{len(c.program.outputs)}]", _valid(c)]
    return arguments


def _valid(c: Printer) -> str:
    return "uint32_t valid" if c.words == 1 else f"const uint32_t valid[{c.words}]"


def _argument_doc(c: Printer) -> str:
    lines = []
    if c.program.parameters:
        lines.append(" *  @param params  run-time parameters of this sample")
    if c.program.inputs:
        lines.append(" *  @param u       inputs of this sample, finite")
    lines.append(" *  @param y       measurements; NaN = missing, an infinity is refused")
    lines.append(
        " *  @param valid   bit i set: y[i] was measured; a row without its bit is not read"
    )
    return "\n".join(lines)


def _phases(c: Printer) -> list[_PhaseText]:
    result = []
    words = {"update": ("correct", "Condition on y[k]"), "predict": ("propagate", "Move to k + 1")}
    for name, phase in zip(words, c.program.phases, strict=True):
        arguments = [f"const {c.name}_t *self"]
        if phase.reads_parameters:
            arguments.append(f"const {c.name}_params_t *params")
        if phase.reads_input:
            arguments.append(f"const {c.real} *u")
        if name == "update":
            present = "uint32_t present" if c.words == 1 else "const uint32_t *present"
            arguments += [f"const {c.real} *y", present]
        arguments.append(f"{c.name}_t *next")
        result.append(_PhaseText(*words[name], ", ".join(arguments), phase))
    return result


def _functions(c: Printer) -> list[_Function]:
    update, predict = (f"{c.name}_{text.verb}" for text in _phases(c))
    common = [
        [(phase.reads_parameters, "params"), (phase.reads_input, "u")] for phase in c.program.phases
    ]
    first, second = ([word for used, word in words if used] for words in common)
    pointers = ["self"]
    pointers += ["params"] if c.program.parameters else []
    pointers += ["u"] if c.program.inputs else []
    measured = [*pointers, "y", *(["valid"] if c.words > 1 else [])]
    correct = f"{update}({', '.join(['self', *first, 'y', 'present', '&next'])})"
    moved = f"{predict}({', '.join(['self', *second, '&next'])})"
    moved_next = f"{predict}({', '.join(['&next', *second, '&next'])})"
    any_row = " | ".join(f"present[{i}]" for i in range(c.words)) if c.words > 1 else "present"
    ok, skipped = c.status(Status.OK), c.status(Status.SKIPPED)
    outcome = f"(({any_row}) != 0u) ? {c.outcome} : {skipped}"
    return [
        _Function("update", (correct,), True, False, _any_null(measured), outcome),  # noqa: FBT003
        _Function("predict", (moved,), False, False, _any_null(pointers), ok),  # noqa: FBT003
        _Function("step", (correct, moved_next), True, True, _any_null(measured), outcome),  # noqa: FBT003
    ]


def _any_null(pointers: list[str]) -> str:
    tests = [f"{pointer} == NULL" for pointer in pointers]
    return tests[0] if len(tests) == 1 else " || ".join(f"({test})" for test in tests)


def _step_call(program: CProgram, *, record: bool) -> str:
    p, q = len(program.outputs), len(program.inputs)
    arguments = ["self" if record else "&filter"]
    if program.parameters:
        arguments.append("&now" if record else "&params")
    if q:
        arguments.append(f"u + k * {q}" if record else "input[k]")
    if record:
        return ", ".join([*arguments, f"y + k * {p}", "valid"])
    return ", ".join([*arguments, "measurement[k]", "valid[k]"])


def _numbers(c: Printer, values: tuple[float, ...]) -> list[str]:
    return [c.literal(0.0 if math.isnan(value) else value) for value in values]


def _mask(c: Printer, row: tuple[float, ...]) -> str:
    bits = sum(1 << i for i, value in enumerate(row) if not math.isnan(value))
    words = [f"{(bits >> (32 * w)) & 0xFFFFFFFF:#x}u" for w in range(c.words)]
    return words[0] if c.words == 1 else "{ " + ", ".join(words) + " }"


def _shape_text(port: Port) -> str:
    if not port.symmetric:
        extent = " x ".join(str(length) for length in port.shape)
        return f" ({extent})" if len(port.shape) > 1 else ""
    stacked = " x ".join(str(length) for length in port.shape[:-2])
    return f" ({stacked + ' x ' if stacked else ''}symmetric {port.shape[-1]} x {port.shape[-1]})"


def _signal_groups(program: CProgram) -> list[tuple[str, str, tuple[object, ...]]]:
    groups = [
        ("States", "x", program.states),
        ("Inputs", "u", program.inputs),
        ("Measurements", "y", program.outputs),
    ]
    return [group for group in groups if group[2]]


def _facts(program: CProgram, claims: tuple[str, ...]) -> dict[str, object]:
    return {
        "name": program.name,
        "family": program.family,
        "scalar": program.scalar,
        "fkgen": __version__,
        "api": API_VERSION,
        "spec": program.digest,
        "equations": program.source,
        "proved": list(claims),
        "flops": program.flops,
        "calls": {
            op.value: n
            for op, n in sorted(program.operations.items(), key=_operator_name)
            if op.is_function
        },
        "parameters": dict(program.parameters),
        "states": [signal.name for signal in program.states],
        "inputs": [signal.name for signal in program.inputs],
        "outputs": [signal.name for signal in program.outputs],
        "ports": [
            {"name": p.name, "shape": list(p.shape), "symmetric": p.symmetric, "meaning": p.meaning}
            for p in program.ports
        ],
        "statuses": {status.name: status.value for status in program.statuses},
    }


def _operator_name(item: tuple[Operator, int]) -> str:
    return item[0].value
