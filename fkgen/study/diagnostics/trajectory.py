"""Where a plant with f and h goes and its filter with it: what y says of the state along the way.

The filter runs, as generated, over a record or over a trial that is drawn from the spec. From
estimates on the way the plant moves on without noise over a window of samples, linearised where it
is: y of the window then determines the state at its beginning, or leaves directions open.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fkgen.backend.execute import Machine
from fkgen.backend.lower import lower
from fkgen.errors import DataError
from fkgen.families import family
from fkgen.oracle.exact.gaussian import square_root
from fkgen.oracle.plants.actuator import actuation_of
from fkgen.oracle.plants.equations import system_of
from fkgen.oracle.plants.nonlinear import NonlinearSystem
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.runtime import record
from fkgen.study.diagnostics.subject import Array, Subject, listed
from fkgen.trials.errors import error_signals

SAMPLES = 200  # of a trial
LONGEST = 1000  # of a record
WINDOW = 50  # samples, more for many states
WINDOWS = 20

#: Singular values of scaled matrices that count as zero, and shares of a direction that are none.
_OPEN, _NOTHING = 1e-9, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What a plant is driven by, and what was measured if it was: y (T, p), u (T, q), (T,) each."""

    u: Array
    params: Mapping[str, Array]
    y: Array | None = None
    of: str = "a trial"

    @classmethod
    def standing(cls, spec: Spec, u: Array | None) -> Drive:
        """Constant inputs, zero if there are none given, and parameters at their defaults."""
        q = spec.model.nu
        inputs: Array = np.zeros(q) if u is None else u
        stated = {each.name: np.full(SAMPLES, each.default) for each in spec.stated_parameters}
        shown = ", ".join(f"{each:g}" for each in inputs)
        shown = f" with u = {shown if inputs.any() else 0}" if q else ""
        return cls(np.tile(inputs, (SAMPLES, 1)), stated, of=f"a trial{shown}")

    def drawn(self, spec: Spec) -> Drive:
        """The same with measurements, drawn from the spec unless they are there."""
        if self.y is not None:
            return self
        rng = np.random.default_rng(20130905)
        with np.errstate(all="ignore"):
            y, params = draw_record(spec, dict(self.params), self.u, rng)
        return replace(self, y=y, params=params)


def drive_of(
    spec: Spec,
    y: ArrayLike | None = None,
    u: ArrayLike | None = None,
    params: Mapping[str, ArrayLike] | None = None,
) -> Drive:
    """What somebody gives of a record, checked; without y and a u by samples a trial."""
    q, p = spec.model.nu, spec.model.ny
    constant = None
    if y is None and u is not None and np.ndim(u) < 2 and np.size(u) == q:
        constant = np.asarray(record.numbers("u", u, np.float64), float).ravel()
    if y is None and (u is None or constant is not None):
        drive = Drive.standing(spec, constant)
        T, measured = SAMPLES, None
    else:
        measured = None if y is None else np.asarray(record.signal("y", y, p, np.float64), float)
        T = len(np.atleast_1d(np.asarray(u if measured is None else measured)))
        drive = Drive(np.zeros((T, q)), {}, measured, "the record")
    named = {item.name: item.default for item in spec.parameters}
    values = record.values_of(tuple(named.items()), params, T, np.float64)
    given = {n: np.broadcast_to(v, (T,)).astype(float) for n, v in zip(named, values, strict=True)}
    inputs = drive.u
    if constant is None and u is not None:
        inputs = np.asarray(record.signal("u", u, q, np.float64), float)
    if inputs.shape != (T, q) or not np.isfinite(inputs).all():
        expected = f"finite numbers of shape ({T}, {q}), or ({q},)"
        raise DataError("u", given=f"shape {inputs.shape}", expected=expected)
    part = slice(0, LONGEST)
    cut = {name: each[part] for name, each in given.items()}
    return replace(
        drive, u=inputs[part], params=cut, y=None if measured is None else measured[part]
    )


class Trajectory:
    """A filter over what drives it."""

    def __init__(self, spec: Spec, drive: Drive) -> None:
        self.spec = replace(spec.whole, code=replace(spec.whole.code, scalar="double"))
        self.drive = drive.drawn(self.spec)
        self.T = len(self.drive.u)
        self._run()

    def _run(self) -> None:
        spec, drive, model = self.spec, self.drive, self.spec.model
        machine, ne = Machine(lower(family(spec.filter.family).build(spec))), model.ne
        rows, columns = np.tril_indices(ne)

        def estimate(which: str) -> tuple[Array, Array]:
            P = np.zeros((ne, ne))
            P[rows, columns] = P[columns, rows] = machine.ports[f"{which}_covariance"]
            return np.array(machine.ports[f"{which}_state"], float), P

        prior = model.x0.values(spec.defaults)[:, 0], model.P0.values(spec.defaults)
        found: dict[str, list[tuple[Array, Array]]] = {"predicted": [], "filtered": []}
        accepted = []
        for k in range(self.T):
            told = {name: float(values[k]) for name, values in drive.params.items()}
            y = np.zeros(model.ny) if drive.y is None else drive.y[k]
            accepted.append(machine.step(drive.u[k], y, told).value >= 0)
            found["predicted"].append(prior)
            found["filtered"].append(estimate("filtered") if accepted[-1] else prior)
            prior = estimate("predicted") if accepted[-1] else prior
        self.accepted = np.array(accepted, bool)
        #: (T, nx), (T, ne, ne) each: x(k|k-1), x(k|k) and their covariances
        self.predicted, self.filtered = (
            tuple(np.array(each) for each in zip(*found[which], strict=True))
            for which in ("predicted", "filtered")
        )

    @cached_property
    def systems(self) -> tuple[NonlinearSystem, ...]:
        """The plant, or every mode of it, over the samples."""
        jump = self.spec.faults.jump
        plants = (None,) if jump is None else jump.modes
        return tuple(system_of(self.spec, self.T, self.drive.params, each) for each in plants)

    @cached_property
    def u(self) -> Array:
        """Inputs as they arrive on average, (T, q)."""
        spec = self.spec
        if spec.faults.actuator is None:
            return self.drive.u
        rate, _ = actuation_of(spec, self.T, self.drive.params, spec.first_rates)
        return np.asarray(rate * self.drive.u)

    def windows(self) -> list[int]:
        """Where windows begin that have samples enough."""
        length = self.length
        last = self.T - length
        count = min(WINDOWS, last // length + 1)
        return [int(k) for k in np.linspace(0, last, count)]

    @property
    def length(self) -> int:
        """Samples of a window."""
        return min(self.T, max(WINDOW, 5 * self.spec.model.ne))


def seen_through(system: NonlinearSystem, x: Array, u: Array, start: int, count: int) -> Array:
    """What y of some samples is by errors of the state at the first, in deviations, (count p, ne).

    Rows of a singular R are of length one.
    """
    space = system.space
    through, rows = np.eye(space.ne), []
    x = space.normal(x)
    for k in range(start, start + count):
        H: Array = system.seen(k, x, u[k]).H
        if is_singular(system.R[k]):
            size = np.linalg.norm(H, axis=1, keepdims=True)
            H = np.divide(H, size, out=np.zeros_like(H), where=size > 0.0)
        else:
            H = np.asarray(np.linalg.solve(square_root(system.R[k]), H), np.float64)
        rows.append(H @ through)
        moved = system.moved(k, x, u[k])
        x, through = moved.x, moved.F @ through
    return np.vstack(rows)


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """What the measurements of a window say of the state at its beginning."""

    start: int
    open: Array  # (h, ne): directions of which they say nothing
    deviation: Array  # (ne,): how well they alone determine each number; infinite if not


def window_of(
    systems: Sequence[NonlinearSystem], x: Array, u: Array, start: int, count: int
) -> Window | None:
    """The window that begins with an estimate, seen by modes; None if f or h has no value in it."""
    each = [seen_through(system, x, u, start, count) for system in systems]
    stacked = np.vstack(each)
    if not np.isfinite(stacked).all():
        return None
    scale = np.linalg.norm(stacked, axis=0)
    scale[scale == 0.0] = 1.0
    _, singular, right = np.linalg.svd(stacked / scale, full_matrices=True)
    values = np.zeros(len(right))
    values[: len(singular)] = singular
    seen = values > _OPEN * max(1.0, values.max(initial=0.0))
    deviation = np.linalg.norm(right[seen].T / values[seen], axis=1) / scale
    lost = right[~seen]
    deviation[(np.abs(lost) > _OPEN).any(axis=0)] = np.inf
    return Window(start, lost / scale, np.asarray(deviation))


def observability(model: Subject, path: Trajectory) -> None:
    """Directions that windows of measurements leave open, and those of which they say little.

    Of several modes: what none of them shows, then what some of them do not.
    """
    units, state = np.sqrt(np.diag(model.P0).clip(0.0)), path.filtered[0]

    def windows(*systems: NonlinearSystem) -> dict[int, Window]:
        given = ((k, window_of(systems, state[k], path.u, k, path.length)) for k in path.windows())
        return {k: window for k, window in given if window is not None}

    found, several = windows(*path.systems), len(path.systems) > 1
    if not found:  # what that comes from is a finding of its own
        return
    own = [windows(each) for each in path.systems] if several else [found]
    best = np.min([each.deviation for of_mode in own for each in of_mode.values()], axis=0)
    model.put("observation_sd", model.states, best)
    blind = [each for each in found.values() if len(each.open)]
    model.values["unobservable_windows"] = float(len(blind))
    facts = {"length": path.length, "of": path.drive.of, "windows": len(found)}
    if several:
        _blind_modes(model, found, own, units, facts)
    if blind:
        always = len(blind) == len(found)
        sign = 1 if always else -1  # what no window shows, or what some do not
        worst = min(blind, key=lambda each: (sign * len(each.open), each.start))
        code = "unobservable.trajectory" if always else "unobservable.sometimes"
        starts = listed([str(each.start) for each in blind[:4]])
        more = " ..." * (len(blind) > 4)
        names = _direction(model, worst.open, units)
        facts |= {"names": names, "starts": f"{starts}{more}", "k": len(blind)}
        facts["whom"] = " of any mode" * several
        model.add(code, len(worst.open), **facts)
        return
    signals = zip(error_signals(model.spec.model.states), best, units, strict=True)
    for signal, sd, prior in signals:
        if 0.0 < prior < sd < np.inf:
            model.add("weakly_observable", float(sd), name=signal.name, prior=prior, **facts)


def _blind_modes(
    model: Subject,
    together: Mapping[int, Window],
    own: Sequence[Mapping[int, Window]],
    units: Array,
    facts: dict[str, Any],
) -> None:
    """What modes do not show in any window, though others do."""
    modes: dict[str, list[str]] = {}
    for m, windows in enumerate(own):
        model.values[f"unobservable_windows.{m}"] = float(
            sum(bool(len(w.open)) for w in windows.values())
        )
        extra = [len(w.open) - len(together[k].open) for k, w in windows.items() if k in together]
        if extra and min(extra) > 0:
            worst = min(windows.values(), key=lambda each: (len(each.open), each.start))
            modes.setdefault(_direction(model, worst.open, units), []).append(str(m))
    for names, which in modes.items():
        plural = "s" * (len(which) > 1)
        told = facts | {"names": names, "modes": listed(which), "plural": plural}
        model.add("unobservable.mode", len(which), **told)


def _direction(model: Subject, directions: Array, units: Array) -> str:
    """The states of directions, of one of them with their shares in deviations of the prior."""
    scale = np.where(units > 0.0, units, 1.0)
    shares = directions / scale
    shares /= np.abs(shares).max(axis=1, keepdims=True)
    involved = [int(i) for i in np.flatnonzero((np.abs(shares) > _NOTHING).any(axis=0))]
    names = listed([model.states[i] for i in involved])
    if len(involved) == len(directions):
        return names
    if len(directions) > 1:
        return f"{len(directions)} combinations of {names}"
    shown = " : ".join(f"{shares[0, i] / shares[0, involved[0]]:.3g}" for i in involved)
    return f"one combination of {names} ({shown} in deviations of P0)"


def spread(model: Subject, path: Trajectory) -> None:
    """Standard deviations in the second half, as a value and a note."""
    half = path.T // 2
    P, M = (each[1][half:].mean(axis=0) for each in (path.filtered, path.predicted))
    sd, before = (np.sqrt(np.diag(each).clip(0.0)) for each in (P, M))
    model.put("stationary_sd", model.states, sd)
    model.put("stationary_predicted_sd", model.states, before)
    shown = zip(error_signals(model.spec.model.states), sd, strict=True)
    texts = (f"{signal.name} {value:.3g} {signal.unit}".rstrip() for signal, value in shown)
    model.add("stationary_sd.trajectory", of=path.drive.of, deviations=", ".join(texts))
    refused = int((~path.accepted).sum())
    if refused:
        first = int(np.argmin(path.accepted))
        model.add("trajectory_refused", refused, of=path.drive.of, first=first, samples=path.T)
