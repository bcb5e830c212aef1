"""What `uwblink show` says of a recording."""

import io

import pytest
from rich.console import Console

from tests.uwblink.recording.test_file import random_exchanges
from uwblink.cli.commands import print_summary
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Tag
from uwblink.recording.summary import failures_by_pair


@pytest.fixture
def summary(tmp_path):
    with Recording.create(tmp_path / "f.uwb", meta={"note": "[bold]x[/] \x1b[31m", "scenario": "long"}) as r:
        r.append_exchanges(random_exchanges(50))
        r.append_tags([Tag(3, "b", (0.1, 0.2, 0.3))])
        r.append("faults", [Fault(9, "1", "time-out", "no answer"), Fault(10, "1", "time-out", "")])
    with Recording.open(tmp_path / "f.uwb") as r:
        return r.show()


def test_counts_add_up(summary):
    assert summary.counts["exchanges"] == 50 == sum(p.exchanges for p in summary.pairs)
    assert sum(summary.protocols.values()) == 50
    assert summary.faults == {"time-out": 2}
    assert summary.to_dict()["tags"] == [{"tag": 3, "body": "b", "lever_arm_m": [0.1, 0.2, 0.3]}]


def test_printed_text_from_a_file_cannot_format_or_steer_the_terminal(summary):
    out = io.StringIO()
    print_summary(summary, Console(file=out, width=100, force_terminal=True, color_system=None))
    assert "[bold]x[/]" in out.getvalue()
    assert "\x1b[31m" not in out.getvalue()


def test_a_summary_fits_on_a_screen_and_cannot_steer_it(tmp_path):
    with Recording.create(tmp_path / "\x1b[2J.uwb") as r:
        r.append_exchanges(random_exchanges(500))
        r.append_tags([Tag(k, "\x1b[31m" + "b" * 200, (0.0, 0.0, 0.0)) for k in range(40)])
        r.append("faults", [Fault(k, "1", f"kind {k}" * 10, "", 1, 2) for k in range(40)])
    with Recording.open(tmp_path / "\x1b[2J.uwb") as r:
        summary = r.show()
    lines = str(summary).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 79
    assert "500 exchanges in" in lines[0]
    assert "\x1b" not in str(summary) + summary._repr_html_()
    assert repr(summary) == str(summary)
    assert "<td>" in summary._repr_html_()


def test_failures_are_counted_by_the_ends_of_the_exchange_whatever_the_text_says():
    faults = [
        Fault(1, "7", "time-out", "anything at all", 7, 8),
        Fault(2, "7", "failed exchange", "nothing of the kind", 7, 8),
        Fault(3, "8", "failed exchange", "", 8, 7),
        Fault(4, "9", "garbage", "9 ranged with 8: message 1 lost; ranging with 8 failed"),
    ]
    assert failures_by_pair(faults) == {(7, 8): 2, (8, 7): 1}
