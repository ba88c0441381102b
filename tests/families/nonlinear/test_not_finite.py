"""Equations without a value where a filter is are refused, and nothing changes."""

from __future__ import annotations

import equations
import numpy as np
import pytest
from plants import built
from toolchain import needs_compiler

import fkgen
from fkgen.errors import StepRefused

pytestmark = needs_compiler()

MODEL = {
    "states": [{"name": "a"}, {"name": "b"}], "outputs": [{"name": "y"}],
    "Q": [[1e-6, 0.0], [0.0, 1e-6]], "R": [[0.1]], "x0": [3.0, 0.5],
    "P0": [[1e-4, 0.0], [0.0, 1e-4]],
}  # fmt: skip
SECTIONS = {
    "ekf": {},
    "imm": {
        "faults": {
            "jump": {
                "transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5],
                "modes": [{}, {"R": [[1.0]]}],
            }
        }
    },
    "genie": {"faults": {"sensor": {"noise_factor": 4.0, "rows": [0]}}},
}  # fmt: skip
#: f of a, and h; a is -1, where neither root nor logarithm has a value. Decisions hide that.
CASES = {
    "a root": ("a", "sqrt(a) + sin(b)"),
    "a motion": ("log(a) + 1", "a + sin(b)"),
    "a comparison": ("a", "if(log(a) > 0, sin(a), 2*b)"),
    "a comparison of the motion": ("if(log(a) > 0, sin(a), 2*b)", "a + sin(b)"),
    "a smaller one": ("a", "min(sqrt(a), 3) + b"),
    "a place in a table": ("a", "interp(log(a), 'curve') + b"),
}


@pytest.mark.parametrize("family", SECTIONS)
@pytest.mark.parametrize("case", CASES)
def test_a_sample_at_which_equations_have_no_value_is_refused(family, case):
    f, h = CASES[case]
    tables = {"curve": {"x": [0.0, 1.0], "y": [0.0, 1.0]}}
    model = MODEL | {"f": {"a": f}, "h": {"y": h}}
    given = equations.table(model, {}, family, tables=tables, **SECTIONS[family])
    found = built(fkgen.Spec.from_dict(given))
    told = {"gamma": 1.0, "delta": 1.0} if family == "genie" else None
    found.reset()
    assert found.step([1.0], None, told).status == 0
    found.reset(x0=[-1.0, 0.5])
    before = found.snapshot()
    with pytest.raises(StepRefused) as caught:
        found.step([1.0], None, told)
    assert caught.value.name == "PLANT_RESULT_NOT_FINITE"
    assert found.snapshot() == before
    run = found.run(np.ones((2, 1)), None, told, start={"x0": [-1.0, 0.5]})
    assert (run.status == -5).all()
    assert np.isfinite(run.filtered_state).all()
