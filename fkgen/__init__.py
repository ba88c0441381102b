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
    from fkgen.study.comparisons.comparison import compare
    from fkgen.study.comparisons.ranking import Comparison
    from fkgen.study.diagnostics.check import Finding, Report, check
    from fkgen.study.effects.detectability import Detectability, detectability
    from fkgen.study.effects.effect import FaultEffect
    from fkgen.study.effects.fault_effect import fault_effect
    from fkgen.symbolic.validated import Claim, Validated
    from fkgen.trials.simulation import Simulation, simulate

#: Where the lazily loaded names live.
_HOMES = {
    "Spec": "fkgen.problem",
    "load": "fkgen.problem",
    "validate": "fkgen.pipeline",
    "generate": "fkgen.pipeline",
    "compile": "fkgen.pipeline",
    "build": "fkgen.pipeline",
    "check": "fkgen.study.diagnostics.check",
    "Report": "fkgen.study.diagnostics.check",
    "Finding": "fkgen.study.diagnostics.check",
    "simulate": "fkgen.trials.simulation",
    "Simulation": "fkgen.trials.simulation",
    "compare": "fkgen.study.comparisons.comparison",
    "Comparison": "fkgen.study.comparisons.ranking",
    "fault_effect": "fkgen.study.effects.fault_effect",
    "FaultEffect": "fkgen.study.effects.effect",
    "detectability": "fkgen.study.effects.detectability",
    "Detectability": "fkgen.study.effects.detectability",
    "Claim": "fkgen.symbolic.validated",
    "Validated": "fkgen.symbolic.validated",
    "Source": "fkgen.backend.source",
    "CompiledFilter": "fkgen.runtime.compiled",
    "Run": "fkgen.runtime.results",
    "Snapshot": "fkgen.runtime.results",
}

#: Modules that are public as they are.
_MODULES = {"profiles": "fkgen.profiles"}

__all__ = [
    "Claim",
    "Comparison",
    "CompiledFilter",
    "CompilerError",
    "DataError",
    "Detectability",
    "FaultEffect",
    "Finding",
    "FkgenError",
    "InternalError",
    "OutputError",
    "Report",
    "Run",
    "Simulation",
    "Snapshot",
    "Source",
    "Spec",
    "SpecError",
    "StepRefused",
    "UserError",
    "Validated",
    "ValidationError",
    "__version__",
    "build",
    "check",
    "compare",
    "compile",
    "detectability",
    "fault_effect",
    "generate",
    "load",
    "profiles",
    "simulate",
    "validate",
]


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used."""
    if name in _MODULES:
        value: Any = import_module(_MODULES[name])
    elif name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'fkgen' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
