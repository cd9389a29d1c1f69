"""Normal equations of a fit, corrected for noise in the force and for the drivers' response to slopes.

**Noise of the measured torque** is in the regressors and biases 1/m towards zero. The normal matrix is corrected with
the noise scale of the fit (a corrected score: Nakamura 1990, Stefanski 1989):

    X'K^-1 X  less  the mean over the noise d of  dX' K^-1 dX,   dX = X(F + d) - X(F)

The noise scale is an acceleration, estimated with the uncorrected coefficients: the noise of the force is the scale
times the uncorrected mass. Errors of a speed in coarse steps (OBD-II: whole km/h) last for seconds, and part of them is
estimated as noise of the torque: then COARSE_SHARE of the noise is subtracted, with an uncertainty of all of it.

**Drivers respond to slopes**, but the model has slopes independent of the force: a driver or a governor that keeps the
speed adds the force k m g theta on a slope, so the speed changes by less, and the mass is overestimated. With the
covariance K of the data and S that of the accelerations with the part due to slopes, the moments lack

    E[X_j' K^-1 (-g theta)] = -k m sum_i (K^-1 S)_ii dX_ij / dF

In the simplest case, one regressor, the mass is too large by k R with

    R = s^2 sum_i (K^-1 S)_ii

where s is its relative sd, and the sum is the effective number of parameters of the slopes. The share k depends on the
driver; its mean is DRIVER_FEEDBACK.

The covariance includes the uncertainty of both corrections and of the scales, which are estimated from the same drive.
With V_i the derivative of K by the logarithm of scale i, the moments of a residual r change by

    -X' K^-1 V_i K^-1 r

The resulting variance of the coefficients is added twice: for the error of the scales (Kackar & Harville 1984), and
because the covariance at the estimated scales is too small by as much on average (Kenward & Roger 1997).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood, limited
from estimator.model.linear_gaussian import Places
from estimator.model.road_scales import TORQUE
from estimator.model.road_score import average_information, changed_by_scales
from estimator.signals import Floats, Mask, Quantity
from estimator.strides import DURATION

MAX_NOISE_SHARE = 0.3  # of noise in the information on 1/m: beyond, the whole correction is added as sd (BMW i3: 0.13)
# Share of the noise scale that is due to the torque where the speed has coarse steps, and the relative sd of the
# correction there.
COARSE_SHARE, COARSE_SD = 0.5, 1.0
# Share of the slope force that drivers add, and its sd. 54 drives of a simulated driver, who changes the force within
# 0.6 s, have 1.09 +- 0.05; a speed trace that is followed exactly has 1, a constant pedal 0.
DRIVER_FEEDBACK, DRIVER_FEEDBACK_SD = 1.0, 0.4
MAX_DRIVER_CORRECTION = 0.3  # largest relative change of 1/m by the drivers' response: the correction is of first order


@dataclass(frozen=True, kw_only=True)
class Corrections:
    """Sums over strides that the equations are corrected with.

    ``noise`` (q, q) is the part of the products of the regressors that is noise, for a mass of 1 kg; ``driver_bias``
    (q,) are the moments lost if drivers respond to slopes in full, times 1/m; ``present`` is the number of strides of
    the present load.
    """

    noise: Floats
    driver_bias: Floats
    present: int

    @classmethod
    def of(cls, likelihood: Likelihood, scales: Floats, shapes: Floats, counted: Mask) -> "Corrections":
        """Sums over the ``counted`` (n,) of the driven strides, with ``shapes`` (n, k) of changes."""
        conditioned, _ = likelihood.at(scales)
        by_force = likelihood.by_force(shapes) * counted[:, None]
        noise = likelihood.noise_information(conditioned, by_force)
        if Quantity.SPEED_STEP in likelihood.model.strides.context:
            noise *= COARSE_SHARE
        return cls(
            noise=noise,
            driver_bias=float(likelihood.unit[0]) * conditioned.leverage @ by_force,
            present=int(np.count_nonzero(shapes.any(axis=1) & counted)),
        )

    def __add__(self, other: "Corrections") -> "Corrections":
        """Sums over the strides of both."""
        return Corrections(
            noise=self.noise + other.noise,
            driver_bias=self.driver_bias + other.driver_bias,
            present=self.present + other.present,
        )


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Normal equations of p coefficients and of changes of 1/m, A/m and C/m with each of k shapes; q = p + 3 k.

    The shapes are functions of time over the present load; their coefficients follow the p. All are in the units of
    the likelihood.
    """

    gram: Floats  # (1 + q, 1 + q) products of the data, the response first
    noise: Floats  # (q, q) part of the products of the regressors that is noise
    driver_bias: Floats  # (q,) moments lost if drivers respond to slopes in full, times 1/m
    moved: Floats  # (q, d) change of the moments by one sd of each of d independent directions of the scales
    noise_moved: Floats  # (d,) relative change of the noise by one sd of each direction
    prior: Floats  # (p,) precisions
    unit: Floats  # (p,) a coefficient in the likelihood's units, over its value in SI
    present: int  # strides of the present load

    @classmethod
    def of(
        cls,
        likelihood: Likelihood,
        scales: Floats,
        free: Sequence[int],
        power_chance: float,
        shapes: Floats,
    ) -> "NormalEquations":
        """Compute the equations at ``scales``, of which those with the indices ``free`` were estimated.

        ``power_chance`` is the probability that the noise of the torque is noise of the power, which needs no
        correction; ``shapes`` (n, k) of changes at the driven strides.
        """
        conditioned, plain = likelihood.at(scales)
        data = likelihood.with_changes(shapes)
        beta, information, _ = likelihood.solve(plain)
        q, p = data.shape[1] - 1, len(beta)
        blank = cls(
            gram=plain,
            noise=np.zeros((q, q)),
            driver_bias=np.zeros(q),
            moved=np.zeros((q, 0)),
            noise_moved=np.zeros(0),
            prior=np.diag(likelihood.prior),
            unit=likelihood.unit,
            present=0,
        )
        found = blank.with_sums(plain, beta, Corrections.of(likelihood, scales, shapes, np.ones(len(shapes), bool)))
        residual = data[:, 0] - data[:, 1 : 1 + p] @ found.solve()[0]
        changed = changed_by_scales(conditioned, scales, residual)[:, free]
        products = conditioned.gram(np.column_stack([data, changed]))
        moments = products[1 : 1 + q, 1 + q :]
        of_scales = average_information(products[1 + q :, 1 + q :], moments[:p], information)
        spread = np.array([likelihood.model.scales[i].spread for i in free])
        root, noise_moved = _scale_doubt(of_scales + np.diag(spread**-2.0), scales, free, power_chance)
        moved = -moments @ root
        if Quantity.SPEED_STEP in likelihood.model.strides.context:
            moved, noise_moved = np.column_stack([moved, np.zeros(q)]), np.append(noise_moved, COARSE_SD)
        return replace(found, gram=products[: 1 + q, : 1 + q], moved=moved, noise_moved=noise_moved)

    def with_sums(self, gram: Floats, beta: Floats, corrections: Corrections) -> "NormalEquations":
        """The equations of other strides, with the same uncertainty of the scales.

        ``beta`` (p,) are the coefficients that solve the ``gram`` matrix without corrections.
        """
        mass = float(self.unit[0] / beta[0])
        return replace(
            self,
            gram=gram,
            noise=mass**2 * corrections.noise,
            driver_bias=corrections.driver_bias,
            present=corrections.present,
        )

    def solve(
        self, change: int | None = None, precision: Sequence[float] | Floats = ()
    ) -> tuple[Floats, Floats, float]:
        """Return the corrected coefficients, their covariance, and the share of noise in the information on 1/m.

        With the number of a ``change`` and the prior ``precision`` (3,) of its coefficients, these are appended.
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
        by_noise, driver_correction = beta - plain, self._driver_correction(corrected, beta, places)
        by_scales = corrected @ self.moved[places]
        all_moved = by_scales + np.outer(by_noise, self.noise_moved)
        covariance: Floats = corrected @ information @ corrected + by_scales @ by_scales.T + all_moved @ all_moved.T
        covariance += (share > MAX_NOISE_SHARE) * np.outer(by_noise, by_noise)
        return (
            beta + DRIVER_FEEDBACK * driver_correction,
            covariance + DRIVER_FEEDBACK_SD**2 * np.outer(driver_correction, driver_correction),
            share,
        )

    def _driver_correction(self, corrected: Floats, beta: Floats, places: Places) -> Floats:
        """Return the bias to add to the coefficients if drivers respond to slopes in full, to first order."""
        if not beta[0] > 0:
            return np.zeros_like(beta)
        taken: Floats = corrected @ self.driver_bias[places] / beta[0]
        return taken * of_first_order(float(taken[0]), float(beta[0]))


def of_first_order(taken: float, coefficient: float) -> float:
    """Return the factor (at most 1) that limits the correction ``taken`` to a share of the ``coefficient`` 1/m.

    The share is MAX_DRIVER_CORRECTION. The factor is 0 where the coefficient is not positive, which is no mass.
    """
    return min(1.0, MAX_DRIVER_CORRECTION * max(coefficient, 0.0) / max(taken, 1e-300))


def _scale_doubt(
    information: Floats, scales: Floats, free: Sequence[int], power_chance: float
) -> tuple[Floats, Floats]:
    """Change by one sd of d independent directions: of the logarithms of ``free`` scales (k, d), of the noise (d,).

    ``information`` (k, k) on these logarithms is that of the posterior. The noise is the variance of a stride's mean
    noise of the torque, 2 sd^2 (u - 1 + exp(-u)) / u^2 with u = T / time. The last direction is the doubt whether the
    noise is of the torque (``power_chance``); the scales are constant.
    """
    root = np.linalg.inv(np.linalg.cholesky(information)).T
    u = DURATION / scales[TORQUE + 1]
    by_time = 2 - u * (1 - np.exp(-u)) / (u - 1 + np.exp(-u))
    direction = np.array([2.0 if i == TORQUE else by_time if i == TORQUE + 1 else 0.0 for i in free])
    which = np.sqrt(power_chance * (1 - power_chance))
    moved = np.append(direction @ root, which)
    return np.column_stack([root, np.zeros(len(free))]), moved / max(float(np.linalg.norm(moved)), 1.0)
