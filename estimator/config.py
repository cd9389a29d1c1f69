"""The configuration: one TOML file, every key typed, ranged and defaulted here; unknown keys are errors."""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from estimator.errors import ConfigError
from estimator.signals import Role

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=1)]
Address = Annotated[int, Meta(ge=0, le=253)]
Range = tuple[float, float]

J1939_BINDING: dict[str, str | list[str]] = {
    Role.SPEED: "CCVS1.WheelBasedVehicleSpeed",
    Role.ENGINE_SPEED: "EEC1.EngSpeed",
    Role.TORQUE_FRACTION: "EEC1.ActualEngPercentTorque",
    Role.TORQUE_FRACTION_FINE: "EEC1.ActualEngPercentTorqueFractional",
    Role.FRICTION_FRACTION: "EEC3.NominalFrictionPercentTorque",
    Role.REFERENCE_TORQUE: "EC1.EngReferenceTorque",
    Role.GEAR: "ETC2.TransCurrentGear",
    Role.BRAKE_SWITCH: "CCVS1.BrakeSwitch",
    Role.BRAKE_PEDAL: "EBC1.BrakePedalPosition",
    Role.CLUTCH_SWITCH: "CCVS1.ClutchSwitch",
    Role.SHIFT_IN_PROCESS: "ETC1.TransShiftInProcess",
    Role.DRIVELINE_ENGAGED: "ETC1.TransDrivelineEngaged",
    Role.RETARDER_FRACTION: "ERC1.ActualRetarderPercentTorque",
    Role.AMBIENT_TEMPERATURE: "AMB.AmbientAirTemperature",
    Role.AIR_PRESSURE: "AMB.BarometricPressure",
    Role.ALTITUDE: "VDS.Altitude",
    Role.HEADING: "VDS.CompassBearing",
    Role.GPS_SPEED: "VDS.NavigationBasedVehicleSpeed",
    Role.COOLANT_TEMPERATURE: "ET1.EngCoolantTemperature",
    Role.PARASITIC_FRACTION: "EEC3.EstEngParasiticLossesPercentTorque",
}


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all tables: immutable, and strict about its keys."""


class Vehicle(Section, frozen=True):
    """What is known of the vehicle beforehand."""

    driveline_efficiency: Annotated[float, Meta(gt=0, le=1)] = 1.0  # wheel power over crank power
    reference_torque_Nm: Positive | None = None  # instead of the EC1 broadcast
    subtract_parasitic_losses: bool = False  # some ECUs already count them as friction


class Bus(Section, frozen=True):
    """How traffic is decoded: databases, and which source address may speak for a message."""

    dbc: list[str] = []  # paths relative to the configuration file; empty: the shipped j1939.dbc
    match: Literal["auto", "pgn", "id"] = "auto"  # auto: by PGN where the DBC says J1939
    source_addresses: dict[str, Address] = {}  # MESSAGE = address; others lock on the first valid sender


class Kinematics(Section, frozen=True):
    """How speed becomes acceleration."""

    acceleration: Literal["wheel_speed", "inertial"] = "wheel_speed"  # inertial: senses gravity, so grade too
    maximum_lag_s: Annotated[float, Meta(ge=0, le=2)] = 0.6  # of torque against speed, searched on either side


class Admission(Section, frozen=True):
    """Which samples may enter the window."""

    minimum_speed_m_s: NotNegative = 1.0
    margin_s: NotNegative = 1.5  # kept away from brake use, shifts and gaps, on either side
    power_sigmas: NotNegative = 3.0  # model power must exceed this many sd of the residual


class Window(Section, frozen=True):
    """What is remembered."""

    samples: Annotated[int, Meta(ge=600, le=1_000_000)] = 36_000  # at 10 Hz: an hour of admitted driving
    hours: Positive = 24.0


class Gate(Section, frozen=True):
    """When an estimate may be made."""

    interval_s: Annotated[float, Meta(ge=5)] = 60.0  # between updates, message time
    minimum_samples: Count = 1200
    minimum_cells: Count = 8  # occupied cells of the speed x acceleration grid
    cell_count: Count = 10  # samples that make a cell occupied
    coverage: Fraction = 0.15
    speed_step_m_s: Positive = 2.5
    acceleration_step_m_s2: Positive = 0.1
    new_samples: Fraction = 0.02  # share of the window that must be new since the last estimate
    relative_sd: tuple[Positive, Positive, Positive] = (0.5, 0.5, 0.1)  # largest predicted, of A, C, m


class Prior(Section, frozen=True):
    """Box priors: the posterior lives inside."""

    mass_kg: Range = (500.0, 100_000.0)
    A_N: Range = (0.0, 10_000.0)
    C_N_s2_m2: Range = (0.0, 20.0)


class Sampler(Section, frozen=True):
    """Metropolis-Hastings."""

    likelihood: Literal["instruments", "paper"] = "instruments"
    kernel: Literal["independence", "random_walk"] = "independence"
    chains: Annotated[int, Meta(ge=2, le=1024)] = 64
    burn_in: Count = 20
    draws: Annotated[int, Meta(ge=8)] = 100  # kept, per chain
    seed: int = 1


class Publish(Section, frozen=True):
    """What is broadcast."""

    source_address: Address = 0xFB
    priority: Annotated[int, Meta(ge=0, le=7)] = 6
    status_period_s: Positive = 1.0
    value_period_s: Positive = 10.0
    stale_after_s: Positive = 3600.0
    cvw: bool = False  # combination vehicle weight, PGN 65136


class Config(Section, frozen=True):
    """The whole file."""

    vehicle: Vehicle = Vehicle()
    bus: Bus = Bus()
    signals: dict[str, str | list[str]] = {}
    kinematics: Kinematics = Kinematics()
    admission: Admission = Admission()
    window: Window = Window()
    gate: Gate = Gate()
    prior: Prior = Prior()
    sampler: Sampler = Sampler()
    publish: Publish = Publish()

    @property
    def binding(self) -> dict[str, str | list[str]]:
        """Role to ``MESSAGE.signal``: the file's own, or J1939 where it names none."""
        return self.signals or J1939_BINDING


def _check(config: Config) -> None:
    for name, (low, high) in msgspec.structs.asdict(config.prior).items():
        if not low < high:
            raise ConfigError(f"prior.{name}: the box is empty: {low} is not below {high}")
        if low < 0:
            raise ConfigError(f"prior.{name}: a road-load parameter cannot be negative, {low} is")
    known = {role.value for role in Role}
    for role, bound in config.signals.items():
        if role not in known:
            raise ConfigError(f"signals.{role}: no such role; the roles are {', '.join(sorted(known))}")
        if isinstance(bound, list) and role != Role.WHEEL_SPEEDS:
            raise ConfigError(f"signals.{role}: takes one MESSAGE.signal; only wheel_speeds takes a list")
        for signal in [bound] if isinstance(bound, str) else bound:
            if signal.count(".") != 1:
                raise ConfigError(f"signals.{role}: {signal!r} is not of the form MESSAGE.signal")


def from_dict(tables: dict[str, Any]) -> Config:
    """Build and check a configuration from parsed tables.

    Raises
    ------
    ConfigError
        An unknown key, a wrong type or a value out of range; the message names the key.
    """
    try:
        config = msgspec.convert(tables, Config)
    except msgspec.ValidationError as error:
        reason, _, place = str(error).partition(" - at `$")
        key = place.rstrip("`").lstrip(".")
        raise ConfigError(f"{key}: {reason}" if key else reason) from error
    _check(config)
    return config


def load(path: Path | None) -> Config:
    """Read a TOML file, or the defaults when there is none; DBC paths become relative to the file.

    Raises
    ------
    ConfigError
        The file is missing, not TOML, or wrong.
    """
    if path is None:
        return Config()
    try:
        with path.open("rb") as file:
            tables = tomllib.load(file)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        config = from_dict(tables)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    databases = [str(path.parent / name) for name in config.bus.dbc]
    return msgspec.structs.replace(config, bus=msgspec.structs.replace(config.bus, dbc=databases))


def replace(config: Config, **sections: Section) -> Config:
    """A copy of ``config`` with whole tables exchanged."""
    return msgspec.structs.replace(config, **sections)
