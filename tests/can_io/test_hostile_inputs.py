"""Inputs made to hang the program or to fill its memory: each is one line and status 2, within 10 s and 500 MB."""

import gzip
import os
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import can
import pytest
from limited_process import exit_status

from estimator.config import Config
from estimator.errors import ConfigError
from estimator.road_map import RoadMap
from estimator.streaming.listener import InlineWorker, Listener, broadcast_by

Refused = Callable[..., str]
GOOD = "(1.0) can0 18FEF100#FFFFFFFFFFFFFFFF\n"


@pytest.fixture
def refused(tmp_path: Path) -> Refused:
    """The one line with which a command refuses."""

    def refuse(*arguments: object) -> str:
        assert exit_status([*map(str, arguments)], tmp_path / "answer") == 2
        line = (tmp_path / "answer").read_text()
        assert line.startswith("error: ")
        assert line.count("\n") == 1
        assert len(line) < 1000
        return line

    return refuse


def plain(folder: Path) -> Path:
    (folder / "good.log").write_text(GOOD * 3)
    return folder / "good.log"


# Logs


@pytest.mark.slow
@pytest.mark.parametrize("time", ["100000000000000000.0", "99999999999999999999.0", "1e17", "nan", "inf", "1e300"])
@pytest.mark.parametrize("suffix", [".log", ".csv", ".asc"])
def test_a_time_of_no_clock(refused: Refused, tmp_path: Path, time: str, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    head = {
        ".log": "",
        ".csv": "timestamp,arbitration_id,extended,remote,error,dlc,data\n",
        ".asc": "base hex  timestamps absolute\n",
    }
    form = {".log": "({}) can0 123#11\n", ".csv": "{},0x123,0,0,0,1,EQ==\n", ".asc": "{} 1  123  Rx   d 1 11\n"}
    path.write_text(head[suffix] + form[suffix].format("1.0") + form[suffix].format(time))
    assert str(path) in refused("estimate", path)


@pytest.mark.slow
def test_a_time_of_no_clock_in_a_blf(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "a.blf").write_bytes(blf_of(objects=[frame(10**9), frame(2**64 - 1)]))
    assert "missing inputs" in refused("estimate", tmp_path / "a.blf")  # 584 years are a time


def frame(time: int, channel: int = 1) -> bytes:
    """A CAN frame object of a BLF log, at ``time`` [ns]."""
    head = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, time)
    return head + struct.pack("<HBBL8s", channel, 0, 8, 0x123, bytes(8))


def blf_of(objects: list[bytes] | None = None, containers: list[bytes] | None = None) -> bytes:
    """A BLF log of ``objects`` in one container, or of packed ``containers`` with their headers."""
    body = b"".join(containers or [container(b"".join(objects or []))])
    return struct.pack("<4sLQQQLL8H8H", b"LOGG", 144, 0, 0, 0, 0, 0, *[0] * 16).ljust(144, b"\0") + body


def container(data: bytes) -> bytes:
    packed = zlib.compress(data, 1)
    size = 32 + len(packed)
    return struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, size, 10, 2, len(data)) + packed + bytes(size % 4)


@pytest.mark.slow
def test_a_blf_object_that_never_ends(refused: Refused, tmp_path: Path) -> None:
    endless = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 4_000_000, 65, 2, 0, 0, 0)
    pieces = [container(frame(0) + endless), *[container(bytes(60))] * 60_000]
    (tmp_path / "a.blf").write_bytes(blf_of(containers=pieces))
    assert "ends too early" in refused("estimate", tmp_path / "a.blf")


@pytest.mark.slow
def test_blf_containers_that_unpack_to_a_thousand_times_their_size(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "a.blf").write_bytes(blf_of(containers=[container(bytes(128 << 20))]))
    assert "damaged or cut at byte 144" in refused("estimate", tmp_path / "a.blf")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "content"),
    [(".log", b"\n"), (".asc", b"//\n"), (".csv", b"\n"), (".trc", b"; \n"), (".blf", b"\0")],
)
def test_a_gzip_bomb(refused: Refused, tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"a{suffix}.gz"
    path.write_bytes(256 * gzip.compress(content * ((1 << 20) // len(content))))
    assert path.name in refused("estimate", path)


@pytest.mark.slow
def test_a_gzip_bomb_of_frames_at_one_time(refused: Refused, tmp_path: Path) -> None:
    line = b"(1.0) can0 123#\n"
    packed = gzip.compress(line * ((1 << 20) // len(line)), 1)  # less than a bomb of blank lines is
    (tmp_path / "a.log.gz").write_bytes(256 * packed)
    assert "within 5 s, which no bus carries" in refused("estimate", tmp_path / "a.log.gz")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".log", ".asc", ".csv", ".trc"])
def test_a_flood_of_blank_lines(refused: Refused, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"\n" * (64 << 20))
    assert path.name in refused("estimate", path)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".log", ".asc", ".csv", ".trc", ".blf", ".mf4", ".log.gz", ".txt"])
def test_a_device_without_end(refused: Refused, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.symlink_to("/dev/zero")
    assert path.name in refused("estimate", path)


def test_a_payload_cut_in_the_middle_of_its_padding(refused: Refused, tmp_path: Path) -> None:
    head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
    (tmp_path / "a.csv").write_text(f"{head}1.0,0xcf00203,1,0,0,8,zP///1e17////8=\n")
    assert "a.csv:2: this line cannot be read (Incorrect padding)" in refused("estimate", tmp_path / "a.csv")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".log", ".blf"])
def test_a_log_of_more_channels_than_any_logger_has(refused: Refused, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".log":
        path.write_text("".join(f"({k}.0) can{k} {k:08X}#00\n" for k in range(100_000)))
    else:
        path.write_bytes(blf_of(objects=[frame(k, channel=k) for k in range(60_000)]))
    assert "more than 250 channels" in refused("estimate", path)


# Databases and settings

DBC = 'VERSION ""\nBU_: X\nBO_ 2566844926 M: 8 X\n SG_ S : {}@1+ (1,0) [0|0] "km/h" X\n'


@pytest.mark.parametrize(
    ("change", "said"),
    [(("(1,0)", "(0,0)"), "M.S: has a factor of 0"), (("", ""), "more than one message 'M'")],
)
def test_a_database_that_gives_no_value(refused: Refused, tmp_path: Path, change: tuple[str, str], said: str) -> None:
    text = DBC.format("0|16")
    other = text.splitlines(keepends=True)[2:] if not change[0] else []
    (tmp_path / "a.dbc").write_text(text.replace(*change) + "".join(other).replace("2566844926", "2566844925"))
    (tmp_path / "a.toml").write_text('bus.dbc = ["a.dbc"]\nsignals = {speed = "M.S", engine_power = "M.S"}\n')
    assert said in refused("estimate", plain(tmp_path), "--config", tmp_path / "a.toml")


def test_a_log_that_comes_through_a_pipe_or_leads_in_a_circle(refused: Refused, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.blf")
    assert "is no file but a pipe or a device" in refused("estimate", tmp_path / "a.blf")
    (tmp_path / "b.blf").symlink_to(tmp_path / "b.blf")
    assert "b.blf: cannot be read" in refused("estimate", tmp_path / "b.blf")


@pytest.mark.parametrize("layout", ["0|2000000000", "2000000000|16", "0|" + "9" * 5000, "0 |\n 2000000000 "])
def test_a_signal_of_absurd_size(refused: Refused, tmp_path: Path, layout: str) -> None:
    (tmp_path / "a.dbc").write_text(DBC.format(layout))
    said = refused("estimate", plain(tmp_path), "--dbc", tmp_path / "a.dbc")
    assert "a.dbc: left out: signals" in said
    assert "(1, line 4)" in said


MULTIPLEXED = ' SG_ S{0} m{0} : 16|8@1+ (1,0) [0|0] "" X\n'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (f'VERSION "{"a" * (7 << 20)}"\n' + DBC.format("0|8"), "a.dbc:1: a text of over 65,536 characters"),
        (DBC.format("0|8") + 'CM_ "' + "\n" * (1 << 20), "a.dbc:5: a text of over 65,536 characters"),
        (DBC.format("0|8") + "".join(map(MULTIPLEXED.format, range(90_000))), "more than 1,000 signals in a message"),
        (DBC.format("0|8") + ";" * (7 << 20), "over 400,000 names, numbers and texts"),
        ("".join(f"BO_ {k} M{k}: 8 X\n" for k in range(300_000)), "over 400,000 names, numbers and texts"),
    ],
)
def test_a_database_that_takes_minutes_or_gigabytes_to_parse(
    refused: Refused, tmp_path: Path, content: str, said: str
) -> None:
    (tmp_path / "a.dbc").write_text(content)
    assert said in refused("estimate", plain(tmp_path), "--dbc", tmp_path / "a.dbc")


@pytest.mark.slow
def test_databases_that_are_too_large_together(refused: Refused, tmp_path: Path) -> None:
    for k in range(10):
        text = DBC.format("0|8").replace("M:", f"M{k}:") + f'CM_ "{"a" * 60_000}";\n' * 15
        (tmp_path / f"{k}.dbc").write_text(text)
    options = [text for k in range(10) for text in ("--dbc", tmp_path / f"{k}.dbc")]
    assert "9.dbc: the databases have over 8 MiB" in refused("estimate", plain(tmp_path), *options)


def test_a_long_line_that_is_no_statement_is_counted_and_not_quoted(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(DBC.format("0|8") + "VERSION\nX\nBO_ " + "X " * 100_000)
    said = refused("estimate", plain(tmp_path), "--dbc", tmp_path / "a.dbc")
    assert "messages that cannot be read (1, line 7)" in said
    assert len(said) < 1000


@pytest.mark.parametrize("line", ["{} = 1", "[{}]", "x = {{{} = 1}}"])
def test_a_key_of_thousands_of_parts(refused: Refused, tmp_path: Path, line: str) -> None:
    (tmp_path / "a.toml").write_text("\n" + line.format(".".join(["a"] * 400_000)))
    said = refused("estimate", plain(tmp_path), "--config", tmp_path / "a.toml")
    assert "a.toml: not valid TOML: more than 100 dots in line 2" in said


# Simulated drives


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--mass=1e308", "not a positive number up to 1e+06"),
        ("--A=1e308", "not a positive number up to 1e+06"),
        ("--C=1e308", "not a positive number up to 1000"),
        ("--minutes=1e308", "not a number of minutes"),
        ("--cycle=/dev/zero", "is larger than 4 MiB"),
    ],
)
def test_a_drive_of_no_vehicle(refused: Refused, tmp_path: Path, option: str, said: str) -> None:
    assert said in refused("simulate", tmp_path / "a.log", option)


def test_a_cycle_of_thirty_million_years(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_s,v_mps\n0,0\n1,10\n1e15,0\n")
    assert "a cycle of more than 1,000,000 s" in refused("simulate", tmp_path / "a.log", "--cycle", tmp_path / "a.csv")


def test_a_signal_that_no_message_can_carry(refused: Refused, tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(DBC.format("500000|16"))
    (tmp_path / "a.toml").write_text('bus.dbc = ["a.dbc"]\nsignals = {speed = "M.S", engine_power = "M.S"}\n')
    assert "M.S: lies beyond byte 4095" in refused("estimate", plain(tmp_path), "--config", tmp_path / "a.toml")


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/urandom"])
def test_a_device_for_a_database_or_settings(refused: Refused, tmp_path: Path, name: str) -> None:
    (tmp_path / "a.toml").write_text(f'[bus]\ndbc = ["{name}"]\n')
    assert f"{name}: is larger than 8 MiB" in refused("estimate", plain(tmp_path), "--config", tmp_path / "a.toml")
    assert f"{name}: is larger than 1 MiB" in refused("estimate", plain(tmp_path), "--config", name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        "vehicle.reference_torque_Nm = 1e308",
        "vehicle.driveline_efficiency = 1e-308",
        "admission.margin_s = 1e308",
        "admission.power_sigmas = 1e308",
        "gate.interval_s = 1e308",
        "gate.speed_step_m_s = 1e-308",
        "gate.acceleration_step_m_s2 = 1e308",
        "gate.minimum_samples = 1000000000000000000",
        "window.hours = 1e308",
        "load.stop_s = 1e308",
        "prior.mass_kg = [0.0, 1e308]",
        "prior.mass_belief_kg = [1e308, 1e308]",
        "publish.value_period_s = 1e-308",
        "transmit.frames_per_second = 1e308",
    ],
)
def test_settings_beyond_all_sense(refused: Refused, tmp_path: Path, line: str) -> None:
    (tmp_path / "a.toml").write_text(line + "\n")
    key = line.partition(" ")[0]
    assert f"a.toml: {key}" in refused("estimate", plain(tmp_path), "--config", tmp_path / "a.toml")


# A bus


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e300, 1e17, -1.0])
@pytest.mark.parametrize("first", [True, False])
def test_a_listener_counts_messages_without_a_usable_time(bad: float, first: bool) -> None:
    sent: list[can.Message] = []
    worker = InlineWorker(Config())
    listener = Listener(worker, broadcast_by(Config().publish, sent.append))
    stamps = [*([bad] if first else []), *(100.0 + 0.1 * i for i in range(50)), bad, 105.0, bad]
    for t in stamps:
        listener(can.Message(timestamp=t, arbitration_id=0x18FEF100, data=bytes(8)))
    listener.stop()
    assert worker.pipeline.traffic.frames == 51
    assert sum(listener.skipped.values()) == len(stamps) - 51
    assert {100.0 <= message.timestamp <= 106.0 for message in sent} == {True}


def test_the_header_of_a_map_gives_no_warning_of_python(tmp_path: Path) -> None:
    header = b"{'descr': '<i4', 'fortran_order': False, 'shape': (1in (2,),)}".ljust(117) + b"\n"
    (tmp_path / "map.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with warnings.catch_warnings(record=True, action="always") as caught, pytest.raises(ConfigError, match="not a map"):
        RoadMap.read(tmp_path / "map.npy")
    assert not caught
