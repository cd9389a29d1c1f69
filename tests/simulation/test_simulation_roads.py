"""Roads: bends fit their speed, ways back and laps come home, driving cycles become roads."""

from itertools import pairwise

import numpy as np
import pytest
from project_paths import TOOLS

from estimator.errors import InputError
from estimator.simulation.cycle import cycle_route
from estimator.simulation.drive import drive
from estimator.simulation.driver import speeds_ahead
from estimator.simulation.effects.effect import Effect
from estimator.simulation.itinerary import plan_route, shaped
from estimator.simulation.route import GRADE_SPACING, MEASURED_WAVES, generate_route
from estimator.simulation.truck import Truck

HWFET = TOOLS / "cycles" / "hwfet.csv"
TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)


@pytest.mark.parametrize("kind", ["urban", "mixed", "highway"])
def test_bends_can_be_driven_at_the_speed_of_the_road(kind):
    route = generate_route(kind, 60e3, np.random.default_rng(1))
    place = 5.0 * np.arange(len(route.curvature))
    allowed = speeds_ahead(route, 0.17, 0.55)[(place / 2.0).astype(int).clip(max=int(route.length / 2.0))]
    lateral = allowed**2 * route.curvature

    assert np.abs(lateral).max() < 2.5
    assert 0.2 < lateral.std() < 0.8
    assert np.ptp(route.heading) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "measured"),
    [
        ("urban", [0.09, 0.36, 0.26, 0.28, 0.01]),
        ("mixed", [0.02, 0.26, 0.69, 0.03, 0.01]),
        ("highway", [0.00, 0.03, 0.17, 0.43, 0.38]),
    ],
)
def test_long_and_short_waves_of_the_grade_have_their_measured_shares(kind, measured):
    edges = [40.0, 200.0, 800.0, 3200.0, 12_800.0, np.inf]
    power, points = 0.0, 5000
    for seed in range(8):
        grade = generate_route(kind, 1e5, np.random.default_rng(seed), 0.01, MEASURED_WAVES[kind]).grade[:points]
        power = power + np.abs(np.fft.rfft((grade - grade.mean()) * np.hanning(points))) ** 2 / 8
    wave = GRADE_SPACING * points / np.maximum(np.arange(len(power)), 1)
    shares = [power[1:][(wave[1:] >= low) & (wave[1:] < high)].sum() / power[1:].sum() for low, high in pairwise(edges)]
    assert np.abs(np.subtract(shares, measured)).max() < (0.25 if kind == "mixed" else 0.12)  # one profile of 26 km


def test_there_and_back_ends_where_it_began_facing_the_other_way():
    route = plan_route("mixed", 1800.0, np.random.default_rng(4), "out-and-back")
    hilly = plan_route("mixed", 1800.0, np.random.default_rng(4), "out-and-back")
    turned = (route.heading[-1] - route.heading[0]) % (2 * np.pi)

    assert route.altitude[-1] == pytest.approx(0.0, abs=1e-6)
    assert turned == pytest.approx(np.pi, abs=0.1)
    assert route.length == hilly.length
    x, y = np.cumsum(np.sin(route.heading)) * 5.0, np.cumsum(np.cos(route.heading)) * 5.0
    assert np.hypot(x[-1], y[-1]) < 300.0
    assert np.hypot(x, y).max() > 2000.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["urban", "highway"])
def test_the_truck_is_back_in_time(kind):
    rng = np.random.default_rng(6)
    route = plan_route(kind, 1800.0, rng, "out-and-back")
    truth = drive(TRUCK, route, 1800.0, rng)

    assert truth.s[-1] > 0.88 * route.length


@pytest.mark.slow
def test_a_loop_closes_and_repeats():
    rng = np.random.default_rng(8)
    route = plan_route("mixed", 3600.0, rng, "loop")
    truth = drive(TRUCK, route, 3600.0, rng, [Effect(name="grade", magnitude=0.01)])
    lap = route.lap
    points = round(lap / 20.0)
    first, second = truth.s < lap, (truth.s > lap) & (truth.s < 2 * lap)
    again = np.interp(truth.s[second] - lap, truth.s[first], truth.altitude[first])

    assert truth.s[-1] > 1.8 * lap
    assert route.heading[0] - np.interp(lap, 5.0 * np.arange(len(route.heading)), route.heading) == pytest.approx(
        2 * np.pi, abs=0.05
    )
    assert np.std(truth.grade) == pytest.approx(0.01, rel=0.4)
    np.testing.assert_allclose(truth.altitude[second], again, atol=0.5)
    np.testing.assert_array_equal(route.grade[:points], route.grade[points : 2 * points])


@pytest.mark.slow
def test_a_cycle_becomes_a_road_with_its_speeds():
    rng = np.random.default_rng(2)
    route = cycle_route(HWFET, 16e3, rng)
    truth = drive(Truck(mass=13e3, A=800.0, C=3.0), route, 800.0, rng)
    t, v = np.loadtxt(HWFET, delimiter=",", skiprows=3, unpack=True)
    place = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    cruising = (truth.v > 10.0) & (truth.s > 2000.0) & (truth.s < 15_000.0)
    wanted = np.interp(truth.s, place, v)

    assert route.length == pytest.approx(16_500.0, rel=0.01)  # EPA: 10.26 miles
    assert np.median((truth.v / np.maximum(wanted, 0.1))[cruising]) == pytest.approx(0.95, abs=0.05)
    np.testing.assert_allclose(route.section_speed.max(), v.max())


def test_a_cycle_with_stops_and_grade(tmp_path):
    rows = [(0, 0, 0.0), (20, 0, 0.0), (60, 12, 0.01), (120, 12, 0.02), (160, 0, 0.0), (190, 0, 0.0), (191, 0, 0.0)]
    path = tmp_path / "c.csv"
    path.write_text("t_s,v_mps,grade\n" + "".join(f"{t},{v},{g}\n" for t, v, g in rows))
    route = cycle_route(path, 3000.0, np.random.default_rng(0))

    np.testing.assert_allclose(route.stop_position, [1200.0, 2400.0, 3600.0])
    np.testing.assert_allclose(route.stop_dwell[:2], [32.0 + 21.0, 32.0 + 21.0])
    assert route.grade.max() == pytest.approx(0.02, rel=0.05)


def test_a_cycle_by_distance(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("s_m,v_mps\n0,5\n500,15\n900,0\n1000,10\n1500,10\n")
    route = cycle_route(path, 1500.0, np.random.default_rng(0))

    np.testing.assert_allclose(route.stop_position, [900.0, 1500.0])
    np.testing.assert_allclose(route.section_speed, [5.0, 15.0, 10.0, 10.0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t_s,speed\n0,1\n", "v_mps"),
        ("", "v_mps"),
        ("t_s,v_mps\n0,1\n1,x\n", "number"),
        ("t_s,v_mps\n0,1\n1\n", "number"),
        ("t_s,v_mps\n0,1\n0,2\n", "rise"),
        ("t_s,v_mps\n0,-1\n9,2\n", "negative"),
        ("t_s,v_mps\n0,nan\n9,2\n", "finite"),
        ("t_s,v_mps\n0,1\n9,2\n", "m long"),
    ],
)
def test_what_is_no_cycle_is_refused(tmp_path, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as error:
        cycle_route(path, 1000.0, np.random.default_rng(0))
    assert "bad.csv" in str(error.value)


def test_a_missing_cycle_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.csv"):
        cycle_route(tmp_path / "nowhere.csv", 1000.0, np.random.default_rng(0))


@pytest.mark.slow
def test_a_cycle_can_be_driven_there_and_back():
    rng = np.random.default_rng(2)
    route = shaped(cycle_route(HWFET, 40e3, rng), 1200.0, "out-and-back")
    truth = drive(TRUCK, route, 1200.0, rng, [Effect(name="grade", magnitude=0.008)])

    assert truth.s[-1] > 0.85 * route.length
    assert truth.v.max() > 20.0
