"""The line that a command shows while it works."""

import io
import sys
import time

from uwblink.cli.shared import waiting


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_it_comes_after_a_while_and_goes(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with waiting("fitting [1]", after_s=0.01):
        begun = time.monotonic()
        while "fitting [1]" not in screen.getvalue():
            assert time.monotonic() - begun < 20
            time.sleep(0.01)
    assert screen.getvalue().endswith("\x1b[2K")


def test_quick_work_shows_nothing(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with waiting("fitting", after_s=60):
        pass
    assert screen.getvalue() == ""


def test_elsewhere_it_shows_nothing(capsys):
    with waiting("fitting", after_s=0.0):
        time.sleep(0.05)
    assert capsys.readouterr() == ("", "")
