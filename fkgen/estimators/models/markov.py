"""A Markov chain of modes with known kernel: predicted probabilities and mixing weights.

Probabilities travel with their logarithms. A column of the kernel without zeros needs only the
probabilities, because one of the modes before it holds at least 1/N; where entries are zero the
remaining modes may all be improbable, and the sum is taken in the log domain. Zeros stay exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.models.weights import LOG_ZERO
from fkgen.symbolic.builder import Script
from fkgen.symbolic.linalg import column

Kernel = tuple[tuple[float, ...], ...]

#: Entries of a kernel below this share of their column are treated in the log domain, like zeros.
SMALL = 1e-9

#: Columns are proportional if they are so to this relative error.
PROPORTIONAL = 1e-14


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


def advance(
    script: Script, kernel: Kernel, now: tuple[ca.SX, ca.SX], scalar: str, *, mixing: bool
) -> Prediction:
    """One step of the chain from ``now`` = (probability, logarithm)."""
    columns = list(zip(*kernel, strict=True))
    groups = _groups(columns)
    heads: list[_Column] = []
    for members in groups:
        heads.append(_column(script, columns[members[0]], now, str(len(heads)), mixing=mixing))
    probability: dict[int, ca.SX] = {}
    logarithm: dict[int, ca.SX] = {}
    for members, head in zip(groups, heads, strict=True):
        for j in members:
            ratio = _ratio(columns[j], columns[members[0]])
            probability[j] = head.probability * ratio
            logarithm[j] = head.logarithm + math.log(ratio)
    for j, entries in enumerate(columns):
        if not any(entries):  # never entered
            probability[j], logarithm[j] = ca.SX(0), ca.SX(LOG_ZERO[scalar])
    group = {j: at for at, members in enumerate(groups) for j in members}
    return Prediction(
        probability=column([probability[j] for j in range(len(columns))]),
        logarithm=column([logarithm[j] for j in range(len(columns))]),
        mixing=tuple(head.mixing for head in heads),
        columns=tuple(
            columns[members[0]] if _is_full(columns[members[0]]) else None for members in groups
        ),
        group=tuple(group.get(j, 0) for j in range(len(columns))),
    )


def _groups(columns: list[tuple[float, ...]]) -> list[list[int]]:
    """Targets that can be entered, those with proportional columns together."""
    groups: list[list[int]] = []
    for j, entries in enumerate(columns):
        if not any(entries):
            continue
        for members in groups:
            head = columns[members[0]]
            ratio = sum(entries) / sum(head)
            if all(
                abs(a - ratio * b) <= PROPORTIONAL * a for a, b in zip(entries, head, strict=True)
            ):
                members.append(j)
                break
        else:
            groups.append([j])
    return groups


def _ratio(entries: tuple[float, ...], head: tuple[float, ...]) -> float:
    return sum(entries) / sum(head)


@dataclass(frozen=True, slots=True)
class _Column:
    probability: ca.SX
    logarithm: ca.SX
    mixing: ca.SX


def _column(
    script: Script, entries: tuple[float, ...], now: tuple[ca.SX, ca.SX], tag: str, *, mixing: bool
) -> _Column:
    """c_j and mu_(i|j) for one target."""
    probability, logarithm = now
    if len(set(entries)) == 1:  # equal rows: the next mode does not depend on this one
        constant = ca.SX(entries[0])
        return _Column(constant, ca.SX(math.log(entries[0])), probability)
    source = [i for i, entry in enumerate(entries) if entry > 0.0]
    products = [probability[i] * entries[i] for i in source]
    total = script.let(f"mode_prediction_{tag}", sum(products[1:], start=products[0]))
    if len(source) == 1:
        weights = ca.SX.eye(len(entries))[:, source[0]]
        return _Column(total, logarithm[source[0]] + math.log(entries[source[0]]), weights)
    if _is_full(entries):
        inverse = script.let(f"mode_prediction_inverse_{tag}", 1 / total) if mixing else ca.SX(0)
        shares = column([product * inverse for product in products])
        return _Column(
            total, ca.log(total), script.let(f"mixing_{tag}", shares) if mixing else shares
        )
    return _in_logarithms(script, entries, logarithm, total, tag)


def _is_full(entries: tuple[float, ...]) -> bool:
    """Whether every mode can lead here, so that one of them is probable."""
    return min(entries) > 0.0 and min(entries) >= SMALL * max(entries)


def _in_logarithms(
    script: Script, entries: tuple[float, ...], logarithm: ca.SX, total: ca.SX, tag: str
) -> _Column:
    """The same where the modes that lead here may all be improbable."""
    source = [i for i, entry in enumerate(entries) if entry > 0.0]
    joint = [logarithm[i] + math.log(entries[i]) for i in source]
    named = script.let(f"log_path_{tag}", column(joint))
    largest = named[0]
    for at in range(1, len(source)):
        largest = ca.fmax(largest, named[at])
    top = script.let(f"log_path_largest_{tag}", largest)
    share = script.let(f"path_share_{tag}", ca.exp(named - top))
    share_total = script.let(f"path_share_total_{tag}", ca.sum1(share))
    inverse = script.let(f"path_share_inverse_{tag}", 1 / share_total)
    weights = ca.SX(len(entries), 1)
    for at, i in enumerate(source):
        weights[i] = share[at] * inverse
    return _Column(total, top + ca.log(share_total), weights)
