"""Sensors that drift slowly: which rows of y the host filter trusts at once, and which wait."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, Self

from fkgen.problem.covariance import values_nearby
from fkgen.problem.filter import Options
from fkgen.problem.model import Model
from fkgen.problem.signals import Signal, as_rows, read_rows
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section, as_list

#: Longest window, and most rejections in a row: a float counts exactly up to 2^24.
LONGEST_WINDOW = 10_000_000

#: Most groups: every set of accepted groups needs a filter of its own.
MOST_GROUPS = 4

Rows = tuple[int, ...]
Wanted = Literal["some", "any", "optional"]  # Whether the host needs rows, or the key


@dataclass(frozen=True, slots=True)
class SoftFaults:
    """Rows of y of the host filter and of the compression filters: Lee & Lee, eqs. (26), (27).

    The host takes over compressed measurements at samples k > 0 with k mod window = 0.
    """

    host: Rows  # rows of y that the host uses at once, ascending; empty: it only propagates
    groups: tuple[Rows, ...]  # of each compression filter; with the host every row just once
    window: int
    false_alarm: float = 0.05  # Pr(a compression filter without fault is rejected), in (0, 1)

    @property
    def compressed(self) -> Rows:
        """The rows of all groups, ascending."""
        return tuple(sorted(row for group in self.groups for row in group))


def read_soft_faults(
    section: Section, model: Model, _: str, *, host: Wanted = "any", single: bool = False
) -> SoftFaults:
    """The soft faults that a table describes; ``single``: there is one group at most."""
    rows = _host(section, host, model.outputs)
    groups = _groups(section, rows, model.outputs, most=1 if single else MOST_GROUPS)
    expected = f"a whole number of samples, 1 to {LONGEST_WINDOW}, between updates of the host"
    window = section.whole("window", expected, LONGEST_WINDOW)
    expected = "a probability between 0 and 1, both excluded"
    alarm = section.number("false_alarm", expected, lambda number: 0.0 < number < 1.0, 0.05)
    faults = SoftFaults(rows, groups, window, alarm)
    _check_noise(faults, model, section)
    return faults


def _host(section: Section, wanted: Wanted, outputs: Sequence[Signal]) -> Rows:
    if wanted == "optional" and "host" not in section:
        return ()
    hint = "a host that only propagates is compression_full" if wanted == "some" else ""
    rows = read_rows(section, "host", outputs, ", that drift never", hint)
    if len(rows) == len(outputs):
        expected = "at least one row left for the compression filter"
        raise section.error("host", "every row of y", expected)
    return rows


def _groups(
    section: Section, host: Rows, outputs: Sequence[Signal], *, most: int
) -> tuple[Rows, ...]:
    others = tuple(i for i in range(len(outputs)) if i not in host)
    if "groups" not in section:
        return (others,)
    place = section.place.entry("groups")
    expected = "a list of groups of rows, such as [[1], [2, 3]], every row that is not host's once"
    entries = as_list(section.table["groups"], place, expected)
    if not entries:
        raise place.error("an empty list", f"{expected}; leave the key out for one group")
    if len(entries) > most:
        reason = (
            "cpcf has one compression filter; dfcf has one per group"
            if most == 1
            else f"each of the {2 ** len(entries) - 1} sets of accepted groups needs a filter"
        )
        raise place.error(f"{len(entries)} groups", f"at most {most}: {reason}")
    taken = dict.fromkeys(host, "a row of the host")
    groups = []
    for i, entry in enumerate(entries):
        group = as_rows(entry, place.item(i), "a list of rows of y", outputs)
        if not group:
            raise place.item(i).error("an empty group", "at least one row of y")
        for row in group:
            if row in taken:
                expected = "every row once, in host or in a group"
                raise place.item(i).error(f"row {row}, {taken[row]}", expected)
        groups.append(group)
        taken |= dict.fromkeys(group, "in another group too")
    for row in others:
        if row not in taken:
            raise place.error(
                f"groups without row {row} ({outputs[row].name})", "every row in host or a group"
            )
    return tuple(groups)


def _check_noise(faults: SoftFaults, model: Model, section: Section) -> None:
    """Refuse noise that two groups share: Lee & Lee, (27), have a block-diagonal r."""
    label = dict.fromkeys(faults.host, -1)
    label |= {row: at for at, group in enumerate(faults.groups) for row in group}
    for _, R in values_nearby(model.R, section.defaults):
        for i, j in combinations(range(model.ny), 2):
            if label[i] != label[j] and R[j, i] != 0.0:
                raise Place(section.place.file, "model.R").error(
                    f"entry [{j}][{i}] = {float(R[j, i]):.6g} for rows of different filters",
                    "0: noise that host and compression filter (or two groups) share would be"
                    " counted twice; put such rows into one group",
                )


@dataclass(frozen=True, slots=True)
class CompressionOptions(Options):
    """What a compression filter does with its test."""

    test: bool = True  # False reports the statistic and rejects nothing
    #: Rejections in a row from which on the host is inflated; None: never
    reacquire: int | None = None

    @classmethod
    def read(cls, section: Section, _: object, __: Model) -> Self:
        """The test, and what follows from rejections."""
        test = section.flag("test", default=True)
        if "reacquire" not in section:
            return cls(test)
        what = "rejections in a row (leave it out for never)"
        limit = section.count("reacquire", 1, LONGEST_WINDOW, what)
        if not test:
            given = "reacquire with test = false"
            raise section.error("reacquire", given, "a test: without it nothing is rejected")
        return cls(test, limit)
