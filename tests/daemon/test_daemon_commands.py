"""`roadload run`, `check` and `status` as a user meets them."""

import errno
import json
import os
import signal
import threading
import tomllib
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import can
import numpy as np
import pytest
from daemon_bench import Bench
from project_paths import ROOT

from estimator import config
from estimator.answers.answer import decode
from estimator.answers.status import NotRunningAnswer
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import open_log
from estimator.checkpoint.store import StateStore
from estimator.daemon.service import folder_lock, folders, supervision
from estimator.daemon.service.assembly import Plan, plan, restored
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.sd_notify import Notifier
from estimator.daemon.service.supervision import Signals, _reload, supervise
from estimator.daemon.service.worker import Worker
from estimator.errors import ConfigError, RoadloadError
from estimator.settings import Transmit, Vehicle
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

Outcome = tuple[int, str, str]
DBC = ROOT / "dbc"
PATIENCE = 20.0  # s for threads to get somewhere


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    file = tmp_path / "c.toml"
    file.write_text(
        f"[service]\nstate_directory = '{tmp_path}/state'\nruntime_directory = '{tmp_path}/run'\n"
        f"[reception]\ninterface = 'virtual'\nchannel = '{tmp_path}'\n"
    )
    return file


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(2)
    truck = Truck(mass=20_000.0, A=1200.0, C=3.5)
    path = tmp_path_factory.mktemp("daemon") / "drive.blf"
    write_log(frames_of(record(truck, generate_route("urban", 5e3, rng), 60.0, rng).signals), path)
    return path


def test_the_printed_configuration_is_the_one_in_force(cli: Callable[..., Outcome], settings: Path) -> None:
    status, out, _ = cli("run", "--config", settings, "--transmit", "-c", 'odd "name"', "--print-config")
    assert status == 0
    again = config.from_dict(tomllib.loads(out))
    before = config.load(settings)
    assert again.transmit.enabled
    assert again.reception.channel == 'odd "name"'
    assert again.binding == before.binding
    assert again.gate == before.gate


@pytest.mark.parametrize(
    ("text", "arguments", "fragment"),
    [
        ("", ["-i", "socketcan", "-c", "can/0"], "cannot be the name"),
        ("", ["-i", "virtual"], "no channel"),
        ("", ["-i", "nonsense", "-c", "x"], "nonsense"),
        ("", ["-i", "udp_multicast", "-c", "can0"], "give -c 239.0.0.77"),
        ("[transmit]\nenabled = 3\n", [], "transmit.enabled"),
        ("[bus]\ndbc = ['no.dbc']\n", [], "c.toml: DIR/no.dbc: No such file or directory; correct bus.dbc"),
        ("[signals]\nspeed = 'A.B'\n", [], "c.toml: signals.speed: the DBC has no message 'A'"),
        ("[signals]\nspeed = 'EEC1.EngSpeed'\n", [], "c.toml: bus.units: EEC1.EngSpeed has the unit 'rpm'"),
        ("effects = ['nonsense']\n", [], "c.toml: effects: 'nonsense' is not known"),
        ("[transmit]\nidentity = 3000000\n", [], "transmit.identity"),
        ("", ["-i", "virtual", "-c", "x", "--output-channel", "y", "--output-interface", "virtual"], "--transmit"),
        ("[service]\nstate_directory = '/proc/nowhere'\n", ["-i", "virtual", "-c", "x"], "/proc/nowhere"),
    ],
)
def test_what_can_never_work_is_one_line_and_status_2(
    cli: Callable[..., Outcome], tmp_path: Path, text: str, arguments: list[str], fragment: str
) -> None:
    (tmp_path / "c.toml").write_text(text)
    status, out, err = cli("run", "--config", tmp_path / "c.toml", *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert fragment.replace("DIR", str(tmp_path)) in err


def test_what_everybody_may_write_is_not_believed(cli: Callable[..., Outcome], settings: Path, tmp_path: Path) -> None:
    settings.chmod(0o666)
    status, _, err = cli("run", "--config", settings)
    assert status == 2
    assert "chmod o-w" in err
    settings.chmod(0o644)
    (tmp_path / "state").mkdir()
    (tmp_path / "state").chmod(0o777)
    status, _, err = cli("run", "--config", settings)
    assert status == 2
    assert "state" in err


def test_an_output_group_cannot_be_an_input(settings: Path, tmp_path: Path) -> None:
    source = (DBC / "roadload.dbc").read_text()
    (tmp_path / "own.dbc").write_text(source)
    text = settings.read_text() + (
        "[bus]\ndbc = ['own.dbc']\nmatch = 'pgn'\n[signals]\nspeed = 'RoadloadMass.MassMean'\n"
        "engine_power = 'RoadloadMass.MassQ05'\n[transmit]\nenabled = true\n"
    )
    (tmp_path / "own.dbc").write_text(source.replace('"kg"', '"km/h"', 1).replace('"kg"', '"kW"', 1))
    settings.write_text(text)
    with pytest.raises(ConfigError, match="0FF61 is an input here"):
        plan(settings, None, Namespace())


def test_a_state_belongs_to_what_it_was_estimated_with(
    settings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own.dbc").write_text((DBC / "j1939.dbc").read_text())
    base = config.from_dict({"bus": {"dbc": [str(tmp_path / "own.dbc")]}})
    key = config.state_key(base)
    assert config.state_key(config.replace(base, transmit=Transmit(enabled=True))) == key
    assert config.state_key(config.replace(base, vehicle=Vehicle(driveline_efficiency=0.9))) != key
    (tmp_path / "own.dbc").write_text((DBC / "j1939.dbc").read_text() + "\n")
    assert config.state_key(base) != key
    given, without = config.state_key(base), config.state_key(config.Config())
    monkeypatch.setattr(config, "files", lambda package: tmp_path)
    (tmp_path / "j1939.dbc").write_text("another version of what is shipped")
    assert config.state_key(config.Config()) != without
    assert config.state_key(base) == given


def test_a_state_is_used_again_under_other_limits_of_the_gate() -> None:
    usual, other = config.Config(), config.from_dict({"gate": {"interval_s": 20.0, "coverage": 0.3}})
    assert config.state_key(other) == config.state_key(usual)
    assert config.estimation_key(other) != config.estimation_key(usual)
    cells = config.from_dict({"gate": {"speed_step_m_s": 3.0}})  # which a state has by their numbers
    assert config.state_key(cells) != config.state_key(usual)


def test_a_state_that_is_refused_is_a_warning_that_names_what_changed(
    settings: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loaded, store = config.load(settings), StateStore(tmp_path / "state")
    caplog.set_level("INFO")
    restored(loaded, store, config.state_key(loaded))
    assert "no state saved yet" in caplog.text
    assert "WARNING" not in caplog.text
    store.save(Pipeline(loaded).state(), config.state_key(loaded))
    other = config.replace(loaded, vehicle=Vehicle(driveline_efficiency=0.9))
    restored(other, store, config.state_key(other))
    assert "WARNING" in caplog.text
    assert "configuration: changed in vehicle" in caplog.text


def test_check_tells_whether_a_log_can_feed_the_model(cli: Callable[..., Outcome], log: Path, tmp_path: Path) -> None:
    status, out, _ = cli("check", log)
    assert status == 0
    assert "the model can be fed" in out
    assert "CCVS1.WheelBasedVehicleSpeed" in out
    status, out, _ = cli("check", log, "--json")
    assert json.loads(out)["senders"]["CCVS1"] == [0]
    (tmp_path / "c.toml").write_text("[signals]\nspeed = 'TCO1.TachographVehicleSpeed'\nengine_power = 'X.Y'\n")
    (tmp_path / "slow.log").write_text("(1.0) can0 18FEF100#FFFFFFFFFFFFFFFF\n(2.0) can0 18FEF100#FFFFFFFFFFFFFFFF\n")
    status, out, _ = cli("check", tmp_path / "slow.log")
    assert status == 1
    assert "cannot be fed" in out


def test_the_configuration_of_a_daemon_can_be_checked_without_its_bus(
    cli: Callable[..., Outcome], settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> can.BusABC:
        raise ConfigError("a bus was opened")

    monkeypatch.setattr("estimator.commands.check.open_bus", refuse)
    assert "a bus was opened" in cli("check", "--config", settings)[2]
    status, out, err = cli("check", "--config", settings, "--no-bus")
    assert (status, err) == (0, "")
    assert "CCVS1.WheelBasedVehicleSpeed" in out


@pytest.mark.slow
def test_check_hears_a_bus(cli: Callable[..., Outcome], tmp_path: Path) -> None:
    status, out, _ = cli("check", "-i", "virtual", "-c", tmp_path, "--seconds", "1", "--json")
    assert status == 1
    assert json.loads(out)["frames"]["read"] == 0
    status, _, err = cli("check", "-i", "socketcan", "-c", "lo", "--seconds", "1")
    assert status == 2
    assert "not a CAN interface" in err


def test_status_says_when_no_daemon_runs(cli: Callable[..., Outcome], settings: Path, tmp_path: Path) -> None:
    status, out, err = cli("status", "--config", settings)
    assert (status, out) == (1, "")
    assert "no daemon is running" in err
    status, out, err = cli("status", "--config", settings, "--json")
    assert (status, err) == (1, "")
    assert decode(out, NotRunningAnswer).why_not.startswith("there is no ")
    (tmp_path / "run").mkdir()
    (tmp_path / "run/status.json").write_text("{broken")
    status, _, err = cli("status", "--config", settings)
    assert status == 2
    bench = Bench(tmp_path / "run")
    bench.turn()  # on a clock that stopped long ago
    status, _, err = cli("status", "--config", settings)
    assert status == 1
    assert "no daemon is running" in err
    status, out, _ = cli("status", "--config", settings, "--json")
    assert status == 1
    assert json.loads(out)["running"] is False


def test_status_without_a_configuration_says_that_the_daemon_may_have_one(
    cli: Callable[..., Outcome], settings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "elsewhere"))
    monkeypatch.setattr(folders, "SYSTEM_RUNTIME", tmp_path / "nowhere")
    _, _, err = cli("status")
    assert "; give --config FILE.toml if the daemon has service.runtime_directory" in err
    _, _, err = cli("status", "--config", settings)
    assert "give --config" not in err


class Running:
    """A supervised daemon in a thread, told what to do as by signals."""

    def __init__(self, settings: Path, *arguments: tuple[str, object]) -> None:
        self.signals = Signals()
        self.plans: list[Plan] = []
        self.failure: BaseException | None = None
        self._settings, self._options = settings, Namespace(**dict(arguments))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            supervise(self._plan, self.signals)
        except RoadloadError as error:
            self.failure = error

    def _plan(self) -> Plan:
        made = plan(self._settings, None, self._options)
        self.plans.append(made)
        return made

    def stop(self) -> None:
        self.signals.stop.set()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition that threads bring about."""
    waiting = threading.Event()
    for _ in range(int(PATIENCE / 0.02)):
        if condition():
            return
        waiting.wait(0.02)
    raise AssertionError("it never came to pass")


def shown(tmp_path: Path) -> dict[str, object]:
    try:
        content: dict[str, object] = json.loads((tmp_path / "run/status.json").read_text())
    except FileNotFoundError:
        return {}
    return content


def heard(tmp_path: Path) -> int:
    """Frames that the daemon has counted."""
    link: dict[str, int] = shown(tmp_path).get("input", {})  # type: ignore[assignment]
    return link.get("frames", 0)


@pytest.fixture
def running(settings: Path) -> Iterator[Running]:
    daemon = Running(settings)
    yield daemon
    daemon.stop()


@pytest.mark.slow
def test_a_daemon_hears_reports_reloads_saves_and_stops(
    running: Running, settings: Path, tmp_path: Path, log: Path, cli: Callable[..., Outcome]
) -> None:
    until(lambda: bool(shown(tmp_path)))
    with can.Bus(interface="virtual", channel=str(tmp_path), ignore_config=True) as vehicle:
        with can.LogReader(log) as reader:
            for message in islice(reader, 500):
                vehicle.send(message)
        until(lambda: heard(tmp_path) > 300)
        status, out, _ = cli("status", "--config", settings)
        assert status == 0
        assert "receiving" in out
        assert "virtual" in out
        good = settings.read_text()
        settings.write_text(good + "nonsense = 1\n")
        running.signals.reload.set()
        until(lambda: not running.signals.reload.is_set())
        settings.write_text(good + "silence_s = 2.0\n")
        running.signals.reload.set()
        until(lambda: len(running.plans) == 2)
        until(lambda: bool(shown(tmp_path)))
        running.stop()
    assert running.failure is None
    assert (tmp_path / "state/state").exists()
    assert not (tmp_path / "run/status.json").exists()
    state, reason = StateStore(tmp_path / "state").load(running.plans[-1].key)
    assert reason == ""
    assert state is not None
    restored = Pipeline(running.plans[-1].config)
    restored.restore(state)
    assert restored.traffic.frames > 300


@pytest.mark.slow
def test_a_bus_that_cannot_be_opened_does_not_take_the_place_of_one_that_can(
    running: Running, settings: Path, tmp_path: Path, log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    until(lambda: bool(shown(tmp_path)))
    good = settings.read_text()
    settings.write_text(
        good.replace("'virtual'", "'socketcan'").replace(f"channel = '{tmp_path}'", "channel = 'no-such'")
    )
    running.signals.reload.set()
    until(lambda: "the old one stays: socketcan no-such" in caplog.text)
    with can.Bus(interface="virtual", channel=str(tmp_path), ignore_config=True) as vehicle:
        with can.LogReader(log) as reader:
            for message in islice(reader, 500):
                vehicle.send(message)
        until(lambda: heard(tmp_path) > 300)
    running.stop()
    assert running.failure is None


def test_a_state_from_before_the_machine_was_started_is_not_taken_for_the_same_load(
    settings: Path, tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boot = tmp_path / "boot_id"
    monkeypatch.setattr("estimator.daemon.service.boot_id.BOOT_ID", boot)
    loaded = config.load(settings)
    frames = Frames.concatenate(list(open_log(log)))
    frames = replace(frames, t=frames.t - frames.t[0] + 1.7e9)
    store, now = StateStore(tmp_path / "state"), frames.t < 1.7e9 + 50

    def sources_after(first: str, second: str) -> dict[str, int]:
        boot.write_text(first)
        worker = Worker(Pipeline(loaded), 10**6, store, "k")
        worker.offer(frames[now])
        worker.close()
        boot.write_text(second)
        pipeline = restored(loaded, store, "k")
        list(pipeline.feed(frames[~now][:1]))
        list(pipeline.finish())  # frames are held for a second to be put in order
        return pipeline.traffic.sources

    assert sources_after("a", "a")
    assert not sources_after("a", "b")
    boot.write_text("a")
    worker = Worker(Pipeline(loaded), 10**6, store, "k")
    worker.offer(frames[now])
    worker.close()
    boot.write_text("b")
    worker = Worker(restored(loaded, store, "k"), 10**6, store, "k")
    worker.offer(frames[~now][:10])  # too few to be put in order
    worker.close()
    state, _ = store.load("k")
    assert state is not None
    assert state["boot"] == "a"
    assert not sources_after("", "")


def test_an_absence_counts_whole_though_the_clock_was_set_back_in_it(settings: Path, tmp_path: Path, log: Path) -> None:
    loaded = config.load(settings)
    frames = Frames.concatenate(list(open_log(log)))
    frames = replace(frames, t=frames.t - frames.t[0] + 1.7e9)
    store, now = StateStore(tmp_path / "state"), frames.t < 1.7e9 + 50

    def sources_after(away: float) -> dict[str, int]:
        worker = Worker(Pipeline(loaded), 10**6, store, "k", clock=lambda: 500.0)
        worker.offer(frames[now])
        worker.close()
        worker = Worker(restored(loaded, store, "k"), 10**6, store, "k", clock=lambda: 500.0 + away)
        worker.offer(frames[~now][:1])
        worker.turn()
        list(worker.pipeline.finish())
        return worker.pipeline.traffic.sources

    assert sources_after(300.0)
    assert not sources_after(7200.0)  # 0 s by the times of the messages


def test_two_daemons_do_not_share_a_state(running: Running, settings: Path, tmp_path: Path) -> None:
    until(lambda: bool(shown(tmp_path)))
    with pytest.raises(ConfigError, match="another daemon"):
        supervise(lambda: plan(settings, None, Namespace()), Signals())


def test_a_new_configuration_with_the_folder_of_another_daemon_is_not_used(
    running: Running, settings: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    until(lambda: bool(shown(tmp_path)))
    with folder_lock.alone(tmp_path / "other"):
        settings.write_text(settings.read_text().replace(f"'{tmp_path / 'state'}'", f"'{tmp_path / 'other'}'"))
        running.signals.reload.set()
        until(lambda: "the old one stays" in caplog.text)
    assert "another daemon" in caplog.text
    running.stop()
    assert running.failure is None


def test_a_new_configuration_with_an_effect_that_is_not_known_is_not_used(settings: Path) -> None:
    settings.write_text("effects = ['nonsense']\n" + settings.read_text())
    with pytest.raises(ConfigError, match="'nonsense' is not known"):
        plan(settings, None, Namespace())


def test_a_configuration_that_cannot_be_read_leaves_the_old_one(
    settings: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def denied() -> Plan:
        raise PermissionError(errno.EACCES, "Permission denied", str(settings))

    assert _reload(plan(settings, None, Namespace()), denied, Notifier()) is None
    assert "the old one stays: [Errno 13] Permission denied" in caplog.text


def test_the_pipeline_of_an_estimator_that_failed_is_not_given_to_the_next_daemon(
    settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, following = list[Pipeline](), [plan(settings, None, Namespace()), None]

    def serve(daemon: Daemon, *others: object) -> Plan | None:
        given.append(daemon.worker.pipeline)
        daemon.worker.failure = RuntimeError("broken")
        daemon.close()
        return following.pop(0)

    monkeypatch.setattr(supervision, "_serve", serve)
    supervise(lambda: plan(settings, None, Namespace()), Signals())
    assert given[0] is not given[1]


def test_a_pipeline_that_is_still_at_work_is_not_given_to_the_next_daemon(
    settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish, following = threading.Event(), [plan(settings, None, Namespace()), None]

    def serve(daemon: Daemon, *others: object) -> Plan | None:
        monkeypatch.setattr(daemon.worker, "_feed", lambda frames, began: finish.wait(PATIENCE))
        daemon.worker.offer(Frames.from_messages([can.Message(timestamp=1.0)]))
        daemon.worker.start()
        until(lambda: not daemon.worker.backlog)
        daemon.worker.close(timeout=0.0)
        return following.pop(0)

    monkeypatch.setattr("estimator.daemon.service.supervision._serve", serve)
    try:
        with pytest.raises(RoadloadError, match="did not finish"):
            supervise(lambda: plan(settings, None, Namespace()), Signals())
    finally:
        finish.set()


def test_the_clock_of_a_bus_goes_on_with_the_pipeline(settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of the wall clock that was taken out stays out under the next configuration."""
    served: list[Daemon] = []

    def serve(daemon: Daemon, plan: Plan, make_plan: Callable[[], Plan], *others: object) -> Plan | None:
        served.append(daemon)
        return make_plan() if len(served) < 3 else None

    def make_plan() -> Plan:
        found = plan(settings, None, Namespace())
        return found if len(served) < 2 else replace(found, key="another vehicle")

    monkeypatch.setattr("estimator.daemon.service.supervision._serve", serve)
    supervise(make_plan, Signals())
    first, second, third = (list(daemon.clocks.values()) for daemon in served)
    assert second[0] is first[0]
    assert third[0] is not second[0]


def test_a_reload_with_another_gate_goes_on_with_the_drive(
    settings: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("estimator.daemon.service.boot_id.BOOT_ID", settings.parent / "none")  # as on macOS
    frames = Frames.concatenate(list(open_log(log)))
    frames = replace(frames, t=frames.t - frames.t[0] + 1.7e9)
    first, served = frames.t < 1.7e9 + 50, list[Pipeline]()

    def serve(daemon: Daemon, *others: object) -> Plan | None:
        served.append(daemon.worker.pipeline)
        if len(served) == 2:
            return None
        daemon.worker.offer(frames[first])
        daemon.close()
        settings.write_text(settings.read_text() + "[gate]\ninterval_s = 20.0\n")
        return plan(settings, None, Namespace())

    monkeypatch.setattr(supervision, "_serve", serve)
    supervise(lambda: plan(settings, None, Namespace()), Signals())
    before, after = served
    list(after.feed(frames[~first]))
    assert after.config.gate.interval_s == 20.0
    assert after.traffic.frames == len(frames)
    assert after.estimator.segment == before.estimator.segment
    assert after.traffic.rows.valid > before.traffic.rows.valid


def test_an_estimator_that_fails_at_the_end_saves_nothing_and_leaves_no_status(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = StateStore(tmp_path)
    bench = Bench(tmp_path / "run", store=store)
    (tmp_path / "run").mkdir()
    bench.turn()
    assert (tmp_path / "run/metrics.prom").exists()

    def fail(frames: Frames, now: float) -> None:
        raise ZeroDivisionError("broken")

    monkeypatch.setattr(bench.worker.pipeline, "feed", fail)
    bench.worker.offer(Frames.from_messages([can.Message(timestamp=1.0)]))
    bench.daemon.close()
    assert "the estimator failed; what it did since the last save is lost: ZeroDivisionError('broken')" in caplog.text
    assert not list((tmp_path / "run").iterdir())
    assert store.load("key")[0] is None


def test_signals_are_taken_over_and_given_back() -> None:
    before = signal.getsignal(signal.SIGHUP)
    with Signals().caught() as signals:
        os.kill(os.getpid(), signal.SIGHUP)
        assert signals.reload.wait(PATIENCE)
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.stop.wait(PATIENCE)
    assert signal.getsignal(signal.SIGHUP) == before
