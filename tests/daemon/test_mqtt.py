"""The estimate on a real MQTT broker: valid or gone, whatever happens to the broker."""

import shutil
import socket
import subprocess
import threading
from argparse import Namespace
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from broker import HOST, PATIENCE, Broker, Subscriber, free_port, retained, running, wait_for
from made_estimates import MARGINAL, made_estimate

from estimator import config
from estimator.answers.answer import decode
from estimator.answers.published import PublishedAnswer, Usability
from estimator.answers.status import State
from estimator.daemon.outputs.output import Output, Trouble
from estimator.daemon.service.assembly import plan
from estimator.daemon.service.status import published
from estimator.daemon.service.supervision import Signals, supervise

pytest.importorskip("paho.mqtt.client")
from estimator.daemon.outputs.mqtt import MqttChannel

STATE, THERE = "roadload/state", "roadload/availability"
EMPTY = b""


class Clock:
    """Time that the test sets, for the pace of reports and attempts."""

    def __init__(self) -> None:
        self.now, self.slept = 1000.0, 0.0

    def __call__(self) -> float:
        return self.now


def report(age: float = 0.0, status: str = "estimated", mean: float = MARGINAL.mean) -> PublishedAnswer:
    estimate = replace(made_estimate(0.0), mass=replace(MARGINAL, mean=mean))
    fresh = estimate if status == "estimated" else None
    return published(estimate, fresh, State.RECEIVING, age, 1.7e9 + age, 3600.0)


class Sender:
    """An output whose thread is the test's."""

    def __init__(self, port: int, **settings: object) -> None:
        self.clock = Clock()
        table = config.from_dict({"mqtt": {"host": HOST, "port": port, "client_id": "truck", **settings}}).mqtt
        assert table is not None
        self.channel = MqttChannel(table)
        self.output = Output(
            self.channel, table.period_s, np.random.default_rng(1), self.clock, lambda: self.clock.slept
        )

    def offer(self, content: PublishedAnswer, seconds: float = 1.0) -> None:
        """A second goes by, and the loop leaves a report."""
        self.clock.now += seconds
        self.output.offer(content)
        self.output.step(0.0)

    def settle(self) -> None:
        """Until the broker has confirmed everything."""
        wait_for(lambda: not self.channel._waiting, lambda: self.output.step(0.01))

    def end(self) -> None:
        self.output.stop()
        self.output._run()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    with running(tmp_path) as broker:
        yield broker


def state_of(content: bytes) -> PublishedAnswer:
    return decode(content, PublishedAnswer)


def mass_of(content: bytes) -> float:
    estimate = state_of(content).estimate
    assert estimate is not None
    assert estimate.parameters.mass_kg.mean is not None
    return estimate.parameters.mass_kg.mean


def test_a_newcomer_gets_the_valid_estimate_and_nothing_once_it_is_no_longer_valid(broker: Broker) -> None:
    sender, listening = Sender(broker.port), Subscriber(broker.port)
    sender.offer(report())
    sender.settle()
    kept = retained(broker.port)
    assert kept[THERE] == b"online"
    found = state_of(kept[STATE])
    assert found.status is Usability.ESTIMATED
    assert found.estimate is not None
    assert found.estimate.parameters.mass_kg.mean == MARGINAL.mean
    sender.offer(report(status="gone"))
    sender.settle()
    assert STATE not in retained(broker.port)
    wait_for(lambda: len(listening.contents(STATE)) == 3, listening.turn)
    _, withdrawn, invalid = listening.contents(STATE)
    assert withdrawn == EMPTY
    assert state_of(invalid).status is Usability.UNESTIMATED
    assert state_of(invalid).estimate is None
    assert [expiry for topic, content, _, expiry in listening.messages if topic == STATE and content] == [60, 60]
    listening.close()
    sender.end()


def test_a_daemon_that_stops_takes_the_estimate_back(broker: Broker) -> None:
    sender = Sender(broker.port)
    sender.offer(report())
    sender.settle()
    sender.end()
    assert retained(broker.port) == {THERE: b"offline"}


def test_a_daemon_that_dies_is_offline_by_its_last_will(broker: Broker) -> None:
    sender = Sender(broker.port)
    sender.offer(report())
    sender.settle()
    connection = sender.channel._client.socket()
    connection.shutdown(socket.SHUT_RDWR)
    wait_for(lambda: retained(broker.port)[THERE] == b"offline", lambda: None)
    sender.channel.close()


def test_the_estimate_of_a_run_that_died_is_withdrawn_by_the_next(broker: Broker) -> None:
    first = Sender(broker.port)
    first.offer(report())
    first.settle()
    second = Sender(broker.port)
    second.offer(report(status="none"))
    second.settle()
    assert STATE not in retained(broker.port)
    second.end()
    first.channel.close()


@pytest.mark.slow
def test_an_estimate_expires_in_the_broker_when_the_daemon_is_gone(broker: Broker) -> None:
    sender = Sender(broker.port, period_s=1, expire_after_s=2)
    sender.offer(report())
    sender.settle()
    assert STATE in retained(broker.port)
    wait_for(lambda: STATE not in retained(broker.port), lambda: None)
    sender.channel.close()


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
def test_a_new_conclusion_is_sent_at_once_and_the_same_every_period(broker: Broker, protocol: str) -> None:
    sender, listening = Sender(broker.port, protocol=protocol), Subscriber(broker.port)
    for second in range(25):
        sender.offer(report(age=second))
        sender.settle()
    sender.offer(report(age=0.0, mean=20_000.0))
    sender.settle()
    wait_for(lambda: len(listening.contents(STATE)) == 4, listening.turn)
    states = [state_of(content).estimate for content in listening.contents(STATE)]
    assert [state.age_s for state in states if state] == [0.0, 10.0, 20.0, 0.0]
    assert states[-1] is not None
    assert states[-1].parameters.mass_kg.mean == 20_000.0
    assert sender.output.sent == 4
    listening.close()
    sender.end()


@pytest.mark.slow
def test_after_an_outage_of_the_broker_nothing_old_is_sent(broker: Broker, caplog: pytest.LogCaptureFixture) -> None:
    """Every second has another conclusion; those of the outage are lost, none comes late or twice."""
    sender = Sender(broker.port)
    for second in range(5):
        sender.offer(report(mean=1000.0 + second))
        sender.settle()
    broker.kill()
    for second in range(5, 65):
        sender.offer(report(mean=1000.0 + second))
    assert not sender.output.is_open
    assert set(sender.output.failed) <= {Trouble.LOST, Trouble.UNREACHABLE}
    assert sum("not" in message or "lost" in message for message in caplog.messages) <= 2
    broker.start()
    listening = Subscriber(broker.port)
    for second in range(65, 165):
        sender.offer(report(mean=1000.0 + second))
        if sender.output.is_open:
            sender.settle()
    sender.end()
    wait_for(lambda: listening.contents(STATE)[-1:] == [EMPTY], listening.turn)
    seen = [round(mass_of(content)) - 1000 for content in listening.contents(STATE) if content]
    assert seen == list(range(seen[0], 165))
    assert 65 <= seen[0] <= 65 + 60
    assert sender.output.connections == 2
    listening.close()


def test_a_report_that_waited_too_long_is_not_sent(broker: Broker) -> None:
    sender = Sender(broker.port)
    sender.offer(report())
    sender.settle()
    sender.output.offer(report(mean=5.0))
    sender.clock.now += 6.0
    sender.output.step(0.0)
    assert sender.output.sent == 1
    sender.end()


def test_after_a_suspension_the_connection_is_made_anew_at_once(broker: Broker) -> None:
    sender = Sender(broker.port)
    sender.offer(report())
    sender.settle()
    sender.clock.now += 7200.0
    sender.clock.slept += 7200.0
    sender.offer(report(status="none"), seconds=0.5)
    assert sender.output.failed == {Trouble.SUSPENDED: 1}
    sender.offer(report(status="none"), seconds=1.0)
    sender.settle()
    assert sender.output.connections == 2
    assert retained(broker.port) == {THERE: b"online"}
    sender.end()


# Brokers that refuse


def test_a_wrong_password_is_refused_and_the_right_one_is_taken_up(tmp_path: Path) -> None:
    passwords, password, name = tmp_path / "passwords", tmp_path / "password", tmp_path / "name"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(passwords), "gateway", "right"], check=True)
    with running(tmp_path, f"allow_anonymous false\npassword_file {passwords}") as broker:
        for file, text in ((name, "gateway\n"), (password, "wrong\n")):
            file.write_text(text)
            file.chmod(0o600)
        sender = Sender(broker.port, username_file=str(name), password_file=str(password))
        sender.offer(report())
        assert sender.output.failed == {Trouble.REFUSED: 1}
        assert sender.output.problem == "the broker refuses the connection: Not authorized"
        password.write_text("right\n")
        sender.offer(report(), seconds=61.0)
        sender.settle()
        assert sender.output.is_open
        assert sender.output.problem == ""
        sender.end()


def test_a_message_that_may_not_be_published_is_told(tmp_path: Path) -> None:
    (tmp_path / "acl").write_text(f"topic write {THERE}\n")
    with running(tmp_path, f"allow_anonymous true\nacl_file {tmp_path / 'acl'}") as broker:
        sender = Sender(broker.port)
        sender.offer(report())
        wait_for(lambda: sender.output.failed, lambda: sender.output.step(0.01))
        assert sender.output.problem == "the broker refuses a message: Not authorized"


def openssl(*arguments: str) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl here")
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


# paho leaves the socket of a failed handshake to the garbage collector.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_broker_with_tls_is_believed_by_its_authority_alone(tmp_path: Path) -> None:
    authority, key, certificate = (str(tmp_path / name) for name in ("ca.pem", "key.pem", "cert.pem"))
    subject = ["-nodes", "-days", "2", "-newkey", "rsa:2048", "-subj", "/CN=test"]
    openssl("req", "-x509", *subject, "-keyout", str(tmp_path / "ca.key"), "-out", authority)
    openssl("req", *subject, "-keyout", key, "-out", str(tmp_path / "request"))
    (tmp_path / "names").write_text(f"subjectAltName=IP:{HOST}")
    signing = ["-CA", authority, "-CAkey", str(tmp_path / "ca.key"), "-CAcreateserial", "-days", "2"]
    openssl(
        "x509",
        "-req",
        "-in",
        str(tmp_path / "request"),
        *signing,
        "-extfile",
        str(tmp_path / "names"),
        "-out",
        certificate,
    )
    settings = (
        f"allow_anonymous true\ncafile {authority}\ncertfile {certificate}\nkeyfile {key}\nrequire_certificate true"
    )
    with running(tmp_path, settings) as broker:
        believing = Sender(broker.port, tls=True, ca_file=authority, certificate_file=certificate, key_file=key)
        believing.offer(report())
        believing.settle()
        assert believing.output.sent == 1
        believing.end()
        doubting = Sender(broker.port, tls=True, certificate_file=certificate, key_file=key)
        doubting.offer(report())
        assert "CERTIFICATE_VERIFY_FAILED" in doubting.output.problem
        plain = Sender(broker.port)
        plain.offer(report())
        assert not plain.output.is_open


# The whole daemon


@pytest.mark.slow
def test_a_daemon_is_online_until_its_configuration_has_no_broker(broker: Broker, tmp_path: Path) -> None:
    file, signals = tmp_path / "c.toml", Signals()
    plain = (
        f"[service]\nstate_directory = '{tmp_path}/state'\nruntime_directory = '{tmp_path}/run'\n"
        f"[reception]\ninterface = 'virtual'\nchannel = '{tmp_path}'\n"
    )
    file.write_text(f"{plain}[mqtt]\nhost = '{HOST}'\nport = {broker.port}\n")
    daemon = threading.Thread(target=supervise, args=(lambda: plan(file, None, Namespace()), signals))
    listening = Subscriber(broker.port)
    daemon.start()
    try:
        wait_for(lambda: any(listening.contents(STATE)), listening.turn)
        states = [state_of(content) for content in listening.contents(STATE) if content]
        assert (states[0].status, states[0].reason) == (Usability.UNESTIMATED, "no estimate yet")
        file.write_text(plain)
        signals.reload.set()
        wait_for(lambda: listening.contents(THERE)[-1:] == [b"offline"], listening.turn)
    finally:
        signals.stop.set()
        daemon.join(PATIENCE)
        listening.close()
    assert not daemon.is_alive()
    assert retained(broker.port) == {THERE: b"offline"}


# Others at the port of the broker


class Impostor:
    """Answers one connection after another with bytes of its own, and then holds or ends it."""

    def __init__(self, *answers: bytes, holds: bool = True) -> None:
        self._socket = socket.create_server((HOST, free_port()))
        self.port = self._socket.getsockname()[1]
        self._answers, self._holds = answers, holds
        self._held: list[socket.socket] = []
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        for answer in self._answers:
            connection, _ = self._socket.accept()
            self._held.append(connection)
            with suppress(OSError):  # the other end may be the first to leave
                connection.recv(1000)
                connection.sendall(answer)
                if not self._holds:
                    connection.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        self._thread.join(PATIENCE)
        for connection in self._held:
            connection.close()
        self._socket.close()


CONNACK = bytes([0x20, 3, 0, 0, 0])


def garbage(count: int) -> list[bytes]:
    rng = np.random.default_rng(5)
    kinds = rng.integers(0, 3, count)
    noise = [rng.bytes(int(size)) for size in rng.integers(1, 200, count)]
    framed = [bytes([head[0] & 0xF0, len(head[1:]) & 0x7F]) + head[1:] for head in noise]
    return [(noise[i], framed[i], CONNACK + framed[i])[kind] + b"\xff" * 8 for i, kind in enumerate(kinds)]


def test_garbage_from_a_broker_ends_the_connection_and_is_counted() -> None:
    answers = garbage(60)
    impostor = Impostor(*answers, holds=False)
    sender = Sender(impostor.port)
    for _ in answers:
        sender.offer(report(), seconds=61.0)
        wait_for(lambda: not sender.output.is_open, lambda: sender.output.step(0.01))
    impostor.close()
    assert sender.output.failed.total() == len(answers)
    assert set(sender.output.failed) <= set(Trouble)
    assert sender.output.failed[Trouble.GARBAGE] > 10
    assert sender.output.sent <= len(answers)


def test_a_broker_that_stops_to_confirm_is_left_and_nothing_piles_up() -> None:
    impostor = Impostor(CONNACK + bytes([0x40, 2, 0, 1]))
    sender, patience = Sender(impostor.port), Clock()
    sender.channel._clock = patience
    for _ in range(10):
        sender.offer(report(mean=patience.now))
        patience.now += 1.0
        assert len(sender.channel._waiting) == 1  # the first report; no other before it is confirmed
    assert (sender.output.sent, sender.output.is_open) == (1, True)
    sender.offer(report())
    assert sender.output.failed == {Trouble.TIMED_OUT: 1}
    impostor.close()


def test_a_broker_says_why_it_ends_the_connection() -> None:
    """Two daemons with one client id: MQTT 5 has a reason for that."""
    impostor = Impostor(CONNACK + bytes([0x40, 2, 0, 1]) + bytes([0xE0, 2, 0x8E, 0]))
    sender = Sender(impostor.port)
    sender.offer(report())
    wait_for(lambda: sender.output.failed, lambda: sender.output.step(0.01))
    assert sender.output.problem == "the broker ends the connection: Session taken over"
    impostor.close()


@pytest.mark.slow
def test_a_program_that_does_not_answer_is_left() -> None:
    impostor = Impostor(b"")
    sender = Sender(impostor.port)
    times = iter(range(1000))
    sender.channel._clock = lambda: float(next(times))
    sender.offer(report())
    assert sender.output.failed == {Trouble.TIMED_OUT: 1}
    impostor.close()
