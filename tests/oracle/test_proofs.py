"""proofs/ says what SymPy judges, Coq refuses what is not so, and rounding stays within bounds."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import fkgen
from fkgen.families import NAMES, family
from fkgen.oracle.theorems.compression import PARTIAL_IDENTITIES
from fkgen.oracle.theorems.gaussian import MIXTURE_IDENTITIES
from fkgen.oracle.theorems.general import GENERAL_IDENTITIES, letter

ROOT = Path(__file__).resolve().parents[2]
TOOL = runpy.run_path(str(ROOT / "tools" / "proofs.py"))
SCRIPT = (ROOT / "proofs" / "scalar_update.g").read_text(encoding="utf-8")

#: Quick ones: the first and the last of them without a denominator.
SOME = (PARTIAL_IDENTITIES[0], PARTIAL_IDENTITIES[1], *MIXTURE_IDENTITIES[3:])

needs_coq = pytest.mark.skipif(shutil.which("coqc") is None, reason="there is no coqc")
needs_gappa = pytest.mark.skipif(shutil.which("gappa") is None, reason="there is no gappa")


def test_what_is_printed_is_what_stands_there():
    printed = TOOL["files"]()
    for name, text in printed.items():
        assert (ROOT / "proofs" / name).read_text(encoding="utf-8") == text, (
            "if this is meant: python tools/proofs.py --update, and read the diff"
        )
    assert {path.name for path in (ROOT / "proofs").glob("*.v")} == set(printed)


def test_every_theorem_of_a_family_is_printed():
    printed = {each for identities in TOOL["THEOREMS"].values() for each in identities}
    named = {each for name in NAMES for each in family(name).theorems}
    assert named <= printed
    assert len(named) > 40


def value(text, numbers):
    """Coq's arithmetic, by Python's own parser and exact fractions."""
    python = re.sub(r"/ (\w+(\^\d+)?)", r"/ (\1)", text).replace("^", "**")
    return eval(re.sub(r"(^|[(*+]\s*)/ ", r"\1one / ", python), {}, numbers)  # noqa: S307


@pytest.mark.parametrize("identity", SOME, ids=lambda each: each.claim)
def test_printed_sides_have_the_values_that_sympy_gives_them(identity):
    text = TOOL["theorem"](identity)
    statement = text.split("Theorem ")[1].split(".\nProof")[0]
    variables = re.search(r"forall ([\w ]+) : R", statement)[1].split()
    draw = np.random.default_rng(7)
    numbers = {"one": Fraction(1)}
    numbers |= {
        name: Fraction(*map(int, draw.integers(1, 41, 2)))
        for name in variables
        if not name.startswith("den")
    }
    for den, base in re.findall(r"^  (den\d+) = (.*) -> \1 <> 0 ->$", statement, re.MULTILINE):
        numbers[den] = value(base, numbers)
    conclusion = re.split(r"(?:: R,|<> 0 ->)\n", statement)[-1]
    entries = [entry.split(" =\n") for entry in conclusion.split(" /\\\n")]
    expected = identity.entries()
    assert len(entries) == len(expected)
    for sides, pair in zip(entries, expected, strict=True):
        for side, symbolic in zip(sides, pair, strict=True):
            exact = symbolic.subs({each: numbers[each.name] for each in symbolic.free_symbols})
            assert value(side.strip(), numbers) == Fraction(str(exact))


def changed_sign(text):
    """The last sum of a right-hand side, a term of which changes its sign."""
    head, plus, tail = text.rpartition(" + (")
    return f"{head} + (-1) * ({tail}" if plus else text


def without_hypothesis(text):
    return re.sub(r" -> (den\d+) <> 0 ->", " ->", text, count=1)


def by_decree(text):
    name = re.search(r"Theorem (\w+)", text)[1]
    decreed = re.sub(rf"Theorem {name}", "Axiom decreed", text).split("Proof.")[0]
    proof = f"Proof. exact decreed. Qed.\nPrint Assumptions {name}.\n"
    return decreed + "\n" + text.split("Proof.")[0] + proof


@needs_coq
@pytest.mark.parametrize("identity", [SOME[1], SOME[3], SOME[-1]], ids=lambda each: each.claim)
def test_coq_accepts_what_holds_and_no_change_of_sign(identity, capsys):
    text = TOOL["theorem"](identity)
    judge = lambda theorem: [*TOOL["refused"]("one.v", TOOL["PRELUDE"] + theorem)]  # noqa: E731
    assert judge(text) == []
    assert "1 checked by Coq" in capsys.readouterr().out
    assert changed_sign(text) != text
    (problem,) = judge(changed_sign(text))
    assert "one.v: " in problem
    assert "Error" in problem


@pytest.mark.parametrize("identity", GENERAL_IDENTITIES, ids=lambda each: each.claim)
def test_identities_for_any_size_hold_and_with_another_sign_do_not(identity):
    assert identity.holds()
    entries = identity.equations()
    for i, (left, right) in enumerate(entries):
        for wrong in (-right, right + letter("K") * letter("S")):
            changed = (*entries[:i], (left, wrong), *entries[i + 1 :])
            assert not replace(identity, equations=lambda changed=changed: changed).holds()


def test_what_is_given_is_needed():
    for identity in GENERAL_IDENTITIES:
        assert not replace(identity, given=tuple).holds()


@pytest.mark.parametrize("identity", GENERAL_IDENTITIES, ids=lambda each: each.claim)
def test_identities_for_any_size_hold_of_matrices_of_numbers(identity):
    """The statement itself, not its proof: gains by NumPy, sizes that all differ."""
    draw, size = np.random.default_rng(3), {"n": 4, "p": 3, "q": 2, "m": 5, "r": 1}
    value = {
        name: draw.normal(size=[size[each] for each in sizes])
        for name, sizes in identity.sizes.items()
    }
    for each in identity.symmetric:
        value[each] = value[each] @ value[each].T + np.eye(len(value[each]))
    P, C, D = value["P"], value["C"], value.get("D")
    if "A" in value:
        across = value["A"] @ P @ C.T + value["B"] @ value["N"] @ D.T
        value["K"] = across @ np.linalg.inv(value["S"])
    else:
        value["K"] = P @ C.T @ np.linalg.inv(value["S"])
    if "L" in value:
        rest = (P - value["K"] @ value["S"] @ value["K"].T) @ D.T
        value["L"] = rest @ np.linalg.inv(value["T"])
    names = {f"{name}_t": matrix.T for name, matrix in value.items()} | value

    def number(expression, rows):
        if expression.is_Symbol:
            return names[expression.name]
        if expression.is_Integer:
            return int(expression) * np.eye(rows)
        parts = iter(expression.args)
        found = number(next(parts), rows)
        for part in parts:
            other = number(part, found.shape[1] if expression.is_Mul else rows)
            found = found @ other if expression.is_Mul else found + other
        return found

    for left, right in (*identity.entries(), *identity.hypotheses()):
        rows = len(names[re.match(r"[-(+ 1*]*(\w+)", str(right))[1]])
        # Products of at most nine matrices of size five and inverses of some with no
        # eigenvalue below one: entries up to 1e4, hundreds of roundings of them.
        np.testing.assert_allclose(number(left, rows), number(right, rows), rtol=1e-8, atol=1e-8)


@needs_coq
def test_coq_accepts_the_joseph_form_for_any_size_and_no_change_of_sign():
    (joseph,) = (each for each in GENERAL_IDENTITIES if "Joseph" in each.claim)
    assert [*TOOL["refused"]("general.v", TOOL["general"]([joseph]))] == []
    text = TOOL["general"]([joseph])
    wrong = text.replace("(P + - (K * S * tr K))", "(P + (K * S * tr K))")
    assert wrong != text
    (problem,) = TOOL["refused"]("general.v", wrong)
    assert "Error" in problem


@needs_coq
def test_coq_wants_denominators_that_are_not_zero_and_no_decrees():
    text = TOOL["theorem"](SOME[1])
    (problem,) = TOOL["refused"]("one.v", TOOL["PRELUDE"] + without_hypothesis(text))
    assert "Error" in problem
    (problem,) = TOOL["refused"]("one.v", TOOL["PRELUDE"] + by_decree(text))
    assert problem == "one.v: rests on the axiom decreed"


@needs_gappa
def test_gappa_refuses_a_bound_that_rounding_exceeds(tmp_path):
    for bound, narrower in (("1.7882e-7", "1.78e-7"), ("3.36e-4", "3e-4")):
        path = tmp_path / "narrower.g"
        path.write_text(SCRIPT.replace(bound, narrower), encoding="utf-8")
        run = subprocess.run(["gappa", path], capture_output=True, text=True, check=False)
        assert run.returncode == 1
    assert subprocess.run(["gappa"], input=SCRIPT, text=True, check=False).returncode == 0


@needs_coq
@needs_gappa
def test_coq_accepts_the_certificate_of_gappa():
    if not list(Path("/usr/lib").glob("**/user-contrib/Gappa")):
        pytest.skip("there is no libcoq-gappa")
    assert [*TOOL["refused"]("scalar_update.v", TOOL["rounding"]())] == []


def test_the_compiled_c_stays_within_the_bound_which_is_no_idle_one():
    relative = Fraction(re.search(r"in \[-.*, (\S+)\]", SCRIPT)[1])
    absolute = Fraction(re.search(r"\|mean - Mean\| <= (\S+) }", SCRIPT)[1])
    model = {"A": [[1.0]], "C": [[1.0]], "Q": [[1.0]], "R": [["r"]], "x0": [0.0], "P0": [[1.0]]}
    table = {"name": "scalar", "model": model, "parameters": {"r": 1.0}}
    table |= {"filter": {"family": "kf"}, "code": {"scalar": "float", "update": "ud"}}
    draw, M = np.random.default_rng(5), 20_000
    x, y = draw.uniform(-512, 512, (2, M)).astype(np.float32)
    p, r = (2 ** draw.uniform(-10, 10, (2, M))).astype(np.float32)
    start = {"x0": x[:, None], "P0": p[:, None, None]}
    run = fkgen.build(fkgen.Spec.from_dict(table)).run_batch(
        y[:, None, None], params={"r": r[:, None]}, start=start
    )
    off = {"mean": Fraction(0), "covariance": Fraction(0)}
    means, covariances = run.filtered_state[:, 0, 0], run.filtered_covariance[:, 0, 0, 0]
    for values in zip(x, y, p, r, means, covariances, strict=True):
        a, b, P, R, mean, covariance = (Fraction(float(each)) for each in values)
        exact = P * R / (P + R)
        off["mean"] = max(off["mean"], abs(mean - (a + P * (b - a) / (P + R))))
        off["covariance"] = max(off["covariance"], abs(covariance - exact) / exact)
    # The bound holds for all of the box: what 20,000 draws find is less, but of its size.
    assert absolute / 10 < off["mean"] <= absolute
    assert relative / 2 < off["covariance"] <= relative


def test_without_coq_it_says_how_to_install_it():
    run = subprocess.run(
        [sys.executable, ROOT / "tools" / "proofs.py"],
        env={**os.environ, "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 2
    assert run.stderr.startswith("proofs: there is no coqc and no gappa. ")
    assert "apt-get install --no-install-recommends coq gappa libcoq-gappa" in run.stderr
