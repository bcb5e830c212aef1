"""Commands on recordings: show, import, poses, replay."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from uwblink.cli.guide import add, choice, epilog
from uwblink.cli.imports import ImportGroup
from uwblink.cli.shared import AsJson, Force, print_json
from uwblink.cli.waiting import waiting

PANEL: Final = "Recordings"

EXAMPLES: Final = epilog(
    "uwblink import guess ranges.csv -o map.toml",
    "uwblink import csv ranges.csv --map map.toml -o ranges.uwb",
    "uwblink import csv folder_of_tables -o all.uwb",
    "uwblink import miluv cirObstacles_3_random_0 -o flight.uwb",
)

imports = typer.Typer(cls=ImportGroup, help="Turn other files into recordings.", epilog=EXAMPLES, no_args_is_help=True)


def _exporters() -> list[str]:
    from uwblink.exporters import EXPORTERS

    return list(EXPORTERS)


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    add(app, show, "uwblink show flight.uwb", panel=PANEL)
    imports.callback()(_imports)
    app.add_typer(imports, name="import", rich_help_panel=PANEL)
    add(app, export, "uwblink export flight.uwb --to csv -o tables", panel=PANEL)
    add(
        app,
        poses,
        "uwblink poses bench.uwb --from poses.csv --tags bench.toml",
        "uwblink poses bench.uwb --from drone=drone.tum --offset auto",
        panel=PANEL,
    )
    add(
        app,
        replay,
        "uwblink replay bench.uwb -o again.uwb",
        "uwblink replay bench.uwb --serve --link-dir ports",
        panel=PANEL,
    )


def _imports() -> None:
    """Hold one command for each importer; a group of typer must have something of its own."""


def show(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    as_json: AsJson = False,
) -> None:
    """Print what a recording holds."""
    from uwblink import Recording

    with waiting("counting"), Recording.open(recording) as opened:
        summary = opened.show()
    if as_json:
        print_json(summary.to_dict())
        return
    from rich.console import Console

    from uwblink.cli.tables import print_summary

    print_summary(summary, Console(highlight=False))


def export(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    to: Annotated[
        str,
        typer.Option(
            help="Form of the files: tables, trajectories, or messages for Foxglove and ROS 2.",
            **choice("csv", "parquet", "tum", "mcap", "rosbag2", more=_exporters),
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    force: Force = False,
) -> None:
    """Write a recording as files that others read: tables, or the trajectories of its bodies."""
    from uwblink.exporters import export_recording

    with waiting("exporting"):
        written = export_recording(recording, output, to=to, force=force)
    for name, rows in written.items():
        typer.echo(f"{output / name}: {rows} rows")


def poses(
    recording: Annotated[Path, typer.Argument(help="Recording to add poses to (.uwb).")],
    source: Annotated[
        list[str], typer.Option("--from", help="Poses: .csv, .tum or a ROS bag; or BODY=FILE, as often as needed.")
    ],
    offset: Annotated[str, typer.Option(help="Seconds to add to the poses' times, or auto.")] = "0",
    tags: Annotated[
        Path | None, typer.Option(help="File (.toml) whose \\[\\[tags]] and \\[\\[anchors]] to use.")
    ] = None,
    body: Annotated[str | None, typer.Option(help="The body of a TUM or EuRoC file.")] = None,
    topic: Annotated[
        list[str] | None, typer.Option(help="BODY=TOPIC of a bag, as often as needed; else found by their names.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the poses that the recording has.")] = False,
) -> None:
    """Add motion-capture truth to a recording of boards."""
    from uwblink.importers import add_poses

    files = _files(source)
    topics = _pairs("topic", topic) if topic else None
    with waiting("adding poses"):
        found = add_poses(recording, files, offset=offset, tags_from=tags, body=body, topics=topics, force=force)
    typer.echo(
        f"{recording}: {found.poses} poses of {', '.join(found.bodies)}, offset {found.offset_s:+.4f} s; "
        f"{found.covered} of {found.exchanges} exchanges have a true distance"
    )


def _files(sources: list[str]) -> Path | dict[str, Path]:
    """Return one file, or files by body; a name that is there is a file, whatever it holds."""
    if len(sources) == 1 and ("=" not in sources[0] or Path(sources[0]).exists()):
        return Path(sources[0])
    return {body: Path(name) for body, name in _pairs("from", sources).items()}


def _pairs(option: str, words: list[str]) -> dict[str, str]:
    """Return what stands behind each body; raises `ImportTableError` for words that are not BODY=SOMETHING."""
    from uwblink.errors import ImportTableError

    found: dict[str, str] = {}
    for word in words:
        body, _, rest = word.partition("=")
        if not body or not rest or body in found:
            what = "BODY=TOPIC" if option == "topic" else "BODY=FILE"
            raise ImportTableError(f"--{option}: found {word!r}, expected {what}, each body once")
        found[body] = rest
    return found


def replay(
    recording: Annotated[Path, typer.Argument(help="Recording of boards (.uwb).")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Recording to write, decoded again.")] = None,
    speed: Annotated[float, typer.Option(min=0.001, help="How much faster than it was.")] = 1.0,
    serve: Annotated[bool, typer.Option("--serve", help="Play back on pseudo-terminals.")] = False,
    link_dir: Annotated[Path | None, typer.Option(help="Folder for stable links to them.")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Decode the stored bytes again, or play them back as boards would have sent them."""
    from uwblink import Recording
    from uwblink.boards import decode_again, play, rewrite, summarize
    from uwblink.output import check_output

    if output:
        check_output(output, force=force, recording=True)
    with Recording.open(recording) as opened:
        if serve:
            count = play(opened, _announce, speed=speed, link_dir=link_dir)
            typer.echo(f"{count} pieces played")
            return
        with waiting("decoding"):
            decoded = decode_again(opened)
            summary = summarize(opened, decoded)
            if output:
                rewrite(opened, decoded, output, force=force)
    if as_json:
        print_json(summary)
        return
    typer.echo(f"{summary['messages']} messages, {summary['skipped_bytes']} bytes skipped")
    for table in ("exchanges", "overheard", "cirs"):
        typer.echo(f"  {table}: {summary[table]['decoded']} decoded now, {summary[table]['stored']} stored then")


def _announce(names: dict[str, str]) -> None:
    for was, now in names.items():
        typer.echo(f"{was} plays at {now}")
