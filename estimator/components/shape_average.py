"""The road load averaged over the shapes of the effects chosen: a time constant or a wind is known only roughly.

With the posterior probabilities w_i of an effect's shapes, and theta_i the road load with each,

    mean = sum w_i theta_i,   covariance = that of one shape + sum w_i (theta_i - mean) (theta_i - mean)'

(the law of total variance). The shapes of each effect vary by themselves, with those of the others as chosen.
"""

from collections.abc import Sequence

import numpy as np

from estimator.components.component import Component, Frame, of_term
from estimator.components.drive_state import DriveState
from estimator.components.likelihood import JointLikelihood
from estimator.estimation.road_fit import theta_jacobian
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.model.design_matrix import Term
from estimator.signals import Floats, Quantity


def averaged(drive: DriveState) -> tuple[Floats, Floats]:
    """A [N], C [N s^2/m^2], m [kg] (3,) of a drive with the effects chosen, and their covariance (3, 3)."""
    fit, count = drive.fit, len(drive.chosen)
    theta, covariance = fit.theta[:ROAD_LOAD].copy(), fit.theta_covariance()[:ROAD_LOAD, :ROAD_LOAD].copy()
    frame = Frame.of(fit)
    shapes = {
        own: found for own in range(count) if (found := _shapes(frame, drive.chosen[own], float(drive.sizes[own])))
    }
    if not shapes:
        return theta, covariance
    joint, at = drive.joint([shape for found in shapes.values() for shape in found]), count
    for own, found in shapes.items():
        others = [i for i in range(count) if i != own]
        weights, shifts = _shifts(joint, others, own, range(at, at + len(found)))
        mean = weights @ shifts
        theta += mean
        covariance += (shifts - mean).T @ ((shifts - mean) * weights[:, None])
        at += len(found)
    return theta, covariance


def _shapes(frame: Frame, component: Component, size: float) -> list[Component]:
    """All shapes of an effect that no signal tells, those near the chosen one too."""
    term = component.term
    if term is None or term.effect.finer is None or isinstance(term.shape, Quantity):
        return []
    shapes = dict.fromkeys((*term.effect.shapes, *term.effect.finer(term.shape, size)))
    return [of_term(frame, Term(term.effect, shape)) for shape in shapes if not isinstance(shape, Quantity)]


def _shifts(joint: JointLikelihood, others: list[int], own: int, shapes: Sequence[int]) -> tuple[Floats, Floats]:
    """Probabilities (c,) of the components ``shapes`` in the place of ``own``, and what each adds to theta (c, 3)."""
    log = np.array([joint.unlimited([*others, shape]) for shape in shapes])
    weights = np.exp(log - log.max())
    base, chosen = joint.base_size, joint.posterior([*others, own]).mean
    jacobian = theta_jacobian(chosen[:base], 0)[:ROAD_LOAD]
    means = np.array([joint.posterior([*others, shape]).mean[:base] for shape in shapes])
    return weights / weights.sum(), (means - chosen[:base]) @ jacobian.T
