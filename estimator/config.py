"""The configuration: one TOML file, read and checked as a whole; unknown keys are errors."""

import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import reduce
from hashlib import blake2b
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import msgspec

from estimator.errors import ConfigError, DatabaseError
from estimator.input_files import read_bounded
from estimator.near_names import did_you_mean
from estimator.roles import Role
from estimator.settings import (
    Address,
    Admission,
    Bus,
    Gate,
    Kinematics,
    Kuksa,
    Lake,
    Load,
    Mqtt,
    Prior,
    Publish,
    Range,
    Reception,
    RoadTable,
    Sampler,
    Section,
    Service,
    SignalPaths,
    Table,
    Transmit,
    Vehicle,
    Window,
)

MAX_FILE_BYTES = 1 << 20  # bytes of a configuration: an endless device or fifo does not fill the memory
MAX_DOTS = 100  # in a line of a configuration
MAX_MAP_BYTES = 256 << 20  # bytes of a map: 13 million places, more than the cells of the main roads of a continent
DAEMON_TABLES = ("publish", "reception", "transmit", "mqtt", "kuksa", "service")  # that the estimate does not depend on
FREE_TABLES: dict[str, Any] = {  # keys are the user's
    "signals": SignalPaths,
    "bus.source_addresses": Address,
    "bus.units": str,
    "bus.ranges": Range,
    "bus.states": list[int],
    "lake.units": str,
    "lake.ranges": Range,
    "table.columns": str,
    "table.alternatives": list[str],
}

TABLE_ROLES = {"power": Role.ENGINE_POWER.value, "force": Role.ENGINE_POWER.value}  # other names for them in a table
RETIRED = {  # keys and values of earlier versions, and what became of them
    "kinematics.acceleration": "is no longer needed: an accelerometer that is bound shows the slope by itself",
    "admission.margin_s": "belonged to the samples of earlier versions: admission.stride_margin_s is the margin",
    "admission.power_sigmas": "belonged to the samples of earlier versions: power of any sign is used",
    "sampler.likelihood = instruments": (
        "is no longer there: it had no road, and gave wrong masses in hills; "
        "take the key out for 'road', which has level roads too, or write 'paper'"
    ),
}

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
    Role.LATITUDE: "VP.Latitude",
    Role.LONGITUDE: "VP.Longitude",
    Role.COOLANT_TEMPERATURE: "ET1.EngCoolantTemperature",
    Role.FAN_SPEED: "FD.FanSpeed",
    Role.YAW_RATE: "VDC2.YawRate",
    Role.LATERAL_ACCELERATION: "VDC2.LateralAcceleration",
    Role.PARASITIC_FRACTION: "EEC3.EstEngParasiticLossesPercentTorque",
}


class Config(Section, frozen=True):
    """The whole file."""

    effects: list[str] = msgspec.field(default_factory=list)  # beyond the plain road load, as the catalogue names them
    vehicle: Vehicle = Vehicle()
    bus: Bus = Bus()
    lake: Lake | None = None  # logs hold decoded signals instead of frames
    table: Table | None = None  # logs are tables of measurements
    signals: dict[str, SignalPaths] = msgspec.field(default_factory=dict)
    kinematics: Kinematics = Kinematics()
    admission: Admission = Admission()
    window: Window = Window()
    gate: Gate = Gate()
    load: Load = Load()
    road: RoadTable = RoadTable()
    prior: Prior = Prior()
    sampler: Sampler = Sampler()
    publish: Publish = Publish()
    reception: Reception = Reception()
    transmit: Transmit = Transmit()
    mqtt: Mqtt | None = None
    kuksa: Kuksa | None = None
    service: Service = Service()

    @property
    def binding(self) -> dict[str, SignalPaths]:
        """Role to ``MESSAGE.signal``: the file's own, or J1939 where it names none; of a table, role to column."""
        if self.table is not None:
            return {TABLE_ROLES.get(key, key): column for key, column in self.table.columns.items()}
        return self.signals or J1939_BINDING


def check(config: Config) -> None:
    """Refuse tables that contradict each other.

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
            raise ConfigError('sampler.likelihood: "paper" has boxes only; take the beliefs out of [prior]')
    if config.effects and config.sampler.likelihood == "paper":
        raise ConfigError('sampler.likelihood: "paper" has the plain road load only; take the effects out')
    if config.gate.minimum_samples > config.window.samples:
        most = f"window.samples = {config.window.samples}"
        raise ConfigError(f"gate.minimum_samples: {config.gate.minimum_samples} never fit into {most}; change one")
    lake: dict[str, Any] = msgspec.structs.asdict(config.lake) if config.lake else {}
    for table, ranges in (("lake", lake.get("ranges", {})), ("bus", config.bus.ranges)):
        for path, (low, high) in ranges.items():
            if not low < high:
                raise ConfigError(f"{table}.ranges.{path}: {low} is not below {high}")
    if config.mqtt is not None:
        _check_mqtt(config.mqtt)
    known = {role.value for role in Role}
    for role, bound in config.signals.items():
        if role not in known:
            guess = did_you_mean(role, known) or f"; the roles are {', '.join(sorted(known))}"
            raise ConfigError(f"signals.{role}: no such role{guess}")
        if isinstance(bound, list) and role != Role.WHEEL_SPEEDS:
            raise ConfigError(f"signals.{role}: takes one MESSAGE.signal; only wheel_speeds takes a list")
        if not bound:
            raise ConfigError(f"signals.{role}: is empty; leave it out, or write MESSAGE.signal")
        for signal in [bound] if isinstance(bound, str) else bound:
            message, _, name = signal.partition(".")
            if not message or not name or "." in name:
                raise ConfigError(f"signals.{role}: {signal!r} is not of the form MESSAGE.signal")
    for key in ("units", "ranges"):
        check_paths(f"lake.{key}", lake.get(key, {}), config.binding)


def check_paths(key: str, given: Iterable[str], binding: Mapping[str, SignalPaths]) -> None:
    """Refuse ``MESSAGE.signal`` that are ``given`` for a key, and that no role is bound to.

    Raises
    ------
    ConfigError
        The message names the key.
    """
    paths = {path for bound in binding.values() for path in ([bound] if isinstance(bound, str) else bound)}
    for path in sorted(set(given) - paths):
        guess = did_you_mean(path, paths) or f"; bound are {', '.join(sorted(paths))}"
        raise ConfigError(f"{key}.{path}: no signal of that name is bound{guess}")


def _check_mqtt(mqtt: Mqtt) -> None:
    for key in ("ca_file", "certificate_file", "key_file"):
        if getattr(mqtt, key) is not None and not mqtt.tls:
            raise ConfigError(f"mqtt.{key}: is for TLS, which is off; write tls = true")
    if (mqtt.certificate_file is None) != (mqtt.key_file is None):
        raise ConfigError("mqtt.certificate_file: goes with mqtt.key_file; name both or neither")
    if mqtt.password_file is not None and mqtt.username_file is None:
        raise ConfigError("mqtt.password_file: goes with mqtt.username_file; name that too")
    if not mqtt.period_s < mqtt.expire_after_s:
        times = f"{mqtt.expire_after_s} s is not longer than mqtt.period_s = {mqtt.period_s:g}"
        raise ConfigError(f"mqtt.expire_after_s: {times}; values would vanish between two messages")


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
        raise ConfigError(_explained(key, reason, tables)) from error
    check(config)
    return config


def _leaves(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """All values that are neither tables nor lists, with their places."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, f"{place}.{key}" if place else key)
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _leaves(inner, f"{place}[{i}]")
    else:
        yield place, value


def _explained(place: str, reason: str, tables: dict[str, Any]) -> str:
    """Message about the error at ``place``, with the keys and values that are possible there."""
    kind: Any = Config
    value: Any = tables
    for key in place.split(".") if place else ():
        kind = next((f.type for f in _fields(kind) if f.encode_name == key), None)
        value = value.get(key) if isinstance(value, dict) else None
    if unknown := re.fullmatch(r"Object contains unknown field `(.*)`", reason):
        key = f"{place}.{unknown[1]}" if place else unknown[1]
        if key in RETIRED:
            return f"{key}: {RETIRED[key]}; take the key out"
        there = [f.encode_name for f in _fields(kind)]
        return f"{key}: no such key" + (did_you_mean(unknown[1], there) or f"; there are {', '.join(there)}")
    if reason.startswith("Invalid enum value"):
        if f"{place} = {value}" in RETIRED:
            return f"{place}: {value!r} {RETIRED[f'{place} = {value}']}"
        return f"{place}: {value!r} is none of {', '.join(map(repr, get_args(kind)))}"
    found = f", found {value!r}" if isinstance(value, bool | int | float | str) else ""
    return f"{place}: {reason}{found}" if place else reason


def _fields(kind: Any) -> tuple[msgspec.structs.FieldInfo, ...]:
    """Those of a table of settings; none of anything else."""
    tables = [k for k in (kind, *get_args(kind)) if isinstance(k, type) and issubclass(k, msgspec.Struct)]
    return msgspec.structs.fields(tables[0]) if tables else ()


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


def load(path: Path | str | None = None) -> Config:
    """Read a TOML file, or the defaults when there is none; paths become relative to the file.

    A bare name such as ``obd2`` is that of a configuration that is shipped, unless there is a file of that name.

    Raises
    ------
    ConfigError
        The file is missing, not TOML, or wrong.
    """
    if path is None:
        return Config()
    path = located(Path(path))
    try:
        text = read_bounded(path, MAX_FILE_BYTES).decode("utf-8-sig")
        _refuse_long_keys(text)
        tables = tomllib.loads(text)
    except OSError as error:
        there = f"; configurations that are shipped: {', '.join(sorted(_shipped()))}" if _is_bare(path) else ""
        proposal = "; roadload init writes one" if isinstance(error, FileNotFoundError) else ""
        raise ConfigError(f"{path}: {error.strerror}{there}{proposal}") from error
    except (ValueError, RecursionError) as error:  # also bytes that are not UTF-8, and numbers of thousands of digits
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    with in_file(path):
        config = from_dict(tables)
    databases = [str(path.parent / name) for name in config.bus.dbc]
    road = None if config.road.map is None else str(path.parent / config.road.map)
    return replace(
        config,
        bus=msgspec.structs.replace(config.bus, dbc=databases),
        road=msgspec.structs.replace(config.road, map=road),
        mqtt=_beside(path, config.mqtt),
        kuksa=_beside(path, config.kuksa),
    )


@contextmanager
def in_file(path: Path | None) -> Iterator[None]:
    """Say the configuration file in errors of the context, which name its keys; None where there is no file.

    Raises
    ------
    ConfigError, DatabaseError
        That of the context.
    """
    try:
        yield
    except (ConfigError, DatabaseError) as error:
        raise error if path is None else type(error)(f"{path}: {error}") from error


def _beside(path: Path, table: Mqtt | Kuksa | None) -> Mqtt | Kuksa | None:
    """The table with its files relative to the folder of ``path``."""
    if table is None:
        return None
    named = {key: name for key, name in msgspec.structs.asdict(table).items() if key.endswith("_file") and name}
    return msgspec.structs.replace(table, **{key: str(path.parent / name) for key, name in named.items()})


def located(path: Path) -> Path:
    """The file that is meant by a path, or by the name of a configuration that is shipped."""
    return path if path.is_file() or not _is_bare(path) else _shipped().get(path.name, path)


def _is_bare(path: Path) -> bool:
    return path.name == str(path) and not path.suffix


def _shipped() -> dict[str, Path]:
    """Configurations that are shipped with their databases, by name."""
    paths = Path(str(files("estimator.dbc"))).glob("*.toml")
    databases = {path: tomllib.loads(path.read_text(encoding="utf-8"))["bus"]["dbc"] for path in paths}
    return {
        path.stem: path for path, names in databases.items() if all((path.parent / name).is_file() for name in names)
    }


def _refuse_long_keys(text: str) -> None:
    """ValueError where a line has so many dots that `tomllib` may need hours for the key that they make."""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.count(".") > MAX_DOTS:
            raise ValueError(f"more than {MAX_DOTS} dots in line {number}; no key or list here has so many")


def replace(config: Config, **sections: Section | None) -> Config:
    """A copy of ``config`` with whole tables exchanged."""
    return msgspec.structs.replace(config, **sections)


def read_map(path: Path) -> bytes:
    """Contents of the file that ``road.map`` names.

    Raises
    ------
    ConfigError
        It cannot be read, or is too large.
    """
    try:
        return read_bounded(path, MAX_MAP_BYTES)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; correct road.map, or take it out") from error


def estimation_key(config: Config) -> str:
    """Digests of everything that an estimate depends on, as ``table=digest``: vehicle, databases, map, settings.

    Raises
    ------
    ConfigError
        The map cannot be read.
    """
    tables = {name: getattr(config, name) for name in config.__struct_fields__ if name not in (*DAEMON_TABLES, "road")}
    tables["bus"] = msgspec.structs.replace(config.bus, dbc=[])
    contents = {name: msgspec.json.encode(table, order="sorted") for name, table in tables.items()}
    databases = config.bus.dbc or [str(files("estimator.dbc").joinpath("j1939.dbc"))]
    contents["bus.dbc"] = b"".join(Path(name).read_bytes() for name in databases)
    if config.road.map is not None:
        contents["road.map"] = read_map(Path(config.road.map))
    return " ".join(f"{name}={blake2b(content, digest_size=16).hexdigest()}" for name, content in contents.items())


def state_key(config: Config) -> str:
    """`estimation_key` of what a saved state depends on: of ``[gate]`` only the cells, for the rest only judges it.

    Raises
    ------
    ConfigError
        The map cannot be read.
    """
    cells = {name: getattr(config.gate, name) for name in ("speed_step_m_s", "acceleration_step_m_s2")}
    return estimation_key(replace(config, gate=Gate(**cells)))
