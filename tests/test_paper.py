"""The paper's dummy case and Table 5, from shipped data alone."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def tools(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "tools"))


def test_cycles_are_those_described():
    from paper.cycles import commut, hwfet
    from paper.vehicles import MPH

    assert (commut().duration, commut().v.max() / MPH) == (330, pytest.approx(55))
    assert commut().miles == pytest.approx(4.0, abs=0.005)
    assert (hwfet().duration, hwfet().v.max() / MPH) == (766, pytest.approx(59.9))
    assert hwfet().miles == pytest.approx(10.26, abs=0.005)


@pytest.mark.parametrize("cycle", ["hwfet", "commut"])
def test_dummy_case_is_recovered_from_anywhere_in_the_box(cycle):
    from paper import cycles
    from paper.experiments import dummy_case
    from paper.vehicles import DUMMY

    result = dummy_case(getattr(cycles, cycle)())
    mean, sd = result.refreshed
    assert mean == pytest.approx(DUMMY, rel=1e-4)
    assert (sd < 1e-3 * DUMMY).all()
    assert result.frozen[0] == pytest.approx(DUMMY, rel=0.02)


def test_noisy_truck_is_recovered():
    from paper.cycles import hwfet
    from paper.estimation import Drive, estimate
    from paper.vehicles import DYNO

    result = estimate(Drive.of(hwfet(), DYNO, 2e3, (1,)).positive())
    assert (np.abs(result.mean - DYNO) < 4 * result.sd).all()
    assert (result.sd < 0.02 * DYNO).all()
    assert result.r_hat < 1.02


def test_table_five():
    from paper.cycles import hwfet
    from paper.estimation import raw_metrics
    from paper.experiments import COMMON_MASS
    from paper.vehicles import DYNO

    for theta, angle in ((DYNO, 25.8), (COMMON_MASS, 22.6)):
        metrics = raw_metrics(hwfet(), theta)
        assert metrics.log10_eigenvalues == pytest.approx([13.1, 5.3, 4.7], abs=0.1)
        A, C, m = metrics.angles.min(axis=0)
        assert pytest.approx(0.020, abs=0.0005) == C
        assert pytest.approx(angle, abs=0.1) == A
        assert m == pytest.approx(A, abs=0.01)
        assert metrics.angles[0].argmin() == 1
