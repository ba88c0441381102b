"""Rows of y in loops say what they say in straight lines; compiled loops give the bits of NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import covariance, distance
from toolchain import needs_compiler

import fkgen
from fkgen.backend.ir import For, Product, every
from fkgen.errors import ValidationError
from fkgen.estimators.gaussian import decorrelation
from fkgen.estimators.gaussian.rolled import Arrays
from fkgen.proof.agreement import trial, with_interpreter, with_machine

#: Sums in another order: roundings of 1e-16 that logarithms and gains multiply.
ROUNDED = 1e-9


def model(seed, n, p, **more):
    """A dense plant with a full R."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    arrays = {"A": 0.9 * A / np.abs(np.linalg.eigvals(A)).max(), "C": rng.standard_normal((p, n))}
    arrays |= {"Q": covariance(rng, n), "R": covariance(rng, p), "P0": covariance(rng, n)}
    plain = {name: value.tolist() for name, value in arrays.items()}
    return plain | {"x0": rng.standard_normal(n).tolist()} | more


def table(family, plant, faults=None, code=None, **options):
    return {
        "name": "rolled",
        "model": plant,
        "filter": {"family": family, **options},
        **({"faults": faults} if faults else {}),
        **({"code": code} if code else {}),
    }


def driven(seed, n, p):
    rng = np.random.default_rng(seed + 1000)
    columns = {"B": rng.standard_normal((n, 1)).tolist(), "D": rng.standard_normal((p, 1)).tolist()}
    return model(seed, n, p, **columns)


def apart(plant, *groups):
    """Rows of different groups have noises of their own."""
    rows = range(len(plant["R"]))
    same = [[any({i, j} <= set(group) for group in groups) for j in rows] for i in rows]
    return plant | {"R": (np.array(plant["R"]) * same).tolist()}


def singular(plant):
    """Row 2 of y measures without noise, and so does the sum of the others' noises."""
    root = np.linalg.cholesky(np.array(plant["R"]))[:, :1]
    return plant | {"R": (root @ root.T).tolist()}


def varying():
    """R and C are computed in every sample."""
    plant = model(3, 2, 3) | {"C": [["a", 0.0], [0.5, "a**2"], [0.0, 1.0]]}
    plant["R"][0][0], plant["R"][1][0], plant["R"][0][1] = "3.0 + a", "0.1*a", "0.1*a"
    return table("kf", plant) | {"parameters": {"a": 1.0}}


def noisy():
    """Noise of x that is correlated with that of y."""
    joint = covariance(np.random.default_rng(4), 5, smallest=0.1)
    parts = {"Q": joint[:2, :2], "S": joint[:2, 2:], "R": joint[2:, 2:]}
    return model(4, 2, 3) | {name: value.tolist() for name, value in parts.items()}


CHAINS = {"gamma_chain": [[0.9, 0.1], [0.1, 0.9]], "delta_chain": [[0.9, 0.1], [0.2, 0.8]]}
SENSOR = {"sensor": {"rows": [0, 1], "noise_factor": 10.0, "problem": 3, **CHAINS}}
TOLD = {"sensor": {"rows": [0, 1], "noise_factor": 4.0}}
RATE = {"actuator": {"success_rate": 0.7, "dependence": "common"}}
JUMP = {"transition": [[0.9, 0.1], [0.2, 0.8]], "initial": [0.5, 0.5]}
JUMP |= {"modes": [{}, {"Q": [[1.0, 0.0], [0.0, 1.0]]}], "arrival_rate": 0.9, "arrival": "unknown"}
SOFT = {"window": 4, "false_alarm": 0.05}

SPECS = {
    "kf": table("kf", model(1, 2, 4), code={"update": "short"}),
    "kf joseph": table("kf", driven(2, 3, 3), code={"update": "joseph"}),
    "kf diagonal R": table("kf", model(5, 2, 3) | {"R": np.diag([1.0, 2.0, 3.0]).tolist()}),
    "kf parameters": varying(),
    "kf singular R": table("kf", singular(model(6, 2, 3))),
    "kf correlated noise": table("kf", noisy()),
    "kf gate": table("kf", model(7, 2, 3), gate=0.5),
    "kf gate of many rows": table("kf", model(21, 2, 6), gate=0.5),
    "kf gate on samples": table("kf", model(8, 2, 3), gate=0.5, gate_by="sample"),
    "kf stationary": table("kf", model(9, 2, 3), gain="stationary"),
    "mkf": table("mkf", driven(10, 2, 3), RATE),
    "mme": table(
        "mme", driven(11, 2, 3), {"actuator": {"dependence": "common"}}, hypotheses=[0.2, 0.8]
    ),
    "genie": table("genie", model(12, 2, 3), TOLD),
    "one_step": table("one_step", model(13, 2, 3), SENSOR),
    "imm": table("imm", model(14, 2, 3), SENSOR),
    "linear_optimal": table("linear_optimal", model(20, 2, 3, x0=[0.0, 0.0]), SENSOR),
    "mjls_lmmse": table("mjls_lmmse", model(16, 2, 3), {"jump": JUMP}),
    "dfcf": table(
        "dfcf", apart(model(17, 2, 4), [0, 2], [1, 3]), {"soft": SOFT | {"host": [0, 2]}}
    ),
    "dfcf rows without a rule": table(
        "dfcf",
        apart(model(22, 2, 7), [0, 1, 3, 4, 6], [2, 5]),
        {"soft": SOFT | {"host": [0, 1, 3, 4, 6]}},
    ),
    "cpcf": table(
        "cpcf", apart(model(18, 2, 4), [0, 1], [2, 3]), {"soft": SOFT | {"host": [0, 1]}}
    ),
    "compression_full": table("compression_full", model(19, 2, 3), {"soft": SOFT}),
}


def loops(source):
    return sum(1 for phase in source.program.phases for _ in every(For, phase.body))


def products(source):
    return sum(1 for phase in source.program.phases for _ in every(Product, phase.body))


#: Noise of x that y tells of is estimated with x, a row at a time.
ALWAYS_IN_LINE = {"kf correlated noise"}


@pytest.fixture
def rolled(monkeypatch):
    """Every conditioning is written in loops."""
    monkeypatch.setattr(decorrelation, "STRAIGHT", 0)


def short(record, T):
    cut = {name: value[:T] for name, value in record.parameters.items()}
    return replace(record, y=record.y[:T], u=record.u[:T], parameters=cut)


@needs_compiler()
@pytest.mark.parametrize("name", SPECS)
def test_loops_say_what_straight_lines_say(name, monkeypatch):
    spec = fkgen.Spec.from_dict(SPECS[name])
    straight = fkgen.generate(fkgen.validate(spec))
    monkeypatch.setattr(decorrelation, "STRAIGHT", 0)
    design = fkgen.validate(spec)
    source = fkgen.generate(design)
    assert loops(source) > loops(straight) == 0
    record = short(trial(spec), 30)
    u = record.u if record.u.shape[1] else None
    runs = [fkgen.compile(each).run(record.y, u, record.parameters) for each in (straight, source)]
    for port in runs[0].ports:
        assert distance(runs[1][port], runs[0][port]) <= ROUNDED, port
    claims = *with_interpreter(design), *with_machine(source, short(record, 8))
    assert not [str(claim) for claim in claims if not claim.holds]


@needs_compiler()
@pytest.mark.parametrize("name", SPECS)
def test_products_of_matrices_say_what_straight_lines_say(name):
    forms = [SPECS[name].get("code", {}) | {"form": form} for form in ("straight", "loops")]
    specs = [fkgen.Spec.from_dict(SPECS[name] | {"code": code}) for code in forms]
    designs = [fkgen.validate(spec) for spec in specs]
    sources = [fkgen.generate(design) for design in designs]
    assert not products(sources[0])
    assert products(sources[1]) or name in ALWAYS_IN_LINE
    record = short(trial(specs[0]), 30)
    u = record.u if record.u.shape[1] else None
    runs = [fkgen.compile(each).run(record.y, u, record.parameters) for each in sources]
    for port in runs[0].ports:
        assert distance(runs[1][port], runs[0][port]) <= ROUNDED, port
    claims = *with_interpreter(designs[1]), *with_machine(sources[1], short(record, 8))
    assert not [str(claim) for claim in claims if not claim.holds]


@needs_compiler()
@pytest.mark.parametrize("update", ["short", "joseph"])
@pytest.mark.parametrize(("n", "p"), [(1, 1), (2, 1), (1, 2)])
def test_matrices_of_one_number_go_through_loops_too(n, p, update):
    code = {"form": "loops", "update": update}
    spec = fkgen.Spec.from_dict(table("mkf", driven(23, n, p), RATE, code))
    design = fkgen.validate(spec)
    claims = *with_interpreter(design), *with_machine(fkgen.generate(design), trial(spec))
    assert not [str(claim) for claim in claims if not claim.holds]


@needs_compiler()
@pytest.mark.parametrize("name", ["kf", "kf gate", "mkf"])
def test_float_loops_give_the_bits_of_their_statements(name, rolled):
    given = SPECS[name] | {"code": {"scalar": "float"}}
    spec = fkgen.Spec.from_dict(given)
    source = fkgen.generate(fkgen.validate(spec))
    assert loops(source)
    assert all(claim.holds for claim in with_machine(source, trial(spec)))


@pytest.mark.parametrize(
    ("name", "what"),
    [
        *[("kf", what) for what in ("share", "coupling", "decorrelated", "noise", "sensed")],
        *[("mkf", what) for what in ("combined", "gain")],
        ("kf correlated noise", "shared_noise"),
    ],
)
def test_mistake_an_index_is_off_by_one(name, what, rolled, monkeypatch):
    right = Arrays.__getitem__

    def shifted(arrays, place):
        return right(arrays, (place[0], place[1] + (1 if what == place[0] else 0)))

    spec = fkgen.Spec.from_dict(SPECS[name])
    fkgen.validate(spec)
    monkeypatch.setattr(Arrays, "__getitem__", shifted)
    with pytest.raises((ValidationError, IndexError)):
        fkgen.validate(spec)
