"""The functions of a C program: prototypes, calls, and which elementary functions it needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fkgen.backend.elementary import FORMATS
from fkgen.backend.ir import CProgram, Operator, Phase, Scalar
from fkgen.backend.printer import Printer, StatementPrinter, shared_prefix
from fkgen.symbolic.interface import Status

#: Operations per step up to which update and predict are compiled into step: a copy of the instance
#: between them costs more than the code.
INLINED = 2500


@dataclass(frozen=True, slots=True)
class PhaseText:
    """One phase as a static function."""

    verb: str
    comment: str
    arguments: str
    program: Phase
    inlined: bool


@dataclass(frozen=True, slots=True)
class Call:
    """Call of a phase, under a condition if ``when`` holds one."""

    text: str
    when: str = ""


@dataclass(frozen=True, slots=True)
class Function:
    """One of the functions that run a filter: what it calls and what it returns."""

    name: str
    calls: tuple[Call, ...]
    reads_y: bool
    complete: bool
    null: str
    result: str


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
        arguments += [f"const {c.real} y[{len(c.program.outputs)}]", valid_argument(c)]
    return arguments


def valid_argument(c: Printer) -> str:
    """The bits that say which rows of y were measured."""
    return "uint32_t valid" if c.words == 1 else f"const uint32_t valid[{c.words}]"


def argument_doc(c: Printer) -> str:
    """Lines of the header about the arguments of an update."""
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


def phases_of(c: Printer, phases: tuple[Phase, ...]) -> list[PhaseText]:
    """The phases as static functions; what few samples need is never inlined."""
    result, program = [], c.program
    update, *closing, predict = phases
    small = program.flops <= INLINED
    for words, phase, inlined in (
        (("correct", "Condition on y[k]"), update, small),
        (("close_window", "At the end of a window"), next(iter(closing), None), False),
        (("propagate", "Move to k + 1"), predict, small),
    ):
        if phase is None:
            continue
        arguments = [f"const {c.name}_t *self"]
        if phase.reads_parameters:
            arguments.append(f"const {c.name}_params_t *params")
        if phase.reads_input:
            arguments.append(f"const {c.real} *u")
        if phase is update:
            present = "uint32_t present" if c.words == 1 else "const uint32_t *present"
            arguments += [f"const {c.real} *y", present]
        arguments.append(f"{c.name}_t *next")
        result.append(PhaseText(*words, ", ".join(arguments), phase, inlined))
    return result


def functions_of(c: Printer) -> list[Function]:
    """Update, predict and step."""
    program = c.program
    pointers = ["self"]
    pointers += ["params"] if program.parameters else []
    pointers += ["u"] if program.inputs else []
    measured = [*pointers, "y", *(["valid"] if c.words > 1 else [])]
    correct = [_call(c, "correct", program.update, "self")]
    if program.closing is not None:
        when = f"!(next.{program.closing.unless} > {c.literal(0.0)})"
        correct.append(Call(_call(c, "close_window", program.closing, "&next").text, when))
    moved = _call(c, "propagate", program.predict, "self")
    moved_next = _call(c, "propagate", program.predict, "&next")
    any_row = " | ".join(f"present[{i}]" for i in range(c.words)) if c.words > 1 else "present"
    ok, skipped = c.status(Status.OK), c.status(Status.SKIPPED)
    outcome = f"(({any_row}) != 0u) ? {c.outcome} : {skipped}"
    step = (*correct, moved_next)
    return [
        Function("update", tuple(correct), True, False, _any_null(measured), outcome),  # noqa: FBT003
        Function("predict", (moved,), False, False, _any_null(pointers), ok),  # noqa: FBT003
        Function("step", step, True, True, _any_null(measured), outcome),  # noqa: FBT003
    ]


def _call(c: Printer, verb: str, phase: Phase, source: str) -> Call:
    """Call of one phase, which reads ``source`` and writes ``next``."""
    arguments = [source]
    arguments += ["params"] if phase.reads_parameters else []
    arguments += ["u"] if phase.reads_input else []
    arguments += ["y", "present"] if phase is c.program.update else []
    return Call(f"{c.name}_{verb}({', '.join([*arguments, '&next'])})")


def _any_null(pointers: list[str]) -> str:
    tests = [f"{pointer} == NULL" for pointer in pointers]
    return tests[0] if len(tests) == 1 else " || ".join(f"({test})" for test in tests)


def step_call(program: CProgram, *, record: bool) -> str:
    """Arguments of a call of step inside the record runner or the self-test."""
    p, q = len(program.outputs), len(program.inputs)
    arguments = ["self" if record else "&filter"]
    if program.parameters:
        arguments.append("&now" if record else "&params")
    if q:
        arguments.append(f"u + k * {q}" if record else "input[k]")
    if record:
        return ", ".join([*arguments, f"y + k * {p}", "valid"])
    return ", ".join([*arguments, "measurement[k]", "valid[k]"])


#: Name of the files that hold the functions for all filters of a program, by scalar.
SHARED = "fkgen_elementary_{}"


def shared_context(scalar: Scalar) -> dict[str, object]:
    """What the templates of the shared files read: every function, whatever a filter needs."""
    c = StatementPrinter(shared_prefix(scalar), scalar, 1)
    functions = frozenset(operator for operator in Operator if operator.is_function)
    return elementary_context(c, functions) | {"storage": "", "file": SHARED.format(scalar)}


def elementary_context(c: StatementPrinter, functions: frozenset[Operator]) -> dict[str, object]:
    """Names, constants, and which functions there are; sqrt where atan2 needs it."""
    needs = {op.value: op in functions for op in Operator if op.is_function}
    needs["wave"] = needs["sin"] or needs["cos"] or needs["tan"]
    needs["scale"] = needs["exp"]
    needs["sqrt"] = needs["sqrt"] or needs["atan2"]
    return {
        "c": c,
        "name": c.name,
        "elementary": c.elementary,
        "storage": "static ",
        "upper": c.upper,
        "real": c.real,
        "word": "uint64_t" if c.real == "double" else "uint32_t",
        "f": FORMATS[c.real],
        "needs": needs,
        "needs_elementary": bool(functions),
        "shared": SHARED.format(c.real) if functions and c.elementary != c.name else "",
        "root2": math.sqrt(2.0),
        "ln2": math.log(2.0),
        "pi": math.pi,
    }
