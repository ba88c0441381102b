"""The commands that study faults and filters: arguments to studies and back."""

from __future__ import annotations

# ruff: noqa: PLC0415 - what takes long to import is imported by the commands that need it
from pathlib import Path
from typing import Any

import click

from fkgen.console import print_table

RECORD = click.option(
    "--record", type=Path, help="CSV file that gives u, parameters and missing rows."
)
INPUTS = click.option("--u", "inputs", default="", help="Constant inputs instead: 1.5,0,...")
SOFT_FAULTS = click.option(
    "--profile", type=Path, help="CSV file with soft faults, by names of signals."
)
STEPS = click.option(
    "--steps", type=int, help="Samples; default 200, or as many as the files have."
)
SEED = click.option("--seed", default=0, help="Default 0.")
PLOT = click.option("--plot", type=Path, help="Picture to draw, as PNG, PDF or SVG.")
FORCE = click.option("--force", is_flag=True, help="Replace files that exist.")


@click.command("fault-effect")
@click.argument("spec")
@click.option("--sensor", help="Row of y that is faulty, by name.")
@click.option("--input", "driven", help="Input that is faulty, by name.")
@click.option("--shape", default="step", help="pulse, step (default), ramp or drift.")
@click.option("--amplitude", default=1.0, help="Its size, in the unit of the signal; default 1.")
@click.option("--start", default=0, help="First faulty sample; default 0.")
@click.option("--stop", type=int, help="First healthy sample after it; default: it stays.")
@click.option("--length", default=10, help="Samples in which a ramp rises; default 10.")
@click.option("--steps", default=100, help="Samples to look at; default 100.")
@click.option("--profile", type=Path, help="CSV file with the fault instead, by names of signals.")
@RECORD
@INPUTS
@click.option("--mode", default="both", help="Who gets a faulty input: both, plant or filter.")
@click.option("--fraction", default=0.01, help="Share of the peak that counts as over.")
@click.option("--false-alarm", default=1e-3, help="Of the NIS test; default 0.001.")
@click.option("--runs", default=256, help="Pairs, where they have to be simulated.")
@click.option("--json", "as_json", is_flag=True, help="Everything, sample by sample, as JSON.")
@PLOT
@FORCE
def fault_effect(
    spec: str, *, as_json: bool, plot: Path | None, force: bool, **options: Any
) -> None:
    """Say what a fault of a sensor or an input does to the estimate of SPEC, and for how long."""
    from fkgen.problem import load
    from fkgen.study.effects.report import Options, report_of

    found = report_of(load(spec), Options(**options), plot=plot, force=force)
    if as_json:
        click.echo(found.to_json())
    else:
        print_table(found.head, found.rows, **dict.fromkeys(found.head[1:], "right"))
        for line in found.sentences:
            click.echo(line)
    for note in found.notes:
        click.echo(f"note: {note}", err=True)


@click.command()
@click.argument("spec")
@click.option("--direction", default="", help="Direction of the bias in y instead: 1,-1,...")
@click.option("--false-alarm", default=1e-3, help="Per test; default 0.001.")
@click.option("--power", default=0.9, help="Probability to find the bias; default 0.9.")
@click.option("--window", default="1,10,50,200", help="Samples of the windowed tests.")
@click.option("--u", "inputs", default="", help="Constant inputs, for mkf: 1.5,0,...")
@click.option("--json", "as_json", is_flag=True, help="As JSON.")
def detectability(spec: str, *, as_json: bool, **options: Any) -> None:
    """Say how large a constant bias of a sensor has to be to be found by the filter of SPEC."""
    from fkgen.problem import load
    from fkgen.study.effects.detectability import least_biases

    found = least_biases(load(spec), **options)
    if as_json:
        click.echo(found.to_json())
        return
    print_table(found.head, found.rows, **dict.fromkeys(found.head[2:], "right"))
    for line in found.sentences:
        click.echo(line)


@click.command()
@click.argument("spec")
@STEPS
@SEED
@click.option("--trial", default=0, help="Which trial of the seed; default 0.")
@RECORD
@INPUTS
@SOFT_FAULTS
@click.option("-o", "--output", type=Path, help="CSV file to write; default: standard output.")
@click.option("--force", is_flag=True, help="Replace a file that exists.")
def simulate(spec: str, *, output: Path | None, force: bool, **options: Any) -> None:
    """Draw one trial of the plant of SPEC, with its faults, as a record for fkgen run."""
    from fkgen.problem import load
    from fkgen.study.comparisons.commands import drawn
    from fkgen.study.records.files import refuse_targets, write_whole

    refuse_targets(output, force=force)
    text = drawn(load(spec), **options)
    if output is None:
        click.echo(text, nl=False)
        return
    write_whole(output, text.encode("utf-8"), force=force)
    click.echo(f"{output}: try: fkgen run {spec} {output}", err=True)


@click.command()
@click.argument("specs", nargs=-1, required=True)
@click.option("--families", default="", help="imm,kf,...; each may be family:key=value.")
@click.option("--runs", default=2000, help="Trials; default 2000.")
@STEPS
@SEED
@click.option("--skip", type=int, help="Samples that do not count; default: the first quarter.")
@click.option("--false-alarm", default=0.01, help="Of the NIS test; default 0.01.")
@RECORD
@INPUTS
@SOFT_FAULTS
@click.option("--json", "as_json", is_flag=True, help="Everything as JSON.")
@PLOT
@FORCE
def compare(specs: tuple[str, ...], *, as_json: bool, **options: Any) -> None:
    """Say which filter to take for the plant and the faults of the first of SPECS.

    Several SPECS are filters as they stand; --families adds families for the plant of the first
    one, and of one spec all that fit are compared.
    """
    from fkgen.problem import load
    from fkgen.study.comparisons.commands import compared
    from fkgen.study.comparisons.report import table_of

    found = compared(tuple(load(spec) for spec in specs), **options)
    if as_json:
        click.echo(found.to_json())
        return
    head, rows = table_of(found)
    print_table(head, rows, **dict.fromkeys(head[1:], "right"))
    for note in found.notes:
        click.echo(f"note: {note}")
    click.echo(f"\n{found.recommendation}")
