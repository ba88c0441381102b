"""Whatever the public functions are given, what comes out is a result or an error of fkgen's."""

from __future__ import annotations

import decimal
import traceback
from pathlib import Path

import numpy as np
import pytest
from plants import MOTOR, built, generated, motor, spec
from toolchain import needs_compiler

import fkgen
from fkgen.errors import FkgenError, InternalError

pytestmark = needs_compiler()

PLAIN = spec({key: MOTOR[key] for key in ("A", "C", "Q", "R", "x0", "P0")}, family="kf")
FAULTY = motor("mkf")
Y = np.ones((4, PLAIN.model.ny))
EFFECT = np.ones((4, PLAIN.model.ny))

HUGE, RAGGED = 10**400, [[1.0], [1.0, 2.0]]

#: Things that are not what anyone asks for, most of them.
WRONG = (
    *(None, True, 0, -1, 3, 1.5, float("nan"), float("inf"), -0.0, 1j, HUGE, decimal.Decimal(2)),
    *("", "text", "nis", "a\0b", b"bytes", Path("nowhere/at all"), object(), int, print, ...),
    *([], {}, (), [1, 2], RAGGED, [None], ["x"], [[[1.0]]], {"a": 1}, {1: 2}, {"x"}),
    *(
        range(3),
        (i for i in "ab"),
        np.float32(2.0),
        np.array("x"),
        np.array(None),
        np.zeros((2, 0)),
    ),
    *(np.array([1j]), np.array([1, "a"], object), np.ma.masked, np.datetime64("2020-01-01")),
    *(np.full((4, 1), np.inf), np.zeros((2, 2, 2)), np.array([True]), PLAIN, FAULTY, ValueError()),
)

#: Arguments that are records; of those the ragged and the huge ones have tests of their own.
RECORDS = {"run": (0,), "run_batch": (0,), "detectability": (1, "u")}
RECORDS |= dict.fromkeys(("simulate", "compare"), ("u", "sensor", "input"))
RECORDS["fault_effect"] = ("u", "y", "sensor", "input", "params")
REGULAR = tuple(v for v in WRONG if v is not HUGE and v is not RAGGED)


def calls(folder):
    """Public functions with arguments that they accept."""
    source, kf, run = generated(PLAIN), built(PLAIN), built(PLAIN).run(Y)
    snapshot = fkgen.build(PLAIN).snapshot()
    profiles = fkgen.profiles
    small = {"runs": 2, "steps": 8, "skip": 2}
    return (
        (fkgen.load, (str(folder / "spec.toml"),), {}),
        (fkgen.Spec.from_dict, (PLAIN.to_dict(),), {"file": "x"}),
        (fkgen.validate, (PLAIN,), {}),
        (fkgen.generate, (fkgen.validate(PLAIN),), {}),
        (fkgen.compile, (source,), {}),
        (fkgen.build, (PLAIN,), {}),
        (fkgen.check, (PLAIN,), {}),
        (source.write, (str(folder / "out"),), {}),
        (kf.run, (Y,), {"keep": ["nis"]}),
        (kf.run_batch, (Y[np.newaxis],), {"keep": ["nis"], "advance": None}),
        (kf.state, ("filtered_state",), {}),
        (run.__getitem__, ("nis",), {}),
        (snapshot.__getitem__, ("nis",), {}),
        (fkgen.simulate, (PLAIN, 2, 3), {"seed": 1, "sensor": None, "present": None, "first": 0}),
        (fkgen.simulate, (FAULTY, 2, 3), {"u": 1.0, "input": None}),
        (fkgen.compare, (PLAIN,), {**small, "families": ("kf",), "seed": 0, "false_alarm": 0.01}),
        (fkgen.compare, ([PLAIN],), {**small, "u": None, "params": None, "sensor": None}),
        (fkgen.fault_effect, (PLAIN,), {"sensor": EFFECT, "steps": None, "params": {}}),
        (fkgen.fault_effect, (FAULTY,), {"input": np.ones((4, 1)), "mode": "both", "u": Y, "y": Y}),
        (fkgen.detectability, (PLAIN, [1.0]), {"window": 2, "power": 0.9}),
        (fkgen.detectability, (FAULTY, [1.0]), {"u": 1.0, "false_alarm": 0.001}),
        (profiles.pulse, (5, 1, [1.0]), {}),
        (profiles.step, (5, 1, [1.0]), {"stop": 3}),
        (profiles.ramp, (5, 1, [1.0]), {"length": 2, "stop": None}),
        (profiles.drift, (5, 1, [1.0]), {"stop": None}),
        (profiles.from_csv, (str(folder / "profile.csv"), ["y0"]), {}),
    )


def drawn(rng, call):
    """A call with one or two arguments that are something else."""
    function, given, named = call
    arguments, keywords = list(given), dict(named)
    for _ in range(int(rng.integers(1, 3))):
        places = [*range(len(arguments)), *keywords]
        place = places[int(rng.integers(len(places)))]
        pool = REGULAR if place in RECORDS.get(function.__name__, ()) else WRONG
        wrong = pool[int(rng.integers(len(pool)))]
        if isinstance(place, int):
            arguments[place] = wrong
        else:
            keywords[place] = wrong
    return function, arguments, keywords


def raw(function, arguments, keywords):
    """What came out that is no result, in one line; empty if all is well."""
    try:
        function(*arguments, **keywords)
    except InternalError as error:
        return f"{function.__name__}{arguments}{keywords}: blames itself: {error}"
    except FkgenError as error:
        text = str(error)
        return "" if text and "\n" not in text else f"{function.__name__}: {text!r}"
    except Exception as error:  # noqa: BLE001 - this is what is looked for
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        return f"{function.__name__}{arguments}{keywords}: {type(error).__name__} {error} ({place})"
    return ""


@pytest.fixture
def accepted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.toml").write_text('name = "x"\n')
    (tmp_path / "profile.csv").write_text("y0\n1.0\n")
    return calls(tmp_path)


def look(accepted, seed, count):
    rng = np.random.default_rng(seed)
    found = [raw(*drawn(rng, accepted[int(rng.integers(len(accepted)))])) for _ in range(count)]
    assert [each for each in dict.fromkeys(found) if each] == []


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_no_call_with_wrong_types_ends_in_an_exception_of_python(accepted):
    look(accepted, 1, 250)


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(2, 10))
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_no_call_of_many_with_wrong_types_ends_in_an_exception_of_python(accepted, seed):
    look(accepted, seed, 300)
