"""Spec tables that are right, and the check of what is said when one of them is made wrong."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from fkgen.errors import SpecError
from fkgen.problem import Spec

REMOVED = object()

KF: dict[str, Any] = {
    "name": "motor",
    "model": {
        "A": [[0.98, -0.0002], [0.0094, "exp(-0.01/tau)"]],
        "C": [[0.0, 1.0]],
        "Q": [[1e-6, 0.0], [0.0, 1e-6]],
        "R": [[1e-4]],
        "x0": [0.0, 0.0],
        "P0": [[1.0, 0.0], [0.0, 1.0]],
    },
    "parameters": {"tau": 0.05},
    "filter": {"family": "kf"},
}
MKF: dict[str, Any] = {
    **KF,
    "model": {**KF["model"], "B": [[0.02], [0.0001]]},
    "faults": {"actuator": {"success_rate": 0.7}},
    "filter": {"family": "mkf"},
}
MME: dict[str, Any] = {
    **MKF,
    "faults": {"actuator": {}},
    "filter": {"family": "mme", "hypotheses": [0.1, 0.5, 0.9]},
}


def changed(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    result = copy.deepcopy(base)
    for key, value in changes.items():
        *path, last = key.split(".")
        table = result
        for part in path:
            table = table.setdefault(part, {})
        if value is REMOVED:
            del table[last]
        else:
            table[last] = value
    return result


def refusal(table: object) -> SpecError:
    with pytest.raises(SpecError) as caught:
        Spec.from_dict(table, file="motor.toml")
    error = caught.value
    assert str(error).startswith(f"motor.toml: {error.key}: given {error.given}; expected ")
    assert str(error).endswith(error.expected)
    assert str(error).isprintable()
    assert error.__suppress_context__ or error.__context__ is None
    return error


def check(
    base: dict[str, Any], changes: dict[str, Any], key: str, given: str, expected: str
) -> None:
    error = refusal(changed(base, changes))
    assert error.key == key
    assert given in error.given
    assert expected in error.expected


Case = tuple[dict[str, Any], dict[str, Any], str, str, str]
NAN, INF = float("nan"), float("inf")
