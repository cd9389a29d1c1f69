"""A grade that no signal shows, where an altimeter is there: what its silence is worth."""

import pytest
from simulated_logs import ask, drive, named, written

from estimator.signals import Role
from estimator.simulation.effects.effect import Effect

pytestmark = pytest.mark.slow

NO_OTHER = (Role.GRADE, Role.LONGITUDINAL_ACCELERATION)


@pytest.fixture
def diagnose(tmp_path):
    def diagnosis(kind, seed, effect, altitude_noise):
        recording = drive(kind, 20, seed, effect, without=NO_OTHER, altitude_noise=altitude_noise)
        return ask("diagnose", written(recording, tmp_path / "log.blf"))

    return diagnosis


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [1, 2])
def test_an_altimeter_too_noisy_to_show_hills_does_not_deny_them(diagnose, seed):
    answer = diagnose("highway", seed, Effect(name="grade", magnitude=0.005), 20.0)
    assert named(answer) == ["grade"]
    assert answer["effects"][0]["detail"] == "varies with place; shown in part by altitude"


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [2])
def test_on_a_rough_road_that_an_altimeter_shows_flat_there_are_no_hills(diagnose, seed):
    answer = diagnose("highway", seed, Effect(name="road_surface", magnitude=0.6), 1.0)
    assert (answer["verdict"], named(answer)) == ("unknown effect", [])


@pytest.mark.nightly
def test_a_good_altimeter_names_the_hills_itself(diagnose):
    answer = diagnose("highway", 2, Effect(name="grade", magnitude=0.005), 1.0)
    assert named(answer)[0] == "grade"
    assert answer["effects"][0]["detail"] == "varies with place; shown by altitude"


def test_a_load_taken_on_is_found_beside_hills_that_a_poor_altimeter_shows(tmp_path):
    """To the search on a level road the altimeter, which wanders by 3 m, shows no grade; the road's own slope does."""
    import check_budget

    world = check_budget.draw(7, seed=20261122, minutes=40.0)
    assert (world.shown, world.extra) == ("poor", "mass_step")
    answer = ask("diagnose", written(world.recording, tmp_path / "log.blf"))
    grade, load = answer["effects"][:2]
    assert (grade["name"], load["name"]) == ("grade", "mass_step")
    assert grade["detail"] == "varies with place; shown in part by altitude"
    assert grade["log_bayes_factor"] > 15
    (share,) = [part["share"] for part in answer["budget"] if part["cause"] == "mass_step"]
    assert share == pytest.approx(0.4, abs=0.1)
