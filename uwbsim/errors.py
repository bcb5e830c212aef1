"""Everything `uwbsim` raises on bad input."""


class UwbsimError(Exception):
    """Base of the errors of this package; the text says what, where and what to do."""


class ScenarioError(UwbsimError, ValueError):
    """A scenario that cannot be run; the text names the file, the key, what was found."""
