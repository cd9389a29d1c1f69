"""The most probable scales of road and noise: Newton's method with the average information for the curvature.

The information is never negative, so every step goes upwards; it is damped as by Levenberg and Marquardt where the
log evidence is not yet parabolic. Scales at a bound stay there as long as the gradient points out of it.
"""

from collections.abc import Sequence

import numpy as np

from estimator.estimation.road_likelihood import Likelihood
from estimator.signals import Floats, Mask

# Of the log posterior that the next step is expected to bring, for one step more. At 0.05 a scale is within 0.3 of its
# standard deviation, and effects are judged by differences of several.
MIN_GAIN = 0.05
MAX_STEPS = 50  # bounds the cost; 5 to 20 are usual
# Where a parabola promises a gain below NEAR, the gain to the mode is at most MAX_RATIO times that and one nat: 2.8 is
# the largest of 107 searches. Farther away it is at most FAR_RATIO times that: 45 is the largest of 340 steps.
NEAR, MAX_RATIO, FAR_RATIO = 10.0, 3.0, 100.0
MAX_STEP = 2.0  # of the logarithm of a scale at once: the parabola holds no further
DAMPING = 0.01  # of the first step, as a share of the curvature
MAX_DAMPING = 1e6  # beyond, no step gains
GOOD, POOR = 0.75, 0.25  # share of the expected gain above which damping is reduced, and below which it is raised
LESS, MORE, MUCH_MORE = 0.1, 4.0, 10.0  # factors of the damping: after a good step, a poor one, and one that loses


def most_probable(
    likelihood: Likelihood, start: Floats, free: Sequence[int], worth: float = -np.inf
) -> tuple[Floats, float]:
    """Scales (k,) at the mode of their posterior, from ``start``, and the log evidence there with their prior.

    Those with numbers in ``free`` are varied. The search ends early where the evidence cannot come to ``worth``.
    """
    search = _Search(likelihood, free)
    logs, value = search.climbed(search.inside(np.log(start)), worth)
    best = start.copy()
    best[list(free)] = np.exp(logs[list(free)])
    return best, value


class _Search:
    """The log posterior of the logarithms of scales."""

    def __init__(self, likelihood: Likelihood, free: Sequence[int]) -> None:
        scales = likelihood.model.scales
        self._likelihood, self._free = likelihood, np.isin(np.arange(len(scales)), list(free))
        self._centre, self._spread = np.log([s.centre for s in scales]), np.array([s.spread for s in scales])
        self._low, self._high = np.log([s.low for s in scales]), np.log([s.high for s in scales])

    def inside(self, logs: Floats) -> Floats:
        """The logarithms (k,) with those that are free within their bounds."""
        return np.where(self._free, np.clip(logs, self._low, self._high), logs)

    def _value(self, logs: Floats) -> float:
        prior = float(np.sum((((logs - self._centre) / self._spread)[self._free]) ** 2))
        return self._likelihood.log_evidence(np.exp(logs)) - 0.5 * prior

    def _slopes(self, logs: Floats) -> tuple[Floats, Floats, Mask]:
        """Gradient (k,) of the log posterior, its curvature (k, k), and which scales may move (k,)."""
        found = self._likelihood.score(np.exp(logs))
        gradient = found.gradient - (logs - self._centre) / self._spread**2
        curvature = found.information + np.diag(self._spread**-2.0)
        out = ((logs <= self._low) & (gradient < 0)) | ((logs >= self._high) & (gradient > 0))
        return gradient, curvature, self._free & ~out

    def climbed(self, logs: Floats, worth: float) -> tuple[Floats, float]:
        """The mode that is reached from ``logs`` (k,), and the log posterior there; less where it is not ``worth``."""
        value, damping = self._value(logs), DAMPING
        if not np.isfinite(value):
            return logs, value
        for _ in range(MAX_STEPS):
            gradient, curvature, moving = self._slopes(logs)
            if value + _reach(gradient[moving], curvature[np.ix_(moving, moving)]) < worth:
                break
            gain = expected = 0.0
            while gain <= 0 and damping < MAX_DAMPING:
                new = self._stepped(logs, gradient, curvature, moving, damping)
                move = new - logs
                expected = float(gradient @ move - 0.5 * move @ curvature @ move)
                gain = self._value(new) - value if expected > MIN_GAIN else 0.0  # a bound may leave a step no gain
                if gain <= 0:
                    damping = MUCH_MORE * max(damping, DAMPING)
            if gain <= 0:
                break
            damping *= LESS if gain > GOOD * expected else MORE if gain < POOR * expected else 1.0
            logs, value = new, value + gain
        return logs, value

    def _stepped(self, logs: Floats, gradient: Floats, curvature: Floats, moving: Mask, damping: float) -> Floats:
        """The logarithms after one damped step of those that are ``moving``."""
        own = curvature[np.ix_(moving, moving)]
        step = np.linalg.solve(own + damping * np.diag(np.diag(own)), gradient[moving])
        new = logs.copy()
        new[moving] += step * (MAX_STEP / max(float(np.abs(step).max(initial=0.0)), MAX_STEP))
        return self.inside(new)


def _reach(gradient: Floats, curvature: Floats) -> float:
    """Largest gain to the mode, from the ``gradient`` (k,) and the ``curvature`` (k, k)."""
    promised = 0.5 * float(gradient @ np.linalg.solve(curvature, gradient))
    return (MAX_RATIO if promised < NEAR else FAR_RATIO) * (promised + 1.0)
