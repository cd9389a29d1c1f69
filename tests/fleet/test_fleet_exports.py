"""A vehicle of a fleet for other programs: the same road load in their terms, and the same energy in FASTSim."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from made_fleets import WINTER_DRAG, made

from estimator.answers.answer import decode
from estimator.answers.vehicle import VehicleAnswer
from estimator.config import Config
from estimator.fleet.exports import VECTO_DENSITY, export
from estimator.fleet.output import prepare, write_fleet
from estimator.model.road_load import design
from estimator.units import STANDARD_GRAVITY


@pytest.fixture(scope="module")
def vehicle() -> VehicleAnswer:
    exported = export(made(4, 20, 7).fleet.vehicles[0])
    assert exported is not None
    return exported


def test_every_program_gets_the_same_forces(vehicle: VehicleAnswer) -> None:
    v = np.array([5.0, 15.0, 25.0])  # m/s
    force = vehicle.A_N.mean + vehicle.B_N_s_m * v + vehicle.C_N_s2_m2.mean * v**2
    down = vehicle.coast_down
    assert down.F0_N + down.F1_N_h_km * 3.6 * v + down.F2_N_h2_km2 * (3.6 * v) ** 2 == pytest.approx(force)
    weight = vehicle.mass_kg.mean * STANDARD_GRAVITY
    assert vehicle.vecto.RRCISO * weight + VECTO_DENSITY / 2 * vehicle.vecto.CdA * v**2 == pytest.approx(force)


def test_exports_hold_the_truth_and_its_uncertainty() -> None:
    case, inside = made(20, 12, 9), []
    for found in case.fleet.vehicles:
        one = export(found)
        assert one is not None
        rolling, drag = case.truth[one.vehicle]
        for shared, truth in ((one.A_per_mass_N_kg, rolling), (one.C_N_s2_m2, drag * WINTER_DRAG)):
            inside.append(abs(shared.mean - truth) < 2 * shared.sd)
            assert shared.scatter > 0
        assert one.A_N.sd / one.A_N.mean == pytest.approx(one.A_per_mass_N_kg.sd / one.A_per_mass_N_kg.mean)
    assert np.mean(inside) > 0.8


def test_the_command_writes_one_for_each_vehicle_that_is_known(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra `fleet` is not installed")
    prepare(tmp_path)
    fleet = made(3, 4, 5).fleet
    written = write_fleet(fleet, Config(), tmp_path, 0.05)
    names = [path for path in written if path.parent.name == "exports"]
    assert [path.name for path in names] == ["truck-01.json", "truck-02.json", "truck-03.json"]
    answer = decode(names[0].read_bytes(), VehicleAnswer)
    assert answer == export(fleet.vehicles[0])
    assert answer.loads == 4


def test_fastsim_spends_the_same_energy(vehicle: VehicleAnswer) -> None:
    """Positive work at the wheels over the UDDS cycle, as FASTSim and as A v + C v^3 + m v a have it."""
    fastsim = pytest.importorskip("fastsim", reason="the simulator is not installed")
    car: dict[str, Any] = fastsim.Vehicle.from_resource("2012_Ford_Fusion.yaml").to_dict()
    values = msgspec.to_builtins(vehicle.fastsim)
    car["chassis"] |= values["chassis"]
    car["mass_kilograms"] = values["mass_kilograms"]
    engine, storage = car["pt_type"]["Conv"]["fc"], car["pt_type"]["Conv"]["fs"]
    engine |= {"pwr_out_max_watts": 1.5e6, "pwr_out_max_init_watts": 1.5e6}
    storage |= {"pwr_out_max_watts": 1e8, "energy_capacity_joules": 1e12}
    car["chassis"] |= {"wheel_fric_coef": 2.0}
    drive = fastsim.SimDrive(fastsim.Vehicle.from_dict(car), fastsim.Cycle.from_resource("udds.csv"))
    drive.run()
    history = drive.to_dict()["veh"]["history"]
    t, v, wheels = (
        np.array(history[name], dtype=float)
        for name in ("time_seconds", "speed_ach_meters_per_second", "pwr_tractive_watts")
    )
    dt, middle = np.diff(t), (v[1:] + v[:-1]) / 2
    theta = np.array([vehicle.A_N.mean, vehicle.C_N_s2_m2.mean, vehicle.mass_kg.mean])
    power = design(middle, np.diff(v) / dt) @ theta
    spent = float((np.maximum(wheels[1:], 0.0) * dt).sum())
    assert spent == pytest.approx(float((np.maximum(power, 0.0) * dt).sum()), rel=0.01)
