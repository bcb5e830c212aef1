"""The line that a command shows while it works."""

import io
import sys
import time

from uwblink.cli import waiting as room


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_it_comes_after_a_while_and_goes(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(room, "PATIENCE_S", 0.01)
    with room.waiting("fitting [1]"):
        begun = time.monotonic()
        while "fitting [1]" not in screen.getvalue():
            assert time.monotonic() - begun < 20
            time.sleep(0.01)
    assert screen.getvalue().endswith("\x1b[2K")


def test_quick_work_shows_nothing(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(room, "PATIENCE_S", 60)
    with room.waiting("fitting"):
        pass
    assert screen.getvalue() == ""


def test_elsewhere_it_shows_nothing(capsys, monkeypatch):
    monkeypatch.setattr(room, "PATIENCE_S", 0.0)
    with room.waiting("fitting"):
        time.sleep(0.05)
    assert capsys.readouterr() == ("", "")
