"""What a check says: findings and values."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field

from fkgen.problem.finding import Finding, Severity
from fkgen.study.reports.jsonable import finite_or_none

_ORDER: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True, slots=True)
class Report:
    """What a check found, worst first.

    Attributes
    ----------
    findings : tuple of Finding
    values : dict of str to float
        What was computed, at the default parameters: ``spectral_radius``, ``observability_rank``,
        ``closed_loop_radius``, ``stationary_sd.<state>`` ...
    """

    findings: tuple[Finding, ...]
    values: dict[str, float] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether there is no error."""
        return not any(finding.severity == "error" for finding in self.findings)

    def to_json(self) -> str:
        """Findings and values as JSON; a number that is not finite becomes null."""
        findings = [
            asdict(f) | {"value": None if f.value is None else float(f.value)}
            for f in self.findings
        ]
        facts = {"sound": self.sound, "findings": findings, "values": self.values}
        return json.dumps(finite_or_none(facts), indent=2)


@dataclass(slots=True)
class ReportBuilder:
    """Takes what each diagnostic finds and computes."""

    findings: list[Finding] = field(default_factory=list)
    values: dict[str, float] = field(default_factory=dict)

    def note(self, code: str, message: str, value: float | None = None, remedy: str = "") -> None:
        """Add something that is good to know."""
        self.findings.append(Finding(code, "note", message, value, remedy))

    def warning(self, code: str, message: str, value: float | None, remedy: str) -> None:
        """Add something that is probably not what was meant."""
        self.findings.append(Finding(code, "warning", message, value, remedy))

    def error(self, code: str, message: str, value: float | None, remedy: str) -> None:
        """Add something that keeps the filter from its work."""
        self.findings.append(Finding(code, "error", message, value, remedy))

    def rank(self, rank: int, rows: int, where: str = "") -> None:
        """Warn if the innovation covariance does not have full rank."""
        if rank < rows:
            message = (
                f"the innovation covariance has rank {rank} of {rows}{where}: some rows of y "
                "follow exactly from the others, and are left out by a decision on rank"
            )
            remedy = "give every measurement some noise, at least that of its last digit"
            self.warning("innovation_rank", message, rank, remedy)

    def report(self) -> Report:
        """All of it, the worst findings first."""
        worst_first = sorted(self.findings, key=lambda finding: _ORDER.index(finding.severity))
        return Report(tuple(worst_first), self.values)
