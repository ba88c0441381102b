"""Hypotheses about a success rate, side by side: sizes, stacked ports, symbols."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import casadi as ca

from fkgen.errors import InternalError
from fkgen.spec import ActuatorFaults, Spec
from fkgen.symbolic.actuation import Actuation, intermittent
from fkgen.symbolic.estimate import Posterior, senses_actuation, update_form
from fkgen.symbolic.interface import Port, Role
from fkgen.symbolic.linear_filter import from_rows
from fkgen.symbolic.plant import Plant, plant_of
from fkgen.symbolic.ports import innovation_ports, state_ports, symbols_of
from fkgen.symbolic.sequential import Form

#: With more independent inputs than this the mixture has too many terms; the Gaussian is used
#: instead.
LARGEST_MIXTURE = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Bank:
    """The hypotheses side by side: sizes, slices of the stacked ports, symbols."""

    spec: Spec
    plant: Plant
    faults: ActuatorFaults
    ports: tuple[Port, ...]
    symbols: dict[str, ca.SX]
    random: tuple[int, ...]
    form: Form
    mixture: bool

    @classmethod
    def of(cls, spec: Spec) -> Bank:
        """Lay out the hypotheses of a spec."""
        faults = spec.faults.actuator
        if faults is None:
            raise InternalError("mme without actuator faults")
        plant = plant_of(spec)
        u = ca.SX.sym("u", plant.nu)
        actuations = [_actuation(faults, rates, u, plant) for rates in spec.filter.hypotheses]
        sensed = [a.size if senses_actuation(plant, a) else 0 for a in actuations]
        ports = _ports(spec, sensed)
        independent = faults.dependence == "independent" and plant.nu > 1
        fits = not independent or plant.nu <= LARGEST_MIXTURE
        return cls(
            spec=spec,
            plant=plant,
            faults=faults,
            ports=ports,
            symbols=symbols_of(spec, plant, ports),
            random=tuple(sensed),
            form=update_form(spec, plant, augmented=any(sensed)),
            mixture=any(sensed) and fits and spec.filter.likelihood == "mixture",
        )

    @property
    def size(self) -> int:
        """Number N of hypotheses."""
        return len(self.spec.filter.hypotheses)

    def part(self, port: str, i: int) -> ca.SX:
        """Share of hypothesis i in a port that stacks equal shares."""
        symbol = self.symbols[port]
        width = symbol.numel() // self.size
        return symbol[i * width : (i + 1) * width]

    def actuation(self, i: int) -> Actuation:
        """Inputs under hypothesis i."""
        rates = self.spec.filter.hypotheses[i]
        return _actuation(self.faults, rates, self.symbols["u"], self.plant)

    def deviation(self, i: int) -> Posterior:
        """The filtered estimate of hypothesis i, read back from the ports."""
        n, r = self.plant.nx, self.random[i]
        none = ca.SX(0, 1)
        begin = sum(self.random[:i])
        packed = [s * (s + 1) // 2 for s in self.random]
        covariance = slice(sum(packed[:i]), sum(packed[: i + 1]))
        cross = slice(begin * n, (begin + r) * n)
        return Posterior(
            state=self.part("mode_filtered_state", i),
            covariance=self.part("mode_filtered_covariance", i),
            deviation=self.symbols["mode_deviation"][begin : begin + r] if r else none,
            deviation_covariance=self.symbols["mode_deviation_covariance"][covariance]
            if r
            else none,
            cross_covariance=from_rows(self.symbols["mode_deviation_cross"][cross], r)
            if r
            else none,
        )


def _actuation(
    faults: ActuatorFaults, rates: tuple[float, ...], u: ca.SX, plant: Plant
) -> Actuation:
    return intermittent(faults, [ca.SX(rate) for rate in rates], u, plant)


def _ports(spec: Spec, random: list[int]) -> tuple[Port, ...]:
    n, count = spec.model.nx, len(spec.filter.hypotheses)
    rates = len(spec.filter.hypotheses[0])
    vector = partial(Port, role=Role.STATE)
    ports = [
        *state_ports(spec),
        *innovation_ports(spec),
        vector(
            name="mode_probability",
            shape=(count,),
            meaning="probability of each hypothesis given y[0..k]",
        ),
        Port(
            name="success_rate_estimate",
            shape=(rates,) if rates > 1 else (),
            role=Role.OUTPUT,
            meaning="mean success rate given y[0..k]",
        ),
        Port(
            name="paper_state",
            unit="x",
            shape=(n,),
            role=Role.OUTPUT,
            meaning="(18) as printed: predictions for k with weights given y[0..k]",
        ),
        vector(name="log_weight", shape=(count,), meaning="logarithm of mode_probability"),
    ]
    for name, when in (("mode_", "x(k+1|k)"), ("mode_filtered_", "x(k|k)")):
        ports += [
            vector(
                name=f"{name}state",
                unit="x",
                shape=(count, n),
                meaning=f"{when} under each hypothesis",
            ),
            vector(
                name=f"{name}covariance",
                unit="xx",
                shape=(count, n, n),
                symmetric=True,
                meaning="its error covariance",
            ),
        ]
    return (*ports, *(_deviation_ports(n, random) if any(random) else ()))


def _deviation_ports(n: int, random: list[int]) -> tuple[Port, ...]:
    """What each hypothesis makes of gamma[k], one after the other: sizes differ between them."""
    about = "of gamma[k] minus its mean under each hypothesis, given y[0..k]"
    sizes = {
        "mode_deviation": (sum(random), f"mean {about}"),
        "mode_deviation_covariance": (sum(r * (r + 1) // 2 for r in random), f"covariance {about}"),
        "mode_deviation_cross": (sum(random) * n, f"covariance {about}, with the state"),
    }
    return tuple(
        Port(name=name, shape=(size,), role=Role.STATE, meaning=meaning)
        for name, (size, meaning) in sizes.items()
    )
