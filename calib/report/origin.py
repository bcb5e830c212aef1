"""Where a report comes from: when it was made, by which command, from which files."""

from __future__ import annotations

import datetime
import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from calib.data.sources import Data

BLOCK: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Origin:
    """When (ISO 8601, UTC), how, with which version, and the SHA-256 of each file that was read, by its name."""

    made: str = ""
    command: str = ""
    version: str = ""
    files: dict[str, str] = field(default_factory=dict)

    def sentence(self) -> str:
        """Return it in a line, for the head of a report."""
        parts = [f"Made {self.made}" if self.made else "", f"by uwbcal {self.version}" if self.version else ""]
        how = f": {self.command}" if self.command else ""
        return " ".join(filter(None, parts)) + how


def origin_of(data: Iterable[Data], command: str = "") -> Origin:
    """Return the origin of a report on some recordings; those in memory have no files.

    The date is now, or what `SOURCE_DATE_EPOCH` says (seconds since 1970), for files that are the same each time.
    """
    from uwblink import __version__

    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = (
        datetime.datetime.fromtimestamp(int(epoch), datetime.UTC)
        if epoch.isdecimal()
        else datetime.datetime.now(datetime.UTC)
    )
    files = {str(path): _sha256(path) for one in data if isinstance(one, str | os.PathLike) for path in [Path(one)]}
    return Origin(now.strftime("%Y-%m-%d %H:%M UTC"), command, __version__, files)


def _sha256(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            found.update(block)
    return found.hexdigest()
