"""A simulated flight in memory: its truth, how it is written, and its exchanges as the bytes of boards."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats
from uwblink.protocols.table import ON_BOARDS
from uwblink.recording.file import Recording
from uwblink.recording.schema import CirRow, Fault, FrameRow, Poses, Tag
from uwblink.ticks import TICK_S, elapsed
from uwblink.twr import Exchanges, raw_range
from uwblink.wire.bulk import ColumnDecoder
from uwblink.wire.codec import encode
from uwblink.wire.messages import RangeReport
from uwbsim.errors import ScenarioError
from uwbsim.world.clocks import NS_PER_S


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Simulated:
    """A simulated flight in memory: what a recording of it holds, and the truth, which none does.

    `exchanges` are n exchanges in order of time and `truth_m` (n,) their true distances in metres, each the mean over
    the first two messages; `poses` are those of motion capture; `tags` say which body carries which tag, and where;
    `faults` are the exchanges that failed. `overheard` are the columns of what passive tags heard, `cirs` impulse
    responses (time_ns, board, initiator, target, first path in taps, 1016 magnitudes). `meta` is the recording's
    provenance. `temperature` are the columns of what tags with a temperature or a supply voltage read of them, `imu`
    and `height` those of bodies' inertial and height sensors.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"name": "two", "duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> print(flight)
    Simulated 'two': 100 exchanges (ds) of 2 tags on 2 bodies in 2 s
      raw range less truth: median +0.3 cm, standard deviation 2.8 cm
      failed: none
      poses: 414; overheard: 0; impulse responses: 0
    >>> flight.save("two.uwb")
    """

    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    overheard: dict[str, NDArray[Any]]
    cirs: list[CirRow]
    truth_m: Floats
    meta: dict[str, Any]
    temperature: dict[str, NDArray[Any]] = field(default_factory=dict)
    imu: dict[str, NDArray[Any]] = field(default_factory=dict)
    height: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def planted(self) -> dict[str, Any]:
        """Return what a calibration should find: `delays_ns` by tag, `bias_curve`, `sigma_curve`, `alpha_dbm`."""
        planted: dict[str, Any] = self.meta["planted"]
        return planted

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        frames: Sequence[FrameRow] = (),
        force: bool = False,
    ) -> None:
        """Write a recording (.uwb), with the bytes of boards where there are any (`through_wire`).

        Raises `RecordingExistsError` where the file is there already, unless `force` says to replace it.
        """
        write(self, path, frames=frames, force=force)

    def __repr__(self) -> str:
        """Return a few lines: what was simulated, how the raw ranges err, and what failed."""
        return _described(self)


def write(
    simulated: Simulated,
    path: str | os.PathLike[str],
    *,
    frames: Sequence[FrameRow] = (),
    force: bool = False,
) -> None:
    """Write the recording, with the bytes of boards where there are any; raises what `Recording.create` raises."""
    with Recording.create(path, meta=simulated.meta, force=force) as recording:
        recording.append_tags(simulated.tags)
        recording.append_poses(simulated.poses)
        recording.append_exchanges(simulated.exchanges)
        recording.append_faults(simulated.faults)
        for table in ("overheard", "temperature", "imu", "height"):
            recording.append_columns(table, getattr(simulated, table))
        recording.append_cirs(simulated.cirs)
        recording.append_frames(frames)


def _described(flight: Simulated) -> str:
    run, ranging = (flight.meta["scenario"][name] for name in ("run", "ranging"))
    error = raw_range(flight.exchanges) - flight.truth_m
    reasons = Counter(fault.kind for fault in flight.faults)
    failed = ", ".join(f"{count} {reason}" for reason, count in sorted(reasons.items())) or "none"
    lines = [
        f"Simulated {run['name']!r}: {len(flight.exchanges)} exchanges ({ranging['protocol']}) of "
        f"{len(flight.tags)} tags on {len({tag.body for tag in flight.tags})} bodies in {run['duration_s']:g} s",
        f"  failed: {failed}",
        f"  poses: {len(flight.poses)}; overheard: {len(flight.overheard.get('time_ns', ()))}; "
        f"impulse responses: {len(flight.cirs)}",
    ]
    if len(error):
        median, spread = (100 * float(v) for v in (np.median(error), np.std(error)))
        lines.insert(1, f"  raw range less truth: median {median:+.1f} cm, standard deviation {spread:.1f} cm")
    return "\n".join(lines)


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
    exchanges = Exchanges.concatenate(parts).in_time_order()
    ports = {name.removeprefix("board "): name for name in decoders}
    return replace(simulated, exchanges=exchanges, meta=simulated.meta | {"ports": ports}), frames
