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

#: Times the usual pause between rows of y is a gap: two samples lost in a row, not one.
GAP = 2.5
_USUAL = 100_000  # pauses that say what is usual

Array = NDArray[np.float64]

_VERDICTS = [status.value for status in VERDICTS]


class Summary:
    """Counts over the pieces of a record."""

    def __init__(self, spec: Spec, built: CompiledFilter) -> None:
        soft = spec.faults.soft
        self._host: slice | list[int] = slice(None) if soft is None else list(soft.host)
        self._gated = "rejected" in built.ports
        self._ports = ["nis", *(["rejected"] if self._gated else [])]
        self.ports = tuple(name for name in self._ports if name in built.ports)
        self.samples = self.rows = self.present = self.rejected = 0
        self.refused = self.held = 0
        self._degrees, self._sum, self._pauses = 0, 0.0, _Pauses()
        self._timed = False

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
        self._pauses.add(table.time, np.asarray(there.any(axis=1)))
        self._timed = bool(table.time_name)
        if "nis" in self.ports:
            counted = (run.status == 0) | (accepted & out.any(axis=1) & self._gated)
            degrees, nis = used[:, self._host].sum(axis=1), run["nis"]
            counted &= (degrees > 0) & np.isfinite(nis)
            self._degrees += int(degrees[counted].sum())
            self._sum += float(nis[counted].sum())

    def text(self, file: str) -> str:
        """The line."""
        count, longest = self._pauses.gaps()
        size = f"{longest:.6g} s" if self._timed else several(round(longest), "sample")
        parts = [
            several(self.samples, "sample"),
            f"{self.present} of {several(self.rows, 'row')} used",
            several(count, "gap") + (f" (the longest of {size})" if count else ""),
            f"{self.refused} refused" + (f" ({self.held} of them held)" if self.held else ""),
            f"{self.rejected} rejected",
        ]
        if self._degrees:
            rms = math.sqrt(self._sum / self._degrees)
            parts.append(f"rms of normalised innovations {rms:.3g} (1 where the model is right)")
        return f"{file}: {', '.join(parts)}"


class _Pauses:
    """Times from one row of y to the next, over the pieces of a record."""

    def __init__(self) -> None:
        self._heard = self._time = np.nan  # The last time with a row, and the last one
        self._kept: list[Array] = []
        self._steps: list[Array] = []
        self._counted, self._usual, self._most, self._longest = 0, np.nan, 0, 0.0

    def add(self, time: Array, heard: NDArray[np.bool_]) -> None:
        """Go on with a piece."""
        before = time[:1] if np.isnan(self._time) else np.array([self._heard])
        ends = np.concatenate([before, time[heard]])
        if np.isnan(self._usual):
            self._steps.append(np.diff(time, prepend=self._time))
        self._heard, self._time = float(ends[-1]), float(time[-1])
        self._count(np.diff(ends))

    def gaps(self) -> tuple[int, float]:
        """How many pauses are above `GAP` times the usual one, and the longest of them."""
        self._settle()
        tail = self._time - self._heard
        over = tail > GAP * self._usual
        return self._counted + int(over), max(self._longest, tail if over else 0.0)

    def _count(self, pauses: Array) -> None:
        if np.isnan(self._usual):
            self._kept.append(pauses)
            self._most += len(pauses)
            if self._most > _USUAL:
                self._settle()
            return
        long = pauses[pauses > GAP * self._usual]
        self._counted += len(long)
        self._longest = max([self._longest, *long.tolist()])

    def _settle(self) -> None:
        """Say from the first pauses what is usual, and count those that are not."""
        if not np.isnan(self._usual):
            return
        pauses, steps = np.concatenate(self._kept), np.concatenate(self._steps)
        self._usual = usual_pause(pauses[1:], steps[np.isfinite(steps)])
        self._count(pauses)
        self._kept, self._steps = [], []


def usual_pause(pauses: Array, steps: Array) -> float:
    """The usual time from a row of y to the next: some sensors report now and then."""
    return max([0.0, *(float(np.median(each)) for each in (pauses, steps) if each.size)])


def several(count: int, noun: str) -> str:
    """A count and what is counted."""
    return f"{count} {noun}{'' if count == 1 else 'es' if noun.endswith('ch') else 's'}"
