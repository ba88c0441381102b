"""The checkers are checked: a recursion with one mistake never gets past its closed forms."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from plants import independent, random_model, spec, table

import fkgen
from fkgen.errors import ValidationError
from fkgen.estimators.gaussian.actuation import intermittent
from fkgen.estimators.models.weights import patterns
from fkgen.families import family
from fkgen.proof.validate import confront
from fkgen.symbolic.linalg import weighted_sum

KF = table(random_model(61, 3, 2, 2, direct=True, correlated=True), family="kf")
MKF = table(
    random_model(62, 3, 2, 2, direct=True, correlated=True),
    family="mkf",
    actuator=independent([0.7, 0.4]),
)
MME = table(
    random_model(63, 2, 2, 2, direct=True),
    family="mme",
    actuator={"dependence": "common"},
    hypotheses=[0.2, 0.5, 0.9],
    prior=[0.5, 0.3, 0.2],
)
TABLES = {"kf": KF, "mkf": MKF, "mme": MME}


def recursion(name):
    return family(name).build(fkgen.Spec.from_dict(TABLES[name]))


def refused(mutant):
    """Whether the proof refuses a recursion, and for a reason of size, not by accident."""
    with pytest.raises(ValidationError) as caught:
        confront(family(mutant.spec.filter.family), mutant)
    return bool(caught.value.failed)


def edited(recursion, variable, change):
    """Change what is assigned to a variable in the last block that assigns it.

    ``change(value, symbols)`` gives the new value.
    """
    phases = []
    found = False
    for phase in recursion.phases:
        blocks = list(phase.blocks)
        places = [i for i, block in enumerate(blocks) if variable in block.assign]
        if places and not found:
            found = True
            block = blocks[places[-1]]
            value = ca.densify(change(block.assign[variable], phase.symbols))
            values = {**block.assign, variable: value}
            blocks[places[-1]] = replace(block, assign=values, reads=reads(value, block, phase))
        phases.append(replace(phase, blocks=tuple(blocks)))
    assert found
    return replace(recursion, update=phases[0], predict=phases[1])


def reads(value, block, phase):
    """What a block reads, and what a new value in it reads."""
    owner = {e.element_hash(): n for n, s in phase.symbols.items() for e in ca.symvar(s)}
    return tuple(sorted({*block.reads, *(owner[e.element_hash()] for e in ca.symvar(value))}))


def of_value(function):
    return lambda value, _: function(value)


def scaled(factor):
    return of_value(lambda value: factor * value)


def read_from(name):
    """Assign another variable as it is."""
    return lambda _, symbols: symbols[name]


def swapped(value, _):
    return ca.vertcat(value[1], value[0], *(value[i] for i in range(2, value.numel())))


def instead(old, new):
    """Read another variable of the same size."""
    return lambda value, symbols: ca.substitute(value, symbols[old], symbols[new])


def other_way(variable):
    """Add what should be subtracted."""
    return lambda value, symbols: 2.0 * symbols[variable] - value


def shuffled(name, order):
    """Read the entries of a variable in another order."""

    def change(value, symbols):
        whole = symbols[name]
        return ca.substitute(value, whole, ca.vertcat(*(whole[i] for i in order)))

    return change


EDITS = {
    "filtered covariance times 1.001": ("filtered_covariance", scaled(1.001)),
    "predicted covariance times 1.001": ("predicted_covariance", scaled(1.001)),
    "innovation covariance times 1.001": ("innovation_covariance", scaled(1.001)),
    "innovation with the other sign": ("innovation", scaled(-1.0)),
    "states exchanged after the update": ("filtered_state", swapped),
    "states exchanged after the prediction": ("predicted_state", swapped),
    "rows of the innovation exchanged": ("innovation", swapped),
    "variance and covariance exchanged": ("filtered_covariance", swapped),
    "half of the nis": ("nis", scaled(0.5)),
    "likelihood with the other sign": ("log_likelihood", scaled(-1.0)),
    "likelihood without its constant": (
        "log_likelihood",
        of_value(lambda v: v + np.log(2.0 * np.pi)),
    ),
}
LINEAR = {
    "correction in the wrong direction": ("mean", other_way("mean")),
    "covariance that grows when something is learnt": ("covariance", other_way("covariance")),
    "innovation of a row from another row of y": ("innovation_0", shuffled("y", [1, 0])),
    "inputs exchanged": ("predicted_state", shuffled("u", [1, 0])),
    "no prediction": ("predicted_state", read_from("filtered_state")),
    "prediction from the prediction": (
        "predicted_state",
        instead("filtered_state", "predicted_state"),
    ),
}
BANK = {
    "weights by the inverse likelihood": ("log_joint", lambda v, s: 2.0 * s["log_weight"] - v),
    "likelihoods of other hypotheses": ("log_joint", swapped),
    "floor applied twice": ("floored", of_value(lambda v: 1e-6 + (1.0 - 3e-6) * v)),
    "floor without its scale": ("floored", scaled(1.0 + 3e-6)),
    "weights that never change": ("mode_probability", read_from("mode_probability")),
    "weights of the other hypothesis": ("mode_probability", swapped),
    "success rate from the prior weights": (
        "success_rate_estimate",
        instead("weight", "mode_probability"),
    ),
    "(18) with the weights before the sample": (
        "paper_state",
        instead("weight", "mode_probability"),
    ),
    "combined state with the weights before the sample": (
        "filtered_state",
        instead("weight", "mode_probability"),
    ),
    "one hypothesis predicted from another": (
        "moved_state",
        shuffled("mode_filtered_state", [2, 3, 0, 1, 4, 5]),
    ),
    "evidence of the largest hypothesis alone": (
        "log_evidence",
        read_from("log_largest"),
    ),
}
CASES = [
    *((name, what, *edit) for name in TABLES for what, edit in EDITS.items()),
    *((name, what, *edit) for name in ("kf", "mkf") for what, edit in LINEAR.items()),
    *(("mme", what, *edit) for what, edit in BANK.items()),
    ("mkf", "gain times 1.001", "gain", scaled(1.001)),
    ("mkf", "gain by columns instead of rows", "gain", swapped),
    ("mkf", "filter gain exchanged", "filtered_gain", swapped),
    ("mkf", "fault forgotten", "actuation_deviation", scaled(0.0)),
    ("mkf", "fault covariance times 1.001", "actuation_covariance", scaled(1.001)),
    ("mkf", "fault and state correlated otherwise", "actuation_cross_covariance", scaled(-1.0)),
]


@pytest.mark.parametrize("name", list(TABLES))
def test_what_is_not_mutated_passes(name):
    assert confront(family(name), recursion(name)).claims


@pytest.mark.parametrize(
    ("name", "what", "variable", "change"), CASES, ids=[f"{c[0]}: {c[1]}" for c in CASES]
)
def test_a_mistake_in_one_assignment_is_refused(name, what, variable, change):
    assert refused(edited(recursion(name), variable, change))


def of_another_model(name, **changes):
    """The recursion of a changed plant, passed off as that of the plant."""
    given = TABLES[name]
    other = fkgen.Spec.from_dict({**given, "model": {**given["model"], **changes}})
    mutant = family(name).build(other)
    return replace(mutant, spec=fkgen.Spec.from_dict(given))


def matrix(name, letter):
    return np.array(TABLES[name]["model"][letter])


WRONG_MODELS = {
    "A transposed": lambda n: {"A": matrix(n, "A").T},
    "B with its columns exchanged": lambda n: {"B": matrix(n, "B")[:, ::-1]},
    "rows of C exchanged": lambda n: {"C": matrix(n, "C")[::-1]},
    "D left out": lambda n: {"D": 0.0 * matrix(n, "D")},
    "D with the wrong sign": lambda n: {"D": -matrix(n, "D")},
    "Q left out": lambda n: {"Q": 0.0 * matrix(n, "Q")},
    "Q times 1.001": lambda n: {"Q": 1.001 * matrix(n, "Q")},
    "R times 1.001": lambda n: {"R": 1.001 * matrix(n, "R")},
    "x0 left out": lambda n: {"x0": 0.0 * matrix(n, "x0")},
}


@pytest.mark.parametrize("name", list(TABLES))
@pytest.mark.parametrize("what", list(WRONG_MODELS))
def test_a_mistake_in_the_plant_is_refused(name, what):
    assert refused(of_another_model(name, **WRONG_MODELS[what](name)))


@pytest.mark.parametrize("name", ["kf", "mkf"])
def test_noise_taken_for_uncorrelated_is_refused(name):
    assert refused(of_another_model(name, R=np.diag(np.diag(matrix(name, "R")))))


#: What is computed while the noise of a row is taken out of the rows below it.
ELIMINATION = ("share", "sensed", "decorrelated", "noise")


@pytest.mark.parametrize("name", ["kf", "mkf"])
def test_a_missing_row_that_stays_in_R_is_refused(name):
    whole = recursion(name)
    blocks = [
        replace(block, when=None) if any(v.startswith(ELIMINATION) for v in block.assign) else block
        for block in whole.update.blocks
    ]
    assert refused(replace(whole, update=replace(whole.update, blocks=tuple(blocks))))


@pytest.mark.parametrize("name", list(TABLES))
def test_a_wrong_prior_covariance_is_refused(name):
    right = recursion(name)
    wrong = {
        key: tuple(1.001 * v for v in values) if key.endswith("covariance") else values
        for key, values in right.initial.items()
    }
    assert refused(replace(right, initial=wrong))


@pytest.mark.parametrize("what", ["mode_probability", "log_weight"])
def test_a_wrong_prior_of_the_hypotheses_is_refused(what):
    right = recursion("mme")
    assert refused(replace(right, initial={**right.initial, what: (0.2, 0.3, 0.5)}))


def rates_for_variances(faults, rates, u, plant):
    right = intermittent(faults, rates, u, plant)
    return replace(right, covariance=ca.diag(ca.vertcat(*rates)))


def test_the_rate_for_its_variance_is_refused(monkeypatch):
    monkeypatch.setattr("fkgen.estimators.gaussian.actuation.intermittent", rates_for_variances)
    assert refused(recursion("mkf"))


def without_spread(w, parts, *_):
    return weighted_sum(w, [packed for _, packed in parts])


def test_a_mixture_without_the_spread_of_its_means_is_refused(monkeypatch):
    monkeypatch.setattr("fkgen.estimators.models.merge.mixture_covariance", without_spread)
    assert refused(recursion("mme"))


def test_failures_taken_for_successes_in_the_mixture_are_refused(monkeypatch):
    monkeypatch.setattr(
        "fkgen.estimators.models.bank.patterns",
        lambda rates: patterns([1.0 - rate for rate in rates]),
    )
    assert refused(recursion("mme"))


def test_common_faults_taken_for_independent_ones_are_refused():
    given = fkgen.Spec.from_dict(MKF)
    model = MKF["model"]
    common = spec(model, family="mkf", actuator={"success_rate": 0.7, "dependence": "common"})
    apart = spec(model, family="mkf", actuator=independent(0.7))
    assert given != common
    assert refused(replace(family("mkf").build(common), spec=apart))
