"""Reference filters over modes of the plant: the sum over histories, and where imm is exact."""

from __future__ import annotations

import numpy as np
import pytest
from imm_plants import (
    BAYES,
    HOLES,
    KALMAN,
    PLANTS,
    TURN,
    by_histories,
    plant,
    seen,
    system_of,
    told,
)
from sensor_plants import close

from fkgen.errors import DataError
from fkgen.oracle.exact.batch import batch_lmmse
from fkgen.oracle.exact.enumeration import enumerate_jumps
from fkgen.oracle.textbook.switching import interacting


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("name", ["everything", "offsets", "measurement"])
def test_the_sum_over_histories_is_that_of_joint_densities(name, missing):
    spec = plant(name)
    y, u = seen(spec, 4, seed=2, missing=missing)
    system = system_of(spec, 4)
    result, expected = enumerate_jumps(system, y, u), by_histories(system, y, u)
    assert result.log_likelihood.sum() == pytest.approx(expected.pop("log_likelihood"), rel=1e-10)
    for port, value in expected.items():
        np.testing.assert_allclose(
            getattr(result, port)[-1], value, rtol=1e-9, atol=1e-10, err_msg=port
        )


@pytest.mark.parametrize("name", list(PLANTS))
def test_the_first_sample_is_bayes_rule_itself(name):
    spec = plant(name)
    y, u = seen(spec, 2, seed=3)
    system = system_of(spec, 2)
    close(interacting(system, y, u), enumerate_jumps(system, y, u), BAYES, rows=slice(1))


@pytest.mark.parametrize("mode", range(3))
@pytest.mark.parametrize("name", list(PLANTS))
def test_a_known_first_mode_makes_two_samples_exact(name, mode):
    spec = plant(name, initial=np.eye(3)[mode])
    y, u = seen(spec, 2, seed=4)
    system = system_of(spec, 2)
    exact = enumerate_jumps(system, y, u)
    result = interacting(system, y, u)
    close(result, exact, BAYES)
    possible = exact.mode_probability[1] > 0.0
    for port in ("mode_filtered_state", "mode_filtered_covariance"):
        np.testing.assert_allclose(
            getattr(result, port)[1, possible], getattr(exact, port)[1, possible], rtol=1e-10
        )


@pytest.mark.parametrize("start", range(3))
def test_known_modes_make_the_kalman_filter_that_is_told_them(start):
    spec = plant("everything", transition=TURN, initial=np.eye(3)[start])
    y, u = seen(spec, 12, seed=5, missing=0.2)
    system = system_of(spec, 12)
    path = (start + np.arange(13)) % 3
    close(interacting(system, y, u), batch_lmmse(*_told(system, path, y, u)), KALMAN, rtol=1e-9)


def _told(system, path, y, u):
    known, inputs = told(system, path, u)
    return known, y, inputs


def test_a_long_record_is_refused():
    spec = plant("offsets", transition=HOLES)
    y, u = seen(spec, 8)
    with pytest.raises(DataError, match="at most 7"):
        enumerate_jumps(system_of(spec, 8), y, u)
