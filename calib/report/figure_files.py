"""Figures as files, of what has no report of its own: localization, and two calibrations side by side."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from calib.calibration.comparison import Comparison
from calib.calibration.model import Calibration
from calib.evaluation.onboard_track import OnboardTrack
from calib.evaluation.tracking import Localization
from calib.report import figures_comparison, figures_tracks
from calib.report.blocks import Block, Document, Picture
from calib.report.localization_section import file_name
from calib.report.writing import write_document


def write_track_figures(found: Sequence[Localization], folder: Path, *, force: bool = False) -> None:
    """Write bars of the RMSE and each body's track into a folder, as PDF and SVG at two widths.

    Raises what `check_places` raises.
    """
    tracks = [
        Picture(f"track-{file_name(one.source, one.body)}", partial(figures_tracks.track, one=one), one.body)
        for one in found
    ]
    _write([Picture("rmse", partial(figures_tracks.rmse_bars, found=list(found)), "RMSE"), *tracks], folder, force)


def write_onboard_figures(found: Sequence[OnboardTrack], folder: Path, *, force: bool = False) -> None:
    """Write each body's track by what is on board, likewise."""
    _write(
        [
            Picture(f"track-{file_name(one.source, one.body)}", partial(figures_comparison.onboard, one=one), one.body)
            for one in found
        ],
        folder,
        force,
    )


def write_comparison_figures(
    found: Comparison, known: Sequence[Calibration], names: Sequence[str], folder: Path, *, force: bool = False
) -> None:
    """Write the differences of delays and both calibrations' curves, likewise; `names` are what they are called."""
    _write(
        [
            Picture("differences", partial(figures_comparison.differences, found=found), "Delays"),
            Picture("curves", partial(figures_comparison.both_curves, known=known, names=names), "Curves"),
        ],
        folder,
        force,
    )


def _write(pictures: Sequence[Block], folder: Path, force: bool) -> None:
    write_document(Document("", list(pictures)), None, None, folder, force=force)
