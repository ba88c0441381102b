"""Draw a filtered record: states with bands, innovations, NIS with its bounds, probabilities."""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fkgen.faults import SoftFaults
from fkgen.problem import Name, Signal, Spec
from fkgen.runtime.results import Run
from fkgen.study.records.files import refuse_format, write_whole
from fkgen.study.records.record import Table
from fkgen.study.records.summary import GAP, usual_pause
from fkgen.symbolic.interface import VERDICTS
from fkgen.symbolic.lifting.equations import places

Array = NDArray[np.floating]

BLUE, ORANGE, GREY, BAND = "#1f5a94", "#d9741a", "#6b6b6b", 0.18
SHADES = ("#1f5a94", "#d9741a", "#4c9a6a", "#a14a76", "#c9a227", "#6a7fc1", "#7b5b3a", "#5fa8b8")
#: What a picture of a run may show.
PARTS = ("states", "innovation", "nis", "faults")
LARGEST = 12  # panels of states; more would be a page nobody reads
HEIGHT = 1.9  # of a panel, in inches
_SHADE = 0.13  # how dark a gap is
_CONFIDENCE, _LOWEST = 0.95, 1e-3  # smaller ratios of a test to its threshold are drawn there
_MANY = {"ncols": 8, "markerscale": 3, "handlelength": 1.2}
#: A legend in one line above the panel, where it hides nothing.
_ABOVE = _MANY | {"loc": "lower left", "bbox_to_anchor": (0.0, 0.98), "borderaxespad": 0.0}
_RIGHT = _ABOVE | {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "markerscale": 2}

#: Plain frames and small texts, on the left: decorates what draws.
styled = mpl.rc_context(
    {
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.labelsize": 9,
        "axes.titlesize": 8,
        "axes.titlelocation": "left",
        "legend.frameon": False,
        "legend.fontsize": 8,
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class _Sheet:
    spec: Spec
    run: Run
    time: Array
    y: Array  # (T, p); NaN = missing
    read_by: tuple[tuple[int, ...], ...]  # per state the rows of y that are it in noise
    truth: Array | None = None  # (T, n); NaN = not known
    estimate: str = "filtered"  # What the states are

    @property
    def present(self) -> NDArray[np.bool_]:
        """(T, p): rows that are there."""
        return np.isfinite(self.y)

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(T, p): rows that are there and that a gate or a test left out."""
        if "rejected" in self.run.ports:
            left_out = np.asarray(self.run["rejected"]).reshape(self.present.shape) > 0
        else:
            verdict = np.isin(self.run.status, [status.value for status in VERDICTS])
            left_out = np.broadcast_to(verdict[:, np.newaxis], self.present.shape)
        return np.asarray(left_out & self.present)


def gaps_of(time: Array, silent: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Begin and length of the gaps: times without a row of y for longer than usual.

    Where a sensor reports now and then its pauses are usual; a gap is above `GAP` times the median.
    """
    heard = np.concatenate([time[:1], time[~silent], time[-1:]])
    pauses = np.diff(heard)
    long = pauses > GAP * usual_pause(pauses[1:-1], np.diff(time))
    return list(zip(heard[:-1][long].tolist(), pauses[long].tolist(), strict=True))


def _read_by(spec: Spec) -> tuple[tuple[int, ...], ...]:
    """Per number of x the rows of y that read it alone, as it is."""
    model, equations = spec.model, spec.model.equations
    if equations is not None:
        seen = [[i for i, h in enumerate(equations.h) if h == Name(x)] for x in equations.states]
        return tuple(map(tuple, seen))
    rows = np.asarray(model.C.values(spec.defaults))
    others = [m.values(spec.defaults) for m in (model.D, model.d)]
    alone = (np.count_nonzero(rows, axis=1) == 1) & (rows.max(axis=1) == 1.0)
    for each in others:
        alone &= ~np.reshape(each, (len(rows), -1)).any(axis=1)
    return tuple(tuple(np.flatnonzero(alone & (column == 1.0)).tolist()) for column in rows.T)


@styled
def draw(
    spec: Spec,
    table: Table,
    run: Run,
    *,
    estimate: str = "filtered",
    parts: Collection[str] = PARTS,
    truth: Array | None = None,
    faults: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Draw a run: a panel per state, then innovations, NIS, and probabilities or verdicts.

    It needs ``filtered_state``. ``filtered_covariance``, ``innovation``, ``nis``,
    ``mode_probability``, and ``test_statistic``, ``test_dof`` and ``fault_declared`` are drawn if
    they are there and among the ``parts``; ``truth`` (T, n) beside the states, and begin and
    length of ``faults``, in samples, as bars. ``estimate`` is what the states are called.
    """
    states, outputs, soft = _panels_of(spec)[:LARGEST], spec.model.outputs, spec.faults.soft
    units = {one.unit: [i for i, s in enumerate(outputs) if s.unit == one.unit] for one in outputs}
    time, label = times_of(spec, table)
    per = time[-1] / (len(time) - 1) if len(time) > 1 else 1.0
    y, read_by = np.asarray(table.y, dtype=float), _read_by(spec)
    sheet = _Sheet(spec, run, time, y, read_by, truth, estimate)
    states = states if "states" in parts else []
    draws = [partial(draw_one, sheet=sheet) for draw_one in states]
    if "innovation" in run.ports and "innovation" in parts:
        draws += [partial(_draw_innovation, sheet=sheet, unit=u, rows=units[u]) for u in units]
    if "nis" in run.ports and "nis" in parts:
        draws.append(partial(_draw_nis, sheet=sheet))
    if "mode_probability" in run.ports and "faults" in parts:
        draws.append(partial(_draw_modes, sheet=sheet))
    if soft is not None and "test_statistic" in run.ports and "faults" in parts:
        draws.append(partial(_draw_verdicts, sheet=sheet, soft=soft))
    heights = [2.1] * len(states) + [HEIGHT] * (len(draws) - len(states))
    gaps = gaps_of(time, np.asarray(~sheet.present.any(axis=1)))
    bars = [(per * begin, per * length) for begin, length in faults]
    return panels(heights, draws, label, gaps, bars)


def times_of(spec: Spec, table: Table) -> tuple[Array, str]:
    """The times of a record, and what they are."""
    time, label = np.asarray(table.time, dtype=float), table.time_label or "sample"
    if not table.time_name and spec.period is not None:
        return time * spec.period, "time (s)"
    return time, label


def panels(
    heights: Sequence[float],
    draws: Sequence[Callable[[Axes], None]],
    time: str,
    gaps: Sequence[tuple[float, float]] = (),
    faults: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Draw panels above each other, time below the last one, gaps as grey bars through all."""
    figure = Figure(figsize=(9.0, sum(heights)), layout="constrained")
    several = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)
    axes = several[:, 0]
    for axis, draw_panel in zip(axes, draws, strict=True):
        axis.margins(x=0.0)
        across = axis.get_xaxis_transform()
        for bars, colour in ((gaps, GREY), (faults, ORANGE)):
            if bars:
                shade = {"color": colour, "alpha": _SHADE, "lw": 0}
                axis.broken_barh(bars, (0.0, 1.0), transform=across, **shade)
        axis.tick_params(labelsize=8)
        draw_panel(axis)
    axes[-1].set_xlabel(time)
    figure.align_ylabels(axes)
    return figure


def save(figure: Figure, path: Path, *, force: bool) -> None:
    """Write a figure into a file."""
    write_whole(path, rendered(figure, path), force=force)


def rendered(figure: Figure, path: Path) -> bytes:
    """The picture in the format that the name asks for; the same run gives the same bytes."""
    refuse_format(path)
    out = io.BytesIO()
    suffix = path.suffix.lower().lstrip(".")
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
    with mpl.rc_context({"svg.hashsalt": "fkgen"}):
        figure.savefig(out, format=suffix, dpi=130, metadata=metadata[suffix])
    return out.getvalue()


def label_of(signal: Signal) -> str:
    """Name and unit of a signal, for an axis."""
    unit = f" ({signal.unit})" if signal.unit else ""
    return signal.name.replace("_", " ") + unit


def _panels_of(spec: Spec) -> list[Callable[..., None]]:
    """What draws each state, from where it stands in x and in covariances."""
    found: list[Callable[..., None]] = []
    at = places(spec.model.nx, spec.model.attitudes)
    for signal, (i, error, turns) in zip(spec.model.states, at, strict=True):
        drawn = partial(_draw_attitude, i=i) if turns else partial(_draw_state, i=i, error=error)
        found.append(partial(drawn, signal=signal))
    return found


def _draw_attitude(axis: Axes, sheet: _Sheet, signal: Signal, i: int) -> None:
    """The four numbers of a filtered unit quaternion; q or -q, whichever is nearer to the last."""
    q = sheet.run["filtered_state"][:, i : i + 4]
    turned = np.einsum("ki,ki->k", q[1:], q[:-1]) < 0.0
    drawn = np.concatenate([[1.0], np.cumprod(np.where(turned, -1.0, 1.0))]) * q.T
    for values, name, colour in zip(drawn, "wxyz", SHADES):  # noqa: B905
        axis.plot(sheet.time, values, color=colour, lw=1.2, label=name)
    axis.set_ylabel(label_of(Signal(signal.name)))
    axis.set_ylim(-1.05, 1.05)
    _mark_refused(axis, sheet)
    axis.legend(**_RIGHT)
    if i == 0:
        _entitle(axis, sheet)


def _mark_refused(axis: Axes, sheet: _Sheet) -> None:
    stopped, across = sheet.time[sheet.run.refused], axis.get_xaxis_transform()
    if stopped.size:
        foot = np.full(stopped.shape, 0.03)
        axis.plot(stopped, foot, "|", ms=5, color=ORANGE, transform=across, label="refused")


def _entitle(axis: Axes, sheet: _Sheet) -> None:
    samples, refused = len(sheet.time), int(sheet.run.refused.sum())
    text = f"{sheet.spec.name}: {sheet.spec.filter.family}, {samples} samples"
    axis.set_title(text + (f", {refused} refused" if refused else ""), fontsize=10)


def _draw_state(axis: Axes, sheet: _Sheet, signal: Signal, i: int, error: int) -> None:
    """One filtered state within three of its standard deviations."""
    mean = sheet.run["filtered_state"][:, i]
    band = np.zeros_like(mean)
    if "filtered_covariance" in sheet.run.ports:
        band = 3.0 * np.sqrt(np.maximum(sheet.run["filtered_covariance"][:, error, error], 0.0))
        area = (sheet.time, mean - band, mean + band)
        axis.fill_between(*area, color=BLUE, alpha=BAND, lw=0, label=r"$\pm 3\sigma$")
    for at, row in enumerate(sheet.read_by[i]):
        used = sheet.present[:, row] & ~sheet.rejected[:, row]
        label = None if at else "measured"
        axis.plot(sheet.time[used], sheet.y[used, row], ".", ms=2.0, color=GREY, label=label)
    if sheet.truth is not None:
        axis.plot(sheet.time, sheet.truth[:, i], color="black", lw=0.9, ls="--", label="true")
    axis.plot(sheet.time, mean, color=BLUE, lw=1.2, label=sheet.estimate)
    _mark_refused(axis, sheet)
    axis.set_ylabel(label_of(signal))
    # room for the state and its usual band: a vague start does not set the scale
    typical = np.minimum(band, 3.0 * np.nanmedian(band))
    low, high = float(np.nanmin(mean - typical)), float(np.nanmax(mean + typical))
    margin = 0.05 * (high - low) or 1.0
    finite = np.isfinite([low, high]).all()
    axis.set_ylim(*((low - margin, high + margin) if finite else (-1.0, 1.0)))
    if i == 0:
        _entitle(axis, sheet)
        axis.legend(**_RIGHT)


def _draw_innovation(axis: Axes, sheet: _Sheet, unit: str, rows: list[int]) -> None:
    """Innovations of the rows of one unit; rejected samples are left out, a start sets no scale."""
    values, rejected = sheet.run["innovation"].copy(), sheet.rejected
    left_out = np.where(np.isfinite(values), values, np.inf)
    values[rejected] = np.nan
    for i, colour in zip(rows, cycle(SHADES)):
        shown, name = np.isfinite(values[:, i]), sheet.spec.model.outputs[i].name.replace("_", " ")
        axis.plot(sheet.time[shown], values[shown, i], ".", ms=2.5, color=colour, label=name)
    axis.axhline(0.0, color="black", lw=0.6)
    axis.set_ylabel(f"innovation ({unit})" if unit else "innovation")
    size = np.abs(values[:, rows][np.isfinite(values[:, rows])])
    if size.size:
        reach = 1.3 * float(np.quantile(size, 0.995)) or 1.0
        axis.set_ylim(-reach, reach)
    if rejected[:, rows].any():
        low, high = axis.get_ylim()
        for i, colour in zip(rows, cycle(SHADES)):
            at = rejected[:, i]
            shown = np.clip(left_out[at, i], 0.95 * low, 0.95 * high)
            axis.plot(sheet.time[at], shown, "x", ms=5, color=colour)
        axis.plot([], [], "x", ms=2, color="black", label="rejected")
    axis.legend(**_ABOVE)


def _draw_nis(axis: Axes, sheet: _Sheet) -> None:
    """NIS with its two-sided bounds, or relative to the upper one where rows come and go."""
    from scipy.special import gammaincinv  # noqa: PLC0415 - scipy.stats would take a second

    soft = sheet.spec.faults.soft
    counted = slice(None) if soft is None else list(soft.host)
    rows = sheet.present[:, counted].sum(axis=1)
    used = (rows > 0) & (sheet.run.status == 0)
    if not used.any():
        axis.set_ylabel("NIS")
        return
    tail = 0.5 * (1.0 - _CONFIDENCE)
    low, high = (2.0 * gammaincinv(0.5 * rows[used], q) for q in (tail, 1.0 - tail))
    nis = sheet.run["nis"][used]
    inside = float(np.mean((nis >= low) & (nis <= high)))
    mixed = bool(np.ptp(rows[used]))
    values = nis / high if mixed else nis
    axis.semilogy(sheet.time[used], np.maximum(values, 1e-12), ".", ms=2.5, color=BLUE)
    bounds = (1.0,) if mixed else (float(low[0]), float(high[0]))
    for bound in bounds:
        axis.axhline(bound, color=ORANGE, lw=1.2)
    top = max(3.0 * bounds[-1], 1.5 * float(np.quantile(values, 0.999)))
    axis.set_ylim(max(1e-4 * bounds[-1], 0.2 * float(np.quantile(values, 0.005))), top)
    axis.set_ylabel("NIS / upper bound" if mixed else "NIS")
    degrees = "rows present" if mixed else f"{int(rows[used][0])} degrees of freedom"
    text = f"{inside:.1%} within the {_CONFIDENCE:.0%} bounds of chi-square ({degrees})"
    faults, told = sheet.spec.faults, sheet.spec.filter.traits.told
    if faults.jump is not None or (faults.sensor is not None and not told):
        text += "; a guide and no test: y with faults is a mixture"
    axis.set_title(text, color=GREY)


def _draw_modes(axis: Axes, sheet: _Sheet) -> None:
    probability = sheet.run["mode_probability"].T
    names = _mode_names(sheet.spec, len(probability))
    for values, name, colour in zip(probability, names, cycle(SHADES)):
        axis.plot(sheet.time, values, lw=1.4, color=colour, label=name)
    axis.set_ylim(-0.03, 1.03)
    axis.set_ylabel("probability")
    axis.legend(**_ABOVE)


def _mode_names(spec: Spec, count: int) -> list[str]:
    """What a mode stands for: success rates of the inputs, or a condition of the sensors."""
    if spec.faults.sensor is None:
        tried = spec.filter.option("hypotheses", ())
        rates = [", ".join(f"{rate:g}" for rate in each) for each in tried]
        return [f"rate {each}" for each in rates] or [f"mode {i}" for i in range(count)]
    noisy = f"noise x {spec.faults.sensor.noise_factor:g}"
    silent = ["no signal"] if count == 3 else ["no signal", f"no signal, {noisy}"]
    return ["signal", f"signal, {noisy}", *silent]


def _draw_verdicts(axis: Axes, sheet: _Sheet, soft: SoftFaults) -> None:
    """Statistic over threshold of every group at every end of a window; crosses are rejections."""
    from scipy.special import chdtri  # noqa: PLC0415 - scipy.stats would take a second

    statistic, dof, declared = (
        np.asarray(sheet.run[name], float).reshape(len(sheet.time), len(soft.groups))
        for name in ("test_statistic", "test_dof", "fault_declared")
    )
    names = [signal.name.replace("_", " ") for signal in sheet.spec.model.outputs]
    for at, (group, colour) in enumerate(zip(soft.groups, cycle(SHADES))):
        tested = dof[:, at] > 0
        time, rejected = sheet.time[tested], declared[tested, at] > 0
        ratio = statistic[tested, at] / np.asarray(chdtri(dof[tested, at], soft.false_alarm), float)
        values, label = np.maximum(ratio, _LOWEST), ", ".join(names[row] for row in group)
        axis.semilogy(time, values, ".", ms=4, color=colour, label=label)
        axis.semilogy(time[rejected], values[rejected], "x", ms=6, color=colour)
    axis.axhline(1.0, color="black", lw=0.8)
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, 1e-2), max(high, 1e1))
    axis.set_ylabel("test / threshold")
    axis.legend(**_ABOVE)
