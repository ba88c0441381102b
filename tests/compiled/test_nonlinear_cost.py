"""Steps of extended filters take no more operations than those that are arranged by hand."""

from __future__ import annotations

import extended
import numpy as np
import pytest
from hand_forms import Counted

import fkgen
from fkgen.backend.lower import lower
from fkgen.families import family

FACTOR = 1.10


def plain(value, p):
    if isinstance(value, dict):
        return np.array([[value[max(i, j), min(i, j)].value for j in range(p)] for i in range(p)])
    if isinstance(value, list):
        return np.array([each.value for each in value])
    return value.value if isinstance(value, Counted) else value


@pytest.mark.parametrize("name", extended.CASES)
def test_a_step_takes_at_most_a_tenth_more_operations_than_by_hand(name):
    spec = extended.spec_of(name)
    u, y = extended.sample_of(spec)
    run = fkgen.build(spec).run(y, u)
    found, operations = extended.arranged(name)
    found["innovation_covariance"] = found.pop("S")
    for port, value in found.items():
        expected = plain(value, spec.model.ny)
        np.testing.assert_allclose(run[port][0], expected, rtol=1e-11, atol=1e-13, err_msg=port)
    assert set(found) == set(run.ports)
    program = lower(family("ekf").build(spec))
    assert sum(program.operations.values()) <= FACTOR * operations
