"""iekf: a step to where h, or what it decides by, has no value is never taken."""

from __future__ import annotations

import equations
import numpy as np
import pytest
from plants import built
from toolchain import needs_compiler

import fkgen

pytestmark = needs_compiler()

MODEL = {
    "states": [{"name": "a"}], "outputs": [{"name": "y"}], "Q": [[0.01]], "R": [[0.1]],
    "x0": [100.0], "P0": [[1.0]], "f": {"a": "100 + 0.5*(a - 100)"},
}  # fmt: skip
#: h is a, nearly, and below 0 without a value, which all but the first hide in a decision.
CASES = {
    "a value": "a + 1e-9*log(a)",
    "a comparison": "if(log(a) > -100, a, a + 1e-9)",
    "the larger one": "a + 1e-9*max(log(a), -50)",
    "an infinity": "a + 1e-9*max(1/(1 + sign(a)), -50) + 1e-12*sin(a)",
    "a definition": "a + small",
}
PRIOR, P = 1.0, 10.0
GAIN = P / (P + 0.1)


def filter_of(h, iterations):
    model = MODEL | {"h": {"y": h}, "let": {"small": "1e-9*min(log(a), 50)"}}
    table = equations.table(model, {}, "iekf")
    table["filter"]["iterations"] = iterations
    return built(fkgen.Spec.from_dict(table))


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("case", CASES)
def test_the_estimate_stays_where_a_step_would_leave_the_domain(case, iterations):
    found = filter_of(CASES[case], iterations)
    found.reset(x0=[PRIOR], P0=[[P]])
    inside = found.update([3.0])
    assert inside.filtered_state == pytest.approx(PRIOR + GAIN * 2.0, abs=1e-7)
    found.reset(x0=[PRIOR], P0=[[P]])
    outside = found.update([-3.0])
    assert outside.stayed == 1.0
    assert outside.filtered_state[0] == PRIOR
    assert outside.filtered_covariance[0, 0] == pytest.approx((1.0 - GAIN) * P, rel=1e-6)
    assert outside.innovation[0] == pytest.approx(-4.0, abs=1e-6)
    assert np.isfinite(found.predict().predicted_state).all()


def test_steps_before_the_one_that_leaves_are_kept():
    # h = a**2 from 1 on y = 0.001: Newton halves a at each step; the decision ends at 0.4
    found = filter_of("if(sqrt(a - 0.4) >= 0, a**2, a**2 + 1e-9)", 5)
    found.reset(x0=[PRIOR], P0=[[1e6]])
    told = found.update([0.001])
    assert told.stayed == 1.0
    assert told.filtered_state[0] == pytest.approx((1.0 + 0.001) / 2.0, abs=1e-3)
