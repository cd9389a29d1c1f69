"""Tables without a brake signal: braking that the power does not show is left out, at any rate of rows."""

from pathlib import Path

import numpy as np
import pytest

from estimator import estimate, read

MASS, A, C = 2800.0, 300.0, 0.9
COLUMNS = {"time": "t [s]", "speed": "v [km/h]", "power": "P [kW]"}


def braking(path: Path, seed: int, rate: float) -> Path:
    """A van on a level road for 25 min, with friction brakes and 150 W of noise in the power, at ``rate`` [1/s]."""
    rng, n, step = np.random.default_rng(seed), 15_000, 0.1
    v, P, wanted = np.zeros(n + 1), np.zeros(n), 8.0
    for k in range(n):
        if k % 250 == 0:
            wanted = rng.uniform(0.0, 25.0) if rng.random() < 0.9 else 0.0
        a = float(np.clip(0.3 * (wanted - v[k]), -2.0, 1.2)) if v[k] > 0 or wanted > 2 else 0.0
        force = MASS * a + A + C * v[k] ** 2
        P[k] = max(force, 0.0) * v[k] if v[k] > 0 else 0.0
        v[k + 1] = max(v[k] + a * step, 0.0)
    every = round(1 / (rate * step))
    t = step * np.arange(n)[::every]
    speed = 3.6 * (v[:-1] + rng.normal(0.0, 0.02, n))[::every]
    power = 1e-3 * (P + rng.normal(0.0, 150.0, n))[::every]
    lines = ["t,v,P", *(f"{a:.2f},{b:.3f},{c:.4f}" for a, b, c in zip(t, np.maximum(speed, 0.0), power, strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("rate", [2.0, 5.0])
def test_the_mass_is_right_though_the_brake_is_on_no_bus(rate: float, tmp_path: Path) -> None:
    final = estimate(read(braking(tmp_path / "van.csv", 3, rate), columns=COLUMNS)).final
    assert final.mass is not None
    assert abs(final.mass.mean - MASS) < 3 * final.mass.sd
    assert final.mass.mean == pytest.approx(MASS, rel=0.05)
