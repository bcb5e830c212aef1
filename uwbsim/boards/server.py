"""Virtual boards behind pseudo-terminals, in wall time, with live motion capture and faults (`uwbsim serve`).

One loop advances the simulated time of the bench to the wall clock, passes bytes from clients to the boards, and sends
the boards' output at its time. The models of faults come first: they are the schema of a file of faults.
"""

from __future__ import annotations

import math
import os
import sched
import selectors
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from uwblink.boards.ports import open_terminals
from uwblink.output import new_file
from uwblink.recording.schema import Poses
from uwblink.text_files import read_text
from uwbsim.boards.frames import NS_PER_MS
from uwbsim.boards.virtual_board import Bench
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.base import NotNegative, Positive, Section, Share, TagId
from uwbsim.scenario.bodies import Carried
from uwbsim.scenario.loading import parse_toml, validated
from uwbsim.scenario.model import Scenario
from uwbsim.world.clocks import LONGEST_RUN_S, NS_PER_S
from uwbsim.world.world import World


class Random(Section):
    """A fault that occurs with a probability, at one board or at all."""

    share: Share = Field(description="Probability for each byte, or for each message.")
    tag: TagId | None = Field(None, description="Board; by default all.")


class Bytes(Random):
    """Each byte to the host is dropped, or replaced by a random one, with a probability."""

    kind: Literal["drop-bytes", "garble-bytes"] = Field(description="Bytes are dropped, or replaced by random ones.")


class SplitWrites(Random):
    """Messages come in two pieces with a gap between, with a probability."""

    kind: Literal["split-writes"] = Field(description="Messages arrive in two pieces.")
    gap_ms: NotNegative = Field(2.0, description="Gap between the pieces.")


class LateReplies(Random):
    """Messages come late, with a probability."""

    kind: Literal["late-replies"] = Field(description="Messages arrive late.")
    delay_ms: Positive = Field(200.0, description="Delay.")


class LoseFrames(Section):
    """Frames on the air are lost with a probability."""

    kind: Literal["lose-frames"] = Field(description="Frames on the air are lost.")
    share: Share = Field(description="Probability for each frame.")


class Hang(Section):
    """A board goes into its hard-fault loop until it is unplugged."""

    kind: Literal["hang"] = Field(description="A board hangs until it is unplugged.")
    tag: TagId = Field(description="Board.")
    at_s: NotNegative = Field(description="Time after the start.")


class Unplug(Section):
    """A board is unplugged, and plugged in again after a while."""

    kind: Literal["unplug"] = Field(description="A board is unplugged for a while.")
    tag: TagId = Field(description="Board.")
    at_s: NotNegative = Field(description="Time after the start.")
    for_s: Positive = Field(1.0, description="Duration.")


Fault = Annotated[Bytes | SplitWrites | LateReplies | LoseFrames | Hang | Unplug, Field(discriminator="kind")]


class FaultsFile(Section):
    """A file of faults."""

    faults: tuple[Fault, ...] = Field((), description="The faults, in any order.")


def load_faults(path: str | os.PathLike[str], tags: Iterable[int]) -> FaultsFile:
    """Read a file of faults of boards with these tags; raises `ScenarioError` that says where it is wrong.

    >>> from pathlib import Path
    >>> import uwbsim
    >>> _ = Path("faults.toml").write_text("faults = [{ kind = 'unplug', tag = 10, at_s = 0.5, for_s = 0.1 }]\\n")
    >>> uwbsim.load_faults("faults.toml", [10, 20]).faults[0].at_s
    0.5
    """
    tags, path = list(tags), Path(path)
    faults = validated(FaultsFile, parse_toml(read_text(path, ScenarioError, "file of faults (.toml)"), path), path)
    for number, fault in enumerate(faults.faults):
        tag = getattr(fault, "tag", None)
        if tag is not None and tag not in tags:
            raise ScenarioError(f"{path}: faults[{number}].tag: found {tag}, the tags are {', '.join(map(str, tags))}")
    return faults


def stays_s(scenario: Scenario) -> list[tuple[float, float]]:
    """Return the intervals, (begin, end) in seconds, in which no body is moved; none without `carried` bodies.

    The last one has no end.
    """
    carried = [body.motion for body in scenario.bodies if isinstance(body.motion, Carried)]
    moves = sorted(
        (turn * (motion.stay_s + motion.carry_s) + motion.stay_s, (turn + 1) * (motion.stay_s + motion.carry_s))
        for motion in carried
        for turn in range(len(motion.places_m) - 1)
    )
    found, since = [], 0.0
    for begin, end in moves:
        if begin > since:
            found.append((since, begin))
        since = max(since, end)
    return [*found, (since, math.inf)] if carried else []


class LivePoses:
    """Writes the poses of motion capture, with its rate, noise, latency and gaps, as `uwblink poses` reads them.

    Rows are flushed together: a reader sees an incomplete line only while the system copies them.
    """

    def __init__(self, world: World, path: Path, epoch_ns: int) -> None:
        """Create the file; `epoch_ns` is the host time at which the world's time is zero."""
        seed, mocap = world.scenario.run.seed, world.scenario.mocap
        self._world, self._epoch_ns, self._next = world, epoch_ns, 0
        self._noise = {name: stream(seed, "live motion capture", name) for name in world.trajectories}
        # Half as many again as gaps are expected in the longest run, each after the end of the last.
        numbers, per_min = np.arange(int(1.5 * mocap.gaps_per_min * LONGEST_RUN_S / 60)), max(mocap.gaps_per_min, 1e-9)
        draws = {name: stream(seed, "live motion capture gaps", name) for name in world.trajectories}
        waits = {name: np.cumsum(rng.exponential(60 / per_min, len(numbers))) for name, rng in draws.items()}
        self._gaps_s = {name: wait + numbers * mocap.gap_s for name, wait in waits.items()}
        self._file = new_file(path)
        self._file.write("time_ns,body,x,y,z,qx,qy,qz,qw\n")
        self._file.flush()

    def write_until(self, time_ns: int) -> None:
        """Append the poses that motion capture has delivered until a time of the world."""
        mocap = self._world.scenario.mocap
        end = math.floor((time_ns - round(mocap.latency_ms * 1e6)) * mocap.rate_hz / NS_PER_S) + 1
        if end <= self._next:
            return
        taken_ns = np.rint(np.arange(self._next, end) * (NS_PER_S / mocap.rate_hz)).astype(np.int64)
        self._next = end
        parts = [self._world.seen(name, taken_ns, rng, self._gaps_s[name]) for name, rng in self._noise.items()]
        poses = Poses.concatenate(parts).in_time_order()
        for at, body, *pose in zip(poses.time_ns, poses.body, *poses.position_m.T, *poses.quaternion.T, strict=True):
            self._file.write(f"{at + self._epoch_ns},{body}," + ",".join(f"{v:.6f}" for v in pose) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Server:
    """Serves the boards of a scenario. `names` maps tags to what clients open.

    >>> import threading
    >>> import uwblink, uwbsim
    >>> near, far = ({"model": "static", "position_m": [x, 0.0, 1.0]} for x in (0.0, 3.0))
    >>> server = uwbsim.Server(
    ...     uwbsim.load(
    ...         {
    ...             "run": {"duration_s": 10.0},
    ...             "ranging": {"rate_hz": 50.0},
    ...             "bodies": [{"name": "near", "motion": near}, {"name": "far", "motion": far}],
    ...             "tags": [{"id": 10, "body": "near"}, {"id": 20, "body": "far"}],
    ...         }
    ...     )
    ... )
    >>> stop = threading.Event()
    >>> serving = threading.Thread(target=server.run, args=(stop.is_set,))
    >>> serving.start()
    >>> with uwblink.Board.open(server.names[10]) as board:
    ...     board.id
    10
    >>> stop.set()
    >>> serving.join()
    >>> server.close()
    """

    def __init__(
        self,
        scenario: Scenario,
        link_dir: Path | None = None,
        faults: FaultsFile | None = None,
        *,
        speed: float = 1.0,
        tell: Callable[[str], object] = lambda text: None,
    ) -> None:
        """Open one pseudo-terminal a tag; raises `PortError` where a link cannot be made.

        `speed` is the rate of the boards' time relative to the wall clock. `tell` is called with a line about each
        failure that does not end the server: a command of a board failed, or poses cannot be written any more.
        """
        self._speed, self._tell = speed, tell
        self._faults = faults or FaultsFile()
        kept = math.prod(1 - fault.share for fault in self._faults.faults if isinstance(fault, LoseFrames))
        self.bench = Bench(scenario, self._printed, 1 - kept)
        self.bench.crashed = lambda board, error: self._tell(
            f"board {board.id} hangs: its program failed with {type(error).__name__}: {error}"
        )
        self._poses: LivePoses | None = None
        self._rng = stream(scenario.run.seed, "serial faults")
        self._selector = selectors.SelectSelector()
        self._start_ns = time.monotonic_ns()
        self.epoch_ns = time.time_ns()
        """Host time (Unix epoch) at which the scenario's time is zero."""
        self._reached_ns = 0
        self._timed = sched.scheduler(lambda: self._reached_ns)
        for fault in self._faults.faults:
            self._arrange(fault)
        self._terminals = open_terminals(
            {tag.id: link_dir / f"tag{tag.id}" if link_dir else None for tag in scenario.tags}
        )
        for number in self._terminals:
            self._watch(number)
        self.names = {tag: terminal.name for tag, terminal in self._terminals.items()}

    @staticmethod
    def extended(scenario: Scenario, duration_s: float | None) -> Scenario:
        """Return a scenario that lasts as long as it is served, two hours if no duration is given.

        After that, bodies do not move.
        """
        longer = min(max(scenario.run.duration_s, duration_s or 7200.0), LONGEST_RUN_S)
        return scenario.changed("run", duration_s=longer)

    def run(self, stop: Callable[[], bool], duration_s: float = float("inf")) -> None:
        """Serve until `stop` returns True or the duration is over."""
        end_ns = duration_s * NS_PER_S
        while not stop() and self._now_ns() < end_ns:
            self.step()

    def step(self) -> None:
        """Wait for bytes from clients or for the next event, and process them."""
        due = min(self.bench.next_ns(), *(event.time for event in self._timed.queue[:1]), math.inf)
        wait_s = min(max((due - self._now_ns()) / NS_PER_S / self._speed, 0.0), 0.1)
        for key, _ in self._selector.select(wait_s):
            tag: int = key.data
            data = self._terminals[tag].read()
            if data:
                self.bench.advance(self._now_ns())
                self.bench.boards[tag].write(data)
        self._reached_ns = self._now_ns()
        self.bench.advance(self._reached_ns)
        # The scheduler's time stands still meanwhile: an action that schedules the next one ends, however late it is.
        self._timed.run(blocking=False)

    def announce(self, tell: Callable[[str], object]) -> None:
        """Call `tell` with a line at each time from which `carried` boards stand still, and until when."""
        stays = stays_s(self.bench.scenario)
        for number, (begin_s, end_s) in enumerate(stays, start=1):
            until = "stay there" if math.isinf(end_s) else f"stand until {end_s:g} s"
            text = f"{begin_s:5g} s  place {number} of {len(stays)}: boards {until}"
            self._at(int(begin_s * NS_PER_S), partial(tell, text))

    def write_poses(self, path: Path) -> None:
        """Write motion capture to a file from now on, in host time, as `uwblink poses` reads it."""
        self._poses = LivePoses(self.bench.air.world, path, self.epoch_ns)
        self._append_poses(self._poses)

    def _append_poses(self, poses: LivePoses) -> None:
        now = self._now_ns()
        try:
            poses.write_until(now)
        except OSError as error:
            self._tell(f"the poses end here: {error.strerror or error}")
        else:
            self._at(now + 100 * NS_PER_MS, partial(self._append_poses, poses))

    def close(self) -> None:
        """Unplug all boards, and close the file of poses."""
        if self._poses is not None:
            with suppress(OSError):
                self._poses.close()
        for terminal in self._terminals.values():
            terminal.unplug()
        self._selector.close()

    def unplug(self, tag: int) -> None:
        """Unplug a board, from any thread: `step` does it, so that no terminal is closed while it is waited on."""
        self._at(self._now_ns(), partial(self._unplug, tag))

    def plug(self, tag: int) -> None:
        """Plug a board in again, from any thread; it boots."""
        self._at(self._now_ns(), partial(self._plug, tag))

    def _unplug(self, tag: int) -> None:
        terminal = self._terminals[tag]
        if terminal.fileno is not None:
            self._selector.unregister(terminal.fileno)
        terminal.unplug()
        self.bench.boards[tag].power_off()

    def _plug(self, tag: int) -> None:
        if self._terminals[tag].fileno is None:
            self._terminals[tag].plug()
            self._watch(tag)
            self.bench.boards[tag].power_cycle()

    def _watch(self, tag: int) -> None:
        number = self._terminals[tag].fileno
        if number is not None:
            self._selector.register(number, selectors.EVENT_READ, tag)

    def _now_ns(self) -> int:
        return round((time.monotonic_ns() - self._start_ns) * self._speed)

    def _at(self, time_ns: int, action: Callable[[], object]) -> None:
        self._timed.enterabs(time_ns, 0, action)

    def _arrange(self, fault: Fault) -> None:
        if isinstance(fault, Hang):
            self._at(int(fault.at_s * NS_PER_S), self.bench.boards[fault.tag].hang)
        if isinstance(fault, Unplug):
            self._at(int(fault.at_s * NS_PER_S), partial(self._unplug, fault.tag))
            self._at(int((fault.at_s + fault.for_s) * NS_PER_S), partial(self._plug, fault.tag))

    def _printed(self, time_ns: int, tag: int, data: bytes) -> None:
        """Send the output of a board in one write, unless a fault changes it."""
        terminal = self._terminals[tag]
        for fault in self._faults.faults:
            if getattr(fault, "tag", tag) not in (tag, None):
                continue
            if isinstance(fault, Bytes):
                data = self._damaged(fault, data)
            elif isinstance(fault, LateReplies) and self._rng.random() < fault.share:
                self._at(time_ns + int(fault.delay_ms * NS_PER_MS), partial(terminal.write, data))
                return
            elif isinstance(fault, SplitWrites) and len(data) > 1 and self._rng.random() < fault.share:
                cut = int(self._rng.integers(1, len(data)))
                self._at(time_ns + int(fault.gap_ms * NS_PER_MS), partial(terminal.write, data[cut:]))
                data = data[:cut]
        terminal.write(data)

    def _damaged(self, fault: Bytes, data: bytes) -> bytes:
        values = np.frombuffer(data, dtype=np.uint8)
        hit = self._rng.random(len(values)) < fault.share
        if fault.kind == "drop-bytes":
            return values[~hit].tobytes()
        return np.where(hit, self._rng.integers(0, 256, len(values)), values).astype(np.uint8).tobytes()
