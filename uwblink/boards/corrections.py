"""Corrected ranges while recording, by whatever distribution knows how to correct.

uwblink stands below what calibrates, so it does not import it: an entry point of the group `uwbcal.corrections` names a
function that takes the path of a calibration and returns the function which corrects exchanges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final

from uwblink.arrays import Bools, Floats
from uwblink.errors import PlanError
from uwblink.recording.antenna_delays import AntennaDelays, delays_differ
from uwblink.twr import Exchanges

GROUP: Final = "uwbcal.corrections"
Correction = Callable[[Exchanges], Mapping[str, Floats | Bools]]
"""Returns what is known of exchanges (n,), by name: columns (n,).

`corrected_m` and `sigma_m` in metres, and whatever else whoever corrects can say; NaN where a value is not known.
Raises a `ValueError` for exchanges that it cannot correct, as of a tag that is not calibrated.
"""


def load_correction(path: Path) -> Correction:
    """Return the correction of a calibration's file; raises `PlanError` for what is none, or where nothing corrects.

    What the correction cannot correct is a `PlanError`, too.
    """
    found = sorted(entry_points(group=GROUP), key=lambda entry: entry.name)
    if not found:
        raise PlanError(f"{path}: no installed distribution corrects ranges (entry points of {GROUP})")
    with _as_plan_errors():
        make: Callable[[Path], Correction] = found[0].load()
        made = make(path)
    return _as_plan_errors()(made)


@contextmanager
def _as_plan_errors() -> Iterator[None]:
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        raise PlanError(str(error)) from error


def delays_warning(correct: Correction | None, delays: AntennaDelays, tags: Iterable[int] | None = None) -> str:
    """Say where a correction is of other antenna delays than are programmed now; "" where it is not, or not known.

    A correction says what it is of by an attribute `antenna_delays`. `tags` are those that range, by default all that
    it knows.
    """
    then: AntennaDelays = getattr(correct, "antenna_delays", {})
    return delays_differ(then, delays, (tag for tag in then if tag is not None) if tags is None else tags)


def check_pairs(correct: Correction | None, pairs: Sequence[tuple[int, int]]) -> None:
    """Correct a range of each pair of initiator and target, for what the correction raises where it cannot."""
    if correct and pairs:
        initiator, target = zip(*pairs, strict=True)
        correct(Exchanges.from_arrays(initiator, target, tx1=[0] * len(pairs), rx1=0, tx2=0, rx2=0, range_m=1.0))
