"""The errors of `calib`, of two kinds with different exit status."""

from uwblink.errors import OfParameter, PlainWarning


class CalibError(OfParameter):
    """Base of the errors of this package; the text says what, where and what to do."""


class BadInputError(CalibError, ValueError):
    """A file or an argument that cannot be used: exit status 2."""


class UnanswerableError(CalibError, ValueError):
    """Good input that does not determine what was asked: exit status 1.

    `undetermined` are groups of tags whose delays the data leave free, where that is the reason.
    """

    def __init__(self, text: str, *, parameter: str | None = None, undetermined: list[list[int]] | None = None) -> None:
        """Say what, where and what to do."""
        super().__init__(text, parameter=parameter)
        self.undetermined = undetermined or []


class LeftOutWarning(PlainWarning):
    """Measurements that are not corrected: ranges of pairs that a calibration does not determine, differences."""


class DirectionWarning(PlainWarning):
    """Ranges whose directions are not known, of tags with a pattern over direction; names the recording."""


class TemperatureWarning(PlainWarning):
    """Tags at temperatures at which a calibration was not fitted, or readings that are of none of them; names them."""


class WeakHeadingWarning(PlainWarning):
    """Robots with a single tag, whose heading ranges tell only from motion; names the robots."""
