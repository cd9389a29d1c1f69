"""The answer of a residual's diagnosis."""

from dataclasses import dataclass

from estimator.answers.diagnosis import Verdict


@dataclass(frozen=True, kw_only=True)
class Part:
    """Share of the residual's mean square by one cause, "sensor noise" and processes among them, with 90 % interval.

    ``reached``: rms on stretches left out of the fit, once the cause is in the model; None where it is not chosen.
    ``expected``: rms if its magnitude were known exactly.
    """

    cause: str
    share: float
    q05: float
    q95: float
    reached: float | None
    expected: float


@dataclass(frozen=True, kw_only=True)
class Suspect:
    """One candidate: probability that it acts, and log Bayes factor alone against the base.

    ``value`` +- ``sd``: its magnitude if it acts, averaged over what acts beside it. ``hidden``: rms of the residual
    that it could cause without having been seen (95 %).
    """

    name: str
    probability: float
    log_bayes_factor: float
    value: float
    sd: float
    unit: str
    hidden: float


@dataclass(frozen=True, kw_only=True)
class Disagreement:
    """A part of an axis where the residual is not zero on average: ``bias`` in its unit."""

    axis: str
    start: float
    end: float
    unit: str
    bias: float
    q_value: float  # false discovery rate at which it is found


@dataclass(frozen=True, kw_only=True)
class Description:
    """A formula for what has no name: ``value`` +- ``sd`` [``unit``] x ``text``; it is no name.

    ``log_bayes_factor`` counts all formulas that were tried; ``reached``: rms on left-out stretches with it.
    """

    text: str
    value: float
    sd: float
    unit: str
    log_bayes_factor: float
    reached: float


@dataclass(frozen=True, kw_only=True)
class ResidualDiagnosis:
    """Which, how far and where.

    ``named``: candidates that act with a probability of at least the level. ``between``: where the verdict is "cannot
    tell", the smallest set of candidates of which one acts with that probability. ``budget``: parts that sum to one.
    ``max_false_alarms`` bounds the probability that a name or "unknown effect" is given to noise of the fitted kind;
    ``p_value`` is the share of surrogates of such noise with as large odds, None without surrogates.
    """

    verdict: Verdict
    named: tuple[str, ...]
    between: tuple[str, ...]
    suspects: tuple[Suspect, ...]  # most probable first
    unknown: float  # probability that something without a name acts beside
    budget: tuple[Part, ...]  # largest share first
    rms: float
    reached: float  # rms on left-out stretches with all that is named
    noise: float  # rms of the noise
    where: tuple[Disagreement, ...]
    formula: Description | None  # of a gap without a name
    max_false_alarms: float
    p_value: float | None

    def part(self, cause: str) -> Part:
        """Of the budget.

        Raises
        ------
        KeyError
            There is no such cause.
        """
        return {part.cause: part for part in self.budget}[cause]
