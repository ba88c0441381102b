"""The commands ``fkgen fault-effect`` and ``fkgen detectability``: arguments to study and back."""

from __future__ import annotations

# ruff: noqa: PLC0415 - what takes long to import is imported by the commands that need it
from pathlib import Path
from typing import Any

import click

from fkgen.console import print_table


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
@click.option("--record", type=Path, help="CSV file that gives u, parameters and missing rows.")
@click.option("--u", "inputs", default="", help="Constant inputs instead: 1.5,0,...")
@click.option("--mode", default="both", help="Who gets a faulty input: both, plant or filter.")
@click.option("--fraction", default=0.01, help="Share of the peak that counts as over.")
@click.option("--false-alarm", default=1e-3, help="Of the NIS test; default 0.001.")
@click.option("--runs", default=256, help="Pairs, where they have to be simulated.")
@click.option("--json", "as_json", is_flag=True, help="Everything, sample by sample, as JSON.")
@click.option("--plot", type=Path, help="Picture to draw, as PNG, PDF or SVG.")
@click.option("--force", is_flag=True, help="Replace files that exist.")
def fault_effect(spec: str, *, as_json: bool, plot: Path | None, force: bool, **wish: Any) -> None:
    """Say what a fault of a sensor or an input does to the estimate of SPEC, and for how long."""
    from fkgen.problem import load
    from fkgen.study.effects import report

    description = load(spec)
    done = report.answer(description, report.Wish(**wish), plot=plot, force=force)
    if as_json:
        click.echo(done.to_json())
    else:
        head, rows = done.table()
        print_table(head, rows, **dict.fromkeys(head[1:], "right"))
        for line in done.sentences():
            click.echo(line)
    for note in done.notes:
        click.echo(f"note: {note}", err=True)


@click.command()
@click.argument("spec")
@click.option("--direction", default="", help="Direction of the bias in y instead: 1,-1,...")
@click.option("--false-alarm", default=1e-3, help="Per test; default 0.001.")
@click.option("--power", default=0.9, help="Probability to find the bias; default 0.9.")
@click.option("--window", default="1,10,50,200", help="Samples of the windowed tests.")
@click.option("--u", "inputs", default="", help="Constant inputs, for mkf: 1.5,0,...")
@click.option("--json", "as_json", is_flag=True, help="As JSON.")
def detectability(spec: str, *, as_json: bool, **wish: Any) -> None:
    """Say how large a constant bias of a sensor has to be to be found by the filter of SPEC."""
    from fkgen.problem import load
    from fkgen.study.effects import detectability as report

    done = report.answer(load(spec), report.Wish(**wish))
    if as_json:
        click.echo(done.to_json())
        return
    head, rows = done.table()
    print_table(head, rows, **dict.fromkeys(head[2:], "right"))
    click.echo(done.sentence())
