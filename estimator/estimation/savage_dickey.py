"""Log Bayes factor of one more amplitude in a linear Gaussian model: the Savage-Dickey density ratio at zero.

With a prior N(0, s0^2) of the amplitude and its posterior N(value, sd^2), all other amplitudes eliminated,

    log B = log N(0; 0, s0^2) - log N(0; value, sd^2) = 1/2 (value / sd)^2 + log(sd / s0)

(Dickey, Ann. Math. Statist. 42, 1971).
"""

import numpy as np

from estimator.signals import Floats


def log_bayes_factor(value: Floats | float, sd: Floats | float, prior_sd: Floats | float) -> Floats:
    """Log Bayes factor (c,) of amplitudes against zero, from their posterior ``value`` and ``sd`` and ``prior_sd``."""
    gain: Floats = 0.5 * np.square(np.divide(value, sd)) + np.log(np.divide(sd, prior_sd))
    return gain


def posterior_of(score: Floats | float, strength: Floats | float, prior_sd: float) -> tuple[Floats, Floats]:
    """Posterior value and sd (c,) of amplitudes with prior N(0, ``prior_sd``^2).

    ``score`` and ``strength`` (c,): moment and squared norm of each column, everything else eliminated; a strength that
    rounding made negative counts as zero.
    """
    precision = np.maximum(strength, 0.0) + prior_sd**-2.0
    return np.divide(score, precision), 1 / np.sqrt(precision)


def first_eliminated(scores: Floats, products: Floats, prior_sd: float) -> tuple[Floats, Floats]:
    """Scores (k - 1, ...) and products (k - 1, k - 1, ...) of all columns but the first, whose amplitude is eliminated.

    ``scores`` (k, ...) and ``products`` (k, k, ...) have everything else eliminated; it has the prior N(0,
    ``prior_sd``^2).
    """
    share = products[1:, 0] / (np.maximum(products[0, 0], 0.0) + prior_sd**-2.0)
    return scores[1:] - share * scores[0], products[1:, 1:] - share[:, None] * products[0, 1:]
