"""One update by the paper's method: the clipped Gaussian likelihood of the power at strides, sampled in a box.

    log p = -chi2 / (2 sigma^2),   chi2 = sum (P - max(A v + C v^3 + m v a, 0))^2   over the strides with P > 0

It models no slopes, no noise of the speed and no autocorrelation of the residual. On a level road its means are near
the truth, but its intervals are too narrow. Source: Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty
Vehicles", NREL.
"""

from collections import Counter
from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, generator_state, set_generator, substate
from estimator.config import Config
from estimator.estimates import PARAMETERS, Coverage, Estimate, Status
from estimator.estimation import posterior
from estimator.estimation.evidence import Evidence, Trace
from estimator.estimation.gate import Gate, Judged, wrong_sign_of, wrong_unit_of
from estimator.estimation.load_segments import Loads, Segment
from estimator.estimation.scale_check import ScaleCheck
from estimator.estimation.window import Window
from estimator.model.road_load import design
from estimator.sampling.clipped import ClippedGaussianTarget
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, Strides

MIN_EXPLAINED = 0.5  # share of the variance of the power
NOTHING_COVERED = Coverage(0, 0)


class PaperInference:
    """Estimates from a window of strides by the paper's method; same interface as `RoadInference`.

    Parameters
    ----------
    config
        All settings.
    window
        The strides that estimates are made from.
    rng
        Source of all randomness.
    """

    def __init__(self, config: Config, window: Window, rng: np.random.Generator) -> None:
        self.evidence: Evidence | None = None  # of the newest estimate
        self._config = config
        self._window = window
        self._gate = Gate(config.gate, window.grid)
        self._rng = rng
        self._loads = Loads()

    def start_segment(self, departure: float | None = None) -> float | None:
        """Begin a new load: the present one becomes the previous one, and all its driving is discarded."""
        self._loads.start_segment()
        self.evidence = None
        return None

    def forget_vehicle(self) -> None:
        """Discard the segments before the present one: they may belong to another vehicle."""
        self._loads.forget_vehicle()

    def state(self) -> dict[str, Any]:
        """Return the state that `restore` reads, without the evidence, which the next update computes."""
        return {"generator": generator_state(self._rng), "loads": self._loads.state()}

    def restore(self, state: State) -> None:
        """Load the state of another instance.

        Raises
        ------
        StateError
            The state does not belong to this class.
        """
        set_generator(self._rng, state, "generator")
        self._loads.restore(substate(state, "loads"))

    def recover(self, state: State) -> None:
        """Return to the ``state`` before an update that failed."""
        self.restore(state)
        self.evidence = None

    def conclude(
        self, t: float, context: frozenset[Quantity], scale: ScaleCheck, rejected: Counter[str], is_last: bool
    ) -> Estimate:
        """Return the estimate at time ``t`` [s].

        ``context`` and ``is_last`` are not used; ``scale`` compares the speed with other signals; ``rejected`` rows by
        reason.
        """
        self.evidence = None
        driven = self._window.strides[self._window.strides.known]
        pulling = driven[driven.power > 0]
        held = int(pulling.rows.sum())

        def withheld(
            reason: str,
            coverage: Coverage = NOTHING_COVERED,
            status: Status = Status.UNESTIMATED,
            remedy: str | None = None,
        ) -> Estimate:
            return Estimate(t=t, status=status, reason=reason, coverage=coverage, admitted=held, remedy=remedy)

        lower, upper = posterior.box(self._config.prior)
        if reason := self._gate.missing_rows(held, rejected):
            return withheld(reason)
        if reason := wrong_sign_of(driven.power, driven.a):
            return withheld(reason, remedy="")
        if reason := wrong_unit_of(driven.power / driven.speed, driven.a, float(lower[2])):
            return withheld(reason, status=Status.INVALID)
        X, P = design(pulling.speed, pulling.a, pulling.relative_density), pulling.power
        target = ClippedGaussianTarget(X, P, lower, upper)
        judged = Judged(target.centre, np.sqrt(np.diag(target.curvature(target.centre[None])[0])))
        coverage = self._gate.coverage(self._window.counts, target.centre, P)
        if reason := self._gate.obstacle_to_estimate(judged, coverage):
            return withheld(reason, coverage)
        fitted = np.maximum(X @ target.centre, 0.0)
        if reason := scale.verdict() or _misfit(P, fitted):
            return withheld(reason, coverage, Status.INVALID)
        draws = posterior.sample(target, self._config, self._rng)
        if not draws.has_converged:
            return withheld(draws.complaint, coverage)
        return self._published(t, pulling, fitted, draws, coverage)

    def _published(
        self, t: float, pulling: Strides, fitted: Floats, draws: posterior.Posterior, coverage: Coverage
    ) -> Estimate:
        """Return the estimate from converged draws; store its evidence and the segment of its load."""
        rms = float(np.sqrt(np.mean((pulling.power - fitted) ** 2)))
        trace = Trace(
            t=pulling.t,
            v=pulling.speed,
            a=pulling.a,
            P=pulling.power,
            fitted=fitted,
            density=pulling.density,
            spacing=DURATION,
        )
        self.evidence = Evidence(
            trace=trace,
            posterior=draws,
            lag=0.0,
            grid=self._window.grid,
            counts=self._window.counts,
            rms=rms,
            effective=float(len(pulling)),
        )
        marginals = {name: draws.marginal(i) for i, name in enumerate(PARAMETERS)}
        road_load = draws.draws.reshape(-1, draws.draws.shape[2])
        return Estimate(
            t=t,
            status=Status.ESTIMATED,
            reason="",
            coverage=coverage,
            admitted=int(pulling.rows.sum()),
            mass=marginals["m"],
            A=marginals["A"],
            C=marginals["C"],
            convergence=draws.convergence,
            rms=rms,
            load=self._loads.show(Segment(road_load.mean(axis=0), np.cov(road_load.T), t)),
            c_rr=draws.c_rr,
            air_density=trace.mean_density,
        )


def _misfit(P: Floats, fitted: Floats) -> str:
    """Message if the road load explains too little variance of the power ``P`` (n,) [W]; else empty."""
    explained = 1 - float(np.var(P - fitted)) / max(float(np.var(P)), np.finfo(float).tiny)
    if explained >= MIN_EXPLAINED:
        return ""
    return f"the model explains {100 * max(explained, 0.0):.0f} % of the power's variance: grade, or a wrong signal?"
