"""Faults between virtual boards and host, for `uwbsim serve --faults`."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from uwblink.text_files import read_text
from uwbsim.errors import ScenarioError
from uwbsim.scenario.base import NotNegative, Positive, Section, Share, TagId
from uwbsim.scenario.loading import parse_toml, validated


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


class Faults(Section):
    """A file of faults."""

    faults: tuple[Fault, ...] = Field((), description="The faults, in any order.")

    def lost_share(self) -> float:
        """Return the share of frames that are lost on the air."""
        return 1 - math.prod(1 - fault.share for fault in self.faults if isinstance(fault, LoseFrames))


def load_faults(path: str | os.PathLike[str], tags: Iterable[int]) -> Faults:
    """Read a file of faults of boards with these tags; raises `ScenarioError` that says where it is wrong.

    >>> from pathlib import Path
    >>> import uwbsim
    >>> _ = Path("faults.toml").write_text("faults = [{ kind = 'unplug', tag = 10, at_s = 0.5, for_s = 0.1 }]\\n")
    >>> uwbsim.load_faults("faults.toml", [10, 20]).faults[0].at_s
    0.5
    """
    tags, path = list(tags), Path(path)
    faults = validated(Faults, parse_toml(read_text(path, ScenarioError, "file of faults (.toml)"), path), path)
    for number, fault in enumerate(faults.faults):
        tag = getattr(fault, "tag", None)
        if tag is not None and tag not in tags:
            raise ScenarioError(f"{path}: faults[{number}].tag: found {tag}, the tags are {', '.join(map(str, tags))}")
    return faults
