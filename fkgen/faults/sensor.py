"""Sensors that lose their signal (gamma) or gain noise (delta): Sigalov & Oshman, sec. II."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fkgen.faults.chain import Lumping, Mode, ModeChain, lump
from fkgen.problem.model import Model
from fkgen.problem.probability import (
    Distribution,
    as_distribution,
    as_probability,
    as_transition,
    stationary_law,
    visited,
)
from fkgen.problem.signals import Signal, read_rows
from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_number
from fkgen.problem.text.expression import ZERO, Expression, Name, Number, operation
from fkgen.problem.text.matrix import Matrix

Problem = Literal[1, 2, 3, 4, "moments"]

#: What each problem of the paper states about (gamma, delta).
LAW_KEYS: dict[Problem, tuple[str, ...]] = {
    1: ("gamma_rate", "delta_nominal_rate"),
    2: ("joint",),
    3: ("gamma_chain", "delta_chain"),
    4: ("kernel",),
    "moments": ("gamma_rate", "gamma_persistence", "delta_nominal_rate"),
}
_ALL_LAW_KEYS = tuple(dict.fromkeys(key for keys in LAW_KEYS.values() for key in keys))
_RATES = {
    "gamma_rate": "Pr(gamma = 1)",
    "gamma_persistence": "Pr(gamma = 1, given that it was 1 in an earlier sample)",
    "delta_nominal_rate": "Pr(delta = 1)",
}
_MODES = "(1,1) (1,C) (0,1) (0,C) as (gamma, delta)"
LARGEST_FACTOR = 1e12
ROUNDED = 1e-12
"""Slack of inequalities between probabilities that a user computed."""


@dataclass(frozen=True, slots=True)
class Moments:
    """The three numbers that a linear filter needs."""

    gamma_rate: float  # E[gamma]
    gamma_persistence: float  # p11: Pr(gamma_k = 1 | gamma_i = 1) for every i < k
    delta_nominal_rate: float  # Pr(delta = 1)


@dataclass(frozen=True, slots=True)
class SensorFaults:
    """y = G (C x + D u) + v: rows may lose their signal (gamma = 0) or be noisier (delta = C).

    Modes are (1,1) (1,C) (0,1) (0,C) as (gamma, delta). There is no kernel where moments take its
    place, or nothing is said (``genie``).
    """

    noise_factor: float  # C: the noise covariance of the rows is R delta, delta in {1, C}
    rows: tuple[int, ...]  # of y that can fail, ascending
    kernel: tuple[Distribution, ...] = ()  # Pr(mode at k+1 is j | mode at k is i)
    initial: Distribution = ()  # at sample 0
    moments: Moments | None = None

    @property
    def conditions(self) -> tuple[tuple[float, float], ...]:
        """(gamma, delta) of the four modes."""
        return tuple((gamma, delta) for gamma in (1.0, 0.0) for delta in (1.0, self.noise_factor))

    def chain(self, model: Model) -> ModeChain:
        """The four conditions as modes of the plant; they all move alike."""
        noisy = f"noise x {self.noise_factor:g}"
        titles = [
            f"{signal}, {noise}" for signal in ("signal", "no signal") for noise in ("R", noisy)
        ]
        modes = tuple(
            replace(self.sensed(model, Number(gamma), Number(delta)), title=title)
            for (gamma, delta), title in zip(self.conditions, titles, strict=True)
        )
        return ModeChain(modes, self.kernel, self.initial)

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
        scale = (Number(1.0), operation("sqrt", delta), delta)

        def signal(matrix: Matrix) -> Matrix:
            return Matrix(
                tuple(
                    tuple(operation("*", gamma, entry) for entry in row) if i in self.rows else row
                    for i, row in enumerate(matrix.rows)
                )
            )

        R = Matrix(
            tuple(
                tuple(
                    operation("*", entry, scale[(i in self.rows) + (j in self.rows)])
                    for j, entry in enumerate(row)
                )
                for i, row in enumerate(model.R.rows)
            )
        )
        still = Matrix.zeros(model.nx, 1)
        C, D = signal(model.C), signal(model.D)
        return Mode(A=model.A, B=model.B, C=C, D=D, Q=model.Q, R=R, c=still)

    def entangles(self, R: Matrix) -> bool:
        """Whether R correlates rows that can fail with rows that cannot."""
        return any(
            (i in self.rows) != (j in self.rows) and entry != ZERO
            for i, row in enumerate(R.rows)
            for j, entry in enumerate(row)
        )

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold; every chain is written as problem 4."""
        table: dict[str, object] = {"noise_factor": self.noise_factor, "rows": list(self.rows)}
        if self.moments is not None:
            names = LAW_KEYS["moments"]
            table |= {"problem": "moments"} | {n: getattr(self.moments, n) for n in names}
        elif self.kernel:
            kernel = [list(row) for row in self.kernel]
            table |= {"problem": 4, "kernel": kernel, "initial": list(self.initial)}
        return table


def read_sensor_faults(
    table: object,
    place: Place,
    _: Mapping[str, float],
    model: Model,
    family: str,
    *,
    law: Literal["modes", "moments", "optional"] = "modes",
) -> SensorFaults:
    """The sensor faults that a table describes; moments, or no law, will do for some families."""
    known = ("noise_factor", "rows", "problem", "initial", *_ALL_LAW_KEYS)
    section = Section(table, place, known=known)
    factor = _noise_factor(section)
    rows = _rows(section, model.outputs)
    if law == "optional" and "problem" not in section:
        for key in ("initial", *_ALL_LAW_KEYS):
            if key in section:
                raise place.entry("problem").error(
                    f"nothing (the key is missing) beside {key}", "the problem that it belongs to"
                )
        return SensorFaults(factor, rows)
    problem = _problem(section, family, law)
    reader = _Law(section, problem, nominal=factor == 1.0)
    if problem == "moments":
        return SensorFaults(factor, rows, moments=reader.moments())
    kernel, default = reader.chain()
    return SensorFaults(factor, rows, kernel, reader.initial(default))


def _noise_factor(section: Section) -> float:
    place = section.place.entry("noise_factor")
    expected = f"a positive number up to {LARGEST_FACTOR:g}: noise variance of a fault over R"
    factor = as_number(section.table.get("noise_factor", 1.0), place, expected)
    if not 0.0 < factor <= LARGEST_FACTOR:
        raise place.error(show(factor), expected)
    return factor


def _rows(section: Section, outputs: Sequence[Signal]) -> tuple[int, ...]:
    if "rows" not in section:
        return tuple(range(len(outputs)))
    place = section.place.entry("rows")
    names = [signal.name for signal in outputs]
    expected = f"a list of rows of y, out of 0..{len(names) - 1} ({', '.join(names)})"
    rows = read_rows(section.table["rows"], place, expected, names)
    if not rows:
        raise place.error("an empty list", f"{expected}; leave the key out if all rows can fail")
    return rows


def _problem(section: Section, family: str, law: str) -> Problem:
    place = section.place.entry("problem")
    expected = (
        "1 (gamma_rate, delta_nominal_rate), 2 (joint), 3 (gamma_chain, delta_chain), 4 (kernel)"
        ' or "moments" (gamma_rate, gamma_persistence, delta_nominal_rate)'
    )
    given = section.require("problem", expected)
    found = next((p for p in LAW_KEYS if p == given and not isinstance(given, bool)), None)
    if found is None:
        raise place.error(show(given), expected)
    if found == "moments" and law != "moments":
        others = "problem 1, 2, 3 or 4" + (", or no law at all" if law == "optional" else "")
        raise place.error(
            f'"moments" for the family {family}',
            f"{others}: only linear_optimal works with moments",
        )
    allowed = LAW_KEYS[found] if found == "moments" else (*LAW_KEYS[found], "initial")
    for key in ("initial", *_ALL_LAW_KEYS):
        if key in section and key not in allowed:
            raise section.place.entry(key).error(
                f"{key} with problem {show(found)}", f"{', '.join(allowed)} for this problem"
            )
    return found


class _Law:
    """Reads the law of (gamma, delta); with a noise factor of 1 nothing need be said of delta."""

    def __init__(self, section: Section, problem: Problem, *, nominal: bool) -> None:
        self.section, self.problem, self.nominal = section, problem, nominal

    def chain(self) -> tuple[tuple[Distribution, ...], Distribution | None]:
        """Kernel of the four modes and its stationary law, if there is just one."""
        match self.problem:
            case 1:
                g, d = self.rate("gamma_rate"), self.delta_rate()
                joint: Distribution = tuple(s * n for s in (g, 1.0 - g) for n in (d, 1.0 - d))
                return (joint,) * 4, joint
            case 2:
                given = self.section.require("joint", f"4 probabilities, ordered {_MODES}")
                place = self.section.place.entry("joint")
                joint = as_distribution(given, place, 4, f"ordered {_MODES}")
                return (joint,) * 4, joint
            case 3:
                return self.product()
        given = self.section.require("kernel", f"a 4 x 4 matrix, modes ordered {_MODES}")
        kernel = as_transition(given, self.section.place.entry("kernel"), _MODES, 4)
        law = stationary_law(kernel)
        return kernel, None if law is None else tuple(law.tolist())

    def product(self) -> tuple[tuple[Distribution, ...], Distribution | None]:
        """Problem 3: independent chains; gamma comes as (0, 1), modes begin with gamma = 1."""
        gamma = np.array(self.two_states("gamma_chain", "(0, 1)"))
        always_nominal = np.array([[1.0, 0.0], [1.0, 0.0]])
        stated = "delta_chain" in self.section or not self.nominal
        delta = np.array(self.two_states("delta_chain", "(1, C)")) if stated else always_nominal
        kernel = np.kron(gamma[::-1, ::-1], delta)
        laws = stationary_law(gamma), stationary_law(delta)
        rows = tuple(tuple(row) for row in kernel.tolist())
        if laws[0] is None or laws[1] is None:
            return rows, None
        return rows, tuple(np.kron(laws[0][::-1], laws[1]).tolist())

    def two_states(self, key: str, order: str) -> tuple[Distribution, ...]:
        given = self.section.require(key, f"a 2 x 2 matrix, states ordered {order}")
        return as_transition(given, self.section.place.entry(key), order, 2)

    def initial(self, default: Distribution | None) -> Distribution:
        place = self.section.place.entry("initial")
        what = f"ordered {_MODES}"
        if "initial" in self.section:
            return as_distribution(self.section.table["initial"], place, 4, what)
        if default is None:
            raise place.error(
                "nothing (the key is missing), and several stationary laws",
                f"4 probabilities, {what}: where the chain starts decides where it stays",
            )
        return default

    def moments(self) -> Moments:
        """E[gamma], p11 and E[delta], which must belong to some process."""
        g, p = self.rate("gamma_rate"), self.rate("gamma_persistence")
        place = self.section.place.entry("gamma_persistence")
        if g > 0.0 and p < g - ROUNDED:
            raise place.error(
                show(p),
                f"at least gamma_rate = {g:g}: were samples less often 1 together, the mean of "
                "many would have a negative variance; a chain that alternates needs problem 3 or 4",
            )
        return Moments(g, p, self.delta_rate())

    def delta_rate(self) -> float:
        if self.nominal and "delta_nominal_rate" not in self.section:
            return 1.0
        return self.rate("delta_nominal_rate")

    def rate(self, key: str) -> float:
        given = self.section.require(key, f"a probability in [0, 1]: {_RATES[key]}")
        return as_probability(given, self.section.place.entry(key))


#: Largest difference of conditional probabilities that are meant to be the same.
EQUAL = 1e-12


def is_white(faults: SensorFaults) -> bool:
    """Whether gamma is independent of its past: E[gamma_k] = p11(k) for every k."""
    if faults.moments is not None:
        return abs(faults.moments.gamma_rate - faults.moments.gamma_persistence) <= EQUAL
    kernel = np.array(faults.kernel)
    rates = kernel[visited(kernel, faults.initial), :2].sum(axis=1)
    return bool(np.ptp(rates) <= EQUAL)
