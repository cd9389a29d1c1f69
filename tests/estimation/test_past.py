"""Fits that go on from the past of a drive, against fits of the whole of it."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from made_strides import made_strides
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import gaussian_filter1d

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import from_dict
from estimator.estimates import Status
from estimator.estimation import continued
from estimator.estimation.continued import Continued, fit_behind, past_of
from estimator.estimation.past import GROWTH, REPEATED
from estimator.estimation.road_fit import RoadFit, fit, fit_given
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.scales import RoadScales
from estimator.signals import Role, Series
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from estimator.strides import Strides
from estimator.units import STANDARD_GRAVITY

A, C, M = 1500.0, 3.5, 20e3
N = 900  # strides of a drive


@cache
def hilly(altitude: bool) -> Strides:
    """A drive over hills, with an altimeter or without, a gap in it and strides whose force is not known."""
    rng = np.random.default_rng(3)
    profile = gaussian_filter1d(rng.standard_normal(2 * N), 40.0)  # every 10 m, over 400 m
    profile *= 0.012 / profile.std()
    speed, pull, place = np.full(N + 1, 14.0), np.zeros(N), np.zeros(N + 1)
    for k in range(N):
        v, wanted = speed[k], 14.0 + 5.0 * np.sin(k / 40)
        slope = np.interp(place[k], 10.0 * np.arange(len(profile)), profile)
        pull[k] = A + C * v**2 + M * (STANDARD_GRAVITY * slope + 0.1 * (wanted - v) + 0.1 * np.sin(k / 7))
        speed[k + 1] = max(v + (pull[k] - A - C * v**2) / M - STANDARD_GRAVITY * slope, 3.0)
        place[k + 1] = place[k] + 0.5 * (speed[k] + speed[k + 1])
    made = made_strides(speed + rng.normal(0.0, 0.01, N + 1), pull + rng.normal(0.0, 60.0, N), {})
    known = np.ones(N, bool)
    known[rng.integers(0, N, 20)] = False
    heights = 10.0 * np.cumsum(profile)
    shown = np.interp(place[1:], 10.0 * np.arange(len(profile)), heights) + rng.normal(0.0, 0.5, N)
    late = np.where(np.arange(N) >= 500, 40.0, 0.0)
    return replace(
        made,
        known=made.known & known,
        t=made.t + late,
        s0=made.s0 + 15 * late,
        s1=made.s1 + 15 * late,
        altitude=shown if altitude else made.altitude,
    )


@cache
def scales_of(altitude: bool) -> RoadScales:
    found = fit(hilly(altitude))
    assert found is not None
    return found.scales


def behind(strides: Strides, scales: RoadScales, length: int) -> RoadFit:
    past = past_of(strides[:length], scales)
    assert past is not None
    assert past.is_of(strides, scales) == (len(strides) <= GROWTH * length)
    found = fit_behind(past, strides)
    assert found is not None
    return found


@pytest.mark.parametrize("altitude", [True, False])
def test_the_past_of_a_drive_and_nothing_behind_it_have_the_fit_of_the_whole(altitude):
    strides, scales = hilly(altitude), scales_of(altitude)
    whole, found = fit_given(strides, scales), behind(strides, scales, N)
    assert whole is not None
    sd = np.sqrt(np.diag(whole.covariance))
    assert_allclose(found.beta, whole.beta, atol=1e-4 * sd.min(), rtol=1e-6)
    assert_allclose(np.sqrt(np.diag(found.covariance)), sd, rtol=1e-3)
    assert_allclose(found.fitted, whole.fitted, atol=1e-6)
    assert_allclose(found.slope, whole.slope, atol=1e-7)
    assert found.slope_sd == pytest.approx(whole.slope_sd, rel=1e-4)
    assert found.climbed == pytest.approx(whole.climbed, rel=1e-4)
    assert_array_equal(found.strides.t, whole.strides.t)
    assert found.equations.present == whole.equations.present


@pytest.mark.parametrize("altitude", [True, False])
@pytest.mark.parametrize("length", [N - 1, N - 37, N - 140])
def test_what_follows_a_past_is_fitted_as_with_the_whole_drive(altitude, length):
    strides, scales = hilly(altitude), scales_of(altitude)
    whole, found = fit_given(strides, scales), behind(strides, scales, length)
    assert whole is not None
    sd = np.sqrt(np.diag(whole.covariance))
    assert np.all(np.abs(found.beta - whole.beta) < 0.1 * sd)
    assert_allclose(np.sqrt(np.diag(found.covariance))[0], sd[0], rtol=0.1)
    assert_allclose(found.slope, whole.slope, atol=0.1 * whole.slope_doubt)
    assert len(found.fitted) == len(whole.fitted) == len(found.strides)
    assert found.residual_power.std() == pytest.approx(whole.residual_power.std(), rel=0.02)


def test_the_products_of_all_data_are_exact():
    """References are those of the past: with the same ones the whole drive has the same products."""
    strides, scales = hilly(True), scales_of(True)
    past = past_of(strides[: N - 100], scales)
    assert past is not None
    likelihood = past.likelihood_behind(strides)
    assert likelihood is not None
    found = likelihood.at(scales.values)[1]
    model = scales.model_of(strides, past.references)
    whole = Likelihood(model, (), past.road_load, scales.lag, unit=past.equations.unit).at(scales.values)[1]
    own = np.sqrt(np.diag(whole)) + (np.diag(whole) == 0)  # the engine never drags
    assert_allclose(found / np.outer(own, own), whole / np.outer(own, own), atol=1e-9)


def test_short_drives_have_no_past():
    strides, scales = hilly(True), scales_of(True)
    assert past_of(strides[: 4 * REPEATED - 1], scales) is None
    assert past_of(strides[: 4 * REPEATED + 10], scales) is not None


def test_a_past_is_not_that_of_other_strides_or_scales():
    strides, scales = hilly(True), scales_of(True)
    past = past_of(strides[:600], scales)
    assert past is not None
    assert past.is_of(strides[:650], scales)
    assert not past.is_of(strides[:599], scales)
    assert not past.is_of(strides[: int(GROWTH * 600) + 1], scales)
    assert not past.is_of(strides[:650], replace(scales))
    assert not past.is_of(strides[np.arange(N) != 100][:650], scales)  # one is forgotten
    shifted = replace(strides, t=strides.t + 3600.0)  # the clock is set
    assert not past.is_of(shifted[:650], scales)


def test_strides_that_become_known_behind_the_border_are_not_fitted_from_it():
    strides, scales = hilly(False), scales_of(False)
    past = past_of(strides[:600], scales)
    assert past is not None
    known = strides.known.copy()
    known[600 - REPEATED : 600 - REPEATED + 3] = False
    assert fit_behind(past, replace(strides, known=known)[:650]) is None


@pytest.mark.parametrize("left", [slice(0, 700), slice(0, 500), slice(0, 200), slice(100, 700)], ids=str)
def test_a_past_is_made_again_after_a_restart_from_the_strides_that_are_left(left):
    strides, scales = hilly(True), scales_of(True)
    one, other = Continued(), Continued()
    assert one.fit(strides[:600], scales) is not None
    other.restore(one.state())
    found = other.fit(strides[left], scales)
    expected = Continued().fit(strides[left], scales) if left != slice(0, 700) else one.fit(strides[left], scales)
    assert (found is None) == (expected is None) == (left == slice(0, 200))
    if found is not None:
        assert found.beta.tolist() == expected.beta.tolist()


# Updates of an estimator

MINUTES = 25
SMALL = {"window": {"samples": 8000}}  # 13 min: the rest is forgotten block by block


@cache
def recording() -> Recording:
    rng = np.random.default_rng(11)
    road = generate_route("mixed", 1200.0 * MINUTES, rng, 0.008)
    return record(Truck(mass=24e3, A=1600.0, C=3.6), road, 60.0 * MINUTES, rng, sensors=Sensors(altitude_noise=0.5))


@cache
def traffic() -> Frames:
    return frames_of(recording().signals)


def updates(parts, restored=False):
    """Estimates of the traffic in ``parts``; between them the estimator may be saved and restored."""
    pipeline, found = Pipeline(from_dict(SMALL)), []
    for i, frames in enumerate(parts):
        if restored and i:
            other = pipeline._new()
            other.restore(pipeline.estimator.state())
            other._resting = False  # no downtime
            pipeline.estimator = other
        found += pipeline.feed(frames)
    return [*found, *pipeline.finish()]


@pytest.mark.slow
def test_updates_from_the_past_are_those_of_the_whole_window(monkeypatch):
    frames, fits = traffic(), list[bool]()

    def counted(past, strides):
        fits.append(True)
        return fit_behind(past, strides)

    monkeypatch.setattr(continued, "fit_behind", counted)
    found = updates([frames])
    assert len(fits) > 0.6 * len(found)  # the first ones have too few strides
    monkeypatch.setattr(continued, "past_of", lambda strides, scales: None)
    expected = updates([frames])
    assert [u.t for u in found] == [u.t for u in expected]
    pairs = [
        (u.mass, v.mass) for u, v in zip(found, expected, strict=True) if u.mass is not None and v.mass is not None
    ]
    assert len(pairs) > 0.7 * len(found)
    assert np.median([abs(m.mean - n.mean) / n.sd for m, n in pairs]) < 0.1
    assert all(abs(m.mean - n.mean) < 0.7 * n.sd for m, n in pairs)
    assert found[-1].status is expected[-1].status is Status.ESTIMATED


@pytest.mark.slow
def test_the_last_estimate_is_of_the_whole_window():
    """So that it is that of a diagnosis, see tests/diagnosis/test_one_model.py."""
    pipeline = Pipeline(from_dict(SMALL))
    last = [*pipeline.feed(traffic()), *pipeline.finish()][-1]
    evidence, scales = pipeline.estimator.evidence, pipeline.estimator._inference._scales
    assert last.status is Status.ESTIMATED
    whole = fit_given(pipeline.estimator.window.strides, scales)
    assert evidence.fit.equations.solve()[0].tolist() == whole.equations.solve()[0].tolist()


@pytest.mark.slow
def test_a_signal_that_comes_later_is_used_at_once():
    bus = dict(recording().signals)
    for role in (Role.GRADE, Role.LONGITUDINAL_ACCELERATION):
        bus.pop(role, None)
    t, begin = bus[Role.ALTITUDE].t, 60.0 * 14 + bus[Role.ALTITUDE].t[0]
    bus[Role.ALTITUDE] = Series(t[t > begin], bus[Role.ALTITUDE].value[t > begin])
    found = [*Pipeline(from_dict({})).feed(frames_of(bus))]
    minutes = [(estimate.t - frames_of(bus).t[0]) / 60 for estimate in found]
    shown = [estimate.road is not None and estimate.road.shown_by == ("altitude",) for estimate in found]
    assert shown == [t > 14.2 for t in minutes]


@pytest.mark.slow
def test_an_estimator_that_is_restored_goes_on_as_if_it_had_never_stopped():
    frames = traffic()
    cuts = np.linspace(0, len(frames), 6, dtype=int)
    parts = [frames[a:b] for a, b in pairwise(cuts)]
    assert updates(parts, restored=True) == updates(parts)
