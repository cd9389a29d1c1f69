"""One update: fit, judge, sample, given the window and prior beliefs.

Beliefs come from the configuration, and from the parameters of the vehicle under earlier loads.
"""

from collections import Counter
from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, generator_state, read, set_generator, substate
from estimator.config import Config
from estimator.estimate import Coverage, Estimate, Status
from estimator.estimation import moments, posterior
from estimator.estimation.evidence import Evidence, Trace
from estimator.estimation.gate import Gate, wrong_sign_of
from estimator.estimation.load_segments import Loads, Segment
from estimator.estimation.model_check import contradiction, misfit
from estimator.estimation.moments import SMALL_LAG, Fit
from estimator.estimation.paper_likelihood import PaperLikelihood
from estimator.estimation.window import Window
from estimator.model.effects import named, obstacle
from estimator.model.road_load import design
from estimator.preparation.admission import Reason
from estimator.samples import STEP, Samples
from estimator.sampling.likelihood import Target
from estimator.signals import Quantity

NOTHING_COVERED = Coverage(0, 0)


class Inference:
    """Makes estimates from a window of samples, and keeps the segments of the loads.

    Parameters
    ----------
    config
        All settings.
    window
        The samples that estimates are made from.
    rng
        Source of all randomness.
    """

    def __init__(self, config: Config, window: Window[Samples], rng: np.random.Generator) -> None:
        self.evidence: Evidence | None = None  # of the newest estimate
        self.below = 0  # samples that the newest fit left out for their model power
        self._config = config
        self._window = window
        self._gate = Gate(config.gate, window.grid)
        self._effects = named(config.effects)
        self._given = posterior.belief_of(config.prior)
        self._rng = rng
        self._paper = PaperLikelihood()
        self._loads = Loads()

    def start_segment(self, departure: float | None = None) -> None:
        """Begin a new load: the present segment becomes the one before."""
        self._loads.start_segment()
        self.evidence = None

    def forget_vehicle(self) -> None:
        """Discard the segments: the vehicle may be another one."""
        self._loads.forget_vehicle()

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads; the evidence is left out, for the next update computes it."""
        return {
            "generator": generator_state(self._rng),
            "below": self.below,
            "paper": self._paper.state(),
            "loads": self._loads.state(),
        }

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not that of an inference.
        """
        set_generator(self._rng, state, "generator")
        self.below = read(state, "below", Count)
        self._paper.restore(substate(state, "paper"))
        self._loads.restore(substate(state, "loads"))

    def recover(self, state: State) -> None:
        """Return to the ``state`` before an update that failed."""
        self.restore(state)
        self.evidence = None

    def conclude(
        self, t: float, context: frozenset[Quantity], lag: float, doubt: str, rejected: Counter[str]
    ) -> Estimate:
        """The estimate at time ``t`` [s].

        ``context`` that the samples carry; ``lag`` [s] by which power was moved; ``doubt`` about the signals, or
        empty; rows ``rejected`` before the fit, by reason.
        """
        self.evidence = None
        window = self._window
        samples = window.samples
        if reason := self._contradicted(samples):
            return Estimate(t=t, status=Status.INVALID, reason=reason, coverage=NOTHING_COVERED, admitted=len(samples))
        belief = self._given + self._loads.carried_over(t, self._config.load)
        if reason := obstacle(self._effects, context):
            return Estimate(
                t=t, status=Status.UNESTIMATED, reason=reason, coverage=NOTHING_COVERED, admitted=len(samples)
            )
        fit = moments.fit(samples, self._config.admission.power_sigmas, belief, self._effects)
        held = int(fit.kept.sum()) if fit else len(samples)
        self.below = len(samples) - held

        def unestimated(reason: str, coverage: Coverage = NOTHING_COVERED) -> Estimate:
            return Estimate(t=t, status=Status.UNESTIMATED, reason=reason, coverage=coverage, admitted=held)

        reason = self._gate.obstacle_to_fit(fit, held, posterior.box(self._config.prior))
        if fit is None and (wrong := wrong_sign_of(samples.P, samples.za)):
            return unestimated(wrong)
        if fit is None or reason:
            common = (rejected + Counter({Reason.BELOW_MODEL_POWER.value: self.below})).most_common(1)
            return unestimated(reason + (f"; most others: {common[0][0]}" if common else ""))
        counts = window.counts
        coverage = self._gate.coverage(counts, np.maximum(fit.theta[:3], 0.0), samples.P)
        if reason := self._gate.obstacle_to_estimate(fit, coverage):
            return unestimated(reason, coverage)
        if reason := doubt or misfit(samples, fit):
            return Estimate(t=t, status=Status.INVALID, reason=reason, coverage=coverage, admitted=held, rms=fit.rms)
        draws = posterior.sample(self._target(window, fit), self._config, self._rng)
        if not draws.has_converged:
            c = draws.convergence
            return unestimated(f"chains did not converge: R-hat {c.r_hat:.3f}, ESS {c.ess_bulk:.0f}", coverage)
        return self._published(t, fit, draws, coverage, lag)

    def _published(
        self, t: float, fit: moments.Fit, draws: posterior.Posterior, coverage: Coverage, lag: float
    ) -> Estimate:
        """The estimate of converged draws; keeps its evidence and its load."""
        window = self._window
        used = window.samples[fit.kept]
        theta = draws.draws.mean(axis=(0, 1))[: moments.ROAD_LOAD]
        self.evidence = Evidence(
            trace=Trace(
                v=used.v,
                a=used.a,
                P=used.P,
                fitted=design(used.v, used.a, used.relative_density) @ theta,
                density=used.density,
                spacing=STEP,
            ),
            posterior=draws,
            lag=lag + float(fit.theta[moments.ROAD_LOAD]),
            grid=window.grid,
            counts=window.counts,
            rms=fit.rms,
            effective=fit.effective,
        )
        A, C, m = (draws.marginal(i) for i in range(3))
        road_load = draws.draws.reshape(-1, draws.draws.shape[2])[:, : moments.ROAD_LOAD]
        own = enumerate(fit.own_terms, start=moments.PARAMETERS)
        effects = {term.effect.name: draws.marginal(i) for i, term in own}
        change = self._loads.show(Segment(road_load.mean(axis=0), np.cov(road_load.T), t))
        return Estimate(
            t=t,
            status=Status.ESTIMATED,
            reason="",
            coverage=coverage,
            admitted=len(used),
            mass=m,
            A=A,
            C=C,
            convergence=draws.convergence,
            rms=fit.rms,
            effects=effects,
            load=change,
        )

    def _contradicted(self, samples: Samples) -> str:
        """Belief of the configuration that the drive contradicts; empty where there is none."""
        if self._given is SMALL_LAG:
            return ""
        drive = moments.fit(samples, self._config.admission.power_sigmas, SMALL_LAG, self._effects)
        if drive is None or drive.kept.sum() < self._config.gate.minimum_samples:
            return ""
        return contradiction(self._config.prior, drive)

    def _target(self, window: Window[Samples], fit: Fit) -> Target:
        if self._config.sampler.likelihood != "paper":
            return posterior.target_of(fit, self._config)
        lower, upper = posterior.box(self._config.prior)
        return self._paper.target(window.blocks, lower[: moments.ROAD_LOAD], upper[: moments.ROAD_LOAD])
