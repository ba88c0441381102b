"""One line about a filtered record: what there was, what was used, and how well it fits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fkgen.problem import Spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.results import Run
from fkgen.study.records.record import Table
from fkgen.symbolic.interface import VERDICTS

_VERDICTS = [status.value for status in VERDICTS]


class Summary:
    """Counts over the pieces of a record."""

    def __init__(self, spec: Spec, built: CompiledFilter) -> None:
        soft = spec.faults.soft
        self._host: slice | list[int] = slice(None) if soft is None else list(soft.host)
        self._gated = "rejected" in built.ports
        self._ports = ["nis", *(["rejected"] if self._gated else [])]
        self.ports = tuple(name for name in self._ports if name in built.ports)
        self.samples = self.rows = self.present = self.gaps = self.rejected = 0
        self.refused = self.held = 0
        self._degrees, self._sum, self._silent = 0, 0.0, False
        self._longest = self._length = 0

    def add(self, table: Table, run: Run) -> None:
        """Count a piece."""
        there = np.isfinite(table.y)
        accepted = run.status >= 0
        rejected = np.isin(run.status, _VERDICTS)
        out = np.zeros(there.shape, bool)
        if self._gated:
            out = (np.asarray(run["rejected"]).reshape(there.shape) > 0) & there
        elif rejected.any():
            out[rejected] = there[rejected]
            if isinstance(self._host, list):  # it is the others that wait for the test
                out[:, self._host] = False
        used = there & accepted[:, np.newaxis] & ~out
        self.samples += len(there)
        self.rows += there.size
        self.present += int(used.sum())
        self.refused += int((~accepted).sum())
        self.held += int(run.held.sum())
        self.rejected += int(out.any(axis=1).sum() if self._gated else rejected.sum())
        self._count_gaps(np.asarray(~there.any(axis=1)))
        if "nis" in self.ports:
            counted = (run.status == 0) | (accepted & out.any(axis=1) & self._gated)
            degrees, nis = used[:, self._host].sum(axis=1), run["nis"]
            counted &= (degrees > 0) & np.isfinite(nis)
            self._degrees += int(degrees[counted].sum())
            self._sum += float(nis[counted].sum())

    def _count_gaps(self, silent: NDArray[np.bool_]) -> None:
        """Stretches of samples without a single row."""
        edges = np.diff(silent.astype(np.int8), prepend=np.int8(self._silent))
        starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
        self.gaps += len(starts)
        opened = -self._length if self._silent else None
        begins = starts.tolist() if opened is None else [opened, *starts.tolist()]
        stops = [*ends.tolist(), len(silent)][: len(begins)]
        lengths = [stop - start for start, stop in zip(begins, stops, strict=True)]
        self._longest = max([self._longest, *lengths])
        self._silent = bool(silent[-1])
        self._length = lengths[-1] if self._silent else 0

    def text(self, file: str) -> str:
        """The line."""
        gaps = _several(self.gaps, "gap")
        longest = f" (the longest of {_several(self._longest, 'sample')})" if self.gaps else ""
        parts = [
            _several(self.samples, "sample"),
            f"{self.present} of {_several(self.rows, 'row')} used",
            gaps + longest,
            f"{self.refused} refused" + (f" ({self.held} of them held)" if self.held else ""),
            f"{self.rejected} rejected",
        ]
        if self._degrees:
            rms = math.sqrt(self._sum / self._degrees)
            parts.append(f"rms of normalised innovations {rms:.3g} (1 where the model is right)")
        return f"{file}: {', '.join(parts)}"


def _several(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
