"""Compiled C against what it was made from: CasADi's interpreter, and its statements in NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from fkgen.backend.execute import Machine
from fkgen.backend.ir import FUNCTIONS, CProgram
from fkgen.backend.lower import generate
from fkgen.backend.source import Source
from fkgen.oracle.claims.claim import Record
from fkgen.oracle.plants.equations import is_nonlinear
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Code, Number, Operation, Spec
from fkgen.problem.text.expression import Expression
from fkgen.proof.records import GENTLER, PLAIN, Gentle, samples_with_values
from fkgen.proof.validate import digits, distance, natural_deviation, validate
from fkgen.runtime.compiler import compile_source
from fkgen.runtime.results import Run
from fkgen.symbolic.interface import Port, triangle
from fkgen.symbolic.interpreter import Interpreter
from fkgen.symbolic.validated import Claim, Validated

Array = NDArray[np.floating]

SAMPLES = 50

#: Of the records.
SEED = 20260101

#: Windows of compression filters up to this length come to their end within the record.
WAITED = 500

#: Functions that IEEE 754 does not fix to the last bit: fkgen's own differ from those CasADi calls.
_INEXACT = frozenset(FUNCTIONS - {"sqrt"})

#: Own exp and log are good to about one unit in the last place.
_LOGARITHM = 1e-14

#: Weights are exponentials of sums of some hundred: an error of 1e-15 there is 1e-13 here.
_WEIGHTS = 1e-12

#: The same sums, rounded less often: three digits closer than two ways to the same numbers are.
_FUSED = 1e-3

#: Share of the entries of y that are missing.
MISSING = 0.2


def trial(spec: Spec, samples: int = SAMPLES) -> Record:
    """A record of the model itself with missing rows; parameters shaken by a percent each time.

    Of a plant by equations the first that has values at all samples, or else at most of them.
    """
    tried = (
        _drawn(spec, given, samples) for given in (GENTLER if is_nonlinear(spec) else (PLAIN,))
    )
    record, lasting = next(tried)
    for other, count in tried:
        if lasting == len(record.y):
            break
        if count > lasting:
            record, lasting = other, count
    return record


def _drawn(spec: Spec, given: Gentle, samples: int) -> tuple[Record, int]:
    """A record, and at how many samples the plant that was drawn has values."""
    rng = np.random.default_rng(SEED)
    soft = spec.faults.soft
    T = samples + (soft.window if soft is not None and soft.window <= WAITED else 0)
    u = given.inputs(rng.normal(size=(T, spec.model.nu)))
    for i, signal in enumerate(spec.model.inputs):
        u[:, i] = u[:, i] if signal.range is None else np.clip(u[:, i], *signal.range)
    parameters = {
        item.name: np.clip(item.default * rng.uniform(0.99, 1.01, T), item.low, item.high)
        for item in spec.stated_parameters
    }
    steady = {name: np.full(T, spec.defaults[name]) for name in parameters}
    y, told = draw_record(spec, steady, u, rng, scale=given.noise)
    lasting = samples_with_values(y)
    y[rng.random(y.shape) < MISSING] = np.nan
    y[T // 2] = np.nan
    P0 = spec.model.P0.values(spec.defaults)
    return Record(y=y, u=u, parameters={**told, **parameters}, P0=P0), lasting


def with_machine(source: Source, record: Record) -> tuple[Claim, ...]:
    """Every port of the compiled code against the same statements in NumPy, bit for bit."""
    program = source.program
    run, found = _compiled(source, record), _machine(program, record)
    error = max(_difference(run[port.name], found[port.name]) for port in program.ports)
    claim = Claim(
        claim=f"the compiled {program.scalar} code gives the bits of its statements in NumPy",
        source=f"{len(record.y)} samples with missing rows; all ports, exp and log included",
        error=error,
        tolerance=0.0,
    )
    return (claim,)


def _compiled(source: Source, record: Record) -> Run:
    u = record.u if record.u.shape[1] else None
    return compile_source(source).run(record.y, u, record.parameters)


def _machine(program: CProgram, record: Record) -> dict[str, Array]:
    machine = Machine(program)
    machine.start(record.first)
    rows: dict[str, list[Array]] = {port.name: [] for port in program.ports}
    for k, y in enumerate(record.y):
        now = {name: float(value[k]) for name, value in record.parameters.items()}
        machine.step(tuple(record.u[k]), tuple(y), now)
        stored = {name: np.array(values, machine.real) for name, values in machine.ports.items()}
        shown = np.where(machine.outside(y), np.nan, y)
        for port in program.ports:
            rows[port.name].append(port.shown(stored, shown))
    return {name: np.array(values) for name, values in rows.items()}


def _difference(found: Array, expected: Array) -> float:
    """0 if all bits are the same (any NaN is one), else the relative distance, never 0."""
    if found.dtype == np.bool_:
        return 0.0 if np.array_equal(found, expected > 0) else float("inf")
    expected = expected.astype(found.dtype)
    word = np.uint32 if found.dtype == np.float32 else np.uint64
    same = np.ascontiguousarray(found).view(word) == np.ascontiguousarray(expected).view(word)
    if found.shape == expected.shape and np.all(same | (np.isnan(found) & np.isnan(expected))):
        return 0.0
    off = distance(found.astype(float), expected.astype(float))
    return max(off, float(np.finfo(float).tiny))


def with_interpreter(design: Validated) -> tuple[Claim, ...]:
    """The compiled double code against CasADi: bit for bit, but for exp, log, fma and the like."""
    if design.spec.code.scalar != "double":
        form, fma = design.recursion.form or "short", design.spec.code.fma
        code = Code(scalar="double", update=form, fma=fma)
        design = validate(replace(design.spec, code=code))
    spec, record, source = design.spec, trial(design.spec), generate(design)
    run = _compiled(source, record)
    interpreter = Interpreter(design.recursion)
    interpreter.reset(record.first)
    found = interpreter.run(record.y, record.u, record.parameters)
    ports = source.program.ports
    tolerances, reason = _tolerances(spec, ports)
    exact = [port for port in ports if tolerances[port.name] == 0.0]
    rounded = [port for port in ports if tolerances[port.name] > 0.0]
    origin = f"{len(record.y)} samples with missing rows"
    claims = []
    if exact:
        what = f"the compiled double code gives the bits of CasADi's interpreter: {_names(exact)}"
        error = max(_difference(run[p.name], found[p.name]) for p in exact)
        claims.append(Claim(claim=what, source=origin, error=error, tolerance=0.0))
    if rounded:
        what = f"the compiled double code agrees with CasADi's interpreter: {_names(rounded)}"
        error = max(_distance(spec, run, found, p) for p in rounded)
        allowed = max(tolerances[port.name] for port in rounded)
        origin = f"{origin}; {reason}"
        claims.append(Claim(claim=what, source=origin, error=error, tolerance=allowed))
    return tuple(claims)


def _distance(spec: Spec, run: Run, found: Mapping[str, Array], port: Port) -> float:
    expected = {name: np.asarray(values, dtype=float) for name, values in found.items()}
    if port.name.endswith("removed_factors"):  # of rounding where nothing is removed
        given, wanted = (
            _squared(np.asarray(each, dtype=float), spec.model.ne)
            for each in (run[port.name], expected[port.name])
        )
        return distance(given, wanted, symmetric=True)
    return distance(
        np.asarray(run[port.name], dtype=float),
        expected[port.name],
        symmetric=port.symmetric,
        deviation=natural_deviation(port.name, expected, spec.model.attitudes),
    )


def _squared(packed: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """U D U' of factors that are packed by columns, D in place of the diagonal of U."""
    unit, scale = np.zeros((*packed.shape[:-1], n, n)), np.zeros((*packed.shape[:-1], n))
    for at, (j, i) in enumerate(triangle(n)):
        unit[..., i, j] = packed[..., at] if i < j else 1.0
        if i == j:
            scale[..., j] = packed[..., at]
    return (unit * scale[..., np.newaxis, :]) @ np.swapaxes(unit, -1, -2)


def _names(ports: list[Port]) -> str:
    shown = [port.name for port in ports]
    if len(shown) > 4:
        return f"{', '.join(shown[:3])} and {len(shown) - 3} more"
    return ", ".join(shown)


def _tolerances(spec: Spec, ports: Sequence[Port]) -> tuple[dict[str, float], str]:
    """How far each port may be from CasADi, and why."""
    names, models = [port.name for port in ports], spec.filter.traits.models
    if _goes_through_functions(spec):
        reason = "entries of the model go through fkgen's own functions, good to one ulp"
        return dict.fromkeys(names, digits(spec)), reason
    if spec.code.fma:
        reason = "CasADi rounds products before it adds them"
        return dict.fromkeys(names, _FUSED * digits(spec)), reason
    if models == "one":
        logarithms = {"log_likelihood", "test_statistic"}
        reason = "fkgen's own log is good to one unit in the last place"
        return {name: _LOGARITHM if name in logarithms else 0.0 for name in names}, reason
    tolerances = dict.fromkeys(names, _WEIGHTS)  # mixing makes everything depend on weights
    if models == "bank":
        before = {name for name in names if name.startswith("mode_") and name != "mode_probability"}
        tolerances |= dict.fromkeys(before, 0.0)
    reason = "weights are exponentials of sums, which enlarge the last bit of exp and log"
    return tolerances, reason


def _goes_through_functions(spec: Spec) -> bool:
    """Whether entries of the model need functions that are not the same everywhere."""
    every = chain(spec.expressions, spec.start_expressions)
    return bool(spec.equations) or any(map(_is_inexact, every))


def _is_inexact(expression: Expression) -> bool:
    if not isinstance(expression, Operation):
        return False
    if expression.operator == "**" and not _is_product(expression.arguments[1]):
        return True
    return expression.operator in _INEXACT or any(map(_is_inexact, expression.arguments))


def _is_product(exponent: Expression) -> bool:
    """Whether a power is computed by multiplications and square roots, which IEEE 754 does fix."""
    return isinstance(exponent, Number) and (2.0 * exponent.value).is_integer()
