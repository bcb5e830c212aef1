"""Stamps that make ranges by another protocol, or as a counter of another width, than the recording says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from calib.doctor.base import RecordingView, plausible_share
from calib.doctor.checks import Seen
from uwblink.arrays import Bools
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording import target_faster_ppm
from uwblink.twr import Exchanges, raw_range

WIDTHS: Final = (32, 40)
ENOUGH: Final = 0.5
"""Another reading must make at least this share of the ranges possible, and by `GAIN` more than the recording's own."""

GAIN: Final = 0.2
GAIN_OF_WIDTH: Final = 0.01
SKEW_PPM: Final = 100.0
MOST: Final = 4000


def another(view: RecordingView) -> Iterator[Seen]:
    """Try every other protocol with as many messages, and every width of the counter."""
    e = view.exchanges[:: max(len(view.exchanges) // MOST, 1)]
    own = _share(e)
    names, counts = np.unique(e.protocol, return_counts=True)
    said = str(names[int(np.argmax(counts))])
    tried = {
        (name, bits): _share(replace(e, protocol=np.full(len(e), name), bits=bits)) for name, bits in _others(e, said)
    }
    if not tried:
        return
    name, bits = max(tried, key=lambda key: (round(tried[key], 2), key[1] == e.bits, key[0] == said))
    share, wider = tried[name, bits], bits != e.bits
    gain = GAIN_OF_WIDTH if name == said else GAIN
    if share < ENOUGH or share < own + gain:
        return
    numbers = f"{100 * share:.1f} % of the ranges are possible, {100 * own:.1f} % as the recording has it"
    if name == said:
        yield Seen("timestamp width", f"as {bits}-bit stamps {numbers}", words={"bits": bits})
        return
    alike = [n for n in PROTOCOLS if tried.get((n, bits), 0.0) > share - 0.01 and n != said]
    also = f" (or {' or '.join(n for n in alike if n != name)})" if len(alike) > 1 else ""
    yield Seen(
        "another protocol",
        f"read as {name}{also}{f' with {bits} bits' if wider else ''} {numbers} ({said})",
        words={"settings": f'protocol = "{name}"' + (f", bits = {bits}" if wider else "")},
    )


def _others(e: Exchanges, said: str) -> Iterator[tuple[str, int]]:
    """Yield the protocols and widths that the stamps may be of, other than the recording's own."""
    third = bool(np.mean((e.tx3 | e.rx3) != 0) > ENOUGH)
    highest = max(int(stamps.max(initial=0)) for stamps in (e.tx1, e.rx1, e.tx2, e.rx2))
    for name, row in PROTOCOLS.items():
        for bits in WIDTHS:
            fits = highest < 1 << bits and (name != said or bits != e.bits)
            if fits and (row.third_sender is not None) == third:
                yield name, bits


def _share(e: Exchanges) -> float:
    """Return the share of exchanges whose range and clocks are possible."""
    with np.errstate(all="ignore"):
        raw = raw_range(e)
        return plausible_share(np.where(sound_clocks(e), raw, np.inf))


def sound_clocks(e: Exchanges) -> Bools:
    """Return where the third leg says that clocks run alike as crystals do, (n,); so they do where there is none."""
    names = [name for name in np.unique(e.protocol).tolist() if PROTOCOLS[name].third_sender is not None]
    return np.asarray(~np.isin(e.protocol, names) | (np.abs(target_faster_ppm(e)) < SKEW_PPM))
