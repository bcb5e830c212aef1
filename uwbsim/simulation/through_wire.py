"""A simulated flight as bytes: every exchange encoded as its initiator's report, and decoded again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uwblink.protocols.table import ON_BOARDS
from uwblink.recording.schema import FrameRow
from uwblink.ticks import TICK_S, elapsed
from uwblink.twr import COLUMNS
from uwblink.wire.bulk import ColumnDecoder
from uwblink.wire.codec import encode
from uwblink.wire.messages import RangeReport
from uwbsim.errors import ScenarioError
from uwbsim.simulation.simulated import Simulated
from uwbsim.units import NS_PER_S


def frames_of(simulated: Simulated) -> list[FrameRow]:
    """Return the bytes that the boards would have sent, as a recorder stores them.

    Raises `ScenarioError` for a protocol that the boards do not know.
    """
    e = simulated.exchanges
    strange = sorted(set(np.unique(e.protocol).tolist()) - set(ON_BOARDS))
    if strange:
        raise ScenarioError(
            f"ranging.protocol: found {strange[0]!r}, but the boards report only {', '.join(ON_BOARDS)}"
        )
    last = np.where(e.rx3 != 0, e.rx3, e.rx2)
    time_ns = e.time_ns + np.rint(elapsed(last, e.tx1) * (TICK_S * NS_PER_S)).astype(np.int64)
    names = [name for name in RangeReport.FIELDS if name != "neighbour"]
    columns = [e.target.tolist(), *(getattr(e, name).tolist() for name in names)]
    reports = (encode(RangeReport(*row)) for row in zip(*columns, strict=True))
    return [
        FrameRow(t, f"board {i}", "in", data)
        for t, i, data in zip(time_ns.tolist(), e.initiator.tolist(), reports, strict=True)
    ]


def through_wire(simulated: Simulated) -> tuple[Simulated, list[FrameRow]]:
    """Return a flight whose exchanges were decoded from the boards' bytes, and those bytes.

    Raises `ScenarioError` for a protocol that the boards do not know.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> decoded, frames = uwbsim.through_wire(flight)
    >>> len(frames), bool((decoded.exchanges.rx2 == flight.exchanges.rx2).all())
    (100, True)
    >>> decoded.save("wire.uwb", frames=frames)
    """
    frames = frames_of(simulated)
    decoders = {f"board {i}": ColumnDecoder(int(i)) for i in np.unique(simulated.exchanges.initiator)}
    for frame in frames:
        decoders[frame.board].feed(frame.data, frame.time_ns)
    parts = [d.exchanges() for d in decoders.values()] or [simulated.exchanges]  # nothing was received
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
    order = np.argsort(columns["time_ns"], kind="stable")
    exchanges = replace(parts[0], **{name: column[order] for name, column in columns.items()})
    ports = {name.removeprefix("board "): name for name in decoders}
    return replace(simulated, exchanges=exchanges, meta=simulated.meta | {"ports": ports}), frames
