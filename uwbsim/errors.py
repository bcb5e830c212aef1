"""Everything `uwbsim` raises on bad input."""


class UwbsimError(Exception):
    """Base of the errors of this package; the text says what, where and what to do."""


class ScenarioError(UwbsimError, ValueError):
    """A scenario that cannot be run; the text names the file, the key, what was found."""


class ParameterError(ScenarioError):
    """An argument that cannot be; `parameter` names it, and `reason` says what was found and what is allowed."""

    def __init__(self, parameter: str, reason: str) -> None:
        """Keep both, so that a command line can name its option instead."""
        super().__init__(parameter, reason)
        self.parameter, self.reason = parameter, reason

    def __str__(self) -> str:
        """Return one line."""
        return f"{self.parameter}: {self.reason}"


class UnknownKeyError(ScenarioError):
    """A key path that leads nowhere in a scenario."""
