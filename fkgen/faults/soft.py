"""Sensors that drift slowly: which rows of y the host filter trusts at once, and which wait."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Self

from fkgen.problem.covariance import nearby
from fkgen.problem.filter import Options
from fkgen.problem.model import Model
from fkgen.problem.signals import Signal, read_rows
from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_list, as_number

#: Longest window: a float counts samples exactly up to 2^24.
LONGEST_WINDOW = 10_000_000

#: Most groups: every set of accepted groups needs a filter of its own.
MOST_GROUPS = 4

Rows = tuple[int, ...]


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

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        return {
            "host": list(self.host),
            "window": self.window,
            "false_alarm": self.false_alarm,
            "groups": [list(group) for group in self.groups],
        }


def read_soft_faults(
    table: object,
    place: Place,
    defaults: Mapping[str, float],
    model: Model,
    _: str,
    *,
    host: Literal["some", "any", "optional"] = "any",
    single: bool = False,
) -> SoftFaults:
    """The soft faults that a table describes.

    ``host``: whether the host needs rows, or the key; ``single``: there is one group at most.
    """
    section = Section(table, place, known=("host", "window", "false_alarm", "groups"))
    rows = _host(section, host, model.outputs)
    groups = _groups(section, rows, model.outputs, most=1 if single else MOST_GROUPS)
    faults = SoftFaults(rows, groups, _window(section), _false_alarm(section))
    _check_noise(faults, model, place, defaults)
    return faults


def _host(section: Section, wanted: str, outputs: Sequence[Signal]) -> Rows:
    place = section.place.entry("host")
    names = [signal.name for signal in outputs]
    choice = f"0..{len(names) - 1} ({', '.join(names)})"
    expected = f"a list of rows of y, out of {choice}, that drift never"
    if wanted == "optional" and "host" not in section:
        return ()
    rows = read_rows(section.require("host", expected), place, expected, names)
    if not rows and wanted == "some":
        raise place.error(
            "an empty list", f"{expected}; a host that only propagates is compression_full"
        )
    if len(rows) == len(outputs):
        raise place.error("every row of y", "at least one row left for the compression filter")
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
        groups.append(_group(entry, place.item(i), taken, outputs))
        taken |= dict.fromkeys(groups[-1], "in another group too")
    for row in others:
        if row not in taken:
            raise place.error(
                f"groups without row {row} ({outputs[row].name})", "every row in host or a group"
            )
    return tuple(groups)


def _group(
    entry: object, place: Place, taken: Mapping[int, str], outputs: Sequence[Signal]
) -> Rows:
    names = [signal.name for signal in outputs]
    group = read_rows(entry, place, "a list of rows of y", names)
    if not group:
        raise place.error("an empty group", "at least one row of y")
    for row in group:
        if row in taken:
            raise place.error(f"row {row}, {taken[row]}", "every row once, in host or in a group")
    return group


def _window(section: Section) -> int:
    place = section.place.entry("window")
    expected = f"a whole number of samples, 1 to {LONGEST_WINDOW}, between updates of the host"
    number = as_number(section.require("window", expected), place, expected)
    if number != int(number) or not 1 <= number <= LONGEST_WINDOW:
        raise place.error(show(number), expected)
    return int(number)


def _false_alarm(section: Section) -> float:
    place = section.place.entry("false_alarm")
    expected = "a probability between 0 and 1, both excluded"
    number = as_number(section.table.get("false_alarm", 0.05), place, expected)
    if not 0.0 < number < 1.0:
        raise place.error(show(number), expected)
    return number


def _check_noise(
    faults: SoftFaults, model: Model, place: Place, defaults: Mapping[str, float]
) -> None:
    """Refuse noise that two groups share: Lee & Lee, (27), have a block-diagonal r."""
    label = dict.fromkeys(faults.host, -1)
    label |= {row: at for at, group in enumerate(faults.groups) for row in group}
    where = Place(place.file).entry("model").entry("R")
    for point in [defaults] if model.R.is_constant else nearby(defaults):
        try:
            R = model.R.values(point)
        except ArithmeticError:  # outside the domain of an entry: this point says nothing
            continue
        for i in range(model.ny):
            for j in range(i):
                if label[i] != label[j] and R[i, j] != 0.0:
                    raise where.error(
                        f"entry [{i}][{j}] = {float(R[i, j]):.6g} for rows of different filters",
                        "0: noise that host and compression filter (or two groups) share would be"
                        " counted twice; put such rows into one group",
                    )


#: A float counts exactly up to 2^24.
MOST_REJECTIONS = 10_000_000


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
        limit = section.count("reacquire", 1, MOST_REJECTIONS, what)
        if not test:
            raise section.place.entry("reacquire").error(
                "reacquire with test = false", "a test: without it nothing is rejected"
            )
        return cls(test, limit)
