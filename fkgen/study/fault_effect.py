"""What a fault does to the estimate, for how long, and whether the innovation shows it."""

from __future__ import annotations

from collections.abc import Mapping

from numpy.typing import ArrayLike

from fkgen.spec import Spec
from fkgen.study.effect import FaultEffect
from fkgen.study.paired import RUNS, differenced_response, paired_response
from fkgen.study.question import ask
from fkgen.study.response import LINEAR, linear_response

__all__ = ["FaultEffect", "fault_effect"]


def fault_effect(
    spec: Spec,
    sensor: ArrayLike | None = None,
    input: ArrayLike | None = None,  # noqa: A002 - the word of the contract
    mode: str = "both",
    steps: int | None = None,
    *,
    params: Mapping[str, ArrayLike] | None = None,
    u: ArrayLike | None = None,
    y: ArrayLike | None = None,
    runs: int = RUNS,
    seed: int = 0,
) -> FaultEffect:
    """Say what a fault changes in the estimate, the error and the innovation.

    For ``kf``, ``mkf`` and ``genie`` the answer is the recursion of the filter itself, driven by
    the fault and started at zero, in compiled C. For ``linear_optimal`` and sensor faults it is the
    difference of two runs, which is the same for every record. For all others runs are simulated
    in pairs, with and without the fault and with the same noise; ``kind`` says which it was.

    Parameters
    ----------
    spec : Spec
        Plant and filter.
    sensor : (T, p) array_like, optional
        What is added to y; see `fkgen.profiles`.
    input : (T, q) array_like, optional
        What is added to u.
    mode : str
        Who gets the input anomaly: ``"both"`` plant and filter, ``"plant"`` (an actuator fault) or
        ``"filter"`` (a wrong readback of the command).
    steps : int, optional
        T; only to be checked against the profile.
    params : mapping of str to float or (T,) array_like, optional
        Run-time parameters; those left out keep their defaults.
    u : (T, q) array_like, optional
        The inputs without the fault. Needed where the gain depends on them (``mkf``, ``mme``).
    y : (T, p) array_like, optional
        A record of which only the missing entries (NaN) matter.
    runs, seed : int, optional
        Pairs of simulated runs, and where their random numbers start.

    Returns
    -------
    FaultEffect

    Raises
    ------
    DataError
        If a profile does not fit the model, or the plant is unstable and numbers overflow.

    References
    ----------
    Song & Hu 2019, *Effect of Faults on Kalman Filter of State Vectors in Linear Systems*, eqs.
    (6)-(26), with the errata of docs/fault-effects.md.
    """
    question = ask(spec, (sensor, input), mode, steps, params=params, u=u, y=y)
    if spec.filter.family in LINEAR:
        return linear_response(question)
    if spec.filter.family == "linear_optimal" and input is None:
        return differenced_response(question)
    return paired_response(question, runs, seed)
