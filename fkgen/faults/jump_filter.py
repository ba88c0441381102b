"""What the filters of jumping plants demand of the spec: detectors, the stationary gain, R."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fkgen.faults.jump import JumpFaults
from fkgen.problem.covariance import is_singular
from fkgen.problem.filter import Filter
from fkgen.problem.magnitude import check_mode_magnitudes
from fkgen.problem.probability import period, stationary_law
from fkgen.problem.table.place import Place

Array = NDArray[np.float64]

#: Radii closer to one than this are not told from one.
MARGIN = 1e-9


def mean_square_radius(transition: Sequence[Sequence[float]], dynamics: Sequence[Array]) -> float:
    """Spectral radius of the operator that moves the second moments, mode by mode.

    Parameters
    ----------
    transition : (N, N) nested sequence of float
    dynamics : N (n, n) ndarray
        A of each mode.

    Returns
    -------
    float
        Below one exactly if the plant is mean-square stable.

    References
    ----------
    Costa, Fragoso & Marques 2005, Theorem 3.9: block (j, i) is p_ij A_i (x) A_i.
    """
    P = np.asarray(transition, float)
    moved = [np.kron(A, A) for A in dynamics]
    blocks = [[P[i, j] * moved[i] for i in range(len(P))] for j in range(len(P))]
    return float(np.abs(np.linalg.eigvals(np.block(blocks))).max())


def is_ergodic(transition: Sequence[Sequence[float]]) -> bool:
    """Whether the law of the mode converges to one limit, wherever the chain starts."""
    return stationary_law(transition) is not None and period(transition) == 1


def check_jumps(
    faults: JumpFaults, place: Place, options: Filter, defaults: Mapping[str, float], scalar: str
) -> None:
    """Refuse a plant for which the family is not defined, or an option has no meaning.

    Raises
    ------
    SpecError
        If an entry is too large or too small for the scalar, R of a mode is singular where
        densities are compared, a detector has nothing to detect, or the stationary gain does not
        exist.
    """
    where = place.entry("faults").entry("jump")
    for i, mode in enumerate(faults.modes):
        check_mode_magnitudes(mode, where.entry("modes").item(i), defaults, scalar)
    _check_noise(faults, where, options, defaults)
    if options.detector != "none":
        _check_detector(faults, where, options)
    if options.gain == "stationary":
        _check_stationary(faults, place, defaults)


def _check_noise(
    faults: JumpFaults, where: Place, options: Filter, defaults: Mapping[str, float]
) -> None:
    compares = options.family == "imm" or options.detector == "llr"
    for i, mode in enumerate(faults.modes):
        if not is_singular(mode.R.values(defaults)):
            continue
        at = where.entry("modes").item(i).entry("R")
        if compares:
            whose = "the family imm" if options.family == "imm" else "the detector llr"
            raise at.error(
                "a singular matrix", f"a positive definite R for {whose}: it compares densities"
            )
        if not mode.Q.values(defaults).any():
            raise at.error(
                "a singular matrix, and Q = 0",
                "a positive definite R where there is no process noise, or some process noise",
            )


def _check_detector(faults: JumpFaults, where: Place, options: Filter) -> None:
    if faults.arrival == "always":
        given = "'always'" if faults.has_channel else "nothing about arrivals"
        raise where.entry("arrival").error(
            f"{given} with the detector {options.detector}",
            "arrival_rate or arrival_chain: a detector is about samples that may be lost",
        )
    if options.detector == "llr" and faults.arrival_rate is None:
        raise where.entry("arrival_rate").error(
            "nothing (the key is missing) with the detector llr",
            "Pr(a sample holds a signal): it is the prior of the likelihood ratio",
        )


def _check_stationary(faults: JumpFaults, place: Place, defaults: Mapping[str, float]) -> None:
    at = place.entry("filter").entry("gain")
    given, instead = "'stationary'", "use 'time_varying'"
    if not all(mode.is_constant for mode in faults.modes):
        raise at.error(f"{given} with matrices that depend on parameters", f"constants; {instead}")
    if any(mode.B.shape[1] for mode in faults.modes):
        raise at.error(
            f"{given} with inputs",
            f"a plant without B: an input moves the second moments at will; {instead}",
        )
    if not is_ergodic(faults.transition):
        raise at.error(
            f"{given} with a chain that has no limit",
            "an ergodic chain: one stationary law, and no cycle that it is bound to; " + instead,
        )
    if (
        faults.arrival == "unknown"
        and faults.arrival_chain
        and not is_ergodic(faults.arrival_chain)
    ):
        raise at.error(
            f"{given} with an arrival_chain that alternates", f"a chain with a limit; {instead}"
        )
    radius = mean_square_radius(
        faults.transition, [mode.A.values(defaults) for mode in faults.modes]
    )
    if radius >= 1.0 - MARGIN:
        raise at.error(
            f"{given} where the second moments grow: the mean-square radius is {radius:.9g}",
            f"a mean-square stable plant, radius below 1; {instead}, its gain follows the moments",
        )
