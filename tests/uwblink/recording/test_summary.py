"""What `uwblink show` says of a recording."""

import io

import pytest
from rich.console import Console

from tests.uwblink.recording.test_file import random_exchanges
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Tag
from uwblink.recording.summary import print_summary, summarize


@pytest.fixture
def summary(tmp_path):
    with Recording.create(tmp_path / "f.uwb", meta={"note": "[bold]x[/] \x1b[31m", "scenario": "long"}) as r:
        r.append_exchanges(random_exchanges(50))
        r.append_tags([Tag(3, "b", (0.1, 0.2, 0.3))])
        r.append_faults([Fault(9, "1", "time-out", "no answer"), Fault(10, "1", "time-out", "")])
    with Recording.open(tmp_path / "f.uwb") as r:
        return summarize(r)


def test_counts_add_up(summary):
    assert summary["counts"]["exchanges"] == 50 == sum(p["exchanges"] for p in summary["pairs"])
    assert sum(summary["protocols"].values()) == 50
    assert summary["faults"] == {"time-out": 2}
    assert summary["tags"] == [{"tag": 3, "body": "b", "lever_arm_m": [0.1, 0.2, 0.3]}]


def test_printed_text_from_a_file_cannot_format_or_steer_the_terminal(summary):
    out = io.StringIO()
    print_summary(summary, Console(file=out, width=100, force_terminal=True, color_system=None))
    assert "[bold]x[/]" in out.getvalue()
    assert "\x1b[31m" not in out.getvalue()
