"""Compute the joint likelihood of all terms on a drive: the evidence of any hypothesis beside road load and road.

K is the covariance of everything that is not a term: road, noise of torque and speed (see `model.road`). All
hypotheses share it, so the products of all columns are computed once, and each hypothesis is a small linear system. Two
corrections come first (see `estimation.normal_equations`): for noise of the measured force in the products, and for
drivers' feedback to slopes in the moments.
"""

from array import array
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.components.set_likelihood import SetLikelihood
from estimator.components.term import Frame, Term
from estimator.estimation.normal_equations import DRIVER_FEEDBACK, of_first_order
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import DRAG, LAG, Likelihood, limited
from estimator.model.conditioned import Conditioned
from estimator.signals import Floats


class JointLikelihood(SetLikelihood):
    """Likelihood of one drive for sets of ``terms``.

    Parameters
    ----------
    conditioned
        Road model of the drive at the scales of ``fit``.
    fit
        Fit of the drive.
    terms
        All terms that a hypothesis may contain.
    stretches
        Stretches of the road in every hypothesis; None if all slopes are those of the Gaussian process.
    """

    def __init__(
        self,
        conditioned: Conditioned,
        fit: RoadFit,
        terms: Sequence[Term],
        stretches: Term | None = None,
    ) -> None:
        self.frame, self.terms = Frame.of(fit), list(terms)
        self.conditioned, self.model = conditioned, conditioned.model
        base = Likelihood(self.model, (), fit.theta[:3], fit.scales.lag)
        steep = np.empty((len(self.model.driven), 0)) if stretches is None else stretches.columns(self.frame)
        plain, base_size = base.data.shape[1] - 1, base.data.shape[1] - 1 + steep.shape[1]
        self.stretches = np.arange(plain, base_size)  # their columns among those of all amplitudes
        self.response = base.data[:, 0]
        self._common = np.zeros((len(base.data), 1 + base_size))
        self._common[:, : 1 + plain] = base.data
        self._common[: len(steep), 1 + plain :] = steep
        data, numbers = _joined(self._common, terms, self.frame)
        term_columns = [of_term - 1 for of_term in numbers]  # the first one is the response
        products, free = self.conditioned.gram(data), data.shape[1] - 1 - base_size
        del data  # on a long drive it takes as much memory as all else
        unit = np.concatenate([base.unit, np.ones(len(products) - 1 - plain)])
        stretch_precision = np.full(len(self.stretches), 1.0 if stretches is None else stretches.sd**-2.0)
        base_precision = np.concatenate([np.diag(base.prior), stretch_precision])
        super().__init__(products, base_precision, self.terms, term_columns, unit)
        widest = np.concatenate([base_precision, np.full(free, np.inf)])
        for of_term, term in zip(term_columns, terms, strict=True):
            widest[of_term] = np.minimum(widest[of_term], term.sd**-2.0)
        with_prior = self._information + np.diag(widest)
        self._information -= limited(self._noise(fit), with_prior)
        self._moment = self._moment + DRIVER_FEEDBACK * self._driver_correction(base, fit)

    @cached_property
    def columns(self) -> sp.csc_array:
        """Columns (n, p) of all amplitudes; most entries are zero. They are made when they are asked for."""
        data = _joined(self._common, self.terms, self.frame)[0]
        start = data.indptr[1]
        parts = data.data[start:], data.indices[start:], data.indptr[1:] - start
        return sp.csc_array(parts, (data.shape[0], data.shape[1] - 1))

    def without_columns(self) -> SetLikelihood:
        """The likelihood of the sets alone, without the model and the terms of the drive."""
        products = np.block([[np.array([[self._total]]), self._moment], [self._moment[:, None], self._information]])
        return SetLikelihood(products, self._prior, self.priors, self.term_columns, self.unit)

    def _padded(self, columns: Floats | sp.sparray) -> sp.csc_array:
        """Columns (m, c) extended with zero rows to the length of the data (n, c)."""
        sparse = sp.csc_array(columns)
        return sp.csc_array((sparse.data, sparse.indices, sparse.indptr), (len(self.response), sparse.shape[1]))

    def _products(self, columns: sp.csc_array) -> Floats:
        """Products (1 + c, 1 + c) of the response and ``columns`` (n, c), weighted by K^-1."""
        data = sp.hstack([sp.csc_array(self.response[:, None]), columns], format="csc")
        return self.conditioned.gram(data)

    def _noise(self, fit: RoadFit) -> Floats:
        """Mean contribution (p, p) of noise of the measured force to the products of all columns."""
        mass, (changed, by_force) = 1 / float(fit.beta[0]), self._change_by_force
        total = np.zeros((len(self.unit), len(self.unit)))
        total[np.ix_(changed, changed)], of_rate = self.conditioned.torque_noise(mass * by_force)
        total[LAG, LAG] = (mass / self.unit[LAG]) ** 2 * of_rate.sum()
        return total

    def _driver_correction(self, base: Likelihood, fit: RoadFit) -> Floats:
        """Loss of the moments (p,) of all columns if drivers compensate slopes in full."""
        changed, by_force = self._change_by_force
        loss = np.zeros(len(self.unit))
        loss[changed] = self.conditioned.leverage @ by_force / float(fit.beta[0])
        base_columns, information, _ = self._set(())
        shift = float(np.linalg.solve(information, loss[base_columns])[0])
        return loss * of_first_order(shift, float(fit.beta[0] * base.unit[0]))

    @cached_property
    def _change_by_force(self) -> tuple[NDArray[np.int64], sp.csc_array]:
        """Numbers (c,) of the columns that contain the measured force, and their change (n, c) per unit [N] of it."""
        noisy = [i for i, term in enumerate(self.terms) if term.is_noisy]
        terms, force = [self.terms[i] for i in noisy], self.frame.force
        before = np.column_stack([np.zeros(len(force)), np.minimum(force, 0.0)])
        after = np.column_stack([np.ones(len(force)), np.minimum(force + 1.0, 0.0)])
        unit = self.unit[[0, DRAG]]
        columns, columns_of_noisy = _joined(before / unit, terms, self.frame)
        numbers = np.zeros(columns.shape[1], dtype=np.int64)
        numbers[:2] = 0, DRAG
        for columns_of_term, i in zip(columns_of_noisy, noisy, strict=True):
            numbers[columns_of_term] = self.term_columns[i]
        return numbers, _joined(after / unit, terms, self.frame.disturbed(1.0))[0] - columns

    def projected(self, chosen: Sequence[int], columns: Floats | sp.sparray) -> tuple[Floats, Floats]:
        """Products (c, c) and scores (c,) of further ``columns``, the terms of a hypothesis eliminated.

        The columns have shape (m, c), m <= n; their other rows are zero.
        """
        beside = self.columns[:, self._set(chosen)[0]]
        return self.eliminated(chosen, self._products(sp.hstack([beside, self._padded(columns)], format="csc")))

    def weighed_residual(self, chosen: Sequence[int]) -> Floats:
        """K^-1 (a - X b) (n,) of the accelerations a given a hypothesis; its products with columns are their scores."""
        columns, information, _ = self._set(chosen)
        residual = self.response - self.columns[:, columns] @ np.linalg.solve(information, self._moment[columns])
        return self.conditioned.weighed(residual)[: len(self.frame.strides)]

    def residual(self, amplitudes: Floats) -> Floats:
        """Response (n, ...) minus all columns times ``amplitudes`` (p, ...)."""
        modelled: Floats = self.columns @ amplitudes
        return np.subtract(self.response, modelled.T, out=modelled.T).T

    def acceleration(self, columns: NDArray[np.int64], amplitudes: Floats) -> Floats:
        """Acceleration (n, ...) [m/s^2] of the strides: ``columns`` (k,), by number, times ``amplitudes`` (k, ...)."""
        modelled: Floats = self.columns[:, columns][: len(self.frame.strides)] @ amplitudes
        return modelled


def _joined(first: Floats, terms: Sequence[Term], frame: Frame) -> tuple[sp.csc_array, list[NDArray[np.int64]]]:
    """Columns ``first`` (n, c), then the distinct ones of ``terms``, and the numbers of those of each term.

    Strengths of one process share its columns; stretches of the road with the same times share theirs. Columns of terms
    have a row for each stride, and are zero in all later rows.
    """
    number_of: dict[object, int] = {}
    rows, values, ends = array("i"), array("d"), [0]  # they grow in place: with lists, all would be in memory twice

    def add(column: Floats) -> None:
        nonzero = np.flatnonzero(column).astype(np.int32)
        rows.frombytes(nonzero.view(np.uint8).data)
        values.frombytes(column[nonzero].view(np.uint8).data)
        ends.append(len(rows))

    for column in first.T:
        add(column)
    numbers: dict[int, NDArray[np.int64]] = {}
    for key, term in {id(term.columns): term for term in terms}.items():
        transposed = term.columns(frame).T
        names = [column.tobytes() if term.is_slope else (key, k) for k, column in enumerate(transposed)]
        for column, name in zip(transposed, names, strict=True):
            if name not in number_of:
                number_of[name] = first.shape[1] + len(number_of)
                add(column)
        numbers[key] = np.array([number_of[name] for name in names], dtype=np.int64)
    parts = np.frombuffer(values), np.frombuffer(rows, dtype=np.int32), np.array(ends, dtype=np.int32)
    return sp.csc_array(parts, (len(first), len(ends) - 1)), [numbers[id(term.columns)] for term in terms]
