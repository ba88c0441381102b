"""The command ``fkgen``: arguments to pipeline and back to text. No other work is done here.

Exit status: 0 all is well; 1 the model, the filter or the record is not in order; 2 a mistake of
the user (one line says which); 130 interrupted.
"""

from __future__ import annotations

# ruff: noqa: PLC0415 - what takes long to import is imported by the commands that need it
import contextlib
import errno
import os
import sys
from pathlib import Path
from typing import Any, NoReturn

import click

from fkgen.cli import studies
from fkgen.console import console as _console
from fkgen.console import print_table as _print_table
from fkgen.errors import FkgenError, InternalError
from fkgen.version import __version__

_INTERRUPTED = 130
_STYLES = {"error": "bold red", "warning": "yellow", "note": "cyan"}


class _OneLine(click.Group):
    """A group of commands whose failures are one line on stderr, never a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()
        except KeyboardInterrupt:
            _fail(ctx, "interrupted", status=_INTERRUPTED)
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


@click.group(cls=_OneLine, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="fkgen", message="%(prog)s %(version)s")
def main() -> None:
    """Kalman filters for systems with faults: described once, proved, printed as C99.

    \b
    fkgen new mkf -o motor.toml      a spec to begin with
    fkgen check motor.toml           is the model sound?
    fkgen generate motor.toml        C code
    fkgen run motor.toml record.csv  filter a record
    fkgen fault-effect motor.toml    what a fault does to the estimate
    fkgen compare motor.toml         which family to take
    """  # noqa: D301 - \b is for click


@main.command()
def families() -> None:
    """List the families of filters."""
    from fkgen.families import NAMES, family

    _print_table(("family", "what it is for"), ((name, family(name).title) for name in NAMES))


@main.command()
@click.argument("family")
@click.option("-o", "--output", type=Path, help="File to write; never one that exists.")
def new(family: str, output: Path | None) -> None:
    """Write a commented spec of FAMILY to begin with."""
    from fkgen.study.records.files import write_whole
    from fkgen.study.reports.starters import starter

    text = starter(family)
    if output is None:
        click.echo(text, nl=False)
        return
    write_whole(output, text.encode("utf-8"))
    click.echo(f"{output}: try: fkgen check {output}")


@main.command()
@click.argument("spec")
@click.option("--json", "as_json", is_flag=True, help="Findings and values as JSON.")
def check(spec: str, as_json: bool) -> None:
    """Say what is wrong with a model before anyone trusts it."""
    from fkgen.problem import load
    from fkgen.study.diagnostics.check import check as examine

    report = examine(load(spec))
    if as_json:
        click.echo(report.to_json())
    else:
        rows = [
            (_styled(f.severity, _STYLES[f.severity]), f.code, "; ".join(filter(None, texts)))
            for f in report.findings
            for texts in [(f.message, f.remedy)]
        ]
        if rows:
            _print_table(("severity", "code", "finding"), rows)
        values = ((name, f"{value:.6g}") for name, value in report.values.items())
        _print_table(("value", "number"), values, number="right")
    sys.exit(0 if report.sound else 1)


def _styled(text: str, style: str) -> Any:
    from rich.text import Text

    return Text(text, style=style)


@main.command()
@click.argument("spec")
@click.option("-o", "--output", type=Path, help="Folder; default: the name of the filter, here.")
def generate(spec: str, output: Path | None) -> None:
    """Prove the filter of SPEC and write it as C."""
    from fkgen import pipeline
    from fkgen.backend.render import cost
    from fkgen.problem import load

    description = load(spec)
    design = pipeline.validate(description)
    source = pipeline.generate(design)
    folder = source.write(output or Path(description.name))
    for name in sorted(source.files):
        click.echo(folder / name)
    click.echo(f"{len(design.claims)} claims hold; one step: {cost(source.program)}")


@main.command()
@click.argument("spec")
def verify(spec: str) -> None:
    """Confront the filter of SPEC with the literature, and the compiled C with all of it."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from fkgen.problem import load
    from fkgen.proof.verify import steps
    from fkgen.symbolic.validated import Claim

    claims: list[Claim] = []
    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    todo = steps(load(spec))
    with Progress(*columns, console=_console(err=True), transient=True) as progress:
        task = progress.add_task("", total=len(todo))
        for step in todo:
            progress.update(task, description=step.title)
            claims += step.run()
            progress.advance(task)
    holds = {True: _styled("yes", "green"), False: _styled("NO", "bold red")}
    head = ("claim", "source", "error", "allowed", "holds")
    numbers = ((f"{c.error:.1e}", f"{c.tolerance:.1e}") for c in claims)
    rows = ((c.claim, c.source, *n, holds[c.holds]) for c, n in zip(claims, numbers, strict=True))
    _print_table(head, rows, error="right", allowed="right")
    failed = sum(not claim.holds for claim in claims)
    click.echo(f"{len(claims) - failed} of {len(claims)} claims hold")
    sys.exit(1 if failed else 0)


@main.command()
@click.argument("spec")
@click.argument("record")
@click.option("-o", "--output", type=Path, help="CSV file to write; default: standard output.")
@studies.PLOT
@click.option("--keep", default="", help="Columns instead of the usual ones: port,port,...")
@studies.FORCE
def run(spec: str, record: str, **options: Any) -> None:
    """Filter RECORD, a CSV file, with the compiled filter of SPEC."""
    from fkgen.problem import load
    from fkgen.study.records import filtering

    done = filtering.run(load(spec), Path(record), **options)
    for note in done.notes:
        click.echo(f"note: {note}", err=True)
    if done.text:
        click.echo(done.text, nl=False)
    for problem in done.problems:
        click.echo(f"warning: {problem}", err=True)
    sys.exit(1 if done.problems else 0)


@main.command()
@click.option("-o", "--output", type=Path, default=Path("fkgen_demo"), help="Folder to write.")
def demo(output: Path) -> None:
    """Generate, compile and run two filters, one of them over a real drive."""
    from fkgen.study.reports.demo import play

    console = _console()
    for line in play(output):
        console.print(line, soft_wrap=True)


for _command in (studies.fault_effect, studies.detectability, studies.simulate, studies.compare):
    main.add_command(_command)


if __name__ == "__main__":
    main(prog_name="fkgen")
