"""Windows at whose end a host filter takes over, or rejects, what compression filters collected.

A window ends at samples k > 0 with k mod window = 0: it is the closing phase of a recursion, and a
countdown port tells when it is due. Every compression filter is tested then, Lee & Lee, (50), (51),
and the host takes over what passes, (25).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import casadi as ca

from fkgen.errors import InternalError
from fkgen.estimators.gaussian.decorrelation import Measurement
from fkgen.estimators.gaussian.estimate import bound, finite, measurement_of, update_form
from fkgen.estimators.gaussian.sequential import Conditioned, innovations
from fkgen.estimators.gaussian.ud import (
    Factors,
    factors_note,
    order_of,
    seen_through,
    started,
    unpacked,
)
from fkgen.faults import SoftFaults
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.interface import Outcome, Port, Status, triangle
from fkgen.symbolic.linalg import column, outer_lower, pack
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import (
    carried,
    innovation_ports,
    shown,
    state_ports,
    symbols_of,
)
from fkgen.symbolic.recursion import Phase, Recursion

#: Positive while no window ends; the closing phase runs at zero.
COUNTDOWN = "window_left"

#: A group: what is accepted (0 or 1), what is rejected, the statistic and its degrees of freedom.
Verdict = tuple[ca.SX, ca.SX, ca.SX, ca.SX]


def soft_faults(spec: Spec) -> SoftFaults:
    """The faults that windows are for."""
    if spec.faults.soft is None:
        raise InternalError(f"{spec.filter.family} without soft faults")
    return spec.faults.soft


class Design:
    """The host and what waits for the end of a window: what the phases are written from."""

    def __init__(
        self,
        spec: Spec,
        ports: tuple[Port, ...],
        factors: tuple[Port, ...] = (),
        beside: tuple[Port, ...] = (),
    ) -> None:
        """Lay out ``ports``; ``factors`` are of covariances, of a filter that can use them.

        What else it keeps then is ``beside`` them, 0 at the start.
        """
        self.spec, self.soft = spec, soft_faults(spec)
        self.plant = plant_of(spec)
        own = len(triangle(self.plant.ne))
        self.counts = {port.name: port.size // own for port in factors}
        self.form = update_form(
            spec,
            self.plant,
            augmented=False,
            factored=bool(factors),
            many=1 + max(self.counts.values(), default=0),
        )
        self.order = order_of((self.plant,)) if self.form == "ud" else ()
        self.ports = (*factors, *beside, *ports) if self.order else ports
        self.symbols = symbols_of(spec, self.plant, self.ports)

    def held(self, packed: ca.SX) -> ca.SX | Factors:
        """What a port holds: factors, if covariances are carried so."""
        return Factors.of(packed, self.order, self.plant.scalar) if self.order else packed

    def host(self, when: str) -> ca.SX | Factors:
        """The covariance of the host, "predicted" or "filtered"."""
        return self.held(self.symbols[f"{when}_{'factors' if self.order else 'covariance'}"])

    def recursion(
        self,
        source: str,
        phases: tuple[Phase, Phase, Phase],
        *,
        notes: tuple[str, ...] = (),
    ) -> Recursion:
        """Update, closing and prediction as a recursion."""
        rejects = (Outcome(Status.FAULT_DECLARED, "fault_declared", 0.5),)
        return Recursion(
            spec=self.spec,
            source=source,
            ports=self.ports,
            start=(
                started(self.spec, self.symbols, self.counts, self.order) if self.order else None
            ),
            update=phases[0],
            closing=phases[1],
            predict=phases[2],
            form=self.form,
            notes=(*notes, *factors_note(self.order, self.spec)),
            outcomes=rejects if self.spec.filter.options.test else (),
        )


def host_ports(spec: Spec) -> tuple[Port, ...]:
    """Estimates and innovation: normalised square and density are those of the host's own rows."""
    own = {
        "nis": "normalised innovation squared over the rows of the host that are present",
        "log_likelihood": "log density of the rows of the host that are present",
    }
    shared = innovation_ports(spec)
    innovation = (replace(port, meaning=own.get(port.name, port.meaning)) for port in shared)
    return (*state_ports(spec), *innovation)


def window_ports(spec: Spec) -> tuple[Port, ...]:
    """Results of the test, and what has to be remembered from sample to sample."""
    soft = soft_faults(spec)
    count, start = len(soft.groups), {COUNTDOWN: (float(soft.window),)}  # sample 0 ends no window
    each, of = ((count,), " of each group") if count > 1 else ((), "")
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
        shown("test_statistic", each, statistic, given="test_dof"),
        shown("test_dof", each, "its degrees of freedom; 0 where no test is made"),
        shown("fault_declared", each, f"1 where the compression filter{of} is rejected"),
        *(carried(*counter) for counter in counters),
        *(
            carried(f"predicted_{n}", shape, f"{n} before sample k+1", start=start.get(n, ()))
            for n, shape, _ in counters
        ),
    )


def observed(builder: PhaseBuilder, design: Design) -> tuple[Plant, Measurement, list[ca.SX]]:
    """The plant with named entries, y as it measures it, and the innovation of the host."""
    plant, symbols = bound(builder, design.plant, "CDRd"), design.symbols
    offset = plant.D @ symbols["u"] + plant.d
    y = measurement_of(plant, y=symbols["y"], C=plant.C, offset=offset, R=plant.R)
    return plant, y, innovations(builder, symbols["predicted_state"], y, "")


def innovation_of_host(
    design: Design, plant: Plant, innovation: list[ca.SX], found: Conditioned | None
) -> dict[str, ca.SX]:
    """The ports about the innovation; ``found`` is what the rows of the host say, if it has any."""
    seen = seen_through(plant.C, unpacked(design.host("predicted"), plant.nx))
    return {
        "innovation": column(innovation),
        "innovation_covariance": seen + pack(plant.R),
        "nis": ca.SX(0) if found is None else found.nis,
        "log_likelihood": ca.SX(0) if found is None else found.log_likelihood,
    }


def collect(builder: PhaseBuilder, symbols: dict[str, ca.SX], soft: SoftFaults) -> dict[str, ca.SX]:
    """Note which groups have a measurement; what the update says of window and test."""
    with builder.titled("which compression filters hold a measurement"):
        flags = []
        for at, group in enumerate(soft.groups):
            name = f"collecting_{at}"
            flags.append(builder.local(name, 1))
            builder.assign({name: symbols["predicted_collecting"][at]})
            for row in group:
                with builder.if_present(row):
                    builder.assign({name: ca.SX(1)})
    none = ca.SX.zeros(len(soft.groups))
    result = {
        COUNTDOWN: symbols[f"predicted_{COUNTDOWN}"],
        "collecting": ca.vertcat(*flags),
        **dict.fromkeys(("test_statistic", "test_dof", "fault_declared"), none),
    }
    if "rejections" in symbols:
        result["rejections"] = symbols["predicted_rejections"]
    return result


def count_down(
    builder: PhaseBuilder, symbols: dict[str, ca.SX], soft: SoftFaults
) -> dict[str, ca.SX]:
    """What the prediction says of the window: one sample fewer, or a new one."""
    with builder.titled("samples left in the window"):
        left = builder.local("left", 1)
        builder.assign({"left": symbols[COUNTDOWN] - 1})
        with builder.if_positive(0.5 - symbols[COUNTDOWN]):
            builder.assign({"left": ca.SX(soft.window - 1)})
    carried = [name for name in ("collecting", "rejections") if name in symbols]
    return {f"predicted_{COUNTDOWN}": left} | {f"predicted_{n}": symbols[n] for n in carried}


def verdict_on(
    builder: PhaseBuilder, design: Design, group: int, tag: str, excess: Callable[[], ca.SX]
) -> tuple[ca.SX, ca.SX]:
    """(accepted, rejected) as 0 or 1: neither of them if there was no measurement."""
    names = f"accepted{tag}", f"faulty{tag}"
    accepted, rejected = (builder.local(name, 1) for name in names)
    builder.assign({names[0]: design.symbols["collecting"][group], names[1]: ca.SX(0)})
    if design.spec.filter.options.test:
        with builder.if_positive(excess()):
            builder.assign({names[0]: ca.SX(0), names[1]: ca.SX(1)})
    return accepted, rejected


@dataclass(frozen=True, slots=True)
class Takeover:
    """What the host takes over where ``agreed`` is positive."""

    title: str
    agreed: ca.SX
    shift: ca.SX  # (n,), what its state is corrected by
    covariance: ca.SX | Factors  # its own then, packed or in factors

    def results(self, state: ca.SX) -> tuple[ca.SX, ...]:
        """State, covariance, and factors if there are any."""
        held = self.covariance
        whole = (held.covariance(), held.packed) if isinstance(held, Factors) else (held,)
        return state + self.shift, *whole


def closed(
    builder: PhaseBuilder,
    design: Design,
    verdicts: Sequence[Verdict],
    takeovers: Sequence[Takeover],
    *,
    title: str = "",
    restarted: Callable[[dict[str, ca.SX]], dict[str, ca.SX]] = lambda _: {},
) -> Phase:
    """End the phase: the host as it becomes (25); what was collected is discarded in any case.

    ``restarted``: what other ports are, given covariance and factors that the host has now.
    """
    symbols, count = design.symbols, len(verdicts)
    accepted, rejected, statistic, dof = zip(*verdicts, strict=True)
    kinds = ("state", "covariance", *(("factors",) if design.order else ()))
    host = {f"closed_{of}": symbols[f"filtered_{of}"] for of in kinds}
    now = {of: builder.local(f"closed_{of}", symbols[f"filtered_{of}"].numel()) for of in kinds}
    with builder.titled(title):
        builder.assign(host)
    for each in takeovers:
        moved = each.results(symbols["filtered_state"])
        with builder.titled(each.title), builder.if_positive(each.agreed):
            builder.assign(dict(zip(host, moved, strict=True)))
    counted = {}
    if design.spec.filter.options.reacquire is not None:
        counted = _reacquired(builder, design, (accepted, rejected), takeovers[-1].shift)
    with builder.titled("results of the window"):
        builder.assign(
            {
                **{f"filtered_{of}": value for of, value in now.items()},
                **restarted({of: value for of, value in now.items() if of != "state"}),
                "collecting": ca.SX.zeros(count),
                "test_statistic": ca.vertcat(*statistic),
                "test_dof": ca.vertcat(*dof),
                "fault_declared": ca.vertcat(*rejected),
                **counted,
            },
            [finite(now["state"], now["covariance"])],
        )
    return builder.phase(unless=COUNTDOWN)


def _reacquired(
    builder: PhaseBuilder, design: Design, verdicts: Sequence[Sequence[ca.SX]], d: ca.SX
) -> dict[str, ca.SX]:
    """After so many windows of rejections alone the host admits that it may be off by d: P + d d'.

    d is what it would have been corrected by. It is so again after every further rejection, until
    something passes: the vaguer the host, the more of its error is in d.
    """
    accepted, rejected = verdicts
    with builder.titled("rejections in a row"):
        count = builder.local("rejections_now", 1)
        builder.assign({"rejections_now": builder.symbol("rejections")})
        with builder.if_positive(sum(rejected, start=ca.SX(-0.5))):
            builder.assign({"rejections_now": count + 1})
        with builder.if_positive(sum(accepted, start=ca.SX(-0.5))):
            builder.assign({"rejections_now": ca.SX(0)})
        with builder.if_positive(count - (design.spec.filter.options.reacquire - 0.5)):
            name = f"closed_{'factors' if design.order else 'covariance'}"
            held = design.held(builder.symbol(name))
            if isinstance(held, Factors):
                held = held.moved(ca.SX.eye(held.size), d, ca.SX(1))
                held = held.named(builder, "reopened")
                builder.assign({name: held.packed, "closed_covariance": held.covariance()})
            else:
                builder.assign({name: held + outer_lower(d, d)})
    return {"rejections": count}
