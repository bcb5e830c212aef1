"""All sub-commands of `uwblink`."""

from __future__ import annotations

from uwblink.cli import boards, files, recording, streaming
from uwblink.cli.shared import new_app

app = new_app("Talk to ranging boards, record and stream them, and look at, import and replay recordings.")
for room in (boards, recording, streaming, files):
    room.add_to(app)
