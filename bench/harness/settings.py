"""What every measurement needs to know."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Settings:
    """How to measure.

    Attributes
    ----------
    folder : Path
        For generated and compiled files.
    rounds : int
        How often all contenders take their turn, at least.
    seconds : float
        How long they do so, at least: a neighbour's bursts have to end in between.
    callgrind : bool
        Count instructions too.
    """

    folder: Path
    rounds: int
    seconds: float
    callgrind: bool

    @property
    def compilers(self) -> tuple[str, ...]:
        """Those that are installed."""
        return tuple(cc for cc in ("gcc", "clang") if shutil.which(cc))
