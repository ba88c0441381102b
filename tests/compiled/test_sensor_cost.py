"""What a step costs that mixes the estimates of several conditions of a sensor."""

from __future__ import annotations

import re

import numpy as np
import pytest
from plants import generated, spec

DT = 0.1
DRIFT = [[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]

#: A target of constant velocity in the plane whose position is measured.
TARGET = {
    "A": np.kron(np.eye(2), [[1.0, DT], [0.0, 1.0]]).tolist(),
    "C": np.kron(np.eye(2), [[1.0, 0.0]]).tolist(),
    "Q": np.kron(np.eye(2), np.multiply(2.0, DRIFT)).tolist(),
    "R": [[0.25, 0.0], [0.0, 0.25]],
    "x0": [0.0] * 4,
    "P0": np.diag([4.0, 9.0, 4.0, 9.0]).tolist(),
}

#: delta is drawn anew for every sample, which lumps the conditions without signal together.
INDEPENDENT_NOISE = {
    "problem": 3,
    "gamma_chain": [[0.7, 0.3], [0.05, 0.95]],
    "delta_chain": [[0.8, 0.2], [0.8, 0.2]],
}

#: Both chains remember: columns of the kernel agree on pairs of modes, which are merged once.
TWO_CHAINS = INDEPENDENT_NOISE | {"delta_chain": [[0.8, 0.2], [0.6, 0.4]]}

#: No two columns are proportional and no entry is zero: nothing can be shared between the modes.
GENERAL = {
    "problem": 4,
    "kernel": [
        [0.85, 0.09, 0.05, 0.01],
        [0.40, 0.50, 0.04, 0.06],
        [0.25, 0.05, 0.60, 0.10],
        [0.08, 0.22, 0.30, 0.40],
    ],
}

LIMITS = {
    "3 modes, independent noise": (INDEPENDENT_NOISE, 3, 950),
    "4 modes, independent noise": (INDEPENDENT_NOISE, 4, 1400),
    "4 modes, two chains": (TWO_CHAINS, 4, 1490),
    # Four merges of four Gaussians by halves, 229 operations each, in place of those shared above.
    "4 modes, general kernel": (GENERAL, 4, 1770),
}


def source_of(law, modes):
    return generated(spec(TARGET, family="imm", modes=modes, sensor={"noise_factor": 10.0, **law}))


@pytest.mark.parametrize("name", list(LIMITS))
def test_a_step_of_interacting_models_costs_no_more_than_it_should(name):
    law, modes, limit = LIMITS[name]
    source = source_of(law, modes)
    assert 0 < source.program.flops <= limit
    printed = re.search(r"Cost of one step[^:]*: (\d+) floating", source.files["plant.h"])
    assert int(printed[1]) == source.program.flops


def test_lumping_the_conditions_without_signal_makes_a_step_cheaper():
    lumped, apart = (source_of(INDEPENDENT_NOISE, modes).program.flops for modes in (3, 4))
    assert lumped < apart
