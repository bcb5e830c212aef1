"""A board that is deaf for a while is asked once more; one that is dead is called so."""

import pytest

from uwblink.boards.board import Board
from uwblink.errors import NoAnswerError
from uwblink.wire import messages as m


class Deaf:
    """A board that takes in what is written to it only from `wakes_s` on; time passes while it is read."""

    name = "port"

    def __init__(self, wakes_s, answers):
        self.time_s, self.wakes_s, self.answers, self.heard = 0.0, wakes_s, answers, []

    def write(self, data):
        self.heard.append(data)

    def read(self, timeout_s):
        if self.heard and self.time_s + timeout_s >= self.wakes_s:
            self.time_s = max(self.time_s, self.wakes_s)
            # The firmware carries out only the last of the commands that wait.
            last, self.heard = self.heard[-1], []
            return self.answers[last]
        self.time_s += timeout_s
        return b""

    def now_s(self):
        return self.time_s

    def close(self):
        pass


ANSWERS = {b"C00\r": b"R00\r\n", b"C01\r": b"R01|7\r\n", b"C06|\x01\x00x\r": b"R06\r\n"}


def test_a_board_that_is_deaf_for_300_ms_is_asked_once_more():
    board = Board(Deaf(0.3, ANSWERS))
    assert board.id == 7


def test_a_broadcast_is_not_sent_twice():
    deaf = Deaf(0.3, ANSWERS)
    with pytest.raises(NoAnswerError, match="no answer to b'C06"):
        Board(deaf).send(b"x")
    assert "must be unplugged" not in str(deaf.heard)


def test_only_a_board_that_answers_nothing_for_a_second_is_called_dead():
    deaf = Deaf(1e9, ANSWERS)
    with pytest.raises(NoAnswerError, match=r"b'C01.* within 150 ms; heard nothing; then no answer.*1000 ms") as caught:
        _ = Board(deaf).id
    assert str(caught.value).endswith("must be unplugged")
    assert deaf.time_s == pytest.approx(1.15)


def test_one_that_comes_back_is_not_called_dead():
    with pytest.raises(NoAnswerError) as caught:
        Board(Deaf(0.3, ANSWERS)).send(b"x")
    assert "must be unplugged" not in str(caught.value)


def test_the_answer_to_the_second_asking_may_fail_too():
    class Once(Deaf):
        def read(self, timeout_s):
            data = super().read(timeout_s)
            return data if data == b"R00\r\n" else b""

    board = Board(Once(0.0, ANSWERS))
    with pytest.raises(NoAnswerError, match="b'C01"):
        board.request(m.GetId())
