"""What `calib fit --truth ranges` takes and does, where distances are found together with the delays."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from calib.errors import BadInputError
from uwblink import KnownDistance

if TYPE_CHECKING:
    import calib
    from calib.estimation import FitSettings

NUMBER: Final = r"\s*(\d+(?:\.\d*)?|\.\d+)\s*"
TAPED: Final = re.compile(rf"\s*(\d+)\s*-\s*(\d+)\s*={NUMBER}(?:(?:\+-|±){NUMBER})?(?:@(.+))?$")
TAPE_M: Final = 0.01
"""What a tape is good to where nobody says."""

TRUTHS: Final = ("recorded", "ranges")
SHARED: Final = ("fixed_ns", "groups", "lift", "reference_power_dbm", "delays_only", "minimum_norm")
"""Settings that both fits take."""

ALONE: Final = {
    "loss": None,
    "scale_ns": None,
    "sequential": False,
    "delays_from": None,
    "constants": "tag",
}
"""Settings of the other fit, and what they are when nobody asks for them."""


def trajectory_options(truth: str, settings: dict[str, Any]) -> dict[str, Any] | None:
    """Return the settings that only a fit without known distances takes; None for a fit with them."""
    if truth not in TRUTHS:
        raise BadInputError(f"found {truth!r}, allowed: {', '.join(TRUTHS)}", parameter="truth")
    given = {name: value for name, value in settings.items() if value is not None}
    if "distances" in given:
        given["distances"] = [taped(text) for text in given["distances"]]
    if truth == "ranges":
        return given
    for name in given:
        raise BadInputError("goes with a fit whose `truth` is ranges", parameter=name)
    return None


def taped(text: str) -> KnownDistance:
    """Return the distance that a text TAG-TAG=METRES says; raises `BadInputError` for what cannot be read."""
    found = TAPED.match(text)
    if found is None:
        raise BadInputError(
            f"found {text!r:.60}, expected TAG-TAG=METRES, as in 11-12=3.06, 11-12=3.06+-0.005 or 1-3=1.52@2..8",
            parameter="distances",
        )
    first, second, distance, sigma, when = found.groups()
    return KnownDistance(int(first), int(second), float(distance), float(sigma or TAPE_M), (when or "").strip())


def fitted_from_ranges(
    recordings: Sequence[Path], options: FitSettings, unknown: dict[str, Any], *, trim_static: bool
) -> calib.FitResult:
    """Fit without known distances and show how far it has come; raises `BadInputError` for settings of other fits."""
    import calib

    if len(recordings) != 1:
        raise BadInputError("ranges takes one recording, of one flight", parameter="truth")
    given: dict[str, Any] = dict(options)
    for name, nothing in ALONE.items():
        if given[name] != nothing:
            raise BadInputError("goes with known distances only, not with `truth` ranges", parameter=name)
    if trim_static:
        raise BadInputError("goes with known distances only, not with `truth` ranges", parameter="trim_static")
    with _progress(recordings[0].name) as report:
        return calib.fit_from_ranges(
            recordings[0], progress=report, **{name: given[name] for name in SHARED}, **unknown
        )


@contextmanager
def _progress(name: str) -> Iterator[Callable[[float], None] | None]:
    """Show a bar on a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(escape(name), total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)
