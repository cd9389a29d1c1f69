"""`roadload run` between two real buses: driving comes in on one, the estimate goes out on the other."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from conftest import ip
from vm.machine import EARLY_GATE, QUICK_SAMPLER

from estimator.can_io.counter_crc import verify
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.j1939_node import ADDRESS_CLAIMED
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_database
from estimator.checkpoint.store import StateStore
from estimator.config import load, state_key
from estimator.daemon.service.assembly import plan
from estimator.daemon.service.supervision import Signals, supervise
from estimator.daemon.service.worker import Worker
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

# python-can leaves the socket of an attempt that failed to the garbage collector.
pytestmark = [pytest.mark.nightly, pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")]

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
KNOWN, PLAYED = 400.0, 90.0  # s of driving: before the daemon starts, and at most while it runs
START = 5.0  # s of driving, where it need only be heard: 800 frames
LONGEST = 60.0  # s for anything here to happen; the machine is slow
SERVICE = """
[service]
state_directory = "{folder}"
runtime_directory = "{folder}"
"""
ESTIMATED, WITHHELD = "estimated", "not available"


def driven(duration: float) -> Frames:
    rng = np.random.default_rng(1)
    return frames_of(record(TRUCK, generate_route("mixed", 30e3, rng), duration, rng).signals)


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    path = tmp_path / "roadload.toml"
    path.write_text(QUICK_SAMPLER + EARLY_GATE + SERVICE.format(folder=tmp_path))
    return path


class Listener:
    """Everything that is heard on a bus, decoded as the shipped roadload.dbc says."""

    def __init__(self, channel: str) -> None:
        self._bus = can.Bus(interface="socketcan", channel=channel, ignore_config=True)
        self._bus.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self.messages: list[can.Message] = []

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def wait_for(self, wanted: Callable[[can.Message], bool], what: str, longest: float = LONGEST) -> can.Message:
        """Listen until a message is as wanted; it and those before it are kept."""
        deadline = time.monotonic() + longest
        while (left := deadline - time.monotonic()) > 0:
            message = self._bus.recv(left)
            if message is not None:
                self.messages.append(message)
                if wanted(message):
                    return message
        pytest.fail(f"waited {longest:g} s for: {what}; heard {[str(m) for m in self.messages[-5:]]}")

    def drain(self) -> None:
        while (message := self._bus.recv(0.5)) is not None:
            self.messages.append(message)


def group(message: can.Message) -> int:
    """PGN, without the destination of a message to somebody."""
    pgn = message.arbitration_id >> 8 & 0x3FFFF
    return pgn if pgn >> 8 & 0xFF >= 240 else pgn & 0x3FF00


def source(message: can.Message) -> int:
    return message.arbitration_id & 0xFF


def values(message: can.Message) -> dict[str, float | str]:
    """Signals of one of our groups; those of other groups are none."""
    layouts = {layout.frame_id >> 8 & 0x3FFFF: layout for layout in output_database().messages}
    return layouts[group(message)].decode(bytes(message.data)) if group(message) in layouts else {}


def remember(drive: Frames, settings: Path) -> None:
    """Leave the state of a daemon that heard the first part of the drive, until half a minute ago."""
    config = load(settings)
    before = drive[drive.t - drive.t[0] < KNOWN]
    worker = Worker(Pipeline(config), len(before), StateStore(settings.parent), state_key(config))
    worker.offer(replace(before, t=before.t - before.t[-1] + time.time() - 30))
    worker.close()


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`roadload` as a process of its own; killed if the test does not end it."""
    command = [sys.executable, "-m", "estimator", *arguments]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as daemon:
        try:
            yield daemon
        finally:
            daemon.kill()


@contextmanager
def thread(settings: Path, channel: str, *, output: str | None = None, transmit: bool = False) -> Iterator[Signals]:
    """The daemon in this process, which saves the time of starting another."""
    options = Namespace(interface="socketcan", channel=channel, transmit=transmit)
    if output:
        options.output_interface, options.output_channel = "socketcan", output
    signals, failures = Signals(), []

    def run() -> None:
        try:
            supervise(lambda: plan(settings, None, options), signals)
        except BaseException as error:
            failures.append(error)
            raise

    running = threading.Thread(target=run)
    running.start()
    try:
        yield signals
    finally:
        signals.stop.set()
        running.join(LONGEST)
    assert not running.is_alive()
    assert not failures


def status(folder: Path, condition: Callable[[dict], bool], what: str) -> dict:
    """The status file, once it says what is waited for."""
    deadline = time.monotonic() + LONGEST
    content: dict = {}
    while time.monotonic() < deadline:
        path = folder / "status.json"
        content = json.loads(path.read_text()) if path.exists() else {}
        if content and condition(content):
            return content
        time.sleep(0.1)
    pytest.fail(f"waited {LONGEST:g} s for: {what}; the status says {content}")


def play(drive: Frames, folder: Path, channel: str) -> subprocess.Popen[bytes]:
    """The second part of the drive, played by python-can's own player."""
    log = folder / "drive.log"
    write_log(drive[drive.t - drive.t[0] >= KNOWN], log)
    return subprocess.Popen([sys.executable, "-m", "can.player", "-i", "socketcan", "-c", channel, str(log)])


def test_a_played_log_comes_back_as_an_estimate_on_the_other_bus(buses, settings):
    (inward, outward), drive = buses, driven(KNOWN + PLAYED)
    remember(drive, settings)
    bus = ["-i", "socketcan", "-c", inward, "--output-interface", "socketcan", "--output-channel", outward]
    with (
        Listener(outward) as out,
        process("run", *bus, "--transmit", "--config", str(settings)) as daemon,
        play(drive, settings.parent, inward) as player,
    ):
        out.wait_for(lambda m: group(m) == 0xFF60, "the first status")
        out.wait_for(lambda m: values(m).get("EstimateStatus") == ESTIMATED, "an estimate")
        content = status(settings.parent, lambda s: s["frames_used"] > 1000, "frames used")
        mass = out.wait_for(
            lambda m: group(m) == 0xFF61 and values(m)["EstimateStatus"] == ESTIMATED, "the mass estimated"
        )
        shown = subprocess.run(
            [sys.executable, "-m", "estimator", "status", "--json", "--config", str(settings)],
            capture_output=True,
            text=True,
        )
        assert player.poll() is None  # the vehicle drives on, so receivers are told
        daemon.send_signal(signal.SIGTERM)
        _, log = daemon.communicate(timeout=LONGEST)
        assert daemon.returncode == 0, log
        player.terminate()
        out.drain()

    assert values(mass)["MassMean"] == pytest.approx(TRUCK.mass, rel=0.05)
    assert values(mass)["MassQ05"] < values(mass)["MassMean"] < values(mass)["MassQ95"]
    ours = [m for m in out.messages if group(m) in range(0xFF60, 0xFF65)]
    assert all(verify(message) for message in ours)
    # The address is claimed, and the claim has stood for 250 ms, before anything is said.
    assert [group(m) for m in out.messages[:2]] == [0xEA00, ADDRESS_CLAIMED]
    assert ours[0].timestamp - out.messages[1].timestamp >= 0.25
    assert {source(m) for m in ours} == {0xFB}
    # The last word is that nothing is known any more.
    last = {group(m): values(m) for m in ours}
    assert last[0xFF61]["MassMean"] == WITHHELD
    assert last[0xFF60]["EstimateStatus"] == "unestimated"
    # Nothing was lost, and everybody could read so.
    assert content["state"] == "receiving"
    assert content["input"]["kernel_drops"] == content["input"]["queue_drops"] == 0
    told = json.loads(shown.stdout)
    assert told["running"]
    assert told["estimate"]["status"] == ESTIMATED
    assert told["input"]["frames"] >= content["input"]["frames"]


def test_without_permission_nothing_is_sent(buses, settings):
    """Listen-only is the default, and holds through loss and return of the interface."""
    inward, _ = buses
    frames = [m for m in driven(START)[:400].messages() if group(m) not in (0xEC00, 0xEB00)]
    with Listener(inward) as on_bus, thread(settings, inward):
        status(settings.parent, lambda s: s["input"]["open"], "the bus to open")
        with can.Bus(interface="socketcan", channel=inward, ignore_config=True) as player:
            for message in frames:
                player.send(message)
        status(settings.parent, lambda s: s["state"] == "receiving" and s["input"]["frames"] > 0, "reception")
        status(settings.parent, lambda s: s["state"] == "ignition off", "silence to be told from a fault")
        on_bus.drain()
        assert len(on_bus.messages) == len(frames)


def test_the_bus_may_go_and_come_back(buses, settings):
    inward, outward = buses
    folder, drive = settings.parent, driven(START)

    def drive_on(first: int) -> None:
        before = status(folder, lambda s: True, "a status")["input"]["frames"]
        with can.Bus(interface="socketcan", channel=inward, ignore_config=True) as player:
            for message in drive[first : first + 200].messages():
                player.send(message)
        status(folder, lambda s: s["state"] == "receiving" and s["input"]["frames"] > before, "reception")
        out.wait_for(lambda m: group(m) == 0xFF60, "the broadcast")

    with Listener(outward) as out, thread(settings, inward, output=outward, transmit=True):
        status(folder, lambda s: s["input"]["open"] and s["output"]["open"], "both buses to open")
        drive_on(0)
        ip("set", "dev", inward, "down")
        status(folder, lambda s: s["state"] == "waiting for interface", "the loss to be told")
        ip("set", "dev", inward, "up")
        status(folder, lambda s: s["input"]["open"] and s["input"]["up"], "the return")
        drive_on(200)
        ip("delete", "dev", inward)
        status(folder, lambda s: s["state"] == "waiting for interface", "the loss to be told")
        ip("add", "dev", inward, "type", "vcan")
        ip("set", "dev", inward, "up")
        status(folder, lambda s: s["input"]["open"] and s["input"]["up"], "the return")
        drive_on(400)
        content = status(folder, lambda s: True, "a status")
    assert content["input"]["reopened"] >= 2
    assert content["output"]["reopened"] == 0


@pytest.mark.parametrize(
    ("peer", "wins"), [("0000000000000001", True), ("ffffffffffffffff", False)], ids=["lower", "higher"]
)
def test_address_claim_against_another_implementation(buses, settings, tmp_path, peer, wins):
    """can-utils' j1939acd wants our address; the lower NAME keeps it, the other one moves."""
    bus, ours = buses[0], 0x80
    settings.write_text(settings.read_text() + f"[publish]\nsource_address = {ours}\n")
    claim = ["j1939acd", "-r", "128-140", "-a", "128", "-c", str(tmp_path / "claim"), peer, bus]
    frames = list(driven(START)[:600].messages())
    name = bytes.fromhex(peer)[::-1]
    with Listener(bus) as heard, thread(settings, bus, transmit=True), subprocess.Popen(claim) as acd:
        try:
            heard.wait_for(lambda m: group(m) == ADDRESS_CLAIMED and bytes(m.data) == name, "the other's claim")
            settled = status(
                tmp_path,
                lambda s: s["transmit"]["address"] is not None and (s["transmit"]["address"] != ours or not wins),
                "our address",
            )
            with can.Bus(interface="socketcan", channel=bus, ignore_config=True) as player:
                for message in frames:
                    player.send(message)
            heard.wait_for(lambda m: group(m) == 0xFF60, "our broadcast")
            heard.drain()
        finally:
            acd.terminate()
    claims = {bytes(m.data): source(m) for m in heard.messages if group(m) == ADDRESS_CLAIMED}
    addresses = {own: address for own, address in claims.items() if own != name}
    assert claims[name] == (ours if wins else ours + 1)
    assert list(addresses.values()) == [settled["transmit"]["address"]] == [ours + 1 if wins else ours]
    assert {source(m) for m in heard.messages if group(m) == 0xFF60} <= {ours, settled["transmit"]["address"]}
