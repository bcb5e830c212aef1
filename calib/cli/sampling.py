"""The command that writes a recording to try the others with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calib.cli.fitting import PANEL
from uwblink.cli.guide import add
from uwblink.cli.options import Force, Seed, count, output


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(
        app,
        sample,
        "calib sample -o sample.uwb",
        "calib sample -o other.uwb --seed 2",
        panel=PANEL,
        renamed={"--anchors": "--with-anchors"},
    )


def sample(
    output: Annotated[Path, output("Recording to write (.uwb).")],
    count: Annotated[int, count("Number of exchanges, 100 per second.", min=3, max=1_000_000)] = 3000,
    seed: Seed = 1,
    with_anchors: Annotated[bool, typer.Option("--with-anchors", help="One moving tag and four anchors.")] = False,
    force: Force = False,
) -> None:
    """Write a small flight with known delays, to try the other commands with; no simulator is needed for it."""
    import calib
    from uwblink import Contents
    from uwblink.output import check_output

    check_output(output, force=force, recording=True)
    seed = 1 if seed is None else seed
    flight = calib.sample_flight(count, seed=seed, anchors=with_anchors)
    meta = {"planted": flight.planted, "source": "sample", "seed": seed}
    contents = Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags, meta=meta)
    contents.save(output, force=force)
    typer.echo(f"{output}: {count} exchanges of tags {', '.join(str(tag.tag) for tag in flight.tags)}, known delays")
