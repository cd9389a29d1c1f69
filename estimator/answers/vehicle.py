"""A vehicle of a fleet for other programs: road load, and the same in the terms of simulators and range planners."""

from msgspec import Struct

from estimator.answers.answer import Answer


class Value(Struct, frozen=True, kw_only=True):
    """Mean and standard deviation."""

    mean: float
    sd: float


class Shared(Struct, frozen=True, kw_only=True):
    """Mean that the drives of the vehicle share, with its sd, and the sd of single drives around it."""

    mean: float
    sd: float
    scatter: float


class CoastDown(Struct, frozen=True, kw_only=True):
    """Force over the speed in km/h at the mean mass: F = F0 + F1 v + F2 v^2, as range planners take it."""

    F0_N: float
    F1_N_h_km: float
    F2_N_h2_km2: float


class FastsimChassis(Struct, frozen=True, kw_only=True):
    """Keys of ``chassis`` of a FASTSim 3 vehicle.

    The mass contains what rotates, so the wheels have no inertia. Only the product of drag coefficient and frontal
    area counts.
    """

    drag_coef: float
    frontal_area_square_meters: float
    wheel_rr_coef: float
    wheel_inertia_kilogram_square_meters: float
    glider_mass_kilograms: None
    cargo_mass_kilograms: None


class Fastsim(Struct, frozen=True, kw_only=True):
    """Keys of a FASTSim 3 vehicle; ``chassis`` is to be merged into its own."""

    mass_kilograms: float
    chassis: FastsimChassis


class Vecto(Struct, frozen=True, kw_only=True):
    """Values of a VECTO engineering vehicle: ``CdA`` [m^2], and ``RRCISO`` of all tyres.

    ``RRCISO`` holds where ``FzISO`` is the load of the tyre at the mean mass.
    """

    CdA: float
    RRCISO: float


class VehicleAnswer(Answer, frozen=True, kw_only=True):
    """A vehicle over its drives: F = A + B v + C v^2 [N], v in m/s, and mass m.

    ``A_N`` is that of the mean mass of its loads, ``A_per_mass_N_kg`` of any; the road load has no linear term, so B is
    0. ``mass_kg`` is that of a load to come. Forces are those at the place where power is measured: the crank, unless
    the configuration names a driveline efficiency.
    """

    vehicle: str
    loads: int
    mass_kg: Value
    A_N: Shared
    B_N_s_m: float
    C_N_s2_m2: Shared
    A_per_mass_N_kg: Shared
    coast_down: CoastDown
    fastsim: Fastsim
    vecto: Vecto
