"""A formula for what is left without a name: products of speed, acceleration, force, engine speed, time and distance.

It describes, and names nothing. It is judged on the residual averaged over seconds of the longest drive, beside the
road load and the effects that were chosen, and on stretches that its fit has not seen.
"""

from collections.abc import Iterator

import numpy as np

from estimator.components.formula import Variable, best_formula
from estimator.diagnosis.averaged_residual import Averages, averages_of, weigh
from estimator.diagnosis.model import Model
from estimator.diagnosis.result import Described
from estimator.signals import Floats, Quantity

MIN_LOG_BF = 5.0  # of a formula, all formulas counted: that of an effect
FOLDS, CHUNKS = 5, 4  # each fold is so many stretches of the drive


def described(model: Model) -> Described | None:
    """The formula with most evidence; None where it has too little, or explains nothing of stretches left out."""
    averages = averages_of(model)
    rms = float(np.sqrt(np.mean(averages.residual**2)))

    def judge(columns: Floats) -> tuple[Floats, Floats, Floats]:
        weight = weigh(averages, averages.mean(columns), usual=1.0, positive=False)
        return weight.log_bayes_factor, weight.value, weight.sd

    found = best_formula(dict(_variables(model)), "W", rms, judge)
    if found is None or found.gain < MIN_LOG_BF:
        return None
    share = _held_out_share(averages, averages.mean(found.column[:, None])[:, 0])
    if share <= 0:
        return None
    return Described(
        text=found.text, value=found.value, sd=found.sd, unit=found.unit, log_bayes_factor=found.gain, share=share
    )


def _variables(model: Model) -> Iterator[tuple[str, Variable]]:
    """Quantities (samples,) that hold no noise of the residual."""
    s, base = model.samples, model.base
    yield "v", Variable(s.zv, "m/s")
    yield "a", Variable(s.za, "m/s^2")
    yield "F", Variable(base.Z @ base.theta / s.zv, "N")
    yield "t", Variable(s.t - s.t[0], "s")
    yield "s", Variable(s.context[Quantity.DISTANCE], "m")
    if Quantity.ENGINE_SPEED in s.context:
        yield "n", Variable(s.context[Quantity.ENGINE_SPEED], "rad/s")


def _held_out_share(averages: Averages, column: Floats) -> float:
    """Share of the squared residual that ``column`` (n,) takes away on stretches left out of both fits."""
    n, y = len(averages), averages.residual
    plain = averages.columns / np.sqrt((averages.columns**2).mean(axis=0))
    wide = np.column_stack([plain, column / np.sqrt(np.mean(column**2))])
    fold = (np.arange(n) * FOLDS * CHUNKS // n) % FOLDS
    left = {False: 0.0, True: 0.0}
    for k in range(FOLDS):
        out = fold == k
        for with_column, X in ((False, plain), (True, wide)):
            amplitudes = np.linalg.lstsq(X[~out], y[~out], rcond=None)[0]
            left[with_column] += float(np.sum((y[out] - X[out] @ amplitudes) ** 2))
    return 1 - left[True] / left[False]
