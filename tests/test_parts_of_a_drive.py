"""What the parts of a drive say of the mass, each by itself: a difference widens the estimate or withholds it."""

import numpy as np
import pytest

from estimator.estimation.mass_changes import Change
from estimator.estimation.road_fit import RoadFit, RoadScales
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.model.road import ALPHAS
from estimator.model.road_scales import SCALES
from estimator.strides import Strides

INVERSE = 1 / 27_190.0  # 1/kg


def change(share: float, sd_before: float, sd_after: float) -> Change:
    """Parts that differ by a share of 1/m, with standard deviations that are shares of it."""
    return Change(INVERSE, INVERSE * (1 + share), (sd_before * INVERSE) ** 2, (sd_after * INVERSE) ** 2)


def fitted(beta: list[float], sds: list[float], strides: Strides) -> RoadFit:
    scales = RoadScales(values=np.ones(len(SCALES)), alpha=ALPHAS[0], readings=(), lag=0, wander=ALPHAS[0])
    return RoadFit(
        beta=np.array(beta),
        covariance=np.diag(np.square(sds)),
        scales=scales,
        log_evidence=0.0,
        terms=(),
        strides=strides,
        fitted=np.empty(0),
        slope=np.empty(0),
        slope_sd=0.0,
        climbed=0.0,
        torque_share=0.0,
    )


def test_the_doubt_of_a_drive_that_does_not_change_is_that_of_the_whole():
    rng = np.random.default_rng(1)
    before, after = 0.01, 0.02
    doubts = [change(d, before, after).doubt for d in rng.normal(0, np.hypot(before, after), 4000)]
    whole = (before**-2 + after**-2) ** -0.5
    assert np.sqrt(np.mean(np.square(doubts))) == pytest.approx(whole, rel=0.03)


def test_a_change_in_the_middle_is_doubted_by_the_whole_bias_it_makes():
    assert change(0.1, 0.01, 0.01).doubt == pytest.approx(0.05)
    assert change(-0.1, 0.01, 0.01).doubt == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("share", "sd", "complaint"),
    [(0.1, 0.01, "mass 2.719e+04 and 2.472e+04 kg"), (0.1, 0.02, ""), (0.035, 0.001, ""), (-0.06, 0.01, "contradict")],
)
def test_parts_contradict_each_other_when_they_differ_by_more_than_chance_and_form(share, sd, complaint):
    assert complaint in change(share, sd, sd).contradiction
    assert bool(complaint) == bool(change(share, sd, sd).contradiction)


def test_doubt_of_the_mass_is_one_of_the_gain_of_the_torque():
    found = fitted([INVERSE, 0.06, 1e-4, 0.0, 0.0], [0.01 * INVERSE, 1e-3, 1e-6, 1e-6, 1e-6], strides=None)  # type: ignore[arg-type]
    wider = found.with_doubt_of_mass(0.03)
    assert found.with_doubt_of_mass(0.005) is found
    assert np.sqrt(wider.covariance[0, 0]) == pytest.approx(0.03 * INVERSE)
    np.testing.assert_array_equal(wider.covariance[1:, 1:], found.covariance[1:, 1:])
    before, after = (np.sqrt(np.diag(f.theta_covariance())[:ROAD_LOAD]) / f.theta[:ROAD_LOAD] for f in (found, wider))
    np.testing.assert_allclose(after**2 - before**2, 0.03**2 - 0.01**2, rtol=1e-6)
