"""A plant that jumps between modes, each with matrices of its own, and whose samples may be lost.

Mode and sample go together: mode[k] drives y[k] and the step from x[k] to x[k+1].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from fkgen.faults.chain import LETTERS, Channel, Mode, ModeChain
from fkgen.problem.covariance import checked_covariance
from fkgen.problem.model import Model, component
from fkgen.problem.probability import (
    Distribution,
    as_distribution,
    as_probability,
    as_transition,
    stationary_law,
)
from fkgen.problem.table.matrix import Role, read_entry, read_matrix
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section, as_list
from fkgen.problem.text.expression import Expression, Name, operation, total
from fkgen.problem.text.matrix import Matrix

Arrival = Literal["always", "known", "unknown"]

_ARRIVALS: tuple[Arrival, ...] = ("always", "known", "unknown")
_ARRIVAL_KEYS = ("arrival", "arrival_rate", "arrival_chain")
_ORDER = "(lost, arrived)"

#: Parameter of a filter that is told the mode.
INDICATOR = "in_mode_{}"


@dataclass(frozen=True, slots=True)
class JumpFaults:
    """N modes, their chain, and the channel on which samples are lost.

    A lost sample is y = v: noise without signal. A row of y that is NaN is missing, which the
    filter knows. Of the channel it knows that every sample arrives (``"always"``), what was lost
    (``"known"``: NaN), or probabilities alone (``"unknown"``).
    """

    transition: tuple[Distribution, ...]  # Pr(mode at k+1 is j | mode at k is i)
    initial: Distribution  # at sample 0
    modes: tuple[Mode, ...]
    arrival: Arrival = "always"
    arrival_rate: float | None = None  # Pr(a sample holds a signal), independent
    arrival_chain: tuple[Distribution, ...] = ()  # in place of the rate, (lost, arrived)

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {
            "transition": [list(row) for row in self.transition],
            "initial": list(self.initial),
            "modes": [mode.plain() for mode in self.modes],
        }
        if self.arrival != "always" or self.has_channel:
            table["arrival"] = self.arrival
        if self.arrival_rate is not None:
            table["arrival_rate"] = self.arrival_rate
        if self.arrival_chain:
            table["arrival_chain"] = [list(row) for row in self.arrival_chain]
        return table

    def chain(self, model: Model) -> ModeChain:
        """Every mode is a plant of its own; losses are apart, see `channel`."""
        modes = tuple(replace(mode, title=_title(mode, model)) for mode in self.modes)
        return ModeChain(modes, self.transition, self.initial)

    def told(self) -> Mode:
        """The plant of one who is told the mode: parameters are 1 in it and 0 in the others."""
        indicators = [Name(INDICATOR.format(i)) for i in range(len(self.modes))]

        def entry(*values: Expression) -> Expression:
            terms = [operation("*", *each) for each in zip(indicators, values, strict=True)]
            return values[0] if len(set(values)) == 1 else total(terms)

        def chosen(matrices: list[Matrix]) -> Matrix:
            rows = zip(*(matrix.rows for matrix in matrices), strict=True)
            return Matrix(tuple(tuple(map(entry, *each)) for each in rows))

        told = {
            letter: chosen([getattr(mode, letter) for mode in self.modes]) for letter in LETTERS
        }
        return replace(self.modes[0], title="", **told)

    @property
    def channel(self) -> Channel | None:
        """How samples are lost; None if nothing is said."""
        if self.arrival_rate is not None:
            return Channel.of([[1.0 - self.arrival_rate, self.arrival_rate]] * 2)
        return Channel.of(self.arrival_chain) if self.arrival_chain else None

    @property
    def has_channel(self) -> bool:
        """Whether something is said about how often samples are lost."""
        return self.arrival_rate is not None or bool(self.arrival_chain)


def _title(mode: Mode, model: Model) -> str:
    """What tells a mode from the model."""
    own = [letter for letter in "ABCDQR" if getattr(mode, letter) != getattr(model, letter)]
    own += ["c"] if mode.c != Matrix.zeros(model.nx, 1) else []
    return "with its own " + ", ".join(own) if own else "the model"


def read_jump_faults(
    table: object,
    place: Place,
    defaults: Mapping[str, float],
    model: Model,
    family: str,
    *,
    arrivals: bool = False,
) -> JumpFaults:
    """The jump faults that a table describes; ``arrivals``: the family knows of lost samples."""
    section = Section(table, place, known=("transition", "initial", "modes", *_ARRIVAL_KEYS))
    if not arrivals:
        for key in _ARRIVAL_KEYS:
            if key in section:
                raise place.entry(key).error(
                    f"{key} for the family {family}",
                    "no key about arrivals: they are for mjls_lmmse; write the loss of samples as"
                    " modes with C = 0",
                )
    modes = _modes(section, defaults, model)
    transition, initial = _chain(section, len(modes))
    rate, chain = _channel(section)
    arrival = _arrival(section, has_channel=rate is not None or bool(chain))
    return JumpFaults(transition, initial, modes, arrival, rate, chain)


def _modes(section: Section, defaults: Mapping[str, float], model: Model) -> tuple[Mode, ...]:
    place = section.place.entry("modes")
    expected = "a list of modes, each a table of the matrices in which it differs from the model"
    entries = as_list(section.require("modes", expected), place, expected)
    if not entries:
        raise place.error("an empty list", expected)
    return tuple(
        _Mode(entry, place.item(i), defaults, model).mode() for i, entry in enumerate(entries)
    )


class _Mode:
    """Reads one entry of ``modes``."""

    def __init__(
        self, entry: object, place: Place, defaults: Mapping[str, float], model: Model
    ) -> None:
        self.section = Section(entry, place, known=("A", "B", "C", "D", "Q", "R", "c"))
        self.place, self.defaults, self.model = place, defaults, model

    def mode(self) -> Mode:
        """The matrices of the mode."""
        if not self.model.nu:
            for key in ("B", "D"):
                if key in self.section:
                    raise self.place.entry(key).error(
                        f"{key} where model.B is missing",
                        "model.B first (zeros will do): it says how many inputs there are",
                    )
        return Mode(
            A=self.matrix("A"),
            B=self.matrix("B"),
            C=self.matrix("C"),
            D=self.matrix("D"),
            Q=self.covariance("Q"),
            R=self.covariance("R"),
            c=self.offset(),
        )

    def matrix(self, key: str) -> Matrix:
        """The matrix of the mode, of the size of the model's, or that one."""
        own: Matrix = getattr(self.model, key)
        if key not in self.section:
            return own
        role = Role(
            *own.shape, f"all modes share the states, inputs and rows of y; so is model.{key}"
        )
        return read_matrix(self.section.table[key], self.place.entry(key), role, self.defaults)

    def covariance(self, key: str) -> Matrix:
        """The same for a covariance."""
        matrix = self.matrix(key)
        if key not in self.section:
            return matrix
        return checked_covariance(matrix, self.place.entry(key), self.defaults)

    def offset(self) -> Matrix:
        """The known offset, zero if there is none."""
        n, place = self.model.nx, self.place.entry("c")
        if "c" not in self.section:
            return Matrix.zeros(n, 1)
        expected = f"a list of {n} numbers or expressions: the state has {n} components"
        entries = as_list(self.section.table["c"], place, expected)
        if len(entries) != n:
            raise place.error(f"{len(entries)} entries", expected)
        return Matrix(
            tuple(
                (read_entry(component(entry, place.item(i)), place.item(i), self.defaults),)
                for i, entry in enumerate(entries)
            )
        )


def _chain(section: Section, count: int) -> tuple[tuple[Distribution, ...], Distribution]:
    """Transition matrix, and the law of the first mode: the stationary one if it is not said."""
    order = "as the modes are"
    place = section.place.entry("transition")
    given = section.require("transition", f"a {count} x {count} matrix, one row per mode")
    transition = as_transition(given, place, order, count)
    place = section.place.entry("initial")
    if "initial" in section:
        law = as_distribution(section.table["initial"], place, count, "one per mode")
        return transition, law
    stationary = stationary_law(transition)
    if stationary is None:
        raise place.error(
            "nothing (the key is missing), and several stationary laws",
            f"{count} probabilities, one per mode: where the chain starts decides where it stays",
        )
    return transition, tuple(stationary.tolist())


def _channel(section: Section) -> tuple[float | None, tuple[Distribution, ...]]:
    """Rate or chain of the arrivals, whichever is there."""
    rate = None
    if "arrival_rate" in section:
        place = section.place.entry("arrival_rate")
        rate = as_probability(section.table["arrival_rate"], place)
    if "arrival_chain" not in section:
        return rate, ()
    place = section.place.entry("arrival_chain")
    if rate is not None:
        raise place.error("arrival_chain beside arrival_rate", "one of the two")
    chain = as_transition(section.table["arrival_chain"], place, _ORDER, 2)
    if stationary_law(chain) is None:
        raise place.error(
            "a chain that never changes, so that it has several stationary laws",
            f"a chain with one: its law, ordered {_ORDER}, is that of the first sample",
        )
    return None, chain


def _arrival(section: Section, *, has_channel: bool) -> Arrival:
    """What the filter makes of the channel: it is unknown what was lost, unless it is said."""
    default: Arrival = "unknown" if has_channel else "always"
    arrival = section.choice("arrival", _ARRIVALS, default)
    if arrival == "unknown" and not has_channel:
        raise section.place.entry("arrival_rate").error(
            "nothing (the key is missing) with arrival = 'unknown'",
            "arrival_rate = Pr(a sample holds a signal), or arrival_chain",
        )
    return arrival
