"""Print what SymPy judges as Coq, and have Coq judge it: ``make proofs``.

    python tools/proofs.py              compares proofs/ with what is printed now, and checks it
    python tools/proofs.py --update     writes proofs/ anew; read the diff before you commit it

Every identity of ``fkgen/oracle/theorems`` becomes one theorem over the real numbers: its symbols
are variables, every denominator is named and not zero, both sides of every entry stand there as
SymPy has them.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import sympy

from fkgen.oracle.theorems import compression, gaussian, linear_optimal, mkf
from fkgen.oracle.theorems.general import GENERAL_IDENTITIES, GeneralIdentity
from fkgen.oracle.theorems.identity import Identity

ROOT = Path(__file__).resolve().parents[1]
PROOFS = ROOT / "proofs"

#: Files of proofs/, and what stands in each.
THEOREMS = {
    "updates": gaussian.MIXTURE_IDENTITIES,
    "mkf": mkf.IDENTITIES,
    "compression": compression.COMPRESSION_IDENTITIES + compression.PARTIAL_IDENTITIES,
    "linear_optimal": linear_optimal.LINEAR_IDENTITIES,
}

#: What Coq's real numbers themselves stand on: the only axioms that a theorem may name.
AXIOMS = {
    "Classical_Prop.classic",  # of Flocq, beneath Gappa's certificate
    "ClassicalDedekindReals.sig_not_dec",
    "ClassicalDedekindReals.sig_forall_dec",
    "FunctionalExtensionality.functional_extensionality_dep",
}

PRINTED = "(* Printed by tools/proofs.py from what SymPy judges, fkgen/oracle/theorems. *)"
PRELUDE = f"""{PRINTED}
Require Import Reals Field.
Open Scope R_scope.

(* A condition of field is a denominator, written out in another order or with the other sign. *)
Ltac nonzero := match goal with H : ?d <> 0 |- _ <> 0 =>
  let zero := fresh in intro zero; apply H; (rewrite <- zero; ring) || (
    apply Ropp_eq_0_compat in zero; rewrite <- zero; ring) end.
Ltac decide_equality := intros; subst; repeat split;
  (reflexivity || ring || (field; repeat split; nonzero)).
"""

MISSING = (
    "proofs: there is no {}. On Debian or Ubuntu: "
    "apt-get install --no-install-recommends coq gappa libcoq-gappa"
)


def printed(expression: Any, names: dict[Any, str]) -> str:
    """One expression in Coq's words; denominators by their names."""
    match expression:
        case sympy.Symbol():
            return str(expression.name)
        case sympy.Rational():
            fraction = f"{expression.p} / {expression.q}" if expression.q != 1 else str(expression)
            return f"({fraction})" if expression.q != 1 or expression < 0 else fraction
        case sympy.Add() | sympy.Mul():
            sign = " + " if isinstance(expression, sympy.Add) else " * "
            return f"({sign.join(printed(each, names) for each in expression.args)})"
        case sympy.Pow(base=base, exp=sympy.Integer() as exponent):
            inverse = exponent < 0
            power = names[base] if inverse else printed(base, names)
            power += f"^{abs(exponent)}" if abs(exponent) > 1 else ""
            return f"/ {power}" if inverse else power
    raise TypeError(f"{expression} has no form in Coq")


def theorem(identity: Identity) -> str:
    """Statement and proof, and the axioms on which it stands."""
    entries = identity.entries()
    sides = [side for pair in entries for side in pair]
    powers = {power for side in sides for power in side.atoms(sympy.Pow) if power.exp.is_negative}
    names = {
        base: f"den{i}" for i, base in enumerate(sorted({each.base for each in powers}, key=str))
    }
    symbols = sorted({each.name for side in sides for each in side.free_symbols})
    lines = [f"forall {' '.join([*symbols, *names.values()])} : R,"]
    lines += [f"{den} = {printed(base, names)} -> {den} <> 0 ->" for base, den in names.items()]
    equal = [f"{printed(left, names)} =\n    {printed(right, names)}" for left, right in entries]
    name = named(identity)
    return (
        f"\n{said(identity)}\nTheorem {name} :\n  "
        + "\n  ".join([*lines, " /\\\n  ".join(equal)])
        + f".\nProof. decide_equality. Qed.\nPrint Assumptions {name}.\n"
    )


def named(identity: Identity) -> str:
    """Its claim as one word."""
    name = re.sub(r"[^a-z0-9]+", "_", identity.claim.lower()).strip("_")
    return name if name[0].isalpha() else f"eq_{name}"


def said(identity: Identity) -> str:
    """Claim and source as a comment."""
    text = f"{identity.claim}.\n   {identity.source}".replace("*)", "* )")
    return f"(* {text} *)"


def of_any_size(expression: Any) -> str:
    """An expression in letters that do not commute, in the words of tools/matrices.v."""
    match expression:
        case sympy.Symbol():
            name, _, turned = expression.name.partition("_")
            return f"tr {name}" if turned else name
        case sympy.Integer() if expression == 1:
            return "one"
        case sympy.Add():
            return f"({' + '.join(map(of_any_size, expression.args))})"
        case sympy.Mul(args=(sympy.Integer() as sign, *rest)) if sign == -1:
            return f"- {of_any_size(sympy.Mul(*rest))}"
        case sympy.Mul():
            return f"({' * '.join(map(of_any_size, expression.args))})"
    raise TypeError(f"{expression} has no form in Coq")


def general_theorem(identity: GeneralIdentity) -> str:
    """Statement and proof for all sizes."""
    sizes = sorted(set("".join(identity.sizes.values())))
    letters = [
        f"({name} : Mat {rows} {columns})" for name, (rows, columns) in identity.sizes.items()
    ]
    given = [
        f"{of_any_size(left)} = {of_any_size(right)} ->" for left, right in identity.hypotheses()
    ]
    symmetric = " ".join(f"tr {each} = {each} ->" for each in identity.symmetric)
    sides = [
        f"{of_any_size(left)} =\n    {of_any_size(right)}" for left, right in identity.entries()
    ]
    names = [f"G{i}" for i in range(len(given))]
    steps = [f"rewrite ?mul_assoc in {name}; transposed {name} T{name}." for name in names]
    used = "; ".join(f"use {name}; use T{name}" for name in names)
    body = "\n  ".join(["forall " + " ".join([*sizes, *letters]) + ",", symmetric, *given])
    return (
        f"\n{said(identity)}\nTheorem {named(identity)} :\n  {body}\n  "
        + " /\\\n  ".join(sides)
        + f".\nProof.\n  intros {' '.join([*sizes, *identity.sizes])}"
        + f" {' '.join('H' + each for each in identity.symmetric)} {' '.join(names)}.\n  "
        + "\n  ".join(steps)
        + f"\n  repeat split; equal; repeat (progress ({used}; expand)); collect.\nQed.\n"
    )


def general(identities: Iterable[GeneralIdentity] = GENERAL_IDENTITIES) -> str:
    """Theorems for all sizes, and on what they stand once the section of laws is closed."""
    laws = (ROOT / "tools" / "matrices.v").read_text(encoding="utf-8")
    closed = [f"Print Assumptions {named(each)}.\n" for each in identities]
    theorems = "".join(map(general_theorem, identities))
    return f"{PRINTED}\n{laws}{theorems}\nEnd Matrices.\n{''.join(closed)}"


def files() -> dict[str, str]:
    """What stands in proofs/."""
    small = {
        f"{name}.v": PRELUDE + "".join(map(theorem, identities))
        for name, identities in THEOREMS.items()
    }
    return small | {"general.v": general()}


#: What Gappa's certificate takes for granted of the script's last line, and its proof.
HINT = re.compile(r"^Hypothesis (a1 : .*)\.$", re.MULTILINE)
FIELD = (
    r"Lemma \1.\nProof. unfold Float1; intros; field; repeat split;"
    r" (assumption || (rewrite Rplus_comm; assumption)). Qed."
)


def rounding() -> str:
    """Gappa's proof of scalar_update.g for Coq: nothing in it is left as a hypothesis."""
    script = PROOFS / "scalar_update.g"
    found = subprocess.run(["gappa", "-Bcoq", script], capture_output=True, text=True, check=False)
    if found.returncode:
        raise SystemExit(f"proofs/{script.name}: {found.stderr.strip()}")
    last = re.findall(r"^Lemma (\w+)", found.stdout, re.MULTILINE)[-1]
    proved, hints = HINT.subn(FIELD, found.stdout)
    if hints != 1 or "Hypothesis" in proved:
        raise SystemExit(f"proofs/{script.name}: its certificate rests on more than one hint")
    return (
        f"Require Import Reals Field.\n{proved}\n"
        f"Theorem bounds : forall p r y x : R, s1 p r y x -> False.\nProof. exact {last}. Qed.\n"
        "Print Assumptions bounds.\n"
    )


def refused(name: str, text: str) -> Iterator[str]:
    """What speaks against one file: Coq's refusal, an axiom too many, a theorem it did not name."""
    with TemporaryDirectory() as folder:
        path = Path(folder, name)
        path.write_text(text, encoding="utf-8")
        found = subprocess.run(
            ["coqc", "-q", path.name], cwd=folder, capture_output=True, text=True, check=False
        )
    if found.returncode:
        yield f"{name}: {found.stderr.strip()}"
        return
    axioms = set(re.findall(r"^([\w.]+)\s*:", found.stdout, re.MULTILINE)) - {"Axioms"}
    yield from (f"{name}: rests on the axiom {axiom}" for axiom in sorted(axioms - AXIOMS))
    said = found.stdout.count("Axioms:") + found.stdout.count("Closed under the global context")
    theorems = text.count("\nTheorem ")
    if said != theorems:
        yield f"{name}: has {theorems} theorems, {said} of them with assumptions"
    print(f"{name}: {theorems} checked by Coq; axioms: {', '.join(sorted(axioms)) or 'none'}")


def main() -> int:
    """Run as a script."""
    parser = argparse.ArgumentParser(description="check proofs/ with Coq")
    parser.add_argument("--update", action="store_true", help="write proofs/ anew")
    update = parser.parse_args().update
    missing = [name for name in ("coqc", "gappa") if shutil.which(name) is None]
    if missing and not update:
        print(MISSING.format(" and no ".join(missing)), file=sys.stderr)
        return 2
    now = files()
    if update:
        for name, text in now.items():
            (PROOFS / name).write_text(text, encoding="utf-8", newline="\n")
        return 0
    for name, text in now.items():
        if (PROOFS / name).read_text(encoding="utf-8") != text:
            print(f"proofs/{name} is not what is printed now: python tools/proofs.py --update")
            return 1
    jobs = sorted(now.items(), key=lambda job: -len(job[1]))  # the longest first
    jobs.append(("scalar_update.v", rounding()))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        problems = [
            each for found in pool.map(lambda job: [*refused(*job)], jobs) for each in found
        ]
    print("\n".join(problems) or "proofs/ holds")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
