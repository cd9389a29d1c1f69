"""The estimate as other programs get it while the daemon runs; what may not be used is not in it."""

from enum import StrEnum

from estimator.answers.answer import Answer
from estimator.answers.status import Estimate, State


class Usability(StrEnum):
    """Whether the estimate may be used; the words of the broadcast on the bus."""

    UNESTIMATED = "unestimated"
    ESTIMATED = "estimated"
    INVALID = "invalid"
    STALE = "stale"


class PublishedAnswer(Answer, frozen=True, kw_only=True):
    """The estimate at ``written_s`` [s since 1970], and the reason where there is none to be used."""

    status: Usability
    reason: str
    state: State
    written_s: float
    estimate: Estimate | None
