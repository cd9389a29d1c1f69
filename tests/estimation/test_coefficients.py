"""c_rr, c_d A and coast-down coefficients: what they are, where they are shown, and when they are withheld."""

import dataclasses
import json
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_fleets import made
from made_outputs import made_evidence, made_view
from rich.console import Console
from simulated_logs import TRUCK, ask, drive, written

from estimator.commands.estimate_table import print_estimate
from estimator.estimates import Estimate, Marginal, Status
from estimator.fleet.drive_result import DriveResult
from estimator.fleet.rows import drive_rows, vehicle_rows
from estimator.report import summary
from estimator.roles import Role
from estimator.units import STANDARD_DENSITY, STANDARD_GRAVITY

AIR = (Role.AMBIENT_TEMPERATURE, Role.AIR_PRESSURE)


def final() -> Estimate:
    """An estimate of all three."""
    return made_view().final


def printed(estimate: Estimate, width: int = 100) -> str:
    """The table on a terminal of ``width`` columns."""
    out = StringIO()
    print_estimate(
        Console(file=out, width=width), summary.parameters(estimate), summary.coefficients(estimate), {"mass": 20e3}
    )
    return out.getvalue()


def test_c_rr_is_the_ratio_of_the_draws() -> None:
    """Its interval allows for the correlation of A and m, which a formula of means and sds would not."""
    posterior = made_evidence().posterior
    draws = posterior.draws.copy()
    draws[:, :, 0] = 0.006 * STANDARD_GRAVITY * draws[:, :, 2]  # A follows m: the ratio is known exactly
    c_rr = dataclasses.replace(posterior, draws=draws).c_rr
    assert c_rr.mean == pytest.approx(0.006)
    assert c_rr.sd < 1e-12
    found = posterior.c_rr
    ratio = posterior.draws[:, :, 0] / posterior.draws[:, :, 2] / STANDARD_GRAVITY
    assert [found.q05, found.q50, found.q95] == pytest.approx(np.quantile(ratio, [0.05, 0.5, 0.95]))


def test_the_same_force_in_all_terms() -> None:
    estimate = final()
    found = summary.coefficients(estimate)
    assert estimate.A is not None
    assert estimate.C is not None
    v = np.array([5.0, 15.0, 25.0])  # m/s
    force = estimate.A.mean + estimate.C.mean * v**2
    down = found.coast_down
    assert down.F0_N.mean + down.F1_N_h_km * 3.6 * v + down.F2_N_h2_km2.mean * (3.6 * v) ** 2 == pytest.approx(force)
    drag = 0.5 * found.air_density_kg_m3 * found.c_d_A_m2.mean * v**2
    assert estimate.A.mean + drag == pytest.approx(force)
    for derived, C in ((found.c_d_A_m2, estimate.C), (down.F2_N_h2_km2, estimate.C)):
        assert derived.sd / derived.mean == pytest.approx(C.sd / C.mean)


def test_the_density_is_that_of_the_air_or_the_standard_s() -> None:
    assert summary.coefficients(final()).is_density_measured
    assert summary.coefficients(final()).air_density_kg_m3 == pytest.approx(1.2)
    blank = summary.coefficients(dataclasses.replace(final(), air_density=None))
    assert not blank.is_density_measured
    assert blank.air_density_kg_m3 == STANDARD_DENSITY
    text = printed(dataclasses.replace(final(), air_density=None))
    assert "1.225 kg/m³ of standard air, for no signal shows the density" in " ".join(text.split())
    assert "standard" not in printed(final())


@pytest.mark.parametrize("missing", ["A", "C"])
def test_what_rests_on_a_withheld_parameter_is_withheld(missing: str) -> None:
    estimate = dataclasses.replace(final(), withheld={missing: "too uncertain"}, **{missing: None})
    found = summary.coefficients(estimate)
    with_A, with_C = (found.c_rr, found.coast_down.F0_N), (found.c_d_A_m2, found.coast_down.F2_N_h2_km2)
    for parameters, name in ((with_A, "A"), (with_C, "C")):
        for x in parameters:
            assert (x.mean is None) == (name == missing)
            assert x.status is (Status.UNESTIMATED if name == missing else Status.ESTIMATED)
            assert x.reason == ("too uncertain" if name == missing else "")
    text = printed(estimate)
    assert ("c_rr" in text) == (missing == "C")
    assert ("c_d A  " in text) == (missing == "A")
    assert ("F0 unestimated" if missing == "A" else "F2 unestimated") in text


def test_nothing_is_shown_of_a_value_that_may_not_be_used() -> None:
    """The daemon takes the values out of what it publishes; what follows from them goes too."""
    cleared = dataclasses.replace(final(), mass=None, A=None, C=None, status=Status.INVALID)
    conclusion = summary.conclusion(cleared, cleared.t, cleared.t)
    assert conclusion is not None
    found = conclusion.coefficients
    assert found is not None
    down = found.coast_down
    assert [x.mean for x in (found.c_rr, found.c_d_A_m2, down.F0_N, down.F2_N_h2_km2)] == [None] * 4


@pytest.mark.parametrize("width", [100, 40])
def test_the_terminal_shows_them(width: int) -> None:
    text, estimate = printed(final(), width), final()
    assert estimate.c_rr is not None
    assert f"{100 * estimate.c_rr.mean:.3f} %" in text
    assert "F1 0" in text
    assert "N/(km/h)²" in text


def test_the_tables_of_a_fleet_have_them() -> None:
    fleet = made(2, 3, 1).fleet
    results = []
    for result in fleet.results:
        (segment,) = result.segments
        density = 1.1 if segment.start == max(r.segments[0].start for r in fleet.results) else None
        c_rr = Marginal(mean=0.006, sd=1e-4, q05=0.0058, q50=0.006, q95=0.0062)
        results.append(DriveResult(segments=(dataclasses.replace(segment, c_rr=c_rr, air_density=density),)))
    fleet = dataclasses.replace(fleet, results=tuple(results))
    rows = drive_rows(fleet)
    for row in (row for row in rows if row["status"] == "estimated"):
        assert row["c_rr_mean"] == 0.006
        assert row["c_d_A_m2_mean"] == pytest.approx(2 * row["C_N_s2_m2_mean"] / row.get("air_density_kg_m3", 1.225))
    measured, other = sorted(vehicle_rows(fleet, 0.05), key=lambda row: "air_density_kg_m3" not in row)
    assert measured["air_density_kg_m3"] == 1.1
    assert measured["c_d_A_m2_mean"] == pytest.approx(2 * measured["C_N_s2_m2_mean"] / 1.1)
    assert other["c_d_A_m2_mean"] == pytest.approx(2 * other["C_N_s2_m2_mean"] / 1.225)
    assert measured["c_rr_mean"] == pytest.approx(measured["A_per_mass_N_kg_mean"] / STANDARD_GRAVITY)


@pytest.mark.slow
@pytest.mark.parametrize("without", [(), AIR])
def test_the_truth_of_a_simulated_truck_is_found(tmp_path: Path, without: tuple[Role, ...]) -> None:
    """In `--json` and from the draws: c_rr of the truck, and the drag area in the air that was measured or assumed."""
    log, draws = written(drive("mixed", 13, 11, without=without), tmp_path / "drive.blf"), tmp_path / "draws.json"
    answer = ask("estimate", log, "--draws", draws)
    found: dict[str, Any] = answer["coefficients"]
    assert found["is_density_measured"] == (not without)
    truth = TRUCK.A / (TRUCK.mass * STANDARD_GRAVITY)
    assert found["c_rr"]["mean"] == pytest.approx(truth, abs=4 * found["c_rr"]["sd"])
    area = 2 * TRUCK.C / found["air_density_kg_m3"]
    assert found["c_d_A_m2"]["mean"] == pytest.approx(area, abs=4 * found["c_d_A_m2"]["sd"])
    posterior = json.loads(draws.read_text())["posterior"]
    ratio = np.array(posterior["A_N"]) / np.array(posterior["mass_kg"]) / STANDARD_GRAVITY
    assert found["c_rr"]["q95"] == pytest.approx(np.quantile(ratio, 0.95))
