"""The plant: matrices, or equations in their place, in discrete time."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import SpecError
from fkgen.problem.covariance import checked_covariance
from fkgen.problem.equations import ABSENCE, Equations
from fkgen.problem.finding import Finding
from fkgen.problem.functions.affine import linear_plant
from fkgen.problem.functions.finite import check_start
from fkgen.problem.functions.named import read_named, read_start
from fkgen.problem.functions.reading import (
    KEYS,
    has_equations,
    plain_equations,
    read_equations,
    read_timing,
)
from fkgen.problem.signals import Signal, read_signals
from fkgen.problem.table.place import Place, show, suggestion
from fkgen.problem.table.section import Section, check_finite
from fkgen.problem.text.discretise import OF_TIME, Continuous, as_time
from fkgen.problem.text.expression import is_large
from fkgen.problem.text.foreign import state_space
from fkgen.problem.text.matrix import Matrix, congruence, plain_fields

_KEYS = (
    *("A", "B", "C", "D", "Q", "R", "c", "d", "S", "F", "V", "G", "W", "x0", "P0"),
    *("sample_time", "time", "states", "inputs", "outputs", "system"),
)


@dataclass(frozen=True, slots=True)
class Ranged:
    """A state with a range, and where it is in x and among the rows of its covariance."""

    name: str
    at: int
    error: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Model:
    r"""A plant with n states, q inputs and p outputs.

    .. math::

        x_{k+1} = A x_k + B u_k + c + w_k, \qquad y_k = C x_k + D u_k + d + v_k
    """

    A: Matrix  # (n, n)
    B: Matrix  # (n, q): q may be 0
    C: Matrix  # (p, n)
    D: Matrix  # (p, q): Zeros if the user gave none
    #: Q, R: (n, n) and (p, p): Covariances of the noises as they enter x and y; the upper
    #: triangle mirrors the lower
    Q: Matrix
    R: Matrix
    c: Matrix  # c, d: (n, 1) and (p, 1): known offsets of x and of y
    d: Matrix
    S: Matrix  # (n, p): covariance of w[k] with v[k]
    #: x0, P0: (n, 1) and (n, n): Mean and covariance of the prediction for sample 0, with its
    #: parameters
    x0: Matrix
    P0: Matrix
    sample_time: float | str | None  # In seconds, or the parameter that holds it
    states: tuple[Signal, ...]  # states, inputs, outputs: n, q and p of them
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    source: Continuous | None = None  # What A, B, c and Q were computed from, if the time was
    equations: Equations | None = None  # What is there in place of A, B, C, D, c and d
    #: The equations that the matrices were read from, if they were, and the Q beside them
    stated: tuple[Equations, Matrix] | None = field(default=None, compare=False)
    #: What a user should know of how it was read
    remarks: tuple[Finding, ...] = field(default=(), compare=False)

    @property
    def nx(self) -> int:
        """Count of numbers in x, n."""
        return len(self.x0.rows)

    @property
    def ne(self) -> int:
        """Count of rows of covariances of x: n, less one for every attitude."""
        return len(self.P0.rows)

    @property
    def attitudes(self) -> tuple[int, ...]:
        """Where the four numbers of an attitude begin in x."""
        return () if self.equations is None else self.equations.attitudes

    @property
    def nu(self) -> int:
        """Number of inputs, q."""
        return len(self.inputs)

    @property
    def ny(self) -> int:
        """Number of outputs, p."""
        return len(self.outputs)

    @property
    def ranged(self) -> tuple[Ranged, ...]:
        """The states that have a range."""
        found, at, error = [], 0, 0
        for state in self.states:
            found += [] if state.range is None else [Ranged(state.name, at, error, *state.range)]
            at, error = at + (4 if state.manifold else 1), error + (3 if state.manifold else 1)
        return tuple(found)

    def within(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measurements (..., p), with NaN in place of those outside of the range of their row."""
        low, high = np.array([row.range or (-np.inf, np.inf) for row in self.outputs]).T
        with np.errstate(invalid="ignore"):
            return np.where((y < low) | (y > high), np.float64(np.nan), y)

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        if self.equations is not None:
            return self._plain_equations(self.equations)
        absent = ["equations", "stated", "remarks"]
        absent += [key for key in ("c", "d", "S") if getattr(self, key).is_zero]
        absent += [] if self.nu else ["B", "D"]
        columns = {key: getattr(self, key).plain_column() for key in ("x0", "c", "d")}
        table = plain_fields(self) | columns
        if self.source is not None:
            table |= {"time": "continuous"} | plain_source(self.source)
            absent = ["source", *(key for key in absent if key != "c")]
            absent += ["c"] if self.source.c.is_zero else []
        return {key: entry for key, entry in table.items() if key not in absent}

    def _plain_equations(self, equations: Equations) -> dict[str, object]:
        table: dict[str, object] = {key: getattr(self, key).plain() for key in ("Q", "R", "P0")}
        table |= {} if self.S.is_zero else {"S": self.S.plain()}
        table |= {"x0": self.x0.plain_column()}
        for key in ("states", "inputs", "outputs"):
            table[key] = [signal.plain() for signal in getattr(self, key)]
        table |= {} if self.sample_time is None else {"sample_time": self.sample_time}
        return table | plain_equations(equations, self.states, self.outputs)


def read_model(table: object, place: Place, defaults: Mapping[str, float]) -> Model:
    """Return the model that a table describes; its matrices fix its dimensions one by one."""
    section = Section(table, place, known=(*_KEYS, *KEYS), defaults=defaults)
    if has_equations(section):
        return _with_equations(section)
    sample_time = _expand_system(section)
    A = section.matrix("A", (None, None), "A maps the state to itself")
    n = A.shape[0]
    if A.shape[1] != n:
        expected = f"shape ({n}, {n}): A maps the state to itself"
        raise section.error("A", f"shape {A.shape}", expected)
    C = section.matrix("C", (None, n), "C maps the state to the measurement")
    p = C.shape[0]
    B = Matrix.zeros(n, 0)
    if "B" in section:
        B = section.matrix("B", (n, None), "B maps the input to the state")
    q = B.shape[1]
    D = Matrix.zeros(p, q)
    if "D" in section:
        if "B" not in section:
            raise section.error("D", "D without B", "no D where there is no input")
        D = section.matrix("D", (p, q), "D maps the input to the measurement")
    because = "P0 is the covariance of the error of x0"
    Q = _noise(section, ("Q", "F", "V"), n, "state")
    R = _noise(section, ("R", "G", "W"), p, "measurement")
    c = offset(section, "c", n, "state")
    source = None
    if section.choice("time", ("discrete", "continuous"), "discrete") == "continuous":
        source = _continuous(section, (A, B, c, Q), sample_time)
        A, B, c, Q = discretised(source, section.place.entry("sample_time"), section)
    return Model(
        source=source,
        A=A,
        B=B,
        C=C,
        D=D,
        Q=Q,
        R=R,
        S=_cross_covariance(section, Q, R),
        c=c,
        d=offset(section, "d", p, "measurement"),
        x0=section.column("x0", n, "numbers or expressions"),
        P0=section.covariance("P0", n, because),
        sample_time=sample_time,
        states=read_signals(section, "states", "x", n),
        inputs=read_signals(section, "inputs", "u", q),
        outputs=read_signals(section, "outputs", "y", p),
    )


def _with_equations(section: Section) -> Model:
    """The model whose motion or measurement is stated by equations."""
    sample_time = _expand_system(section)
    named = read_named(section)
    n, p = len(named.coordinates), len(named.outputs)
    ne = n - len(named.attitudes)
    period = None
    if named.continuous:
        if sample_time is None:
            raise _no_sample_time(section)
        period = as_time(sample_time)
    equations = read_equations(section, named, read_timing(section, period))
    zero = "Q" not in section and "F" not in section and bool(named.noises)
    because = "P0 is the covariance of the error of x0 (3 rows for an attitude)"
    Q = Matrix.zeros(ne, ne) if zero else _noise(section, ("Q", "F", "V"), ne, "state")
    R = _noise(section, ("R", "G", "W"), p, "measurement")
    x0, remarks = read_start(section, named, section.column("x0", n, "numbers or expressions"))
    check_start(equations, named, x0.values(section.defaults).ravel(), section.place)
    found = linear_plant(equations, Q, section) if not named.wraps else None
    letters = {"Q": Q} | ABSENCE if found is None else found
    return Model(
        **letters,
        R=R,
        S=_cross_covariance(section, Q, R),
        x0=x0,
        P0=section.covariance("P0", ne, because),
        sample_time=sample_time,
        states=named.states,
        inputs=named.inputs,
        outputs=named.outputs,
        equations=equations if found is None else None,
        stated=None if found is None else (equations, Q),
        remarks=remarks,
    )


def offset(section: Section, key: str, count: int, of: str) -> Matrix:
    """The known offset of the state or of the measurement that was given, or zeros."""
    if key not in section:
        return Matrix.zeros(count, 1)
    return section.column(key, count, "numbers or expressions", of)


def _noise(section: Section, keys: tuple[str, str, str], count: int, target: str) -> Matrix:
    whole, factor, inner = keys
    alternative = f"{whole} = {factor} {inner} {factor}'"
    for key in (factor, inner):
        if key in section and whole in section:
            expected = f"either {whole}, or {factor} and {inner} ({alternative})"
            raise section.error(key, f"{key} beside {whole}", expected)
    if factor in section:
        return _factored(section, factor, inner, (count, target))
    if inner in section:
        given = f"nothing (the key is missing) beside {inner}"
        raise section.error(factor, given, f"{factor}, since {alternative}")
    section.require(
        whole, f"a ({count}, {count}) covariance, or {factor} and {inner} ({alternative})"
    )
    return section.covariance(
        whole, count, f"{whole} is the covariance of the noise in the {target}"
    )


def _cross_covariance(section: Section, Q: Matrix, R: Matrix) -> Matrix:
    """Cov(w, v), which Q and R have to allow, or zeros."""
    n, p = len(Q.rows), len(R.rows)
    if "S" not in section:
        return Matrix.zeros(n, p)
    S = section.matrix("S", (n, p), "S is the covariance of w[k], row by row, with v[k]")
    joint = joint_noise(Q, S, R)
    try:
        checked_covariance(joint, section.place.entry("S"), section.defaults)
    except SpecError as fault:
        expected = "what Q and R allow: [[Q, S], [S', R]] without a negative eigenvalue"
        raise section.error("S", f"{fault.given}, of [[Q, S], [S', R]]", expected) from None
    return S


def joint_noise(Q: Matrix, S: Matrix, R: Matrix) -> Matrix:
    """[[Q, S], [S', R]], the covariance of (w, v)."""
    above = (Q_row + S_row for Q_row, S_row in zip(Q.rows, S.rows, strict=True))
    below = (S_row + R_row for S_row, R_row in zip(zip(*S.rows, strict=True), R.rows, strict=True))
    return Matrix((*above, *below))


def _factored(section: Section, factor: str, inner: str, mapped: tuple[int, str]) -> Matrix:
    """Return F V F', where V is the identity unless it is there."""
    left = section.matrix(factor, (mapped[0], None), f"{factor} maps a noise to the {mapped[1]}")
    m = left.shape[1]
    middle = Matrix.of(np.eye(m)) if m else Matrix(())
    if inner in section:
        middle = section.covariance(inner, m, f"{inner} is the covariance of what {factor} maps")
    try:
        result = congruence(left, middle)
    except ArithmeticError as fault:
        given, expected = "a noise factor", f"a finite covariance, but {fault}"
        raise section.error(factor, given, expected) from None
    for expression in itertools.chain(*result.rows):
        if is_large(expression):
            given = "a product with very large expressions"
            raise section.error(factor, given, "the product itself")
        check_finite(expression, section.place.entry(factor), section.defaults)
    return result


def _continuous(
    section: Section, stated: tuple[Matrix, Matrix, Matrix, Matrix], sample_time: float | str | None
) -> Continuous:
    """What a continuous plant is discretised from."""
    if sample_time is None:
        raise _no_sample_time(section)
    return Continuous(*stated, sample_time)


def _no_sample_time(section: Section) -> Exception:
    given = 'nothing (the key is missing) beside time = "continuous"'
    expected = "the seconds from sample to sample, or the name of a parameter"
    return section.error("sample_time", given, expected)


def discretised(
    source: Continuous, place: Place, section: Section
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """A, B, c and Q from sample to sample."""
    try:
        found = source.discrete
    except ArithmeticError as fault:
        given = f"{source.sample_time!r} for a continuous plant"
        raise place.error(given, f"a sample over which A stays finite, but {fault}") from None
    for matrix in found.values():
        for expression in itertools.chain(*matrix.rows):
            if is_large(expression):
                raise place.error("very large expressions once discretised", "simpler entries")
            check_finite(expression, place, section.defaults)
    A, B, c, Q = (found[letter] for letter in OF_TIME)
    return A, B, c, Q


def plain_source(source: Continuous) -> dict[str, object]:
    """The matrices of dx/dt as a spec file writes them."""
    return {letter: getattr(source, letter).plain() for letter in "ABQ"} | {
        "c": source.c.plain_column()
    }


def _sample_time(section: Section) -> float | str | None:
    """A number of seconds, or the name of a parameter whose default is one."""
    expected = "a positive number of seconds, or the name of a parameter"
    given = section.table.get("sample_time", 1.0)
    if not isinstance(given, str):
        number = section.number("sample_time", expected, lambda number: number > 0.0, 1.0)
        return number if "sample_time" in section else None
    if given not in section.defaults:
        hint = suggestion(given, section.defaults)
        raise section.error("sample_time", show(given), f"{expected} in [parameters]{hint}")
    if not section.defaults[given] > 0.0:
        shown = f"{show(given)}, whose default is {section.defaults[given]!r}"
        raise section.error("sample_time", shown, "a parameter with a positive default")
    return given


def _expand_system(section: Section) -> float | str | None:
    """Replace ``system`` by its matrices and return the sample time."""
    stated = _sample_time(section)
    if "system" not in section:
        return stated
    for key in ("A", "B", "C", "D"):
        if key in section:
            raise section.error(key, f"{key} beside system", f"either system or {key}")
    system, where = section.table.pop("system"), section.place.entry("system")
    matrices, own = state_space(system, where, continuous="time" in section)
    if stated is not None and own is not None and stated != own:
        expected = f"{own!r}, the sample time of system"
        raise section.error("sample_time", f"{stated!r}", expected)
    section.table.update(matrices)
    return stated if own is None else own
