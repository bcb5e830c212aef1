"""Export of recordings to files of other formats; programs can register exporters of their own."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from uwblink.errors import ArgumentError, RecordingError, RecordingExistsError, UwblinkError
from uwblink.exporters.mcap import write_mcap, write_rosbag2
from uwblink.exporters.tables import write_csv, write_parquet, write_tum
from uwblink.output import place_beside, take_name
from uwblink.plugins import Registry, check_row
from uwblink.recording.intake import check_name


@dataclass(frozen=True, slots=True)
class Exporter:
    """A format to which recordings can be exported.

    `write(recording, folder)` writes files into an empty folder and returns what each holds, rows by the file's name;
    it raises `RecordingError`.
    """

    name: str
    write: Callable[[Path, Path], dict[str, int]]
    help: str


def check_exporter(row: Any) -> None:
    """Raise `ArgumentError` for a row that cannot be an exporter."""
    check_row("exporter", row, Exporter, {"write": (callable, "a function of two paths")})


EXPORTERS: Final[Registry[Exporter]] = Registry(
    "exporter",
    "uwbcal.exporters",
    (
        Exporter("csv", write_csv, "a CSV file a table"),
        Exporter("parquet", write_parquet, "a Parquet file a table"),
        Exporter("tum", write_tum, "a trajectory a body (time x y z qx qy qz qw)"),
        Exporter("mcap", write_mcap, "one file of JSON messages, for Foxglove and PlotJuggler"),
        Exporter("rosbag2", write_rosbag2, "a bag of ROS 2: PoseStamped, tf, sensor_msgs/Range and Imu"),
    ),
    check_exporter,
)
"""Exporters by name: the project's, those of `register_exporter`, and those of installed distributions."""


def register_exporter(row: Exporter, *, replace: bool = False) -> None:
    """Add a format to `EXPORTERS`, for `export_recording` and `uwblink export`.

    `replace` puts it in place of one registered before. Raises `ArgumentError` for a name that is taken.
    """
    EXPORTERS.register(row, replace=replace)


def check_export(folder: str | os.PathLike[str], *, to: str, force: bool) -> None:
    """Raise what `export_recording` raises for an unknown format, or a folder that cannot be written."""
    final = Path(folder)
    if to not in EXPORTERS:
        raise ArgumentError(f"found {to!r:.40}, allowed: {', '.join(EXPORTERS)}", parameter="to")
    check_name(final)
    if final.exists() and (not force or not final.is_dir()):
        raise RecordingExistsError(f"{final}: exists already; give another name, or `force` to replace it")
    if not final.parent.is_dir():
        raise RecordingError(f"{final}: the folder {final.parent} does not exist; create it first")


def export_recording(
    recording: str | os.PathLike[str], folder: str | os.PathLike[str], *, to: str, force: bool = False
) -> dict[str, int]:
    """Write a recording as files in a new folder; returns the rows of each file.

    `to` names a row of `EXPORTERS`. Files are written to a hidden folder, which takes the name when all went well.
    Raises `ArgumentError`, `RecordingError` and `RecordingExistsError` (a folder that is there, unless `force`).

    >>> import pathlib, tempfile, uwblink
    >>> from uwblink.exporters import export_recording
    >>> place = pathlib.Path(tempfile.mkdtemp())
    >>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    >>> uwblink.Contents(exchanges=x).save(place / "mine.uwb")
    >>> export_recording(place / "mine.uwb", place / "mine", to="csv")["exchanges.csv"]
    1
    """
    final = Path(folder)
    check_export(final, to=to, force=force)
    try:
        with place_beside(final) as partial:
            partial.mkdir()
            with EXPORTERS.calling(to, RecordingError):
                written = EXPORTERS[to].write(Path(recording), partial)
            take_name(partial, final)
    except OSError as error:
        if isinstance(error, UwblinkError):
            raise
        raise RecordingError(f"{final}: cannot be written ({error.strerror or error})") from error
    return written
