"""The past of a drive: what a fit at given scales keeps of it, so that the next one goes on behind it.

The scales of road and noise stay as they are between two searches. The driving before a border is then eliminated once
(`model/border.py`), and later fits whiten what is behind it alone: the products of all data are exact. The corrections
of the equations are sums over strides; those before the border are kept as the driving up to REPEATED strides behind it
has them. The uncertainty of the scales, and the shapes of changes of the force, are those of the past.
"""

from dataclasses import dataclass

import numpy as np

from estimator.estimation.normal_equations import Corrections, NormalEquations
from estimator.estimation.road_found import RoadFound
from estimator.estimation.road_likelihood import Likelihood, shapes_at
from estimator.estimation.scales import RoadScales
from estimator.model.border import Border
from estimator.model.road_nodes import References
from estimator.signals import Floats
from estimator.strides import DURATION, Strides

# Strides with a known force of a past behind its border, and as many before it, that are in the model of what follows.
REPEATED = 60
GROWTH = 1.2  # factor by which strides outgrow a past: what it keeps is older than the rest by so much at most


@dataclass(frozen=True, kw_only=True)
class Past:
    """The first strides of a drive at given scales, for fits of them with the strides that follow.

    ``t`` (n,) [s] are those of the strides, ``present`` is the number of those with a known force, and ``first`` the
    number of the one with which the model of what follows begins. That model has the ``references`` of these strides,
    and its coefficients the unit of the ``equations``, which are of all of them. ``corrections`` and ``road``, the
    latter by columns of the data, are of the driving before the ``border``.
    """

    t: Floats
    present: int
    first: int
    scales: RoadScales
    road_load: Floats
    references: References
    equations: NormalEquations
    border: Border
    corrections: Corrections
    road: RoadFound

    @staticmethod
    def is_possible(strides: Strides) -> bool:
        """Whether so many strides have a known force that most of them are before a border."""
        return int(np.count_nonzero(strides.known)) >= 4 * REPEATED

    @classmethod
    def of(cls, likelihood: Likelihood, scales: RoadScales) -> "Past":
        """The past that all strides of a likelihood are, at its ``scales``."""
        model, strides, values = likelihood.model, likelihood.model.strides, scales.values
        n, (conditioned, _) = len(model.driven), likelihood.at(values)
        shapes = shapes_at(np.arange(1, n + 1) / n)
        t = float(model.driven.t[-REPEATED]) - 0.75 * DURATION  # a quarter of a second before a stride begins
        begin = model.place_at(t)
        before, nodes_before = model.before(begin)[0], ~model.nodes_behind(begin)
        data, each = likelihood.with_changes(shapes), np.eye(likelihood.data.shape[1])
        whitened = conditioned.whitened(data)
        unknowns = conditioned.factor.unwhiten(whitened[:, : len(each)])
        return cls(
            t=strides.t,
            present=n,
            first=int(np.flatnonzero(strides.known)[-2 * REPEATED]),
            scales=scales,
            road_load=likelihood.road_load,
            references=model.references,
            equations=NormalEquations.of(likelihood, values, scales.free, scales.power_chance, shapes),
            border=Border.of(model, conditioned.factor, conditioned.variance, t, data, whitened),
            corrections=Corrections.of(likelihood, values, shapes, before),
            road=RoadFound.of(likelihood, values, each, unknowns).of_those(nodes_before, before),
        )

    def is_of(self, strides: Strides, scales: RoadScales) -> bool:
        """Whether strides that are to be fitted at these scales begin with it, and have not outgrown it."""
        n = len(self.t)
        return scales is self.scales and n <= len(strides) <= GROWTH * n and np.array_equal(strides.t[:n], self.t)

    def likelihood_behind(self, strides: Strides) -> Likelihood | None:
        """The likelihood of ``strides`` with this past, behind its border; None where the two do not fit together."""
        model = self.scales.model_of(strides[self.first :], self.references)
        if not self.border.is_that_of(model):
            return None
        return Likelihood(model, (), self.road_load, self.scales.lag, border=self.border, unit=self.equations.unit)

    def equations_behind(self, likelihood: Likelihood) -> NormalEquations:
        """The equations of all strides, for the `likelihood_behind` of those that follow the border.

        A change of the force goes on from its shape in the past.
        """
        values, n = self.scales.values, len(likelihood.model.driven)
        behind = np.isfinite(likelihood.at(values)[0].variance[:n])
        shapes = shapes_at((np.cumsum(behind) + self.corrections.present) / self.present)
        corrections = self.corrections + Corrections.of(likelihood, values, shapes, behind)
        conditioned, plain = likelihood.at(values)
        products = conditioned.gram(likelihood.with_changes(shapes))
        return self.equations.with_sums(products, likelihood.solve(plain)[0], corrections)
