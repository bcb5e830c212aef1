"""What `uwbsim serve --faults` makes go wrong between virtual boards and host."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from uwblink.text_files import read_text
from uwbsim.errors import ScenarioError
from uwbsim.scenario.base import NotNegative, Positive, Section, Share, TagId
from uwbsim.scenario.loading import parse_toml, validated


class Bytes(Section):
    """Each byte to the host is dropped, or replaced by a random one, with a probability."""

    kind: Literal["drop-bytes", "garble-bytes"] = Field(description="What happens to bytes.")
    share: Share = Field(description="Probability for each byte.")
    tag: TagId | None = Field(None, description="Which board; all where it is left out.")


class SplitWrites(Section):
    """Messages come in two pieces with a gap between, with a probability."""

    kind: Literal["split-writes"] = Field(description="Messages come in two pieces.")
    share: Share = Field(description="Probability for each message.")
    gap_ms: NotNegative = Field(2.0, description="Between the pieces.")
    tag: TagId | None = Field(None, description="Which board; all where it is left out.")


class LateReplies(Section):
    """Messages come late, with a probability."""

    kind: Literal["late-replies"] = Field(description="Messages come late.")
    share: Share = Field(description="Probability for each message.")
    delay_ms: Positive = Field(200.0, description="How late.")
    tag: TagId | None = Field(None, description="Which board; all where it is left out.")


class LoseFrames(Section):
    """Frames on the air are lost with a probability."""

    kind: Literal["lose-frames"] = Field(description="Frames on the air are lost.")
    share: Share = Field(description="Probability for each frame.")


class Hang(Section):
    """A board goes into its hard-fault loop until it is unplugged."""

    kind: Literal["hang"] = Field(description="A board hangs until it is unplugged.")
    tag: TagId = Field(description="Which board.")
    at_s: NotNegative = Field(description="When, after the start.")


class Unplug(Section):
    """A board is unplugged, and plugged in again after a while."""

    kind: Literal["unplug"] = Field(description="A board is unplugged for a while.")
    tag: TagId = Field(description="Which board.")
    at_s: NotNegative = Field(description="When, after the start.")
    for_s: Positive = Field(1.0, description="For how long.")


Fault = Annotated[Bytes | SplitWrites | LateReplies | LoseFrames | Hang | Unplug, Field(discriminator="kind")]


class Faults(Section):
    """A file of faults."""

    faults: tuple[Fault, ...] = Field((), description="What goes wrong, in any order.")

    def lost_share(self) -> float:
        """Return the share of frames that are lost on the air."""
        kept = 1.0
        for fault in self.faults:
            if isinstance(fault, LoseFrames):
                kept *= 1 - fault.share
        return 1 - kept


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
