"""The command as a user meets it: exit status, one line of error, JSON and nothing else."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import can
import numpy as np
import pytest
from failures import Cli, fails

from estimator import config
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import open_log
from estimator.commands.main import main
from estimator.config import Config
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.inspection import Input, Inspection


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two minutes of driving: too little for an estimate, enough for everything else."""
    rng = np.random.default_rng(2)
    truck = Truck(mass=20_000.0, A=1200.0, C=3.5)
    path = tmp_path_factory.mktemp("cli") / "drive.blf"
    write_log(frames_of(record(truck, generate_route("urban", 5e3, rng), 120.0, rng).signals), path)
    return path


@pytest.mark.parametrize("command", ["check", "inspect", "estimate"])
@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("[bus]\ndbc = ['no.dbc']\n", "DIR/no.dbc: No such file or directory; correct bus.dbc, or give --dbc FILE.dbc"),
        ("[signals]\nspeed = 'A.B'\n", "signals.speed: the DBC has no message 'A'"),
        ("[signals]\nspeed = 'EEC1.EngSpeed'\n", "bus.units: EEC1.EngSpeed has the unit 'rpm'"),
    ],
)
def test_what_does_not_fit_the_databases_names_file_key_and_remedy(
    cli: Cli, log: Path, tmp_path: Path, command: str, text: str, fragment: str
) -> None:
    file = tmp_path / "c.toml"
    file.write_text(text)
    fails(cli(command, log, "--config", file), f"error: {file}: {fragment.replace('DIR', str(tmp_path))}")


def test_a_missing_file_of_an_option_is_not_blamed_on_the_configuration(cli: Cli, log: Path, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("")
    outcome = cli("estimate", log, "--config", tmp_path / "c.toml", "--dbc", tmp_path / "no.dbc")
    fails(outcome, f"error: {tmp_path / 'no.dbc'}: No such file")


JSON_KEYS = {
    "schema",
    "status",
    "reason",
    "references",
    "advice",
    "warnings",
    "parameters",
    "convergence",
    "coverage",
    "rms_kW",
    "samples",
    "frames",
    "failed_updates",
    "effects",
    "magnitudes",
    "updates",
    "coefficients",
    "coverage_map",
    "road",
}


@pytest.mark.slow
@pytest.mark.parametrize("command", ["replay", "estimate"])
def test_json_is_one_object_with_the_agreed_keys(cli: Cli, log: Path, command: str) -> None:
    status, out, err = cli(command, log, "--json")
    assert (status, err) == (0, "")
    content = json.loads(out)
    assert set(content) == JSON_KEYS
    assert content["status"] == "unestimated"
    assert "needed" in content["reason"]
    assert set(content["parameters"]) == {"mass_kg", "A_N", "C_N_s2_m2"}
    assert set(content["coverage"]) == {"fraction", "occupied", "available"}
    assert content["frames"]["read"] > 15_000
    assert set(content["samples"]) == {"admitted", "rejected"}
    assert set(content["updates"][-1]) == {"t_s", "status", "parameters"}


@pytest.mark.slow
def test_simulate_then_estimate(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "truck.asc"
    status, out, _ = cli("simulate", path, "--minutes", 8, "--seed", 5, "--mass", 30_000, "--json")
    truth = json.loads(out)["truth"]
    assert status == 0
    assert truth["mass_kg"] == 30_000
    status, out, _ = cli("estimate", path, "--json")
    content = json.loads(out)
    assert content["status"] == "estimated"
    assert content["parameters"]["mass_kg"]["mean"] == pytest.approx(30_000, rel=0.03)
    assert set(content["parameters"]["A_N"]) == {"status", "reason", "mean", "sd", "q05", "q50", "q95"}
    assert set(content["convergence"]) == {"r_hat", "ess_bulk", "acceptance", "draws", "chains"}


@pytest.mark.slow
def test_tables_for_people(cli: Cli, log: Path) -> None:
    status, out, _ = cli("estimate", log)
    assert status == 0
    assert "unestimated" in out
    status, out, _ = cli("inspect", log)
    assert status == 0
    assert "EEC1.EngSpeed" in out
    assert "0x00" in out


def test_inspect_json(cli: Cli, log: Path) -> None:
    _, out, _ = cli("inspect", log, "--json")
    content = json.loads(out)
    assert content["inputs"]["speed"]["rate_Hz"] == pytest.approx(10, rel=0.05)
    assert content["inputs"]["engine_speed"]["rate_Hz"] == pytest.approx(50, rel=0.05)
    assert content["sources"]["EEC1.EngSpeed"] == 0
    assert content["status"] == "unestimated"


def test_pace(cli: Cli, tmp_path: Path, log: Path) -> None:
    with can.LogReader(log) as reader, can.Logger(tmp_path / "short.blf") as writer:
        for message, _ in zip(reader, range(1300), strict=False):
            writer(message)
    status, out, _ = cli("replay", tmp_path / "short.blf", "--speed", 50, "--json")
    assert status == 0
    assert json.loads(out)["frames"]["read"] == 1300


# Bad input: one line, status 2, nothing left behind.


def test_log_missing(cli: Cli, tmp_path: Path) -> None:
    fails(cli("estimate", tmp_path / "no.blf"), "no.blf")


def test_log_empty(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "empty.blf").touch()
    fails(cli("replay", tmp_path / "empty.blf"), "empty.blf")


@pytest.mark.slow
def test_log_truncated_leaves_no_output(cli: Cli, tmp_path: Path, log: Path) -> None:
    content = log.read_bytes()
    (tmp_path / "cut.blf").write_bytes(content[: len(content) * 2 // 3])
    output = tmp_path / "out.blf"
    fails(cli("replay", tmp_path / "cut.blf", "--output", output), "cut.blf", "byte")
    assert [p.name for p in tmp_path.iterdir()] == ["cut.blf"]


def test_log_is_prose(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "poem.log").write_text("Shall I compare thee to a summer's day?\n")
    fails(cli("estimate", tmp_path / "poem.log"), "poem.log:1")


def test_dbc_does_not_parse(cli: Cli, tmp_path: Path, log: Path) -> None:
    (tmp_path / "bad.dbc").write_text("BO_ what is this")
    fails(cli("estimate", log, "--dbc", tmp_path / "bad.dbc"), "bad.dbc")


def test_signal_not_in_the_dbc(cli: Cli, tmp_path: Path, log: Path) -> None:
    (tmp_path / "c.toml").write_text('[signals]\nspeed = "CCVS1.Velocity"\n')
    fails(cli("estimate", log, "--config", tmp_path / "c.toml"), "Velocity", "WheelBasedVehicleSpeed")


def test_unknown_configuration_key(cli: Cli, tmp_path: Path, log: Path) -> None:
    (tmp_path / "c.toml").write_text("[window]\nsample = 1000\n")
    fails(cli("estimate", log, "--config", tmp_path / "c.toml"), "c.toml", "sample", "window")


@pytest.mark.slow
def test_inputs_missing_are_named_beside_those_found(cli: Cli, tmp_path: Path, log: Path) -> None:
    with can.LogReader(log) as reader, can.Logger(tmp_path / "deaf.blf") as writer:
        for message in reader:
            if message.arbitration_id >> 8 & 0xFFFF != 0xF004:
                writer(message)
    fails(cli("replay", tmp_path / "deaf.blf"), "EEC1.EngSpeed", "CCVS1.WheelBasedVehicleSpeed", "missing")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["estimate", "replay"])
def test_frames_out_of_order_are_counted(cli: Cli, tmp_path: Path, log: Path, command: str) -> None:
    with can.LogReader(log) as reader:
        messages = list(reader)
    messages[100], messages[120] = messages[120], messages[100]
    with can.Logger(tmp_path / "late.csv") as writer:
        for message in [*messages, *messages[:500]]:
            writer(message)
    _, out, _ = cli(command, tmp_path / "late.csv", "--json")
    frames = json.loads(out)["frames"]
    assert frames["read"] == len(messages) + 500
    assert frames["steps_back"] == 1
    assert 2 <= frames["reordered"] <= 42  # frame 120 came before 20 others, and so did its copy
    _, out, _ = cli(command, tmp_path / "late.csv")
    assert "put in order" in out
    assert "time steps back from 1" in out


@pytest.mark.slow
def test_inspect_says_that_time_steps_back(cli: Cli, tmp_path: Path, log: Path) -> None:
    with can.LogReader(log) as reader:
        messages = list(reader)
    with can.Logger(tmp_path / "twice.csv") as writer:
        for message in [*messages, *messages]:
            writer(message)
    _, out, _ = cli("inspect", tmp_path / "twice.csv", "--json")
    content = json.loads(out)
    assert content["frames"]["steps_back"] == 1
    assert content["duration_s"] == pytest.approx(2 * (messages[-1].timestamp - messages[0].timestamp), abs=0.01)
    assert "another drive" in cli("inspect", tmp_path / "twice.csv")[1]


def without(frames: Frames, *pdu_formats_and_groups: int) -> Frames:
    """Frames but those of some PGNs; of 8 bits for the transport protocol, which names a destination too."""
    pgn = frames.ident >> 8 & 0xFFFF
    return frames[~np.isin(pgn, pdu_formats_and_groups) & ~np.isin(pgn >> 8, pdu_formats_and_groups)]


@pytest.fixture(scope="module")
def traffic(log: Path) -> Frames:
    return Frames.concatenate(list(open_log(log)))


REMEDIES = [
    ((0xEB, 0xEC), "EC1.EngReferenceTorque", "vehicle.reference_torque_Nm = 2500"),
    (
        (0xFEDF,),
        "EEC3.NominalFrictionPercentTorque",
        'signals = {speed = "CCVS1.WheelBasedVehicleSpeed", torque_fraction = "EEC1.ActualEngPercentTorque", '
        'engine_speed = "EEC1.EngSpeed", reference_torque = "EC1.EngReferenceTorque"}',
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("left_out", "missing", "remedy"), REMEDIES)
def test_the_remedy_for_missing_inputs_can_be_pasted_and_works(
    cli: Cli, tmp_path: Path, traffic: Frames, left_out: tuple[int, ...], missing: str, remedy: str
) -> None:
    log, settings = tmp_path / "a.blf", tmp_path / "c.toml"
    write_log(without(traffic, *left_out), log)
    fails(cli("estimate", log), f"missing inputs: {missing}; start the configuration", remedy.removesuffix("2500"))
    settings.write_text(remedy + "\n")
    assert cli("estimate", log, "--config", settings)[0] == 0


def test_a_bus_that_is_not_j1939_is_shown_the_way_to_a_configuration(cli: Cli, tmp_path: Path, traffic: Frames) -> None:
    other = Frames(traffic.t, np.full(len(traffic), 0x123, np.uint32), traffic.length, traffic.data)
    write_log(other, tmp_path / "a.blf")
    outcome = cli("estimate", tmp_path / "a.blf")
    fails(outcome, "roadload init FILE.dbc LOG -o FILE.toml", "--config FILE.toml", "found: none")
    assert f"most frequent ids: 123 ({len(traffic):,} frames)" in cli("inspect", tmp_path / "a.blf")[1]


def test_a_silent_bus_is_told() -> None:
    silent = Inspection(Config()).report("can0", Counter())
    assert silent.reason == "can0: no frame came; check the bit rate, the wiring and the filters"
    asked = Inspection(config.load("obd2")).report("can0", Counter())
    assert "the logger has to ask for PID 0x0D" in asked.reason
    assert not silent.usable


@pytest.mark.parametrize(
    ("t", "rate"),
    [
        (np.sort(np.concatenate([np.arange(100) / 24, np.arange(100) / 24 + 0.005])), 48.0),
        (np.concatenate([np.arange(1100, 1110, 0.5), np.arange(1050, 1100, 0.5)]), 2.0),
        (np.concatenate([np.arange(0, 10, 0.1), np.arange(60, 70, 0.1)]), 10.0),
    ],
    ids=["pairs", "step back", "gap"],
)
def test_rates_are_those_of_the_time_in_which_a_signal_comes(t: np.ndarray, rate: float) -> None:
    assert Input("X.x", [t], [t]).describe(float(t[-1]), float(t[0])).rate_Hz == pytest.approx(rate, rel=0.02)


def test_unestimated_says_what_to_do(cli: Cli, log: Path) -> None:
    content = json.loads(cli("estimate", log, "--json")[1])
    assert "give a longer log" in content["advice"]
    assert f"to do     {content['advice']}" in cli("estimate", log)[1]


def test_candump_lines_in_a_txt_are_read(cli: Cli, tmp_path: Path, traffic: Frames) -> None:
    write_log(traffic, tmp_path / "a.log")
    (tmp_path / "a.log").rename(tmp_path / "a.txt")
    assert cli("estimate", tmp_path / "a.txt")[0] == 0
    (tmp_path / "b.txt").write_text("12:00 left home\n")
    fails(cli("estimate", tmp_path / "b.txt"), "b.txt", "rename", ".log")


ODD = "\x1b[31mred\x07\u202egnp\udcff"


def test_control_characters_of_names_are_never_printed(cli: Cli, tmp_path: Path, log: Path) -> None:
    bad, good, settings = (tmp_path / f"{ODD}.{suffix}" for suffix in ("asc", "blf", "toml"))
    bad.write_text("nonsense\n")
    good.write_bytes(log.read_bytes())
    settings.write_text("[no_such_table]\n")
    for outcome in (
        cli("estimate", bad),
        cli("estimate", bad, "--debug"),
        cli("inspect", good),
        cli("diagnose", good, good),
        cli("estimate", good, "--config", settings),
        cli("simulate", tmp_path / f"{ODD}2.blf", "--minutes", 0.5),
        cli("status", "--config", settings),
    ):
        text = "".join(outcome[1:])
        assert "\\x1b[31mred\\x07\\u202egnp\\udcff" in text
        assert not set(ODD) - {*"[31mredgnp"} & set(text)


def test_a_usage_error_shows_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["simulate", "a.blf", "--route", ODD])
    assert "\x1b" not in capsys.readouterr().err


def test_several_drives_too_short_are_told_their_minutes(cli: Cli, log: Path, tmp_path: Path) -> None:
    other = shutil.copy(log, tmp_path / "other.blf")
    reason = " ".join(cli("diagnose", log, other)[1].split())
    assert "of 2 drives the longest has 0.5 minutes that can be used, all together " in reason


def test_two_clocks_in_one_log(cli: Cli, tmp_path: Path) -> None:
    lines = [f"({t + i:.6f}) can0 18FEF100#FFFFFFFFFFFFFFFF" for i in range(200) for t in (1000.0, 0.0)]
    (tmp_path / "two.log").write_text("\n".join(lines) + "\n")
    fails(cli("estimate", tmp_path / "two.log"), "two.log", "time steps back", "frame 2")


def test_nothing_valid_in_the_whole_log(cli: Cli, tmp_path: Path, log: Path) -> None:
    with can.LogReader(log) as reader:
        frames = Frames.from_messages(reader)
    speed = frames.ident >> 8 & 0xFFFF == 0xFEF1
    data = frames.data.copy()
    data[speed] = 0xFF
    write_log(Frames(frames.t, frames.ident | EXTENDED, frames.length, data), tmp_path / "na.blf")
    fails(cli("estimate", tmp_path / "na.blf"), "na.blf", "CCVS1.WheelBasedVehicleSpeed")


def test_speed_factor_is_checked(cli: Cli, log: Path) -> None:
    fails(cli("replay", log, "--speed", "fast"), "--speed")


def test_usage_errors_have_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["estimate"])
    assert exit_info.value.code == 2
    assert capsys.readouterr().err == "error: the following arguments are required: LOG; see roadload estimate --help\n"


def test_an_input_is_never_overwritten(cli: Cli, log: Path) -> None:
    before = log.read_bytes()
    fails(cli("replay", log, "--output", log), log.name, "another file")
    assert log.read_bytes() == before


@pytest.mark.parametrize("output", ["nowhere/out.blf", ".", "out.xyz"])
def test_outputs_are_checked_before_the_work(cli: Cli, tmp_path: Path, log: Path, output: str) -> None:
    fails(cli("replay", log, "--output", tmp_path / output))
    fails(cli("simulate", tmp_path / output, "--minutes", 1))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments", [("--minutes", "0"), ("--minutes", "x"), ("--speed-noise", "nan"), ("--seed", "-1"), ("--mass", "inf")]
)
def test_arguments_out_of_range_are_one_line(
    arguments: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["simulate", str(tmp_path / "x.blf"), *arguments])
    assert exit_info.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith(f"error: argument {arguments[0]}")


def test_names_are_printed_as_they_are(cli: Cli, tmp_path: Path, log: Path) -> None:
    odd = tmp_path / "[bold]odd[red].blf"
    odd.write_bytes(log.read_bytes())
    status, out, _ = cli("inspect", odd)
    assert status == 0
    assert "[bold]odd[red].blf" in out


def test_databases_that_define_a_message_twice(cli: Cli, tmp_path: Path, log: Path) -> None:
    dbc = 'VERSION ""\nBU_: X\nBO_ 256 M: 8 X\n SG_ S : 0|16@1+ (1,0) [0|0] "km/h" X\n'
    for name in ("a.dbc", "b.dbc"):
        (tmp_path / name).write_text(dbc)
    fails(cli("estimate", log, "--dbc", tmp_path / "a.dbc", "--dbc", tmp_path / "b.dbc"), "b.dbc", "'M'")


@pytest.mark.slow
def test_each_wheel_is_inspected_on_its_own(cli: Cli, tmp_path: Path, log: Path) -> None:
    (tmp_path / "c.toml").write_text(
        '[signals]\nwheel_speeds = ["CCVS1.WheelBasedVehicleSpeed", "EBC2.FrontAxleSpeed"]\n'
        'torque_fraction = "EEC1.ActualEngPercentTorque"\nengine_speed = "EEC1.EngSpeed"\n'
        'reference_torque = "EC1.EngReferenceTorque"\n'
    )
    _, out, _ = cli("inspect", log, "--config", tmp_path / "c.toml", "--json")
    inputs = json.loads(out)["inputs"]
    for name in ("wheel_speeds 1", "wheel_speeds 2"):
        assert inputs[name]["rate_Hz"] == pytest.approx(10, rel=0.05)
        assert inputs[name]["gaps_s"] == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_stopped_says_so_and_leaves_no_file(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it is ignored

    monkeypatch.setattr("estimator.can_io.j1939_encoder.frames_of", lambda signals: os.kill(os.getpid(), number))
    assert cli("simulate", tmp_path / "a.log", "--minutes", "0.5") == (1, "", "error: interrupted\n")
    signal.signal(signal.SIGINT, ignored)
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.slow
def test_outputs_that_are_closed_or_narrow_are_no_error(log: Path) -> None:
    program = "import sys; sys.stdout = None; from estimator.commands.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "inspect", str(log)]
    assert subprocess.run(command, capture_output=True).returncode == 0
    done = subprocess.run(
        [sys.executable, "-m", "estimator", "inspect", str(log)],
        capture_output=True,
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (
            ("diagnose", "x.blf", "--plot", "x.html"),
            "--plot x.html; did you mean --report?; see roadload diagnose --help",
        ),
        (("inspect", "x.blf", "--sed=1"), "--sed=1; see roadload inspect --help"),
        (("estimate", "x.blf", "--sed=1"), "--sed=1; did you mean --seed?; see roadload estimate --help"),
        (("fleet", "x.blf", "--output", "out", "--plot"), "--plot; did you mean --report?; see roadload fleet --help"),
        (("estimate", "x.blf", "-q"), "-q; see roadload estimate --help"),
        (("status", "now"), "now; see roadload status --help"),
    ],
)
def test_an_unknown_option_leads_to_the_help_of_its_command(
    arguments: tuple[str, ...], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(list(arguments))
    assert stopped.value.code == 2
    assert capsys.readouterr().err == f"error: unrecognized arguments: {complaint}\n"


def test_the_page_of_an_estimate_is_called_as_that_of_a_diagnosis_too(cli: Cli, log: Path, tmp_path: Path) -> None:
    fails(cli("estimate", log, "--report", tmp_path / "page.doc"), "page.doc", ".html")
