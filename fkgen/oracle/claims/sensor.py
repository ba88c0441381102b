"""Closed forms for filters over modes: textbook matrices, enumeration, joint moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fkgen.faults.sensor import is_white
from fkgen.oracle.claims.claim import Array, ClosedForm, Ports, Record, of_matrices, ports
from fkgen.oracle.claims.gaussian import digits_at_stake, likelihood_tolerance, system_of, undecided
from fkgen.oracle.exact.enumeration import enumerate_jumps
from fkgen.oracle.exact.moments import FaultMoments, satisfies_lemma_2
from fkgen.oracle.exact.uncertain import batch_uncertain
from fkgen.oracle.plants.jump import JumpSystem
from fkgen.oracle.plants.sensor import SensorLaw, is_lumpable, sensed_modes
from fkgen.oracle.textbook.linear_optimal import linear_optimal
from fkgen.oracle.textbook.switching import Lumping, interacting, silent_lumped, textbook_one_step
from fkgen.problem import Spec

#: An eigenvalue that is negative by less than this share of the largest entry may be rounding.
NEGLIGIBLE = 1e-9

PAPER = "Sigalov & Oshman"


def _one_step(spec: Spec, record: Record) -> Ports:
    system, law = system_of(spec, record), law_of(spec, record)
    covariance = spec.filter.options.covariance
    return ports(textbook_one_step(system, law, record.y, record.u, covariance=covariance))


def law_of(spec: Spec, record: Record) -> SensorLaw:
    """The law of the sensor with the parameters of a record."""
    return SensorLaw.over(spec, len(record.y), record.parameters)


def _conditions(spec: Spec, record: Record) -> tuple[JumpSystem, Lumping | None]:
    """The plant in each condition, and how the modes of imm are made of them."""
    if spec.faults.jump is not None:
        system = JumpSystem.from_spec(spec, len(record.y), record.parameters)
        return replace(system, P0=record.P0), None
    law, T = law_of(spec, record), len(record.y)
    lumps = spec.filter.option("modes", 4) == 3
    return sensed_modes(system_of(spec, record), law), silent_lumped(law, T) if lumps else None


def _imm(spec: Spec, record: Record) -> Ports:
    """All ports; without the estimates of single modes if one of them is impossible at times."""
    system, lumping = _conditions(spec, record)
    result = interacting(system, record.y, record.u, lumping)
    if result.mode_probability.all() and result.predicted_mode_probability.all():
        return ports(result)
    single = ("mode_state", "mode_covariance", "mode_filtered_state", "mode_filtered_covariance")
    return ports(result, *single)


def _enumerated(spec: Spec, record: Record) -> Ports | None:
    """Exact Bayes at sample 0, and at sample 1 if the first mode is certain."""
    system, lumping = _conditions(spec, record)
    if lumping is not None and not is_lumpable(SensorLaw.from_spec(spec))[0]:
        return None
    samples = 2 if system.initial.max() == 1.0 else 1
    exact = enumerate_jumps(system.over(slice(samples)), record.y[:samples], record.u[:samples])
    names = ["filtered_state", "log_likelihood", "mode_probability"]
    if spec.filter.option("covariance", "moment_matched") == "moment_matched":
        names.append("filtered_covariance")
    elif samples > 1:  # other readings go on with another covariance
        return None
    found = {name: getattr(exact, name) for name in names}
    if lumping is not None:
        found["mode_probability"] = found["mode_probability"] @ (lumping.shares > 0.0).T
    return found


def _moment_tolerance(spec: Spec, record: Record) -> float:
    """C - V of the closed form cancels where the state is far larger than its error."""
    x0 = spec.model.x0.values(spec.defaults | record.first).ravel()
    R = np.diag(spec.model.R.values(spec.defaults))
    size = float(np.max(np.abs(spec.model.C.values(spec.defaults) @ x0)) ** 2)
    noise = float(R[R > 0.0].min()) if (R > 0.0).any() else 1.0
    return max(digits_at_stake(spec, record), 1e4 * np.finfo(float).eps * (1.0 + size / noise))


def _moments(spec: Spec, record: Record) -> FaultMoments:
    return FaultMoments.from_spec(spec, len(record.y), record.parameters)


def _lemma_2_form(spec: Spec, record: Record) -> Ports | None:
    if spec.filter.options.form != "lemma2":
        return None
    system, moments = system_of(spec, record), _moments(spec, record)
    result = linear_optimal(system, moments, record.y, record.u)
    unused = ["offset", "estimate_second_moment"]
    ranks = np.linalg.matrix_rank(result.innovation_covariance, hermitian=True)
    if (ranks < spec.model.ny).any():  # rows that say the same may share the gain in any way
        unused.append("measurement_gain")
    found, sound = ports(result, *unused), _sound_samples(result.predicted_covariance)
    return {name: values[:sound] for name, values in found.items()}


def _sound_samples(predicted: Array) -> int:
    """How many samples it takes until C - V, which is no covariance without Lemma 2, is none."""
    least, size = np.linalg.eigvalsh(predicted)[:, 0], np.abs(predicted).max(axis=(1, 2))
    wrong = np.flatnonzero(least < -NEGLIGIBLE * size)
    return int(wrong[0]) + 1 if wrong.size else len(predicted)


def lemma_2_holds(spec: Spec) -> bool:
    """Whether Pr(gamma_k = 1 | gamma_i = 1) is the same for all i < k, and enough with all rows.

    Rows that cannot fail need a gamma that does not depend on its past: it does not multiply them.
    """
    faults = spec.faults.sensor
    if faults is None:
        return True
    healthy = len(faults.rows) < spec.model.ny
    if faults.moments is not None:
        return not healthy or faults.moments.gamma_rate == faults.moments.gamma_persistence
    if (faults.law or faults.first) is not None:
        return is_white(faults)
    law = SensorLaw.from_spec(spec)
    return satisfies_lemma_2(law.kernel, law.initial)[0] and (not healthy or is_white(faults))


def _linear_batch(spec: Spec, record: Record) -> Ports | None:
    if spec.filter.options.form == "lemma2" and not lemma_2_holds(spec):
        return None
    system, moments = system_of(spec, record), _moments(spec, record)
    return ports(batch_uncertain(system, moments, record.y, record.u), *undecided(spec))


ONE_STEP = ClosedForm(
    claim="estimates and probabilities are those of matrix filters, one for each sensor condition",
    source=f"{PAPER}, eqs. (3)-(14) with the covariance spelled out",
    tolerance=likelihood_tolerance,
    expected=of_matrices(_one_step),
)
IMM = ClosedForm(
    claim="estimates and probabilities are those of interacting matrix filters",
    source=f"Blom & Bar-Shalom 1988; {PAPER}, sec. IV, eqs. (15)-(18)",
    tolerance=likelihood_tolerance,
    expected=of_matrices(_imm),
)
ENUMERATION = ClosedForm(
    claim="exact Bayes as long as nothing is approximated: at sample 0, one more if the first mode"
    " is known",
    source="enumeration of all histories of modes",
    tolerance=likelihood_tolerance,
    expected=of_matrices(_enumerated),
)
LEMMA_2_FORM = ClosedForm(
    claim="gains and estimates are those of (23), the covariance is C - V",
    source=f"{PAPER}, eqs. (19)-(23)",
    tolerance=_moment_tolerance,
    expected=_lemma_2_form,
)
LINEAR_BATCH = ClosedForm(
    claim="estimates are the best linear ones given the second moments of all samples",
    source="projection on the joint second moments of states and measurements",
    tolerance=_moment_tolerance,
    expected=_linear_batch,
)
