"""The command ``fkgen``: arguments to pipeline and back to text. No other work is done here.

Exit status: 0 all is well; 1 the model, the filter or the record is not in order; 2 a mistake of
the user (one line says which); 130 interrupted.
"""

from __future__ import annotations

# ruff: noqa: PLC0415 - what takes long to import is imported by the commands that need it
import contextlib
import errno
import functools
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from fkgen.console import console, print_table
from fkgen.errors import FkgenError, InternalError
from fkgen.version import __version__

if TYPE_CHECKING:
    from fkgen.problem import Spec
    from fkgen.study.records.filtering import Told
    from fkgen.study.records.reading import Reading
    from fkgen.symbolic.validated import Claim

_INTERRUPTED = 130
_STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}


class _OneLine(click.Group):
    """A group of commands whose failures are one line on stderr, never a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
        except KeyboardInterrupt as interrupt:
            _fail(ctx, str(interrupt) or "interrupted", status=_INTERRUPTED)
        except click.UsageError as error:
            path = error.ctx.command_path if error.ctx else ctx.command_path
            text = error.format_message().replace(". Did", "; did").rstrip(".?")
            _fail(ctx, f"{text[:1].lower()}{text[1:]}; see: {path} --help")
        except InternalError as error:
            _fail(ctx, f"{error}; this is a defect of fkgen: please report it with the spec")
        except FkgenError as error:
            _fail(ctx, str(error))
        except OSError as error:
            _drop_stdout()
            if error.errno == errno.EPIPE:
                ctx.exit(1)
            _fail(ctx, f"output cannot be written: {(error.strerror or str(error)).lower()}")
        return result


def _fail(ctx: click.Context, message: str, *, status: int = 2) -> NoReturn:
    click.echo(f"error: {' '.join(message.split())}", err=True)
    ctx.exit(status)


def _drop_stdout() -> None:
    """Whoever read stdout is gone, or its disk is full: what is still buffered goes nowhere."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _loaded(_ctx: click.Context, _parameter: click.Parameter, path: Any) -> Any:
    """The spec of a path, or those of several."""
    from fkgen.problem import load

    return load(path) if isinstance(path, str) else tuple(map(load, path))


_SPEC = click.argument("spec", callback=_loaded)
_RECORD = click.option("--record", type=Path, help="Record: u, parameters, missing rows.")
_INPUTS = click.option("--u", "inputs", default="", help="Constant inputs instead: 1.5,0,...")
_SOFT_FAULTS = click.option("--profile", type=Path, help="CSV file: soft faults of signals.")
_STEPS = click.option("--steps", type=int, help="Samples; default 200, or those of the files.")
_SEED = click.option("--seed", default=0, help="Default 0.")
_CSV = click.option("-o", "--output", type=Path, help="CSV file; default: standard output.")
_PLOT = click.option("--plot", type=Path, help="Picture to draw, as PNG, PDF or SVG.")
_FORCE = click.option("--force", is_flag=True, help="Replace files that exist.")
_JSON = click.option("--json", "as_json", is_flag=True, help="Everything as JSON.")


_DIALECT = (
    click.option("--column", multiple=True, help="Its heading: gnss='GPS height [m]'; repeat."),
    click.option("--time", help="Heading of the time column; '' goes without."),
    click.option("--delimiter", help="Between fields of a CSV file: ';', tab, space, ..."),
    click.option("--decimal", help="Of its numbers: '.' or ','."),
    click.option("--encoding", help="Of its text: utf-8, latin-1, utf-16, ..."),
    click.option("--skip-rows", type=int, help="Lines before its header."),
    click.option("--missing", multiple=True, help="A mark of missing values: -9999; repeat."),
)


def _reading(command: Any) -> Any:
    """Hand record files over together with how they are written; what is not said is found out."""

    @functools.wraps(command)
    def call(*arguments: Any, record: Path | tuple[Path, ...] | None, **options: Any) -> Any:
        from fkgen.study.records.reading import checked

        names = ("time", "delimiter", "decimal", "encoding", "skip_rows", "missing")
        written: Any = {name: options.pop(name) for name in names}
        written["columns"] = options.pop("column")
        given: Reading | tuple[Reading, ...] | None = None
        if isinstance(record, tuple):
            given = tuple(checked(each, **written) for each in record)
        elif record is not None:
            given = checked(record, **written)
        return command(*arguments, record=given, **options)

    for option in reversed(_DIALECT):
        call = option(call)
    return call


def _tell(found: Any, table: Any, lines: Iterable[str], *, as_json: bool, names: int = 1) -> None:
    """Print JSON; or a table, numbers to the right of the first columns, and lines below it."""
    if as_json:
        click.echo(found.to_json())
        return
    head, rows = table
    print_table(head, rows, **dict.fromkeys(head[names:], "right"))
    for line in lines:
        click.echo(line)


def _say(kind: str, sentences: Iterable[str]) -> None:
    for sentence in sentences:
        click.echo(f"{kind}: {sentence}", err=True)


@click.group(cls=_OneLine, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fkgen", message="%(prog)s %(version)s")
def main() -> None:
    """Kalman filters for systems with faults: described once, proved, printed as C99.

    \b
    fkgen new mkf -o motor.toml      a spec to begin with; or --from record.csv
    fkgen check motor.toml           is the model sound?
    fkgen generate motor.toml        C code
    fkgen run motor.toml record.csv  filter a record; smooth: each sample from all of it
    fkgen fit motor.toml record.csv  parameters from records
    fkgen fault-effect motor.toml    what a fault does to the estimate
    fkgen compare motor.toml         which family to take
    fkgen montecarlo motor.toml      is the filter right about its errors?
    fkgen report motor.toml -o r.html   all of it on one page
    """  # noqa: D301 - \b is for click


@main.command()
def families() -> None:
    """List the families of filters."""
    from fkgen.families import NAMES, family

    print_table(("family", "what it is for"), ((name, family(name).title) for name in NAMES))


@main.command()
@click.argument("family", required=False)
@click.option("--from", "record", type=Path, help="Record whose signals and noises it is to have.")
@click.option("--inputs", default="", help="Columns of it that are inputs: a,b; default: by name.")
@click.option("-o", "--output", type=Path, help="File to write; never one that exists.")
@_reading
def new(family: str | None, record: Reading | None, inputs: str, output: Path | None) -> None:
    """Write a commented spec of FAMILY to begin with, or one of kf from a record."""
    from fkgen.study.reports.starters import begun

    text, then = begun(family, record, inputs, str(output))
    _write(text, output, then, force=False, err=False)


def _write(text: str, output: Path | None, then: str, *, force: bool, err: bool) -> None:
    """Write a text to the standard output; or into a file, and say what to do then."""
    from fkgen.study.records.files import write_whole

    if output is None:
        click.echo(text, nl=False)
        return
    write_whole(output, text.encode("utf-8"), force=force)
    click.echo(f"{output}: try: {then}", err=err)


@main.command()
@_SPEC
@click.option("--record", type=Path, help="Record along which f and h are looked at.")
@_INPUTS
@_JSON
@_reading
def check(spec: Spec, *, as_json: bool, **options: Any) -> None:
    """Say what is wrong with a model before anyone trusts it."""
    from fkgen.study.diagnostics.check import checked

    report = checked(spec, say=_say, **options)
    rows = [
        (_styled(f.severity, _STYLES[f.severity]), f.code, "; ".join(filter(None, texts)))
        for f in report.findings
        for texts in [(f.message, f.remedy)]
    ]
    if rows and not as_json:
        print_table(("severity", "code", "finding"), rows)
    values = ((name, f"{value:.6g}") for name, value in report.values.items())
    _tell(report, (("value", "number"), values), (), as_json=as_json)
    sys.exit(0 if report.sound else 1)


def _styled(text: str, style: str) -> Any:
    from rich.text import Text

    return Text(text, style=style)


@main.command()
@_SPEC
@click.option("-o", "--output", type=Path, help="Folder; default: the name of the filter, here.")
@click.option("--package", "kinds", default="", help="With files for: cmake,cpp,arduino,...")
@click.option("--harness", is_flag=True, help="With a program for libFuzzer; not in a package.")
def generate(spec: Spec, output: Path | None, kinds: str, *, harness: bool) -> None:
    """Prove the filter of SPEC and write it as C.

    A package is for one or several of cmake, arduino, platformio, zephyr, esp-idf, cmsis, mex and
    cpp; its version and author are those of the table [package] of SPEC.
    """
    from fkgen import pipeline
    from fkgen.backend.render import cost, with_harness
    from fkgen.backend.source import own_files

    if kinds and harness:
        raise click.UsageError("--harness: given with --package; expected one of them")
    design = pipeline.validate(spec)
    source = pipeline.generate(design)
    if kinds:
        from fkgen.target import packages

        folder = output or Path(spec.name)
        for name in packages.write(spec, source, packages.listed(kinds), folder):
            click.echo(folder / name)
        return
    source = with_harness(source) if harness else source
    folder = source.write(output or Path(spec.name))
    left = source.files.keys() - own_files(folder)
    for name in sorted(source.files.keys() - left):
        click.echo(folder / name)
    _say("note", (f"{folder / name} is yours and stays; add {spec.name}.c to it" for name in left))
    click.echo(f"{len(design.claims)} claims hold; one step: {cost(source.program)}")


@main.command("export-fmu")
@_SPEC
@click.option("-o", "--output", type=Path, help="File; default: the name of the filter, here.")
@click.option("--fmi", type=click.Choice(["2", "3"]), default="2", help="Version; default 2.")
@_FORCE
def export_fmu(spec: Spec, output: Path | None, fmi: str, *, force: bool) -> None:
    """Write the filter of SPEC as a unit for co-simulation, FMI 2.0 or 3.0: library and sources."""
    from fkgen import pipeline
    from fkgen.study.records.files import refuse_targets, write_whole
    from fkgen.target.fmu import fmu

    path = output or Path(f"{spec.name}.fmu")
    refuse_targets(path, force=force)
    write_whole(path, fmu(pipeline.generate(pipeline.validate(spec)), int(fmi)), force=force)
    click.echo(f"{path}: one step is one sample; NaN in y is a missing row")


@main.command()
@_SPEC
@click.option("--target", "targets", multiple=True, help="Processor to emulate; repeat, or a,b.")
@click.option("--prove", is_flag=True, help="No run-time error, by Frama-C's EVA.")
@_JSON
@click.option("-o", "--output", type=Path, help="JSON file with errors, seeds and versions.")
@_FORCE
def verify(
    spec: Spec,
    *,
    targets: tuple[str, ...],
    prove: bool,
    as_json: bool,
    output: Path | None,
    force: bool,
) -> None:
    """Confront the filter of SPEC with the literature, and the compiled C with all of it.

    With --target it is built for processors, and 200 steps are held against those of this machine:
    cortex-m0plus, cortex-m3, cortex-m4f, cortex-m7, cortex-m33, rv32imac, rv32imafc, rv64gc, avr.
    With --prove its C is analysed: no call has a run-time error, whatever bits it is given.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from fkgen.study.records.files import refuse_targets, write_whole
    from fkgen.study.reports.evidence import FIGURES, Evidence, told

    refuse_targets(output, force=force)
    found = Evidence(spec, told(targets), prove)
    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    with Progress(*columns, console=console(err=True), transient=True) as progress:
        for step in progress.track(found.steps(), description=""):
            progress.update(progress.task_ids[0], description=step.title)
            found.take(step)
    if output is not None:
        write_whole(output, found.to_json().encode("utf-8"), force=force)
    if as_json:
        click.echo(found.to_json())
    else:
        _print_claims(found.claims)
        if found.rows:
            print_table(FIGURES, found.rows, **dict.fromkeys(FIGURES[2:], "right"))
        click.echo(f"{len(found.claims) - found.failed} of {len(found.claims)} claims hold")
    sys.exit(1 if found.failed else 0)


def _print_claims(claims: Iterable[Claim]) -> None:
    holds = {True: _styled("yes", "green"), False: _styled("NO", "bold red")}
    head = ("claim", "source", "error", "allowed", "holds")
    rows = (
        (c.claim, c.source, f"{c.error:.1e}", f"{c.tolerance:.1e}", holds[c.holds]) for c in claims
    )
    print_table(head, rows, error="right", allowed="right")


@main.command()
@_SPEC
@click.argument("record", type=Path)
@_CSV
@_PLOT
@click.option("--keep", default="", help="Columns instead of the usual ones: port,port,...")
@click.option("--resume", is_flag=True, help="Keep what is written when it stops; go on from it.")
@_FORCE
@_reading
def run(spec: Spec, record: Reading, **options: Any) -> None:
    """Filter RECORD, a CSV, Parquet, npz or mat file, with the compiled filter of SPEC.

    Numbers go to the standard output or a file (.parquet, else CSV), a summary and what is to be
    said to the standard error.
    """
    from fkgen.study.records import filtering

    _end(filtering.run(spec, record, **options))


@main.command()
@_SPEC
@click.argument("record", type=Path)
@_CSV
@_PLOT
@_FORCE
@_reading
def smooth(spec: Spec, record: Reading, **options: Any) -> None:
    """Estimate every sample of RECORD from all of it: states and standard deviations.

    Numbers go to the standard output, a summary and what is to be said to the standard error.
    """
    from fkgen.study.records import filtering

    _end(filtering.smooth(spec, record, **options))


def _end(told: Told) -> NoReturn:
    """Say what there is to say of a record."""
    _say("note", told.notes)
    _say("warning", (*told.warnings, *told.refused))
    _say("summary", [told.summary])
    sys.exit(1 if told.refused else 0)


@main.command()
@_SPEC
@click.argument("record", nargs=-1, required=True, type=Path)
@click.option("--estimate", required=True, help="Parameters to estimate: q,r,...")
@click.option("-o", "--output", type=Path, help="Spec file to write, with the estimates.")
@click.option("--autocovariance", "second", is_flag=True, help="A second opinion on Q and R.")
@_PLOT
@_FORCE
@_JSON
@_reading
def fit(spec: Spec, record: tuple[Reading, ...], *, as_json: bool, **options: Any) -> None:
    """Estimate parameters of SPEC from RECORDs, by maximum likelihood.

    The new spec file keeps comments and order of the old one.
    """
    from fkgen.study.fitting.command import fitted

    found = fitted(spec, record, say=_say, **options)
    _tell(found, (found.head, found.rows), found.lines, as_json=as_json)
    sys.exit(0 if found.fit.converged else 1)


@main.command("fault-effect")
@_SPEC
@click.option("--sensor", help="Row of y that is faulty, by name.")
@click.option("--input", "driven", help="Input that is faulty, by name.")
@click.option("--shape", default="step", help="pulse, step (default), ramp or drift.")
@click.option("--amplitude", default=1.0, help="Its size, in the unit of the signal; default 1.")
@click.option("--start", default=0, help="First faulty sample; default 0.")
@click.option("--stop", type=int, help="First healthy sample after it; default: it stays.")
@click.option("--length", default=10, help="Samples in which a ramp rises; default 10.")
@click.option("--steps", default=100, help="Samples to look at; default 100.")
@click.option("--profile", type=Path, help="CSV file with the fault instead, by names of signals.")
@_RECORD
@_INPUTS
@click.option("--mode", default="both", help="Who gets a faulty input: both, plant or filter.")
@click.option("--fraction", default=0.01, help="Share of the peak that counts as over.")
@click.option("--false-alarm", default=1e-3, help="Of the NIS test; default 0.001.")
@click.option("--runs", default=256, help="Pairs, where they have to be simulated.")
@_JSON
@_PLOT
@_FORCE
@_reading
def fault_effect(
    spec: Spec, *, as_json: bool, plot: Path | None, force: bool, **options: Any
) -> None:
    """Say what a fault of a sensor or an input does to the estimate of SPEC, and for how long."""
    from fkgen.study.effects.report import Options, report_of

    found = report_of(spec, Options(**options), plot=plot, force=force, say=_say)
    _tell(found, (found.head, found.rows), found.sentences, as_json=as_json)
    _say("note", found.notes)


@main.command()
@_SPEC
@click.option("--direction", default="", help="Direction of the bias in y instead: 1,-1,...")
@click.option("--false-alarm", default=1e-3, help="Per test; default 0.001.")
@click.option("--power", default=0.9, help="Probability to find the bias; default 0.9.")
@click.option("--window", default="1,10,50,200", help="Samples of the windowed tests.")
@click.option("--u", "inputs", default="", help="Constant inputs, for mkf: 1.5,0,...")
@_JSON
def detectability(spec: Spec, *, as_json: bool, **options: Any) -> None:
    """Say how large a constant bias of a sensor has to be to be found by the filter of SPEC."""
    from fkgen.study.effects.detectability import least_biases

    found = least_biases(spec, **options)
    _tell(found, (found.head, found.rows), found.sentences, as_json=as_json, names=2)


@main.command()
@_SPEC
@_STEPS
@_SEED
@click.option("--trial", default=0, help="Which trial of the seed; default 0.")
@_RECORD
@_INPUTS
@_SOFT_FAULTS
@_CSV
@_FORCE
@_reading
def simulate(spec: Spec, *, output: Path | None, force: bool, **options: Any) -> None:
    """Draw one trial of the plant of SPEC, with its faults, as a record for fkgen run."""
    from fkgen.study.comparisons.comparison import drawn
    from fkgen.study.records.files import refuse_targets

    refuse_targets(output, force=force)
    text, then = drawn(spec, say=_say, **options), f"fkgen run {spec.file} {output}"
    _write(text, output, then, force=force, err=True)


@main.command()
@click.argument("specs", nargs=-1, required=True, callback=_loaded)
@click.option("--families", default="", help="imm,kf,...; each may be family:key=value.")
@click.option("--runs", default=2000, help="Trials; default 2000.")
@_STEPS
@_SEED
@click.option("--skip", type=int, help="Samples that do not count; default: the first quarter.")
@click.option("--false-alarm", default=0.01, help="Of the NIS test; default 0.01.")
@_RECORD
@_INPUTS
@_SOFT_FAULTS
@_JSON
@_PLOT
@_FORCE
@_reading
def compare(specs: tuple[Spec, ...], *, as_json: bool, **options: Any) -> None:
    """Say which filter to take for the plant and the faults of the first of SPECS.

    Several SPECS are filters as they stand; --families adds families for the plant of the first
    one, and of one spec all that fit are compared.
    """
    from fkgen.study.comparisons.comparison import compared
    from fkgen.study.comparisons.report import table_of

    found = compared(specs, say=_say, **options)
    lines = [*(f"note: {note}" for note in found.notes), f"\n{found.recommendation}"]
    _tell(found, table_of(found), lines, as_json=as_json)


@main.command()
@_SPEC
@click.option("--trials", default=1000, help="Default 1000.")
@click.option("--steps", default=200, help="Samples of each; default 200.")
@_SEED
@_INPUTS
@click.option("--truth", type=Path, help="Spec of the plant, if it is not that of SPEC.")
@click.option("--sweep", "over", multiple=True, help="KEY=0.5:0.95:10, KEY=0.5x:2x:5; repeat.")
@click.option("--workers", type=int, help="Threads; default: one for each core.")
@click.option("--scheduler", help="Of a Dask cluster: tcp://10.0.0.1:8786.")
@click.option("--checkpoint", type=Path, help="File to keep sums in, and to go on from.")
@click.option("--precision", type=float, help="Relative error of the rmse that is enough: 0.01.")
@_JSON
@_PLOT
@_FORCE
def montecarlo(spec: Spec, *, as_json: bool, **options: Any) -> None:
    """Say over many trials how large the errors of SPEC are, and whether it is right about them.

    The status is 0 if every verdict is consistent. A sweep varies the plant, not the filter.
    """
    from fkgen.study.campaigns.report import campaigned
    from fkgen.study.campaigns.results import Campaign, table_of
    from fkgen.study.campaigns.sweep import table_of as table_of_sweep

    found = campaigned(spec, **options)
    if isinstance(found, Campaign):
        _tell(found, table_of(found), (), as_json=as_json, names=2)
        sys.exit(0 if found.consistent else 1)
    _tell(found, table_of_sweep(found), (), as_json=as_json)
    sys.exit(0 if found.consistent.all() else 1)


@main.command()
@_SPEC
@click.option("-o", "--output", type=Path, help="HTML file; default: standard output.")
@click.option("--record", type=Path, help="Record to filter, as for fkgen run.")
@click.option("--truth", type=Path, help="Its truth: a file with a column for each state, by name.")
@click.option("--u", "inputs", default="", help="Constant inputs of the trials: 1.5,0,...")
@_FORCE
@_reading
def report(spec: Spec, *, output: Path | None, **options: Any) -> None:
    """Write one page about the filter of SPEC: model, proof, consistency, size, how to embed it."""
    from fkgen.study.page.page import reported

    page = reported(spec, output=output, **options)
    if output is None:
        click.echo(page.html, nl=False)
    else:
        _say("note", [f"{output}: written; a browser shows it"])


@main.command()
@click.option("-o", "--output", type=Path, default=Path("fkgen_demo"), help="Folder to write.")
def demo(output: Path) -> None:
    """Generate, compile and run two filters, one of them over a real drive."""
    from fkgen.study.reports.demo import play

    out = console()
    for line in play(output):
        out.print(line, soft_wrap=True)


if __name__ == "__main__":
    main(prog_name="fkgen")
