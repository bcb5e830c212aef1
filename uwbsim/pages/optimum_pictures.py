"""Pictures of the best delays, as files."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from uwblink.output import check_folder, write_files
from uwblink.pages.figures import picture
from uwbsim.pages.protocol_figures import optimum_curve
from uwbsim.protocols.comparison import Optimum


def optimum_file(protocol: str) -> str:
    """Return what `write_optima` calls the picture of a protocol."""
    return f"optimum-{protocol}.png"


def write_optima(found: Iterable[Optimum], folder: Path, *, force: bool = False) -> None:
    """Write the curve of each optimum as a picture (.png) into a folder, which is made where it is missing.

    Raises what `check_folder` raises.
    """
    pictures = {optimum_file(one.protocol): picture(partial(optimum_curve, found=one), "png") for one in found}
    check_folder(folder, pictures, force=force)
    write_files(folder, pictures, force=force)
