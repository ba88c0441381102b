"""Peak memory of a long record.

The peak is VmHWM of the process itself: what getrusage says may be its parent's, from before exec.
"""

from __future__ import annotations

import json
import subprocess
import sys

from harness import models
from harness.report import Table, verdict
from harness.settings import Settings

import fkgen

_SAMPLES = 1_000_000
_MARGIN = 60.0

_SCRIPT = r"""
import json, re, sys
import numpy as np
import fkgen
spec, kept, samples = json.loads(sys.argv[1]), sys.argv[2], int(sys.argv[3])
from fkgen.runtime.compiled import CompiledFilter
{work}
print(int(re.search(r"VmHWM:\s*(\d+)", open("/proc/self/status").read())[1]) / 1024.0)
"""
_INPUTS = "y, u = np.ones((samples, 1)), np.ones((samples, 1))\n"
_BASELINE = (
    _INPUTS + "x = np.zeros((samples, 2)); x[:] = 1.0; s = np.zeros(samples, np.int32); s[:] = 1"
)
_RUN = "motor = fkgen.build(fkgen.Spec.from_dict(spec))\n" + _INPUTS
_RUN += "run = motor.run(y, u, keep=[kept])"


def peak(settings: Settings) -> Table:
    """Peak resident memory of processes that do more and more."""
    del settings
    arrays = _SAMPLES * (1 + 1 + 2) * 8 / 2**20
    table = Table(
        f"Memory of {_SAMPLES} samples of the motor",
        ["process", "peak, MiB", "above the imports", "limit", "met"],
        'mkf, u and y of one column each, keep = ["filtered_state"]: inputs and outputs are '
        f"{arrays:.1f} MiB, the status 3.8. Limit: inputs + outputs + {_MARGIN:.0f} MiB above the "
        "imports.",
    )
    fkgen.build(fkgen.Spec.from_dict(models.mkf()))
    imports, baseline, run = (_measure(work) for work in ("", _BASELINE, _RUN))
    limit = arrays + _MARGIN
    table.add("imports", f"{imports:.1f}", "", "", "")
    above = f"{baseline - imports:.1f}"
    table.add("imports, inputs and outputs", f"{baseline:.1f}", above, "", "")
    used = run - imports
    met = verdict(used, limit)
    table.add("build (cached) and run", f"{run:.1f}", f"{used:.1f}", f"{limit:.1f}", met)
    return table


def _measure(work: str) -> float:
    arguments = [json.dumps(models.mkf()), "filtered_state", str(_SAMPLES)]
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT.replace("{work}", work), *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return float(done.stdout)
