"""Everything `uwblink` raises on bad input, each also the standard type a caller would expect."""


class UwblinkError(Exception):
    """Base of the errors of this package; the text says what, where and what to do."""


class FrameError(UwblinkError, ValueError):
    """A message whose fields do not fit the wire format."""


class RecordingError(UwblinkError, ValueError):
    """A file that is not a usable recording."""


class RecordingExistsError(UwblinkError, FileExistsError):
    """The output is already there and `--force` was not given."""


class RecordingMissingError(UwblinkError, FileNotFoundError):
    """The recording to read is not there."""


class ImportTableError(UwblinkError, ValueError):
    """A table whose columns or cells cannot be understood; quotes the row and the column."""
