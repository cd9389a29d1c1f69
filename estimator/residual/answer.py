"""Define the result of the diagnosis of a residual."""

from dataclasses import dataclass

from estimator.answers.diagnosis import Verdict


@dataclass(frozen=True, kw_only=True)
class Part:
    """Share of one cause in the mean square of the residual, with its 90 % interval.

    Causes are candidates, nameless processes and "sensor noise". ``held_out_rms``: on stretches left out of the fit,
    with the cause in the model; None if it is not named. ``expected``: rms if its magnitude were known exactly.
    """

    cause: str
    share: float
    q05: float
    q95: float
    held_out_rms: float | None
    expected: float


@dataclass(frozen=True, kw_only=True)
class Suspect:
    """One candidate: the probability that it acts, and its log Bayes factor alone against the base.

    ``value`` +- ``sd``: its magnitude if it acts, averaged over the other causes in the model. ``hidden``: 95 % upper
    bound of the rms of its part in the residual.
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
    """Part of an axis where the mean residual is not zero; ``bias``: this mean, in the unit of the residual."""

    axis: str
    start: float
    end: float
    unit: str
    bias: float
    q_value: float  # smallest false discovery rate at which it is listed


@dataclass(frozen=True, kw_only=True)
class Description:
    """Formula for the residual that no named cause explains: ``value`` +- ``sd`` [``unit``] x ``text``.

    It describes but names no cause. ``log_bayes_factor`` is less the cost of all formulas that were tried.
    ``held_out_rms``: of the residual on stretches left out of the fit, with the formula.
    """

    text: str
    value: float
    sd: float
    unit: str
    log_bayes_factor: float
    held_out_rms: float


@dataclass(frozen=True, kw_only=True)
class ResidualDiagnosis:
    """Verdict on a residual, its causes with their shares, and the parts of each axis where it is not zero.

    ``named``: candidates that act with at least the probability LEVEL. ``between``: if the verdict is "cannot tell", a
    few causes (nameless processes among them) of which at least one acts with that probability. ``budget``: parts whose
    shares sum to one. ``max_false_alarms``: upper bound of the probability that noise of the fitted kind gives a named
    cause or "unknown effect". ``p_value``: share of surrogates of such noise with at least these odds, None without
    surrogates.
    """

    verdict: Verdict
    named: tuple[str, ...]
    between: tuple[str, ...]
    suspects: tuple[Suspect, ...]  # most probable first
    unknown: float  # probability that a nameless process acts
    budget: tuple[Part, ...]  # largest share first
    rms: float
    held_out_rms: float  # on held-out stretches with all named causes
    noise: float  # rms of the noise
    where: tuple[Disagreement, ...]
    formula: Description | None  # if an unknown effect is likely
    max_false_alarms: float
    p_value: float | None

    def part(self, cause: str) -> Part:
        """Part of the budget with this cause.

        Raises
        ------
        KeyError
            There is no such cause.
        """
        return {part.cause: part for part in self.budget}[cause]
