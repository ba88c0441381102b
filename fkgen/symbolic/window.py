"""Windows at whose end a host filter takes over, or rejects, what was collected meanwhile.

The end of a window is at samples k > 0 with k mod window = 0. It is the closing phase of a
recursion; a countdown port tells when it is due.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from fkgen.spec import SoftFaults, Spec
from fkgen.symbolic.interface import Outcome, Port, Role, Status
from fkgen.symbolic.linalg import outer_lower
from fkgen.symbolic.script import Script

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
    if spec.filter.reacquire is not None:
        counters.append(
            ("rejections", (), "window ends in a row at which all that was tested was rejected")
        )
    return (
        Port(
            name="test_statistic",
            shape=each,
            role=Role.OUTPUT,
            given="test_dof",
            meaning=f"zeta{of}: chi-square distributed without fault; 0 where no test is made",
        ),
        Port(
            name="test_dof",
            shape=each,
            role=Role.OUTPUT,
            meaning="its degrees of freedom; 0 where no test is made",
        ),
        Port(
            name="fault_declared",
            shape=each,
            role=Role.OUTPUT,
            meaning=f"1 where the compression filter{of} is rejected",
        ),
        *(Port(name=n, shape=s, role=Role.STATE, meaning=m) for n, s, m in counters),
        *(
            Port(name=f"predicted_{n}", shape=s, role=Role.STATE, meaning=f"{n} before sample k+1")
            for n, s, _ in counters
        ),
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
    return (Outcome(Status.FAULT_DECLARED, "fault_declared", 0.5),) if spec.filter.test else ()


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
    something passes: the vaguer the host, the more of its error is in d.

    Parameters
    ----------
    script : Script
        Of the closing phase.
    limit : int or None
        ``filter.reacquire``.
    verdicts : (list of SX, list of SX)
        1 where a group is accepted; 1 where it is rejected.
    host : (SX, str)
        d, and the local that holds P, packed.
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
