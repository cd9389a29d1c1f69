"""Make the terms that may explain a residual, with priors: candidates, and a nameless process along each axis."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.components.model_table import TermGroup
from estimator.components.processes import hats
from estimator.components.set_likelihood import SetLikelihood, term_columns_of
from estimator.residual.inputs import PROCESS, Record
from estimator.residual.noise import Noise
from estimator.signals import Floats

ODDS_OF_CANDIDATES = 0.37  # prior odds of all candidates together: e^-1 to one
ODDS_OF_PROCESSES = 0.1  # prior odds of all nameless processes together
HATS = (4, 16)  # number of distances between hats in the range of an axis
STRENGTHS = (0.1, 0.3, 1.0)  # of a process, in rms of the residual
BASE_SD = 1e4  # prior sd of the base's amplitudes, in rms: practically free, and finite on rows without information


@dataclass(frozen=True, kw_only=True)
class ResidualTerm:
    """A candidate or process in the model of a residual: columns (n, k) whose amplitudes have the prior N(0, ``sd``^2).

    ``positive``: the prior is the half of it above zero.
    """

    name: str
    columns: Floats
    sd: float
    positive: bool = False
    max_size: float = np.inf
    max_positive_size: float = np.inf
    cost: float = 0.0


def terms_of(record: Record) -> tuple[list[ResidualTerm], list[TermGroup]]:
    """All terms, and those of each candidate or process as a group with its prior odds."""
    terms: list[ResidualTerm] = []
    groups: list[TermGroup] = []

    def add(name: str, is_named: bool, odds: float, terms_of_group: Sequence[ResidualTerm]) -> None:
        numbers = tuple(range(len(terms), len(terms) + len(terms_of_group)))
        terms.extend(terms_of_group)
        groups.append(
            TermGroup(
                name=name,
                is_named=is_named,
                terms=numbers,
                log_odds=float(np.log(odds)),
                log_count=float(np.log(len(numbers))),
            )
        )

    for name, c in record.candidates.items():
        term = ResidualTerm(name=name, columns=c.column[:, None], sd=c.sd, positive=c.positive)
        add(name, True, ODDS_OF_CANDIDATES / len(record.candidates), [term])
    varying = {name: axis for name, axis in record.axes.items() if np.ptp(axis.values) > 0}
    for name, axis in varying.items():
        process = list(_process(PROCESS + name, axis.values, record))
        add(PROCESS + name, False, ODDS_OF_PROCESSES / len(varying), process)
    return terms, groups


def _process(name: str, values: Floats, record: Record) -> Iterator[ResidualTerm]:
    for number in HATS:
        columns = record.off_base(hats(values, float(np.ptp(values)) / number))
        for strength in STRENGTHS:
            yield ResidualTerm(name=name, columns=columns, sd=strength * record.rms)


class ResidualLikelihood(SetLikelihood):
    """Likelihood of one record for sets of ``terms``, under a ``noise``; ``rows``: numbers of the samples it uses."""

    def __init__(
        self, record: Record, terms: Sequence[ResidualTerm], noise: Noise, rows: NDArray[np.int64] | None = None
    ) -> None:
        self.terms = list(terms)
        columns = [record.residual[:, None], record.base, *(term.columns for term in terms)]
        data = np.hstack(columns)
        base_size = record.base.shape[1]
        term_columns = term_columns_of(base_size, [term.columns.shape[1] for term in terms])
        unit = np.ones(data.shape[1] - 1)
        base_precision = np.full(base_size, (BASE_SD * record.rms) ** -2.0)
        self.data, self._noise = data if rows is None else data[rows], noise
        super().__init__(noise.gram(self.data), base_precision, terms, term_columns, unit)

    def projected(self, chosen: Sequence[int], columns: Floats) -> tuple[Floats, Floats]:
        """Products (c, c) and scores (c,) of further ``columns`` (n, c), after projection off a set of terms."""
        beside = [0, *(1 + self._set(chosen)[0])]
        return self.eliminated(chosen, self._noise.gram(np.hstack([self.data[:, beside], columns])))
