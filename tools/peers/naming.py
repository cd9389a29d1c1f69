"""Published methods on the same drives, fed with the same smoothed samples and candidate columns.

* STLSQ: sequentially thresholded least squares (Brunton, Proctor, Kutz 2016), from pysindy.
* LassoLarsIC: the lasso with the penalty with the lowest BIC (Zou, Hastie, Tibshirani 2007), from scikit-learn.
* BIC: forward selection while the Bayesian information criterion falls, with independent errors.

Samples and columns are those of the diagnosis: for every effect of the catalogue the column with its best shape and
times. The columns are projected off v, v^3, v a and the lag by least squares and scaled to one, as is the residual
power; so a coefficient of 1 would explain all of it. Each method names the effects it keeps, largest coefficient first,
or "no gap"; no method has the verdicts "unknown effect" or "cannot tell".
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from blind import seal
from blind.answer import Run, bare
from blind.case import Case
from blind.naming import naming
from blind.truth import Truth
from numpy.typing import NDArray
from pysindy.optimizers import STLSQ
from sklearn.linear_model import LassoLarsIC

from estimator.answers.diagnosis import DiagnosisAnswer, Verdict
from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.components.term import Frame
from estimator.config import Config
from estimator.diagnosis.result import Diagnosis
from estimator.model.effect_term import EffectTerm
from estimator.model.effects import CATALOGUE
from estimator.report.diagnosis_summary import of_diagnosis
from estimator.streaming.drive_extraction import drives_of

THRESHOLD = 0.1  # of STLSQ, as in the published study of discrepancy models

Floats = NDArray[np.float64]
Choose = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True, slots=True)
class Library:
    """Input of a method: names of effects, their columns (n, k) and the residual to explain (n,)."""

    names: tuple[str, ...]
    columns: Floats
    left: Floats


def library_of(log: Path) -> Library | None:
    """Samples and candidate columns of one log; None where the road load cannot be fitted."""
    drive = max(drives_of(log, Config(), lambda share: None), key=lambda drive: drive.minutes_known)
    state = DriveState.of(drive.strides, drive.rests, is_level=True)
    if state is None:
        return None
    effects = [
        effect
        for effect in CATALOGUE
        if not (effect.is_absorbed or effect.is_gravity or effect.is_applied(drive.known_quantities))
        and effect.usable_shapes(drive.known_quantities)
    ]
    terms = [EffectTerm(effect, effect.usable_shapes(drive.known_quantities)[0]) for effect in effects]
    plain, frame = PlainModel(state.fit), Frame.of(state.fit)
    raw = np.column_stack([plain.power, *(term.column(frame.view) for term in terms)])
    rest = plain.residual(raw)
    raw = plain.paired(raw)
    spread = rest.std(axis=0)
    usable = spread > 1e-9 * raw.std(axis=0)
    scaled = rest[:, usable] / spread[usable]
    names = tuple(effect.name for effect, use in zip(effects, usable[1:], strict=True) if use)
    return Library(names, scaled[:, 1:], scaled[:, 0])


def stlsq(columns: Floats, left: Floats) -> Floats:
    """Coefficients (k,) that stay above the threshold."""
    return np.ravel(STLSQ(threshold=THRESHOLD).fit(columns, left[:, None]).coef_)


def lasso(columns: Floats, left: Floats) -> Floats:
    """Coefficients (k,) of the lasso at the lowest BIC."""
    return np.asarray(LassoLarsIC(criterion="bic").fit(columns, left).coef_)


def forward_bic(columns: Floats, left: Floats) -> Floats:
    """Coefficients (k,) after adding columns while BIC falls."""
    n, k = columns.shape
    chosen: list[int] = []
    coefficients, cost = np.zeros(k), n * np.log(np.mean(left**2))
    while len(chosen) < k:
        trials = []
        for i in set(range(k)) - set(chosen):
            some = [*chosen, i]
            b = np.linalg.lstsq(columns[:, some], left, rcond=None)[0]
            error = float(np.mean((left - columns[:, some] @ b) ** 2))
            trials.append((n * np.log(error) + len(some) * np.log(n), i, b))
        best, i, b = min(trials, key=lambda trial: trial[0])
        if best >= cost:
            break
        chosen.append(i)
        cost = best
        coefficients = np.zeros(k)
        coefficients[chosen] = b
    return coefficients


METHODS: dict[str, Choose] = {
    "STLSQ (pysindy)": stlsq,
    "LassoLarsIC (scikit-learn)": lasso,
    "BIC, independent errors": forward_bic,
}


def answer_of(library: Library | None, choose: Choose) -> DiagnosisAnswer:
    """Result of a method, as an answer of the diagnosis."""
    nothing = of_diagnosis(Diagnosis(verdict=Verdict.CANNOT_TELL))
    if library is None or not library.names:
        return nothing
    coefficients = choose(library.columns, library.left)
    order = np.argsort(-np.abs(coefficients))
    named = tuple(bare(library.names[i]) for i in order if coefficients[i] != 0.0)
    return msgspec.structs.replace(nothing, verdict=Verdict.EFFECT if named else Verdict.NO_GAP, effects=named)


def compare(truths: dict[str, Truth], folder: Path, workers: int) -> dict[str, list[dict[str, Any]]]:
    """Measures of naming by method."""
    with ProcessPoolExecutor(workers) as pool:
        libraries = list(pool.map(library_of, [seal.log_of(folder, drive) for drive in truths]))
    found = {}
    for name, choose in METHODS.items():
        given = map(partial(answer_of, choose=choose), libraries)
        cases = [
            Case(truth, Run(truth.drive, 0.0, 0.0, 0.0, said))
            for truth, said in zip(truths.values(), given, strict=True)
        ]
        found[name] = [asdict(measure) for measure in naming(cases)]
    return found
