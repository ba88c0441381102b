"""Best linear filter of a plant that jumps between modes, whose samples may be lost.

Costa 1994: linear in y, at a cost that does not grow with time; Sun, Zhao & Yin: losses detected by
a test, a rejected sample replaced by its prediction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, Self, get_args

import numpy as np

from fkgen.families.family import (
    Family,
    built_by,
    by_option,
    demand_noise,
    demand_stationary,
    proved_by,
)
from fkgen.faults import Faults, JumpFaults
from fkgen.faults.chain import MARGIN, is_ergodic, mean_square_radius
from fkgen.faults.jump import read_jump_faults
from fkgen.problem import Model, Spec
from fkgen.problem.filter import Options, Traits
from fkgen.problem.probability import stationary_law
from fkgen.problem.table.place import Place
from fkgen.problem.table.section import Section

Detector = Literal["none", "llr", "nis", "energy"]
Gain = Literal["time_varying", "stationary"]
DETECTORS: tuple[Detector, ...] = get_args(Detector)

SOURCE = "Costa 1994, sec. III; Costa, Fragoso & Marques 2005, sec. 5.4; Nahi 1969, eq. (13)"

DEFAULT_ALPHA = 0.01
LONGEST_WINDOW = 100

#: Options that only some detectors have.
OF_DETECTORS: dict[str, tuple[Detector, ...]] = {
    "alpha": ("nis",),
    "kappa": ("energy",),
    "window": ("energy",),
    "lock_out": ("llr", "nis", "energy"),
    "reinitialise": ("llr", "nis", "energy"),
}


@dataclass(frozen=True, slots=True)
class LossOptions(Options):
    """The test for lost samples, and the gain."""

    #: The test whether a sample was lost; "none", "llr", "nis" or "energy"
    detector: Detector = "none"
    alpha: float = DEFAULT_ALPHA  # Of "nis": its rate of false alarms, in (0, 1)
    #: kappa, window: Of "energy": a loss is declared when the mean of |r|^2 over the last
    #: window samples exceeds kappa times its expectation
    kappa: float = 1.0
    window: int = 1
    lock_out: int = 10  # With a detector: from this many rejections in a row on, the status says so
    #: Whether a lock-out starts the filter again from the unconditional moments
    reinitialise: bool = False
    gain: Gain = "time_varying"  # "time_varying" or "stationary"

    @classmethod
    def read(cls, section: Section, _: Faults, __: Model) -> Self:
        """Everything about the test; ``detector = true`` is the one that is recommended."""
        if isinstance(section.table.get("detector"), bool):
            section.table["detector"] = "llr" if section.table["detector"] else "none"
        detector = section.choice("detector", DETECTORS, "none")
        for key, owners in OF_DETECTORS.items():
            if key in section and detector not in owners and key != "alpha":
                raise section.place.entry(key).error(
                    f"{key} with detector = '{detector}'", f"{key} only with {' or '.join(owners)}"
                )
        return cls(
            detector,
            alpha=section.positive("alpha", DEFAULT_ALPHA, below=1.0),
            kappa=section.positive("kappa", 1.0),
            window=section.count("window", 1, LONGEST_WINDOW),
            lock_out=section.count("lock_out", 10, 10**6),
            reinitialise=section.flag("reinitialise", default=False),
            gain=section.choice("gain", get_args(Gain), "time_varying"),
        )

    def plain(self) -> dict[str, object]:
        """The keys that the detector has."""
        return {
            key: value
            for key, value in Options.plain(self).items()
            if self.detector in OF_DETECTORS.get(key, DETECTORS)
        }


def check(spec: Spec) -> None:
    """Refuse a detector that has nothing to detect, and a stationary gain that does not exist."""
    faults, options = spec.faults.jump, spec.filter.options
    if faults is None:
        return
    if options.detector == "llr":
        demand_noise(spec, "the detector llr")
    if options.detector != "none":
        _check_detector(faults, Place(spec.file).entry("faults").entry("jump"), options.detector)
    if options.gain == "stationary":
        _check_stationary(spec, faults)


def _check_detector(faults: JumpFaults, where: Place, detector: Detector) -> None:
    if faults.arrival == "always":
        given = "'always'" if faults.has_channel else "nothing about arrivals"
        raise where.entry("arrival").error(
            f"{given} with the detector {detector}",
            "arrival_rate or arrival_chain: a detector is about samples that may be lost",
        )
    if detector == "llr" and faults.arrival_rate is None:
        raise where.entry("arrival_rate").error(
            "nothing (the key is missing) with the detector llr",
            "Pr(a sample holds a signal): it is the prior of the likelihood ratio",
        )


def _check_stationary(spec: Spec, faults: JumpFaults) -> None:
    at = Place(spec.file).entry("filter").entry("gain")
    given, instead = "'stationary'", "use 'time_varying'"
    if not all(mode.is_constant for mode in faults.modes):
        raise at.error(f"{given} with matrices that depend on parameters", f"constants; {instead}")
    if any(each is not None for each in (faults.law, faults.rate, faults.arrivals, faults.first)):
        raise at.error(
            f"{given} with probabilities that depend on parameters", f"numbers; {instead}"
        )
    tested = spec.filter.options.detector != "none"
    alone = faults.gain_needs_no_moments(tested=tested)
    if spec.model.nu and not alone:
        raise at.error(
            f"{given} with inputs",
            f"a plant without B, or modes that differ in Q and R only and no sample that may be"
            f" lost unseen: an input moves the second moments at will; {instead}",
        )
    if not is_ergodic(faults.transition):
        raise at.error(
            f"{given} with a chain that has no limit",
            "an ergodic chain: one stationary law, and no cycle that it is bound to; " + instead,
        )
    chain = faults.arrival_chain
    if faults.arrival == "unknown" and chain and not is_ergodic(chain):
        raise at.error(
            f"{given} with an arrival_chain that alternates", f"a chain with a limit; {instead}"
        )
    if alone:
        law, first = np.array(stationary_law(faults.transition)), faults.modes[0]
        Q, R = (
            np.einsum("i,iab->ab", law, [getattr(mode, x).values() for mode in faults.modes])
            for x in "QR"
        )
        demand_stationary(at, first.A.values(), first.C.values(), Q, R)
        return
    dynamics = [mode.A.values(spec.defaults) for mode in faults.modes]
    radius = mean_square_radius(faults.transition, dynamics)
    if radius >= 1.0 - MARGIN:
        raise at.error(
            f"{given} where the second moments grow: the mean-square radius is {radius:.9g}",
            "a mean-square stable plant, radius below 1, or modes that differ in Q and R only and"
            f" no sample that may be lost unseen; {instead}, its gain follows the moments",
        )


FAMILY = Family(
    name="mjls_lmmse",
    title="plants that jump between modes, samples that are lost: best linear filter, loss tests",
    build=by_option(
        "gain",
        time_varying=built_by("lmmse.jump:jump_filter", source=SOURCE),
        stationary=built_by("lmmse.stationary:stationary_filter", source=SOURCE),
    ),
    proof=proved_by("jump", "PATHS", "TEXTBOOK"),
    traits=Traits(moments=True),
    instead="imm or mme",
    options=LossOptions,
    accepts={"jump": partial(read_jump_faults, arrivals=True)},
    check=check,
    starter="starter_mjls_lmmse.toml",
)
