"""A board that does not react for a while is asked once more; one that does not answer at all is reported as dead."""

import pytest

from uwblink.boards.board import FENCE, Board, Connection
from uwblink.errors import NoAnswerError, RangingFailedError, RefusedError
from uwblink.wire import messages as m
from uwblink.wire.codec import encode


class Deaf:
    """A board that reads its input only from `wakes_s` on; time advances while it is read."""

    name = "port"

    def __init__(self, wakes_s, answers):
        self.time_s, self.wakes_s, self.answers, self.heard = 0.0, wakes_s, answers, []

    def write(self, data):
        self.heard.append(data)

    def read(self, timeout_s):
        if self.heard and self.time_s + timeout_s >= self.wakes_s:
            self.time_s = max(self.time_s, self.wakes_s)
            # The firmware executes only the last of the waiting commands.
            last, self.heard = self.heard[-1], []
            return self.answers[last]
        self.time_s += timeout_s
        return b""

    def now_s(self):
        return self.time_s

    def close(self):
        pass


ANSWERS = {b"C00\r": b"R00\r\n", b"C01\r": b"R01|7\r\n", b"C06|\x01\x00x\r": b"R06\r\n"}


def test_a_board_without_reaction_for_300_ms_is_asked_once_more():
    assert Board(Deaf(0.3, ANSWERS)).id == 7


def test_a_broadcast_is_not_sent_twice():
    deaf = Deaf(0.3, ANSWERS)
    with pytest.raises(NoAnswerError, match="no answer to b'C06") as caught:
        Board(deaf).send(b"x")
    assert "must be unplugged" not in str(caught.value), "it came back"


def test_boards_without_an_answer_for_a_second_are_reported_as_dead():
    deaf = Deaf(1e9, ANSWERS)
    said = r"b'C01.* within 150 ms; heard nothing; then no answer.*1000 ms.*must be unplugged\Z"
    with pytest.raises(NoAnswerError, match=said):
        _ = Board(deaf).id
    assert deaf.time_s == pytest.approx(1.15)


def test_the_second_request_may_fail():
    class Once(Deaf):
        def read(self, timeout_s):
            data = super().read(timeout_s)
            return data if data == b"R00\r\n" else b""

    with pytest.raises(NoAnswerError, match="b'C01"):
        Board(Once(0.0, ANSWERS)).request(m.GetId())


# The driver's side of a conversation, without ports: outcomes, late replies, fences, times, allowed commands.


REPORT = (
    b"R05|2|3.0550|2334148660|1211574983|1233803316|2356378373|1332123700|2454699099"
    b"|-87.4977|-87.5239|-3.4971|3.5222\r\n"
)


def asked(command=None):
    connection = Connection("port")
    assert connection.send(command or m.RangeCommand(2), 0.0) == encode(command or m.RangeCommand(2))
    return connection


def test_only_one_command_is_outstanding():
    with pytest.raises(RefusedError, match="still waiting"):
        asked().send(m.GetId(), 0.001)


def test_a_line_of_failure_does_not_end_a_command_that_cannot_fail():
    connection = asked(m.GetId())
    assert connection.receive(b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n", 0.001)[1] is None
    # The first of two replies is the outcome.
    assert connection.receive(b"R01|4\r\nR01|5\r\n", 0.002)[1].reply == m.IdReport(4)


CIR = encode(m.Cir(1, 2, 747_015, tuple(range(1016))))


def test_long_time_outs_of_a_connection_are_kept():
    connection = Connection("port", answer_s=2.0)
    for sent_s, heard, heard_s in ((0.0, b"", 2.0), (3.0, b"R00\r\n", 3.1)):
        connection.send(FENCE, sent_s)
        assert connection.deadline_s() == sent_s + 2.0
        connection.receive(heard, heard_s)
    assert not connection.doubtful


def test_the_last_60_bytes_are_quoted():
    connection = asked()
    connection.receive(b"\xff" + b"a" * 40, 0.01)
    connection.receive(b"b" * 21, 0.02)
    error = connection.receive(b"", 1.0)[1].error
    assert (type(error), str(error).partition("heard ")[2]) == (NoAnswerError, f"'{'a' * 39}{'b' * 21}'")


def test_only_requested_impulse_responses_block_the_board():
    connection = asked(m.RangeCommand(2))
    connection.receive(REPORT, 1.0)
    assert connection.ready_s(1.0) == 0.0
    with_cir = asked(m.RangeCommand(2, get_cir=True))
    with_cir.receive(REPORT, 1.0)
    assert (with_cir.ready_s(1.0), with_cir.ready_s(1.02)) == (pytest.approx(0.030), pytest.approx(0.010))
    # After it, the report of a target may follow within 3 ms.
    with_cir.receive(CIR, 1.028)
    assert (with_cir.ready_s(1.03), with_cir.ready_s(1.04)) == (pytest.approx(0.003), 0.0)


@pytest.mark.parametrize(
    ("command", "what"),
    [(m.RangeCommand(2), "ranging with 2"), (m.Broadcast(b"x"), "the broadcast")],
)
def test_failures_are_named_and_lines_quoted_once(command, what):
    connection = asked(command)
    warned = b"WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.\r\n"
    assert connection.receive(warned + warned, 0.01)[1] is None
    outcome = connection.receive(b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n", 0.02)[1]
    assert isinstance(outcome.error, RangingFailedError)
    assert str(outcome.error).startswith(f"port: {what} failed; the board says: WARNING")
    assert (str(outcome.error).count("WARNING"), (outcome.reply, connection.busy)) == (1, (None, False))
    assert not connection.doubtful


def test_reports_answer_only_requests_of_their_target_and_protocol():
    single = REPORT.replace(b"|1332123700|2454699099|", b"|0|0|")
    for double_sided, not_asked, answer in (
        (False, single.replace(b"R05|2|", b"R05|3|"), single),
        (True, single, REPORT),
    ):
        connection = asked(m.RangeCommand(2, double_sided=double_sided))
        assert connection.receive(not_asked, 0.01)[1] is None
        assert (connection.receive(answer, 0.02)[1].reply.tx3 != 0) == double_sided
    assert asked(m.GetId()).receive(REPORT, 0.01)[1] is None
