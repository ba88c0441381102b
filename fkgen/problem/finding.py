"""One thing worth knowing about a model and its filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing worth knowing about a model.

    Attributes
    ----------
    code : str
        Its name, for programs.
    severity : str
        ``"error"``: the filter would not do its work; ``"warning"``: probably not what was meant;
        ``"note"``.
    message : str
        What was found.
    value : float or None
        The number behind it, where there is one.
    remedy : str
        How to mend it; empty for most notes.
    """

    code: str
    severity: Severity
    message: str
    value: float | None = None
    remedy: str = ""
