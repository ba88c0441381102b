"""Sensors that lose their signal (gamma) or gain noise (delta): Sigalov & Oshman, sec. II."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fkgen.faults.chain import Lumping, Mode, ModeChain, lump
from fkgen.problem.equations import ABSENCE
from fkgen.problem.model import Model
from fkgen.problem.probability import (
    Array,
    Distribution,
    FirstLaw,
    Transition,
    as_law,
    as_rate,
    at_defaults,
    read_initial,
    read_transition,
    resting_law,
    rows_of,
    stationary_law,
    visited,
)
from fkgen.problem.signals import read_rows
from fkgen.problem.table.place import show
from fkgen.problem.table.section import Section, as_entry
from fkgen.problem.text.expression import (
    ONE,
    ZERO,
    Expression,
    Name,
    Number,
    evaluate,
    operation,
    to_text,
)
from fkgen.problem.text.matrix import Matrix, plain

Problem = Literal[1, 2, 3, 4, "moments"]
Law = Literal["modes", "moments", "optional"]  # What a family has to be told of it

#: What each problem of the paper states about (gamma, delta).
LAW_KEYS: dict[Problem, tuple[str, ...]] = {
    1: ("gamma_rate", "delta_nominal_rate"),
    2: ("joint",),
    3: ("gamma_chain", "delta_chain"),
    4: ("kernel",),
    "moments": ("gamma_rate", "gamma_persistence", "delta_nominal_rate"),
}
_EVERY_KEY = ("initial", *dict.fromkeys(key for keys in LAW_KEYS.values() for key in keys))
KEYS = ("noise_factor", "rows", "problem", *_EVERY_KEY)
_RATES = {
    "gamma_rate": "Pr(gamma = 1)",
    "gamma_persistence": "Pr(gamma = 1, given that it was 1 in an earlier sample)",
    "delta_nominal_rate": "Pr(delta = 1)",
}
_MODES = "(1,1) (1,C) (0,1) (0,C) as (gamma, delta)"
LARGEST_FACTOR = 1e12
#: Slack of inequalities between probabilities that a user computed.
ROUNDED = 1e-12


@dataclass(frozen=True, slots=True)
class Moments:
    """The three numbers that a linear filter needs."""

    gamma_rate: float  # E[gamma]
    gamma_persistence: float  # p11: Pr(gamma_k = 1 | gamma_i = 1) for every i < k
    delta_nominal_rate: float  # Pr(delta = 1)


@dataclass(frozen=True, slots=True)
class SensorFaults:
    """y = G (C x + D u + d) + v: rows may lose their signal (gamma = 0) or be noisier (delta = C).

    Modes are (1,1) (1,C) (0,1) (0,C) as (gamma, delta). There is no kernel where moments take its
    place, or nothing is said (``genie``).
    """

    noise_factor: float  # C: the noise covariance of the rows is R delta, delta in {1, C}
    rows: tuple[int, ...]  # of y that can fail, ascending
    kernel: Transition = ()  # Pr(mode at k+1 is j | mode at k is i)
    initial: Distribution = ()  # at sample 0
    moments: Moments | None = None
    #: noise_factor and kernel as expressions, where they depend on parameters; the numbers above
    #: are those at the defaults
    factor: Expression | None = None
    law: Matrix | None = None
    independent: bool = False  # the law of every sample is a row of ``law`` with its parameters
    first: FirstLaw | None = None  # initial, where it depends on parameters

    @property
    def conditions(self) -> tuple[tuple[float, float], ...]:
        """(gamma, delta) of the four modes."""
        return tuple((gamma, delta) for gamma in (1.0, 0.0) for delta in (1.0, self.noise_factor))

    def chain(self, model: Model) -> ModeChain:
        """The four conditions as modes of the plant; they all move alike."""
        noises = ("R", f"noise x {f'{self.noise_factor:g}' if self.factor is None else 'C'}")
        titles = [f"{signal}, {noise}" for signal in ("signal", "no signal") for noise in noises]
        deltas = (ONE, self.factor or Number(self.noise_factor)) * 2
        modes = tuple(
            replace(self.sensed(model, Number(gamma), delta), title=title)
            for (gamma, _), delta, title in zip(self.conditions, deltas, titles, strict=True)
        )
        return ModeChain(modes, self.kernel, self.initial, self.law, self.independent, self.first)

    def at(self, parameters: Mapping[str, float]) -> SensorFaults:
        """The faults whose law and noise have these parameters for good."""
        kernel = self.kernel if self.law is None else rows_of(self.law.values(parameters))
        initial = kernel[0] if self.independent else self.initial
        return replace(
            self,
            noise_factor=evaluate(self.factor or Number(self.noise_factor), parameters),
            kernel=kernel,
            initial=initial if self.first is None else self.first.at(parameters, kernel),
            factor=None,
            law=None,
            independent=False,
            first=None,
        )

    def lumped(self) -> Lumping:
        """Three modes: (1, 1), (1, C) and gamma = 0, whatever the noise; sec. III and IV."""
        return lump(self.kernel, self.initial, ((0,), (1,), (2, 3)))

    def told(self, model: Model) -> Mode:
        """The plant of one who is told gamma and delta, which are parameters."""
        return self.sensed(model, Name("gamma"), Name("delta"))

    def sensed(self, model: Model, gamma: Expression, delta: Expression) -> Mode:
        """The plant whose rows have signal ``gamma`` and noise variance R ``delta``, eq. (2).

        Noise that is correlated with that of a healthy row stays so: its deviation grows with the
        square root of delta.
        """
        scale = (ONE, operation("sqrt", delta), delta)
        fails = [i in self.rows for i in range(model.ny)]
        R = model.R.mapped(lambda i, j, entry: operation("*", entry, scale[fails[i] + fails[j]]))
        if model.equations is not None:
            heard = (
                operation("*", gamma, tree) if fails[i] else tree
                for i, tree in enumerate(model.equations.h)
            )
            equations = replace(model.equations, h=tuple(heard))
            return Mode(**ABSENCE, Q=model.Q, R=R, equations=equations)
        C, D, d = (
            matrix.mapped(lambda i, _, entry: operation("*", gamma if fails[i] else ONE, entry))
            for matrix in (model.C, model.D, model.d)
        )
        return Mode(A=model.A, B=model.B, C=C, D=D, Q=model.Q, R=R, c=model.c, d=d)

    def entangles(self, R: Matrix) -> bool:
        """Whether R correlates rows that can fail with rows that cannot."""
        return any(
            (i in self.rows) != (j in self.rows) and entry != ZERO
            for i, row in enumerate(R.rows)
            for j, entry in enumerate(row)
        )

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold; every chain is written as problem 4.

        But where each sample has parameters of its own, as problem 2.
        """
        factor = plain(self.factor or Number(self.noise_factor))
        table: dict[str, object] = {"noise_factor": factor, "rows": list(self.rows)}
        if self.moments is not None:
            names = LAW_KEYS["moments"]
            table |= {"problem": "moments"} | {n: getattr(self.moments, n) for n in names}
        elif self.law is not None and self.independent:
            table |= {"problem": 2, "joint": plain(self.law.rows[0])}
        elif self.kernel:
            kernel = [list(row) for row in self.kernel] if self.law is None else self.law.plain()
            table |= {"problem": 4, "kernel": kernel}
            if self.first is None:
                table["initial"] = list(self.initial)
            elif self.first.stated:
                table["initial"] = plain(self.first.stated)
        return table


def read_sensor_faults(
    section: Section, model: Model, family: str, *, law: Law = "modes"
) -> SensorFaults:
    """The sensor faults that a table describes; moments, or no law, will do for some families."""
    stated = _factor(section)
    factor = evaluate(stated, section.defaults)
    varying = None if isinstance(stated, Number) else stated
    rows = tuple(range(model.ny))
    if "rows" in section:
        hint = "leave the key out if all rows can fail"
        rows = read_rows(section, "rows", model.outputs, empty=hint)
    if law == "optional" and "problem" not in section:
        for key in _EVERY_KEY:
            if key in section:
                given = f"nothing (the key is missing) beside {key}"
                raise section.error("problem", given, "the problem that it belongs to")
        return SensorFaults(factor, rows, factor=varying)
    problem = _problem(section, family, law)
    nominal = 1.0 if stated == ONE else None  # nothing need be said of delta
    if problem == "moments":
        return SensorFaults(factor, rows, moments=_moments(section, nominal), factor=varying)
    chain, stationary, resting = _chain(section, problem, nominal)
    kernel, moving = at_defaults(chain, section), not chain.is_constant
    if moving and problem in {1, 2}:
        if "initial" in section:
            given = f"initial with parameters in problem {problem}"
            expected = "no such key: the law of every sample follows from its own parameters"
            raise section.error("initial", given, expected)
        return SensorFaults(
            factor, rows, kernel, kernel[0], factor=varying, law=chain, independent=True
        )
    initial, first = read_initial(section, chain, stationary, f"ordered {_MODES}", resting)
    of = chain if moving else None
    return SensorFaults(factor, rows, kernel, initial, factor=varying, law=of, first=first)


def _factor(section: Section) -> Expression:
    expected = f"a positive number up to {LARGEST_FACTOR:g}: noise variance of a fault over R"
    place = section.place.entry("noise_factor")
    factor = as_entry(section.table.get("noise_factor", 1.0), place, section.defaults, expected)
    if not 0.0 < (number := evaluate(factor, section.defaults)) <= LARGEST_FACTOR:
        at = "" if isinstance(factor, Number) else f" at the defaults ({to_text(factor)})"
        raise place.error(f"{show(number)}{at}", expected)
    return factor


def _problem(section: Section, family: str, law: Law) -> Problem:
    expected = (
        "1 (gamma_rate, delta_nominal_rate), 2 (joint), 3 (gamma_chain, delta_chain), 4 (kernel)"
        ' or "moments" (gamma_rate, gamma_persistence, delta_nominal_rate)'
    )
    given = section.require("problem", expected)
    found = next((p for p in LAW_KEYS if p == given and not isinstance(given, bool)), None)
    if found is None:
        raise section.error("problem", show(given), expected)
    if found == "moments" and law != "moments":
        others = "problem 1, 2, 3 or 4" + (", or no law at all" if law == "optional" else "")
        raise section.error(
            "problem",
            f'"moments" for the family {family}',
            f"{others}: only linear_optimal works with moments",
        )
    allowed = LAW_KEYS[found] if found == "moments" else (*LAW_KEYS[found], "initial")
    for key in _EVERY_KEY:
        if key in section and key not in allowed:
            expected = f"{', '.join(allowed)} for this problem"
            raise section.error(key, f"{key} with problem {show(found)}", expected)
    return found


def _chain(
    section: Section, problem: Problem, nominal: float | None
) -> tuple[Matrix, Array | None, FirstLaw | None]:
    """Kernel of the four modes and its stationary law, if there is just one.

    The last is how that depends on parameters, if it is not a matter of the kernel alone.
    """
    if problem == 4:
        section.require("kernel", f"a 4 x 4 matrix, modes ordered {_MODES}")
        kernel = read_transition(section, "kernel", _MODES, 4)
        return kernel, stationary_law(at_defaults(kernel, section)), None
    if problem == 3:  # independent chains; gamma comes as (0, 1), modes begin with gamma = 1
        gamma = read_transition(section, "gamma_chain", "(0, 1)", 2)
        delta = Matrix.of([[1.0, 0.0], [1.0, 0.0]])
        if "delta_chain" in section or nominal is None:
            delta = read_transition(section, "delta_chain", "(1, C)", 2)
        first, second = (stationary_law(at_defaults(each, section)) for each in (gamma, delta))
        rows = (_pairs(g[::-1], d) for g in gamma.rows[::-1] for d in delta.rows)
        kernel = Matrix(tuple(rows))
        if first is None or second is None:
            return kernel, None, None
        laws = [_rests(each) for each in (gamma, delta)]
        both = FirstLaw(_pairs(laws[0][::-1], laws[1]))
        return kernel, np.asarray(np.kron(first[::-1], second), float), both
    if problem == 2:
        what = f"ordered {_MODES}"
        given = section.require("joint", f"4 probabilities, {what}")
        joint = as_law(given, section.place.entry("joint"), 4, what, section.defaults)
    else:
        rates = _law_rate(section, "gamma_rate"), _law_rate(section, "delta_nominal_rate", nominal)
        joint = _pairs(*((rate, operation("-", ONE, rate)) for rate in rates))
    kernel = Matrix((joint,) * 4)
    return kernel, np.array(at_defaults(kernel, section)[0]), None


def _rests(chain: Matrix) -> tuple[Expression, ...]:
    """Probabilities of the two states of a chain in its stationary law."""
    law = stationary_law(chain.values()) if chain.is_constant else None
    return resting_law(chain).stated if law is None else tuple(map(Number, law.tolist()))


def _pairs(gamma: tuple[Expression, ...], delta: tuple[Expression, ...]) -> tuple[Expression, ...]:
    """Probabilities of the modes from those of gamma = 1, 0 and of delta = 1, C."""
    return tuple(operation("*", g, d) for g in gamma for d in delta)


def _law_rate(section: Section, key: str, default: float | None = None) -> Expression:
    """A rate that may depend on parameters."""
    expected = f"a probability in [0, 1]: {_RATES[key]}"
    given = section.require(key, expected) if default is None else section.table.get(key, default)
    return as_rate(given, section.place.entry(key), section.defaults)


def _moments(section: Section, nominal: float | None) -> Moments:
    """E[gamma], p11 and E[delta], which must belong to some process."""
    g, p = _rate(section, "gamma_rate"), _rate(section, "gamma_persistence")
    if g > 0.0 and p < g - ROUNDED:
        raise section.error(
            "gamma_persistence",
            show(p),
            f"at least gamma_rate = {g:g}: were samples less often 1 together, the mean of "
            "many would have a negative variance; a chain that alternates needs problem 3 or 4",
        )
    return Moments(g, p, _rate(section, "delta_nominal_rate", nominal))


def _rate(section: Section, key: str, default: float | None = None) -> float:
    return section.probability(key, f": {_RATES[key]}", default)


#: Largest difference of conditional probabilities that are meant to be the same.
EQUAL = 1e-12


def is_white(faults: SensorFaults) -> bool:
    """Whether gamma is independent of its past: E[gamma_k] = p11(k) for every k."""
    if faults.moments is not None:
        return abs(faults.moments.gamma_rate - faults.moments.gamma_persistence) <= EQUAL
    if faults.law is not None:  # equal rows at the defaults need not be equal elsewhere
        return faults.independent
    kernel = np.array(faults.kernel)
    begun = faults.initial if faults.first is None else np.ones(4)
    rates = kernel[visited(kernel, begun), :2].sum(axis=1)
    return bool(np.ptp(rates) <= EQUAL)
