"""The sums of a campaign in a file: where it goes on after whatever stopped it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fkgen.errors import DataError
from fkgen.runtime import cache
from fkgen.study.campaigns.block import Work
from fkgen.study.campaigns.sums import Sums, merged
from fkgen.study.records.files import refuse_existing, write_whole

_KIND = "checkpoint of fkgen montecarlo"
_EVERY = 5.0  # seconds between two writings


@dataclass(slots=True, eq=False)
class Ledger:
    """Which blocks are done, and their sums: whole blocks alone, in any order."""

    done: set[range] = field(default_factory=set)  # disjoint, none next to another
    sums: Sums | None = None
    kept: list[Sums] = field(default_factory=list)  # not merged yet

    def add(self, blocks: range, sums: Sums) -> None:
        """Take in a range of blocks."""
        self.done = set(_joined([*self.done, blocks]))
        self.kept.append(sums)
        if len(self.kept) >= 32:
            self.total()

    def total(self) -> Sums | None:
        """The sums of all blocks that are done."""
        whole = [*([] if self.sums is None else [self.sums]), *self.kept]
        self.sums = merged(whole) if whole else None
        self.kept = []
        return self.sums

    def missing(self, stop: int) -> list[range]:
        """Ranges of blocks below ``stop`` that are not done."""
        at, found = 0, list[range]()
        for each in sorted(self.done, key=lambda one: one.start):
            found.append(range(at, min(each.start, stop)))
            at = each.stop
        return [each for each in (*found, range(at, stop)) if each]

    @property
    def blocks(self) -> int:
        """How many are done."""
        return sum(map(len, self.done))


def _joined(ranges: Iterable[range]) -> list[range]:
    """Disjoint ranges, those next to each other in one."""
    found = list[range]()
    for each in sorted(ranges, key=lambda one: one.start):
        if found and found[-1].stop == each.start:
            found[-1] = range(found[-1].start, each.stop)
        else:
            found.append(each)
    return found


class Checkpoint:
    """A file that holds a ledger, or none where no name is given.

    Raises
    ------
    DataError
        If the file is none of these, or about something else; it stays as it is.
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path | None, work: Work) -> None:
        self.path, self._facts = path, _facts(work)
        self._written = -_EVERY  # the first time at once: whether it can be written shows early
        self.ledger = Ledger()
        if path is not None:
            refuse_existing(path, force=True)
            if path.exists():
                self.ledger = self._read(path, work)

    def add(self, blocks: range, sums: Sums) -> None:
        """Take in a range of blocks, and write now and then."""
        self.ledger.add(blocks, sums)
        if time.monotonic() - self._written > _EVERY:
            self.write()

    def write(self) -> None:
        """Write the file anew, in one step."""
        if self.path is None:
            return
        sums = self.ledger.total()
        state: dict[str, Any] = {"done": []}  # as long as no block is whole
        if sums is not None:
            state = {
                "done": sorted((each.start, each.stop) for each in self.ledger.done),
                "trials": sums.trials,
                "shapes": {name: list(shape) for name, shape in sums.shapes.items()},
                "sums": sums.parts.tolist(),
            }
        text = json.dumps({"kind": _KIND, **self._facts, **state})
        write_whole(self.path, text.encode(), force=True)
        self._written = time.monotonic()

    def _read(self, path: Path, work: Work) -> Ledger:
        try:
            found: Any = json.loads(path.read_bytes())
            if found["kind"] != _KIND:
                raise KeyError  # noqa: TRY301 - told below
            facts, done, sums = {"version": found["version"]}, set[range](), None
            if facts["version"] == self._facts["version"]:  # another one may hold other things
                facts = {key: found[key] for key in self._facts}
                done = {range(*each) for each in found["done"]}
                sums = _sums(found) if done else None
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            given = "a file that is no checkpoint, or one that cannot be read; it stays as it is"
            expected = f"a {_KIND}, or the name of a new file"
            raise DataError(str(path), given=given, expected=expected) from None
        self._compare(path, facts)
        most = work.trials // work.size
        if sums is not None and any(each.stop > most for each in done):
            given = f"{sums.trials} trials in it, and {work.trials} wanted"
            raise DataError(str(path), given=given, expected="at least as many trials as before")
        return Ledger(done, sums)

    def _compare(self, path: Path, facts: Mapping[str, Any]) -> None:
        for key, own in self._facts.items():
            if facts[key] != own:
                shown = (facts[key], own) if key in _SHOWN else ("another one", "this one")
                given, expected = f"a checkpoint with {key} {shown[0]}", f"{key} {shown[1]}"
                raise DataError(str(path), given=given, expected=f"{expected}, or a new file")


def _sums(found: Mapping[str, Any]) -> Sums:
    shapes = {name: tuple(shape) for name, shape in found["shapes"].items()}
    return Sums(found["trials"], shapes, np.array(found["sums"], np.float64))


#: Facts whose values are worth saying.
_SHOWN = ("version", "seed", "steps", "name")


def _facts(work: Work) -> dict[str, Any]:
    """What has to be the same for sums to go together."""
    drawing, request = work.drawing, work.drawing.request
    signals = (drawing.told, *drawing.params.values(), *work.params.values())
    names = (*drawing.params, *work.params)
    return {
        "version": cache.identity(),
        "name": work.spec.name,
        "spec": cache.key_of(work.spec.canonical()),
        "truth": cache.key_of(request.spec.canonical()),
        "seed": request.seed,
        "steps": request.steps,
        "inputs and parameters": cache.key_of(*names, *(each.tobytes().hex() for each in signals)),
        "block": work.size,
    }
