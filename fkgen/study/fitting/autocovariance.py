"""Q and R from autocovariances of innovations: a second opinion that knows nothing of likelihoods.

Innovations of an observer with any constant gain L that is stable have autocovariances that are
linear in Q and R. Those of the records are fitted to them by least squares, under the condition
that Q and R stay covariances (Odelson, Rajamani & Rawlings 2006, Automatica 42, sec. 3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fkgen.errors import DataError
from fkgen.oracle.textbook.riccati import stationary_prediction
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.problem.spec import as_spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.record import whole
from fkgen.study.fitting.domain import estimated
from fkgen.study.fitting.fit import with_defaults
from fkgen.study.fitting.likelihood import Records, records_of

Array = NDArray[np.float64]

SETTLED = 1e-3  # of the first error of the observer: its innovations count from there on
_LINEAR = 1e-9  # relative difference by which Q or R may miss a straight line


@dataclass(frozen=True, eq=False, kw_only=True)
class Autocovariance:
    """Parameters of Q and R by autocovariance least squares.

    Attributes
    ----------
    estimates : mapping of str to float
    autocovariance, expected : (lags, p, p) ndarray
        E[e[k + j] e[k]'] of the innovations of the records, and with the estimates.
    spec : Spec
        The spec with the estimates as defaults.
    """

    estimates: Mapping[str, float]
    autocovariance: Array = field(repr=False)
    expected: Array = field(repr=False)
    spec: Spec = field(repr=False)


def autocovariance(
    spec: Spec,
    y: Any,
    u: Any = None,
    params: Any = None,
    estimate: str | Sequence[str] = (),
    *,
    lags: int = 15,
) -> Autocovariance:
    """Estimate parameters in which Q and R are linear, by autocovariance least squares.

    The records have no missing rows, and no parameter varies in them. The observer has the
    stationary gain of the defaults. Needs cvxpy and clarabel: ``pip install 'fkgen[als]'``.

    Parameters
    ----------
    spec : Spec
        Of a linear plant without faults.
    y, u, params
        Records, as for `fit`.
    estimate : sequence of str
        Parameters to estimate.
    lags : int
        Autocovariances that are fitted, that of lag 0 included.

    Raises
    ------
    DataError
        If records or parameters are not of that kind, or Q and R cannot be told from them.
    """
    count = whole("lags", lags, least=1, expected="a whole number above 0")
    given = _with_known(as_spec(spec), params)
    names = [each.name for each in estimated(given, estimate)]
    plant = _Plant.of(given, names)
    observer = build(plant.observer(given.name))
    records = records_of(observer, (y, u, None), None, ())
    found = plant.sampled(observer, records, count)
    values = dict(zip(names, _solved(given, plant, names, found).tolist(), strict=True))
    return Autocovariance(
        estimates=values,
        autocovariance=found,
        expected=plant.expected(*_noises(given, values), count),
        spec=with_defaults(given, values),
    )


def _with_known(spec: Spec, params: Any) -> Spec:
    """The spec with parameters that are known as defaults, the same in all records."""
    known = dict[str, float]()
    for each in params if isinstance(params, list | tuple) else [params or {}]:
        for name, value in each.items():
            numbers = np.unique(np.asarray(value, float))
            if len(numbers) != 1 or known.setdefault(name, float(numbers[0])) != numbers[0]:
                given = f"{numbers[0]:g} and other values"
                raise DataError(f"params.{name}", given=given, expected="one: nothing varies here")
    return with_defaults(spec, known)


def _noises(spec: Spec, values: Mapping[str, float]) -> tuple[Array, Array]:
    """Q and R with these parameters."""
    whole_set = {**spec.defaults, **values}
    return spec.model.Q.values(whole_set), spec.model.R.values(whole_set)


@dataclass(frozen=True, slots=True, eq=False)
class _Plant:
    """Matrices at the defaults, and the observer: its gain, and the loop A - A L C.

    The prediction errors are x[k+1] - xhat[k+1] = loop (x[k] - xhat[k]) + w[k] - gain v[k].
    """

    matrices: Mapping[str, Array]
    gain: Array  # (n, p): A L
    loop: Array  # (n, n)
    radius: float

    @classmethod
    def of(cls, spec: Spec, names: Sequence[str]) -> _Plant:
        model, faults = spec.model, spec.faults
        if model.equations is not None or any((faults.actuator, faults.sensor, faults.jump)):
            expected = "a linear plant without faults"
            raise DataError("spec", given="equations or faults", expected=expected)
        for key in ("A", "B", "C", "D", "c", "d", "S"):
            moved = sorted(getattr(model, key).names & set(names))
            if moved or (key == "S" and not model.S.is_zero):
                given = f"model.{key} that depends on {moved[0]}" if moved else "model.S"
                raise DataError("estimate", given=given, expected="parameters of Q and R alone")
        keys = ("A", "B", "C", "D", "Q", "R", "c", "d", "x0", "P0")
        at = {key: getattr(model, key).values(spec.defaults) for key in keys}
        solved = stationary_prediction(*(at[key] for key in "ACQR"))
        if solved is None:
            given = "a plant without a stationary gain at the defaults"
            raise DataError("spec", given=given, expected="one that is seen, and moved by Q")
        (P, radius), A, C = solved, at["A"], at["C"]
        gain = A @ P @ C.T @ np.linalg.pinv(C @ P @ C.T + at["R"], hermitian=True)
        return cls(at, gain, A - gain @ C, radius)

    def observer(self, name: str) -> Spec:
        """The filter with this gain."""
        model = {key: values.tolist() for key, values in self.matrices.items()}
        model |= {key: self.matrices[key][:, 0].tolist() for key in ("c", "d", "x0")}
        if not self.matrices["B"].size:
            del model["B"], model["D"]
        chosen = {"family": "kf", "gain": "stationary"}
        return Spec.from_dict({"name": name, "model": model, "filter": chosen})

    def expected(self, Q: Array, R: Array, lags: int) -> Array:
        """(lags, p, p): autocovariances of the innovations, which are linear in Q and R."""
        from scipy.linalg import solve_discrete_lyapunov  # noqa: PLC0415 - slow to import

        C, noise = self.matrices["C"], Q + self.gain @ R @ self.gain.T
        P = solve_discrete_lyapunov(self.loop, noise)
        result, cross = [C @ P @ C.T + R], self.loop @ P @ C.T - self.gain @ R
        for _ in range(1, lags):
            result.append(C @ cross)
            cross = self.loop @ cross
        return np.array(result)

    def sampled(self, observer: CompiledFilter, records: Sequence[Records], lags: int) -> Array:
        """(lags, p, p): those of the records, from where the observer has settled."""
        settled = math.ceil(math.log(SETTLED) / math.log(self.radius)) if self.radius > 0.0 else 0
        products, count = np.zeros((lags, *self.matrices["R"].shape)), np.zeros(lags)
        for some in records:
            if not np.isfinite(some.y).all():
                raise DataError("y", given="missing rows", expected="records without any")
            u = some.u if observer.layout.inputs else None
            run = observer.run_batch(some.y, u, keep=["innovation"])
            if run.refused.any():
                raise DataError("y", given="samples that are refused", expected="finite numbers")
            e = run["innovation"][:, settled:]
            for j in range(min(lags, e.shape[1])):
                first, later = e[:, : e.shape[1] - j], e[:, j:]
                products[j] += np.einsum("mki,mkj->ij", later, first)
                count[j] += first.shape[0] * first.shape[1]
        if count.min() <= 0.0:
            given = f"fewer than {settled + lags} samples"
            raise DataError("y", given=given, expected=f"{settled} to settle, and {lags} lags")
        return np.asarray(products / count[:, None, None])


def _solved(spec: Spec, plant: _Plant, names: Sequence[str], found: Array) -> Array:
    """The parameters whose autocovariances are nearest, with Q and R that are covariances."""
    try:
        cp: Any = import_module("cvxpy")  # an extra
    except ImportError:
        given, expected = "no cvxpy", "cvxpy and clarabel: pip install 'fkgen[als]'"
        raise DataError("autocovariance", given=given, expected=expected) from None
    lags = len(found)
    base, slopes = _affine(spec, names)
    offset = plant.expected(*base, lags)
    scale = np.sqrt(np.diag(found[0]))
    weight = 1.0 / np.outer(scale, scale)
    columns = [(plant.expected(*each, lags) * weight).ravel() for each in slopes]
    rest, matrix = ((found - offset) * weight).ravel(), np.column_stack(columns)
    sizes = np.linalg.norm(matrix, axis=0)
    if np.linalg.matrix_rank(matrix / np.where(sizes > 0.0, sizes, 1.0), tol=1e-9) < len(names):
        given = f"autocovariances that are the same along a direction of {', '.join(names)}"
        raise DataError("estimate", given=given, expected="fewer parameters, or more rows of y")
    unknown = cp.Variable(len(names))  # in units in which every column has length one
    conditions = []
    for each, size, z in zip(estimated(spec, names), sizes, unknown, strict=True):
        conditions += [z >= each.low * size] if each.low > -math.inf else []
        conditions += [z <= each.high * size] if each.high < math.inf else []
    for part in (0, 1):
        unit = np.abs(base[part]).max() + sum(np.abs(each[part]).max() for each in slopes)
        terms = [s[part] / size * z for s, size, z in zip(slopes, sizes, unknown, strict=True)]
        conditions.append((base[part] + sum(terms)) / unit >> 0)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(matrix / sizes @ unknown - rest)), conditions)
    problem.solve(solver=cp.CLARABEL)
    if unknown.value is None:
        given = f"a least-squares problem that is {problem.status}"
        raise DataError("autocovariance", given=given, expected="ranges that hold a solution")
    return np.asarray(unknown.value / sizes, float)


def _affine(
    spec: Spec, names: Sequence[str]
) -> tuple[tuple[Array, Array], list[tuple[Array, Array]]]:
    """Q and R where all parameters are zero, and their slopes by each of them."""
    middle = {name: spec.defaults[name] for name in names}
    at = _noises(spec, middle)
    slopes = []
    for name in names:
        step = abs(middle[name]) or 1.0
        one, two = (_noises(spec, {**middle, name: middle[name] + i * step}) for i in (1, 2))
        for M, N, O in zip(at, one, two, strict=True):
            if np.abs(O - 2.0 * N + M).max() > _LINEAR * np.abs([M, N, O]).max():
                given = f"{name!r}, in which Q or R is not linear"
                raise DataError(
                    "estimate", given=given, expected="parameters that they are linear in"
                )
        slopes.append(((one[0] - at[0]) / step, (one[1] - at[1]) / step))
    zero = [
        M - sum(slope[part] * middle[name] for name, slope in zip(names, slopes, strict=True))
        for part, M in enumerate(at)
    ]
    return (zero[0], zero[1]), slopes
