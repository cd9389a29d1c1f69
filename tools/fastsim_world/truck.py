"""A class-8 truck in fastsim, and its drives."""

from dataclasses import dataclass

import numpy as np

from estimator.errors import RoadloadError
from estimator.signals import Floats, Mask
from estimator.units import STANDARD_GRAVITY
from fastsim_world.roads import STEP, Road

LAUNCH = 1.0  # m/s^2
RESERVE = 0.9  # share of the engine's power that the driver plans with
CRAWL = 0.5  # m/s, below which the schedule advances by its own time and not by distance
BRAKE_POWER = 500.0  # W, negative power at the wheels beyond which the brakes are taken as applied


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A class-8 truck in fastsim's terms; masses [kg], areas [m^2], powers [W], inertia of one wheel [kg m^2]."""

    mass: float
    rolling_coefficient: float
    drag_coefficient: float
    auxiliary_power: float
    driveline_efficiency: float
    frontal_area: float = 10.0
    rated_power: float = 400e3
    wheels: int = 10
    wheel_inertia: float = 11.0
    wheel_radius: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Drive of a road by fastsim, arrays (n,).

    ``t`` [s], ``v`` [m/s], ``grade`` [1], ``altitude`` [m], and where wheels are ``braking``; ``power`` [W] of the
    engine at ``t_power`` [s], the middles of the steps (n - 1,); ``C`` [N s^2/m^2] by fastsim's density of the air.
    """

    t: Floats
    v: Floats
    grade: Floats
    altitude: Floats
    t_power: Floats
    power: Floats
    braking: Mask
    C: float


def draw_vehicle(rng: np.random.Generator) -> Vehicle:
    """A loaded or half-loaded class-8 truck."""
    return Vehicle(
        mass=rng.uniform(16e3, 34e3),
        rolling_coefficient=rng.uniform(0.0052, 0.0075),
        drag_coefficient=rng.uniform(0.52, 0.68),
        auxiliary_power=rng.uniform(4e3, 9e3),
        driveline_efficiency=rng.uniform(0.91, 0.95),
    )


def followed(vehicle: Vehicle, road: Road) -> Road:
    """The road at speeds that this truck can reach: with too little power it takes longer for the same distance."""
    C = 0.6 * vehicle.drag_coefficient * vehicle.frontal_area
    most = RESERVE * vehicle.driveline_efficiency * (vehicle.rated_power - vehicle.auxiliary_power)
    speeds, grades = [0.0], [float(road.grade[0])]
    clock, v = 0.0, 0.0
    while clock < len(road.v) - 1:
        i = int(clock)
        wanted, grade = float(road.v[i]), float(road.grade[i])
        resistance = vehicle.mass * STANDARD_GRAVITY * (vehicle.rolling_coefficient + grade) + C * v * v
        room = min(LAUNCH, (most / max(v, 2.0) - resistance) / (1.03 * vehicle.mass))
        v = max(min(wanted, v + room * STEP), 0.0)
        clock += v / wanted if wanted > CRAWL and v > CRAWL / 2 else 1.0
        speeds.append(v)
        grades.append(grade)
    return Road(np.array(speeds), np.array(grades))


def simulate(vehicle: Vehicle, road: Road) -> Drive:
    """Simulate a drive of the road with fastsim.

    Raises
    ------
    RoadloadError
        fastsim is not installed, or its truck could not follow.
    """
    try:
        import fastsim
    except ImportError as error:
        raise RoadloadError("fastsim is missing: pip install -r tools/fastsim_world/requirements.txt") from error
    car = fastsim.Vehicle.from_resource("2012_Ford_Fusion.yaml").to_dict()
    engine, gearbox = car["pt_type"]["Conv"]["fc"], car["pt_type"]["Conv"]["transmission"]
    engine |= {"pwr_out_max_watts": vehicle.rated_power, "pwr_out_max_init_watts": vehicle.rated_power}
    engine["pwr_ramp_lag_seconds"] = 0.5
    gearbox["eff_interp"] = vehicle.driveline_efficiency
    car["pt_type"]["Conv"]["fs"] |= {"pwr_out_max_watts": 4e6, "energy_capacity_joules": 1e11}
    car["chassis"] |= {
        "drag_coef": vehicle.drag_coefficient,
        "frontal_area_square_meters": vehicle.frontal_area,
        "wheel_rr_coef": vehicle.rolling_coefficient,
        "wheel_inertia_kilogram_square_meters": vehicle.wheel_inertia,
        "num_wheels": vehicle.wheels,
        "wheel_radius_meters": vehicle.wheel_radius,
        "cg_height_meters": 1.5,
        "wheel_base_meters": 6.0,
        "drive_type": "RWD",
        "drive_axle_weight_frac": 0.6,
        "glider_mass_kilograms": None,
        "cargo_mass_kilograms": None,
    }
    car |= {"name": "class 8", "mass_kilograms": vehicle.mass, "pwr_aux_base_watts": vehicle.auxiliary_power}
    t = np.arange(len(road.v)) * STEP
    table = {"time_seconds": t, "speed_meters_per_second": road.v, "grade": road.grade}
    cycle = fastsim.Cycle.from_dict({name: values.tolist() for name, values in table.items()} | {"init_elev_meters": 0})
    run = fastsim.SimDrive(fastsim.Vehicle.from_dict(car), cycle)
    try:
        run.run()
    except RuntimeError as error:
        reason = next((line for line in str(error).splitlines() if "deficit" in line), str(error).splitlines()[0])
        raise RoadloadError(f"fastsim: the truck cannot follow the road: {reason.strip()}") from error
    history = run.to_dataframe()

    def column(name: str) -> Floats:
        values: Floats = history[name].to_numpy().astype(np.float64)
        return values

    v = column("veh.history.speed_ach_meters_per_second")
    propulsion, auxiliaries = (column(f"veh.pt_type.Conv.fc.history.pwr_{part}_watts")[1:] for part in ("prop", "aux"))
    middle = (v[1:] + v[:-1]) / 2
    return Drive(
        t=t,
        v=v,
        grade=road.grade,
        altitude=np.concatenate([[0.0], np.cumsum(road.grade[1:] * middle * STEP)]),
        t_power=t[1:] - STEP / 2,
        power=propulsion + auxiliaries,
        braking=column("veh.history.pwr_tractive_watts") < -BRAKE_POWER,
        C=float(column("veh.history.pwr_drag_watts")[1:].sum() / (middle**3).sum()),
    )
