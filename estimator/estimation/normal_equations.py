"""Normal equations of a fit, corrected for the two ways in which the force is no given regressor.

**Noise of the measured torque** sits in the regressors and would pull 1/m towards zero. With its scale known from the
same fit the normal matrix is corrected (a corrected score: Nakamura 1990, Stefanski 1989):

    X'K^-1 X  less  the mean over simulated noise d of  dX' K^-1 dX,   dX = X(F + d) - X(F)

The scale of the noise is that of an acceleration, found beside the coefficients before they are corrected: the noise of
the force is that times the mass before the correction. Errors of a speed in coarse steps (OBD-II: whole km/h) last for
seconds, and are taken for noise of the torque in part: then half of the noise is corrected for, and all of it is doubt.

**Drivers answer slopes** that the model takes as unknown when the force is given: a foot or a governor that keeps the
speed gives k m g theta more force, so the speed changes by less, and the mass comes out too large. With the covariance
K of the data and S that of the accelerations with what the slopes make of them, the moments lack

    E[X_j' K^-1 (-g theta)] = -k m sum_i (K^-1 S)_ii dX_ij / dF

In the simplest case, one regressor, the mass is too large by k R with

    R = s^2 sum_i (K^-1 S)_ii

its relative sd s, and the effective number of parameters that the slopes take up. The share k is a matter of the
driver, ANSWERED on average.

The corrections' doubts widen the covariance, and so do the scales, which are found from the same drive. With V_i the
derivative of K by the logarithm of scale i, the moments of a residual r change by

    -X' K^-1 V_i K^-1 r

What that makes of the coefficients counts twice: as a variance of their own (Kackar & Harville 1984), and because the
covariance at the scales found is too small by as much on average (Kenward & Roger 1997).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood, limited
from estimator.model.linear_gaussian import Places
from estimator.model.road_scales import TORQUE
from estimator.model.road_score import changed_by_scales
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION

MAX_NOISE_SHARE = 0.3  # of noise in the information on 1/m: beyond, the whole correction counts as sd (BMW i3: 0.13)
# Of the noise found, where the speed comes in coarse steps: the rest may be theirs.
COARSE_SHARE, COARSE_SD = 0.5, 1.0  # and the sd of the correction, over itself
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
    moved: Floats  # (q, d) change of the moments by one sd of each of d independent directions of the scales
    noise_moved: Floats  # (d,) relative change of the noise by the same
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
        data = likelihood.with_changes(shapes)
        beta, _, _ = likelihood.solve(plain)
        by_force = likelihood.disturbed(np.ones(len(shapes)), np.zeros(len(shapes)), shapes)
        q = data.shape[1] - 1
        found = cls(
            gram=conditioned.gram(data) if shapes.size else plain,
            noise=likelihood.noise_information(scales, conditioned, beta, shapes, rng),
            answered=float(likelihood.unit[0]) * conditioned.freedom @ by_force,
            moved=np.zeros((q, 0)),
            noise_moved=np.zeros(0),
            prior=np.diag(likelihood.prior),
            unit=likelihood.unit,
            present=int(np.count_nonzero(shapes.any(axis=1))),
        )
        if Quantity.SPEED_STEP in likelihood.model.strides.context:
            found = replace(found, noise=COARSE_SHARE * found.noise)
        root, noise_moved = _scale_doubt(likelihood, scales, free, power_chance)
        residual = data[:, 0] - data[:, 1 : 1 + len(beta)] @ found.solve()[0]
        changed = changed_by_scales(conditioned, scales, residual)[:, free] @ root
        moved = -data[:, 1:].T @ conditioned.weighed(changed)
        if Quantity.SPEED_STEP in likelihood.model.strides.context:
            moved, noise_moved = np.column_stack([moved, np.zeros(q)]), np.append(noise_moved, COARSE_SD)
        return replace(found, moved=moved, noise_moved=noise_moved)

    def solve(
        self, change: int | None = None, precision: Sequence[float] | Floats = ()
    ) -> tuple[Floats, Floats, float]:
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
        by_noise, by_answers = beta - plain, self._answers(corrected, beta, places)
        by_scales = corrected @ self.moved[places]
        all_moved = by_scales + np.outer(by_noise, self.noise_moved)
        covariance: Floats = corrected @ information @ corrected + by_scales @ by_scales.T + all_moved @ all_moved.T
        covariance += (share > MAX_NOISE_SHARE) * np.outer(by_noise, by_noise)
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
        return taken * of_first_order(float(taken[0]), float(beta[0]))


def of_first_order(taken: float, coefficient: float) -> float:
    """Share of a correction that ``taken`` away from the ``coefficient`` 1/m is small enough for; both in one unit.

    0 where the coefficient is not positive, as of no mass.
    """
    return min(1.0, MAX_ANSWERED * max(coefficient, 0.0) / max(taken, 1e-300))


def _scale_doubt(
    likelihood: Likelihood, scales: Floats, free: Sequence[int], power_chance: float
) -> tuple[Floats, Floats]:
    """What one sd of each of d independent directions changes: logarithms of ``free`` scales (k, d), the noise (d,).

    The noise is the variance of a stride's mean noise of the torque, 2 sd^2 (u - 1 + exp(-u)) / u^2 with u = T / time.
    In the last direction it is there in full, or not at all: the scales stay.
    """
    spread = np.array([likelihood.model.scales[i].spread for i in free])
    information = likelihood.score(scales).information[np.ix_(free, free)] + np.diag(spread**-2.0)
    root = np.linalg.inv(np.linalg.cholesky(information)).T
    u = DURATION / scales[TORQUE + 1]
    by_time = 2 - u * (1 - np.exp(-u)) / (u - 1 + np.exp(-u))
    direction = np.array([2.0 if i == TORQUE else by_time if i == TORQUE + 1 else 0.0 for i in free])
    which = np.sqrt(power_chance * (1 - power_chance))
    moved = np.append(direction @ root, which)
    return np.column_stack([root, np.zeros(len(free))]), moved / max(float(np.linalg.norm(moved)), 1.0)
