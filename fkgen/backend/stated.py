"""What the code says of the spec: model, faults, parameters; and the numbers it calls by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fkgen.backend.ir import (
    Constant,
    Listing,
    Literal,
    Phase,
    Scalar,
    Stated,
    Statements,
    operands,
    walk,
)
from fkgen.estimators.gaussian.decorrelation import LOG_TWO_PI
from fkgen.estimators.models.weights import LOG_ZERO, TINY
from fkgen.problem.spec import Spec
from fkgen.problem.text.expression import ZERO, Expression, Name, Number, names, to_text
from fkgen.problem.text.matrix import Matrix

#: Units of the entries of each matrix.
_UNITS = {"A": "x/x", "B": "x/u", "C": "y/x", "D": "y/u", "Q": "xx", "R": "yy"}
_UNITS |= {"x0": "x", "P0": "xx", "c": "x"}


def stated(spec: Spec, phases: Sequence[Phase]) -> Stated:
    """What the header says about a spec; ``phases`` hold the constants that it folded."""
    return Stated(
        parts=(_model(spec), *_modes(spec), *_faults(spec)),
        ranges=tuple((item.name, _range(spec, item.name)) for item in spec.parameters),
        folded=_folded(spec, phases),
    )


def _model(spec: Spec) -> Statements:
    inputs = spec.model.nu > 0
    offset = " + c" if spec.faults.jump is not None else ""
    move = f"x[k+1] = A x[k]{' + B u[k]' if inputs else ''}{offset} + w[k], w ~ (0, Q)"
    see = f"y[k] = C x[k]{' + D u[k]' if inputs else ''} + v[k], v ~ (0, R)"
    letters = ("A", "B", "C", "D", "Q", "R") if inputs else ("A", "C", "Q", "R")
    return Statements(
        f"Model: {move}; {see}; x[0] ~ (x0, P0)",
        tuple(_listing(letter, getattr(spec.model, letter)) for letter in (*letters, "x0", "P0")),
    )


def _modes(spec: Spec) -> Iterator[Statements]:
    """What each mode has of its own."""
    if spec.faults.jump is None:
        return
    for index, mode in enumerate(spec.faults.jump.modes):
        own = tuple(
            _listing(letter, getattr(mode, letter))
            for letter in ("A", "B", "C", "D", "Q", "R")
            if getattr(mode, letter) != getattr(spec.model, letter)
        )
        if any(entry != ZERO for (entry,) in mode.c.rows):
            own = (*own, _listing("c", mode.c))
        yield Statements(f"Mode {index}: {'what differs' if own else 'the model itself'}", own)


def _listing(name: str, matrix: Matrix) -> Listing:
    rows = tuple(tuple(map(_text, row)) for row in matrix.rows)
    unit = _UNITS.get(name, "")
    entries = {(i, j): entry for i, row in enumerate(matrix.rows) for j, entry in enumerate(row)}
    if name in {"x0", "c"}:
        return Listing(name, (tuple(row[0] for row in rows),), "vector", unit)
    if len(entries) > 1 and all(entry == ZERO for entry in entries.values()):
        return Listing(name, (tuple(map(str, matrix.shape)),), "zeros", unit)
    diagonal = all(entry == ZERO for (i, j), entry in entries.items() if i != j)
    if name in {"Q", "R", "P0"} and diagonal and len(rows) > 1:
        return Listing(name, (tuple(rows[i][i] for i in range(len(rows))),), "diagonal", unit)
    return Listing(name, rows, "matrix", unit)


def _text(entry: Expression) -> str:
    return repr(entry.value) if isinstance(entry, Number) else to_text(entry)


def _numbers(name: str, rows: tuple[tuple[float, ...], ...]) -> Listing:
    return Listing(name, tuple(tuple(map(repr, row)) for row in rows))


def _law(name: str, values: tuple[float, ...]) -> Listing:
    return Listing(name, (tuple(map(repr, values)),), "vector")


def _faults(spec: Spec) -> Iterator[Statements]:
    """The law of the faults in words, with its numbers."""
    faults = spec.faults
    if faults.actuator is not None:
        yield _actuator(spec)
    if faults.sensor is not None:
        yield _sensor(spec)
    if faults.jump is not None:
        yield _jump(spec)
    if faults.soft is not None:
        soft = faults.soft
        rows = [signal.name for signal in spec.model.outputs]
        host = ", ".join(rows[i] for i in soft.host) or "no row"
        groups = " and ".join(", ".join(rows[i] for i in group) for group in soft.groups)
        yield Statements(
            f"Faults: the host filter uses {host} at once; {groups} may drift and wait to the end"
            f" of a window of {soft.window} samples for a test with a rate {soft.false_alarm!r}"
            " of false alarms"
        )


def _actuator(spec: Spec) -> Statements:
    actuator, many = spec.faults.actuator, spec.model.nu > 1
    listings: tuple[Listing, ...] = ()
    if actuator is None or not actuator.success_rate:
        rate = "at a rate that is not known"
    else:
        rate = f"Pr(gamma = 1) = {', '.join(map(_text, actuator.success_rate))}"
        if actuator.covariance is not None:
            listings = (_listing("covariance", actuator.covariance),)
    together = {
        "common": "one gamma for all inputs",
        "independent": "inputs fail independently of each other",
        "covariance": "the covariance of gamma couples the inputs",
    }
    how = f"; {together[actuator.dependence]}" if actuator is not None and many else ""
    tried: tuple[tuple[float, ...], ...] = spec.filter.option("hypotheses", ())
    own = (*listings, *((_numbers("hypotheses", tried),) if tried else ()))
    return Statements(
        f"Faults: gamma u[k] arrives in place of u[k], gamma is 0 or 1 and independent from sample"
        f" to sample, {rate}{how}",
        own,
    )


def _sensor(spec: Spec) -> Statements:
    sensor = spec.faults.sensor
    if sensor is None:
        return Statements("")
    rows = ", ".join(spec.model.outputs[i].name for i in sensor.rows)
    signal = "(C x[k] + D u[k])" if spec.model.nu else "C x[k]"
    text = (
        f"Faults of {rows}: gamma {signal} + v[k] is measured, gamma is 0 or 1; the"
        f" variance of v is delta R, delta is 1 or {sensor.noise_factor!r}"
    )
    if sensor.moments is not None:
        law = sensor.moments
        text += (
            f"; Pr(gamma = 1) = {law.gamma_rate!r}, given that it was 1 before"
            f" {law.gamma_persistence!r}; Pr(delta = 1) = {law.delta_nominal_rate!r}"
        )
    if not sensor.kernel:
        return Statements(text)
    factor = f"{sensor.noise_factor:g}"
    order = f"(1, 1) (1, {factor}) (0, 1) (0, {factor})"
    return Statements(
        f"{text}; modes (gamma, delta): {order}, kernel[i][j] = Pr(j at k+1 | i at k)",
        (_numbers("kernel", sensor.kernel), _law("initial", sensor.initial)),
    )


def _jump(spec: Spec) -> Statements:
    jump = spec.faults.jump
    if jump is None:
        return Statements("")
    text = "Faults: the plant jumps between modes, transition[i][j] = Pr(mode j at k+1 | mode i)"
    channel: tuple[Listing, ...] = ()
    if jump.arrival_rate is not None:
        text += f"; a sample holds a signal with probability {jump.arrival_rate!r}, else noise"
    if jump.arrival_chain:
        text += "; samples are (lost, arrived) by arrival_chain"
        channel = (_numbers("arrival_chain", jump.arrival_chain),)
    if jump.arrival != "always":
        text += f"; whether it does is {jump.arrival}"
    law = (_numbers("transition", jump.transition), _law("initial", jump.initial))
    return Statements(text, (*law, *channel))


def _range(spec: Spec, name: str) -> str:
    """What is known about a parameter: its range, its unit, and where it stands."""
    sensor, actuator = spec.faults.sensor, spec.faults.actuator
    if sensor is not None and name not in {item.name for item in spec.stated_parameters}:
        return {
            "gamma": "1: the rows that can fail hold a signal, 0: they hold none",
            "delta": f"1 or {sensor.noise_factor!r}: factor of the variance of their noise",
        }[name]
    rates = () if actuator is None else actuator.success_rate
    if Name(name) in rates:
        return "a rate, in [0, 1]"
    found = [f"keeps {_text(rate)} in [0, 1]" for rate in rates if name in names(rate)]
    used = []
    for letter in ("A", "B", "C", "D", "Q", "R"):
        matrices = [getattr(plant, letter) for plant in spec.plants]
        if any(name in matrix.names for matrix in matrices):
            used.append(letter)
        if letter in {"Q", "R"}:
            variances = {matrix.rows[i][i] for matrix in matrices for i in range(len(matrix.rows))}
            if used == [letter] and Name(name) in variances:
                found.append("a variance, >= 0")
            elif any(name in names(variance) for variance in variances):
                found.append(f"keeps the variances of {letter} >= 0")
    unit = next(_units_of(spec, name), "")
    return "; ".join([*filter(None, [unit, *found]), *([f"in {', '.join(used)}"] if used else [])])


def _units_of(spec: Spec, name: str) -> Iterator[str]:
    """The unit of a parameter that is an entry of the model by itself, such as ``m per m/s``."""
    signals = {"x": spec.model.states, "u": spec.model.inputs, "y": spec.model.outputs}
    for letter in ("A", "B", "C", "D", "Q", "R"):
        above, below = _UNITS[letter][0], _UNITS[letter][-1]
        for plant in spec.plants:
            for i, row in enumerate(getattr(plant, letter).rows):
                for j, entry in enumerate(row):
                    one, two = signals[above][i].unit, signals[below][j].unit
                    if entry == Name(name) and one and two:
                        product = f"{one} squared" if one == two else f"{one} times {two}"
                        yield product if letter in {"Q", "R"} else f"{one} per {two}"


def _folded(spec: Spec, phases: Sequence[Phase]) -> tuple[tuple[float, str], ...]:
    """Coefficients of A P A', B G B' and C P C' in the code that are no numbers of the spec."""
    known: dict[float, str] = {}
    for index, plant in enumerate(spec.plants):
        of = f" of mode {index}" if len(spec.plants) > 1 else ""
        for letter in "ABC":
            for value, text in _coefficients(letter, getattr(plant, letter)):
                known.setdefault(abs(value), f"{'-' if value < 0 else ''}{text}{of}")
    read = {abs(value) for value in _read(phases)}
    stated = {0.0, 0.5, 1.0, 2.0} | {abs(value) for value in _numbers_in(spec.to_dict())}
    return tuple((value, known[value]) for value in sorted(read & known.keys() - stated))


def _coefficients(letter: str, matrix: Matrix) -> Iterator[tuple[float, str]]:
    """What each P[k][l] is multiplied by in each entry of M P M', for a symmetric P."""
    values = {
        (i, j): entry.value
        for i, row in enumerate(matrix.rows)
        for j, entry in enumerate(row)
        if isinstance(entry, Number) and entry != ZERO
    }
    for (i, k), a in values.items():
        for (j, m), b in values.items():
            if j < i or (j == i and m < k):
                continue
            first, second = f"{letter}[{i}][{k}]", f"{letter}[{j}][{m}]"
            text = f"{first}^2" if first == second else f"{first} {second}"
            if i == j and k != m:
                yield a * b + a * b, f"2 {text}"
            elif k != m and (i, m) in values and (j, k) in values:
                other = f"{letter}[{i}][{m}] {letter}[{j}][{k}]"
                yield a * b + values[i, m] * values[j, k], f"({text} + {other})"
            else:
                yield a * b, text


def _numbers_in(table: object) -> Iterator[float]:
    """Every number of nested tables and lists."""
    if isinstance(table, dict):
        table = [*table.values()]
    if isinstance(table, list):
        for entry in table:
            yield from _numbers_in(entry)
    elif isinstance(table, int | float):
        yield float(table)


def constants_of(scalar: Scalar, phases: Sequence[Phase]) -> tuple[Constant, ...]:
    """The constants that the phases read."""
    read = _read(phases)
    zero = LOG_ZERO[scalar]
    known = (
        Constant("LOG_2_PI", LOG_TWO_PI, "log(2 pi), of a Gaussian density"),
        Constant("TINY", TINY[scalar], "keeps 0/0 out of probabilities that are 0"),
        Constant("LOG_ZERO", zero, "stands for the logarithm of 0"),
        Constant("LEAST_LOG_DENSITY", 0.5 * zero, "below it no density can be told from 0"),
    )
    return tuple(constant for constant in known if constant.value in read)


def _read(phases: Sequence[Phase]) -> set[float]:
    """Every constant that the phases read."""
    return {
        operand.value
        for phase in phases
        for node in walk(phase.body)
        for operand in operands(node)
        if isinstance(operand, Literal)
    }
