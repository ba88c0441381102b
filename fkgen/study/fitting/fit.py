"""`fit`: parameters of a spec from records, by maximum likelihood, and how well they are known."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fkgen.console import Advance, html_table, progressing
from fkgen.errors import DataError, SpecError
from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.problem.spec import as_spec
from fkgen.runtime.compiled import CompiledFilter
from fkgen.runtime.record import choice, probability
from fkgen.study.fitting.domain import Axis, axes_of, covariances_hold, estimated
from fkgen.study.fitting.likelihood import Likelihood, Records, Start, in_double, records_of
from fkgen.study.fitting.profile import Curve, Profile
from fkgen.study.fitting.search import Maximum, maximise
from fkgen.study.records.summary import several
from fkgen.study.reports.jsonable import json_text

Array = NDArray[np.float64]

#: Batches that a search takes, as far as can be said before it is made.
EXPECTED = 60
_LEVEL = 0.95


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """Parameters that make records most likely.

    Attributes
    ----------
    estimates : mapping of str to float
    standard_errors : mapping of str to float
        Square roots of the diagonal of ``covariance``; NaN at a bound, infinite where a parameter
        cannot be identified.
    covariance, correlation : (k, k) ndarray
        In the order of ``names``: the inverse of the observed information J, or, where the
        likelihood is not exactly that of the model, J^-1 (sum s s') J^-1 with the scores s of all
        samples.
    log_likelihood, aic, bic : float
        At the estimates; bic counts the finite rows of y.
    converged : bool
        Whether a maximum was found that is one in all directions.
    message : str
        What is to be said about it, parameters at a bound and those that cannot be identified.
    spec : Spec
        The spec with the estimates as defaults.
    """

    names: tuple[str, ...]
    estimates: Mapping[str, float]
    standard_errors: Mapping[str, float]
    covariance: Array
    correlation: Array
    log_likelihood: float
    aic: float
    bic: float
    converged: bool
    message: str
    spec: Spec
    before: Spec = field(repr=False)
    initial_log_likelihood: float = field(repr=False)
    maximum: Maximum = field(repr=False)
    inflation: Array = field(repr=False)  # (k,): variances over those of the inverse information
    _known: dict[tuple[str, float], tuple[float, float]] = field(default_factory=dict, repr=False)

    def interval(
        self, level: float = _LEVEL, *, advance: Advance | None = None
    ) -> dict[str, tuple[float, float]]:
        """Intervals of a confidence, by the profile likelihood.

        The deviance is divided by the variance that ``covariance`` has for a parameter over that of
        the inverse information (Kent 1982; 1 where they are the same).

        Parameters
        ----------
        level : float
        advance : callable, optional
            Called with 1 after every parameter.

        Returns
        -------
        mapping of str to (low, high)
            They end at the bounds of a parameter, or at infinity, where it cannot be excluded.
        """
        confidence = probability("level", level)
        found = {}
        for name in self.names:
            found[name] = self._interval(name, confidence)
            if advance is not None:
                advance(1)
        return found

    def _interval(self, name: str, level: float) -> tuple[float, float]:
        if (name, level) not in self._known:
            self._known[name, level] = self._curve(name).interval(level)
        return self._known[name, level]

    def profile(self, name: str, points: int = 21) -> Profile:
        """The largest log-likelihood for values of one parameter, over all the others.

        Parameters
        ----------
        name : str
        points : int
            How many values, around the interval of 95 %.
        """
        if name not in self.names:
            raise DataError("name", given=repr(name), expected=choice(str(name), self.names))
        return self._curve(name).profile(points, self._interval(name, _LEVEL))

    def _curve(self, name: str) -> Curve:
        j = self.names.index(name)
        return Curve(self.maximum, j, self.standard_errors[name], float(self.inflation[j]))

    def to_json(self) -> str:
        """All of it as JSON; ``interval`` is that of 95 %."""
        keys = ["estimates", "standard_errors", "covariance", "correlation", "log_likelihood"]
        keys += ["aic", "bic", "converged", "message"]
        facts = {key: getattr(self, key) for key in keys}
        return json_text({**facts, "interval": self.interval(), "spec": self.spec.to_dict()})

    def __repr__(self) -> str:
        told = ", ".join(f"{name} = {value:.6g}" for name, value in self.estimates.items())
        return f"<Fit of {self.spec.name}: {told}; {self.message}>"

    def _repr_html_(self) -> str:
        """Estimates next to the defaults, for a notebook."""
        before, errors = self.before.defaults, self.standard_errors
        rows = (
            (name, f"{before[name]:.6g}", f"{value:.6g}", f"{errors[name]:.3g}")
            for name, value in self.estimates.items()
        )
        head = ("parameter", "default", "estimate", "standard error")
        return html_table(f"{self.spec.name}: {self.message}", head, rows)


def fit(  # noqa: PLR0917 - as `CompiledFilter.run`, with two more
    spec: Spec,
    y: Any,
    u: Any = None,
    params: Any = None,
    estimate: str | Sequence[str] = (),
    start: Start = None,
    *,
    progress: bool = False,
) -> Fit:
    """Estimate parameters of a spec from records, by maximum likelihood.

    Parameters
    ----------
    spec : Spec
        The search begins at the defaults of its parameters; their ranges bound them.
    y : (T, p) or (M, T, p) array_like, or a list of records (T, p)
        Measurements, NaN = missing; several records are independent.
    u : array_like, or a list of them
        Inputs, (T, q) for all records or one for each.
    params : mapping of str to float, (T,) or (M, T) array_like, or a list of mappings
        Run-time parameters that are known.
    estimate : sequence of str
        Parameters to estimate, of the spec's ``[parameters]``; a vector stands for its entries.
    start : Snapshot or mapping
        Where records begin, as for `CompiledFilter.run_batch`.
    progress : bool
        Show how far it is, on stderr.

    Returns
    -------
    Fit

    Raises
    ------
    DataError
        If a name is none of a parameter that occurs, records do not fit or are too short, or the
        likelihood is not finite at the defaults.

    References
    ----------
    Durbin & Koopman, *Time Series Analysis by State Space Methods* (2012), ch. 7; White,
    *Econometrica* 50 (1982), for the covariance of estimates by a likelihood that is approximate.
    """
    given = as_spec(spec)
    _refuse_gate(given)
    likelihood, axes = _prepared(given, (y, u, params), estimate, start)
    with progressing("fit", EXPECTED, shown=progress) as advance:
        allowed = _allowed(given, likelihood.names)
        return _fit_of(given, maximise(likelihood, axes, allowed, lambda: advance(1)))


def _prepared(
    spec: Spec, data: tuple[Any, Any, Any], estimate: str | Sequence[str], start: Start
) -> tuple[Likelihood, tuple[Axis, ...]]:
    """The likelihood of records, and the parameters that are searched, all of it checked."""
    parameters = estimated(spec, estimate)
    names = [each.name for each in parameters]
    built = build(in_double(spec))
    records = records_of(built, data, start, names)
    likelihood = Likelihood(built, names, records)
    axes = axes_of(spec, parameters, _inside(spec, built, records))
    _demand(likelihood, axes)
    return likelihood, axes


def _refuse_gate(spec: Spec) -> None:
    """A gate leaves out what fits badly: with less noise there is always less to fit."""
    if spec.filter.option("gate", None) is not None:
        given = "a gate, which leaves out the rows that fit badly"
        raise SpecError(
            "filter.gate",
            given=given,
            expected="none while parameters are estimated",
            file=spec.file,
        )


def _demand(likelihood: Likelihood, axes: Sequence[Axis]) -> None:
    """Refuse records that are too short, and those that the defaults cannot take."""
    rows, k = likelihood.rows, len(likelihood.names)
    if rows <= k:
        expected = f"more than {k}, as there are parameters to estimate"
        raise DataError("y", given=several(rows, "finite row"), expected=expected)
    first = [axis.default for axis in axes]
    if why := likelihood.refusal(first):
        raise DataError("y", given=f"{why} ({_told(axes, first)})", expected="a finite likelihood")


def _told(axes: Sequence[Axis], theta: ArrayLike) -> str:
    pairs = zip(axes, np.asarray(theta, float), strict=True)
    return ", ".join(f"{axis.name} = {value:.6g}" for axis, value in pairs)


def _inside(
    spec: Spec, built: CompiledFilter, records: Sequence[Records]
) -> Callable[[Mapping[str, float]], bool]:
    """Whether parameters are in the domains of covariances and, as C checks them, of the rest."""
    some = records[0]
    params = {name: values[:1, :1] for name, values in some.params.items()}
    one = Records(np.full_like(some.y[:1, :1], np.nan), some.u[:1, :1], params, None)
    holds = covariances_hold(spec)

    def inside(values: Mapping[str, float]) -> bool:
        if not holds(values):
            return False
        free = [name for name in values if name not in params]
        probe = Likelihood(built, free, [one])
        return bool(np.isfinite(probe([[values[name] for name in free]])[0]))

    return inside


def _allowed(spec: Spec, names: Sequence[str]) -> Callable[[Array], bool]:
    def allowed(theta: Array) -> bool:
        try:
            with_defaults(spec, dict(zip(names, theta.tolist(), strict=True)))
        except SpecError:
            return False
        return True

    return allowed


def with_defaults(spec: Spec, values: Mapping[str, float]) -> Spec:
    """The spec with other defaults of some parameters.

    Raises
    ------
    SpecError
        If it cannot have them.
    """
    table: Any = spec.to_dict()
    put_defaults(table["parameters"], spec, values)
    return Spec.from_dict(table, file=spec.file)


def put_defaults(
    entries: Any,
    spec: Spec,
    values: Mapping[str, float],
    put: Callable[[Any, str, float], object] = operator.setitem,
) -> None:
    """Put values into the table of a spec's parameters; ``put`` is for plain numbers."""
    for each in spec.stated_parameters:
        if each.name not in values:
            continue
        value = float(values[each.name])
        if each.of:
            entries[each.of][int(each.name.removeprefix(f"{each.of}_"))] = value
        elif isinstance(entries[each.name], dict):
            entries[each.name]["default"] = value
        else:
            put(entries, each.name, value)


def _fit_of(spec: Spec, maximum: Maximum) -> Fit:
    """What is known at a maximum."""
    surface, point = maximum.surface, maximum.point
    names, k = surface.likelihood.names, len(surface.axes)
    if not point.finite:
        raise _endless(maximum)
    blind = unidentified(maximum)
    inverse, covariance = _covariances(spec, maximum, blind)
    with np.errstate(invalid="ignore", divide="ignore"):
        errors = np.sqrt(np.diag(covariance))
        correlation = covariance / errors[:, None] / errors
        inflation = np.diag(covariance) / np.diag(inverse)
    estimates = dict(zip(names, maximum.theta.tolist(), strict=True))
    found, sentences = spec, list(_sentences(maximum, blind))
    try:
        found = with_defaults(spec, estimates)
    except SpecError as error:
        sentences.append(f"no spec can have these defaults: {error.key}: given {error.given}")
    converged = point.settled and not blind and found is not spec
    if not (point.settled or blind):
        sentences.insert(0, "the search did not come to a maximum")
    rows = surface.likelihood.rows
    return Fit(
        names=names,
        estimates=estimates,
        standard_errors=dict(zip(names, errors.tolist(), strict=True)),
        covariance=covariance,
        correlation=correlation,
        log_likelihood=point.value,
        aic=2.0 * k - 2.0 * point.value,
        bic=k * math.log(rows) - 2.0 * point.value,
        converged=converged,
        message="; ".join(sentences) or "converged",
        spec=found,
        before=spec,
        initial_log_likelihood=float(surface.likelihood([[a.default for a in surface.axes]])[0]),
        maximum=maximum,
        inflation=np.where(np.isfinite(inflation), inflation, 1.0),
    )


def _endless(maximum: Maximum) -> DataError:
    """What is said where no search stays where the likelihood is finite."""
    axes = maximum.surface.axes
    lost = _told(axes, maximum.theta)
    begun = _told(axes, [axis.default for axis in axes])
    given = f"a likelihood that is not finite near {lost}, where the search from {begun} ended"
    expected = "records that need some noise to be explained, or ranges that end before"
    return DataError("y", given=given, expected=expected)


def unidentified(maximum: Maximum) -> list[tuple[int, ...]]:
    """Axes along which the likelihood is flat, those that are so together in one tuple."""
    point, free = maximum.point, maximum.surface.free
    if not free:
        return []
    _, directions, flat = point.flatness
    found = []
    for direction in directions[:, flat].T:
        share = np.abs(direction) / np.abs(direction).max()
        found.append(tuple(j for j, part in zip(free, share, strict=True) if part > 1e-2))
    return found


def _covariances(
    spec: Spec, maximum: Maximum, blind: Sequence[tuple[int, ...]]
) -> tuple[Array, Array]:
    """The inverse information (k, k), and the covariance of the estimates, by the parameters."""
    surface, point, k = maximum.surface, maximum.point, len(maximum.surface.axes)
    lost = {j for each in blind for j in each}
    known = [at for at, j in enumerate(surface.free) if j not in lost]
    inverse, covariance = np.full((2, k, k), np.nan)
    for j in lost:
        inverse[j, j] = covariance[j, j] = np.inf
    if not known:
        return inverse, covariance
    where = [surface.free[at] for at in known]
    slope = np.array([surface.axes[surface.free[at]].slope(point.z[at]) for at in known])
    own = np.linalg.pinv(point.information[np.ix_(known, known)], hermitian=True)
    whole = own
    if not spec.filter.traits.exact:
        scores = surface.scores(point)[:, known]
        whole = own @ (scores.T @ scores) @ own
    inverse[np.ix_(where, where)] = own * slope[:, None] * slope
    covariance[np.ix_(where, where)] = whole * slope[:, None] * slope
    return inverse, covariance


def _sentences(maximum: Maximum, blind: Sequence[tuple[int, ...]]) -> Iterator[str]:
    axes, surface = maximum.surface.axes, maximum.surface
    for group in blind:
        names = ", ".join(axes[j].name for j in group)
        together = "; a combination of them is known" if len(group) > 1 else ""
        yield f"{names} cannot be identified: the likelihood is flat there{together}"
    for j, value in surface.held.items():
        yield f"{axes[j].name} is at its bound {value:.6g}"
    for value, *theta in (each.tolist() for each in maximum.others):
        less = maximum.point.value - value
        yield f"another maximum, lower by {less:.3g}, is at {_told(axes, theta)}"
