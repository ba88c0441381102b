"""Numbers of the recursions that the code calls by a name."""

from __future__ import annotations

from fkgen.backend.ir import Constant, Literal, Phase, Scalar, operands, walk
from fkgen.estimators.gaussian.sequential import LOG_TWO_PI
from fkgen.estimators.models.weights import LOG_ZERO, TINY


def constants_of(scalar: Scalar, *phases: Phase | None) -> tuple[Constant, ...]:
    """The constants that the phases read."""
    read = {
        operand.value
        for phase in phases
        if phase is not None
        for node in walk(phase.body)
        for operand in operands(node)
        if isinstance(operand, Literal)
    }
    zero = LOG_ZERO[scalar]
    known = (
        Constant("LOG_2_PI", LOG_TWO_PI, "log(2 pi), of a Gaussian density"),
        Constant("TINY", TINY[scalar], "keeps 0/0 out of probabilities that are 0"),
        Constant("LOG_ZERO", zero, "stands for the logarithm of 0"),
        Constant("LEAST_LOG_DENSITY", 0.5 * zero, "below it no density can be told from 0"),
    )
    return tuple(constant for constant in known if constant.value in read)
