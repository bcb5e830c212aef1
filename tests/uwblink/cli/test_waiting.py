"""The line that a command shows while it works."""

import io
import sys
import time

from uwblink.cli.shared import waiting


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_on_a_terminal_it_shows_text_and_share_and_goes(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with waiting("fitting [1]") as update:
        update("drawing")
        update(0.25)
        begun = time.monotonic()
        while not all(shown in screen.getvalue() for shown in ("fitting [1]", "drawing", "25%")):
            assert time.monotonic() - begun < 20
            time.sleep(0.01)
    assert screen.getvalue().endswith("\x1b[2K")


def test_elsewhere_it_shows_nothing(capsys):
    with waiting("fitting") as update:
        update(0.5)
    assert capsys.readouterr() == ("", "")
