"""How small a bias a filter in its steady state can still find, and by which test.

References
----------
Willsky & Jones 1976, *A generalized likelihood ratio approach to the detection and estimation of
jumps in linear systems*, sec. III.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.errors import DataError
from fkgen.families import NAMES, family
from fkgen.problem import Matrix, Signal, Spec
from fkgen.problem.spec import as_spec
from fkgen.runtime.record import choice, numbers, probability, whole
from fkgen.study.diagnostics.subject import Subject
from fkgen.study.effects.effect import required_noncentrality
from fkgen.study.effects.fault_effect import fault_effect
from fkgen.study.effects.profiles import step
from fkgen.study.records.table import numbers_of
from fkgen.study.reports.jsonable import Answer

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Detectability:
    """The least constant bias along one direction that a test finds with a given power.

    Biases are multiples of the direction: for a unit vector, in units of that row of y. Infinite
    where a test never sees the fault.

    Attributes
    ----------
    direction : (p,) ndarray
    window : int
        Samples w from the onset on.
    false_alarm, power : float
    nis : float
        By the NIS of the first faulty sample, chi-square with p degrees of freedom.
    windowed_nis : float
        By the sum of the NIS over the window, p w degrees of freedom.
    glr : float
        By the likelihood ratio for a bias of this direction and onset, one degree of freedom.
    information : (w,) ndarray
        Noncentrality of each sample per unit of the bias squared; at first that of the onset.
    plateau : float
        What it tends to: what remains when the estimate has taken the bias in.
    """

    direction: Array
    window: int
    false_alarm: float
    power: float
    nis: float
    windowed_nis: float
    glr: float
    information: Array
    plateau: float

    def __repr__(self) -> str:
        least = f"NIS {self.nis:.4g}, windowed {self.windowed_nis:.4g}, GLR {self.glr:.4g}"
        return f"<Detectability of a bias along {self.direction}: {least}>"


def detectability(
    spec: Spec,
    direction: ArrayLike | str,
    false_alarm: float = 1e-3,
    power: float = 0.9,
    window: int = 50,
    *,
    u: ArrayLike | None = None,
) -> Detectability:
    """Say how large a constant bias of y has to be to be found by a filter at rest.

    Parameters have their defaults, every row is present.

    Parameters
    ----------
    spec : Spec
        A ``kf``, ``mkf`` or ``genie``.
    direction : (p,) array_like or str
        Direction of the bias in y, or the name of the row that has it.
    false_alarm, power : float
        Probability of an alarm without and with the bias, per test.
    window : int
        Samples that the windowed tests look at.
    u : (q,) array_like, optional
        Constant inputs, on which the gain of ``mkf`` depends; zero if left out.

    Raises
    ------
    DataError
        If an argument does not fit, or the filter is not linear or does not come to rest.
    """
    d = _direction(as_spec(spec), direction)
    w = whole("window", window, least=1, expected="a number of samples, at least 1")
    rates = probability("false_alarm", false_alarm), probability("power", power)
    information, plateau = _information(spec, step(w, 0, d), u)
    total, p = float(information.sum()), spec.model.ny
    tests = {"nis": (p, float(information[0])), "windowed_nis": (p * w, total), "glr": (1, total)}
    least = {}
    for name, (degrees, share) in tests.items():  # share: noncentrality of a bias of one
        needed = required_noncentrality(degrees, *rates)
        least[name] = math.sqrt(needed / share) if share > 0.0 else math.inf
    return Detectability(
        direction=d,
        window=w,
        false_alarm=rates[0],
        power=rates[1],
        **least,
        information=information,
        plateau=plateau,
    )


def _information(spec: Spec, bias: Array, inputs: ArrayLike | None) -> tuple[Array, float]:
    """Noncentrality of every sample of a bias that begins at rest, and what it tends to."""
    q = spec.model.nu
    u = np.zeros(q) if inputs is None else numbers("u", inputs, np.float64).astype(float).ravel()
    if u.shape != (q,) or not np.isfinite(u).all():
        raise DataError("u", given=str(u), expected=f"{q} finite numbers, one per input")
    if spec.filter.linearises:
        given = "a plant with functions f and h, whose filter has no state of rest"
        expected = "matrices, or linear f and h; simulate it: fkgen fault-effect, fkgen compare"
        raise DataError("detectability", given=given, expected=expected)
    if not spec.filter.traits.linear:
        linear = ", ".join(name for name in NAMES if family(name).traits.linear)
        given = f"the family {spec.filter.family}"
        expected = f"one of {linear}: the NIS of a filter that is not linear in y, or"
        expected += " whose y is a mixture, is not chi-square; simulate it"
        raise DataError("detectability", given=given, expected=expected)
    model = Subject(spec)
    steady = model.steady_at(u)
    if steady is None:
        given = "a filter that does not come to rest"
        expected = "a stabilising solution of the Riccati equation; see fkgen.check"
        raise DataError("detectability", given=given, expected=expected)
    rested = replace(spec, model=replace(spec.model, P0=Matrix.of(steady.predicted)))
    effect = fault_effect(rested, bias, u=np.tile(u, (len(bias), 1)) if u.size else None)
    if not effect.gaussian:
        expected = "u = 0, or D = 0: with both, y shows which commands are lost and is a mixture"
        raise DataError("u", given=f"{u} under mkf with D", expected=expected)
    left = model.lasting_innovation(steady, bias[0])
    plateau = float(left @ np.linalg.pinv(steady.innovation, hermitian=True) @ left)
    return effect.noncentrality, plateau


def _direction(spec: Spec, direction: ArrayLike | str) -> Array:
    names = [signal.name for signal in spec.model.outputs]
    if isinstance(direction, str):
        return unit_vector("direction", direction, names)
    d = np.atleast_1d(np.asarray(numbers("direction", direction, np.float64), dtype=float))
    if d.shape != (len(names),):
        expected = f"shape ({len(names)},), one number per row of y, or the name of a row"
        raise DataError("direction", given=f"shape {d.shape}", expected=expected)
    if not np.isfinite(d).all() or not d.any():
        raise DataError("direction", given=str(d), expected="finite numbers, not all of them zero")
    return d


def unit_vector(what: str, name: str, names: Sequence[str]) -> Array:
    """1 for the signal of this name, 0 for the others."""
    if name not in names:
        raise DataError(what, given=repr(name), expected=choice(name, names))
    return np.asarray(np.eye(len(names))[names.index(name)])


def least_biases(
    spec: Spec, *, direction: str, false_alarm: float, power: float, window: str, inputs: str
) -> Answer:
    """Least biases by sensor (or direction) and window; options are those of the command, texts."""
    try:
        windows = tuple(int(part) for part in window.split(","))
    except ValueError:
        windows = ()
    if not windows or min(windows) < 1:
        expected = "numbers of samples, at least 1, separated by commas"
        raise DataError("--window", given=repr(window), expected=expected)
    u = numbers_of("--u", inputs, spec.model.nu)
    along = numbers_of("--direction", direction, spec.model.ny)
    rows, biases = list[Sequence[str]](), []
    for signal in spec.model.outputs if along is None else (Signal(direction),):
        d = signal.name if along is None else along
        found = [detectability(spec, d, false_alarm, power, w, u=u) for w in windows]
        first, sums, ratios = found[0], [o.windowed_nis for o in found], [o.glr for o in found]
        least = (f"{bias:.4g}" for bias in (first.nis, *sums, *ratios))
        rows.append((signal.name, signal.unit, *least))
        about: dict[str, Any] = {
            "name": signal.name,
            "unit": signal.unit,
            "direction": first.direction,
        }
        about |= {"nis": first.nis, "windowed_nis": sums, "glr": ratios}
        about["onset_noncentrality"] = float(first.information[0])
        biases.append(about | {"plateau_noncentrality": first.plateau})
    meaning = (
        f"Least constant bias found with probability {power:g} at {false_alarm:g} false alarms "
        "per test, from its onset on, filter at rest."
    )
    wide = [f"{test} {w}" for test in ("NIS sum", "GLR") for w in windows]
    facts = {"false_alarm": false_alarm, "power": power, "windows": windows, "biases": biases}
    return Answer(("bias of", "unit", "NIS 1", *wide), rows, (meaning,), facts)
