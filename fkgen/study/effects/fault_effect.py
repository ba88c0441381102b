"""What a fault does to the estimate, for how long, and whether the innovation shows it.

References
----------
Song & Hu 2019, *Effect of Faults on Kalman Filter of State Vectors in Linear Systems*, eqs.
(6)-(26), with the errata of docs/fault-effects.md.
"""

from __future__ import annotations

from collections.abc import Mapping

from numpy.typing import ArrayLike

from fkgen.problem import Spec
from fkgen.study.effects.effect import FaultEffect
from fkgen.study.effects.paired import RUNS, differenced_response, paired_response
from fkgen.study.effects.response import linear_response
from fkgen.study.effects.scenario import scenario_of


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

    ``kf``, ``mkf``, ``genie``: by the recursion of the filter, driven by the fault and started at
    zero, in C. ``linear_optimal`` with sensor faults: by two runs, whose difference no record
    changes. Others: by simulated pairs with the same noise. ``kind`` of the result says which.

    Parameters
    ----------
    spec : Spec
    sensor, input : (T, p), (T, q) array_like, optional
        What is added to y, and to u; see `fkgen.profiles`.
    mode : str
        Who gets the input anomaly: ``"both"``, ``"plant"`` (actuator fault), ``"filter"``.
    steps : int, optional
        T, to be checked against the profile.
    params : mapping, optional
        Run-time parameters, numbers or (T,).
    u : (T, q) array_like, optional
        Inputs without the fault; needed where the gain depends on them (``mkf``, ``mme``).
    y : (T, p) array_like, optional
        A record of which only the missing entries (NaN) matter.
    runs, seed : int
        Of the simulated pairs.

    Raises
    ------
    DataError
        If a profile does not fit the model, or the plant is unstable and numbers overflow.
    """
    scenario = scenario_of(spec, (sensor, input), mode, steps, params=params, u=u, y=y)
    traits = spec.filter.traits
    if traits.linear:
        return linear_response(scenario)
    if traits.moments and spec.faults.sensor is not None and not scenario.anomaly.any():
        return differenced_response(scenario)
    return paired_response(scenario, runs, seed)
