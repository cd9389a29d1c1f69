"""Logs of several channels: read as one bus where that is possible, refused where it is not, or one chosen."""

import gzip
import json
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from failures import Cli, fails
from mdf_files import Recorded, Style, mdf
from written_logs import message_of, write

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import Log, open_log
from estimator.can_io.logs.blf_objects import MIN_RUN
from estimator.config import Config, from_dict
from estimator.fleet.engine import Serial
from estimator.fleet.run import run_fleet
from estimator.fleet.sources import find_logs
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck

COUNT = 4 * MIN_RUN
NAMES = {  # of the two channels, as the log writes them
    "a.blf": ("1", "2"),
    "a.blf.gz": ("1", "2"),
    "a.asc": ("1", "2"),
    "a.log": ("can0", "can1"),
    "a.trc": ("1", "2"),
    "a.mf4": ("0", "1"),
    "a.mf4.gz": ("0", "1"),
    "logger.mf4": ("1", "2"),
    "columns.mf4": ("1", "2"),
}
STYLES = {
    "logger.mf4": Style(is_sorted=False, payload="values"),
    "columns.mf4": Style(is_column_store=True, payload="values"),
}


def two_buses(shared: bool, fd: bool = False) -> list[can.Message]:
    """Messages of channels 0 and 1 in turn, in runs of growing length; with an id that both send if ``shared``."""
    rng = np.random.default_rng(5)
    channels = np.repeat(np.arange(60) % 2, np.arange(60))[:COUNT].tolist()
    return [
        can.Message(
            timestamp=1.7e9 + 0.01 * i,
            arbitration_id=0x18FEF100 if shared else 0x18FEF100 + channel,
            channel=channel,
            is_fd=fd and i % 5 == 0,
            data=rng.bytes(12 if fd and i % 5 == 0 else 8),
        )
        for i, channel in enumerate(channels)
    ]


def written(folder: Path, name: str, messages: list[can.Message]) -> Path:
    path = folder / name
    if style := STYLES.get(name):
        recorded = [
            Recorded(t=0.01 * i, ident=m.arbitration_id, data=bytes(m.data), channel=int(m.channel or 0) + 1)
            for i, m in enumerate(messages)
        ]
        path.write_bytes(mdf(recorded, style))
        return path
    plain = folder / name.removesuffix(".gz")
    if plain.suffix == ".mf4":
        pytest.importorskip("asammdf")
    write(plain, messages)
    if plain != path:
        path.write_bytes(gzip.compress(plain.read_bytes()))
    return path


def payloads(log: Log) -> list[bytes]:
    frames = Frames.concatenate(list(log))
    return [bytes(row[:n]) for row, n in zip(frames.data, frames.length, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_one_channel_is_chosen_by_its_name(tmp_path: Path, name: str, shared: bool) -> None:
    messages = two_buses(shared)
    path = written(tmp_path, name, messages)
    for channel, chosen in enumerate(NAMES[name]):
        log = open_log(path, [chosen])
        assert payloads(log) == [bytes(m.data) for m in messages if m.channel == channel]
        assert sum(log.channels.counts.values()) == COUNT
    assert payloads(open_log(path, NAMES[name])) == [bytes(m.data) for m in messages]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_channels_without_a_common_id_are_read_as_one_bus(tmp_path: Path, name: str) -> None:
    messages = two_buses(shared=False)
    log = open_log(written(tmp_path, name, messages))
    assert payloads(log) == [bytes(m.data) for m in messages]
    first, second = NAMES[name]
    counts = [sum(m.channel == channel for m in messages) for channel in (0, 1)]
    assert log.channels.counts == {first: counts[0], second: counts[1]}
    assert payloads(log) == [bytes(m.data) for m in messages]  # once more


@pytest.mark.parametrize("name", NAMES)
def test_an_id_on_two_channels_is_refused_with_the_names_and_counts(tmp_path: Path, name: str) -> None:
    messages = two_buses(shared=True)
    text = message_of(written(tmp_path, name, messages))
    assert "both send 18FEF100; choose with --channel" in text
    for channel, chosen in enumerate(NAMES[name]):
        assert f"{chosen} ({sum(m.channel == channel for m in messages)} frames)" in text


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_channel_that_is_not_there_is_refused(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, name, two_buses(shared=False))
    with pytest.raises(Exception, match=r"no frame of channel 7; choose another --channel: it has channels \S+ \("):
        list(open_log(path, ["7"]))


def test_can_fd_frames_of_one_channel(tmp_path: Path) -> None:
    messages = two_buses(shared=True, fd=True)
    for name in ("a.blf", "a.asc", "a.log"):
        chosen = open_log(written(tmp_path, name, messages), NAMES[name][1:])
        assert payloads(chosen) == [bytes(m.data) for m in messages if m.channel == 1]


def test_a_log_without_names_of_channels_has_none_to_choose(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write(path, two_buses(shared=True))
    assert len(payloads(open_log(path))) == COUNT
    with pytest.raises(Exception, match=r"no frame of channel 1; .* it has channel without a name"):
        list(open_log(path, ["1"]))


def test_a_gzipped_mf4_that_is_cut_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "logger.mf4", two_buses(shared=False))
    packed = tmp_path / "cut.mf4.gz"
    packed.write_bytes(gzip.compress(path.read_bytes())[:-20])
    assert "cannot be read on" in message_of(packed)


# Commands


TRUCKS = (Truck(mass=20_000.0, A=1300.0, C=3.7), Truck(mass=36_000.0, A=2300.0, C=5.0))


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the log of each of two trucks, and one that has both, on channels 1 and 2."""
    folder = tmp_path_factory.mktemp("both")
    drives = [
        frames_of(simulate(truck, "highway", 270.0, np.random.default_rng(3 + i)).signals)
        for i, truck in enumerate(TRUCKS)
    ]
    drives[1] = replace(drives[1], t=drives[1].t - drives[1].t[0] + drives[0].t[0])
    for i, frames in enumerate(drives):
        write_log(frames, folder / f"{i + 1}.blf")
    messages = [(m, i) for i, frames in enumerate(drives) for m in frames.messages()]
    for message, channel in messages:
        message.channel = channel
    write(folder / "both.blf", [m for m, _ in sorted(messages, key=lambda each: each[0].timestamp)])
    return folder


def answer(cli: Cli, *arguments: object) -> dict[str, object]:
    status, out, _ = cli(*arguments, "--json")
    assert status == 0
    content: dict[str, object] = json.loads(out)
    return content


@pytest.mark.slow
@pytest.mark.parametrize("command", ["estimate", "replay", "inspect", "check"])
def test_commands_give_the_answer_of_the_channel_alone(cli: Cli, both: Path, tmp_path: Path, command: str) -> None:
    alone = answer(cli, command, both / "2.blf")
    (tmp_path / "c.toml").write_text("[bus]\nchannels = [2]\n")
    choices = (("--channel", "2"), ("--config", tmp_path / "c.toml"))
    for choice in choices[:1] if command == "replay" else choices:
        other = answer(cli, command, both / "both.blf", *choice)
        assert {k: v for k, v in other.items() if k != "log"} == {k: v for k, v in alone.items() if k != "log"}


@pytest.mark.slow
def test_a_command_without_a_choice_is_refused(cli: Cli, both: Path) -> None:
    fails(cli("estimate", both / "both.blf"), "channels 1 and 2 both send", "choose with --channel: it has channels 1")


@pytest.mark.slow
def test_a_second_bus_with_other_ids_is_noted_and_does_no_harm(cli: Cli, both: Path, tmp_path: Path) -> None:
    frames = Frames.concatenate(list(open_log(both / "1.blf")))
    messages = list(frames.messages())
    for message in messages:
        message.channel = 0
    comfort = [
        can.Message(timestamp=float(t), arbitration_id=0x3A0, is_extended_id=False, channel=1) for t in frames.t[::500]
    ]
    write(tmp_path / "a.blf", sorted([*messages, *comfort], key=lambda m: m.timestamp))
    alone = answer(cli, "estimate", both / "1.blf")
    for command in ("estimate", "diagnose"):  # replay reads as estimate does
        status, out, complaints = cli(command, tmp_path / "a.blf", "--json")
        assert status == 0
        assert f"channels 1 ({len(messages):,} frames), 2 ({len(comfort)} frames) are read as one bus" in complaints
        if command == "estimate":
            assert json.loads(out)["parameters"] == alone["parameters"]
    found = answer(cli, "inspect", tmp_path / "a.blf")
    assert found["frames"]["mixed_channels"] == {"1": len(messages), "2": len(comfort)}  # type: ignore[index]


@pytest.mark.slow
def test_a_fleet_reads_the_channel_that_is_chosen(both: Path, tmp_path: Path) -> None:
    path = tmp_path / "truck" / "both.blf"
    path.parent.mkdir()
    path.symlink_to(both / "both.blf")
    logs = find_logs([str(path.parent)]).logs
    mixed = run_fleet(logs, Config(), Serial())
    (rejected,) = mixed.grouped.rejected
    assert rejected.status == "unreadable"
    assert "choose with --channel" in rejected.reason
    chosen = run_fleet(logs, from_dict({"bus": {"channels": [2]}}), Serial())
    (alone,) = run_fleet(find_logs([str(both / "2.blf")]).logs, Config(), Serial()).results
    assert chosen.results == (alone,)


def test_an_id_with_eleven_bits_is_shown_so(tmp_path: Path) -> None:
    lines = [f"({i}.5) can{i % 2} 123#0011\n" for i in range(4)]
    (tmp_path / "a.log").write_text("".join(lines))
    assert "channels can0 and can1 both send 123;" in message_of(tmp_path / "a.log")
