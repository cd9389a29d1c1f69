"""Posterior draws of one update, their convergence and their summary."""

from dataclasses import dataclass

import numpy as np

from estimator.config import Config
from estimator.estimates import Convergence, Marginal
from estimator.sampling.likelihood import Target
from estimator.sampling.run import MAX_R_HAT, run
from estimator.settings import Prior
from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY

MIN_ESS = 100.0  # effective draws: the Monte Carlo error of the mean is then a tenth of the sd
MAX_USUAL_MAGNITUDES = 20.0  # bound of an effect's magnitude, over its usual magnitude


@dataclass(frozen=True)
class Posterior:
    """Draws (chains, draws, p) of [A, C, m, effects' magnitudes ...] and the diagnostics of their convergence."""

    draws: Floats
    convergence: Convergence

    @property
    def has_converged(self) -> bool:
        """True if R-hat and the effective number of draws are within their limits."""
        c = self.convergence
        return c.r_hat < MAX_R_HAT and c.ess_bulk > MIN_ESS

    @property
    def complaint(self) -> str:
        """Message for chains that have not converged."""
        return f"chains did not converge: R-hat {self.convergence.r_hat:.3f}, ESS {self.convergence.ess_bulk:.0f}"

    def marginal(self, i: int) -> Marginal:
        """Return mean, sd and quantiles of parameter ``i``."""
        return _marginal(self.draws[:, :, i])

    @property
    def c_rr(self) -> Marginal:
        """Marginal of A / (m g) [1], the ratio draw by draw."""
        A, _, m = np.moveaxis(self.draws[:, :, :3], 2, 0)
        return _marginal(A / (m * STANDARD_GRAVITY))


def _marginal(draws: Floats) -> Marginal:
    q05, q50, q95 = np.quantile(draws, [0.05, 0.5, 0.95]).tolist()
    return Marginal(mean=float(draws.mean()), sd=float(draws.std(ddof=1)), q05=q05, q50=q50, q95=q95)


def box(prior: Prior) -> tuple[Floats, Floats]:
    """Lower and upper bounds (3,) of A [N], C [N s^2/m^2] and m [kg]."""
    ranges = (prior.A_N, prior.C_N_s2_m2, prior.mass_kg)
    return np.array([r[0] for r in ranges]), np.array([r[1] for r in ranges])


def sample(target: Target, config: Config, rng: np.random.Generator) -> Posterior:
    """Run the configured kernel from random starting points inside the box.

    Raises
    ------
    FloatingPointError
        The draws are not finite.
    """
    settings = config.sampler
    result = run(target, settings.kernel, settings.chains, settings.burn_in, settings.draws, rng)
    if not np.isfinite(result.draws).all():
        raise FloatingPointError("the draws are not finite")
    road_load = result.diagnoses[:3]
    return Posterior(
        result.draws,
        Convergence(
            # If the diagnostics of one parameter are NaN, the worst is NaN too, which counts as not converged.
            r_hat=float(np.max([diagnosis.r_hat for diagnosis in road_load])),
            ess_bulk=float(np.min([diagnosis.ess_bulk for diagnosis in road_load])),
            acceptance=result.acceptance,
            draws=result.draws.shape[1],
            chains=settings.chains,
        ),
    )
