"""The compression group of cpcf has to be phi [I 0] T x: which condition fails is said."""

from __future__ import annotations

import copy

import pytest
from refusals import Case, check

from fkgen.problem import Spec

CPCF = {
    "name": "ship",
    "model": {
        "A": [[1.0, "dt", 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "C": [[0.0, 1.0, 0.0], ["scale", 0.0, 0.0], ["2*turn", 0.0, "turn"]],
        "Q": [[0.01, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.1]],
        "R": [[0.01, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 4.0]],
        "x0": [0.0, 0.0, 0.0],
        "P0": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        "outputs": [{"name": "log"}, {"name": "gnss"}, {"name": "beacon"}],
    },
    "parameters": {"dt": 0.2, "scale": 2.0, "turn": 0.5},
    "faults": {"soft": {"host": [0], "window": 10}},
    "filter": {"family": "cpcf"},
}
C = "model.C"
EQUAL = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]
NOTHING = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
TURNING = [[0.0, 1.0, 0.0], ["cos(turn)", 0.0, "sin(turn)"], [0.0, 1.0, 0.0]]

CASES: list[Case] = [
    (CPCF, {C: EQUAL}, C, "rows 1 (gnss), 2 (beacon): rank 1 of 2", "det(phi) != 0, (37)"),
    (CPCF, {C: EQUAL}, C, "linearly dependent", "the family dfcf takes any rows"),
    (CPCF, {C: NOTHING}, C, "rank 1 of 2", "the family dfcf takes any rows"),
    (CPCF, {"parameters.scale": 0.0}, C, "rank 1 of 2", "phi [I 0] T"),
    (CPCF, {C: TURNING}, C, "other combinations of states as turn change", "a constant T1, (37)"),
    (CPCF, {C: TURNING}, C, "rows 1 (gnss), 2 (beacon)", "the family dfcf takes any rows"),
]


@pytest.mark.parametrize("case", CASES)
def test_what_is_not_of_the_form_is_refused_and_dfcf_offered(case):
    check(*case)


def test_phi_may_change_with_parameters_and_dfcf_takes_all_of_it():
    Spec.from_dict(CPCF)
    for C in (EQUAL, TURNING):
        table = copy.deepcopy(CPCF)
        table["model"]["C"], table["filter"] = C, {"family": "dfcf"}
        Spec.from_dict(table)
