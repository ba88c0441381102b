"""Windows at whose end a host filter takes over, or rejects, what compression filters collected.

A window ends at samples k > 0 with k mod window = 0: it is the closing phase of a recursion, and a
countdown port tells when it is due. Every compression filter is tested then, Lee & Lee, (50), (51),
and the host takes over what passes, (25).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca

from fkgen.estimators.gaussian.estimate import finite
from fkgen.estimators.gaussian.rank import DIRECTION, QuadraticForm, quadratic_form, thresholds
from fkgen.estimators.gaussian.sequential import Form
from fkgen.faults import SoftFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import Script
from fkgen.symbolic.interface import Outcome, Port, Status
from fkgen.symbolic.linalg import column, diagonal, outer_lower, split_packed
from fkgen.symbolic.plant import Plant
from fkgen.symbolic.ports import carried, shown
from fkgen.symbolic.recursion import Phase

Groups = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """The pair of filters: sizes, symbols, and which groups each compression filter takes."""

    spec: Spec
    soft: SoftFaults
    plant: Plant
    symbols: dict[str, ca.SX]
    form: Form
    subsets: tuple[Groups, ...]

    def rows(self, subset: Groups) -> tuple[int, ...]:
        """The rows of y of the host and of these groups."""
        return tuple(sorted((*self.soft.host, *(r for g in subset for r in self.soft.groups[g]))))

    def filters(self, prefix: str = "") -> list[tuple[ca.SX, ca.SX]]:
        """(d, packed P*) of every compression filter."""
        n = self.plant.nx
        deviation = ca.vertsplit(self.symbols[f"{prefix}compression_deviation"], n)
        covariance = self.symbols[f"{prefix}compression_covariance"]
        return list(zip(deviation, split_packed(covariance, n), strict=True))


#: Positive while no window ends; the closing phase runs at zero.
COUNTDOWN = "window_left"


def window_ports(spec: Spec, soft: SoftFaults) -> tuple[Port, ...]:
    """Results of the test, and what has to be remembered from sample to sample."""
    each = (len(soft.groups),) if len(soft.groups) > 1 else ()
    of = " of each group" if each else ""
    counters = [
        (COUNTDOWN, (), "samples until the end of the window; 0 at its last sample"),
        ("collecting", each, f"1 where the compression filter{of} holds a measurement"),
    ]
    if spec.filter.options.reacquire is not None:
        counters.append(
            ("rejections", (), "window ends in a row at which all that was tested was rejected")
        )
    statistic = f"zeta{of}: chi-square distributed without fault; 0 where no test is made"
    return (
        replace(shown("test_statistic", each, statistic), given="test_dof"),
        shown("test_dof", each, "its degrees of freedom; 0 where no test is made"),
        shown("fault_declared", each, f"1 where the compression filter{of} is rejected"),
        *(carried(*counter) for counter in counters),
        *(carried(f"predicted_{n}", s, f"{n} before sample k+1") for n, s, _ in counters),
    )


def of_the_host(ports: tuple[Port, ...]) -> tuple[Port, ...]:
    """The ports of the innovation: normalised square and density are those of its own rows."""
    own = {
        "nis": "normalised innovation squared over the rows of the host that are present",
        "log_likelihood": "log density of the rows of the host that are present",
    }
    return tuple(replace(port, meaning=own.get(port.name, port.meaning)) for port in ports)


def window_outcomes(spec: Spec) -> tuple[Outcome, ...]:
    """The status of a sample at which a compression filter is rejected."""
    return (
        (Outcome(Status.FAULT_DECLARED, "fault_declared", 0.5),) if spec.filter.options.test else ()
    )


def window_start(soft: SoftFaults) -> dict[str, tuple[float, ...]]:
    """Start values: sample 0 ends no window."""
    return {f"predicted_{COUNTDOWN}": (float(soft.window),)}


def collect(script: Script, symbols: dict[str, ca.SX], soft: SoftFaults) -> dict[str, ca.SX]:
    """Note which groups have a measurement; what the update says of window and test."""
    with script.titled("which compression filters hold a measurement"):
        flags = []
        for at, group in enumerate(soft.groups):
            name = f"collecting_{at}"
            flags.append(script.local(name, 1))
            script.put({name: symbols["predicted_collecting"][at]})
            for row in group:
                with script.when(row):
                    script.put({name: ca.SX(1)})
    none = ca.SX.zeros(len(soft.groups))
    result = {
        COUNTDOWN: symbols[f"predicted_{COUNTDOWN}"],
        "collecting": ca.vertcat(*flags),
        "test_statistic": none,
        "test_dof": none,
        "fault_declared": none,
    }
    if "rejections" in symbols:
        result["rejections"] = symbols["predicted_rejections"]
    return result


def count_down(script: Script, symbols: dict[str, ca.SX], soft: SoftFaults) -> dict[str, ca.SX]:
    """What the prediction says of the window: one sample fewer, or a new one."""
    with script.titled("samples left in the window"):
        left = script.local("left", 1)
        script.put({"left": symbols[COUNTDOWN] - 1})
        with script.where(0.5 - symbols[COUNTDOWN]):
            script.put({"left": ca.SX(soft.window - 1)})
    carried = [name for name in ("collecting", "rejections") if name in symbols]
    return {f"predicted_{COUNTDOWN}": left} | {f"predicted_{n}": symbols[n] for n in carried}


def reacquired(
    script: Script,
    limit: int | None,
    verdicts: tuple[list[ca.SX], list[ca.SX]],
    host: tuple[ca.SX, str],
) -> dict[str, ca.SX]:
    """After so many windows of rejections alone the host admits that it may be off by d: P + d d'.

    d is what it would have been corrected by. It is so again after every further rejection, until
    something passes: the vaguer the host, the more of its error is in d. The ``verdicts``
    are 1 where a group is accepted, and where it is rejected; ``host`` is d and the local of P.
    """
    if limit is None:
        return {}
    (accepted, rejected), (d, name) = verdicts, host
    with script.titled("rejections in a row"):
        count = script.local("rejections_now", 1)
        script.put({"rejections_now": script.symbol("rejections")})
        with script.where(sum(rejected, start=ca.SX(-0.5))):
            script.put({"rejections_now": count + 1})
        with script.where(sum(accepted, start=ca.SX(-0.5))):
            script.put({"rejections_now": ca.SX(0)})
        with script.where(count - (limit - 0.5)):
            script.put({name: script.symbol(name) + outer_lower(d, d)})
    return {"rejections": count}


def window_end(design: Pair) -> Phase:
    """The test (50), (51) of every group, and the update of the host by what it accepts (25)."""
    symbols, n, soft = design.symbols, design.plant.nx, design.soft
    script = Script(symbols)
    tests = [_test(design, script, g) for g in range(len(soft.groups))]
    verdicts = [_verdict(design, script, g, test) for g, test in enumerate(tests)]
    accepted, rejected = ([v[i] for v in verdicts] for i in (0, 1))
    host = {"state": symbols["filtered_state"], "covariance": symbols["filtered_covariance"]}
    state = script.local("closed_state", n)
    covariance = script.local("closed_covariance", host["covariance"].numel())
    script.put({"closed_state": host["state"], "closed_covariance": host["covariance"]})
    for subset, (d, P) in zip(design.subsets, design.filters(), strict=True):
        groups = ", ".join(str(g) for g in subset)
        with script.titled(f"the host takes over: group {groups}"):
            agreed = ca.SX(0.5 - len(subset))
            for g, flag in enumerate(accepted):
                agreed += flag if g in subset else -flag
            with script.where(agreed):
                script.put({"closed_state": host["state"] + d, "closed_covariance": P})
    limit, last = design.spec.filter.options.reacquire, design.filters()[-1][0]
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
    packed = host.numel()
    for name, size in zip(names, (packed, n, n), strict=True):
        script.local(name, size, initial=0.0)
    with script.titled(f"test of group {group}"):
        with script.where(design.symbols["collecting"][group] - 0.5):
            variances = column(diagonal(host, n))
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
        if design.spec.filter.options.test:
            with script.where(test.value - test.looked_up):
                script.put({names[0]: ca.SX(0), names[1]: ca.SX(1)})
    return accepted, rejected
