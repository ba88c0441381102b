"""A plant that jumps between modes, each with matrices of its own, and whose samples may be lost.

Mode and sample go together: mode[k] drives y[k] and the step from x[k] to x[k+1].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from fkgen.faults.chain import LETTERS, Channel, Mode, ModeChain
from fkgen.problem.equations import ABSENCE
from fkgen.problem.functions import affine, modes
from fkgen.problem.functions.finite import check_start
from fkgen.problem.functions.named import Named
from fkgen.problem.model import Model, discretised, offset
from fkgen.problem.probability import (
    Distribution,
    FirstLaw,
    Transition,
    as_rate,
    at_defaults,
    read_initial,
    read_transition,
    rows_of,
    stationary_law,
)
from fkgen.problem.table.place import show
from fkgen.problem.table.section import Section, as_list
from fkgen.problem.text.discretise import OF_TIME
from fkgen.problem.text.expression import (
    ZERO,
    Expression,
    Name,
    Number,
    Scope,
    evaluate,
    operation,
    total,
)
from fkgen.problem.text.matrix import Matrix, plain, plain_fields

Arrival = Literal["always", "known", "unknown"]

_ARRIVAL_KEYS = ("arrival", "arrival_rate", "arrival_chain")
KEYS = ("transition", "initial", "modes", *_ARRIVAL_KEYS)
_ORDER = "(lost, arrived)"

#: Parameters of a filter that is told the mode: of the sample, and, where modes have states of
#: their own, of the step that leads into the next one.
INDICATOR, ENTERED = "in_mode_{}", "into_mode_{}"


@dataclass(frozen=True, slots=True)
class JumpFaults:
    """N modes, their chain, and the channel on which samples are lost.

    A lost sample is y = v: noise without signal. A row of y that is NaN is missing, which the
    filter knows. Of the channel it knows that every sample arrives (``"always"``), what was lost
    (``"known"``: NaN), or probabilities alone (``"unknown"``).
    """

    transition: Transition  # Pr(mode at k+1 is j | mode at k is i)
    initial: Distribution  # at sample 0
    modes: tuple[Mode, ...]
    arrival: Arrival = "always"
    arrival_rate: float | None = None  # Pr(a sample holds a signal), independent
    arrival_chain: Transition = ()  # in place of the rate, (lost, arrived)
    #: transition, arrival_rate, arrival_chain and initial as they depend on parameters, where they
    #: do; the numbers above are those at the defaults
    law: Matrix | None = None
    rate: Expression | None = None
    arrivals: Matrix | None = None
    first: FirstLaw | None = None

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table = {key: value for key, value in plain_fields(self).items() if value != []}
        table |= {"transition": table.pop("law")} if "law" in table else {}
        table |= {"arrival_rate": table.pop("rate")} if "rate" in table else {}
        table |= {"arrival_chain": table.pop("arrivals")} if "arrivals" in table else {}
        if self.first is not None:
            del table["first"], table["initial"]
            table |= {"initial": plain(self.first.stated)} if self.first.stated else {}
        if self.arrival == "always" and not self.has_channel:
            del table["arrival"]
        return table

    def chain(self, model: Model) -> ModeChain:
        """Every mode is a plant of its own; losses are apart, see `channel`."""
        modes = tuple(replace(mode, title=_title(mode, model)) for mode in self.modes)
        return ModeChain(modes, self.transition, self.initial, self.law, first=self.first)

    def at(self, parameters: Mapping[str, float]) -> JumpFaults:
        """The faults whose probabilities have these parameters for good."""
        law, rate, arrivals = self.law, self.rate, self.arrivals
        transition = self.transition if law is None else rows_of(law.values(parameters))
        chain = self.arrival_chain if arrivals is None else rows_of(arrivals.values(parameters))
        return replace(
            self,
            transition=transition,
            initial=self.initial if self.first is None else self.first.at(parameters, transition),
            arrival_rate=self.arrival_rate if rate is None else evaluate(rate, parameters),
            arrival_chain=chain,
            law=None,
            rate=None,
            arrivals=None,
            first=None,
        )

    def gain_needs_no_moments(self, *, tested: bool) -> bool:
        """Whether modes differ in noise alone, and whoever filters takes every sample for good."""
        alike = len({tuple(getattr(mode, x) for x in "ABCDcd") for mode in self.modes}) == 1
        return alike and (tested or self.arrival != "unknown")

    @property
    def unequal(self) -> bool:
        """Whether modes have states of their own; then mode k drives the step into sample k."""
        return any(mode.kept is not None for mode in self.modes)

    @property
    def held(self) -> tuple[tuple[int, ...], ...]:
        """Mode by mode, 1 for the states that it has and 0 for those that it leaves out."""
        states = range(len(self.modes[0].A.rows))
        return tuple(
            tuple(int(mode.kept is None or i in mode.kept) for i in states) for mode in self.modes
        )

    def told(self) -> Mode:
        """The plant of one who is told the mode: parameters are 1 in it and 0 in the others.

        In continuous time, if the plant is stated so and modes have the same states.
        """
        now = [Name(INDICATOR.format(i)) for i in range(len(self.modes))]
        entered = [Name(ENTERED.format(i)) for i in range(len(self.modes))]

        def chosen(letter: str) -> Matrix:
            stated = (
                mode if self.unequal or letter not in OF_TIME else mode.source or mode
                for mode in self.modes
            )
            matrices: list[Matrix] = [getattr(each, letter) for each in stated]
            indicators = entered if self.unequal and letter in OF_TIME else now

            def entry(i: int, j: int, _: Expression) -> Expression:
                value = _by(indicators, [matrix.rows[i][j] for matrix in matrices])
                if letter == "A" and self.unequal:  # what the mode before leaves out was 0
                    return operation(
                        "*", value, _by(now, [Number(float(has[j])) for has in self.held])
                    )
                return value

            return matrices[0].mapped(entry)

        several = [mode.equations for mode in self.modes if mode.equations is not None]
        if several:
            return replace(
                self.modes[0],
                title="",
                Q=chosen("Q"),
                R=chosen("R"),
                equations=modes.chosen(several, now),
            )
        told: dict[str, Any] = {letter: chosen(letter) for letter in LETTERS}
        return replace(self.modes[0], title="", source=None, kept=None, **told)

    @property
    def channel(self) -> Channel | None:
        """How samples are lost; None if nothing is said."""
        if self.arrival_rate is not None:
            return Channel.of([[1.0 - self.arrival_rate, self.arrival_rate]] * 2)
        return Channel.of(self.arrival_chain, self.arrivals) if self.arrival_chain else None

    @property
    def has_channel(self) -> bool:
        """Whether something is said about how often samples are lost."""
        return self.arrival_rate is not None or bool(self.arrival_chain)


def _title(mode: Mode, model: Model) -> str:
    """What tells a mode from the model."""
    own = [letter for letter in LETTERS if getattr(mode, letter) != getattr(model, letter)]
    if mode.equations is not None:
        own = [letter for letter in own if letter in "QR"]
        base = model.equations
        own = [k for k in "fh" if base is None or mode.equations.said(k) != base.said(k)] + own
    return "with its own " + ", ".join(own) if own else "the model"


def _by(indicators: Sequence[Expression], values: Sequence[Expression]) -> Expression:
    """The value whose indicator is 1."""
    terms = [operation("*", *each) for each in zip(indicators, values, strict=True)]
    return values[0] if len(set(values)) == 1 else total(terms)


def read_jump_faults(
    section: Section, model: Model, family: str, *, arrivals: bool = False, sizes: bool = False
) -> JumpFaults:
    """The jump faults that a table describes; ``arrivals``: the family knows of lost samples.

    ``sizes``: modes may leave states out.
    """
    for key in () if arrivals else _ARRIVAL_KEYS:
        if key in section:
            raise section.error(
                key,
                f"{key} for the family {family}",
                "no key about arrivals: they are for mjls_lmmse; write the loss of samples as"
                " modes with C = 0",
            )
    found = _read_modes(section, model, "" if sizes else family)
    section.require("transition", f"a {len(found)} x {len(found)} matrix, one row per mode")
    law = read_transition(section, "transition", "as the modes are", len(found))
    transition = at_defaults(law, section)
    initial, first = read_initial(section, law, stationary_law(transition), "one per mode")
    arrival, rate, chain = _channel(section)
    return JumpFaults(
        transition,
        initial,
        found,
        arrival,
        arrival_rate=None if rate is None else evaluate(rate, section.defaults),
        arrival_chain=() if chain is None else at_defaults(chain, section),
        law=None if law.is_constant else law,
        rate=None if isinstance(rate, Number) else rate,
        arrivals=None if chain is None or chain.is_constant else chain,
        first=first,
    )


def _read_modes(section: Section, model: Model, refuses: str) -> tuple[Mode, ...]:
    place = section.place.entry("modes")
    expected = "a list of modes, each a table of the matrices in which it differs from the model"
    entries = as_list(section.require("modes", expected), place, expected)
    if not entries:
        raise place.error("an empty list", expected)
    sections = [
        Section(
            entry,
            place.item(i),
            known=(*LETTERS, "states", *modes.OF_MODES),
            defaults=section.defaults,
        )
        for i, entry in enumerate(entries)
    ]
    found = tuple(_mode(each, model, _kept(each, model, refuses)) for each in sections)
    if len({mode.equations is None for mode in found}) > 1:
        return tuple(_with_equations(each, model, None, apart=True) for each in sections)
    return found


def _kept(section: Section, model: Model, refuses: str) -> tuple[int, ...] | None:
    """The states that a mode has, if it says so."""
    if "states" not in section:
        return None
    place, names = section.place.entry("states"), [signal.name for signal in model.states]
    if refuses:
        raise place.error(f"states for the family {refuses}", "none: only imm has modes with fewer")
    expected = f"some of the states {', '.join(names)}, each once"
    kept: set[int] = set()
    for i, entry in enumerate(as_list(section.table["states"], place, expected)):
        at = names.index(str(entry)) if entry in names else entry
        known = isinstance(at, int) and not isinstance(at, bool) and at in range(len(names))
        if not isinstance(at, int) or not known or at in kept:
            raise place.item(i).error(show(entry), expected)
        kept.add(at)
    if not kept:
        raise place.error("an empty list", expected)
    return tuple(sorted(kept))


def _widened(matrix: Matrix, letter: str, kept: tuple[int, ...], n: int) -> Matrix:
    """A matrix over some states as one over all of them: 0 elsewhere."""
    place = {state: at for at, state in enumerate(kept)}

    def entry(i: int, j: int, _: Expression) -> Expression:
        row = i if letter == "C" else place.get(i)
        column = place.get(j) if letter in "ACQ" else j
        return ZERO if row is None or column is None else matrix.rows[row][column]

    rows = len(matrix.rows) if letter == "C" else n
    columns = n if letter in "ACQ" else matrix.shape[1]
    return Matrix.zeros(rows, columns).mapped(entry)


def _narrowed(matrix: Matrix, letter: str, kept: tuple[int, ...]) -> Matrix:
    """The rows and columns of some states."""
    rows = matrix.rows if letter == "C" else tuple(matrix.rows[i] for i in kept)
    if letter in "ACQ":
        rows = tuple(tuple(row[j] for j in kept) for row in rows)
    return Matrix(rows)


def _mode(section: Section, model: Model, kept: tuple[int, ...] | None) -> Mode:
    """The mode whose matrices are those of the model, but for those that are stated."""
    noisy = model.stated is not None and bool(model.stated[0].noises)  # Q is not all of the noise
    if model.equations is not None or noisy or any(key in section for key in modes.OF_MODES):
        return _with_equations(section, model, kept)
    for key in ("B", "D"):
        if key in section and not model.nu:
            expected = "model.B first (zeros will do): it says how many inputs there are"
            raise section.error(key, f"{key} where model.B is missing", expected)
    source = model.source
    found = {
        letter: getattr(model if source is None or letter not in OF_TIME else source, letter)
        for letter in LETTERS
    }
    if kept is not None:
        found |= {letter: _narrowed(found[letter], letter, kept) for letter in "ABCQc"}
    _state_own(section, found, model.nx if kept is None else len(kept))
    if kept is not None:
        found |= {letter: _widened(found[letter], letter, kept, model.nx) for letter in "ABCQc"}
    if source is not None:
        stated: dict[str, Any] = {letter: found[letter] for letter in OF_TIME}
        source = replace(source, **stated)
        moved = discretised(source, section.place, section)
        found |= dict(zip(OF_TIME, moved, strict=True))
        if kept is not None:  # what is left out does not stay: it is 0
            found["A"] = _widened(_narrowed(found["A"], "A", kept), "A", kept, model.nx)
    return Mode(**found, kept=kept, source=source)


def _with_equations(
    section: Section, model: Model, kept: tuple[int, ...] | None, *, apart: bool = False
) -> Mode:
    """The mode with equations of its own; matrices where they and those of the model are linear.

    ``apart``: another mode is not linear, so that this one has equations as well.
    """
    for key in ("A", "B", "C", "D", "c", "d"):
        if key in section:
            raise section.error(key, f"{key} for a plant of equations", "f or h of the mode")
    if kept is not None:
        given = "states for a plant of equations"
        raise section.error("states", given, "none: equations have all states of the model")
    if model.source is not None:
        key = next(key for key in modes.OF_MODES if key in section)
        expected = "matrices as the model has, or f in the model: its time is continuous"
        raise section.error(key, f"{key} beside matrices of dx/dt", expected)
    scope = section.defaults if isinstance(section.defaults, Scope) else Scope(section.defaults)
    own, Q = model.stated or (model.equations, model.Q)
    noises, moving = (own.noises, own.continuous) if own else ((), False)
    named = Named(model.states, model.inputs, model.outputs, noises, scope, moving)
    matrices = {} if own else {each: getattr(model, each) for each in LETTERS}
    base = own or modes.of_matrices(named, matrices)
    found: dict[str, Any] = {"Q": Q, "R": model.R}
    _state_own(section, found, model.nx)
    equations = modes.mode_equations(section, named, base)
    check_start(equations, named, model.x0.values(section.defaults).ravel(), section.place)
    linear = None
    if model.equations is None and not apart:
        linear = affine.linear_plant(equations, found["Q"], section)
    if linear is not None:
        return Mode(**(found | linear))
    return Mode(**ABSENCE, **found, equations=equations)


def _state_own(section: Section, found: dict[str, Matrix], states: int) -> None:
    """Put what the mode states in place of what is the model's."""
    for key, own in found.items():
        because = f"all modes share the states, inputs and rows of y; so is model.{key}"
        if "states" in section:
            because = f"the mode has {states} of the states, and the inputs and rows of the model"
        if key in {"c", "d"} and key in section:
            of = "state" if key == "c" else "measurement"
            found[key] = offset(section, key, len(own.rows), of)
        elif key in section and key in {"Q", "R"}:
            found[key] = section.covariance(key, len(own.rows), because)
        elif key in section:
            found[key] = section.matrix(key, own.shape, because)


def _channel(section: Section) -> tuple[Arrival, Expression | None, Matrix | None]:
    """What the filter knows of the channel, and its rate or chain, whichever is there."""
    rate: Expression | None = None
    if "arrival_rate" in section:
        place = section.place.entry("arrival_rate")
        rate = as_rate(section.table["arrival_rate"], place, section.defaults)
    chain: Matrix | None = None
    if "arrival_chain" in section:
        if rate is not None:
            given = "arrival_chain beside arrival_rate"
            raise section.error("arrival_chain", given, "one of the two")
        chain = read_transition(section, "arrival_chain", _ORDER, 2)
        if stationary_law(at_defaults(chain, section)) is None:
            raise section.error(
                "arrival_chain",
                "a chain that never changes, so that it has several stationary laws",
                f"a chain with one: its law, ordered {_ORDER}, is that of the first sample",
            )
    silent = rate is None and chain is None
    arrival = section.choice("arrival", get_args(Arrival), "always" if silent else "unknown")
    if arrival == "unknown" and silent:
        raise section.error(
            "arrival_rate",
            "nothing (the key is missing) with arrival = 'unknown'",
            "arrival_rate = Pr(a sample holds a signal), or arrival_chain",
        )
    return arrival, rate, chain
