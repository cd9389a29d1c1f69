"""The view of `watch` at a moment: on the terminal, and on the page, whose ``/view.json`` it is."""

from msgspec import Struct

from estimator.answers.answer import Answer
from estimator.answers.status import Estimate, Progress


class Sentences(Struct, frozen=True, kw_only=True):
    """Words for people: the headline, what the driving still lacks, and the road; empty where there is nothing."""

    headline: str
    wanted: str
    road: str


class WatchAnswer(Answer, frozen=True, kw_only=True):
    """Source, estimate and progress, all null while nothing is known that is fresh.

    ``share`` is the share of a log that was read, ``note`` what is wrong, ``unused`` are moments not used, by reason.
    """

    source: str
    state: str
    note: str
    share: float | None = None
    frames: int = 0
    frames_per_s: float | None = None
    estimate: Estimate | None = None
    progress: Progress | None = None
    unused: dict[str, int]
    sentences: Sentences
