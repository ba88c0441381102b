"""Ten thousand records of a scalar plant with faults: the errors that the linear filters make."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from plants import built
from sensor_specs import SCALAR, product, sensed

from fkgen.oracle.plants.actuator import LinearSystem
from fkgen.oracle.plants.sensor import SensorLaw
from fkgen.oracle.textbook.linear_optimal import true_covariance

RECORDS, T = 10_000, 12
START = {"P0": [[0.5]]}
TURNING = product([[0.1, 0.9], [0.9, 0.1]], [[0.8, 0.2]] * 2, initial=(0.5, 0.8))
ABSORBING = product([[0.7, 0.3], [0.0, 1.0]], [[0.8, 0.2]] * 2, initial=(0.2, 0.8))

#: Standard errors that 12 samples of a right formula stay within.
FAR = 4.5


def plant(law, **options):
    return sensed(SCALAR | START, law, family="linear_optimal", **options)


@cache
def drawn(initial, kernel):
    """States and measurements of all records, (M, T) each."""
    rng = np.random.default_rng(17)
    cumulated = np.cumsum(kernel, axis=1)
    mode = (rng.random(RECORDS)[:, None] > np.cumsum(initial)).sum(axis=1)
    x = np.sqrt(0.5) * rng.standard_normal(RECORDS)
    states, measured = np.empty((2, RECORDS, T))
    for k in range(T):
        noise = np.where(mode % 2, np.sqrt(10.0), 1.0) * rng.standard_normal(RECORDS)
        states[:, k], measured[:, k] = x, (mode < 2) * x + noise
        x = -0.8 * x + rng.standard_normal(RECORDS)
        mode = (rng.random(RECORDS)[:, None] > cumulated[mode]).sum(axis=1)
    return states, measured


def squared_errors(spec):
    """(M, T) squared errors, and the run."""
    faults = spec.faults.sensor
    states, measured = drawn(faults.initial, faults.kernel)
    result = built(spec).run_batch(measured[:, :, None])
    return (result.filtered_state[:, :, 0] - states) ** 2, result


def deviations(errors, expected):
    """How many standard errors the mean squared errors are from what they should be."""
    deviation = errors.std(axis=0) / np.sqrt(RECORDS)
    return np.abs(errors.mean(axis=0) - expected) / deviation


def test_the_error_under_lemma_2_is_the_covariance_that_the_filter_says():
    errors, result = squared_errors(plant(ABSORBING))
    assert deviations(errors, result.filtered_covariance[0, :, 0, 0]).max() < FAR


def test_the_error_of_the_augmented_form_is_what_it_says_where_lemma_2_fails():
    errors, result = squared_errors(plant(TURNING, form="augmented"))
    assert deviations(errors, result.filtered_covariance[0, :, 0, 0]).max() < FAR


def test_the_error_outside_lemma_2_is_the_true_covariance_and_not_what_the_filter_says():
    spec = plant(TURNING)
    errors, result = squared_errors(spec)
    gains = result.state_gain[0], result.measurement_gain[0]
    system = LinearSystem.from_spec(spec, T)
    truth = true_covariance(system, SensorLaw.from_spec(spec), gains)[:, 0, 0]
    assert deviations(errors, truth).max() < FAR
    assert deviations(errors, result.filtered_covariance[0, :, 0, 0]).max() > 1.5 * FAR


@pytest.mark.exhaustive
@pytest.mark.parametrize("family", ["imm", "one_step"])
def test_filters_that_weigh_modes_beat_the_best_linear_one(family):
    linear, _ = squared_errors(plant(TURNING, form="augmented"))
    spec = sensed(SCALAR | START, TURNING, family=family)
    weighed, _ = squared_errors(spec)
    gain = (linear - weighed)[:, 3:].mean(axis=1)
    assert gain.mean() > FAR * gain.std() / np.sqrt(RECORDS)
