"""The filter: its family and what the family has to know."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fkgen.spec.faults import SECTIONS
from fkgen.spec.place import Place, show, suggestion
from fkgen.spec.section import Section

Likelihood = Literal["mixture", "gaussian"]
CovarianceReading = Literal["moment_matched", "weighted", "paper", "paper_nominal"]
LinearForm = Literal["lemma2", "augmented"]
Detector = Literal["none", "llr", "nis", "energy"]
Gain = Literal["time_varying", "stationary"]
Maintenance = Literal["optimal", "paper"]

FAMILIES = ("kf", *SECTIONS)
LIKELIHOODS: tuple[Likelihood, ...] = ("mixture", "gaussian")
READINGS: tuple[CovarianceReading, ...] = ("moment_matched", "weighted", "paper", "paper_nominal")
FORMS: tuple[LinearForm, ...] = ("lemma2", "augmented")
DETECTORS: tuple[Detector, ...] = ("none", "llr", "nis", "energy")
GAINS: tuple[Gain, ...] = ("time_varying", "stationary")
MAINTENANCE: tuple[Maintenance, ...] = ("optimal", "paper")

#: Which options a family has, besides ``family``.
OPTIONS: dict[str, tuple[str, ...]] = {
    "mme": ("hypotheses", "prior", "weight_floor", "likelihood"),
    "one_step": ("covariance",),
    "imm": ("modes",),
    "linear_optimal": ("form",),
    "mjls_lmmse": (
        *("detector", "alpha", "kappa", "window"),
        *("lock_out", "reinitialise", "gain"),
    ),
    "compression_full": ("test", "reacquire"),
    "dfcf": ("test", "reacquire"),
    "cpcf": ("test", "reacquire", "maintenance"),
}
_KEYS = tuple(dict.fromkeys(key for keys in OPTIONS.values() for key in keys))
DEFAULT_FLOOR = 1e-6
DEFAULT_ALPHA = 0.01

#: Options that only some detectors have.
OF_DETECTORS: dict[str, tuple[Detector, ...]] = {
    "alpha": ("nis",),
    "kappa": ("energy",),
    "window": ("energy",),
    "lock_out": ("llr", "nis", "energy"),
    "reinitialise": ("llr", "nis", "energy"),
}


@dataclass(frozen=True, slots=True)
class Filter:
    """A family and its options; those of other families have their defaults.

    Parameters
    ----------
    family : str
        One of `FAMILIES`.
    hypotheses : tuple of tuple of float
        ``mme``: the N success rates that are tried, each as long as
        ``ActuatorFaults.success_rate`` is.
    prior : tuple of float
        ``mme``: their N probabilities at the start; they sum to one.
    weight_floor : float
        ``mme``: every hypothesis keeps this probability, in [0, 1/N).
    likelihood : str
        ``mme``: ``"mixture"`` (exact for the present sample) or ``"gaussian"``.
    covariance : str
        ``one_step``: how (7) is read; ``"moment_matched"``, ``"weighted"``, ``"paper"`` or
        ``"paper_nominal"``.
    modes : int
        ``imm``: of sensor faults 4, or 3 (without signal, both noise levels are one mode); of jump
        faults as many as the plant has.
    form : str
        ``linear_optimal``: ``"lemma2"`` (23) or ``"augmented"``.
    detector : str
        ``mjls_lmmse``: the test whether a sample was lost; ``"none"``, ``"llr"``, ``"nis"`` or
        ``"energy"``.
    alpha : float
        Of ``"nis"``: its rate of false alarms, in (0, 1).
    kappa, window : float and int
        Of ``"energy"``: a loss is declared when the mean of |r|^2 over the last ``window`` samples
        exceeds ``kappa`` times its expectation.
    lock_out : int
        With a detector: from this many rejections in a row on, the status says so.
    reinitialise : bool
        Whether a lock-out starts the filter again from the unconditional moments.
    gain : str
        ``mjls_lmmse``: ``"time_varying"`` or ``"stationary"``.
    test : bool
        Compression filters: False reports the statistic and rejects nothing.
    reacquire : int or None
        Compression filters: rejections in a row from which on the host is inflated; None: never.
    maintenance : str
        ``cpcf``: ``"optimal"`` or ``"paper"`` (44).
    """

    family: str
    hypotheses: tuple[tuple[float, ...], ...] = ()
    prior: tuple[float, ...] = ()
    weight_floor: float = DEFAULT_FLOOR
    likelihood: Likelihood = "mixture"
    covariance: CovarianceReading = "moment_matched"
    modes: int = 4
    form: LinearForm = "lemma2"
    detector: Detector = "none"
    alpha: float = DEFAULT_ALPHA
    kappa: float = 1.0
    window: int = 1
    lock_out: int = 10
    reinitialise: bool = False
    gain: Gain = "time_varying"
    test: bool = True
    reacquire: int | None = None
    maintenance: Maintenance = "optimal"

    def plain(self) -> dict[str, object]:
        """Return the table a spec file would hold."""
        table: dict[str, object] = {"family": self.family}
        for key in OPTIONS.get(self.family, ()):
            value = getattr(self, key)
            if value is None or (key in OF_DETECTORS and self.detector not in OF_DETECTORS[key]):
                continue
            table[key] = _listed(value) if isinstance(value, tuple) else value
        return table


def _listed(value: tuple[object, ...]) -> list[object]:
    return [list(entry) if isinstance(entry, tuple) else entry for entry in value]


def filter_section(table: object, place: Place) -> Section:
    """Return the section ``filter``, its keys checked and its family known to exist.

    Raises
    ------
    SpecError
        If the family is missing or unknown, or a key is unknown or belongs to another family.
    """
    section = Section(table, place, known=("family", *_KEYS))
    expected = f"one of {', '.join(FAMILIES)}"
    family = section.require("family", expected)
    where = place.entry("family")
    if not isinstance(family, str) or family not in FAMILIES:
        hint = suggestion(family, FAMILIES) if isinstance(family, str) else ""
        raise where.error(show(family), expected + hint)
    for key in _KEYS:
        owners = [name for name, keys in OPTIONS.items() if key in keys]
        if family not in owners and key in section:
            able = f"the family {owners[0]}" if len(owners) == 1 else ", ".join(owners)
            given = f"{key} for the family {family}"
            raise place.entry(key).error(given, f"{key} only for {able}")
    return section
