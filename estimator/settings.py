"""The tables of the configuration: every key typed, ranged and defaulted here."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

MAX_VALUE = 1e9  # in any unit used here: larger numbers are mistakes, and their products overflow
MIN_POSITIVE = 1e-6  # in any unit used here: quotients by it, and their squares, are finite
Positive = Annotated[float, Meta(ge=MIN_POSITIVE, le=MAX_VALUE)]
NotNegative = Annotated[float, Meta(ge=0, le=MAX_VALUE)]
Fraction = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=1, le=int(MAX_VALUE))]
Address = Annotated[int, Meta(ge=0, le=253)]
Bound = Annotated[float, Meta(ge=-MAX_VALUE, le=MAX_VALUE)]
Range = tuple[Bound, Bound]
Belief = tuple[Positive, Positive]
Port = Annotated[int, Meta(ge=1, le=65_535)]
Topic = Annotated[str, Meta(min_length=1, max_length=200, pattern=r"\A[^+#\x00]*\Z")]  # of MQTT, without wildcards
SignalPaths = str | list[str]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all tables: immutable, and strict about its keys."""


class Vehicle(Section, frozen=True):
    """Knowledge of the vehicle before any measurement."""

    driveline_efficiency: Annotated[float, Meta(ge=0.01, le=1)] = 1.0  # wheel power over crank power
    reference_torque_Nm: Positive | None = None  # instead of the EC1 broadcast
    subtract_parasitic_losses: bool = False  # some ECUs already count them as friction
    discharge_current: Literal["positive", "negative"] = "positive"  # sign of battery_current while it drives


class Bus(Section, frozen=True):
    """How traffic is decoded: databases, and the source address of a message."""

    dbc: list[str] = []  # paths relative to the configuration file; empty: the shipped j1939.dbc
    # auto: by PGN where the DBC is of J1939 (VFrameFormat); pgn: all; obd: answers of any ECU
    match: Literal["auto", "pgn", "id", "obd"] = "auto"
    source_addresses: dict[str, Address] = {}  # MESSAGE = address; others are found, and contested if they disagree
    channels: list[str | int] = []  # of a log with several, as the log names them; empty: all of them as one bus
    units: dict[str, str] = {}  # MESSAGE.signal = unit, where the DBC has none or a wrong one
    ranges: dict[str, Range] = {}  # MESSAGE.signal = [lowest, highest] valid value, instead of the DBC's
    states: dict[str, list[int]] = {}  # MESSAGE.signal = values of a switch that mean on, where the DBC does not say
    release_s: Positive = 10.0  # of silence after which a signal may be taken from another address
    contest_s: Annotated[float, Meta(ge=10)] = 30.0  # without a contradiction after which a signal is used again


class Lake(Section, frozen=True):
    """Traffic that was decoded before: a folder of Parquet files by device, message and day, read without a DBC.

    Keys are MESSAGE.signal. Units and ranges that are not given are those of the DBC, if it has a signal of that name.
    """

    units: dict[str, str] = {}  # MESSAGE.signal = unit
    ranges: dict[str, Range] = {}  # in that unit: what lies outside is no value, as "not available" of J1939


class Table(Section, frozen=True):
    """A table of measurements, CSV or Parquet, instead of frames; units are in brackets behind the names of columns."""

    time: str | None = None  # "COLUMN [s]"; default: the column that is called time, t, timestamp, ...
    columns: dict[str, str] = {}  # role = "COLUMN [unit]"; also power or force at the wheels
    alternatives: dict[str, list[str]] = {}  # role = other columns of it, or time, in files that lack the one above


class Kinematics(Section, frozen=True):
    """How speed and power belong together."""

    despike: bool = True  # replace lone gross errors of power by the median of their neighbours, drop those of speed
    maximum_lag_s: Annotated[float, Meta(ge=0, le=2)] = 0.6  # of torque against speed, searched on either side


class Admission(Section, frozen=True):
    """Which driving may enter the window."""

    minimum_speed_m_s: NotNegative = 1.0  # below it the vehicle counts as standing
    stride_margin_s: NotNegative = 0.8  # kept away from brake use, shifts and gaps, on either side


class Window(Section, frozen=True):
    """The samples that an estimate is made from."""

    samples: Annotated[int, Meta(ge=600, le=1_000_000)] = 36_000  # at 10 Hz: an hour of admitted driving
    hours: Positive = 24.0  # older samples are forgotten


class Gate(Section, frozen=True):
    """When an estimate may be made."""

    interval_s: Annotated[float, Meta(ge=5, le=MAX_VALUE)] = 60.0  # between updates, message time
    minimum_samples: Count = 600  # admitted ones, at 10 Hz
    minimum_cells: Count = 8  # occupied cells of the speed x acceleration grid
    cell_count: Count = 10  # samples that make a cell occupied
    coverage: Fraction = 0.15  # share of the cells that the vehicle can reach
    speed_step_m_s: Positive = 2.5  # width of a cell
    acceleration_step_m_s2: Positive = 0.1  # width of a cell
    new_samples: Fraction = 0.02  # share of the window that must be new since the last estimate
    relative_sd: tuple[Positive, Positive, Positive] = (0.5, 0.5, 0.1)  # largest predicted, of A, C, m


class Load(Section, frozen=True):
    """When the load may change, and the uncertainty of the parameters that are carried over."""

    # Standing this long starts a new load segment. Below 300 s, as for a bus, the driving before stays in use: the mass
    # is that since the stop, and A / m, C, road and noise are found from the last 15 loads.
    stop_s: Positive = 300.0
    change_sd: NotNegative = 0.1  # relative sd of what A / m and C may change with the load: trailers differ
    drift_per_hour: NotNegative = 0.03  # relative sd by which A / m and C may wander, growing with the square root


class RoadTable(Section, frozen=True):
    """Knowledge of the road before any measurement."""

    map: str | None = None  # the road.npy of a fleet, relative to the configuration file


class Prior(Section, frozen=True):
    """Boxes, outside of which the posterior is zero; beliefs as (mean, sd), e.g. from a weigh ticket or data sheet."""

    mass_kg: Range = (500.0, 100_000.0)  # lowest and highest
    A_N: Range = (0.0, 10_000.0)  # rolling resistance and other constant force
    C_N_s2_m2: Range = (0.0, 20.0)  # drag: half of air density, drag coefficient and frontal area
    mass_belief_kg: Belief | None = None  # mean and sd, inside the box
    A_belief_N: Belief | None = None  # mean and sd
    C_belief_N_s2_m2: Belief | None = None  # mean and sd


class Sampler(Section, frozen=True):
    """Metropolis-Hastings."""

    likelihood: Literal["road", "paper"] = "road"  # paper: of the power on a level road, as published
    kernel: Literal["independence", "random_walk"] = "independence"  # of proposals
    chains: Annotated[int, Meta(ge=2, le=256)] = 64  # that run side by side
    burn_in: Annotated[int, Meta(ge=1, le=20_000)] = 20  # the random walk takes more of both: it moves slowly
    draws: Annotated[int, Meta(ge=8, le=20_000)] = 100  # kept, per chain
    seed: Annotated[int, Meta(ge=0)] = 1  # of the random numbers


class Publish(Section, frozen=True):
    """Settings of the broadcast."""

    source_address: Address = 0xFB  # the on-board data logger's
    priority: Annotated[int, Meta(ge=0, le=7)] = 6  # of the frames; 0 is the highest
    status_period_s: Positive = 1.0  # between two broadcasts of the status
    value_period_s: Positive = 10.0  # between two broadcasts of the values
    stale_after_s: Positive = 3600.0  # without a new estimate, after which none is broadcast
    cvw: bool = False  # also the mass as CVW, PGN 65136; a node of the vehicle may already send that


class BusOptions(Section, frozen=True):
    """The bus, where the command line does not name it; missing keys are taken from can.conf."""

    interface: str | None = None  # of python-can: "socketcan", "udp_multicast", ...
    channel: str | None = None  # as that interface names it: "can0"
    bitrate: Count | None = None  # bit/s, of interfaces that set it
    context: str | None = None  # section of can.conf


class Reception(BusOptions, frozen=True):
    """How the daemon receives from the bus."""

    filter: bool = True  # have the kernel pass on the wanted messages only
    buffer_bytes: Annotated[int, Meta(ge=4096, le=1 << 28)] = 4 << 20  # of the kernel, for the socket
    queue_frames: Annotated[int, Meta(ge=1000, le=10_000_000)] = 200_000  # that may wait for the estimator
    silence_s: Positive = 5.0  # without a frame: the ignition is off
    reopen_s: NotNegative = 60.0  # of silence after which a bus without a network device is opened anew; 0: never


class Transmit(BusOptions, frozen=True):
    """Whether and how the daemon sends; by default on the bus that it receives from."""

    enabled: bool = False  # without it nothing is sent
    frames_per_second: Positive = 10.0  # on average; three times as many at once
    identity: Annotated[int, Meta(ge=0, lt=1 << 21)] = 1  # of the J1939 NAME: the number of this device
    manufacturer: Annotated[int, Meta(ge=0, lt=1 << 11)] = 0x7FF  # assigned by SAE; none is assigned to this project
    function: Annotated[int, Meta(ge=0, le=255)] = 255  # not available
    function_instance: Annotated[int, Meta(ge=0, le=31)] = 0  # of the J1939 NAME
    ecu_instance: Annotated[int, Meta(ge=0, le=7)] = 0  # of the J1939 NAME
    vehicle_system: Annotated[int, Meta(ge=0, le=127)] = 0  # of the J1939 NAME; 0: not specific
    vehicle_system_instance: Annotated[int, Meta(ge=0, le=15)] = 0  # of the J1939 NAME
    industry_group: Annotated[int, Meta(ge=0, le=7)] = 1  # on-highway
    arbitrary_address: bool = True  # take another address when the preferred one is lost
    commanded_address: bool = False  # take the address that another node commands (J1939-81)
    diagnostics: bool = True  # broadcast our own faults as DM1 every second, answer requests for DM1, 2, 3 and 11


class Mqtt(Section, frozen=True):
    """A broker that gets the estimate; without this table, none. Files are relative to the configuration file."""

    host: Annotated[str, Meta(min_length=1)]
    port: Port | None = None  # 1883; 8883 with TLS
    topic: Topic = "roadload"  # of this vehicle: estimate at TOPIC/state, "online" or "offline" at TOPIC/availability
    client_id: Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_-]{1,64}\Z")] | None = None  # default: roadload-HOSTNAME
    protocol: Literal["5", "3.1.1"] = "5"
    tls: bool = False
    ca_file: str | None = None  # certificates that are believed; default: those of the system
    certificate_file: str | None = None  # of this client, with key_file
    key_file: str | None = None
    username_file: str | None = None  # one line, as in password_file
    password_file: str | None = None
    discovery_prefix: Topic | None = None  # of Home Assistant, usually "homeassistant"; default: none is announced
    keepalive_s: Annotated[int, Meta(ge=5, le=65_535)] = 60
    period_s: Positive = 10.0  # between messages about one conclusion; a new one is sent at once
    expire_after_s: Annotated[int, Meta(ge=2, le=int(MAX_VALUE))] = 60  # after the last message a value is not shown


class Kuksa(Section, frozen=True):
    """A Kuksa databroker that gets the estimate as VSS signals; without this table, none."""

    host: Annotated[str, Meta(min_length=1)]
    port: Port = 55555
    ca_file: str | None = None  # TLS, with these certificates believed; relative to the configuration file
    token_file: str | None = None  # one line, a JSON Web Token
    overlay: bool = True  # also the signals of roadload.vspec, with intervals and status; else only the standard's own
    period_s: Positive = 10.0  # between messages about one conclusion; a new one is sent at once


class Service(Section, frozen=True):
    """Where the daemon keeps its state and status."""

    state_directory: str | None = None  # default: that of systemd, else the user's own
    runtime_directory: str | None = None  # of the status file; default: that of systemd, else the user's own
    save_interval_s: Annotated[float, Meta(ge=10, le=MAX_VALUE)] = 60.0  # lost with the power: at most that and 10 s
    metrics: str | None = None  # file for the node exporter of Prometheus
