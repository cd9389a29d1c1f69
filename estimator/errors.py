"""The errors that a user can cause or meet; each message is one line that names the place and the remedy."""


class RoadloadError(Exception):
    """A run could not finish, e.g. the output disk filled up; the command exits with status 1."""

    exit_status = 1


class InputError(RoadloadError):
    """Input that cannot be used; the command exits with status 2."""

    exit_status = 2


class ConfigError(InputError):
    """The configuration is wrong: an unknown key, a value out of range, boxes that exclude each other."""


class DatabaseError(InputError):
    """A DBC does not parse, lacks a bound signal, or gives a signal an unknown unit."""


class LogError(InputError):
    """A log is missing, empty, truncated, not a log at all, or its time steps back."""


class StateError(InputError):
    """A saved state is damaged, another vehicle's, or not to be trusted; it is discarded and the run starts afresh."""


class MissingInputsError(InputError):
    """A log or bus does not carry the inputs that the model needs."""
