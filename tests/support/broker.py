"""A real MQTT broker and a subscriber for tests of what is published."""

import os
import pwd
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

PATIENCE = 20.0  # s for a broker to answer
HOST = "127.0.0.1"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def wait_for(is_done: Callable[[], object], step: Callable[[], object]) -> None:
    """Take steps until something is done."""
    deadline = time.monotonic() + PATIENCE
    while not is_done():
        assert time.monotonic() < deadline, "it did not happen"
        step()


class Broker:
    """A mosquitto that can be killed and started again on its port, which forgets what it retained."""

    def __init__(self, folder: Path, settings: str = "", port: int | None = None) -> None:
        if shutil.which("mosquitto") is None:
            pytest.skip("no mosquitto here")
        self.port = port or free_port()
        self._file = folder / f"mosquitto-{self.port}.conf"
        user = pwd.getpwuid(os.geteuid()).pw_name  # that of the tests may read their files
        listener = f"user {user}\nlistener {self.port} {HOST}"
        self._file.write_text(f"{listener}\n{settings or 'allow_anonymous true'}\n")
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        program = shutil.which("mosquitto") or ""
        self._process = subprocess.Popen([program, "-c", str(self._file)], stderr=subprocess.DEVNULL)
        wait_for(self._answers, lambda: time.sleep(0.02))

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def _answers(self) -> bool:
        try:
            socket.create_connection((HOST, self.port), timeout=1.0).close()
        except OSError:
            return False
        return True


@contextmanager
def running(folder: Path, settings: str = "") -> Iterator[Broker]:
    broker = Broker(folder, settings)
    broker.start()
    try:
        yield broker
    finally:
        broker.kill()


@dataclass
class Subscriber:
    """Everything published since it came, retained messages first: topic, content, retained, expiry [s]."""

    port: int
    messages: list[tuple[str, bytes, bool, int | None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        mqtt = pytest.importorskip("paho.mqtt.client")
        self._is_ready = False
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self._client.on_message = self._take
        self._client.on_subscribe = self._ready
        self._client.connect(HOST, self.port)
        self._client.subscribe("#", qos=1)
        wait_for(lambda: self._is_ready, self.turn)

    def turn(self) -> None:
        self._client.loop(0.02)

    def contents(self, topic: str) -> list[bytes]:
        return [content for name, content, _, _ in self.messages if name == topic]

    def close(self) -> None:
        self._client.disconnect()

    def _ready(self, *_: object) -> None:
        self._is_ready = True

    def _take(self, client: object, userdata: object, message: object) -> None:
        expiry = getattr(message.properties, "MessageExpiryInterval", None)  # type: ignore[attr-defined]
        self.messages.append((message.topic, message.payload, message.retain, expiry))  # type: ignore[attr-defined]


def retained(port: int) -> dict[str, bytes]:
    """What the broker has kept: all that a newcomer gets before a message of its own comes back."""
    newcomer = Subscriber(port)
    newcomer._client.publish("end", b"", qos=1)
    wait_for(lambda: newcomer.contents("end"), newcomer.turn)
    newcomer.close()
    return {topic: content for topic, content, is_retained, _ in newcomer.messages if is_retained}
