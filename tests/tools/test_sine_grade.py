"""A road whose grade is a sine, which no signal shows: what is told of it, and of the truck."""

import numpy as np
import pytest


@pytest.fixture
def tool():
    import check_sine_grade

    return check_sine_grade


@pytest.mark.nightly
@pytest.mark.slow
def test_a_hidden_sine_has_its_amplitude_and_the_truck_its_mass(tool, tmp_path):
    world = tool.World(mass=18e3, amplitude=0.02, length=2000.0, shown="hidden")
    found = tool.score(world, world.drive(25.0, np.random.default_rng(5)), tmp_path)
    assert found["holds"]
    assert found["amplitude_found"] == pytest.approx(0.02, rel=0.05)
    assert found["named"] == ["grade"]
    assert found["found"][0] == pytest.approx(found["share"], abs=0.02)
    assert "2 %, 2000 m" in tool.row(found)
