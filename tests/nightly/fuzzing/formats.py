"""Files that the program reads: small sound ones of each format, and how each is read."""

import gzip
import logging
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import can
import numpy as np
from mdf_files import Recorded, Style, mdf

from estimator import config as configuration
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import open_log
from estimator.checkpoint import store
from estimator.config import Config
from estimator.daemon.service import faults
from estimator.road_map import RoadMap, key_of
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from fuzzing import tables

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
EXAMPLE = Path(__file__).parents[3] / "deploy" / "systemd" / "roadload.toml"
FIELD_LOGS, MF4S = Path(__file__).parents[2] / "field_logs", "mf4_[vz]*.mf4"  # virtual channels; zstd
KEY = "fuzz"
FRAMES, STATE_SECONDS = 40, 60.0  # of a small log; of the drive behind a saved state [s]
DBC = """VERSION "1"
NS_ : CM_
BS_:
BU_: A B
BO_ 2566844926 CCVS1: 8 A
 SG_ WheelBasedVehicleSpeed : 8|16@1+ (0.00390625,0) [0|250.996] "km/h" B
 SG_ BrakeSwitch m1 : 28|2@0- (1,0) [0|3] "" B
 SG_ Kind M : 0|4@1+ (1,-40) [0|15] "degC" A,B
BO_ 256 Plain: 8 A
 SG_ Power : 7|16@0- (0.5,-3E2) [-300|300] "kW" B
SIG_VALTYPE_ 256 Power : 1;
CM_ SG_ 256 Power "of the engine";
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 100;
BA_ "GenMsgCycleTime" BO_ 256 20;
VAL_ 2566844926 BrakeSwitch 0 "off" 1 "on" ;
"""
SETTINGS = """[bus]
dbc = []
release_s = 5.0
[bus.source_addresses]
CCVS1 = 0
[signals]
speed = "CCVS1.WheelBasedVehicleSpeed"
[vehicle]
reference_torque_Nm = 2500.0
[gate]
relative_sd = [0.1, 0.2, 0.3]
[prior]
mass_kg = [3000.0, 80000.0]
"""


@dataclass(frozen=True)
class Format:
    """Sound files of a kind, and what reads a file; RoadloadError where it cannot be used.

    A file takes as long to read as ``cost`` others do.
    """

    suffix: str
    sound: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    cost: int = 1


logging.getLogger("can").setLevel(logging.CRITICAL)  # its readers log every line that they cannot read


def read_log(path: Path) -> None:
    """Read all frames of a log."""
    for frames in open_log(path):
        assert len(frames)
        assert np.isfinite(frames.t).all()


@cache
def drive(seconds: float) -> Frames:
    """Frames of a simulated drive."""
    rng = np.random.default_rng(1)
    return frames_of(record(TRUCK, generate_route("mixed", 40.0 * seconds, rng), seconds, rng).signals)


def _logs(suffix: str) -> list[bytes]:
    frames = drive(5.0)[:FRAMES]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{name}{suffix}" for name in ("whole", "messages")]
        write_log(frames, paths[0])
        options = {"compression_level": 0} if suffix == ".blf" else {}
        with can.Logger(paths[1], **options) as log:  # other kinds of frames, and in .blf not packed
            for k, message in enumerate(frames[:10].messages()):
                message.is_remote_frame, message.is_error_frame = k == 3, k == 5
                log.on_message_received(message)
        return [path.read_bytes().replace(folder.encode(), b"") for path in paths]  # .trc has the path


def _lines(line: Callable[[float, int, bytes], str], head: str) -> list[bytes]:
    """A text log, of which ``line`` writes a frame, given its time [s], id and data."""
    frames = drive(5.0)[:FRAMES]
    rows = zip(frames.t.tolist(), frames.ident.tolist(), frames.data, strict=True)
    return [(head + "".join(line(t, ident & ~EXTENDED, bytes(data)) + "\n" for t, ident, data in rows)).encode()]


def _gvret(t: float, ident: int, data: bytes) -> str:
    return f"{t * 1e6:.0f},{ident:08X},true,Rx,0,{len(data)},{''.join(f'{byte:02X},' for byte in data)}"


def _crtd(t: float, ident: int, data: bytes) -> str:
    return f"{t:.6f} 1R29 {ident:08X} {data.hex(' ')}"


def _mdf2csv(t: float, ident: int, data: bytes) -> str:
    return f"{t:.6f};1;{ident:X};1;{len(data)};{len(data)};0;0;0;{data.hex()}"


def _mf4s() -> list[bytes]:
    frames = [
        Recorded(t=0.1 * k, data=bytes([k] * 8), kind="error" if k == 3 else "data", valid=k != 5) for k in range(12)
    ]
    styles = (
        Style(width=8),
        Style(is_sorted=False, width=8),
        Style(payload="values", packing="deflated"),
        Style(width=8, packing="transposed", block=64, has_header_list=True),
        Style(is_sorted=False, width=8, has_marks=True),
    )
    return [*(mdf(frames, style) for style in styles), *(path.read_bytes() for path in sorted(FIELD_LOGS.glob(MF4S)))]


def _read_database(path: Path) -> None:
    """Bind two signals, and decode frames of their messages by it."""
    names = {"speed": "CCVS1.WheelBasedVehicleSpeed", "engine_power": "Plain.Power"}
    settings = configuration.from_dict({"bus": {"dbc": [str(path)]}, "signals": names})
    list(Pipeline(settings).feed(_plain_traffic()))


@cache
def _plain_traffic() -> Frames:
    t = np.arange(0.0, 20.0, 0.1)
    ident = np.where(np.arange(len(t)) % 2 == 0, 256, 2566844926).astype(np.uint32)
    data = np.random.default_rng(1).integers(0, 256, (len(t), 8), dtype=np.uint8)
    return Frames(t, ident, np.full(len(t), 8, np.uint8), data)


def _settings() -> list[bytes]:
    return [SETTINGS.encode(), EXAMPLE.read_bytes()]


def _state() -> bytes:
    pipeline = Pipeline(Config())
    list(pipeline.feed(drive(STATE_SECONDS)))
    content = store.pack(pipeline.state(), KEY)
    return zlib.decompress(content[store.HEADER.size + len(KEY) :])


def _read_state(path: Path) -> None:
    """A state whose checksum is right whatever is in it, as a forger makes it; then a drive."""
    name, payload = KEY.encode(), zlib.compress(path.read_bytes(), 1)
    parts = (store.MAGIC, store.SCHEMA, len(name), len(payload))
    digest = store._digest(store.HEADER.pack(*parts, bytes(16)), name, payload)
    state = store.unpack(store.HEADER.pack(*parts, digest) + name + payload, KEY)
    pipeline = Pipeline(Config())
    pipeline.restore(state, same_clock=True)
    list(pipeline.feed(drive(5.0)))


def _codes() -> list[bytes]:
    return [b'[{"spn":84,"fmi":2,"count":1},{"spn":516096,"fmi":9,"count":126}]']


def _map() -> list[bytes]:
    return [RoadMap(key_of(np.arange(3), np.arange(3), np.arange(3)), np.full(3, 0.01), np.full(3, 0.001)).encoded()]


MDF2CSV = "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;DataBytes\n"
LOGS = (".asc", ".blf", ".csv", ".log", ".trc")
FORMATS = {
    **{suffix[1:]: Format(suffix, partial(_logs, suffix), read_log) for suffix in LOGS},
    "gvret": Format(".csv", partial(_lines, _gvret, "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4\n"), read_log),
    "crtd": Format(".crtd", partial(_lines, _crtd, "0.0 CXX OVMS CRTD\n"), read_log),
    "mdf2csv": Format(".csv", partial(_lines, _mdf2csv, MDF2CSV), read_log),
    "mf4": Format(".mf4", _mf4s, read_log),
    "gz": Format(".log.gz", lambda: [gzip.compress(one, mtime=0) for one in _logs(".log")], read_log),
    "table": Format(".csv", tables.csvs, tables.read_table),
    "parquet": Format(".parquet", tables.parquets, tables.read_table),
    "signals": Format(".mf4", tables.measurements, tables.read_table, cost=50),
    "fit": Format(".fit", tables.fits, tables.read_fit),
    "tcx": Format(".tcx", tables.tcxs, tables.read_tcx),
    "dbc": Format(".dbc", lambda: [DBC.encode()], _read_database),
    "toml": Format(".toml", _settings, configuration.load),
    "map": Format(".npy", _map, RoadMap.read),
    "codes": Format(".json", _codes, faults.load),
    "state": Format(".state", lambda: [_state()], _read_state),
}
