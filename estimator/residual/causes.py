"""Causes of a residual, with priors: candidates of one column each, and a nameless process along each axis."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.components.model_table import Cause
from estimator.components.processes import hats
from estimator.components.set_likelihood import SetLikelihood, places_of
from estimator.residual.inputs import PROCESS, Record
from estimator.residual.noise import Noise
from estimator.signals import Floats

ODDS_OF_CANDIDATES = 0.37  # prior odds of all candidates together: e^-1 to one
ODDS_OF_PROCESSES = 0.1  # prior odds of all nameless processes together
HATS = (4, 16)  # number of distances between hats in the range of an axis
STRENGTHS = (0.1, 0.3, 1.0)  # of a process, in rms of the residual
BASE_SD = 1e4  # prior sd of the base's amplitudes, in rms: practically free, and finite on rows without information


@dataclass(frozen=True, kw_only=True)
class Form:
    """One form of a cause: columns (n, k) whose amplitudes have the prior N(0, ``sd``^2).

    ``positive``: the prior is the half of it above zero.
    """

    cause: str
    columns: Floats
    sd: float
    positive: bool = False
    max_size: float = np.inf
    max_positive_size: float = np.inf
    cost: float = 0.0


def forms_of(record: Record) -> tuple[list[Form], list[Cause]]:
    """All forms of all causes, and the causes with the numbers of their forms and their prior odds."""
    forms: list[Form] = []
    causes: list[Cause] = []

    def add(name: str, is_named: bool, odds: float, cause_forms: Sequence[Form]) -> None:
        numbers = tuple(range(len(forms), len(forms) + len(cause_forms)))
        forms.extend(cause_forms)
        causes.append(
            Cause(
                name=name,
                is_named=is_named,
                forms=numbers,
                log_odds=float(np.log(odds)),
                log_forms=float(np.log(len(numbers))),
            )
        )

    for name, c in record.candidates.items():
        form = Form(cause=name, columns=c.column[:, None], sd=c.sd, positive=c.positive)
        add(name, True, ODDS_OF_CANDIDATES / len(record.candidates), [form])
    varying = {name: axis for name, axis in record.axes.items() if np.ptp(axis.values) > 0}
    for name, axis in varying.items():
        cause_forms = list(_process(PROCESS + name, axis.values, record))
        add(PROCESS + name, False, ODDS_OF_PROCESSES / len(varying), cause_forms)
    return forms, causes


def _process(name: str, values: Floats, record: Record) -> Iterator[Form]:
    for number in HATS:
        columns = record.off(hats(values, float(np.ptp(values)) / number))
        for strength in STRENGTHS:
            yield Form(cause=name, columns=columns, sd=strength * record.rms)


class ResidualLikelihood(SetLikelihood):
    """Likelihood of one record for sets of ``forms``, under a ``noise``; ``rows``: numbers of the samples it uses."""

    def __init__(
        self, record: Record, forms: Sequence[Form], noise: Noise, rows: NDArray[np.int64] | None = None
    ) -> None:
        self.forms = list(forms)
        columns = [record.residual[:, None], record.base, *(form.columns for form in forms)]
        data = np.hstack(columns)
        base = record.base.shape[1]
        places = places_of(base, [form.columns.shape[1] for form in forms])
        unit = np.ones(data.shape[1] - 1)
        free = np.full(base, (BASE_SD * record.rms) ** -2.0)
        self.data, self._noise = data if rows is None else data[rows], noise
        super().__init__(noise.gram(self.data), free, forms, places, unit)

    def projected(self, chosen: Sequence[int], columns: Floats) -> tuple[Floats, Floats]:
        """Products (c, c) and scores (c,) of further ``columns`` (n, c), after projection off a set of forms."""
        beside = [0, *(1 + self._set(chosen)[0])]
        return self.off(chosen, self._noise.gram(np.hstack([self.data[:, beside], columns])))
