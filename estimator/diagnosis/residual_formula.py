"""Find a formula for the residual that no named effect explains.

A product of speed, acceleration, force, engine speed, time and distance. It describes the residual but names no effect.
It is judged on the longest drive, beside the road load and the chosen effects, and on stretches left out of the fit.
"""

from collections.abc import Iterator

import numpy as np

from estimator.components.drive_state import DriveState
from estimator.components.folds import cross_validation
from estimator.components.formula import Variable, best_formula, judged
from estimator.components.plain_model import PlainModel
from estimator.components.term import Term
from estimator.diagnosis.result import ResidualFormula
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.signals import Floats, Quantity

MIN_SHARE = 0.05  # of the squared residual that a formula removes on held-out stretches
SMOOTHED = 5  # strides (5 s) over which the acceleration is averaged


def best_residual_formula(drive: DriveState) -> ResidualFormula | None:
    """The formula with most evidence.

    None if its log Bayes factor, less the cost of all formulas that were tried, is not above 0, or if it hardly reduces
    the residual on held-out stretches.
    """
    joint = drive.joint
    chosen = range(len(drive.chosen))
    power = drive.fit.residual_power
    rms = float(np.sqrt(np.mean(power**2)))

    def judge(columns: Floats) -> tuple[Floats, Floats, Floats]:
        return judged(*joint.projected(chosen, joint.frame.as_acceleration(columns)))

    formula = best_formula(dict(_variables(drive)), "W", rms, judge)
    if formula is None or formula.gain <= 0:
        return None
    share = _held_out_share(drive, formula.column)
    if share < MIN_SHARE:
        return None
    value, sd = _refitted(drive, formula.column, rms)
    return ResidualFormula(
        text=formula.text, value=value, sd=sd, unit=formula.unit, log_bayes_factor=formula.gain, share=share
    )


def _refitted(drive: DriveState, column: Floats, rms: float) -> tuple[float, float]:
    """Factor of a power ``column`` [W] (n,) and its sd, fitted together with A, C, m and the chosen effects."""
    term = Term(
        name="formula",
        columns=lambda frame: frame.as_acceleration(column)[:, None],
        sd=rms / float(np.sqrt(np.mean(column**2))),
    )
    joint = drive.joint_with([term])
    posterior = joint.posterior(range(len(joint.terms)))
    scale = 1 / (float(posterior.mean[0]) * float(joint.frame.road_load[2]))
    return float(posterior.mean[-1]) * scale, float(np.sqrt(posterior.covariance[-1, -1])) * scale


def _variables(drive: DriveState) -> Iterator[tuple[str, Variable]]:
    """Variables (n,) of formulas, by symbol, at the strides with a known force; none holds noise of the residual."""
    s = drive.fit.strides
    A, C, m = drive.fit.theta[:ROAD_LOAD].tolist()
    around = np.pad(s.a, SMOOTHED // 2, mode="symmetric")
    # The model's force: noise of the measured one would be in both column and residual.
    a = np.convolve(around, np.full(SMOOTHED, 1 / SMOOTHED), "valid")
    yield "v", Variable(s.speed, "m/s")
    yield "a", Variable(a, "m/s^2")
    yield "F", Variable(A + C * s.relative_density * s.speed_squared + m * a, "N")
    yield "t", Variable(s.t - s.t[0], "s")
    yield "s", Variable(np.cumsum(s.s1 - s.s0), "m")
    turns = s.context.get(Quantity.ENGINE_SPEED)
    if turns is not None and np.isfinite(turns).all():
        yield "n", Variable(turns, "rad/s")


def _held_out_share(drive: DriveState, column: Floats) -> float:
    """Share of the squared residual that ``column`` (n,) removes on held-out stretches, over means of 2 s."""
    plain = PlainModel(drive.fit)
    columns = [term.columns(drive.joint.frame)[:, 0] for term in drive.chosen]
    effects = [plain.residual(plain.as_power(effect, 1 / drive.fit.beta[:1])[:, 0]) for effect in columns]
    y, extra = plain.residual(plain.power), plain.residual(column)
    n = len(y)
    narrow = np.column_stack([np.ones(n), *effects])
    wide = np.column_stack([narrow, extra / np.sqrt(np.mean(extra**2))])
    left = {False: 0.0, True: 0.0}
    for out in cross_validation(n):
        for with_column, X in ((False, narrow), (True, wide)):
            amplitudes = np.linalg.lstsq(X[~out], y[~out], rcond=None)[0]
            left[with_column] += float(np.sum((y[out] - X[out] @ amplitudes) ** 2))
    return 1 - left[True] / left[False]
