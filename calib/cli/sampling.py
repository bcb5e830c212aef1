"""The command that writes a recording to try the others with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.arguments import Force
from calib.cli.fitting import PANEL
from uwblink.cli.guide import add


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(app, sample, "calib sample -o sample.uwb", "calib sample -o other.uwb --seed 2", panel=PANEL)


def sample(
    output: Annotated[Path, typer.Option("-o", "--output", help="Recording to write (.uwb).")],
    count: Annotated[int, typer.Option("-n", min=3, max=1_000_000, help="How many exchanges, 100 a second.")] = 3000,
    seed: Annotated[int, typer.Option(min=0, help="Another flight for another number.")] = 1,
    anchors: Annotated[bool, typer.Option("--anchors", help="One tag moves, and four stand fixed.")] = False,
    force: Force = False,
) -> None:
    """Write a small flight with known delays, to try the other commands with; no simulator is needed for it."""
    import calib
    from uwblink import Contents
    from uwblink.output import check_output

    check_output(output, force=force, recording=True)
    flight = calib.sample_flight(count, seed=seed, anchors=anchors)
    meta = {"planted": flight.planted, "source": "sample", "seed": seed}
    contents = Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags, meta=meta)
    contents.save(output, force=force)
    typer.echo(f"{output}: {count} exchanges of tags {', '.join(str(tag.tag) for tag in flight.tags)}, known delays")
