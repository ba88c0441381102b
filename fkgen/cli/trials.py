"""The commands ``fkgen simulate`` and ``fkgen compare``: arguments to study and back."""

from __future__ import annotations

# ruff: noqa: PLC0415 - what takes long to import is imported by the commands that need it
from pathlib import Path
from typing import Any

import click

from fkgen.console import print_table


@click.command()
@click.argument("spec")
@click.option("--steps", type=int, help="Samples; default 200, or as many as the files have.")
@click.option("--seed", default=0, help="Default 0.")
@click.option("--trial", default=0, help="Which trial of the seed; default 0.")
@click.option("--record", type=Path, help="CSV file that gives u, parameters and missing rows.")
@click.option("--u", "inputs", default="", help="Constant inputs instead: 1.5,0,...")
@click.option("--profile", type=Path, help="CSV file with soft faults, by names of signals.")
@click.option("-o", "--output", type=Path, help="CSV file to write; default: standard output.")
@click.option("--force", is_flag=True, help="Replace a file that exists.")
def simulate(spec: str, *, output: Path | None, force: bool, **wish: Any) -> None:
    """Draw one trial of the plant of SPEC, with its faults, as a record for fkgen run."""
    from fkgen.problem import load
    from fkgen.study.comparisons import commands
    from fkgen.study.records.files import refuse_existing, write_whole

    if output is not None:
        refuse_existing(output, force=force, hint=", or --force to replace it")
    text = commands.drawn(load(spec), commands.Draw(**wish))
    if output is None:
        click.echo(text, nl=False)
        return
    write_whole(output, text.encode("utf-8"), force=force)
    click.echo(f"{output}: try: fkgen run {spec} {output}", err=True)


@click.command()
@click.argument("specs", nargs=-1, required=True)
@click.option("--families", default="", help="imm,kf,...; each may be family:key=value.")
@click.option("--runs", default=2000, help="Trials; default 2000.")
@click.option("--steps", type=int, help="Samples; default 200, or as many as the files have.")
@click.option("--seed", default=0, help="Default 0.")
@click.option("--skip", type=int, help="Samples that do not count; default: the first quarter.")
@click.option("--false-alarm", default=0.01, help="Of the NIS test; default 0.01.")
@click.option("--record", type=Path, help="CSV file that gives u, parameters and missing rows.")
@click.option("--u", "inputs", default="", help="Constant inputs instead: 1.5,0,...")
@click.option("--profile", type=Path, help="CSV file with soft faults, by names of signals.")
@click.option("--json", "as_json", is_flag=True, help="Everything as JSON.")
@click.option("--plot", type=Path, help="Picture to draw, as PNG, PDF or SVG.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
def compare(
    specs: tuple[str, ...], *, as_json: bool, plot: Path | None, force: bool, **wish: Any
) -> None:
    """Say which filter to take for the plant and the faults of the first of SPECS.

    Several SPECS are filters as they stand; --families adds families for the plant of the first
    one, and of one spec all that fit are compared.
    """
    from fkgen.problem import load
    from fkgen.study.comparisons import commands
    from fkgen.study.comparisons.report import table_of

    loaded = tuple(load(spec) for spec in specs)
    found = commands.compared(loaded, commands.Wish(**wish), plot=plot, force=force)
    if as_json:
        click.echo(found.to_json())
        return
    head, rows = table_of(found)
    print_table(head, rows, **dict.fromkeys(head[1:], "right"))
    for note in found.notes:
        click.echo(f"note: {note}")
    click.echo(f"\n{found.recommendation}")
