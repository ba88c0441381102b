"""What the code says of the spec: model, faults, parameters; and the numbers it calls by name."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, combinations_with_replacement
from typing import Any

from fkgen.backend.ir import Constant, Literal, Phase, Scalar, Stated, read
from fkgen.backend.lines import WIDTH, unit_text, units_of, wrapped
from fkgen.estimators.gaussian.decorrelation import LOG_TWO_PI
from fkgen.estimators.models.weights import LOG_ZERO, TINY
from fkgen.faults import ActuatorFaults, JumpFaults, SensorFaults, SoftFaults
from fkgen.faults.chain import LETTERS, Mode
from fkgen.problem import Model, Parameter
from fkgen.problem.equations import ABSENT, Equations
from fkgen.problem.functions.writing import statements
from fkgen.problem.probability import FirstLaw
from fkgen.problem.spec import Spec
from fkgen.problem.text.discretise import OF_TIME
from fkgen.problem.text.expression import ZERO, Computed, Expression, Name, Number, names, to_text
from fkgen.problem.text.matrix import Matrix
from fkgen.symbolic.linalg import FOLDED

#: Units of the entries of each matrix.
_UNITS = {"A": "x/x", "B": "x/u", "C": "y/x", "D": "y/u", "Q": "xx", "R": "yy"}
_UNITS |= {"x0": "x", "P0": "xx", "c": "x", "d": "y", "S": "x/y"}
#: Widest matrix whose entries stand below each other.
_ALIGNED = 80

#: What equations mean by products with an attitude q.
_ROTATIONS = (
    "q * v: q turned by the rotation vector v, in body axes; rotate(q, v): v from body to world"
    " axes, rotate_back(q, v): from world to body axes"
)

#: A title, and matrices as lines of a comment.
_Part = tuple[str, Iterable[list[str]]]


def stated(spec: Spec, phases: Sequence[Phase]) -> Stated:
    """What the header says about a spec; ``phases`` hold the constants that it folded."""
    parts = [_model(spec), *_modes(spec), *_faults(spec)]
    return Stated(
        model=tuple(
            line for title, listings in parts for line in (f" * {title}.", *chain(*listings), " *")
        ),
        ranges=tuple((item.name, _range(spec, item)) for item in spec.parameters),
        folded=_folded(spec, phases),
        spec=json.dumps({"spec": spec.to_dict(), "written": [e.written for e in spec.equations]}),
    )


def _faults(spec: Spec) -> list[_Part]:
    faults = spec.faults
    parts = [_actuator(spec, faults.actuator)] if faults.actuator is not None else []
    parts += [_sensor(spec, faults.sensor)] if faults.sensor is not None else []
    parts += [_jump(spec, faults.jump)] if faults.jump is not None else []
    return parts + ([_soft(spec, faults.soft)] if faults.soft is not None else [])


def faults_said(spec: Spec) -> list[tuple[str, str]]:
    """What is said of the faults and of the modes: sentences, and the numbers below each."""
    parts = [*_faults(spec), *_modes(spec)]
    return [
        (f"{title}.", "\n".join(line[5:] for line in chain(*listings))) for title, listings in parts
    ]


def _equations(spec: Spec, equations: Equations) -> _Part:
    """The model by functions f and h."""
    model = spec.model
    time = "dx/dt = f" if equations.continuous else "x[k+1] = f"
    title = f"Model: {time}(x[k], u[k], w[k]), y[k] = h(x[k], u[k]) + v[k], v ~ (0, R)"
    lines = [each.line for each in statements(equations, model.states, model.outputs)]
    lines += [f"w: {noise.name} ~ (0, {to_text(noise.variance)})" for noise in equations.noises]
    lines += [_ROTATIONS] if equations.attitudes else []
    letters = ("Q", "R", "x0", "P0") if model.S.is_zero else ("Q", "R", "S", "x0", "P0")
    matrices = (_matrix(spec, x, getattr(model, x)) for x in letters)
    return title, [*map(_equation, lines), *matrices]


def _equation(line: str) -> list[str]:
    return wrapped(line, " *   ", " *       ")


def _own_equations(model: Model, mode: Mode) -> list[list[str]]:
    """The equations of a mode that are not the model's."""
    own, base = (
        [] if each is None else statements(each, model.states, model.outputs)
        for each in (mode.equations, model.equations)
    )
    known = [(each.name, each.trees, each.hidden) for each in base]
    changed = (each for each in own if (each.name, each.trees, each.hidden) not in known)
    return [_equation(each.line) for each in changed]


def _model(spec: Spec) -> _Part:
    if spec.model.equations is not None:
        return _equations(spec, spec.model.equations)
    inputs, absent = spec.model.nu > 0, "" if spec.model.nu else "BD"
    absent += "".join(each for each in "cd" if getattr(spec.model, each).is_zero)
    c, d = (
        f" + {each}" if any(not getattr(plant, each).is_zero for plant in spec.plants) else ""
        for each in "cd"
    )
    move = f"x[k+1] = A x[k]{' + B u[k]' if inputs else ''}{c} + w[k], w ~ (0, Q)"
    see = f"y[k] = C x[k]{' + D u[k]' if inputs else ''}{d} + v[k], v ~ (0, R)"
    letters = (*(letter for letter in LETTERS if letter not in absent), "x0", "P0")
    letters += () if spec.model.S.is_zero else ("S",)
    both = "" if spec.model.S.is_zero else "; Cov(w[k], v[k]) = S"
    source: Any = spec.model
    if spec.model.source is not None and any(
        isinstance(entry, Computed) for row in spec.model.A.rows for entry in row
    ):
        source, T = spec.model.source, spec.model.source.sample_time
        move = f"dx/dt = A x{' + B u' if inputs else ''}{c} + w, w white of density Q, for {T} s"
    own = [(x, getattr(source if x in OF_TIME else spec.model, x)) for x in letters]
    listings = [_matrix(spec, letter, matrix) for letter, matrix in own]
    return f"Model: {move}; {see}; x[0] ~ (x0, P0){both}", listings


def _modes(spec: Spec) -> Iterator[_Part]:
    """What each mode has of its own."""
    for index, mode in enumerate(spec.faults.jump.modes if spec.faults.jump is not None else ()):
        own = {letter: getattr(mode, letter) for letter in LETTERS}
        own = {letter: matrix for letter, matrix in own.items() if matrix != ABSENT}
        own = {name: matrix for name, matrix in own.items() if matrix != getattr(spec.model, name)}
        listings = _own_equations(spec.model, mode)
        listings += [_matrix(spec, name, matrix) for name, matrix in own.items()]
        yield f"Mode {index}: {'what differs' if listings else 'the model itself'}", listings


def _matrix(spec: Spec, name: str, matrix: Matrix) -> list[str]:
    """A matrix as the spec states it."""
    rows = [tuple(map(_text, row)) for row in matrix.rows]
    unit = unit_text(units_of(spec.model), _UNITS.get(name, ""))
    nonzero = [i != j for i, row in enumerate(matrix.rows) for j, e in enumerate(row) if e != ZERO]
    if name in {"x0", "c", "d"}:
        return _vector(name, (row[0] for row in rows), unit)
    if not nonzero and matrix.shape != (1, 1):
        return _vector(name, map(str, matrix.shape), unit, "zeros(", ")")
    if name in {"Q", "R", "P0"} and not any(nonzero) and len(rows) > 1:
        return _vector(name, (row[i] for i, row in enumerate(rows)), unit, "diag(", ")")
    return _rows(name, rows, unit)


def _text(entry: Expression) -> str:
    return repr(entry.value) if isinstance(entry, Number) else to_text(entry)


def _numbers(name: str, rows: tuple[tuple[float, ...], ...]) -> list[str]:
    return _rows(name, [tuple(map(repr, row)) for row in rows])


def _vector(
    name: str, entries: Iterable[str], unit: str = "", opening: str = "[", closing: str = "]"
) -> list[str]:
    return _listing(name, [f"{opening}{', '.join(entries)}{closing}"], unit)


def _rows(name: str, rows: list[tuple[str, ...]], unit: str = "") -> list[str]:
    """A matrix by rows, with their entries below each other if they are short enough for it."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if sum(widths) + 2 * len(widths) > _ALIGNED:
        widths = [0] * len(widths)
    texts = [", ".join(map(str.rjust, row, widths)) for row in rows]
    pieces = ["[[" + "],\0 [".join(texts) + "]]"]
    return _listing(name, pieces[0].split("\0"), unit)


def _listing(name: str, pieces: list[str], unit: str) -> list[str]:
    """``name = ...`` as lines of a comment, a piece on as many as it needs, and the unit."""
    head = f" *   {name} = "
    margin = " *" + " " * (len(head) - 2)
    lines = []
    for i, piece in enumerate(pieces):
        whole = re.sub("(?<!,) ", "\0", piece)
        lines += wrapped(whole, margin if i else head, margin + "   ")
    if unit and len(lines[-1]) + len(unit) + 3 <= WIDTH:
        return [*lines[:-1], f"{lines[-1]}   {unit}"]
    return [*lines, *([f"{margin}{unit}"] if unit else [])]


def _soft(spec: Spec, soft: SoftFaults) -> _Part:
    rows = [signal.name for signal in spec.model.outputs]
    host = ", ".join(rows[i] for i in soft.host) or "no row"
    groups = " and ".join(", ".join(rows[i] for i in group) for group in soft.groups)
    text = (
        f"Faults: the host filter uses {host} at once; {groups} may drift and wait to the end"
        f" of a window of {soft.window} samples for a test with a rate {soft.false_alarm!r}"
        " of false alarms"
    )
    return text, []


def _actuator(spec: Spec, actuator: ActuatorFaults) -> _Part:
    listings = []
    rate = "at a rate that is not known"
    if actuator.success_rate:
        rate = f"Pr(gamma = 1) = {', '.join(map(_text, actuator.success_rate))}"
        if actuator.covariance is not None:
            listings.append(_matrix(spec, "covariance", actuator.covariance))
    together = {
        "common": "; one gamma for all inputs",
        "independent": "; inputs fail independently of each other",
        "covariance": "; the covariance of gamma couples the inputs",
    }
    how = together[actuator.dependence] if spec.model.nu > 1 else ""
    if tried := spec.filter.option("hypotheses", ()):
        listings.append(_numbers("hypotheses", tried))
    text = (
        f"Faults: gamma u[k] arrives in place of u[k], gamma is 0 or 1 and independent from sample"
        f" to sample, {rate}{how}"
    )
    return text, listings


def _sensor(spec: Spec, sensor: SensorFaults) -> _Part:
    rows = ", ".join(spec.model.outputs[i].name for i in sensor.rows)
    signal = "(C x[k] + D u[k])" if spec.model.nu else "C x[k]"
    text = (
        f"Faults of {rows}: gamma {signal} + v[k] is measured, gamma is 0 or 1; the"
        f" variance of v is delta R, delta is 1 or {_text(_factor(sensor))}"
    )
    if sensor.moments is not None:
        law = sensor.moments
        text += (
            f"; Pr(gamma = 1) = {law.gamma_rate!r}, given that it was 1 before"
            f" {law.gamma_persistence!r}; Pr(delta = 1) = {law.delta_nominal_rate!r}"
        )
    if not sensor.kernel:
        return text, []
    factor = "C" if sensor.factor is not None else f"{sensor.noise_factor:g}"
    order = f"(1, 1) (1, {factor}) (0, 1) (0, {factor})"
    if sensor.law is not None and sensor.independent:
        text = (
            f"{text}; modes (gamma, delta): {order}, joint[j] = Pr(j) with parameters of sample k"
        )
        return text, [_vector("joint", map(_text, sensor.law.rows[0]))]
    kernel = _numbers("kernel", sensor.kernel)
    if sensor.law is not None:
        kernel = _matrix(spec, "kernel", sensor.law)
    return (
        f"{text}; modes (gamma, delta): {order}, kernel[i][j] = Pr(j at k+1 | i at k)",
        [kernel, _first("kernel", sensor.initial, sensor.first)],
    )


def _first(chain: str, numbers: tuple[float, ...], first: FirstLaw | None) -> list[str]:
    """The law of the mode at sample 0."""
    if first is not None and not first.stated:
        return [f" *   initial = the stationary law of {chain}"]
    return _vector("initial", map(repr, numbers) if first is None else map(_text, first.stated))


def _factor(sensor: SensorFaults) -> Expression:
    return sensor.factor or Number(sensor.noise_factor)


def _jump(spec: Spec, jump: JumpFaults) -> _Part:
    text = "Faults: the plant jumps between modes, transition[i][j] = Pr(mode j at k+1 | mode i)"
    law = _first("transition", jump.initial, jump.first)
    transition = _numbers("transition", jump.transition)
    listings = [transition if jump.law is None else _matrix(spec, "transition", jump.law), law]
    if jump.arrival_rate is not None:
        rate = _text(jump.rate or Number(jump.arrival_rate))
        text += f"; a sample holds a signal with probability {rate}, else noise"
    if jump.arrival_chain:
        text += "; samples are (lost, arrived) by arrival_chain"
        chain = _numbers("arrival_chain", jump.arrival_chain)
        listings.append(_matrix(spec, "arrival_chain", jump.arrivals) if jump.arrivals else chain)
    if jump.arrival != "always":
        text += f"; whether it does is {jump.arrival}"
    return text, listings


def _told(spec: Spec, sensor: SensorFaults | None) -> dict[str, str]:
    """What parameters mean that no file states."""
    late = [signal for signal in spec.model.outputs if signal.max_delay]
    found = {
        each.delay: f"a whole number, 0..{each.max_delay}: so many samples ago was {each.name}"
        for each in late
    }
    if sensor is not None and spec.filter.traits.told:
        found |= {
            "gamma": "1: the rows that can fail hold a signal, 0: they hold none",
            "delta": f"1 or {_text(_factor(sensor))}: factor of the variance of their noise",
        }
    return found


def _range(spec: Spec, item: Parameter) -> str:
    """What is known about a parameter: its range, its unit, and where it stands."""
    name, actuator, told = item.name, spec.faults.actuator, _told(spec, spec.faults.sensor)
    if name in told:
        return told[name]
    rates = () if actuator is None else actuator.success_rate
    if Name(name) in rates and not item.is_bounded:
        return "a rate, in [0, 1]"
    limits = ((">=", item.low), ("<=", item.high))
    stated = [f"{relation} {limit!r}" for relation, limit in limits if math.isfinite(limit)]
    found = [" and ".join(stated)] if stated else []
    if name in spec.faults.law_names:
        found.append("keeps the laws of the faults probabilities")
    found += [f"keeps {_text(rate)} in [0, 1]" for rate in rates if name in names(rate)]
    used = []
    if any(name in each.names for each in spec.equations):
        used.append("f or h")
    for letter in LETTERS:
        matrices = [getattr(plant, letter) for plant in _stating(spec, letter)]
        if any(name in matrix.names for matrix in matrices):
            used.append(letter)
        if letter in {"Q", "R"}:
            variances = {matrix.rows[i][i] for matrix in matrices for i in range(len(matrix.rows))}
            if used == [letter] and Name(name) in variances:
                found.append("a variance, >= 0")
            elif any(name in names(variance) for variance in variances):
                found.append(f"keeps the variances of {letter} >= 0")
    used += [x for x in ("S", "x0", "P0") if name in getattr(spec.model, x).names]
    unit = next(_units_of(spec, name), "")
    return "; ".join([*filter(None, [unit, *found]), *([f"in {', '.join(used)}"] if used else [])])


def _stating(spec: Spec, letter: str) -> Iterator[Model | Mode]:
    """The plants that have this matrix."""
    return (plant for plant in spec.plants if getattr(plant, letter) != ABSENT)


def _units_of(spec: Spec, name: str) -> Iterator[str]:
    """The unit of a parameter that is an entry of the model by itself, such as ``m per m/s``."""
    signals = {"x": spec.model.states, "u": spec.model.inputs, "y": spec.model.outputs}
    for letter in "ABCDQR":
        above, below = _UNITS[letter][0], _UNITS[letter][-1]
        for plant in () if spec.model.attitudes else _stating(spec, letter):
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
        folded = [x for x in "ABC" if plant.equations is None and _width(plant, x) <= FOLDED]
        for letter in folded:
            for value, text in _coefficients(letter, getattr(plant, letter)):
                known.setdefault(abs(value), f"{'-' if value < 0 else ''}{text}{of}")
    used = {abs(value) for value in _read(phases)}
    stated = {0.0, 0.5, 1.0, 2.0} | {abs(value) for value in _numbers_in(spec.to_dict())}
    return tuple((value, known[value]) for value in sorted(used & known.keys() - stated))


def _width(plant: Model | Mode, letter: str) -> int:
    """Columns of a matrix."""
    return max(map(len, getattr(plant, letter).rows), default=0)


def _coefficients(letter: str, matrix: Matrix) -> Iterator[tuple[float, str]]:
    """What each P[k][l] is multiplied by in each entry of M P M', for a symmetric P."""
    values = {
        (i, j): entry.value
        for i, row in enumerate(matrix.rows)
        for j, entry in enumerate(row)
        if isinstance(entry, Number) and entry != ZERO
    }
    for ((i, k), a), ((j, m), b) in combinations_with_replacement(values.items(), 2):
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
    used = _read(phases)
    zero = LOG_ZERO[scalar]
    known = (
        Constant("LOG_2_PI", LOG_TWO_PI, "log(2 pi), of a Gaussian density"),
        Constant("TINY", TINY[scalar], "keeps 0/0 out of probabilities that are 0"),
        Constant("LOG_ZERO", zero, "stands for the logarithm of 0"),
        Constant("LEAST_LOG_DENSITY", 0.5 * zero, "below it no density can be told from 0"),
    )
    return tuple(constant for constant in known if constant.value in used)


def _read(phases: Sequence[Phase]) -> set[float]:
    """Every constant that the phases read."""
    return {each.value for phase in phases for each in read(Literal, phase.body)}
