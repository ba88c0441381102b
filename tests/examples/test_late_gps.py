"""The flight of examples/late_gps: fixes that are known to be late, and some that are not."""

from __future__ import annotations

import numpy as np
import pytest
from scripts import scripts_of

pytestmark = pytest.mark.compiled


def test_the_numbers_of_the_page():
    with scripts_of("late_gps", "prepare", "run") as (prepare, run):
        flight = prepare.read()
        rms = run.errors(flight, *run.estimates(flight))
        late = flight.delay[flight.delay > 0]
        assert (late.size, late.min(), late.max()) == (575, 3, 8)
        found = np.array([rms[way] for way in run.WAYS])
        page = [[0.17, 0.24, 0.19, 0.20], [0.20, 0.27, 0.39, 0.39], [0.47, 0.30, 0.40, 0.39]]
        np.testing.assert_allclose(found, page, atol=0.0075)
        assert not run.missed(rms)
        swapped = dict(zip(run.WAYS, found[[0, 2, 1]], strict=True))
        assert len(run.missed(swapped)) == 2
