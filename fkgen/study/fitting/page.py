"""A page about a fit: profiles of the parameters, innovations and NIS before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from fkgen.pipeline import build
from fkgen.problem import Spec
from fkgen.study.fitting.fit import Fit
from fkgen.study.fitting.likelihood import Records, in_double
from fkgen.study.reports.plots import BAND, BLUE, GREY, ORANGE, SHADES, styled
from fkgen.study.reports.whiteness import LAGS, Correlations, correlations

Array = NDArray[np.float64]

MOST = 8  # profiles: more would be a page nobody reads
_ACROSS = 4
_DEEP = 50.0  # times the fall to the ends of an interval: lower is drawn there
_PIECES = 100  # of a record, over which the NIS is averaged
_POINTS = 400  # of a distribution
_LEVEL = 0.95
_BAND = 1.358  # of a distribution of N numbers, times sqrt(N)
_PORTS = ("innovation", "innovation_covariance", "nis")
_WHITE = 0.01  # a smaller probability of the correlations is no white noise


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How records agree with a filter.

    Attributes
    ----------
    correlations : Correlations
        Of the innovations.
    nis, degrees : (N,) ndarray
        Of the samples with rows, record after record.
    """

    correlations: Correlations
    nis: Array
    degrees: Array


def agreement(spec: Spec, records: Sequence[Records]) -> Agreement:
    """Run the filter of a spec, with its defaults, over records."""
    built = build(in_double(spec.whole))
    keep = [port for port in _PORTS if port in built.ports]
    soft, p = spec.faults.soft, len(built.layout.outputs)
    host = list(range(p)) if soft is None else list(soft.host)
    white = Correlations(np.zeros((p, LAGS + 1)), np.zeros(p))
    nis, degrees = [], []
    for some in records:
        params: dict[str, Any] = {**spec.defaults, **some.params}
        u = some.u if built.layout.inputs else None
        run = built.run_batch(some.y, u, params, keep=keep, start=some.start)
        rows = np.isfinite(some.y)[..., host].sum(axis=2)
        used = (rows > 0) & (run.status >= 0)
        nis.append(run["nis"][used])
        degrees.append(rows[used])
        if "innovation_covariance" in keep:
            found = correlations(run["innovation"], run["innovation_covariance"])
            white = white.plus(found)
    return Agreement(white, np.concatenate(nis), np.concatenate(degrees))


@styled
def draw(fit: Fit) -> Figure:
    """Draw a fit: what changed, profile likelihoods, whiteness of innovations, NIS."""
    records = fit.maximum.surface.likelihood.records
    before, after = (agreement(each, records) for each in (fit.before, fit.spec))
    shown = fit.names[:MOST]
    across = min(_ACROSS, len(shown))
    lines = -(-len(shown) // across)
    figure = Figure(figsize=(9.5, 2.1 * lines + 5.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(2.1 * lines + 0.4, 5.0))
    top, bottom = parts
    top.suptitle(_title(fit), fontsize=10, x=0.01, ha="left")
    places = np.atleast_1d(top.subplots(lines, across)).ravel()
    for axis, name in zip(places, shown, strict=False):
        _draw_profile(axis, fit, name)
    for axis in places[len(shown) :]:
        axis.set_visible(False)
    axes = bottom.subplot_mosaic([["before", "after"], ["nis", "distribution"]])
    outputs = [signal.name.replace("_", " ") for signal in fit.spec.model.outputs]
    limit = _limit(before, after)
    _draw_correlation(axes["before"], before, outputs, "before", limit)
    _draw_correlation(axes["after"], after, outputs, "after", limit)
    _draw_means(axes["nis"], before, after)
    _draw_distribution(axes["distribution"], before, after, guide=_guide(fit.spec))
    for axis in (*places, *axes.values()):
        axis.tick_params(which="both", labelsize=8)
    return figure


def _title(fit: Fit) -> str:
    gained = fit.log_likelihood - fit.initial_log_likelihood
    rows = fit.maximum.surface.likelihood.rows
    text = f"{fit.spec.name}: {fit.spec.filter.family}, {rows} rows of y"
    return (
        f"{text}; log-likelihood {fit.log_likelihood:.6g}, {gained:.4g} above that of the defaults"
    )


def _draw_profile(axis: Axes, fit: Fit, name: str) -> None:
    """The profile likelihood of a parameter below its maximum, the interval, the default."""
    profile, (low, high) = fit.profile(name), fit.interval(_LEVEL)[name]
    inflation = fit.inflation[fit.names.index(name)]
    fall = 0.5 * float(chdtri(1, 1.0 - _LEVEL)) * inflation
    rest = profile.log_likelihood - fit.log_likelihood
    axis.plot(profile.values, np.maximum(rest, -_DEEP * fall), color=BLUE, lw=1.4)
    left, right = axis.get_xlim()
    axis.axhline(-fall, color=ORANGE, lw=0.8)
    axis.axvspan(max(low, left), min(high, right), color=BLUE, alpha=0.6 * BAND, lw=0)
    axis.axvline(fit.estimates[name], color=BLUE, lw=0.8, ls=":")
    default = fit.before.defaults[name]
    if left <= default <= right:
        axis.axvline(default, color=GREY, lw=0.8, ls="--")
    axis.set_xlim(left, right)
    axis.set_ylim(-3.0 * fall, 0.3 * fall)
    axis.set_ylabel("log-likelihood")
    axis.locator_params(axis="x", nbins=4)
    axis.set_title(f"{name}: {default:.4g} → {fit.estimates[name]:.4g}\n[{low:.4g}, {high:.4g}]")


def _limit(*found: Agreement) -> float:
    """Of the axes of correlations."""
    largest = max(float(np.abs(each.correlations.value).max(initial=0.0)) for each in found)
    return float(np.clip(1.15 * largest, 0.1, 1.05))


def _draw_correlation(
    axis: Axes, found: Agreement, names: Sequence[str], when: str, limit: float
) -> None:
    """Autocorrelation of the normalised innovations of every row."""
    lags, white = np.arange(1, LAGS + 1), found.correlations
    bound = float(white.bound.max(initial=0.0))
    axis.axhspan(-bound, bound, color=GREY, alpha=BAND, lw=0)
    axis.axhline(0.0, color="black", lw=0.6)
    width = 0.7 / len(names)
    every = zip(names, white.value, white.probability.tolist(), cycle(SHADES), strict=False)
    for i, (name, values, probability, colour) in enumerate(every):
        verdict = "white" if probability > _WHITE else "not white"
        at = lags + (i - 0.5 * (len(names) - 1)) * width
        label = f"{name}: {verdict} (p = {probability:.2g})"
        axis.bar(at, values, width, color=colour, label=label)
    axis.set_ylim(-limit, 1.4 * limit)  # room for the legend
    axis.set_ylabel("autocorrelation")
    axis.set_xlabel("lag (measurements of the row)")
    axis.set_xticks(range(0, LAGS + 1, 5))
    axis.set_title(f"innovations {when}", fontsize=9)
    axis.legend(loc="upper right", fontsize=7, ncols=1 + len(names) // 4)


def _draw_means(axis: Axes, before: Agreement, after: Agreement) -> None:
    """NIS over its degrees of freedom, averaged over pieces of the records."""
    band = None
    for found, colour, label in ((before, GREY, "before"), (after, BLUE, "after")):
        pieces = max(1, min(_PIECES, len(found.nis) // 10))
        parts = np.array_split(np.arange(len(found.nis)), pieces)
        degrees = np.array([found.degrees[part].sum() for part in parts])
        mean = np.array([found.nis[part].sum() for part in parts]) / degrees
        at = np.array([part.mean() for part in parts])
        axis.semilogy(at, np.maximum(mean, 1e-6), color=colour, lw=1.2, label=label)
        band = at, 1.96 * np.sqrt(2.0 / degrees)
    if band is not None:
        at, width = band
        low = np.maximum(1.0 - width, 1e-2)
        axis.fill_between(at, low, 1.0 + width, color=ORANGE, alpha=BAND, lw=0)
    axis.axhline(1.0, color=ORANGE, lw=0.8)
    axis.set_xlabel("sample with rows, record after record")
    axis.set_ylabel("NIS over its degrees")
    axis.set_title("normalised innovation squared, means of pieces", fontsize=9)
    axis.legend(loc="upper right", fontsize=7, ncols=2)


def _draw_distribution(axis: Axes, before: Agreement, after: Agreement, *, guide: bool) -> None:
    """Share of NIS below each quantile of chi-square: the diagonal where the model is right."""
    for found, colour, label in ((before, GREY, "before"), (after, BLUE, "after")):
        levels = np.sort(1.0 - chdtrc(found.degrees, found.nis))
        at = np.unique(np.linspace(0, len(levels) - 1, _POINTS).astype(int))
        axis.plot(levels[at], (at + 0.5) / len(levels), color=colour, lw=1.2, label=label)
    width = _BAND / np.sqrt(max(1, len(after.nis)))
    line = np.array([0.0, 1.0])
    axis.fill_between(line, line - width, line + width, color=ORANGE, alpha=BAND, lw=0)
    axis.plot(line, line, color=ORANGE, lw=0.8)
    axis.set_xlim(0.0, 1.0)
    axis.set_ylim(0.0, 1.0)
    axis.set_xlabel("probability of chi-square")
    axis.set_ylabel("share of NIS below")
    axis.set_title("NIS" + ("; a guide: y with faults is a mixture" if guide else ""), fontsize=9)
    axis.legend(loc="upper left", fontsize=7)


def _guide(spec: Spec) -> bool:
    """Whether the NIS has no chi-square distribution even where the model is right."""
    return not spec.filter.traits.exact
