"""The plant as it happens, as C for Python only: drawn faults and noise in, y[k] and x[k+1] out.

The counterpart of a recursion: what a family estimates is generated here, always in double.
*Coins* (actuators that work) fall anew in every sample, one *chain* of conditions (of sensors,
packets, modes of the plant) is Markov. Both are numbers, so that a sample is straight-line code.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple

import casadi as ca
import numpy as np

from fkgen.backend.ir import Element, Operate, Operator, Phase, Require, Space, every, read
from fkgen.backend.lines import filled
from fkgen.backend.lower import lower_phase
from fkgen.backend.printer import StatementPrinter
from fkgen.backend.render import elementary_context
from fkgen.errors import InternalError
from fkgen.problem import Spec
from fkgen.symbolic import recursion
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.domain import demands
from fkgen.symbolic.interface import Kind, Port, Role, Status
from fkgen.symbolic.lifting.equations import box_plus, normalised
from fkgen.symbolic.lifting.expressions import lift_expression
from fkgen.symbolic.linalg import column, is_zero, reduced, sparse, total
from fkgen.symbolic.plant import Plant, mode_plants, plant_of
from fkgen.symbolic.ports import PARAMETER
from fkgen.trials import random_numbers
from fkgen.trials.conditions import (
    Conditions,
    conditions_of,
    moving_kernel,
    probabilities_of,
)
from fkgen.version import __version__

#: What a phase reads besides parameters; none of it is kept by the sampler.
_INPUTS = ("x", "u", "w", "v", "coin", "indicator", "hypothesis", "before")
#: What phases write.
_WRITTEN = {
    "state": "x[k]",
    "measurement": "y[k]",
    "threshold": "probabilities at which coins fall, summed up",
    "chain": "probabilities of the next condition after each, summed up",
}
_NORMAL = {Operator.LOG, Operator.SQRT}  # what normal numbers need
#: Samples whose random numbers are drawn at a stretch: they stay in the nearest cache.
MANY = 128
#: The bits of 2^52, below which those of a whole number are a double.
WHOLE_BITS = "0x4330000000000000u"
_NEGLIGIBLE = 1e-14  # a pivot below this share of its diagonal entry is the rounding of a zero
_TINY = 1e-300  # keeps the quotient of two zeros at zero
_ROUNDED = 1e-9  # joint probabilities of expressions may fall below zero by their rounding


class SamplerSource(NamedTuple):
    """Generated C of one sampler, and the facts (JSON) that Python needs to call it."""

    text: str
    facts: str


def render_sampler(spec: Spec) -> SamplerSource:
    """Write, lower and print the phases of a spec that says how its faults come about."""
    conditions, sizes = conditions_of(spec), (spec.model.nx, spec.model.nu, spec.model.ny)
    c = StatementPrinter(spec.name, "double", spec.model.ny)
    ports, written = _phases(spec, conditions)
    lowered = {words: lower_phase(ports, phase, _INPUTS) for words, phase in written.items()}
    body = tuple(node for phase in lowered.values() for node in phase.body)
    operations = [node.operator for node in every(Operate, body)]
    functions = {operator for operator in operations if operator.is_function}
    context = elementary_context(c, frozenset(functions | _NORMAL)) | {
        "parameters": [(p.name, p.default) for p in spec.stated_parameters],
        "ports": ports,
        "version": __version__,
        "tests_finiteness": any(node.kind is Kind.FINITE for node in every(Require, body)),
        **dict(zip("nqp", sizes, strict=True)),
        "errors": spec.model.ne,
        "many": MANY,
        "whole_bits": WHOLE_BITS,
        "noises": noise_count(spec),
        "conditions": conditions,
        "initial": _cumulative(conditions.initial),
        "kernel": [_cumulative(row) for row in conditions.kernel],
        "prior": _cumulative(conditions.prior),
        "phases": [
            {"verb": verb, "comment": comment, "program": phase, "body": c.block(phase.body)}
            | {"reads": _read(phase)}
            for (verb, comment), phase in lowered.items()
        ],
        "statuses": (Status.OK, Status.PARAMETER_OUT_OF_RANGE, Status.RESULT_NOT_FINITE),
        "numbers": random_numbers,
    }
    facts = {
        "name": spec.name,
        "sizes": sizes,
        "coins": conditions.coins,
        "modes": conditions.modes,
        "lost": conditions.lost,
        "hypotheses": len(conditions.prior),
        "operations": len(operations),
    }
    return SamplerSource(filled("sampler.c.j2", context), json.dumps(facts))


def _read(phase: Phase) -> tuple[str, ...]:
    """Names of the arguments that a phase reads."""
    found = {each.name for each in read(Element, phase.body) if each.space is Space.INPUT}
    return tuple(name for name in _INPUTS if name in found)


def _cumulative(law: tuple[float, ...]) -> list[float]:
    """Sums up to each entry but the last: whatever has no probability gets none by rounding."""
    if not law:
        return []
    sums = np.cumsum(law)
    sums[np.flatnonzero(law)[-1] :] = 1.0
    return [float(value) for value in sums[:-1]]


def _phases(
    spec: Spec, conditions: Conditions
) -> tuple[tuple[Port, ...], dict[tuple[str, str], recursion.Phase]]:
    """What phases write; and the phases by verb and comment, in the order in which they run."""
    jump = spec.faults.jump
    plants = (plant_of(spec),) if jump is None else mode_plants(spec, jump.modes)
    symbols = _symbols(spec, plants[0], conditions)
    ports = tuple(
        Port(name=name, shape=(symbols[name].numel(),), role=Role.STATE, meaning=meaning)
        for name, meaning in _WRITTEN.items()
        if symbols[name].numel()
    )
    return ports, {
        ("start", "x[0]"): _start(spec, symbols),
        ("law", "probabilities of coins, summed up"): _law(spec, plants[0], conditions, symbols),
        ("measure", "y[k]"): _sample(spec, plants, conditions, symbols, "measurement"),
        ("move", "x[k+1]"): _sample(spec, plants, conditions, symbols, "state"),
    }


def noise_count(spec: Spec) -> int:
    """Normal numbers of a step: those that are added to x, then those that enter through f."""
    entering = (len(each.noises) for each in spec.equations)
    return spec.model.ne + max(entering, default=0)


def _symbols(spec: Spec, plant: Plant, conditions: Conditions) -> dict[str, ca.SX]:
    n, p = plant.nx, plant.ny
    numbers = len(conditions.indicators[0]) if conditions.indicators else 0
    drawn = noise_count(spec)
    named, count = {item.name for item in spec.stated_parameters}, len(conditions.initial)
    sizes = (n, plant.nu, drawn, p, conditions.coins, numbers, len(conditions.prior), len(named))
    thresholds = sum(len(draw.patterns) - 1 for draw in conditions.draws)
    written = (n, p, thresholds, count * (count - 1) if conditions.moving else 0)
    names = zip((*_INPUTS, *_WRITTEN), (*sizes, *written), strict=True)
    symbols = {name: ca.SX.sym(name, size) for name, size in names}
    return symbols | {PARAMETER + k: s for k, s in plant.parameters.items() if k in named}


def _start(spec: Spec, symbols: Mapping[str, ca.SX]) -> recursion.Phase:
    """x[0] = x0 (+) root(P0) w."""
    builder, model = PhaseBuilder(symbols), spec.model
    x0, root = ca.SX(model.x0.values()), lower_root(ca.SX(model.P0.values()))
    error = root @ symbols["w"][: model.ne]
    builder.assign({"state": normalised(box_plus(x0, error, model.attitudes), model.attitudes)})
    return builder.phase()


def _law(
    spec: Spec, plant: Plant, conditions: Conditions, symbols: Mapping[str, ca.SX]
) -> recursion.Phase:
    """The probabilities of the Bernoulli variables, of which none may be negative."""
    builder = PhaseBuilder(symbols)
    for kind, values in demands(spec, plant.parameters).items():
        builder.demand(kind, values, Status.PARAMETER_OUT_OF_RANGE)
    thresholds: list[ca.SX] = []
    for patterns in probabilities_of(spec, plant, conditions, symbols["hypothesis"]):
        sums = list(accumulate(patterns))
        every = [value + _ROUNDED for value in (*patterns, 1 - sums[-1])]
        builder.demand(Kind.NONNEGATIVE, every, Status.PARAMETER_OUT_OF_RANGE)
        thresholds += sums
    if thresholds:
        builder.assign({"threshold": column(thresholds)})
    if conditions.moving:
        names = [item.name for item in spec.stated_parameters]
        before = dict(zip(names, ca.vertsplit(symbols["before"]), strict=True))
        kernel = moving_kernel(spec, before, plant.parameters)
        rows = [list(accumulate(ca.horzsplit(row))) for row in ca.vertsplit(kernel)]
        builder.assign({"chain": column([each / row[-1] for row in rows for each in row[:-1]])})
    return builder.phase()


def _root_factor(spec: Spec, plant: Plant) -> ca.SX | None:
    """How much larger the noise of a faulty row is, where that depends on parameters."""
    faults = spec.faults.sensor
    if faults is None or faults.factor is None:
        return None
    return ca.sqrt(lift_expression(faults.factor, plant.parameters))


def _sample(
    spec: Spec,
    plants: tuple[Plant, ...],
    conditions: Conditions,
    symbols: Mapping[str, ca.SX],
    port: str,
) -> recursion.Phase:
    """y[k] = s h(x, u) + f root(R) v, or x[k+1] = f(x, u, w) (+) root(Q) w."""
    builder, indicator = PhaseBuilder(symbols), symbols["indicator"]
    by_equations = plants[0].lifted is not None
    if conditions.entering and port == "state":
        indicator = indicator[-conditions.plants :]
    covariances = [plant.R if port == "measurement" else plant.Q for plant in plants]
    for covariance in covariances:
        variances = ca.vertsplit(sparse(ca.diag(covariance)))
        builder.demand(Kind.NONNEGATIVE, variances, Status.PARAMETER_OUT_OF_RANGE)
    roots = {id(covariance): lower_root(covariance) for covariance in covariances}
    root = _moving([roots[id(covariance)] for covariance in covariances], indicator)
    u = symbols["coin"] * symbols["u"] if conditions.coins else symbols["u"]
    value = _stated(builder, plants, indicator, (symbols["x"], u, symbols["w"]), port)
    if port == "measurement":
        added, factor = root @ symbols["v"], _root_factor(spec, plants[0])
        value = _sensed(conditions, (indicator, factor), value, added, guarded=by_equations)
        for row in plants[0].wraps:
            value[row] = reduced(value[row])
    else:
        shared, w = plants[0].S, symbols["w"][: plants[0].ne]
        added = root @ w
        if shared.nnz():  # w given v, which y[k] was drawn with
            R = plants[0].R
            joint = lower_root(ca.blockcat(R, shared.T, shared, plants[0].Q))
            added = joint[R.shape[0] :, :] @ ca.vertcat(symbols["v"], w)
        attitudes = plants[0].attitudes
        value = normalised(box_plus(value, added, attitudes), attitudes)
    builder.assign({port: value})
    builder.demand(Kind.FINITE, ca.vertsplit(symbols[port]), Status.RESULT_NOT_FINITE)
    return builder.phase()


def _stated(
    builder: PhaseBuilder,
    plants: tuple[Plant, ...],
    indicator: ca.SX,
    at: tuple[ca.SX, ca.SX, ca.SX],
    port: str,
) -> ca.SX:
    """h, or f with its noises, of the plant that moves; ``at``: x, u and w."""
    x, u, w = at
    if plants[0].lifted is None:
        letters = "CDd" if port == "measurement" else "ABc"
        M, N, offset = (
            _moving([getattr(p, letter) for p in plants], indicator) for letter in letters
        )
        return M @ x + N @ u + offset
    values = []
    indicators = [ca.SX(1)] if len(plants) == 1 else ca.vertsplit(indicator[: len(plants)])
    for plant, holds in zip(plants, indicators, strict=True):
        lifted = plant.lifted
        if lifted is None:
            raise InternalError("modes of matrices beside modes of equations")
        expression, noise = lifted.seen, ca.SX.zeros(lifted.w.shape)
        if port == "state":
            variances = ca.vertsplit(lifted.variances) if lifted.w.numel() else []
            builder.demand(Kind.NONNEGATIVE, variances, Status.PARAMETER_OUT_OF_RANGE)
            drawn = w[plant.ne : plant.ne + lifted.w.numel(), :]
            expression, noise = lifted.stirred, ca.sqrt(lifted.variances) * drawn
        (value,) = ca.substitute([expression], [lifted.x, lifted.u, lifted.w], [x, u, noise])
        values.append(_while(holds, ca.cse(value)))
    return total(values)


def _while(holds: ca.SX, value: ca.SX) -> ca.SX:
    """A vector where an indicator is 1, else zeros: nothing of a value that may be none."""
    if holds.is_constant():
        return value
    entries = ca.vertsplit(ca.densify(value))
    return column([ca.SX.binary(ca.OP_IF_ELSE_ZERO, holds > 0, each) for each in entries])


def _sensed(
    conditions: Conditions,
    told: tuple[ca.SX, ca.SX | None],
    value: ca.SX,
    added: ca.SX,
    *,
    guarded: bool,
) -> ca.SX:
    """Measurements of a signal and its noise, with what the condition makes of both.

    ``told`` are the indicators, and the factor of the noise where that depends on parameters.
    """
    signal, deviation = ca.SX.ones(value.numel()), ca.SX.ones(value.numel())
    for row in conditions.rows:
        signal[row], deviation[row] = ca.vertsplit(told[0][conditions.plants :][:2])
        if told[1] is not None:
            deviation[row] = 1 + deviation[row] * (told[1] - 1)
    seen = signal * value
    if guarded:  # a signal that is lost may have no value
        pairs = zip(ca.vertsplit(signal), ca.vertsplit(ca.densify(value)), strict=True)
        seen = column([_while(*each) for each in pairs])
    return seen + deviation * added


def _moving(values: Sequence[ca.SX], indicator: ca.SX) -> ca.SX:
    """A matrix of the plant that moves, from those of all of them."""
    if all(values[0] is value for value in values):
        return values[0]
    return ca.SX(sum(indicator[i] * value for i, value in enumerate(values)))


def lower_root(covariance: ca.SX) -> ca.SX:
    """Lower triangular L with L L' = covariance; columns of pivots that are (rounded) 0 are 0."""
    n = covariance.shape[0]
    left, root = ca.SX(covariance), ca.SX(n, n)
    for j in range(n):
        pivot = _pivot(left[j, j], covariance[j, j])
        if is_zero(pivot):
            continue
        root[j, j] = ca.sqrt(pivot)
        below = [i for i in range(j + 1, n) if not is_zero(left[i, j])]
        for i in below:
            root[i, j] = left[i, j] * root[j, j] / (pivot + _TINY)
        for i in below:
            for k in (k for k in below if k <= i):
                left[i, k] = left[i, k] - root[i, j] * root[k, j]
    return sparse(root)


def _pivot(left: ca.SX, whole: ca.SX) -> ca.SX:
    """What is left of a diagonal entry, or zero if that is rounding."""
    if left.is_constant() and whole.is_constant():
        return left if float(left) > _NEGLIGIBLE * float(whole) else ca.SX(0)
    if ca.is_equal(left, whole):
        return left
    return ca.fmax(left - _NEGLIGIBLE * whole, 0)
