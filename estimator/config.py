"""The configuration: one TOML file, every key typed, ranged and defaulted here; unknown keys are errors."""

import math
import tomllib
from collections.abc import Iterator
from functools import reduce
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
Belief = tuple[Positive, Positive]
SignalPaths = str | list[str]
FREE_TABLES: dict[str, Any] = {"signals": SignalPaths, "bus.source_addresses": Address}  # keys are the user's

J1939_BINDING: dict[str, SignalPaths] = {
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
    Role.FAN_SPEED: "FD.FanSpeed",
    Role.YAW_RATE: "VDC2.YawRate",
    Role.LATERAL_ACCELERATION: "VDC2.LateralAcceleration",
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
    despike: bool = True  # replace lone gross errors of power by the median of their neighbours
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
    minimum_samples: Count = 600
    minimum_cells: Count = 8  # occupied cells of the speed x acceleration grid
    cell_count: Count = 10  # samples that make a cell occupied
    coverage: Fraction = 0.15
    speed_step_m_s: Positive = 2.5
    acceleration_step_m_s2: Positive = 0.1
    new_samples: Fraction = 0.02  # share of the window that must be new since the last estimate
    relative_sd: tuple[Positive, Positive, Positive] = (0.5, 0.5, 0.1)  # largest predicted, of A, C, m


class Load(Section, frozen=True):
    """When the load may change, and how well the vehicle is remembered across such a stop."""

    stop_s: Positive = 300.0  # standing this long starts a new load segment
    change_sd: NotNegative = 0.1  # relative sd of what A / m and C may change with the load: trailers differ
    drift_per_hour: NotNegative = 0.03  # relative sd by which A / m and C may wander, growing with the square root


class Prior(Section, frozen=True):
    """Box priors: the posterior lives inside; and beliefs as (mean, sd), e.g. from a weigh ticket or data sheet."""

    mass_kg: Range = (500.0, 100_000.0)
    A_N: Range = (0.0, 10_000.0)
    C_N_s2_m2: Range = (0.0, 20.0)
    mass_belief_kg: Belief | None = None
    A_belief_N: Belief | None = None
    C_belief_N_s2_m2: Belief | None = None


class Sampler(Section, frozen=True):
    """Metropolis-Hastings."""

    likelihood: Literal["instruments", "paper"] = "instruments"
    kernel: Literal["independence", "random_walk"] = "independence"
    chains: Annotated[int, Meta(ge=2, le=256)] = 64
    burn_in: Annotated[int, Meta(ge=1, le=20_000)] = 20  # the random walk takes more of both: it moves slowly
    draws: Annotated[int, Meta(ge=8, le=20_000)] = 100  # kept, per chain
    seed: Annotated[int, Meta(ge=0)] = 1


class Publish(Section, frozen=True):
    """What is broadcast."""

    source_address: Address = 0xFB
    priority: Annotated[int, Meta(ge=0, le=7)] = 6
    status_period_s: Positive = 1.0
    value_period_s: Positive = 10.0
    stale_after_s: Positive = 3600.0
    cvw: bool = False  # combination vehicle weight, PGN 65136


class BusOptions(Section, frozen=True):
    """Which bus, where the command line does not say it; what is missing here is looked up in can.conf."""

    interface: str | None = None  # of python-can: "socketcan", "udp_multicast", ...
    channel: str | None = None
    bitrate: Count | None = None
    context: str | None = None  # section of can.conf


class Reception(BusOptions, frozen=True):
    """How the daemon hears the bus."""

    filter: bool = True  # have the kernel pass on the wanted messages only
    buffer_bytes: Annotated[int, Meta(ge=4096, le=1 << 28)] = 4 << 20  # of the kernel, for the socket
    queue_frames: Annotated[int, Meta(ge=1000, le=10_000_000)] = 200_000  # that may wait for the estimator
    silence_s: Positive = 5.0  # without a frame: the ignition is off
    reopen_s: NotNegative = 60.0  # of silence after which a bus without a network device is opened anew; 0: never


class Transmit(BusOptions, frozen=True):
    """Whether and how the daemon sends; without a bus of its own it sends on the one it hears."""

    enabled: bool = False
    frames_per_second: Positive = 10.0  # on average; three times as many at once
    identity: Annotated[int, Meta(ge=0, lt=1 << 21)] = 1  # of the J1939 NAME: the number of this device
    manufacturer: Annotated[int, Meta(ge=0, lt=1 << 11)] = 0x7FF  # assigned by SAE; none is assigned to this project
    function: Annotated[int, Meta(ge=0, le=255)] = 255  # not available
    function_instance: Annotated[int, Meta(ge=0, le=31)] = 0
    ecu_instance: Annotated[int, Meta(ge=0, le=7)] = 0
    vehicle_system: Annotated[int, Meta(ge=0, le=127)] = 0
    vehicle_system_instance: Annotated[int, Meta(ge=0, le=15)] = 0
    industry_group: Annotated[int, Meta(ge=0, le=7)] = 1  # on-highway
    arbitrary_address: bool = True  # take another address when the preferred one is lost


class Service(Section, frozen=True):
    """Where the daemon keeps what it knows."""

    state_directory: str | None = None  # default: that of systemd, else the user's own
    runtime_directory: str | None = None  # of the status file; default: that of systemd, else the user's own
    save_interval_s: Annotated[float, Meta(ge=10)] = 60.0  # at most that much is lost with the power
    metrics: str | None = None  # file for the node exporter of Prometheus


class Config(Section, frozen=True):
    """The whole file."""

    effects: list[str] = []  # beyond the plain road load, by their names in the catalogue
    vehicle: Vehicle = Vehicle()
    bus: Bus = Bus()
    signals: dict[str, SignalPaths] = {}
    kinematics: Kinematics = Kinematics()
    admission: Admission = Admission()
    window: Window = Window()
    gate: Gate = Gate()
    load: Load = Load()
    prior: Prior = Prior()
    sampler: Sampler = Sampler()
    publish: Publish = Publish()
    reception: Reception = Reception()
    transmit: Transmit = Transmit()
    service: Service = Service()

    @property
    def binding(self) -> dict[str, SignalPaths]:
        """Role to ``MESSAGE.signal``: the file's own, or J1939 where it names none."""
        return self.signals or J1939_BINDING


def check(config: Config) -> None:
    """Complain about tables that contradict each other.

    Raises
    ------
    ConfigError
        The message names the key.
    """
    prior = config.prior
    boxes = {"mass_kg": prior.mass_belief_kg, "A_N": prior.A_belief_N, "C_N_s2_m2": prior.C_belief_N_s2_m2}
    for name, belief in boxes.items():
        low, high = getattr(prior, name)
        if not low < high:
            raise ConfigError(f"prior.{name}: the box is empty: {low} is not below {high}")
        if low < 0:
            raise ConfigError(f"prior.{name}: a road-load parameter cannot be negative, {low} is")
        if belief is not None and not low <= belief[0] <= high:
            raise ConfigError(f"prior.{name}: the box [{low}, {high}] excludes the belief {belief[0]}")
        if belief is not None and config.sampler.likelihood == "paper":
            raise ConfigError('sampler.likelihood: "paper" knows boxes only; take the beliefs out of [prior]')
    if config.effects and config.sampler.likelihood == "paper":
        raise ConfigError('sampler.likelihood: "paper" knows the plain road load only; take the effects out')
    if "grade" in config.effects and config.kinematics.acceleration == "inertial":
        raise ConfigError('kinematics.acceleration: "inertial" feels the grade already; take it out of the effects')
    known = {role.value for role in Role}
    for role, bound in config.signals.items():
        if role not in known:
            raise ConfigError(f"signals.{role}: no such role; the roles are {', '.join(sorted(known))}")
        if isinstance(bound, list) and role != Role.WHEEL_SPEEDS:
            raise ConfigError(f"signals.{role}: takes one MESSAGE.signal; only wheel_speeds takes a list")
        if not bound:
            raise ConfigError(f"signals.{role}: is empty; leave it out, or write MESSAGE.signal")
        for signal in [bound] if isinstance(bound, str) else bound:
            message, _, name = signal.partition(".")
            if not message or not name or "." in name:
                raise ConfigError(f"signals.{role}: {signal!r} is not of the form MESSAGE.signal")


def from_dict(tables: dict[str, Any]) -> Config:
    """Build and check a configuration from parsed tables.

    Raises
    ------
    ConfigError
        An unknown key, a wrong type or a value out of range; the message names the key.
    """
    for place, value in _leaves(tables, ""):
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{place}: {value} is not a number that can be used here")
    try:
        config = msgspec.convert(tables, Config)
    except msgspec.ValidationError as error:
        reason, _, place = str(error).partition(" - at `$")
        key = _named(place.rstrip("`").lstrip("."), tables)
        raise ConfigError(f"{key}: {reason}" if key else reason) from error
    check(config)
    return config


def _leaves(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """All values that are neither tables nor lists, and where they stand."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{place}.{key}" if place else key)
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _leaves(inner, f"{place}[{i}]")
    else:
        yield place, value


def _named(place: str, tables: dict[str, Any]) -> str:
    """``place`` with the key of a free table, for which msgspec writes ``[...]``."""
    table, gap, rest = place.partition("[...]")
    if gap:
        for key, value in reduce(dict.__getitem__, table.split("."), tables).items():
            try:
                msgspec.convert(value, FREE_TABLES[table])
            except msgspec.ValidationError:
                return f"{table}.{key}{rest}"
    return place


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
    except (ValueError, RecursionError) as error:  # also bytes that are not UTF-8, and numbers of thousands of digits
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
