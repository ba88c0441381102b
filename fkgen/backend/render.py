"""IR + templates -> `Source`: templates shape the files, the printer makes the statements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from fkgen.backend.elementary import FORMATS
from fkgen.backend.execute import MARKED, self_test_vectors
from fkgen.backend.expressions import joined
from fkgen.backend.ir import (
    Call,
    CopyArray,
    CProgram,
    Element,
    Operator,
    Phase,
    Scalar,
    Signal,
    Space,
    Triangle,
    every,
    read,
)
from fkgen.backend.lanes.text import WHOLE, lanes_text
from fkgen.backend.lines import LICENSE, filled, filled_lines, unit_text, units_of
from fkgen.backend.printer import SHARED_PREFIX, Printer, StatementPrinter, combined
from fkgen.backend.routines import Outline, outline
from fkgen.backend.size.stack import BYTES, instance_of, stack_of
from fkgen.backend.source import SHARED, Source, complete
from fkgen.symbolic.interface import CORRELATED, OUTSIDE, UPDATED, Port, Role, Status
from fkgen.version import API_VERSION, __version__

#: Operations per step up to which update and predict are compiled into step: a copy of the instance
#: between them costs more than the code.
INLINED = 2500

#: Targets on which fma() is one instruction, by scalar.
_FUSING = {
    "double": "x86-64 with FMA (-mfma, -march=x86-64-v3), AArch64, Cortex-M7 with a unit for double"
    " (-mfpu=fpv5-d16), RISC-V with D, POWER, s390x",
    "float": "x86-64 with FMA (-mfma, -march=x86-64-v3), AArch64, Cortex-M4F, M7 and M33 with their"
    " floating-point units, RISC-V with F, POWER, s390x",
}

#: Rows of a triangle up to which its loops are written out by the compiler: mispredicted branches
#: cost more than the copies.
UNROLLED = 12

#: Above it a number is no probability: one that is rounded exceeds 1 by far less.
LARGEST_PROBABILITY = 1.00001

_COMMENTS = {
    "correct": "Condition on y[k]",
    "close_window": "At the end of a window",
    "propagate": "Move to k + 1",
    "begin": "Compute what follows from a prior",
    "prior": "Compute the prior of the spec",
}


def render(program: CProgram, claims: tuple[str, ...] = ()) -> Source:
    """Print a program. ``claims`` are what was proved about it, for the manifest."""
    context = context_of(program)
    name = program.name
    files = {
        f"{name}.h": filled("header.h.j2", context),
        f"{name}.c": filled("source.c.j2", context),
        f"{name}_selftest.c": filled("selftest.c.j2", context),
        f"{name}_selftest_main.c": filled("selftest_main.c.j2", context),
    }
    if context["shared"]:
        shared = _shared_context(program.scalar) | {"version": __version__}
        files |= {f"{shared['file']}.{end}": filled(f"shared.{end}.j2", shared) for end in "hc"}
    files = complete(files, _facts(program, claims) | {"bytes": context["bytes"]})
    record = filled("record.c.j2", context)
    alone = elementary_context(Printer(program), program.functions - WHOLE)
    lanes = lanes_text(program, context, alone)
    return Source(program=program, files=files, record=record, lanes=lanes, claims=claims)


def with_harness(source: Source) -> Source:
    """The same files, and a program for libFuzzer that calls the filter in any order."""
    text = filled("fuzz.c.j2", context_of(source.program))
    return replace(source, files={**source.files, f"{source.program.name}_fuzz.c": text})


def context_of(program: CProgram) -> dict[str, object]:
    """What the templates of one filter read."""
    outlined = joined(outline(program), (c := Printer(program)).fits)
    c.take(outlined.routines)
    units = units_of(program)
    starts = _starts(program)
    modes = (port.shape[0] for port in program.ports if port.name == "mode_probability")
    return elementary_context(c, program.functions) | {
        "program": program,
        "version": __version__,
        "api": API_VERSION,
        "title": _title(program),
        "fusing": _FUSING[program.scalar],
        "modes": next(modes, 0),
        "cost": cost(program),
        "padded": c.padded,
        "flags": [port for port in program.ports if port.flags],
        "scalars": sum(port.size for port in program.ports),
        "bytes": _bytes(program, outlined, starts),
        "members": sum(port.size for port in program.ports) + 1 + len(program.repeats or ()),
        "hash": f"UINT32_C(0x{program.digest[:8]})",
        "sound": _sound(c),
        "statuses": program.statuses,
        "positive": [c.status(status) for status in program.statuses if status.value >= 0],
        "Status": Status,
        "shape": _shape_text,
        "unit": lambda port: f", {text}" if (text := unit_text(units, port.unit)) else "",
        "ranges": dict(program.stated.ranges),
        "bounds": _bounds(c),
        "indices": _indices(program),
        "listed": filled_lines,
        "numbers": lambda values: [c.literal(0.0 if math.isnan(v) else v) for v in values],
        "starts": starts,
        "tables": {owner: values for values, owner in starts.values()}
        | ({} if program.origin else dict(zip(("x", "P"), program.prior, strict=True))),
        "period": dict(zip(("x", "P"), map(len, program.prior), strict=True)),
        "full": lambda port: math.prod(port.shape),
        "initial": dict(program.initial),
        "phases": _phases(c, outlined.phases),
        "routines": outlined.routines,
        "copies": any(copy for body in outlined.bodies for copy in every(CopyArray, body)),
        "products": outlined.of_matrices,
        "for_speed": "0" if program.optimise == "size" else "!defined(__OPTIMIZE_SIZE__)",
        "for_size": "1" if program.optimise == "size" else "defined(__OPTIMIZE_SIZE__)",
        "unrolled": UNROLLED if _largest_triangle(outlined) <= UNROLLED else 1,
        "inlined": program.flops <= INLINED,
        "functions": _functions(c),
        "order": _order(c, outlined),
        **_selftest(c),
    }


def _indices(program: CProgram) -> list[tuple[str, str, list[tuple[str, int]]]]:
    """Names of numbers, in capitals, and where they are; of an attitude that of the first."""
    titles: list[tuple[str, str, tuple[Signal, ...]]] = [
        ("Indices of states", "STATE", program.states),
        ("Indices of inputs", "INPUT", program.inputs),
        ("Indices of measurements", "OUTPUT", program.outputs),
    ]
    if program.attitudes:
        covariances = "Rows of covariances of the state; of an attitude the first of three"
        titles[0] = ("Indices of states; of an attitude the first of four", *titles[0][1:])
        titles.insert(1, (covariances, "ERROR", program.errors))
    found = []
    for title, kind, signals in titles:
        stems = [signal.name.partition("[")[0].upper() for signal in signals]
        first = dict(zip(reversed(stems), reversed(range(len(stems))), strict=True))
        found.append((title, kind, sorted(first.items(), key=lambda each: each[1])))
    return [each for each in found if each[2]]


def _bounds(c: Printer) -> dict[str, list[list[str]]]:
    """Least and largest numbers of x, u and y as C; nothing where none has a range."""
    signals = {"x": c.program.states, "u": c.program.inputs, "y": c.program.outputs}
    return {
        letter: [
            [f"-{c.limit}" if each.range is None else c.literal(each.range[0]) for each in found],
            [c.limit if each.range is None else c.literal(each.range[1]) for each in found],
        ]
        if any(each.range is not None for each in found)
        else []
        for letter, found in signals.items()
    }


def _sound(c: Printer) -> list[tuple[str, int, tuple[str, str], int]]:
    """What a check asks of members: size, least and largest number, rows where it has variances."""
    n = len(c.program.errors)
    own = n * (n + 1) // 2  # numbers of the factors of one covariance of x alone
    any_number, one = (f"-{c.limit}", c.limit), (c.literal(0.0), c.literal(LARGEST_PROBABILITY))
    found = []
    for port in c.program.ports:
        probable = port.flags or port.name.endswith("probability")
        factors = port.name.endswith("_factors") and port.shape[-1] == own
        rows = port.shape[-1] if port.symmetric else n * factors
        member = f"{'' if port.shape else '&'}self->{port.member}"
        found.append((member, port.size, one if probable else any_number, rows))
    groups = len(c.program.repeats or ())
    found += [(f"self->{CORRELATED}", groups, one, 0)] if groups else []
    return [*found, (f"&self->{UPDATED}", 1, one, 0)]


def _largest_triangle(outlined: Outline) -> int:
    """Rows of the largest symmetric matrix that is packed or unpacked."""
    sizes = (node.size for node in outlined.of_matrices if isinstance(node, Triangle))
    return max(sizes, default=0)


def _selftest(c: Printer) -> dict[str, object]:
    """What the self-test gives the filter, and what it compares."""
    ports, form = c.program.ports, FORMATS[c.program.scalar]
    vectors, infinite = self_test_vectors(c.program), (2 * form.bias + 1) << form.mantissa
    final = dict(vectors.final)
    return {
        "vectors": vectors,
        "compared": [
            f"{{ {'' if port.shape else '&'}filter.{port.member}, {port.size} }}" for port in ports
        ],
        "masks": [_mask(c, row, k) for k, row in enumerate(vectors.y)],
        "flag_words": [(p.name, _words(c, final[p.name])) for p in ports if p.flags],
        "marked": MARKED,
        "infinite": infinite,
        "not_a_number": infinite | (1 << (form.mantissa - 1)),
    }


def _bytes(
    program: CProgram, outlined: Outline, starts: Mapping[str, tuple[tuple[float, ...], str]]
) -> dict[str, int]:
    """Sizes in bytes: instance, tables of constants, and bounds on the stack of a call."""
    size = BYTES[program.scalar]
    tables = {owner: len(values) for values, owner in starts.values()}
    prior = 0 if program.origin else sum(map(len, program.prior))
    numbers = [len(row) for each in outlined.routines for row in each.constants]
    stack = stack_of(program, outlined, inlined=program.flops <= INLINED)
    return {
        "instance": instance_of(program),
        "constants": size * (sum(tables.values()) + prior + sum(numbers)),
        "stack_O0": stack.plain,
        "stack_Os": stack.small,
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
        arguments["valid"] = c.valid
    return arguments


def _given(c: Printer, verb: str) -> dict[str, str]:
    """Declarations of what a phase is given besides the instance that it reads and the next."""
    phase, given = c.program.verbs[verb], {}
    if phase.reads_parameters:
        given["params"] = f"const {c.name}_params_t *params"
    if verb == "begin":
        told = {each.name for each in read(Element, phase.body) if each.space is Space.INPUT}
        return given | {name: f"const {c.real} *{name}" for name in ("x", "P") if name in told}
    if verb == "prior":
        return given
    if phase.reads_input:
        given["u"] = f"const {c.real} *u"
    if verb == "correct":
        given |= {"y": f"const {c.real} *y", "present": c.present}
        given |= {OUTSIDE: f"const {c.real} *{OUTSIDE}"} if c.program.screens else {}
    return given


def _phases(c: Printer, phases: Iterable[Phase]) -> list[dict[str, Any]]:
    """The phases as static functions; what few samples need is never inlined."""
    return [
        {
            "verb": verb,
            "comment": _COMMENTS[verb],
            "arguments": ", ".join(
                [
                    *([] if verb in {"begin", "prior"} else [f"const {c.name}_t *self"]),
                    *_given(c, verb).values(),
                    f"{c.name}_{'prior_' if verb == 'prior' else ''}t *next",
                ]
            ),
            "program": phase,
            "inlined": c.program.flops <= INLINED and verb in {"correct", "propagate"},
        }
        for verb, phase in zip(c.program.verbs, phases, strict=True)
    ]


def _functions(c: Printer) -> dict[str, dict[str, Any]]:
    """Update, predict and step: what each is called with, and what it returns."""
    seen = f"({c.any_row}) || ({c.any_rejected})" if c.program.screens else c.any_row
    outcome = f"({seen}) ? {c.outcome} : {c.status(Status.SKIPPED)}"
    functions = {}
    for name in ("update", "predict", "step"):
        arguments = _arguments(c, name)
        pointers = [each for each in arguments if each != "valid" or c.words > 1]
        functions[name] = {
            "signature": f"{c.name}_status_t {c.name}_{name}({', '.join(arguments.values())})",
            "reads_y": "y" in arguments,
            "null": combined([f"{pointer} == NULL" for pointer in pointers], "||"),
            "result": outcome if "y" in arguments else c.status(Status.OK),
        }
    return functions


def _order(c: Printer, outlined: Outline) -> dict[str, Any]:
    """What the order of calls needs: calls of the phases, and ports that are carried over."""
    calls = (call for body in outlined.bodies for call in every(Call, body))
    handed_on = any(
        e.space is Space.INPUT and e.name == "y" for each in calls for e in each.arguments
    )
    program, given = c.program, {verb: _given(c, verb) for verb in c.program.verbs}
    updated, closing = program.written(program.update), program.closing
    # Part of y may be handed on, so there has to be one, although nothing reads it.
    absent = {"y": "unread" if handed_on else "NULL", "present": "0u" if c.words == 1 else "none"}
    absent |= {OUTSIDE: "inside"} if program.screens else {}
    given["renew"] = given["correct"]
    given["first"] = given["again"] = given["correct"] | given["propagate"]
    given["pass"] = {name: text for name, text in given["correct"].items() if name not in absent}

    def call(verb: str, source: str, to: str = "&next", **other: str) -> str:
        arguments = [other.get(name, name) for name in given[verb]]
        return f"{c.name}_{verb}({', '.join(filter(None, [source, *arguments, to]))})"

    def declared(name: str) -> str:
        own = [f"{c.name}_t *self", *given[name].values()]  # a step changes its instance
        if name not in {"first", "again"}:
            own = [f"const {own[0]}", *own[1:], f"{c.name}_t *next"]
        return f"static {c.name}_status_t {c.name}_{name}({', '.join(own)})"

    own, start = program.written(closing), _starting(c, given.get("begin", {}))
    return start | {
        "call": call,
        "declared": declared,
        "absent": absent,
        "closing": closing and f"{{}}{closing.unless} > {c.literal(0.0)}",
        "predicted": program.written(program.predict),
        "kept": [port for port in updated if port.role is Role.OUTPUT and port not in own],
        "passed": [port for port in program.accumulated if not port.slots],
        "twins": [(port, twin, port not in updated) for port, twin in program.twins],
        "groups": [c.any_of(rows) for rows in program.repeats or ()],
    }


def _starting(c: Printer, given: Mapping[str, str]) -> dict[str, Any]:
    """What the functions need that start a filter; ``given`` is what computes with the prior."""
    program = c.program
    own, params = f"{c.name}_t *self", f"const {c.name}_params_t *params"
    started = [own, *([params] if "params" in given else [])]
    init = [own, *([params] if "params" in given or program.origin is not None else [])]
    sizes = zip(("x", "P"), map(len, program.prior), strict=True)
    prior = [f"const {c.real} {name}[{size}]" for name, size in sizes]
    pointers = [text.split("*")[-1].split("[")[0].split()[-1] for text in (*started, *prior)]
    head = f"{c.name}_status_t {c.name}_"
    return {
        "init": f"{head}init({', '.join(init)})",
        "start": f"{head}start({', '.join([*started, *prior])})",
        "absent_start": combined([f"{pointer} == NULL" for pointer in pointers], "||"),
        "start_reads_params": "params" in given,
        "init_reads_params": len(init) > 1,
        "own_prior": program.origin is not None,
        "begins": program.start is not None,
        "computed": program.written(program.start),
    }


def _shared_context(scalar: Scalar) -> dict[str, object]:
    """What the templates of the shared files read: every function, whatever a filter needs."""
    c = StatementPrinter(SHARED_PREFIX.format(scalar), scalar, 1)
    functions = frozenset(operator for operator in Operator if operator.is_function)
    return elementary_context(c, functions) | {"storage": "", "file": f"{SHARED}{scalar}"}


def elementary_context(c: StatementPrinter, functions: frozenset[Operator]) -> dict[str, object]:
    """Names, constants, and which functions there are; sqrt where hypot needs it."""
    needs = {op.value: op in functions for op in Operator if op.is_function}
    needs["wave"] = needs["sin"] or needs["cos"] or needs["tan"]
    needs["grown"] = needs["sinh"] or needs["cosh"] or needs["tanh"]
    needs["quotient"] = needs["tan"] or needs["grown"]
    needs["excess"] = needs["atan2"] or needs["quotient"]
    needs["arc"] = needs["asin"] or needs["acos"]
    needs["sqrt"] = needs["sqrt"] or needs["arc"] or needs["hypot"]
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
        "shared": f"{SHARED}{c.real}" if functions and c.elementary != c.name else "",
        "ln2": math.log(2.0),
        "pi": math.pi,
    }


def _title(program: CProgram) -> str:
    counts = {"state": len(program.states), "measurement": len(program.outputs)}
    sizes = [f"{count} {what}{'' if count == 1 else 's'}" for what, count in counts.items()]
    return f"{program.family} filter, {', '.join(sizes)}"


def cost(program: CProgram) -> str:
    """Operations of one step in words."""
    joint = f", {program.fused} of them fused multiply-adds" if program.fma else ""
    text = [f"{program.flops} floating-point operations{joint}"]
    text += [f"{n} {function}" for function, n in _calls(program).items()]
    closing = f"; at the end of a window {program.closing_flops} more" if program.closing else ""
    closing += "; more where rows come late" if program.has_rare else ""
    return " and ".join(text) + closing


def _calls(program: CProgram) -> dict[str, int]:
    calls = {op.value: n for op, n in program.operations.items() if op.is_function}
    return dict(sorted(calls.items()))


def _mask(c: Printer, row: tuple[float, ...], k: int) -> str:
    """Bits of the rows that are measured; row 0 of one sample is marked although it is not."""
    marked = [not math.isnan(value) or (k == MARKED and i == 0) for i, value in enumerate(row)]
    words = _words(c, marked)
    return words[0] if c.words == 1 else "{ " + ", ".join(words) + " }"


def _words(c: Printer, rows: Iterable[float]) -> list[str]:
    """Rows that are 1 as bits of words."""
    bits = sum(1 << i for i, value in enumerate(rows) if value > 0)
    return [f"{(bits >> (32 * w)) & 0xFFFFFFFF:#x}u" for w in range(c.words)]


def _shape_text(port: Port) -> str:
    *stacked, n = map(str, port.shape or (1,))
    parts = [*stacked[:-1], f"symmetric {n} x {n}"] if port.symmetric else [*stacked, n]
    return f" ({' x '.join(parts)})" if stacked else ""


def _starts(program: CProgram) -> dict[str, tuple[tuple[float, ...], str]]:
    """Start values of every array without repetitions, and the port whose table holds them."""
    result: dict[str, tuple[tuple[float, ...], str]] = {}
    owners: dict[tuple[str, ...], str] = {}
    initial, computed = dict(program.initial), program.written(program.start)
    for port in program.ports:
        if port.shape and not port.prior and port not in computed:
            values = _period(initial.get(port.name, (0.0,)))
            own = "zero" if values == (0.0,) else port.name
            owner = owners.setdefault(tuple(map(repr, values)), own)
            result[port.name] = (values, owner)
    return result


def _period(values: tuple[float, ...]) -> tuple[float, ...]:
    """The shortest piece of which ``values`` are repetitions, bit by bit."""
    words = tuple(map(repr, values))
    sizes = (d for d in range(1, len(words) + 1) if len(words) % d == 0)
    size = next(d for d in sizes if words == words[:d] * (len(words) // d))
    return values[:size]


def _facts(program: CProgram, claims: tuple[str, ...]) -> dict[str, object]:
    return {
        "name": program.name,
        "family": program.family,
        "scalar": program.scalar,
        "fkgen": __version__,
        "license": LICENSE,
        "api": API_VERSION,
        "spec": program.digest,
        "equations": program.source,
        "proved": list(claims),
        "flops": program.flops,
        **({"fused": program.fused} if program.fma else {}),
        **({"closing_flops": program.closing_flops} if program.closing else {}),
        "calls": _calls(program),
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
