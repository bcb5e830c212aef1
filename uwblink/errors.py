"""The errors of `uwblink`; each is also derived from a matching standard exception."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from traceback import walk_stack


class OfParameter(Exception):  # noqa: N818 - the base of the bases
    """Base of the errors of all three packages; `parameter` is the name of the parameter at fault, if there is one.

    Names of parameters are in backticks, and the one at fault comes first. The command line replaces them by options
    (`uwblink.cli.shared.with_flags`).
    """

    def __init__(self, text: str, *, parameter: str | None = None) -> None:
        """`text` is a line: what is wrong, where, and what to do; the parameter's name is added before it."""
        # Texts quote names and cells of any length; the end of the text says what to do.
        if len(text) > 2000:
            text = f"{text[:1500]} ... {text[-500:]}"
        super().__init__(f"`{parameter}`: {text}" if parameter else text)
        self.parameter = parameter


class UwblinkError(OfParameter):
    """Base of the errors of this package; the text is a line: what is wrong, where, and what to do."""


class ArgumentError(UwblinkError, ValueError):
    """An argument that cannot be used; names the parameter, what was found, and what is expected."""


class PlainWarning(UserWarning):
    """Base of the warnings of all three packages, which commands print as a line."""


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Give a warning at the line that called one of the three packages, through context managers, too."""
    own = {"uwblink", "calib", "uwbsim", "contextlib"}
    names = (str(frame.f_globals.get("__name__")).partition(".")[0] for frame, _ in walk_stack(sys._getframe()))
    level = next((k for k, name in enumerate(names, 1) if name not in own), 1)
    warnings.warn(text, category, stacklevel=level)


class PluginWarning(PlainWarning):
    """A plug-in of another distribution cannot be used, with the reason."""


class FrameError(UwblinkError, ValueError):
    """A message whose fields do not fit the wire format."""


class RecordingError(UwblinkError, ValueError):
    """A file that is not a usable recording."""


class RecordingInUseError(RecordingError):
    """Another process is writing the recording, or has it open for updating."""


class RecordingExistsError(UwblinkError, FileExistsError):
    """The output exists and must not be replaced."""


class OutputError(UwblinkError, OSError):
    """A file that cannot be written, for example without space or permission."""


class RecordingMissingError(UwblinkError, FileNotFoundError):
    """The recording to read does not exist."""


class ImportTableError(UwblinkError, ValueError):
    """A table whose columns or cells cannot be understood; quotes the row and the column."""


class PlanError(UwblinkError, ValueError):
    """A ranging plan that cannot be executed."""


class PortError(UwblinkError, OSError):
    """A serial port that cannot be used, with its name and the reason."""


class PortMissingError(PortError, FileNotFoundError):
    """No such port."""


class PortPermissionError(PortError, PermissionError):
    """No permission for the port; the text names the group to join."""


class PortBusyError(PortError):
    """Another process has the port open."""


class PortLostError(PortError, ConnectionError):
    """The port disappeared while it was in use."""


class BoardError(UwblinkError):
    """A board that did not execute a command."""


class NoAnswerError(BoardError, TimeoutError):
    """A board did not answer in time; the text has the sent and the received bytes."""


class RangingFailedError(BoardError):
    """An exchange failed; quotes the board's own line."""


class RefusedError(BoardError, ValueError):
    """A command that would harm the board or is unknown to it; nothing was sent."""


@contextmanager
def restating(error: Callable[[str], Exception], *kinds: type[Exception], where: str = "") -> Iterator[None]:
    """Raise `error` with the text of exceptions of `kinds`, which begins with `where`."""
    try:
        yield
    except kinds as problem:
        raise error(f"{where}{problem}") from problem


def first_line(error: Exception) -> str:
    """Return the first line of an error's text, 200 characters at most."""
    return (str(error).splitlines() or [""])[0][:200]


@contextmanager
def raising(error: Callable[[str], Exception], what: str, *kinds: type[Exception], remedy: str = "") -> Iterator[None]:
    """Raise `error` in place of exceptions of `kinds` (default: `OSError`): "`what` (reason)" and what to do.

    Errors of the three packages pass, because their texts are complete.
    """
    kinds = kinds or (OSError,)
    try:
        yield
    except OfParameter:
        raise
    except kinds as problem:
        reason = getattr(problem, "strerror", None) or first_line(problem)
        raise error(f"{what} ({reason}){remedy}") from problem
