"""`uwblink import NAME`: a command for each row of the table of importers, made when it is asked for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uwblink.cli.guide import apart, epilog, plain
from uwblink.cli.options import Command, Group
from uwblink.cli.shared import Force
from uwblink.cli.waiting import waiting

if TYPE_CHECKING:
    from uwblink.importers import Importer

Output = Annotated[Path, typer.Option("-o", "--output", help="Recording to write (.uwb).")]


class ImportGroup(Group):
    """A group whose commands are the importers, those of other distributions included."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the importers."""
        from uwblink.importers import IMPORTERS

        return [*IMPORTERS, "guess"]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of one importer, None where there is none of the name."""
        from uwblink.importers import IMPORTERS

        if cmd_name == "guess":
            text = "Look at a table and write the map that it would be imported with."
            return _made("guess", text, guess, "uwblink import guess ranges.csv -o map.toml")
        return _command(IMPORTERS[cmd_name]) if cmd_name in IMPORTERS else None


def _command(row: Importer) -> Any:
    source = f"measured{row.suffixes[0]}" if row.suffixes else "folder"
    example = f"uwblink import {row.name} {source} -o measured.uwb"
    return _made(row.name, row.help, _with_map(row) if row.map_help else _without_map(row), example)


def _made(name: str, text: str, function: Callable[..., None], example: str) -> Any:
    app = typer.Typer(add_completion=False)
    app.command(name, cls=Command, help=plain(text), epilog=epilog(example))(apart(function))
    return typer.main.get_command(app)


def guess(
    table: Annotated[Path, typer.Argument(help="Table (.csv, .csv.gz, .parquet, .jsonl).")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Map to write (.toml); else printed.")] = None,
    force: Force = False,
) -> None:
    """Look at a table and write the map that it would be imported with, and why."""
    from uwblink.importers.guess import guess_map
    from uwblink.output import check_output, write_text

    if output is not None:
        check_output(output, force=force)
    with waiting("reading"):
        found = guess_map(table)
    if output is None:
        typer.echo(found.text, nl=False)
        return
    write_text(output, found.text, force=force)
    then = f"uwblink import csv {quote(str(table))} --map {quote(str(output))} -o {quote(table.name.split('.')[0])}.uwb"
    asked = f"say {' and '.join(found.asked)} in it" if found.asked else "look at it"
    typer.echo(f"{output}: {asked if found.complete else 'fill in what is missing'}, then {then}")


def _with_map(row: Importer) -> Any:
    def run(table: Any, output: Output, map_file: Path | None = None, force: Force = False) -> None:
        _import(row, table, output, map_file, force=force)

    # typer reads annotations, and these depend on the row.
    run.__annotations__ |= {
        "table": _argument(row),
        "output": Output,
        "map_file": Annotated[Path | None, typer.Option("--map", help=row.map_help)],
        "force": Force,
    }
    return run


def _without_map(row: Importer) -> Any:
    def run(table: Path, output: Output, force: Force = False) -> None:
        _import(row, table, output, None, force=force)

    run.__annotations__ |= {"table": _argument(row), "output": Output, "force": Force}
    return run


def _argument(row: Importer) -> Any:
    what = f"File to import ({' or '.join(row.suffixes)})." if row.suffixes else "Folder to import."
    if row.read_all is None:
        return Annotated[Path, typer.Argument(help=what)]
    return Annotated[list[Path], typer.Argument(help=f"{what} Several are one table.")]


def _import(row: Importer, source: Path | list[Path], output: Path, map_file: Path | None, *, force: bool) -> None:
    from uwblink.display import printable
    from uwblink.importers import import_file

    with waiting("importing") as say:
        done = import_file(
            source,
            output,
            importer=row.name,
            map_file=map_file,
            force=force,
            watch=lambda what, share: say(f"{what}, {share:.0%}" if share else what),
        )
    typer.echo(f"{output}: {', '.join(f'{count} {table}' for table, count in done.counts.items())}")
    for note in done.notes:
        typer.echo(f"  {printable(note)}")
