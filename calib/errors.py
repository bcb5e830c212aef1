"""The errors of `calib`, of two kinds with different exit status."""

from uwblink.errors import OfParameter, PlainWarning


class CalibError(OfParameter):
    """Base of the errors of this package; the text says what, where and what to do."""


class BadInputError(CalibError, ValueError):
    """A file or an argument that cannot be used: exit status 2."""


class UnanswerableError(CalibError, ValueError):
    """Valid input that does not determine the requested result: exit status 1.

    `undetermined` lists groups of tags whose delays the data do not determine; it is empty if the reason is another.
    """

    def __init__(self, text: str, *, parameter: str | None = None, undetermined: list[list[int]] | None = None) -> None:
        """Store the text: what was found, where, and what to do."""
        super().__init__(text, parameter=parameter)
        self.undetermined = undetermined or []


class LeftOutWarning(PlainWarning):
    """Warning of measurements that are left out or copied without a correction.

    They are ranges of pairs that a calibration cannot correct, and differences of arrival without stamps.
    """


class DirectionWarning(PlainWarning):
    """Warning of ranges with unknown directions although a tag has a pattern over direction; names the recording."""


class TemperatureWarning(PlainWarning):
    """Warning of tags at temperatures outside the fitted ones, or of readings of other tags; names the tags."""


class WeakHeadingWarning(PlainWarning):
    """Warning of robots with a single tag, whose heading is observable only from motion; names the robots."""
