"""What the daemon hands to other programs, and that none of them holds it up."""

import json
import logging
import re
import sys
import threading
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from daemon_bench import EPOCH, Bench
from hypothesis import given, settings
from hypothesis import strategies as st
from jinja2 import Environment
from made_estimates import MARGINAL, made_estimate

from estimator import config
from estimator.answers.answer import decode, encode
from estimator.answers.published import PublishedAnswer, Usability
from estimator.answers.status import State, StatusAnswer
from estimator.daemon.outputs.credentials import read_secret
from estimator.daemon.outputs.home_assistant import discovery, discovery_topic
from estimator.daemon.outputs.output import MAX_PAUSE, Output, OutputError, Trouble
from estimator.daemon.outputs.vss import MAX_WEIGHT, WEIGHT, signals
from estimator.daemon.service import metrics
from estimator.daemon.service.assembly import plan
from estimator.daemon.service.status import published
from estimator.daemon.service.worker import Knowledge
from estimator.errors import ConfigError
from estimator.estimates import Status
from estimator.extras import how_to_install

PATIENCE = 20.0  # s for threads to get somewhere
STALE_AFTER = 3600.0  # s


@dataclass
class Heard:
    """A channel that keeps what it is sent."""

    address: str = "test"
    reports: list[PublishedAnswer] = field(default_factory=list)
    problems: list[Exception] = field(default_factory=list)  # raised by the next sends
    withdrawn: int = 0

    def open(self) -> None:
        pass

    def attend(self) -> None:
        pass

    def send(self, report: PublishedAnswer) -> bool:
        if self.problems:
            raise self.problems.pop(0)
        self.reports.append(report)
        return True

    def withdraw(self, timeout: float) -> None:
        self.withdrawn += 1

    def close(self) -> None:
        pass


def bench_with(channel: Heard, period: float = 10.0) -> tuple[Bench, Output]:
    """A daemon with an output whose thread is the test's."""
    bench = Bench(outputs={})
    output = Output(channel, period, np.random.default_rng(1), lambda: bench.now, lambda: 0.0)
    bench.daemon._outputs = {"test": output}
    return bench, output


def drive(bench: Bench, output: Output, seconds: float, **known: object) -> None:
    """Traffic for a while, with what the estimator knows at its end."""
    bench.traffic(seconds)
    bench.worker.knowledge = Knowledge(t=EPOCH + bench.now, **known)  # type: ignore[arg-type]
    bench.daemon._report(bench.now)
    output.step(0.0)


def test_an_estimate_is_handed_over_with_its_age() -> None:
    channel = Heard()
    bench, output = bench_with(channel)
    bench.turn()
    drive(bench, output, 3.0, estimate=made_estimate(EPOCH + 101.0))
    report = channel.reports[-1]
    assert (report.status, report.reason, report.state) == (Usability.ESTIMATED, "", State.RECEIVING)
    assert report.estimate is not None
    assert report.estimate.age_s == pytest.approx(bench.now - 101.0, abs=0.01)
    assert report.estimate.parameters.mass_kg.mean == MARGINAL.mean
    assert report.written_s == pytest.approx(EPOCH + bench.now, abs=0.01)


@pytest.mark.parametrize("status", [Status.INVALID, Status.UNESTIMATED])
def test_values_that_may_not_be_used_are_not_handed_over(status: Status) -> None:
    channel = Heard()
    bench, output = bench_with(channel)
    bench.turn()
    drive(bench, output, 3.0, estimate=made_estimate(EPOCH + 101.0, status))
    assert channel.reports[-1].status.value == status.value
    assert str(MARGINAL.mean) not in encode(channel.reports[-1]).decode()


def test_an_estimate_that_is_too_old_is_stale_and_has_no_value() -> None:
    channel = Heard()
    bench, output = bench_with(channel)
    bench.turn()
    bench.daemon._stale_after = 60.0
    drive(bench, output, 3.0, estimate=made_estimate(EPOCH + 101.0))
    assert channel.reports[-1].status is Usability.ESTIMATED
    drive(bench, output, 65.0, estimate=made_estimate(EPOCH + 101.0))
    assert channel.reports[-1].status is Usability.STALE
    assert channel.reports[-1].estimate is None


def test_after_a_silence_in_which_the_load_may_have_changed_there_is_no_value() -> None:
    channel = Heard()
    bench, output = bench_with(channel)
    bench.turn()
    drive(bench, output, 3.0, estimate=made_estimate(EPOCH + 101.0))
    bench.now += 901.0
    bench.daemon.turn()
    output.step(0.0)
    assert channel.reports[-1].status is Usability.UNESTIMATED
    assert channel.reports[-1].reason == "the load may have changed since the latest conclusion"
    assert channel.reports[-1].estimate is None


def test_the_first_report_after_a_suspension_has_no_value_that_is_too_old() -> None:
    """The clock counts the time asleep, so the first turn after waking up withholds what is no longer valid."""
    channel = Heard()
    bench, output = bench_with(channel)
    bench.turn()
    drive(bench, output, 3.0, estimate=made_estimate(EPOCH + 101.0))
    sent = len(channel.reports)
    bench.now += 8 * STALE_AFTER
    bench.daemon.turn()
    output.step(0.0)
    assert [report.estimate for report in channel.reports[sent:]] == [None]


def test_the_status_and_the_metrics_show_an_output() -> None:
    channel = Heard(problems=[OutputError(Trouble.REFUSED, "no entry")])
    bench, output = bench_with(channel)
    bench.turn()
    drive(bench, output, 2.0)
    status = bench.daemon.status(bench.now)
    shown = decode(encode(status), StatusAnswer).outputs["test"]
    assert (shown.connected, shown.problem, shown.failed) == (False, "no entry", {"refused": 1})
    text = metrics.exposition(status)
    assert 'roadload_output_connected{output="test"} 0' in text
    assert 'roadload_output_failed_total{output="test",reason="refused"} 1' in text


# An output that fails


def test_attempts_become_rarer_and_the_log_has_one_line_for_all(caplog: pytest.LogCaptureFixture) -> None:
    class Absent(Heard):
        def open(self) -> None:
            attempts.append(now[0])
            raise OutputError(Trouble.UNREACHABLE, "nobody there")

    now, attempts = [0.0], list[float]()
    channel = Absent()
    output = Output(channel, 10.0, np.random.default_rng(1), lambda: now[0], lambda: 0.0)
    with caplog.at_level(logging.INFO):
        for _ in range(3600):
            output.step(0.0)
            now[0] += 1.0
    pauses = np.diff(attempts)
    assert pauses[0] <= 2.0
    assert (pauses[-20:] <= MAX_PAUSE + 1).all()
    assert (pauses[-20:] >= MAX_PAUSE / 2).all()
    assert output.failed == {Trouble.UNREACHABLE: len(attempts)}
    assert caplog.messages == ["test: nobody there; tried again until it works"]


def test_an_error_of_any_kind_ends_the_connection_and_not_the_output(caplog: pytest.LogCaptureFixture) -> None:
    channel = Heard(problems=[ZeroDivisionError("broken")])
    bench, output = bench_with(channel)
    bench.turn()
    drive(bench, output, 2.0)
    assert output.failed == {Trouble.GARBAGE: 1}
    assert "not understood: ZeroDivisionError('broken')" in caplog.text
    drive(bench, output, 2.0)
    assert output.is_open
    assert channel.reports


def test_an_output_that_hangs_holds_up_neither_the_loop_nor_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread sleeps in a call while the daemon turns; only the newest report waits."""
    hanging, release = threading.Event(), threading.Event()

    class Hanging(Heard):
        def send(self, report: PublishedAnswer) -> bool:
            hanging.set()
            release.wait(PATIENCE)
            return super().send(report)

    monkeypatch.setattr("estimator.daemon.outputs.output.FAREWELL", 0.01)
    channel = Hanging()
    bench, output = bench_with(channel)
    bench.turn()
    output.start()
    bench.traffic(1.5)
    assert hanging.wait(PATIENCE)
    bench.traffic(30.0)
    assert output._newest is not None
    assert output._newest[1] == pytest.approx(bench.now, abs=1.1)
    assert channel.reports == []
    bench.daemon.close()
    release.set()
    assert output._thread is not None
    output._thread.join(PATIENCE)
    assert not output._thread.is_alive()


def test_an_output_withdraws_its_report_when_the_daemon_stops() -> None:
    heard = threading.Event()

    class Telling(Heard):
        def send(self, report: PublishedAnswer) -> bool:
            heard.set()
            return super().send(report)

    channel = Telling()
    bench, output = bench_with(channel)
    output.start()
    bench.turn()
    bench.traffic(2.0)
    assert heard.wait(PATIENCE)
    bench.daemon.close()
    assert output._thread is not None
    assert not output._thread.is_alive()
    assert channel.withdrawn == 1


# Configuration


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"mqtt": {}}, "mqtt: Object missing required field `host`"),
        ({"mqtt": {"host": "a", "frobnicate": 1}}, "mqtt.frobnicate: no such key; there are host, port, topic"),
        ({"mqtt": {"host": "a", "topics": "x"}}, "mqtt.topics: no such key; did you mean topic?"),
        ({"mqtt": {"host": "a", "topic": "fleet/#"}}, "mqtt.topic: "),
        ({"mqtt": {"host": "a", "port": 70_000}}, "mqtt.port: "),
        ({"mqtt": {"host": "a", "client_id": "a b"}}, "mqtt.client_id: "),
        ({"mqtt": {"host": "a", "ca_file": "x"}}, "mqtt.ca_file: is for TLS, which is off; write tls = true"),
        ({"mqtt": {"host": "a", "tls": True, "key_file": "x"}}, "mqtt.certificate_file: goes with mqtt.key_file"),
        ({"mqtt": {"host": "a", "password_file": "x"}}, "mqtt.password_file: goes with mqtt.username_file"),
        ({"mqtt": {"host": "a", "period_s": 60}}, "mqtt.expire_after_s: 60 s is not longer than mqtt.period_s = 60"),
        ({"kuksa": {"port": 1}}, "kuksa: Object missing required field `host`"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(table: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        config.from_dict(table)
    assert str(caught.value).startswith(said)


def test_files_are_relative_to_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text('[mqtt]\nhost = "h"\nusername_file = "name"\n[kuksa]\nhost = "k"\ntoken_file = "/run/token"\n')
    settings = config.load(path)
    assert settings.mqtt is not None
    assert settings.kuksa is not None
    assert settings.mqtt.username_file == str(tmp_path / "name")
    assert settings.kuksa.token_file == "/run/token"


def test_outputs_do_not_belong_to_the_saved_state() -> None:
    plain = config.from_dict({})
    sending = config.from_dict({"mqtt": {"host": "h"}, "kuksa": {"host": "k"}})
    assert config.state_key(plain) == config.state_key(sending)


@pytest.mark.parametrize(("library", "table"), [("paho", "mqtt"), ("kuksa", "kuksa")])
def test_a_library_that_is_not_installed_is_named_with_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, table: str
) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f"[{table}]\nhost = 'h'\n[reception]\ninterface = 'virtual'\nchannel = 'c'\n")
    for name in [name for name in sys.modules if name.split(".")[0] == library or name.endswith(f"outputs.{table}")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ConfigError, match=rf"{table}: needs .*: {re.escape(how_to_install(table))}"):
        plan(path, None, Namespace())


def secret(folder: Path, content: bytes, mode: int = 0o600) -> str:
    path = folder / "secret"
    path.write_bytes(content)
    path.chmod(mode)
    return str(path)


def test_a_secret_is_one_line_of_a_file(tmp_path: Path) -> None:
    assert read_secret(secret(tmp_path, "pässword with spaces\n".encode()), "key") == "pässword with spaces"


@pytest.mark.parametrize(
    ("content", "mode", "said"),
    [
        (b"right", 0o644, "is open to every user; chmod o-rw"),
        (b"", 0o600, "must hold one line of text"),
        (b"two\nlines\n", 0o600, "must hold one line of text"),
        (b"\xff\xfe", 0o600, "must hold one line of text"),
        (b"x" * 20_000, 0o600, "is larger than"),
    ],
)
def test_a_secret_that_cannot_be_one_is_refused(tmp_path: Path, content: bytes, mode: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        read_secret(secret(tmp_path, content, mode), "mqtt.password_file")
    assert str(caught.value).startswith("mqtt.password_file: ")
    assert content[:5] not in str(caught.value).encode() or not content


def test_a_secret_that_is_not_there_is_refused_before_the_daemon_starts(tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt.client")
    path = tmp_path / "c.toml"
    path.write_text(
        "mqtt = { host = 'h', username_file = 'name' }\n[reception]\ninterface = 'virtual'\nchannel = 'c'\n"
    )
    with pytest.raises(ConfigError, match=r"mqtt\.username_file: .*/name: No such file"):
        plan(path, None, Namespace())


# Home Assistant


@pytest.fixture(scope="module")
def rendered() -> Callable[[str, bytes], str]:
    """A template of Home Assistant for the content of a message; what is no JSON has no value_json."""
    templates = Environment(autoescape=False)
    templates.filters["to_json"] = json.dumps

    def render(template: str, content: bytes) -> str:
        try:
            values = {"value_json": json.loads(content)}
        except ValueError:
            values = {}
        return templates.from_string(template).render(values)

    return render


def test_home_assistant_is_told_of_a_weight_in_kilograms(rendered: Callable[[str, bytes], str]) -> None:
    described = json.loads(discovery("truck_1", "fleet/1/state", "fleet/1/availability", 60))
    assert discovery_topic("homeassistant", "truck_1") == "homeassistant/device/truck_1/config"
    assert described["availability_topic"] == "fleet/1/availability"
    mass = described["components"]["mass_kg"]
    assert (mass["device_class"], mass["unit_of_measurement"], mass["expire_after"]) == ("weight", "kg", 60)
    assert len({sensor["unique_id"] for sensor in described["components"].values()}) == 4
    estimate = made_estimate()
    valid = encode(published(estimate, estimate, State.RECEIVING, 1.0, 1.7e9, STALE_AFTER))
    gone = encode(published(estimate, None, State.RECEIVING, 1.0, 1.7e9, STALE_AFTER))
    for name, sensor in described["components"].items():
        template = sensor["value_template"]
        assert rendered(template, valid) == ("estimated" if name == "status" else str(MARGINAL.mean))
        assert rendered(template, gone) == ("unestimated" if name == "status" else "None")
        assert rendered(template, b"") == "None"
    attributes = mass["json_attributes_template"]
    assert json.loads(rendered(attributes, valid))["q05"] == MARGINAL.q05
    assert json.loads(rendered(attributes, gone)) == json.loads(rendered(attributes, b"")) == {}


# VSS


@settings(max_examples=50)
@given(st.floats(0.0, 200_000.0), st.booleans())
def test_the_standard_weight_is_the_mass_or_not_available(mass: float, overlay: bool) -> None:
    estimate = replace(made_estimate(), mass=replace(MARGINAL, mean=mass))
    listed = signals(published(estimate, estimate, State.RECEIVING, 1.0, 1.7e9, STALE_AFTER), overlay)
    weight = listed[0]
    assert (weight.path, weight.kind) == (WEIGHT, "uint32")
    assert weight.value == (round(mass) if round(mass) <= MAX_WEIGHT else None)
    assert len(listed) == (14 if overlay else 1)
    if overlay:
        assert {signal.path: signal.value for signal in listed}["Vehicle.RoadLoad.Mass.Mean"] == mass


def test_without_an_estimate_no_signal_but_the_status_has_a_value() -> None:
    listed = signals(published(made_estimate(), None, State.RECEIVING, 1.0, 1.7e9, STALE_AFTER), overlay=True)
    assert listed == signals(None, overlay=True)
    assert {signal.value for signal in listed} == {None, "UNESTIMATED"}
    assert all(signal.kind == "string" for signal in listed if signal.value is not None)


def test_a_parameter_that_is_not_known_yet_has_a_status_of_its_own() -> None:
    estimate = replace(made_estimate(), C=None)
    listed = signals(published(estimate, estimate, State.RECEIVING, 1.0, 1.7e9, STALE_AFTER), overlay=True)
    values = {signal.path: signal.value for signal in listed}
    assert values["Vehicle.RoadLoad.Mass.Status"] == "ESTIMATED"
    assert values["Vehicle.RoadLoad.Drag.Status"] == "UNESTIMATED"
    assert values["Vehicle.RoadLoad.Drag.Mean"] is None
