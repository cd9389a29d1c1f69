"""The answer of `check` where neither a log nor a bus is given."""

from msgspec import Struct

from estimator.answers.answer import Answer


class BoundInput(Struct, frozen=True, kw_only=True):
    """A bound signal: how its message is found; its unit, range, and values that mean on, in the scale of the DBC."""

    signal: str
    message: str
    unit: str | None
    range: str
    on: tuple[float, ...] | None


class BindingAnswer(Answer, frozen=True, kw_only=True):
    """Signals that a configuration binds, by role.

    ``reason`` why no estimate can come of it, or empty; ``remarks`` on what was left out of the DBC.
    """

    inputs: dict[str, BoundInput]
    reason: str
    remarks: tuple[str, ...]
