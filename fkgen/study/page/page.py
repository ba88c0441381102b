"""The report: one page about one filter, from the model to the hashes, with nothing to load."""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from fkgen import pipeline
from fkgen.backend.lines import environment
from fkgen.backend.render import cost
from fkgen.backend.source import MANIFEST, Source
from fkgen.backend.stated import faults_said
from fkgen.console import progressing
from fkgen.errors import DataError, UserError
from fkgen.families import family
from fkgen.problem import Matrix, Signal, Spec
from fkgen.problem.functions.writing import statements
from fkgen.problem.probability import stationary_law
from fkgen.problem.spec import as_spec
from fkgen.problem.text.discretise import OF_TIME
from fkgen.runtime.record import numbers
from fkgen.study.campaigns import report as campaigns
from fkgen.study.campaigns.results import CONSISTENT, table_of
from fkgen.study.page import mathml
from fkgen.study.page.figures import draw_consistency, draw_ensemble
from fkgen.study.page.logs import described, read_log
from fkgen.study.page.svg import COLOURS, Picture
from fkgen.study.page.trials import TRIALS, Drive, Trials, trials_of
from fkgen.study.records.files import refuse_targets, write_whole
from fkgen.study.records.reading import Reading
from fkgen.study.records.record import Table
from fkgen.study.records.summary import several
from fkgen.study.records.table import numbers_of, read_table
from fkgen.study.reports.plots import draw, times_of
from fkgen.symbolic.validated import Claim, Validated
from fkgen.version import API_VERSION, __version__

Array = NDArray[np.float64]
Rows = list[list[str]]

_CONTENTS = (
    ("model", "Model"),
    ("equations", "Equations"),
    ("faults", "Faults"),
    ("proof", "Proof"),
    ("consistency", "Consistency"),
    ("calibration", "Calibration"),
    ("error", "Error"),
    ("sample-run", "Sample run"),
    ("size", "Size and speed"),
    ("embed", "Embed"),
)
_OF_RECORD = (
    ("record", "Record"),
    ("innovations", "Innovations"),
    ("whiteness", "Whiteness"),
    ("nis", "NIS"),
    ("declared", "Declared faults"),
    ("gaps", "Gaps"),
)
_STAGES = 5  # of the work, for whoever waits


@dataclass(frozen=True, slots=True)
class Page:
    """A report.

    Attributes
    ----------
    name : str
        Of the filter.
    html : str
        The page, with all that belongs to it.
    """

    name: str
    html: str

    def write(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the page into a file, completely or not at all.

        Raises
        ------
        OutputError
            If it exists and ``force`` is not set, or cannot be written.
        """
        target = Path(path)
        write_whole(target, self.html.encode("utf-8"), force=force)
        return target

    def __repr__(self) -> str:
        return f"<Page about {self.name}: {len(self.html.encode('utf-8')) / 1e6:.1f} MB>"


def report(
    spec: Spec,
    *,
    record: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    u: ArrayLike | None = None,
    progress: bool = False,
) -> Page:
    """Say all there is to say about a filter on one page: the same bytes from the same inputs.

    Parameters
    ----------
    spec : Spec
    record : path, optional
        A record to be filtered; its inputs and parameters drive the trials.
    truth : path, optional
        A file of as many samples as the record, with one column for each state, by name.
    u : number or (q,) array_like, optional
        Constant inputs of the trials. Default: those of the record, or 1 each.
    progress : bool, on stderr

    Raises
    ------
    DataError
        If record or truth do not fit the spec.
    ValidationError, CompilerError, OutputError
        As `build` does.
    """
    spec = as_spec(spec)
    if truth is not None and record is None:
        raise DataError("truth", given="a truth without a record", expected="a record beside it")
    table = None if record is None else read_table(record, spec)
    return _made(spec, table, truth, _drive(spec, table, u), shown=progress)


def reported(
    spec: Spec,
    *,
    output: Path | None,
    record: Reading | None,
    truth: Path | None,
    inputs: str,
    force: bool,
) -> Page:
    """What ``fkgen report`` does; without a file to write the page is for the standard output."""
    refuse_targets(output, force=force)
    u = numbers_of("--u", inputs, spec.model.nu)
    page = report(spec, record=record, truth=truth, u=u, progress=sys.stderr.isatty())  # type: ignore[arg-type]
    if output is not None:
        page.write(output, force=force)
    return page


def _drive(spec: Spec, table: Table | None, u: ArrayLike | None) -> Drive:
    """What the trials are driven by, in words too."""
    inputs, params = spec.model.inputs, {} if table is None else dict(table.params)
    text = "" if table is None else "Inputs and parameters are the first ones of the record."
    if not inputs:
        if u is not None:
            raise DataError("u", given="inputs", expected="none: the model has no B")
        return Drive(u=None, params=params, text="" if not params else text)
    if u is None and table is not None:
        return Drive(u=np.asarray(table.u, float), params=params, text=text)
    given = np.ravel(numbers("u", 1.0 if u is None else u, np.float64)).astype(np.float64)
    if given.size not in {1, len(inputs)} or not np.isfinite(given).all():
        expected = f"{len(inputs)} finite numbers, one for each input"
        raise DataError("u", given=f"{given.size} numbers", expected=expected)
    values = np.broadcast_to(given, len(inputs)).copy()
    said = (
        f"{each.name} = {value:g}{f' {each.unit}' if each.unit else ''}"
        for each, value in zip(inputs, values.tolist(), strict=True)
    )
    return Drive(u=values, params=params, text=f"Inputs are constant: {', '.join(said)}.")


def _made(spec: Spec, table: Table | None, truth: Any, drive: Drive, *, shown: bool) -> Page:
    whole = spec.whole
    with progressing("report", _STAGES, shown=shown) as advance:
        design = pipeline.validate(spec)
        advance(1)
        source = pipeline.generate(design)
        built = pipeline.kept(spec, source)
        built = built if whole == spec else pipeline.build(whole)
        advance(1)
        log = None if table is None else read_log(whole, table, truth, built)
        trials, reason = None, ""
        try:
            trials = trials_of(whole, built, drive)
        except UserError as error:
            reason = f"No trials were drawn: {error}."
        advance(1)
        context = _about(spec, design, source) | {"no_trials": reason, "record": None}
        context["trials"] = None if trials is None else _campaign(whole, trials, drive)
        context["cards"] = _cards(design, source, trials)
        advance(1)
        if log is not None:
            context["record"] = described(whole, log)
        context["contents"] = [*_CONTENTS, *(_OF_RECORD if log else ()), ("reproduce", "Reproduce")]
        context |= _identity(spec, source, table, truth)
        html = environment().overlay(autoescape=True).get_template("report.html.j2").render(context)
        advance(1)
    return Page(spec.name, html)


def _about(spec: Spec, design: Validated, source: Source) -> dict[str, Any]:
    """Model, equations, faults, proof, size."""
    model, tried = spec.model, family(spec.filter.family)
    sizes = {"state": model.states, "input": model.inputs, "measurement": model.outputs}
    counted = [several(len(each), what) for what, each in sizes.items() if each]
    return {
        "name": spec.name,
        "family": spec.filter.family,
        "title": f"{spec.filter.family}: {tried.title}",
        "sizes": ", ".join(counted),
        "version": __version__,
        "colours": COLOURS,
        "signals": list(_signals(spec)),
        "sample_time": _sample_time(spec),
        "parameters": _parameters(spec, source),
        "equations": [Markup(each) for each in _equations(spec)],  # noqa: S704 - our own MathML
        "equation_notes": list(_notes(spec)),
        "matrices": [Markup(each) for each in _matrices(spec)],  # noqa: S704
        "faults": [[_sentence(said), law] for said, law in faults_said(spec)],
        "modes": list(_modes(spec)),
        "claims": [*map(_claim, design.claims), *_theorems(spec)],
        "caveats": [each.message for each in design.findings],
        "footprint": _footprint(source),
        "snippet": _snippet(spec, source),
    }


def _sentence(said: str) -> str:
    text = said.removeprefix("Faults: ")
    return text[:1].upper() + text[1:]


def _signals(spec: Spec) -> Iterator[list[str]]:
    model, at = spec.model, 0
    for each in model.states:
        count = 4 if each.manifold else 1
        symbol = f"x[{at}]" if count == 1 else f"x[{at}] to x[{at + 3}]"
        remark = "a unit quaternion (w, x, y, z), body to world" if each.manifold else ""
        yield [each.name, "state", symbol, each.unit, remark or _wraps(each)]
        at += count
    for role, letter, signals in (
        ("input", "u", model.inputs),
        ("measurement", "y", model.outputs),
    ):
        for i, each in enumerate(signals):
            yield [each.name, role, f"{letter}[{i}]", each.unit, _wraps(each)]


def _wraps(signal: Signal) -> str:
    return "an angle, whose differences wrap" if signal.wrap else ""


def _sample_time(spec: Spec) -> str:
    stated = spec.model.sample_time
    if stated is None:
        return ""
    if isinstance(stated, str):
        return f"From sample to sample: the parameter {stated}, in seconds."
    return f"From sample to sample: {stated:g} s."


def _parameters(spec: Spec, source: Source) -> Rows:
    known = dict(source.program.stated.ranges)
    return [[each.name, f"{each.default:g}", known.get(each.name, "")] for each in spec.parameters]


def _equations(spec: Spec) -> Iterator[str]:
    """What moves the state and what is measured, in MathML."""
    model, m = spec.model, mathml
    if model.equations is None:
        plants = spec.plants
        c, d = (any(not getattr(each, x).is_zero for each in plants) for x in "cd")
        continuous, u = model.source is not None, model.nu > 0
        left = m.rate("x") if continuous else m.at("x", "k+1")
        k = "" if continuous else "k"
        terms = [("A", "x", k), *([("B", "u", k)] if u else []), *([("", "c", "")] if c else [])]
        yield m.display(left, m.EQUALS, m.sum_of([*terms, ("", "w", k)]))
        terms = [
            ("C", "x", "k"),
            *([("D", "u", "k")] if u else []),
            *([("", "d", "")] if d else []),
        ]
        yield m.display(m.at("y", "k"), m.EQUALS, m.sum_of([*terms, ("", "v", "k")]))
        yield m.display(*m.normal(m.at("w", k), "Q"), m.COMMA, *m.normal(m.at("v", "k"), "R"))
        yield m.display(*m.normal(m.start("x"), "P0", "x0"))
        return
    equations, continuous = model.equations, model.equations.continuous
    for each in statements(equations, model.states, model.outputs):
        kind = each.key.partition(".")[0]
        left = m.name(each.name) if "[" not in each.name else m.written(each.name)
        left = m.later(left, continuous) if kind == "f" else left
        added = m.PLUS + m.name(f"v_{each.name}") if kind == "h" and "[" not in each.name else ""
        yield m.display(left, m.EQUALS, m.written(each.text), added)
    for noise in equations.noises:
        yield m.display(*m.normal(m.name(noise.name), m.expression(noise.variance)))
    yield m.display(*m.normal("<mi>v</mi>", "R"))
    yield m.display(*m.normal(m.start("x"), "P0", "x0"))


def _notes(spec: Spec) -> Iterator[str]:
    model, equations = spec.model, spec.model.equations
    if not model.S.is_zero:
        yield "The noises w and v of one sample have the covariance S."
    if model.source is not None:
        yield (
            "A, B, c and Q (a spectral density) are those of continuous time; they are discretised "
            "exactly over a sample, in which u is held."
        )
    if equations is None:
        return
    if not model.Q.is_zero:
        yield "Noise of covariance Q is added to the next state beside those that stand in f."
    if equations.continuous:
        how = {"rk4": "Runge and Kutta of order 4", "euler": "Euler"}[equations.integrator]
        yield f"The motion is integrated by {how} in {equations.substeps} step(s) per sample."
    if equations.attitudes:
        yield (
            "q times a vector turns the attitude q by this rotation vector, in body axes; rotate "
            "takes a vector from body to world axes, rotate_back from world to body axes."
        )


def _matrices(spec: Spec) -> Iterator[str]:
    """Every matrix that is there."""
    model: Any = spec.model
    letters = "QR" if model.equations is not None else "ABCDQRcd"
    for letter in (*letters, "S", "x0", "P0"):
        of = model.source if letter in OF_TIME and model.source is not None else model
        value: Matrix = getattr(of, letter)
        absent = (letter in "BD" and not model.nu) or (letter in "cdS" and value.is_zero)
        if not absent and value.rows:
            yield mathml.display(mathml.matrix(letter, value))


def _modes(spec: Spec) -> Iterator[list[str]]:
    """Of a chain of modes: how often each is, and how long it stays."""
    faults: Any = spec.faults.sensor or spec.faults.jump
    transition = np.array(getattr(faults, "kernel", getattr(faults, "transition", ())))
    if faults is None or not transition.size:
        return
    law = stationary_law(transition)
    for i, mode in enumerate(faults.chain(spec.model).modes):
        stays = float(transition[i, i])
        mean = "for ever" if stays >= 1.0 else f"{1.0 / (1.0 - stays):,.1f}"
        title = f": {mode.title}" if mode.title else ""
        yield [f"{i}{title}", "-" if law is None else f"{float(law[i]):.4g}", mean]


def _claim(claim: Claim) -> list[str]:
    error, allowed = (f"{each:.1e}" if each else "0" for each in (claim.error, claim.tolerance))
    holds = "yes" if claim.holds else "no"
    return [claim.claim, claim.source, error, allowed, holds, claim.standing]


def _theorems(spec: Spec) -> Iterator[list[str]]:
    for each in family(spec.filter.family).theorems:
        yield [each.claim, each.source, "exact", "exact", "fkgen verify", each.standing]


def _facts(source: Source) -> dict[str, Any]:
    facts: dict[str, Any] = json.loads(source.files[MANIFEST])
    return facts


def _footprint(source: Source) -> Rows:
    program, of = source.program, _facts(source)["bytes"]
    code = f"{program.name}.c"
    return [
        ["one step with every row present", cost(program)],
        ["an instance", f"{of['instance']} bytes of {program.scalar}s; nothing else is kept"],
        ["tables of constants", f"{of['constants']} bytes"],
        ["stack of one call, at -O0", f"at most {of['stack_O0']} bytes"],
        ["stack of one call, at -Os", f"at most {of['stack_Os']} bytes"],
        ["source", f"{len(source.files[code].splitlines())} lines in {code}"],
    ]


def _snippet(spec: Spec, source: Source) -> str:
    """C that makes an instance and steps it."""
    name, upper, model = spec.name, spec.name.upper(), spec.model
    real, params = source.program.scalar, bool(source.program.parameters)
    header = source.files[f"{name}.h"]
    init = re.search(rf"\b{name}_init\(([^)]*)\)", header)
    started = params and init is not None and "params" in init[1]
    words = -(-model.ny // 32)
    given = [*(["&params"] if params else []), *(["u"] if model.nu else []), "y"]
    given.append("UINT32_C(0xFFFFFFFF)" if words == 1 else "valid")
    u, y = ([f"{real} {x}[{upper}_N{x.upper()}]"] for x in "uy")
    taken = [*(u if model.nu else []), *y]
    lines = [f'#include "{name}.h"', "", f"static {name}_t filter;"]
    lines += [f"static {name}_params_t params;"] if params else []
    lines += ["", "int start(void)", "{"]
    lines += [f"    {name}_params_init(&params);"] if params else []
    lines += [
        f"    return {name}_init(&filter{', &params' if started else ''}) == {upper}_OK;",
        "}",
    ]
    lines += [
        "",
        "/* A row that was not measured is NaN, or has its bit cleared in the last argument. */",
    ]
    lines += [f"{real} on_sample({', '.join(f'const {each}' for each in taken)})", "{"]
    if words > 1:
        bits = ", ".join(["UINT32_C(0xFFFFFFFF)"] * words)
        lines += [f"    const uint32_t valid[{upper}_VALID_WORDS] = {{ {bits} }};"]
    lines += [f"    {name}_status_t status = {name}_step(&filter, {', '.join(given)});"]
    lines += ["    if (status < 0) { /* refused: the filter is as it was */ }"]
    lines += ["    return filter.filtered_state[0];", "}"]
    return "\n".join(lines)


def _campaign(spec: Spec, trials: Trials, drive: Drive) -> dict[str, Any]:
    """Consistency, calibration, error and the sample run."""
    found, sample = trials.campaign, trials.sample
    time = times_of(spec, sample.table)
    runs = len(trials.found.error)
    text = (
        f"{found.trials} trials of {found.steps} samples, seed {found.seed}, were drawn from the "
        f"plant with its faults and filtered by the compiled C. {drive.text} A verdict compares a "
        "statistic with what it is for a filter that is right: optimistic where errors are larger "
        "than the filter says, conservative where they are smaller."
    )
    consistency = (
        f"Above: the normalised squared error over {runs} of the trials; a filter that is right "
        "stays about 1. Below: means over all samples."
    )
    coverage = "How often errors are within 1, 2, 3 of the deviations that the filter states."
    error = (
        f"Root mean square of the errors of {runs} trials at every sample, and the one that the "
        "filter states: together if it is right about itself."
    )
    story = "Estimates of one trial with the truth; shaded in orange: samples struck by the fault."
    drawn = {
        "consistency": (draw_consistency(found, trials, time), "Consistency", consistency),
        "coverage": (campaigns.draw(found, ("coverage",)), "Coverage of errors", coverage),
        "error": (draw_ensemble(spec, trials, time), "Error against time", error),
        "sample": (_sample(spec, trials), "Sample run", story),
    }
    if len(found.calibration.value):
        said = "How often a mode was the true one where the filter gave it some probability."
        figure = campaigns.draw(found, ("calibration",))
        drawn["calibration"] = (figure, "Calibration of mode probabilities", said)
        said = (
            "How often a mode is declared while it is the true one, against how often while another"
            " is, for thresholds of its probability from 0 (above on the right) to 1."
        )
        figure = campaigns.draw(found, ("roc",))
        drawn["roc"] = (figure, "Detection against false alarms", said)
    shown = {key: Picture.of(each[0], key, *each[1:]) for key, each in drawn.items()}
    return {
        "calibration": None,
        "roc": None,
        "text": text,
        "story": sample.text,
        **shown,
        "rows": _signed(table_of(found)[1]),
    }


def _signed(rows: Rows) -> Rows:
    return [[each.replace("+-", "\N{PLUS-MINUS SIGN}") for each in row] for row in rows]


def _sample(spec: Spec, trials: Trials) -> Any:
    one = trials.sample
    truth = np.asarray(one.truth, float)
    return draw(spec, one.table, one.run, truth=truth, faults=one.faults)


def _cards(design: Validated, source: Source, trials: Trials | None) -> list[tuple[str, str, str]]:
    """The few numbers to begin with."""
    held = f"{sum(c.holds for c in design.claims)} of {len(design.claims)} hold"
    verdicts = None if trials is None else trials.campaign.verdicts
    if verdicts is None:
        word, mark = "no trials", ""
    else:
        wrong = [f"{key}: {each}" for key, each in verdicts.items() if each != CONSISTENT]
        word, mark = "; ".join(wrong) or CONSISTENT, "bad" if wrong else "good"
    size = _facts(source)["bytes"]["instance"]
    return [
        ("Claims, measured", held, "good"),
        (f"{TRIALS} trials", word, mark),
        ("One step", f"{source.program.flops} operations", ""),
        ("One instance", f"{size} bytes, {source.program.scalar}", ""),
    ]


def _identity(spec: Spec, source: Source, table: Table | None, truth: Any) -> dict[str, Any]:
    """What it takes to make the page again."""
    facts, file = _facts(source), Path(spec.file).name
    text = _spec_text(spec)
    rows = [
        ["fkgen", f"{__version__}, C interface {API_VERSION}"],
        ["campaign", f"{TRIALS} trials, seed 0"],
        ["spec, as the code states it", str(facts["spec"])],
        ["SHA-256 of the text of the spec", hashlib.sha256(text.encode("utf-8")).hexdigest()],
    ]
    rows += [[f"SHA-256 of {name}", str(digest)] for name, digest in facts["files"].items()]
    shown = [file, "-o report.html"]
    if table is not None:
        shown.append(f"--record {Path(table.file).name}")
    if truth is not None:
        shown.append(f"--truth {Path(truth).name}")
    lines = [f"fkgen report {' '.join(shown)}", f"fkgen verify {file}", f"fkgen montecarlo {file}"]
    return {
        "spec_file": file,
        "spec_text": text,
        "identity": rows,
        "command": "\n".join(lines),
    }


def _spec_text(spec: Spec) -> str:
    """The file that the spec was read from; else what it says, as JSON."""
    try:
        return Path(spec.file).read_bytes().decode("utf-8-sig")
    except (OSError, ValueError):
        return json.dumps(spec.to_dict(), indent=1)
