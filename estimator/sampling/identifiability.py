"""Combinations of parameters that the samples determine: the paper's eigen-metrics.

The information of the samples is J' J, with J = dP / d theta the Jacobian of the model power. It is singular if
v, v^3 and v a are not independent. Its eigenvalues are the information along each eigenvector. The angles between
eigenvectors and parameter axes show whether that information is about one parameter or about a combination.

Both depend on the units of the parameters: J' J of [N, N s^2/m^2, kg] and of the paper's [lbf, lbf/mph^2, slug] have
different eigenvalues and eigenvectors. Scaled by the posterior standard deviations they do not.

Source: Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty Vehicles", NREL, Table 5.
"""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats


@dataclass(frozen=True)
class EigenMetrics:
    """Eigenvalues in descending order, and directions of their eigenvectors.

    ``log10_eigenvalues`` (p,) are in W^2 over the squared units of the parameters, or in 1 if scaled; minus infinity
    for an eigenvalue of zero. ``angles`` (p, p) [deg], 0..90, are those between eigenvector i (row) and the axis of
    parameter j (column).
    """

    log10_eigenvalues: Floats
    angles: Floats


def eigen_metrics(information: Floats, scale: Floats | None = None) -> EigenMetrics:
    """Compute the eigen-metrics of J' J.

    Parameters
    ----------
    information
        J' J (p, p) [W^2 over the units of the parameters], over the samples with power above 0.
    scale
        Units (p,) of the parameters, for example their posterior standard deviations; the matrix becomes S J' J S
        with S = diag(scale). With J' J / sigma^2 and these standard deviations, uncorrelated parameters give log10
        eigenvalues of 0. A combination known ten times better than its parts gives 2.
    """
    scaled = information if scale is None else information * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    # Rounding leaves eigenvalues of a singular matrix on either side of zero.
    values = np.where(values > len(values) * np.finfo(float).eps * values[-1], values, 0.0)
    with np.errstate(divide="ignore"):
        logarithms = np.log10(values)
    angles = np.degrees(np.arccos(np.clip(np.abs(vectors.T), 0.0, 1.0)))
    return EigenMetrics(logarithms[::-1], angles[::-1])
