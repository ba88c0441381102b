"""Innovation gate: what fits its prediction too badly is left out like a missing row.

Bar-Shalom, Li & Kirubarajan 2001, sec. 5.4: normalised squares of innovations are chi-square
distributed as long as nothing disturbs the plant or its sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca

from fkgen.estimators.gaussian.rank import thresholds
from fkgen.problem import Spec
from fkgen.symbolic.builder import PhaseBuilder
from fkgen.symbolic.index import Index, Whole
from fkgen.symbolic.interface import Kind, Outcome, Port, Status
from fkgen.symbolic.linalg import column
from fkgen.symbolic.ports import shown

#: Between two whole numbers.
HALF = 0.5


@dataclass(frozen=True, slots=True)
class Gate:
    """What normalised squares may be: of one row, or of 1, 2, ... rows together."""

    limits: tuple[float, ...]
    together: bool

    @classmethod
    def of(cls, spec: Spec) -> Gate | None:
        """The gate of a spec, if it has one."""
        probability: float | None = spec.filter.option("gate", None)
        if probability is None:
            return None
        limits = tuple(thresholds(1.0 - probability, spec.model.ny))
        return cls(limits, spec.filter.options.gate_by == "sample")

    def row(
        self,
        builder: PhaseBuilder,
        name: str,
        row: Whole,
        tested: tuple[ca.SX, ca.SX],
        significant: ca.SX | None,
    ) -> tuple[ca.SX, ca.SX]:
        """1 if a row is rejected, and what is positive where it is used.

        ``tested`` are its innovation given the rows before it, and the variance of that.
        """
        innovation, variance = tested
        with builder.if_present(row, significant):
            builder.demand(Kind.POSITIVE, [variance], Status.NOT_POSITIVE_DEFINITE)
        rejected = builder.local(name, 1, initial=0.0)
        if isinstance(row, Index):  # in a loop, where it is that of the row before
            builder.assign({name: ca.SX(0)})
        excess = innovation * innovation - self.limits[0] * variance
        if significant is not None:
            excess = ca.fmin(excess, significant)
        with builder.if_present(row, excess):
            builder.assign({name: ca.SX(1)})
        kept = HALF - rejected
        return rejected, kept if significant is None else ca.fmin(kept, significant)

    def sample(
        self,
        builder: PhaseBuilder,
        nis: ca.SX,
        values: Mapping[str, ca.SX],
        prior: Mapping[str, ca.SX],
    ) -> tuple[list[ca.SX], dict[str, ca.SX]]:
        """1 for every row that is rejected, and values as all rows, or none of them, make them."""
        rows = range(len(self.limits))
        count, limit = (builder.local(name, 1, initial=0.0) for name in ("tested", "limit"))
        kept = {name: builder.local(f"kept_{name}", each.numel()) for name, each in values.items()}
        rejected = [builder.local(f"rejected_{row}", 1, initial=0.0) for row in rows]
        with builder.titled("gate: all rows together"):
            for row in rows:
                with builder.if_present(row):
                    builder.assign({"tested": count + 1})
            for below, value in enumerate(self.limits):
                with builder.if_positive(count - (below + HALF)):
                    builder.assign({"limit": ca.SX(value)})
            builder.assign({f"kept_{name}": ca.vec(ca.densify(v)) for name, v in values.items()})
            with builder.if_positive(nis - limit):
                builder.assign({f"kept_{name}": ca.vec(ca.densify(v)) for name, v in prior.items()})
            for row in rows:
                with builder.if_present(row, nis - limit):
                    builder.assign({f"rejected_{row}": ca.SX(1)})
        shaped = {k: ca.reshape(each, *values[k].shape) for k, each in kept.items()}
        return rejected, shaped


def gate_ports(spec: Spec) -> tuple[Port, ...]:
    """What a gate shows; nothing without one."""
    if spec.filter.option("gate", None) is None:
        return ()
    meaning = "rows of y[k] that the gate left out"
    return (shown("rejected", (spec.model.ny,), meaning, flags=True),)


def gate_outcomes(spec: Spec) -> tuple[Outcome, ...]:
    """The status of a sample of which the gate left out a row."""
    return tuple(Outcome(Status.FAULT_DECLARED, port.name, HALF) for port in gate_ports(spec))


def gate_notes(spec: Spec) -> tuple[str, ...]:
    """What the header says about a gate."""
    probability: float | None = spec.filter.option("gate", None)
    if probability is None:
        return ()
    what = {
        "row": "a row of y is left out whose normalised innovation, given the rows before it,",
        "sample": "a sample is left out whose normalised innovation squared",
    }[spec.filter.options.gate_by]
    return (f"gate: {what} lies outside the probability {probability!r}",)


def gate_results(rejected: Sequence[ca.SX]) -> dict[str, ca.SX]:
    """The port of the gate."""
    return {"rejected": column(list(rejected))} if rejected else {}
