"""What was proved of a filter, with every error, tolerance, seed and version, for an assessor."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from fkgen.backend.lower import digest_of
from fkgen.problem import Spec
from fkgen.proof import agreement, eva, records, verify
from fkgen.proof.verify import Step
from fkgen.study.reports.jsonable import json_text
from fkgen.symbolic.validated import Claim
from fkgen.target.verify import Figures
from fkgen.target.verify import steps as on_targets
from fkgen.version import __version__

#: Libraries that compute, compile or emulate.
_LIBRARIES = ("casadi", "numpy", "scipy", "sympy", "control", "ziglang", "unicorn")

#: Headings of the table of figures.
FIGURES = ("target", "compiler", "instructions per step", "flash", "RAM", "stack")


@dataclass(frozen=True, slots=True)
class Evidence:
    """Claims as they are tried, and figures of targets."""

    spec: Spec
    targets: tuple[str, ...] = ()
    prove: bool = False
    claims: list[Claim] = field(default_factory=list)
    figures: list[Figures] = field(default_factory=list)

    def steps(self) -> tuple[Step, ...]:
        """What there is to do: on targets and by static analysis if asked for, else here."""
        proof = eva.steps(self.spec) if self.prove else ()
        if self.targets:
            return *proof, *on_targets(self.spec, self.targets, self.figures)
        return proof or verify.steps(self.spec)

    def take(self, step: Step) -> None:
        """Do one step."""
        self.claims.extend(step.run())

    @property
    def failed(self) -> int:
        """How many claims do not hold."""
        return sum(not claim.holds for claim in self.claims)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """A table of figures."""
        return [
            (
                each.target,
                each.compiler,
                f"{each.instructions_min} to {each.instructions_max}",
                *(f"{size} B" for size in (each.flash, each.ram, each.stack)),
            )
            for each in self.figures
        ]

    def to_json(self) -> str:
        """Everything, for programs and archives; an error that is no number is null."""
        spec = self.spec
        facts: dict[str, Any] = {
            "name": spec.name,
            "family": spec.filter.family,
            "scalar": spec.code.scalar,
            "spec": digest_of(spec),
            "holds": not self.failed,
            "claims": [{**asdict(claim), "holds": claim.holds} for claim in self.claims],
            "targets": [asdict(each) for each in self.figures],
            "seeds": {"closed forms": records.SEED, "compiled code": agreement.SEED},
            "versions": _versions(),
        }
        return json_text(facts)


def told(names: Sequence[str]) -> tuple[str, ...]:
    """Names of targets, each of which may be several with commas between them."""
    return tuple(name.strip() for each in names for name in each.split(","))


def _versions() -> dict[str, str]:
    """What took part, as far as it is installed."""
    found = {"fkgen": __version__, "python": platform.python_version()}
    found |= {"machine": f"{platform.system()} {platform.machine()}"}
    for name in _LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
