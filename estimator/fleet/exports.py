"""Export of a vehicle for simulators and range planners."""

from estimator.answers.vehicle import CoastDown, Fastsim, FastsimChassis, Shared, Value, Vecto, VehicleAnswer
from estimator.estimates import Marginal, drag_area
from estimator.fleet.vehicles import DRAG, ROLLING, VehicleResult
from estimator.units import KMH, STANDARD_GRAVITY

FASTSIM_DENSITY = 1.2  # kg/m^3, of FASTSim 3.1 by default, at any elevation
VECTO_DENSITY = 1.188  # kg/m^3, of VECTO: its reference for the air drag
FRONTAL_AREA = 10.0  # m^2, about that of a truck; the drag coefficient goes with it


def export(result: VehicleResult) -> VehicleAnswer | None:
    """Export a vehicle; None if A/m or C is not estimated.

    C is converted to a drag area with the air density of each program, so that the program computes an equal force.
    """
    if result.rolling is None or result.drag is None or result.load is None:
        return None
    mass, mass_sd = result.load
    C, rolling = result.drag.mean, result.rolling.mean
    coefficient = rolling / STANDARD_GRAVITY
    return VehicleAnswer(
        vehicle=result.vehicle,
        loads=len(result.masses),
        mass_kg=Value(mean=mass, sd=mass_sd),
        A_N=_shared(result.rolling, result.scatter[ROLLING], mass),
        B_N_s_m=0.0,
        C_N_s2_m2=_shared(result.drag, result.scatter[DRAG]),
        A_per_mass_N_kg=_shared(result.rolling, result.scatter[ROLLING]),
        coast_down=CoastDown(F0_N=rolling * mass, F1_N_h_km=0.0, F2_N_h2_km2=C / KMH**2),
        fastsim=Fastsim(
            mass_kilograms=mass,
            chassis=FastsimChassis(
                drag_coef=drag_area(result.drag, FASTSIM_DENSITY).mean / FRONTAL_AREA,
                frontal_area_square_meters=FRONTAL_AREA,
                wheel_rr_coef=coefficient,
                wheel_inertia_kilogram_square_meters=0.0,
                glider_mass_kilograms=None,
                cargo_mass_kilograms=None,
            ),
        ),
        vecto=Vecto(CdA=drag_area(result.drag, VECTO_DENSITY).mean, RRCISO=coefficient),
    )


def _shared(marginal: Marginal, scatter: float, factor: float = 1.0) -> Shared:
    return Shared(mean=factor * marginal.mean, sd=factor * marginal.sd, scatter=factor * scatter)
