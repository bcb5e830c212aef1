"""All sub-commands of `uwblink`; those on recordings are here: show, import, export, poses, replay."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import uwblink
from uwblink.cli import boards
from uwblink.cli.shared import (
    AsJson,
    Force,
    Group,
    LinkDir,
    PlaybackSpeed,
    add,
    choice,
    epilog,
    new_app,
    output,
    print_json,
    print_result,
    waiting,
)
from uwblink.display import first_few, printable
from uwblink.errors import ImportTableError
from uwblink.output import check_output, write_text

if TYPE_CHECKING:
    from uwblink.importers import Importer
    from uwblink.recording import Summary


def _exporters() -> list[str]:
    return list(uwblink.exporters.EXPORTERS)


class ImportGroup(Group):
    """A group with one command for each importer, those of other distributions included."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the importers, and `guess`."""
        return [*uwblink.importers.IMPORTERS, *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command by its name, None if there is none."""
        if cmd_name not in uwblink.importers.IMPORTERS:
            if Path(cmd_name).exists():
                how = f"state how to read it, or try: uwblink import guess {quote(cmd_name)} -o map.toml"
                raise ImportTableError(f"{cmd_name}: {how}")
            return super().get_command(ctx, cmd_name)
        row: Importer = uwblink.importers.IMPORTERS[cmd_name]
        source = f"measured{row.suffixes[0]}" if row.suffixes else "folder"
        app = typer.Typer(add_completion=False)
        add(app, _importing(row), f"uwblink import {row.name} {source} -o measured.uwb", name=cmd_name)
        return typer.main.get_command(app)


imports = typer.Typer(
    cls=ImportGroup,
    help="Import other files as recordings.",
    epilog=epilog(
        "uwblink import guess ranges.csv -o map.toml",
        "uwblink import csv ranges.csv --map map.toml -o ranges.uwb",
        "uwblink import csv folder_of_tables -o all.uwb",
        "uwblink import miluv cirObstacles_3_random_0 -o flight.uwb",
    ),
    no_args_is_help=True,
)


def guess(
    table: Annotated[Path, typer.Argument(help="Table, log, folder of them, or bag.")],
    output: Annotated[Path | None, output("Map to write (.toml); by default it is printed.")] = None,
    force: Force = False,
) -> None:
    """Propose the map of a table or a bag: topics, names and units of columns, with the reason for each line."""
    from uwblink.importers.guess import guess_map

    if output is not None:
        check_output(output, force=force)
    with waiting("reading"):
        found = guess_map(table)
    if output is None:
        typer.echo(found.text, nl=False)
        return
    write_text(output, found.text, force=force)
    name = quote(table.name.split(".")[0])
    then = f"uwblink import {found.importer} {quote(str(table))} --map {quote(str(output))} -o {name}.uwb"
    asked = f"set {' and '.join(found.asked)} in it" if found.asked else "check it"
    typer.echo(f"{output}: {asked if found.complete else 'fill in what is missing'}, then {then}")
    if found.pose_topics or found.advice:
        typer.echo(found.advice or _pose_command(found.pose_topics, f"{name}.uwb", table))


def _pose_command(topics: Sequence[str], recording: str, bag: Path) -> str:
    """Return the command that adds the poses on some topics of a bag to a recording."""
    named = first_few(map(json.dumps, topics))
    command = f"uwblink poses {recording} --from {quote(str(bag))} --tags TAGS.toml"
    return f"the poses on {named} give true distances: {command} (TAGS.toml: bodies and lever arms of the tags)"


def _importing(row: Importer) -> Callable[..., None]:
    """Return the command of an importer. Typer reads its parameters from the annotations, which depend on the row."""

    def run(table: Any, output: Path, map_file: Path | None = None, force: bool = False) -> None:
        with waiting("importing") as report:
            done = uwblink.importers.import_file(
                table,
                output,
                importer=row.name,
                map_file=map_file,
                force=force,
                watch=lambda what, share: report(f"{what}, {share:.0%}" if share else what),
            )
        typer.echo(f"{output}: {', '.join(f'{count} {table}' for table, count in done.counts.items())}")
        for note in done.notes:
            typer.echo(f"  {printable(note)}")
        if row.name == "bag" and "poses" not in done.counts and (found := uwblink.importers.pose_topics(table)):
            typer.echo(_pose_command(found, quote(str(output)), table))

    def without_map(table: Any, output: Path, force: bool = False) -> None:
        run(table, output, force=force)

    what = f"File to import ({' or '.join(row.suffixes)})." if row.suffixes else "Folder to import."
    several = typer.Argument(help=f"{what} Several files are one table.")
    one = typer.Argument(help=what)
    command = run if row.map_help else without_map
    command.__doc__ = escape(row.help)
    command.__annotations__ |= {
        "table": Annotated[list[Path], several] if row.several else Annotated[Path, one],
        "output": Annotated[Path, output("Recording to write (.uwb).")],
        "force": Force,
    }
    if row.map_help:
        command.__annotations__["map_file"] = Annotated[Path | None, typer.Option("--map", help=row.map_help)]
    return command


def show(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    as_json: AsJson = False,
) -> None:
    """Print a summary of a recording."""

    with waiting("counting"), uwblink.Recording.open(recording) as opened:
        summary = opened.show()
    if as_json:
        print_json(summary.to_dict())
        return
    print_summary(summary, Console(highlight=False))


def print_summary(summary: Summary, console: Console) -> None:
    """Print a summary; text from files and boards is escaped, because it can have markup and control characters."""
    console.print(escape(summary.headline()))
    for header, *rows in summary.tables():
        table = Table(*header)
        for row in rows:
            table.add_row(*(escape(printable(cell)) for cell in row))
        if rows:
            console.print(table)
    for line in (*summary.lines(), *(printable(f"  {key}: {value}") for key, value in summary.provenance.items())):
        console.print(escape(line))


def export(
    recording: Annotated[Path, typer.Argument(help="Recording (.uwb).")],
    to: Annotated[
        str,
        typer.Option(
            help="Format to write: tables, trajectories, or messages for Foxglove and ROS 2.",
            **choice("csv", "parquet", "tum", "mcap", "rosbag2", more=_exporters),
        ),
    ],
    output: Annotated[Path, output("Folder to write.")],
    force: Force = False,
) -> None:
    """Write a recording in a format that other programs read."""
    with waiting("exporting"):
        written = uwblink.exporters.export_recording(recording, output, to=to, force=force)
    for name, rows in written.items():
        typer.echo(f"{output / name}: {rows} rows")


def poses(
    recording: Annotated[Path, typer.Argument(help="Recording to add poses to (.uwb).")],
    source: Annotated[
        list[str] | None,
        typer.Option("--from", help="Poses (.csv, .tsv, .tum or a ROS bag), or BODY=FILE. May be repeated."),
    ] = None,
    offset: Annotated[str, typer.Option(help="Seconds to add to the times of the poses, or auto.")] = "0",
    tags: Annotated[Path | None, typer.Option(help="File with the tags and anchors (.toml, .json).")] = None,
    body: Annotated[str | None, typer.Option(help="Body of a TUM or EuRoC file.")] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(help="BODY=TOPIC of a bag; by default topics are found by their names. May be repeated."),
    ] = None,
    map_file: Annotated[Path | None, typer.Option("--map", help="Names and units of a CSV's columns (.toml).")] = None,
    force: Force = False,
) -> None:
    """Add poses of motion capture to a recording; --force replaces its poses."""
    source = source or []
    sources: Any = Path(source[0]) if source else {}
    if len(source) > 1 or (source and "=" in source[0] and not sources.exists()):
        sources = {name: Path(file) for name, file in _by_body("from", "FILE", source).items()}
    topics = _by_body("topic", "TOPIC", topic) if topic else None
    with waiting("adding poses"):
        found = uwblink.importers.add_poses(
            recording, sources, offset=offset, tags_from=tags, body=body, topics=topics, map_file=map_file, force=force
        )
    typer.echo(
        f"{recording}: {found.poses} poses of {', '.join(found.bodies)}, offset {found.offset_s:+.4f} s; "
        f"{found.covered} of {found.exchanges} measurements have a true distance"
        + (f"; no poses of {', '.join(found.missing)}" if found.missing else "")
    )


def _by_body(option: str, what: str, words: list[str]) -> dict[str, str]:
    """Return the values of BODY=VALUE by body; raises `ImportTableError`."""
    found: dict[str, str] = {}
    for word in words:
        body, _, rest = word.partition("=")
        if not body or not rest or body in found:
            raise ImportTableError(f"--{option}: found {word!r}, expected BODY={what}, each body once")
        found[body] = rest
    return found


def replay(
    recording: Annotated[Path, typer.Argument(help="Recording of boards (.uwb).")],
    output: Annotated[Path | None, output("Recording to write with the decoded messages (.uwb).")] = None,
    speed: PlaybackSpeed = 1.0,
    serve: Annotated[bool, typer.Option("--serve", help="Play back on pseudo-terminals.")] = False,
    link_dir: LinkDir = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Decode the stored bytes of boards again, or play them back on pseudo-terminals."""
    if output:
        check_output(output, force=force, recording=True)
    with uwblink.Recording.open(recording) as opened:
        if serve:
            played = uwblink.boards.play(
                opened,
                lambda names: typer.echo("\n".join(f"{was} plays at {now}" for was, now in names.items())),
                speed=speed,
                link_dir=link_dir,
            )
            typer.echo(f"{played} pieces played")
            return
        with waiting("decoding"):
            decoded = uwblink.boards.decode_again(opened)
            summary = uwblink.boards.summarize(opened, decoded)
            if output:
                uwblink.boards.rewrite(opened, decoded, output, force=force)
    lines = [f"{summary['messages']} messages, {summary['skipped_bytes']} bytes skipped"]
    lines += [
        f"  {table}: {summary[table]['decoded']} decoded now, {summary[table]['stored']} in the recording"
        for table in ("exchanges", "overheard", "cirs")
    ]
    print_result(summary, "\n".join(lines), as_json=as_json)


app = new_app("Command ranging boards, record and stream their ranges, and import, export and show recordings.")
boards.add_to(app)
add(imports, guess, "uwblink import guess ranges.csv -o map.toml")
add(app, show, "uwblink show flight.uwb", panel="Recordings")
app.add_typer(imports, name="import", rich_help_panel="Recordings")
for _command, *_examples in (
    (export, "uwblink export flight.uwb --to csv -o tables"),
    (
        poses,
        "uwblink poses bench.uwb --from poses.csv --tags bench.toml",
        "uwblink poses bench.uwb --from drone=drone.tum --offset auto",
    ),
    (replay, "uwblink replay bench.uwb -o again.uwb", "uwblink replay bench.uwb --serve --link-dir ports"),
):
    add(app, _command, *_examples, panel="Recordings")
