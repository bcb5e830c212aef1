"""The errors of `uwbsim`."""

from uwblink.errors import OfParameter


class UwbsimError(OfParameter):
    """Base of the errors of this package; the text says what, where and what to do."""


class ScenarioError(UwbsimError, ValueError):
    """A scenario that cannot be run; the text names the file, the key, what was found."""


class TooFewDataError(ScenarioError):
    """A valid recording with too little data for a twin: exit status 1."""


class ParameterError(ScenarioError):
    """An invalid argument; `parameter` names it, and the text states what was found and what is allowed."""


class UnknownKeyError(ScenarioError):
    """A key path that does not exist in a scenario."""
