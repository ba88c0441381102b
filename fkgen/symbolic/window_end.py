"""The end of a window: every compression filter is tested, the host takes over what passes.

Lee & Lee, (50), (51) and (25).
"""

from __future__ import annotations

import casadi as ca

from fkgen.symbolic.estimate import finite
from fkgen.symbolic.linalg import column
from fkgen.symbolic.pair import Pair
from fkgen.symbolic.rank import DIRECTION, QuadraticForm, quadratic_form, thresholds
from fkgen.symbolic.recursion import Phase
from fkgen.symbolic.script import Script
from fkgen.symbolic.window import COUNTDOWN, reacquired


def window_end(design: Pair) -> Phase:
    """The test (50), (51) of every group, and the update of the host by what it accepts (25)."""
    symbols, n, soft = design.symbols, design.plant.nx, design.soft
    script = Script(symbols)
    tests = [_test(design, script, g) for g in range(len(soft.groups))]
    verdicts = [_verdict(design, script, g, test) for g, test in enumerate(tests)]
    accepted, rejected = ([v[i] for v in verdicts] for i in (0, 1))
    host = {"state": symbols["filtered_state"], "covariance": symbols["filtered_covariance"]}
    state = script.local("closed_state", n)
    covariance = script.local("closed_covariance", n * (n + 1) // 2)
    script.put({"closed_state": host["state"], "closed_covariance": host["covariance"]})
    for subset, (d, P) in zip(design.subsets, design.filters(), strict=True):
        groups = ", ".join(str(g) for g in subset)
        with script.titled(f"the host takes over: group {groups}"):
            agreed = ca.SX(0.5 - len(subset))
            for g, flag in enumerate(accepted):
                agreed += flag if g in subset else -flag
            with script.where(agreed):
                script.put({"closed_state": host["state"] + d, "closed_covariance": P})
    limit, last = design.spec.filter.reacquire, design.filters()[-1][0]
    results = reacquired(script, limit, (accepted, rejected), (last, "closed_covariance"))
    with script.titled("results of the window"):
        count = len(design.subsets)
        script.put(
            {
                "filtered_state": state,
                "filtered_covariance": covariance,
                "compression_deviation": ca.SX.zeros(n * count),
                "compression_covariance": ca.vertcat(*[covariance] * count),
                "collecting": ca.SX.zeros(len(soft.groups)),
                "test_statistic": ca.vertcat(*(test.value for test in tests)),
                "test_dof": ca.vertcat(*(test.rank for test in tests)),
                "fault_declared": ca.vertcat(*rejected),
                **results,
            },
            [finite(state, covariance)],
        )
    return script.phase(unless=COUNTDOWN)


def _test(design: Pair, script: Script, group: int) -> QuadraticForm:
    """The statistic d' (P - P*)^+ d of a group, if it holds a measurement."""
    n, scalar = design.plant.nx, design.spec.code.scalar
    host = design.symbols["filtered_covariance"]
    d, P = design.filters()[group]
    names = f"difference_{group}", f"shift_{group}", f"scale_{group}"
    packed = n * (n + 1) // 2
    for name, size in zip(names, (packed, n, n), strict=True):
        script.local(name, size, initial=0.0)
    with script.titled(f"test of group {group}"):
        with script.where(design.symbols["collecting"][group] - 0.5):
            variances = column([host[i * (i + 3) // 2] for i in range(n)])
            script.put(dict(zip(names, (host - P, d, variances), strict=True)))
        table = thresholds(design.soft.false_alarm, n)
        return quadratic_form(script, names, n, DIRECTION[scalar], table)


def _verdict(design: Pair, script: Script, group: int, test: QuadraticForm) -> tuple[ca.SX, ca.SX]:
    """(accepted, rejected) as 0 or 1: neither of them if there was no measurement."""
    names = f"accepted_{group}", f"rejected_{group}"
    accepted, rejected = (script.local(name, 1) for name in names)
    collecting = design.symbols["collecting"][group]
    with script.titled(f"verdict on group {group}"):
        script.put({names[0]: collecting, names[1]: ca.SX(0)})
        if design.spec.filter.test:
            with script.where(test.value - test.looked_up):
                script.put({names[0]: ca.SX(0), names[1]: ca.SX(1)})
    return accepted, rejected
