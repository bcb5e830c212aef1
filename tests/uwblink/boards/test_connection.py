"""The driver's side of a conversation, without ports: outcomes, late replies, fences, damage."""

import pytest

from uwblink.boards.connection import FENCE, Connection
from uwblink.errors import NoAnswerError, RefusedError
from uwblink.wire import messages as m
from uwblink.wire.codec import encode

REPORT = (
    b"R05|2|3.0550|2334148660|1211574983|1233803316|2356378373|1332123700|2454699099"
    b"|-87.4977|-87.5239|-3.4971|3.5222\r\n"
)
OTHER = REPORT.replace(b"R05|2|", b"R05|3|")


def asked(command=None):
    connection = Connection("port")
    assert connection.send(command or m.RangeCommand(2), 0.0) == encode(command or m.RangeCommand(2))
    return connection


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_a_reply_in_any_pieces_ends_the_command(size):
    connection, outcome = asked(), None
    for k in range(0, len(REPORT), size):
        assert outcome is None
        _, outcome = connection.receive(REPORT[k : k + size], 0.003)
    assert outcome.reply.neighbour == 2
    assert not connection.busy


def test_only_one_command_is_outstanding():
    with pytest.raises(RefusedError, match="still waiting"):
        asked().send(m.GetId(), 0.001)


def test_lines_of_bystanders_and_other_reports_do_not_end_it():
    connection = asked()
    noise = b"WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.\r\nR01|7\r\nS06|\x02\x00hi\r\n"
    events, outcome = connection.receive(noise, 0.001)
    assert len(events) == 3
    assert outcome is None
    assert connection.receive(REPORT, 0.003)[1].reply is not None


def test_a_line_of_failure_does_not_end_a_command_that_cannot_fail():
    connection = asked(m.GetId())
    assert connection.receive(b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n", 0.001)[1] is None
    assert connection.receive(b"R01|4\r\n", 0.002)[1].reply == m.IdReport(4)


def test_time_runs_out_once_and_leaves_a_doubt_that_a_fence_settles():
    connection = asked()
    connection.receive(b"junk", 0.01)
    assert connection.receive(b"", 0.1499)[1] is None
    outcome = connection.receive(b"", 0.15)[1]
    assert isinstance(outcome.error, NoAnswerError)
    assert "b'C05|2|0|1|0\\r'" in str(outcome.error)
    assert "'junk'" in str(outcome.error)
    assert connection.doubtful
    connection.send(FENCE, 0.2)
    # The late reply comes before the fence's and is nobody's.
    events, outcome = connection.receive(b"\r\n" + REPORT + b"R00\r\n", 0.21)
    assert outcome.reply == m.IdleSet()
    assert any(isinstance(e, m.RangeReport) for e in events)
    assert not connection.doubtful
