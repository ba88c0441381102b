"""What a check says: findings and values."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field

from fkgen.problem.finding import Finding, Severity
from fkgen.study.reports.jsonable import finite_or_none

__all__ = ["Finding", "Part", "Report", "Severity", "combined"]

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
            asdict(f) | {"value": None if f.value is None else finite_or_none(f.value)}
            for f in self.findings
        ]
        values = {name: finite_or_none(value) for name, value in self.values.items()}
        return json.dumps({"sound": self.sound, "findings": findings, "values": values}, indent=2)


@dataclass(frozen=True, slots=True)
class Part:
    """What one examination contributes to a report."""

    findings: tuple[Finding, ...] = ()
    values: dict[str, float] = field(default_factory=dict)


def combined(parts: list[Part]) -> Report:
    """All parts as one report, the worst findings first."""
    findings = [finding for part in parts for finding in part.findings]
    findings.sort(key=lambda finding: _ORDER.index(finding.severity))
    values = {name: value for part in parts for name, value in part.values.items()}
    return Report(tuple(findings), values)
