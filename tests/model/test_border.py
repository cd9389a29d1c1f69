"""Driving that goes on behind a border has the equations of the whole drive."""

from dataclasses import replace

import numpy as np
import pytest
from dense_road import MIDDLE, SHOWN, A, C, M, scales_of, strides_of
from numpy.testing import assert_allclose

from estimator.estimation.road_likelihood import Likelihood
from estimator.model.border import Border
from estimator.model.conditioned import Conditioned
from estimator.model.road import ROUGH, SMOOTH, RoadModel
from estimator.signals import Floats
from estimator.strides import Strides

N = 150  # strides
EARLIER = 90  # of them, from which the border is made


def likelihood(strides: Strides, like: Likelihood | None = None, border: Border | None = None, **road) -> Likelihood:
    references = None if like is None else like.model.references
    unit = None if like is None else like.unit
    model = RoadModel(strides, **road, references=references)
    return Likelihood(model, (), np.array([A, C, M]), MIDDLE, border=border, unit=unit)


def border_of(earlier: Likelihood, scales: Floats, t: float) -> Border:
    conditioned = Conditioned.of(earlier.model, scales)
    whitened = conditioned.whitened(earlier.data)
    return Border.of(earlier.model, conditioned.factor, conditioned.variance, t, earlier.data, whitened)


def split(strides: Strides, at: int, begin: int, seed: int = 2, **road) -> tuple[Likelihood, Likelihood, np.ndarray]:
    """The whole drive, and what is behind a border before stride ``at``, in a model from stride ``begin`` on."""
    whole = likelihood(strides, **road)
    scales = scales_of(whole.model, seed)
    earlier = likelihood(strides[:EARLIER], whole, **road)
    border = border_of(earlier, scales, float(strides.t[at]) - 0.75)
    behind = likelihood(strides[begin:], whole, border, **road)
    assert border.is_that_of(behind.model)
    return whole, behind, scales


@pytest.mark.parametrize("shown", SHOWN, ids="+".join)
@pytest.mark.parametrize(
    "road", [{"alpha": 2}, {"alpha": 4, "wander": SMOOTH, "power": False}, {"alpha": 2, "designed": True}], ids=str
)
@pytest.mark.parametrize(("at", "gap"), [(60, 5e4), (60, 800.0), (80, 5e4)])
def test_products_means_and_leverage_are_those_of_the_whole_drive(shown, road, at, gap):
    strides = strides_of(N, shown=shown, unknown=(11, 62, 63, 120), silence=76, gap=gap)
    whole, behind, scales = split(strides, at, at - 30, **{"wander": ROUGH, **road})
    expected, found = whole.at(scales), behind.at(scales)
    own = np.sqrt(np.diag(expected[1]))
    assert_allclose(found[1] / np.outer(own, own), expected[1] / np.outer(own, own), rtol=1e-7, atol=1e-9)
    weights = np.eye(whole.data.shape[1])
    after = [each.model.place_at(strides.t[at] - 0.75) for each in (whole, behind)]
    means = expected[0].means(whole.data, weights)[after[0] :], found[0].means(behind.data, weights)[after[1] :]
    assert_allclose(means[1], means[0], rtol=1e-6, atol=1e-8 * np.abs(means[0]).max())
    seen = np.isfinite(found[0].variance[: len(behind.model.driven)])
    assert_allclose(found[0].leverage[seen], expected[0].leverage[-seen.sum() :], rtol=1e-6, atol=1e-9)
    assert not found[0].leverage[~seen].any()


def test_driving_after_the_border_was_made_changes_nothing_before_it():
    strides = strides_of(N, shown=("altitude",), silence=N)
    whole, _, scales = split(strides, 60, 30, alpha=2)
    t, made = float(strides.t[60]) - 0.75, []
    for end in (EARLIER, N):
        made.append(border_of(likelihood(strides[:end], whole, alpha=2), scales, t))
    for name in ("information", "rows", "products", "kinds"):
        one, other = (getattr(border, name) for border in made)
        assert_allclose(other, one, rtol=1e-7, atol=1e-9 * np.abs(one).max())


def test_a_model_with_other_unknowns_behind_the_border_is_told():
    strides = strides_of(N, silence=N)
    whole = likelihood(strides, alpha=2)
    border = border_of(whole, scales_of(whole.model, 2), float(strides.t[60]) - 0.75)
    assert border.is_that_of(RoadModel(strides[30:], 2))
    known = strides.known.copy()
    known[60:63] = False
    assert not border.is_that_of(RoadModel(replace(strides, known=known)[30:], 2))
