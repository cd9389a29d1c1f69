"""Normal equations of a fit, corrected for the two ways in which the force is no given regressor.

**Noise of the measured torque** sits in the regressors and would pull 1/m towards zero. With its scale known from the
same fit the normal matrix is corrected (a corrected score: Nakamura 1990, Stefanski 1989):

    X'K^-1 X  less  the mean over simulated noise d of  dX' K^-1 dX,   dX = X(F + d) - X(F)

**Drivers answer slopes** that the model takes as unknown when the force is given: a foot or a governor that keeps the
speed gives k m g theta more force, so the speed changes by less, and the mass comes out too large. With the covariance
K of the data and S that of the accelerations with what the slopes make of them, the moments lack

    E[X_j' K^-1 (-g theta)] = -k m sum_i (K^-1 S)_ii dX_ij / dF

In the simplest case, one regressor, the mass is too large by k R with

    R = s^2 sum_i (K^-1 S)_ii

its relative sd s, and the effective number of parameters that the slopes take up. The share k is a matter of the
driver, ANSWERED on average.

The corrections' doubts widen the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood, limited
from estimator.model.linear_gaussian import Places
from estimator.model.road_scales import TORQUE
from estimator.signals import Floats
from estimator.strides import DURATION

MAX_NOISE_SHARE = 0.3  # of noise in the information on 1/m: beyond, the whole correction counts as sd (BMW i3: 0.13)
# Share of the slopes that drivers answer, and its sd. 54 drives of a simulated driver, who changes the force within
# 0.6 s, have 1.09 +- 0.05; a trace that is followed exactly has 1, a foot that does not move 0.
ANSWERED, ANSWERED_SD = 1.0, 0.4
MAX_ANSWERED = 0.3  # relative change of 1/m by answers up to which it is small enough to be of first order


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Of p coefficients, in the likelihood's own units, and of 1/m, A/m and C/m once more for each of k changes.

    Changes have shapes of their own over the present load, and coefficients behind the p; q = p + 3 k.
    """

    gram: Floats  # (1 + q, 1 + q) products of the data, the response first
    noise: Floats  # (q, q) part of them that is noise
    answered: Floats  # (q,) part of the moments that slopes take away where they are answered in full, times 1/m
    noise_doubt: float  # relative sd of the correction for noise
    prior: Floats  # (p,) precisions
    unit: Floats  # (p,) a coefficient in own units, over that in SI
    present: int  # strides of the present load

    @classmethod
    def of(
        cls,
        likelihood: Likelihood,
        scales: Floats,
        free: Sequence[int],
        power_chance: float,
        shapes: Floats,
        rng: np.random.Generator,
    ) -> "NormalEquations":
        """At ``scales`` (k,), of which those at the places ``free`` were found.

        ``power_chance`` that what was found as noise of the torque is that of the power, for which nothing is
        corrected; ``shapes`` (n, k) of changes at the driven strides; ``rng`` is the source of the simulated noise.
        """
        conditioned, plain = likelihood.at(scales)
        which = np.sqrt(power_chance * (1 - power_chance))  # of the noise that is there in full, or not at all
        gram = conditioned.gram(likelihood.with_changes(shapes)) if shapes.size else plain
        beta, _, _ = likelihood.solve(plain)
        by_force = likelihood.disturbed(np.ones(len(shapes)), np.zeros(len(shapes)), shapes)
        return cls(
            gram=gram,
            noise=likelihood.noise_information(scales, conditioned, beta, shapes, rng),
            answered=float(likelihood.unit[0]) * conditioned.freedom() @ by_force,
            noise_doubt=float(np.hypot(which, _torque_doubt(likelihood, scales, free))),
            prior=np.diag(likelihood.prior),
            unit=likelihood.unit,
            present=int(np.count_nonzero(shapes.any(axis=1))),
        )

    def solve(self, change: int | None = None, precision: Sequence[float] = ()) -> tuple[Floats, Floats, float]:
        """Coefficients, their covariance, and the share of noise in the information on 1/m.

        With the number of a ``change`` and the prior precisions of its three coefficients these come last.
        """
        p = len(self.prior)
        places: Places = np.arange(p)
        if change is not None:
            places = np.append(places, p + ROAD_LOAD * change + np.arange(ROAD_LOAD))
        within, moment = np.ix_(places, places), self.gram[1 + places, 0]
        information = self.gram[1:, 1:][within] + np.diag([*self.prior, *precision])
        plain = np.linalg.solve(information, moment)
        direction = np.linalg.solve(information, np.eye(len(places))[0])  # of the information on 1/m
        noise = self.noise[within]
        share = float(direction @ noise @ direction / (direction @ information @ direction))
        corrected = np.linalg.inv(information - limited(noise, information))
        beta: Floats = corrected @ moment
        by_noise = (beta - plain) * (min(self.noise_doubt, 1.0) if share <= MAX_NOISE_SHARE else 1.0)
        by_answers = self._answers(corrected, beta, places)
        covariance: Floats = corrected @ information @ corrected + np.outer(by_noise, by_noise)
        return (
            beta + ANSWERED * by_answers,
            covariance + ANSWERED_SD**2 * np.outer(by_answers, by_answers),
            share,
        )

    def _answers(self, corrected: Floats, beta: Floats, places: Places) -> Floats:
        """What full answers to the slopes took away from the coefficients, to first order."""
        if not beta[0] > 0:
            return np.zeros_like(beta)
        taken: Floats = corrected @ self.answered[places] / beta[0]
        return taken * min(1.0, MAX_ANSWERED * float(beta[0]) / max(float(taken[0]), 1e-300))


def _torque_doubt(likelihood: Likelihood, scales: Floats, free: Sequence[int]) -> float:
    """Relative sd of the variance of a stride's mean noise of the torque, 2 sd^2 (u - 1 + exp(-u)) / u^2, u = T / time.

    To first order in the logarithms of both.
    """
    spread = np.array([likelihood.model.scales[i].spread for i in free])
    information = likelihood.score(scales).information[np.ix_(free, free)] + np.diag(spread**-2.0)
    u = DURATION / scales[TORQUE + 1]
    by_time = 2 - u * (1 - np.exp(-u)) / (u - 1 + np.exp(-u))
    direction = np.array([2.0 if i == TORQUE else by_time if i == TORQUE + 1 else 0.0 for i in free])
    return float(np.sqrt(direction @ np.linalg.solve(information, direction)))
