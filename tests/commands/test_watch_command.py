"""`roadload watch`, `status` and Ctrl-C as a user meets them."""

import io
import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import msgspec
import numpy as np
import pytest
from daemon_bench import Bench
from rich.console import Console

from estimator.answers.status import State
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands import watch
from estimator.commands.displays import display
from estimator.daemon.reception.uptime import since_start
from estimator.daemon.service import assembly, status_file
from estimator.daemon.service.assembly import Plan
from estimator.daemon.service.loop import Daemon
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming import replay
from estimator.streaming.log_frames import LogFrames
from estimator.streaming.replay import MAX_HELD, SLICE, paced_frames
from estimator.watch.view import without_news

Outcome = tuple[int, str, str]
MINUTES = 6.0
INTERRUPTED = "note: interrupted; the answer is that of the first 0:0"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six minutes through a town: enough for several conclusions."""
    rng = np.random.default_rng(4)
    recording = record(Truck(mass=20_000.0, A=1200.0, C=3.5), generate_route("urban", 2e4, rng), 60 * MINUTES, rng)
    path = tmp_path_factory.mktemp("watch") / "drive.blf"
    write_log(frames_of(recording.signals), path)
    return path


class Stopped(LogFrames):
    """Logs during whose reading Ctrl-C comes, after a number of frames."""

    after = 40_000

    def __iter__(self) -> Iterator[Frames]:
        left = self.after
        for frames in super().__iter__():
            yield frames[:left]
            left -= len(frames)
            if left <= 0:
                raise KeyboardInterrupt


class Clock:
    """A time that passes only by sleeping, which calls the next of some ``acts``, and is interrupted after the last."""

    def __init__(self, *acts: Callable[[], object]) -> None:
        self._acts = iter(acts)
        self.now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        act = next(self._acts, None)
        if act is None:
            raise KeyboardInterrupt
        act()


def body(text: str) -> list[str]:
    """The table and what follows."""
    lines = [line.rstrip() for line in text.splitlines()]
    return lines[lines.index("estimated") if "estimated" in lines else -10 :]


@pytest.mark.slow
def test_a_pipe_gets_a_line_an_update_and_the_table_of_estimate(cli: Callable[..., Outcome], log: Path) -> None:
    status, out, err = cli("watch", log, "--speed", "max")
    assert (status, err) == (0, "")
    assert "\x1b" not in out
    updates = json.loads(cli("estimate", log, "--json")[1])["updates"]
    lines = re.findall(r"^\d:\d\d:\d\d estimate: .*$", out, re.MULTILINE)
    assert len(lines) == len(updates) > 3
    for line, update in zip(lines, updates, strict=True):
        if update["status"] == "estimated":
            assert f"{update['parameters']['mass_kg']['mean']:,.0f} kg (" in line
        else:
            assert "unestimated: " in line
    estimated = cli("estimate", log)[1]
    assert out.endswith(estimated)


def terminal_of(environment: dict[str, str]) -> Console:
    """A terminal of 80 columns that keeps what is written, by the variables of an environment."""
    return Console(
        file=io.StringIO(), width=80, height=24, force_terminal=True, color_system=None, _environ=environment
    )


@pytest.mark.parametrize("environment", [{"TERM": "dumb"}, {"TERM": "xterm", "TTY_INTERACTIVE": "0"}])
def test_a_terminal_without_a_cursor_gets_lines(environment: dict[str, str]) -> None:
    terminal = terminal_of(environment)
    with display(terminal, without_news("drive.blf", "opening", ""), None) as show:
        show(without_news("drive.blf", "finished", ""))
    assert terminal.file.getvalue() == "opening\nfinished\n"  # type: ignore[attr-defined]


def test_a_pipe_that_is_said_to_be_interactive_gets_lines() -> None:
    pipe = Console(file=io.StringIO(), force_terminal=False, _environ={"TTY_INTERACTIVE": "1"})
    with display(pipe, without_news("drive.blf", "opening", ""), None):
        pass
    assert pipe.file.getvalue() == "opening\n"  # type: ignore[attr-defined]


def test_a_screen_shows_a_log_that_ends_at_once() -> None:
    terminal = terminal_of({"TERM": "xterm"})
    with display(terminal, without_news("drive.blf", "opening", ""), None):
        pass
    assert "drive.blf" in terminal.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_terminal_is_left_as_it_was_with_the_table(
    cli: Callable[..., Outcome], log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal = terminal_of({"TERM": "xterm"})
    monkeypatch.setattr(watch, "standard_output", lambda: terminal)
    status, _, _ = cli("watch", log, "--speed", "max")
    assert status == 0
    written: str = terminal.file.getvalue()  # type: ignore[attr-defined]
    screens, table = written.split("\x1b[?1049l")
    assert screens.startswith("\x1b[?1049h")
    assert "drive.blf" in screens
    assert "samples" in table
    assert "90 % interval" in table


@pytest.mark.slow
@pytest.mark.parametrize("command", ["estimate", "replay", "watch"])
def test_ctrl_c_leaves_what_is_known(
    cli: Callable[..., Outcome], log: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr(watch if command == "watch" else replay, "LogFrames", Stopped)
    speed = ["--speed", "max"] if command == "watch" else []
    status, out, err = cli(command, log, *speed)
    assert status == 130
    assert err.startswith(INTERRUPTED)
    assert err.count("\n") == 1
    assert re.search(r"^frames    (39,9|40,0)\d\d read", out, re.MULTILINE)
    assert "samples   " in out


@pytest.mark.slow
def test_ctrl_c_before_the_first_conclusion_is_said(
    cli: Callable[..., Outcome], log: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Stopped, "after", 3000)
    monkeypatch.setattr(replay, "LogFrames", Stopped)
    status, out, err = cli("estimate", log, "--json")
    assert status == 130
    assert err.startswith(INTERRUPTED)
    assert json.loads(out)["reason"] == "interrupted before the first conclusion"
    output = tmp_path / "answer.blf"
    status, _, err = cli("replay", log, "--output", output)
    assert status == 130
    assert f"{output}: not written" in err
    assert not output.exists()


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["a.blf", "-i", "virtual"], "watch one thing"),
        (["a.blf", "--status", "s.json"], "watch one thing"),
        (["nowhere.blf"], "nowhere.blf"),
        (["a.blf", "--speed", "fast"], "--speed: 'fast'"),
        (["--web", "70000"], "is no port"),
        (["-i", "nonsense", "-c", "x"], "nonsense"),
    ],
)
def test_what_cannot_be_watched_is_one_line(cli: Callable[..., Outcome], arguments: list[str], fragment: str) -> None:
    status, out, err = cli("watch", *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert fragment in err


def test_a_status_that_is_missing_cut_or_old_is_a_line_and_the_watch_goes_on(
    cli: Callable[..., Outcome], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "status.json"
    Bench(tmp_path).turn()
    status = status_file.read(path)
    path.unlink()

    def write(age: float) -> None:
        status_file.write(path, msgspec.structs.replace(status, written_monotonic_s=since_start() - age))

    def cut() -> None:
        path.write_bytes(path.read_bytes()[:100])

    acts = [lambda: None, lambda: write(0.0), cut, lambda: write(60.0), lambda: write(0.0)]
    monkeypatch.setattr(watch, "time", Clock(*acts))
    code, out, err = cli("watch", "--status", path)
    assert code == 0
    assert err == ""
    lines = out.splitlines()
    assert lines[0] == f"no daemon is running: there is no file {path}"
    assert lines[1] == status.state.value
    assert lines[2].startswith(f"no daemon is running: {path}: is not a status file")
    assert re.fullmatch(f"no daemon is running: {path}: written 6[01] s ago, .*", lines[3])
    assert lines[4] == status.state.value
    assert "estimate  none yet" in out
    monkeypatch.setattr(watch, "time", Clock(path.unlink))
    code, _, err = cli("watch", "--status", path)
    assert code == 1
    assert err.startswith("no daemon is running: there is no file")


@pytest.mark.slow
def test_a_bus_is_heard_and_nothing_is_sent(
    cli: Callable[..., Outcome], log: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    channel, daemons = str(tmp_path), list[Daemon]()

    def listen(planned: Plan) -> Daemon:
        daemons.append(assembly.listening(planned))
        return daemons[0]

    with can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as vehicle:
        rows = next(iter(LogFrames([log], watch.config.load(None))))[:2000]

        def play() -> None:
            for message in rows.messages():
                message.timestamp += time.time() - rows.t[-1]
                vehicle.send(message)

        played: list[bool] = []

        def wait() -> None:
            time.sleep(0.05)
            told = daemons[0].reported
            if not played and told is not None and told.state is State.LISTENING:
                played.append(True)
                play()
            if daemons[0].source.counts.frames == len(rows):
                raise KeyboardInterrupt

        monkeypatch.setattr(watch, "listening", listen)
        monkeypatch.setattr(watch, "time", Clock(*[wait] * 1200))
        settings = tmp_path / "c.toml"
        settings.write_text("[reception]\nfilter = false\n")
        status, out, err = cli("watch", "-i", "virtual", "-c", channel, "--config", settings)
        assert (status, err) == (0, "")
        assert vehicle.recv(0) is None
    told = [line for line in out.splitlines() if line != State.WAITING.value]  # a busy machine opens the bus later
    assert told[:2] == ["opening", State.LISTENING.value]
    assert re.search(r"^frames    2,000 read", out, re.MULTILINE)


def test_frames_are_held_back_but_not_through_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(*[lambda: None] * 1000)
    monkeypatch.setattr(replay, "time", clock)
    t = np.concatenate([np.arange(0, 10, 0.01), 9.0 + np.arange(0, 1, 0.01), 1e7 + np.arange(0, 10, 0.01), [np.nan]])
    frames = Frames(t, np.zeros(len(t), np.uint32), np.full(len(t), 8, np.uint8), np.zeros((len(t), 8), np.uint8))
    parts, moments = [], []
    for part in paced_frames([frames[:700], frames[:0], frames[700:]], speed=2.0):
        parts.append(part.t)
        moments.append(clock.now)
    np.testing.assert_array_equal(np.concatenate(parts), t)
    assert np.diff(moments).max() <= MAX_HELD + SLICE
    assert clock.now == pytest.approx((10 + 1 + 10) / 2 + MAX_HELD, abs=2 * SLICE)
    assert [part is frames for part in paced_frames([frames], None)] == [True]


@pytest.mark.slow
def test_the_status_of_a_daemon_is_the_table_of_estimate(
    cli: Callable[..., Outcome], log: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    (tmp_path / "c.toml").write_text(f"[service]\nruntime_directory = '{tmp_path}'\n")
    bench = Bench(tmp_path)
    frames = Frames.concatenate(list(LogFrames([log], watch.config.load(None))))
    half = len(frames) // 6
    t = frames.t - frames.t[0] + bench.ahead + bench.now
    moved = Frames(t, frames.ident, frames.length, frames.data)
    for part in (moved[:half], moved[half:]):
        bench.worker.offer(part)
        bench.worker.turn()
        bench.now += float(part.t[-1] - part.t[0])
        bench.worker.turn()  # the survey
        status = bench.daemon.status(bench.now)
        age = since_start() - bench.now
        status_file.write(
            tmp_path / "status.json", msgspec.structs.replace(status, written_monotonic_s=bench.now + age)
        )
        code, out, _ = cli("status", "--config", tmp_path / "c.toml")
        assert code == 0
        if part is moved[half:] or len(part) != half:
            break
        assert re.search(r"^to go +[\d,]+ of 600 usable samples$", out, re.MULTILINE)
    estimate = status.estimate
    assert estimate is not None
    mass = estimate.parameters.mass_kg
    assert f" mass   {mass.mean:,.0f} kg" in out
    assert f"{mass.q05:,.0f} .. {mass.q95:,.0f}" in out
    assert "wanted    " in out
    line = f"estimate: {mass.mean:,.0f} kg ({mass.q05:,.0f} .. {mass.q95:,.0f}), A "
    assert any(line in record.getMessage() for record in caplog.records)
