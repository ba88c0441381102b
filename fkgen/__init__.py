"""fkgen: fault-tolerant filters from a model to verified C99.

The names below are the whole contract; everything else may change. Importing fkgen is cheap:
CasADi and its kin are loaded when a filter is first built.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fkgen.errors import (
    CompilerError,
    DataError,
    FkgenError,
    InternalError,
    OutputError,
    SpecError,
    StepRefused,
    UserError,
    ValidationError,
)
from fkgen.version import __version__

if TYPE_CHECKING:
    from fkgen import profiles
    from fkgen.backend.source import Source
    from fkgen.pipeline import build, compile, generate, validate
    from fkgen.problem import Spec, load
    from fkgen.runtime.compiled import CompiledFilter
    from fkgen.runtime.results import Run, Snapshot
    from fkgen.study.campaigns.campaign import montecarlo
    from fkgen.study.campaigns.results import Campaign
    from fkgen.study.campaigns.sweep import Sweep, sweep
    from fkgen.study.comparisons.comparison import compare
    from fkgen.study.comparisons.ranking import Comparison
    from fkgen.study.diagnostics.check import Finding, Report, check
    from fkgen.study.effects.detectability import Detectability, detectability
    from fkgen.study.effects.effect import FaultEffect
    from fkgen.study.effects.fault_effect import fault_effect
    from fkgen.study.fitting.autocovariance import Autocovariance, autocovariance
    from fkgen.study.fitting.fit import Fit, fit
    from fkgen.study.fitting.profile import Profile
    from fkgen.study.page.page import Page, report
    from fkgen.symbolic.validated import Claim, Validated
    from fkgen.trials.simulation import Simulation, simulate

#: Where the lazily loaded names live.
_HOMES = {
    "fkgen.problem": ("Spec", "load"),
    "fkgen.pipeline": ("validate", "generate", "compile", "build"),
    "fkgen.study.diagnostics.check": ("check", "Report", "Finding"),
    "fkgen.trials.simulation": ("simulate", "Simulation"),
    "fkgen.study.campaigns.campaign": ("montecarlo",),
    "fkgen.study.campaigns.results": ("Campaign",),
    "fkgen.study.campaigns.sweep": ("sweep", "Sweep"),
    "fkgen.study.comparisons.comparison": ("compare",),
    "fkgen.study.comparisons.ranking": ("Comparison",),
    "fkgen.study.effects.fault_effect": ("fault_effect",),
    "fkgen.study.effects.effect": ("FaultEffect",),
    "fkgen.study.effects.detectability": ("detectability", "Detectability"),
    "fkgen.study.fitting.autocovariance": ("autocovariance", "Autocovariance"),
    "fkgen.study.fitting.fit": ("fit", "Fit"),
    "fkgen.study.fitting.profile": ("Profile",),
    "fkgen.study.page.page": ("report", "Page"),
    "fkgen.symbolic.validated": ("Claim", "Validated"),
    "fkgen.backend.source": ("Source",),
    "fkgen.runtime.compiled": ("CompiledFilter",),
    "fkgen.runtime.results": ("Run", "Snapshot"),
}

__all__ = ["Autocovariance", "Campaign", "Claim", "Comparison", "CompiledFilter", "Detectability"]
__all__ += ["FaultEffect", "Finding", "Fit", "Page", "Profile", "Report", "Run", "Simulation"]
__all__ += ["Snapshot", "Source", "Spec", "Sweep", "Validated"]
__all__ += ["CompilerError", "DataError", "FkgenError", "InternalError", "OutputError"]
__all__ += ["SpecError", "StepRefused", "UserError", "ValidationError", "__version__"]
__all__ += ["autocovariance", "build", "check", "compare", "compile", "detectability"]
__all__ += ["fault_effect", "fit", "generate", "load", "montecarlo", "profiles", "report"]
__all__ += ["simulate", "sweep", "validate"]


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used."""
    home = next((home for home, names in _HOMES.items() if name in names), None)
    if name == "profiles":
        value: Any = import_module("fkgen.profiles")
    elif home is not None:
        value = getattr(import_module(home), name)
    else:
        raise AttributeError(f"module 'fkgen' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
