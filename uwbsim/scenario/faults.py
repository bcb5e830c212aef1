"""What `uwbsim serve --faults` makes go wrong between virtual boards and host."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from uwblink.text_files import read_text
from uwbsim.errors import ScenarioError
from uwbsim.scenario.base import NotNegative, Positive, Section, Share, TagId


class Bytes(Section):
    """Each byte to the host is dropped, or replaced by a random one, with a probability."""

    kind: Literal["drop-bytes", "garble-bytes"]
    share: Share
    tag: TagId | None = None


class SplitWrites(Section):
    """Messages come in two pieces with a gap between, with a probability."""

    kind: Literal["split-writes"]
    share: Share
    gap_ms: NotNegative = 2.0
    tag: TagId | None = None


class LateReplies(Section):
    """Messages come late, with a probability."""

    kind: Literal["late-replies"]
    share: Share
    delay_ms: Positive = 200.0
    tag: TagId | None = None


class LoseFrames(Section):
    """Frames on the air are lost with a probability."""

    kind: Literal["lose-frames"]
    share: Share


class Hang(Section):
    """A board goes into its hard-fault loop until it is unplugged."""

    kind: Literal["hang"]
    tag: TagId
    at_s: NotNegative


class Unplug(Section):
    """A board is unplugged, and plugged in again after a while."""

    kind: Literal["unplug"]
    tag: TagId
    at_s: NotNegative
    for_s: Positive = 1.0


Fault = Annotated[Bytes | SplitWrites | LateReplies | LoseFrames | Hang | Unplug, Field(discriminator="kind")]


class Faults(Section):
    """A file of faults."""

    faults: tuple[Fault, ...] = ()

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
    tags = list(tags)
    try:
        table = tomllib.loads(read_text(path, ScenarioError, "file of faults (.toml)"))
        faults = Faults.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ScenarioError(f"{path}: {where}: {first['msg'][0].lower()}{first['msg'][1:]}") from error
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path}: cannot be read as a file of faults (.toml): {error}") from error
    for number, fault in enumerate(faults.faults):
        tag = getattr(fault, "tag", None)
        if tag is not None and tag not in tags:
            raise ScenarioError(f"{path}: faults[{number}].tag: found {tag}, the tags are {', '.join(map(str, tags))}")
    return faults
