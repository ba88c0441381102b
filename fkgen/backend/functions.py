"""The functions of a C program: prototypes, calls, and which elementary functions it needs."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from fkgen.backend.elementary import FORMATS
from fkgen.backend.ir import Operator, Phase, Scalar
from fkgen.backend.printer import Printer, StatementPrinter, shared_prefix, tests
from fkgen.symbolic.interface import Status

#: Operations per step up to which update and predict are compiled into step: a copy of the instance
#: between them costs more than the code.
INLINED = 2500

#: Name of the files that hold the functions for all filters of a program, by scalar.
SHARED = "fkgen_elementary_{}"

_COMMENTS = {
    "correct": "Condition on y[k]",
    "close_window": "At the end of a window",
    "propagate": "Move to k + 1",
}


def _arguments(c: Printer, name: str) -> dict[str, str]:
    """Declarations of what one of the three functions that run a filter is given."""
    program = c.program
    arguments = {"self": f"{c.name}_t *self"}
    if program.parameters:
        arguments["params"] = f"const {c.name}_params_t *params"
    if program.inputs:
        arguments["u"] = f"const {c.real} u[{len(program.inputs)}]"
    if name != "predict":
        arguments["y"] = f"const {c.real} y[{len(program.outputs)}]"
        arguments["valid"] = valid_argument(c)
    return arguments


def signature(c: Printer, name: str) -> str:
    """Prototype of one of the three functions that run a filter."""
    return f"{c.name}_status_t {c.name}_{name}({', '.join(_arguments(c, name).values())})"


def valid_argument(c: Printer) -> str:
    """The bits that say which rows of y were measured."""
    return "uint32_t valid" if c.words == 1 else f"const uint32_t valid[{c.words}]"


def _given(c: Printer, verb: str) -> dict[str, str]:
    """Declarations of what a phase is given besides the instance that it reads and the next."""
    phase, given = c.program.verbs[verb], {}
    if phase.reads_parameters:
        given["params"] = f"const {c.name}_params_t *params"
    if phase.reads_input:
        given["u"] = f"const {c.real} *u"
    if verb == "correct":
        given |= {"y": f"const {c.real} *y", "present": c.present}
    return given


def phases_of(c: Printer, phases: Iterable[Phase]) -> list[dict[str, Any]]:
    """The phases as static functions; what few samples need is never inlined."""
    return [
        {
            "verb": verb,
            "comment": _COMMENTS[verb],
            "arguments": ", ".join(
                [f"const {c.name}_t *self", *_given(c, verb).values(), f"{c.name}_t *next"]
            ),
            "program": phase,
            "inlined": c.program.flops <= INLINED and verb != "close_window",
        }
        for verb, phase in zip(c.program.verbs, phases, strict=True)
    ]


def functions_of(c: Printer) -> list[dict[str, Any]]:
    """Update, predict and step: what each calls, maybe under a condition, and what it returns."""

    def call(verb: str, source: str = "&next", when: str = "") -> dict[str, str]:
        given = ", ".join([source, *_given(c, verb), "&next"])
        return {"text": f"{c.name}_{verb}({given})", "when": when}

    correct, closing = [call("correct", "self")], c.program.closing
    if closing is not None:
        ends = f"!(next.{closing.unless} > {c.literal(0.0)})"
        correct.append(call("close_window", when=ends))
    called = {
        "update": correct,
        "predict": [call("propagate", "self")],
        "step": [*correct, call("propagate")],
    }
    outcome = f"({c.any_row}) ? {c.outcome} : {c.status(Status.SKIPPED)}"
    return [
        {
            "name": name,
            "calls": calls,
            "reads_y": name != "predict",
            "null": tests(
                [f"{p} == NULL" for p in _arguments(c, name) if p != "valid" or c.words > 1], "||"
            ),
            "result": c.status(Status.OK) if name == "predict" else outcome,
        }
        for name, calls in called.items()
    ]


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
