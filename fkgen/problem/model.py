"""The plant: a linear time-invariant model in discrete time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fkgen.problem.covariance import checked_covariance
from fkgen.problem.signals import Signal, read_signals
from fkgen.problem.table.matrix import Role, check_matrix, read_entry, read_matrix
from fkgen.problem.table.place import Place, show
from fkgen.problem.table.section import Section, as_list, as_number
from fkgen.problem.text.foreign import plain_list, state_space
from fkgen.problem.text.matrix import Matrix, congruence

_KEYS = (
    *("A", "B", "C", "D", "Q", "R", "F", "V", "G", "W", "x0", "P0"),
    *("sample_time", "states", "inputs", "outputs", "system"),
)


@dataclass(frozen=True, slots=True)
class Model:
    r"""A plant with n states, q inputs and p outputs.

    .. math::

        x_{k+1} = A x_k + B u_k + w_k, \qquad y_k = C x_k + D u_k + v_k
    """

    A: Matrix  # (n, n)
    B: Matrix  # (n, q): q may be 0
    C: Matrix  # (p, n)
    D: Matrix  # (p, q): Zeros if the user gave none
    #: Q, R: (n, n) and (p, p): Covariances of the noises as they enter x and y; the upper
    #: triangle mirrors the lower
    Q: Matrix
    R: Matrix
    #: x0, P0: (n, 1) and (n, n): Mean and covariance of the prediction for sample 0; constant
    x0: Matrix
    P0: Matrix
    sample_time: float | None  # In seconds
    states: tuple[Signal, ...]  # states, inputs, outputs: n, q and p of them
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]

    @property
    def nx(self) -> int:
        """Number of states, n."""
        return self.A.shape[0]

    @property
    def nu(self) -> int:
        """Number of inputs, q."""
        return self.B.shape[1]

    @property
    def ny(self) -> int:
        """Number of outputs, p."""
        return self.C.shape[0]

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {
            key: getattr(self, key).plain()
            for key in ("A", "B", "C", "D", "Q", "R", "P0")
            if self.nu or key not in {"B", "D"}
        }
        table["x0"] = [row[0] for row in self.x0.plain()]
        if self.sample_time is not None:
            table["sample_time"] = self.sample_time
        for key in ("states", "inputs", "outputs"):
            signals: tuple[Signal, ...] = getattr(self, key)
            table[key] = [{"name": signal.name, "unit": signal.unit} for signal in signals]
        return table


def read_model(table: object, place: Place, defaults: Mapping[str, float]) -> Model:
    """Return the model that a table describes."""
    section = Section(table, place, known=_KEYS)
    sample_time = _expand_system(section)
    return _Reader(section, defaults).model(sample_time)


class _Reader:
    """Reads the matrices of one model in the order in which they fix its dimensions."""

    def __init__(self, section: Section, defaults: Mapping[str, float]) -> None:
        self.section, self.defaults = section, defaults

    def model(self, sample_time: float | None) -> Model:
        A = self.dynamics()
        n = A.shape[0]
        C = self.matrix("C", Role(None, n, "C maps the state to the measurement"))
        p = C.shape[0]
        B = Matrix.zeros(n, 0)
        if "B" in self.section:
            B = self.matrix("B", Role(n, None, "B maps the input to the state"))
        D, q = self.feedthrough(p, B.shape[1]), B.shape[1]
        return Model(
            A=A,
            B=B,
            C=C,
            D=D,
            Q=self.noise(("Q", "F", "V"), n, "state"),
            R=self.noise(("R", "G", "W"), p, "measurement"),
            x0=self.start(n),
            P0=self.start_covariance(n),
            sample_time=sample_time,
            states=read_signals(self.section, "states", "x", n),
            inputs=read_signals(self.section, "inputs", "u", q),
            outputs=read_signals(self.section, "outputs", "y", p),
        )

    def matrix(self, key: str, role: Role) -> Matrix:
        given = self.section.require(key, f"a matrix of shape {role.shape}: {role.because}")
        return read_matrix(given, self.section.place.entry(key), role, self.defaults)

    def dynamics(self) -> Matrix:
        A = self.matrix("A", Role(None, None, "A maps the state to itself"))
        rows, columns = A.shape
        if rows != columns:
            raise self.section.place.entry("A").error(
                f"shape {A.shape}", f"shape ({rows}, {rows}): A maps the state to itself"
            )
        return A

    def feedthrough(self, p: int, q: int) -> Matrix:
        if "D" not in self.section:
            return Matrix.zeros(p, q)
        if "B" not in self.section:
            raise self.section.place.entry("D").error("D without B", "no D where there is no input")
        return self.matrix("D", Role(p, q, "D maps the input to the measurement"))

    def covariance(self, key: str, size: int, because: str) -> Matrix:
        matrix = self.matrix(key, Role(size, size, because))
        return checked_covariance(matrix, self.section.place.entry(key), self.defaults)

    def noise(self, keys: tuple[str, str, str], size: int, target: str) -> Matrix:
        whole, factor, inner = keys
        because = f"{whole} is the covariance of the noise in the {target}"
        alternative = f"{whole} = {factor} {inner} {factor}'"
        for key in (factor, inner):
            if key in self.section and whole in self.section:
                raise self.section.place.entry(key).error(
                    f"{key} beside {whole}",
                    f"either {whole}, or {factor} and {inner} ({alternative})",
                )
        if inner in self.section and factor not in self.section:
            raise self.section.place.entry(factor).error(
                f"nothing (the key is missing) beside {inner}", f"{factor}, since {alternative}"
            )
        if factor not in self.section:
            expected = f"a ({size}, {size}) covariance, or {factor} and {inner} ({alternative})"
            self.section.require(whole, expected)
            return self.covariance(whole, size, because)
        role = Role(size, None, f"{factor} maps a noise to the {target}")
        return self.factored(factor, inner, role)

    def factored(self, factor: str, inner: str, role: Role) -> Matrix:
        left = self.matrix(factor, role)
        m = left.shape[1]
        middle = Matrix.of(np.eye(m)) if m else Matrix(())
        if inner in self.section:
            middle = self.covariance(inner, m, f"{inner} is the covariance of what {factor} maps")
        place = self.section.place.entry(factor)
        try:
            result = congruence(left, middle)
        except ArithmeticError as fault:
            raise place.error("a noise factor", f"a finite covariance, but {fault}") from None
        check_matrix(result, place, self.defaults)
        return result

    def start(self, n: int) -> Matrix:
        place = self.section.place.entry("x0")
        expected = f"a list of {n} numbers: the state has {n} components"
        entries = as_list(self.section.require("x0", expected), place, expected)
        if len(entries) != n:
            raise place.error(f"{len(entries)} entries", expected)
        rows = (
            (read_entry(component(entry, place.item(i)), place.item(i), self.defaults),)
            for i, entry in enumerate(entries)
        )
        return self.constant(Matrix(tuple(rows)), place)

    def start_covariance(self, n: int) -> Matrix:
        because = "P0 is the covariance of the error of x0"
        matrix = self.matrix("P0", Role(n, n, because))
        place = self.section.place.entry("P0")
        return checked_covariance(self.constant(matrix, place), place, self.defaults)

    def constant(self, matrix: Matrix, place: Place) -> Matrix:
        if not matrix.is_constant:
            used = ", ".join(sorted(matrix.names))
            raise place.error(
                f"an entry that depends on {used}", "constants: the start of the filter is fixed"
            )
        return matrix


def component(entry: object, place: Place) -> object:
    """Return an entry of x0 or c, out of its row if a column matrix of another library has rows."""
    plain = plain_list(entry, place)
    return plain[0] if isinstance(plain, list) and len(plain) == 1 else entry


def _expand_system(section: Section) -> float | None:
    """Replace ``system`` by its matrices and return the sample time."""
    place = section.place.entry("sample_time")
    stated = None
    if "sample_time" in section:
        stated = as_number(section.table["sample_time"], place, "a positive number of seconds")
        if stated <= 0:
            raise place.error(show(stated), "a positive number of seconds")
    if "system" not in section:
        return stated
    for key in ("A", "B", "C", "D"):
        if key in section:
            raise section.place.entry(key).error(f"{key} beside system", f"either system or {key}")
    matrices, own = state_space(section.table.pop("system"), section.place.entry("system"))
    if stated is not None and own is not None and stated != own:
        raise place.error(f"{stated!r}", f"{own!r}, the sample time of system")
    section.table.update(matrices)
    return stated if own is None else own
