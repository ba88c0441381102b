"""Records on which a filter is proved: drawn from its spec, where its equations have values.

Inputs and noises of about one leave the domain of many an f and h, such as the root of a level:
then they are gentler. What a filter computes is on trial, and any record tries that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from fkgen.errors import SpecError
from fkgen.oracle.claims.claim import Array, ClosedForm, Ports, Record
from fkgen.oracle.plants.actuator import actuation_of
from fkgen.oracle.plants.equations import is_nonlinear
from fkgen.oracle.sampled import draw_record
from fkgen.problem import Spec
from fkgen.problem.covariance import is_singular
from fkgen.problem.model import joint_noise
from fkgen.problem.table.place import show
from fkgen.runtime.refusals import estimates_of, fault_at
from fkgen.symbolic.plant import sensed_at_prior

#: Ratio of prior to measurement variance beyond which a milder prior takes the place of the spec's.
MILD = 1e4

#: Samples; fewer for large models, whose joint covariance grows with them. The fewest that are a
#: proof: samples that are whole, without a row, and missing are among them, and one after those.
LONG, SHORT, MANY_STATES = 6, 4, 8

#: Samples with measurements among the fewest that are a proof: one that corrects a prediction.
MEASURED = 2

#: Of the records.
SEED = 20130905

#: How far out, in terms of the largest entry, is what a gate meets.
OUTLIER = 30.0


@dataclass(frozen=True, slots=True)
class Gentle:
    """What a record is drawn with."""

    noise: float = 1.0  # Of the start and the noises, in deviations; of how parameters change
    size: float = 1.0  # Of the inputs
    offset: float = 0.0  # Of the inputs

    def inputs(self, drawn: Array) -> Array:
        """The inputs, of numbers of about one."""
        return self.offset + self.size * drawn


PLAIN = Gentle()

_SIZES = (1.0, 0.1, 0.01, 0.001)

#: As drawn, then gentler: inputs before noises; about 0, then about 1, where logarithms are.
GENTLER = tuple(
    Gentle(noise, size, offset)
    for noise, size, offset in product(_SIZES, _SIZES, (0.0, 1.0))
    if size <= noise
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A record, and how much of it is on trial."""

    whole: Record
    kept: Record  # The samples at which equations have values

    @property
    def is_cut(self) -> bool:
        """Whether equations have no value at the sample after those that are kept."""
        return len(self.kept.y) < len(self.whole.y)


def record_for(spec: Spec, forms: Sequence[ClosedForm]) -> Found:
    """The first record on which closed forms have values; if there is none, that with most.

    Raises
    ------
    SpecError
        If equations have no values at any samples to speak of.
    """
    if not is_nonlinear(spec):
        record, _ = trial(spec)
        return Found(whole=record, kept=record)
    best = -1, -1
    for given in GENTLER:
        record, lasting = trial(spec, given)
        count = _with_values(spec, forms, record)
        if (count, lasting) > best:
            best, whole = (count, lasting), record
        if min(best) == len(record.y):
            break
    if best[0] == len(whole.y):
        return Found(whole=whole, kept=whole)
    kept = whole.first_samples(best[0])
    if best[0] >= SHORT and np.isfinite(kept.y).any(axis=1).sum() >= MEASURED:
        return Found(whole=whole, kept=kept)
    if (told := _without_values(spec, forms, whole, best[0])) is not None:
        raise told
    plain, _ = trial(spec)  # another defect
    return Found(whole=plain, kept=plain)


def _with_values(spec: Spec, forms: Sequence[ClosedForm], record: Record) -> int:
    """At how many samples, from the first one on, closed forms have values."""
    counts = range(len(record.y), 0, -1)
    return next((n for n in counts if _has_values(spec, forms, record, n)), 0)


def _has_values(spec: Spec, forms: Sequence[ClosedForm], record: Record, count: int) -> bool:
    part = record.first_samples(count)
    return all(
        np.all(np.isfinite(value) | (np.isnan(part.y) if name == "innovation" else False))
        for found in _expected(spec, forms, part)
        for name, value in found.items()
    )


def _expected(spec: Spec, forms: Sequence[ClosedForm], record: Record) -> list[Ports]:
    """What closed forms say of a record; NaN if that has no decomposition."""
    found = []
    for form in forms:
        try:
            with np.errstate(all="ignore"):
                found.append(form.expected(spec, record) or {})
        except np.linalg.LinAlgError:
            found.append({"": np.array(np.nan)})
    return found


def _without_values(
    spec: Spec, forms: Sequence[ClosedForm], record: Record, count: int
) -> SpecError | None:
    """Which equation has no value at the sample after some of a record, if one has none."""
    given = record.u[count].tolist(), spec.defaults | record.sample(count)[2]
    x0 = spec.model.x0.values(given[1]).ravel()
    ports: dict[str, Array] = {"predicted_state": x0, "predicted_covariance": record.P0}
    if count:
        for each in _expected(spec, forms, record.first_samples(count)):
            ports |= {name: value[-1] for name, value in each.items() if len(value) == count}
    found, part = (
        fault_at(spec, estimates_of(ports, spec.equations, updated=False), "h", given),
        "h",
    )
    if found is None:
        for each in _expected(spec, forms, record.first_samples(count + 1)):
            ports |= {name: value[-1] for name, value in each.items() if value.shape}
        updated = "filtered_state" in ports
        part, where = "f", estimates_of(ports, spec.equations, updated=updated)
        found = fault_at(spec, where, part, given)
    if found is None:
        return None
    number, fault = found
    own = spec.model.equations is None or (
        spec.equations[number].said(part) != spec.model.equations.said(part)
    )
    section = f"faults.jump.modes[{number}]" if own else "model"
    return SpecError(
        f"{section}.{fault.key}",
        given=f"{show(fault.text)} with {fault.what} where the filter comes to from x0 "
        f"within {count + 1} samples ({fault.at})",
        expected="values there too: another x0, a smaller P0 or Q, or max(...) in the expression",
        file=spec.file,
    )


def trial(spec: Spec, given: Gentle = PLAIN, *, steady: bool = False) -> tuple[Record, int]:
    """A record from the model itself: random inputs, shaken parameters, missing rows.

    And the number of samples at which the plant that was drawn has values.
    """
    rng = np.random.default_rng(SEED)
    model = spec.model
    T = LONG if model.nx < MANY_STATES else SHORT
    parameters = {item.name: np.full(T, item.default) for item in spec.stated_parameters}
    if not steady:
        _vary(spec, parameters, rng, given.noise)
    u = rng.normal(size=(1 if steady else T, model.nu)).repeat(T if steady else 1, axis=0)
    u = given.inputs(u)
    y, drawn = draw_record(spec, parameters, u, rng, scale=given.noise)
    lasting = samples_with_values(y)
    if steady:
        drawn = {name: np.full(T, spec.defaults[name]) for name in drawn}
    else:
        if spec.filter.option("gate", None) is not None:
            _disturb(spec, y, rng)
        # none is missing at first, then row 0 alone, then all of them, then some
        missing = rng.random(y.shape) < 0.25
        missing[:3] = False
        missing[1, 0] = True
        missing[2] = True
        y[missing] = np.nan
    drawn |= _late(spec, T, rng, steady=steady or is_nonlinear(spec))
    return Record(y=y, u=u, parameters=drawn, P0=_mild_prior(spec, drawn)), lasting


def _late(spec: Spec, T: int, rng: np.random.Generator, *, steady: bool) -> dict[str, Array]:
    """How late rows are that may be: anything, or not at all."""
    late = [signal for signal in spec.model.outputs if signal.max_delay]
    most = [0 if steady else signal.max_delay for signal in late]
    return {
        s.delay: rng.integers(0, m + 1, T).astype(float) for s, m in zip(late, most, strict=True)
    }


def samples_with_values(y: Array) -> int:
    """At how many samples, from the first one on, a record as it was drawn has values."""
    return int(np.append(np.isfinite(y).all(axis=1), False).argmin())


def _disturb(spec: Spec, y: Array, rng: np.random.Generator) -> None:
    """Move rows far out, or whole samples where rows without noise may have to agree."""
    out = rng.random(y.shape) < 0.25
    out[3, 0] = True
    if is_singular(spec.model.R.values(spec.defaults)):
        y *= 1.0 + OUTLIER * out[:, :1]
    else:
        y += OUTLIER * np.abs(y).max() * out


def _vary(spec: Spec, parameters: dict[str, Array], rng: np.random.Generator, scale: float) -> None:
    """Shake parameters by some percent, sample by sample, where the model still makes sense."""
    for k in range(len(next(iter(parameters.values()), ()))):
        shaken = {
            name: v[k] * (1.0 + 0.05 * scale * rng.uniform(-1, 1)) for name, v in parameters.items()
        }
        if _makes_sense(spec, shaken):
            for name, value in shaken.items():
                parameters[name][k] = value


def _makes_sense(spec: Spec, parameters: Mapping[str, float]) -> bool:
    """Whether all matrices are finite, all covariances positive and all rates probabilities.

    And all parameters in their ranges.
    """
    if not all(item.low <= parameters[item.name] <= item.high for item in spec.stated_parameters):
        return False
    try:
        if not spec.faults.in_domain({**spec.defaults, **parameters}):
            return False
        covariances = [spec.model.P0, joint_noise(spec.model.Q, spec.model.S, spec.model.R)]
        for plant in (spec.model, *spec.plants):
            covariances += [plant.Q, plant.R]
            for letter in "ABCDcd" if plant.equations is None else "":
                getattr(plant, letter).values(parameters)
        for matrix in covariances:
            M = matrix.values(parameters)
            if np.linalg.eigvalsh(M)[0] < -1e-12 * np.abs(M).max():
                return False
        rate, _ = actuation_of(spec, 1, dict(parameters), spec.first_rates)
    except ArithmeticError:
        return False
    return bool(np.all((rate >= 0.0) & (rate <= 1.0)))


def _mild_prior(spec: Spec, parameters: Mapping[str, Array]) -> Array:
    """P0, scaled down where it dwarfs the measurement noise: a start value, not an equation.

    Not where P0 is part of the second moments that a gain depends on.
    """
    first = spec.defaults | {name: float(values[0]) for name, values in parameters.items()}
    C = sensed_at_prior(spec, spec.model, first)
    P0, R = (getattr(spec.model, m).values(first) for m in ("P0", "R"))
    noise, prior = np.diag(R), np.diag(C @ P0 @ C.T)
    known = (noise > 0.0) & (prior > 0.0)
    if spec.filter.traits.moments or not known.any():
        return np.asarray(P0)
    excess = float(np.max(prior[known] / noise[known])) / MILD
    return np.asarray(P0 / max(1.0, excess))
