"""Probabilities of hypotheses, kept as logarithms, and Bayes' rule for them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import casadi as ca

from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column

#: Logarithm that stands for probability zero: finite, and no likelihood brings it back.
LOG_ZERO = {"double": -1e300, "float": -1e30}

#: Keeps 0/0 out of a conditional probability whose condition has probability zero.
TINY = {"double": 1e-290, "float": 1e-30}


@dataclass(frozen=True, slots=True)
class Weights:
    """Probabilities after a sample, their logarithms, and the log-likelihood of the sample."""

    probability: ca.SX
    logarithm: ca.SX
    log_likelihood: ca.SX


def log_sum_exp(values: list[ca.SX]) -> ca.SX:
    """Log of the sum of exponentials, with the largest taken out."""
    if len(values) == 1:
        return values[0]
    largest = values[0]
    for value in values[1:]:
        largest = ca.fmax(largest, value)
    total = ca.exp(values[0] - largest)
    for value in values[1:]:
        total += ca.exp(value - largest)
    return largest + ca.log(total)


def reweigh(
    script: Script,
    held: tuple[ca.SX, ca.SX],
    log_likelihoods: list[ca.SX],
    floor: float,
    scalar: str,
) -> Weights:
    """Bayes' rule for ``held`` = (probability, logarithm); with no row present nothing moves.

    A sample so far out that no hypothesis has a density that a logarithm of ``scalar`` can tell
    from that of probability zero is refused.
    """
    probability, logarithm = held
    n = len(log_likelihoods)
    if n == 1:
        return Weights(probability, logarithm, log_likelihoods[0])
    result = Weights(
        script.local("weight", n),
        script.local("log_weight_now", n),
        script.local("log_evidence", 1, initial=0.0),
    )
    script.put({"weight": probability, "log_weight_now": logarithm})
    with script.when(None):
        joint = script.let(
            "log_joint",
            column([logarithm[i] + log_likelihoods[i] for i in range(n)]),
            initial=0.0,
        )
        largest = joint[0]
        for i in range(1, n):
            largest = ca.fmax(largest, joint[i])
        top = script.let("log_largest", largest, initial=0.0)
        share = script.let("share_of_largest", ca.exp(joint - top), initial=0.0)
        total = script.let("share_total", ca.sum1(share), initial=0.0)
        script.demand(Kind.POSITIVE, [top - 0.5 * LOG_ZERO[scalar]], Status.RESULT_NOT_FINITE)
        script.demand(Kind.FINITE, [total], Status.RESULT_NOT_FINITE)
        inverse = script.let("share_total_inverse", 1 / total, initial=0.0)
        log_total = script.let("log_share_total", ca.log(total), initial=0.0)
        if floor > 0.0:
            posterior = floor + (1.0 - n * floor) * (share * inverse)
            weight = script.let("floored", posterior, initial=0.0)
            logarithms = ca.log(weight)
        else:
            weight = share * inverse
            logarithms = ca.fmax((joint - top) - log_total, LOG_ZERO[scalar])
        script.put(
            {"weight": weight, "log_weight_now": logarithms, "log_evidence": top + log_total}
        )
    return result


def log_prior(prior: tuple[float, ...], scalar: str) -> tuple[float, ...]:
    """Logarithms of start probabilities; zero has its own."""
    return tuple(math.log(p) if p > 0.0 else LOG_ZERO[scalar] for p in prior)


def patterns(rates: list[float]) -> list[tuple[tuple[int, ...], float]]:
    """Every outcome of independent components with these rates, with its log probability."""
    result = []
    for works in itertools.product((0, 1), repeat=len(rates)):
        chances = [rate if w else 1.0 - rate for w, rate in zip(works, rates, strict=True)]
        result.append((works, sum(math.log(chance) for chance in chances)))
    return result
