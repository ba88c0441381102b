"""Probabilities of hypotheses with their logarithms: Bayes' rule, and one step of a Markov chain.

A column of a transition matrix without zeros needs only the probabilities, because one of the modes
before it holds at least 1/N; where entries are zero the remaining modes may all be improbable, and
the sum is taken in the log domain. Zeros stay exact.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce

import casadi as ca
import numpy as np

from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Kind, Status
from fkgen.symbolic.linalg import column, is_zero, total

#: Logarithm that stands for probability zero: finite, and no likelihood brings it back.
LOG_ZERO = {"double": -1e300, "float": -1e30}

#: Keeps 0/0 out of a conditional probability whose condition has probability zero.
TINY = {"double": 1e-290, "float": 1e-30}

#: Entries of a kernel below this share of their column are treated in the log domain, like zeros.
SMALL = 1e-9

#: Columns are proportional if they are so to this relative error.
PROPORTIONAL = 1e-14

Kernel = tuple[tuple[float, ...], ...]
#: One whose entries are symbols, but for those that are always zero.
VaryingKernel = tuple[tuple[ca.SX, ...], ...]


@dataclass(frozen=True, slots=True)
class Weights:
    """Probabilities after a sample, their logarithms, and the log-likelihood of the sample."""

    probability: ca.SX
    logarithm: ca.SX
    log_likelihood: ca.SX
    unfloored: ca.SX = field(default_factory=lambda: ca.SX(0, 1))  # As Bayes' rule gives it

    def ports(self) -> dict[str, ca.SX]:
        """What is shown of them."""
        names = "mode_probability", "log_weight", "log_likelihood"
        values = self.probability, self.logarithm, self.log_likelihood
        return dict(zip(names, values, strict=True))


@dataclass(frozen=True, slots=True)
class Prediction:
    """Probabilities of the next mode, and what it says about the one before."""

    probability: ca.SX  # c_j = sum_i p_ij mu_i
    logarithm: ca.SX  # log c_j
    mixing: tuple[ca.SX, ...]  # mu_(i|j), eq. (17), for every group of j with the same weights
    #: For every group its column of the kernel, if the weights are that column times a factor of
    #: each mode, with no entry zero.
    columns: tuple[tuple[float, ...] | None, ...]
    group: tuple[int, ...]  # which of ``mixing`` belongs to target j


def log_sum_exp(values: list[ca.SX]) -> ca.SX:
    """Log of the sum of exponentials, with the largest taken out."""
    if len(values) == 1:
        return values[0]
    largest = reduce(ca.fmax, values)
    return largest + ca.log(sum(ca.exp(value - largest) for value in values))


def reweigh(
    builder: PhaseBuilder,
    held: tuple[ca.SX, ca.SX],
    log_likelihoods: list[ca.SX],
    floor: float,
    scalar: str,
) -> Weights:
    """Bayes' rule for ``held`` = (probability, logarithm); with no row present nothing moves.

    A sample so far out that no hypothesis has a density that a logarithm of ``scalar`` can tell
    from that of probability zero is refused.
    """
    n = len(log_likelihoods)
    if n == 1:
        return Weights(*held, log_likelihoods[0], held[1])
    weights = builder.local("weight", n), builder.local("log_weight_now", n)
    evidence = builder.local("log_evidence", 1, initial=0.0)
    builder.assign({"weight": held[0], "log_weight_now": held[1]})
    unfloored = weights[1]
    if floor > 0.0:
        unfloored = builder.local("log_weight_by_rule", n)
        builder.assign({"log_weight_by_rule": held[1]})
    with builder.if_present(None):
        names = "log_joint", "log_largest", "share_of_largest", "share_total"
        joint, top, share, total = _relative(builder, names, held[1] + column(log_likelihoods), 0.0)
        builder.demand(Kind.POSITIVE, [top - 0.5 * LOG_ZERO[scalar]], Status.RESULT_NOT_FINITE)
        builder.demand(Kind.FINITE, [total], Status.RESULT_NOT_FINITE)
        inverse = builder.define("share_total_inverse", 1 / total, initial=0.0)
        log_total = builder.define("log_share_total", ca.log(total), initial=0.0)
        weight, logarithm = share * inverse, ca.fmax((joint - top) - log_total, LOG_ZERO[scalar])
        if floor > 0.0:
            builder.assign({"log_weight_by_rule": logarithm})
            weight = builder.define("floored", floor + (1.0 - n * floor) * weight, initial=0.0)
            logarithm = ca.log(weight)
        builder.assign(
            {"weight": weight, "log_weight_now": logarithm, "log_evidence": top + log_total}
        )
    return Weights(*weights, evidence, unfloored)


def _relative(
    builder: PhaseBuilder, names: Sequence[str], logs: ca.SX, initial: float | None = None
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Logarithms, the largest of them, exponentials relative to it, and the sum of these."""
    named = builder.define(names[0], logs, initial)
    top = builder.define(names[1], reduce(ca.fmax, ca.vertsplit(named)), initial)
    share = builder.define(names[2], ca.exp(named - top), initial)
    return named, top, share, builder.define(names[3], ca.sum1(share), initial)


def log_prior(prior: Sequence[float], scalar: str) -> tuple[float, ...]:
    """Logarithms of start probabilities; zero has its own."""
    return tuple(math.log(p) if p > 0.0 else LOG_ZERO[scalar] for p in prior)


def patterns(rates: list[float]) -> list[tuple[tuple[int, ...], float]]:
    """Every outcome of independent components with these rates, with its log probability."""
    return [
        (works, sum(math.log(p if w else 1.0 - p) for w, p in zip(works, rates, strict=True)))
        for works in itertools.product((0, 1), repeat=len(rates))
    ]


def logarithm_of(probability: ca.SX, scalar: str) -> ca.SX:
    """Logarithm of a probability that may be zero."""
    return ca.fmax(ca.log(probability), LOG_ZERO[scalar])


def advance_varying(
    builder: PhaseBuilder, kernel: VaryingKernel, now: tuple[ca.SX, ca.SX], scalar: str
) -> Prediction:
    """One step of a chain whose probabilities depend on parameters, and may be zero at times."""
    probability, logarithm = ([ca.SX(zero)] * len(kernel) for zero in (0.0, LOG_ZERO[scalar]))
    group, weights = [0] * len(kernel), list[ca.SX]()
    for j, entries in enumerate(zip(*kernel, strict=True)):
        source = [i for i, entry in enumerate(entries) if not is_zero(entry)]
        if not source:
            continue
        group[j] = len(weights)
        logs = [now[1][i] + logarithm_of(entries[i], scalar) for i in source]
        names = [f"{what}_{j}" for what in _PATH]
        whole = builder.define(
            f"mode_prediction_{j}", total([now[0][i] * entries[i] for i in source])
        )
        _, top, share, summed = _relative(builder, names, column(logs))
        before = ca.SX(len(kernel), 1)
        before[source] = share * builder.define(f"path_share_inverse_{j}", 1 / summed)
        weights.append(before)
        probability[j] = whole
        logarithm[j] = ca.fmax(top + ca.log(summed), LOG_ZERO[scalar])
    return Prediction(
        probability=column(probability),
        logarithm=column(logarithm),
        mixing=tuple(weights),
        columns=(None,) * len(weights),
        group=tuple(group),
    )


def prior_of_sample(
    builder: PhaseBuilder, law: Sequence[ca.SX], evidence: ca.SX, scalar: str
) -> tuple[ca.SX, ca.SX]:
    """Probability and logarithm of modes with this law, and what rows of the sample said before."""
    logs = column([logarithm_of(each, scalar) for each in law]) + evidence
    _, top, share, summed = _relative(builder, [f"{what}_held" for what in _PATH], logs)
    logarithm = ca.fmax((logs - top) - ca.log(summed), LOG_ZERO[scalar])
    return (
        builder.define("held_probability", share / summed),
        builder.define("held_log_weight", logarithm),
    )


def drawn_anew(law: Sequence[ca.SX], now: ca.SX, scalar: str) -> Prediction:
    """A step after which the mode has this law, whatever it was."""
    return Prediction(
        probability=column([*law]),
        logarithm=column([logarithm_of(each, scalar) for each in law]),
        mixing=(now,),
        columns=(None,),
        group=(0,) * len(law),
    )


#: What is computed of the ways into a mode.
_PATH = ("log_path", "log_path_largest", "path_share", "path_share_total")


def advance(
    builder: PhaseBuilder, kernel: Kernel, now: tuple[ca.SX, ca.SX], scalar: str, *, mixing: bool
) -> Prediction:
    """One step of the chain from ``now`` = (probability, logarithm)."""
    columns = list(zip(*kernel, strict=True))
    groups: dict[int, list[int]] = {}  # targets that can be entered, proportional ones together
    for j in (j for j, entries in enumerate(columns) if any(entries)):
        alike = (head for head in groups if _proportional(columns[j], columns[head]))
        groups.setdefault(next(alike, j), []).append(j)
    probability, logarithm = ([ca.SX(zero)] * len(columns) for zero in (0.0, LOG_ZERO[scalar]))
    group, weights = [0] * len(columns), []
    for at, (head, members) in enumerate(groups.items()):
        whole, log, before = _column(builder, columns[head], now, str(at), mixing=mixing)
        weights.append(before)
        for j in members:
            ratio, group[j] = sum(columns[j]) / sum(columns[head]), at
            probability[j], logarithm[j] = whole * ratio, log + math.log(ratio)
    return Prediction(
        probability=column(probability),
        logarithm=column(logarithm),
        mixing=tuple(weights),
        columns=tuple(columns[head] if _is_full(columns[head]) else None for head in groups),
        group=tuple(group),
    )


def _proportional(entries: tuple[float, ...], head: tuple[float, ...]) -> bool:
    ratio = sum(entries) / sum(head)
    return np.allclose(np.multiply(head, ratio), entries, rtol=PROPORTIONAL, atol=0.0)


def _is_full(entries: tuple[float, ...]) -> bool:
    """Whether every mode can lead here, so that one of them is probable."""
    return min(entries) > 0.0 and min(entries) >= SMALL * max(entries)


def _column(
    builder: PhaseBuilder,
    entries: tuple[float, ...],
    now: tuple[ca.SX, ca.SX],
    tag: str,
    *,
    mixing: bool,
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """c_j, log c_j and mu_(i|j) for one target."""
    probability, logarithm = now
    if len(set(entries)) == 1:  # equal rows: the next mode does not depend on this one
        return ca.SX(entries[0]), ca.SX(math.log(entries[0])), probability
    source = [i for i, entry in enumerate(entries) if entry > 0.0]
    products = [probability[i] * entries[i] for i in source]
    whole = builder.define(f"mode_prediction_{tag}", total(products))
    if len(source) == 1:
        only = source[0]
        weights = ca.SX.eye(len(entries))[:, only]
        return whole, logarithm[only] + math.log(entries[only]), weights
    if _is_full(entries):
        if not mixing:
            return whole, ca.log(whole), probability
        inverse = builder.define(f"mode_prediction_inverse_{tag}", 1 / whole)
        shares = column([product * inverse for product in products])
        return whole, ca.log(whole), builder.define(f"mixing_{tag}", shares)
    names = [f"{what}_{tag}" for what in _PATH]
    joint = column([logarithm[i] + math.log(entries[i]) for i in source])
    _, top, share, summed = _relative(builder, names, joint)
    weights = ca.SX(len(entries), 1)
    weights[source] = share * builder.define(f"path_share_inverse_{tag}", 1 / summed)
    return whole, top + ca.log(summed), weights
