"""Every example is run, and finds the truth."""

import importlib.util
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from played_bus import PlayedBus
from printed_text import assert_same
from project_paths import ROOT
from simulated_logs import TRUCK, drive, written

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.logs import open_log
from estimator.commands.main import main
from estimator.config import load
from estimator.errors import RoadloadError
from estimator.signals import Role, Series
from estimator.simulation.recording import Recording

pytestmark = pytest.mark.slow

EXAMPLES = ROOT / "examples"
VAN_LOG = EXAMPLES / "own_vehicle" / "van.blf"
SAMPLED = 0.002  # relative difference of sampled numbers between machines


def example(name: str) -> Callable[[list[str]], None]:
    """The main function of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function: Callable[[list[str]], None] = module.main
    return function


@pytest.fixture(scope="module")
def highway() -> Recording:
    return drive("highway", 8, 3)


def test_offline_estimate(highway: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example("offline_estimate")([str(written(highway, tmp_path / "drive.blf"))])
    out = capsys.readouterr().out
    found = {name: float(value) for name, value in re.findall(r"^(mass|A|C) ([0-9.]+) ±", out, re.MULTILINE)}
    assert found["mass"] == pytest.approx(TRUCK.mass, rel=0.02)
    assert found["A"] == pytest.approx(TRUCK.A, rel=0.1)
    assert found["C"] == pytest.approx(TRUCK.C, rel=0.1)
    assert "unestimated: not yet" in out


def test_live_listener(highway: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    buses: list[PlayedBus] = []

    def open_bus(interface: str, channel: str) -> PlayedBus:
        assert (interface, channel) == ("virtual", "example")
        buses.append(PlayedBus(frames_of(highway.signals).messages()))
        return buses[-1]

    monkeypatch.setattr(can, "Bus", open_bus)
    with pytest.raises(RoadloadError, match="Network is down"):
        example("live_listener")(["--interface", "virtual", "--channel", "example", "--period", "0.1"])
    masses = re.findall(r"^mass (\d+) kg", capsys.readouterr().out, re.MULTILINE)
    assert float(masses[-1]) == pytest.approx(TRUCK.mass, rel=0.02)
    assert {message.arbitration_id >> 8 & 0xFFFF for message in buses[0].sent} == {*range(0xFF60, 0xFF66)}


def with_pump(recording: Recording, k: float) -> Recording:
    """The drive with a pump on the engine that takes the torque k w [N m]."""
    signals = dict(recording.signals)
    torque, speed = signals[Role.TORQUE_FRACTION], signals[Role.ENGINE_SPEED]
    reference = float(signals[Role.REFERENCE_TORQUE].value[0])
    share = k * np.interp(torque.t, speed.t, speed.value) / reference
    signals[Role.TORQUE_FRACTION] = Series(torque.t, torque.value + share)
    return replace(recording, signals=signals)


def test_pendulum(capsys: pytest.CaptureFixture[str]) -> None:
    example("pendulum")(["3"])
    out = capsys.readouterr().out
    assert out.startswith("effect: dry friction\n")
    size, sd = map(float, re.findall(r"^dry friction: P = 1.000, ([0-9.]+) ± ([0-9.]+) rad/s\^2$", out, re.M)[0])
    assert abs(size - 0.04) < 3 * sd
    left, noise = re.findall(r"left-out stretches ([0-9.]+) once named, noise ([0-9.]+)", out)[0]
    assert float(left) == pytest.approx(float(noise), rel=0.05)


def test_a_car_in_another_simulator(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("fastsim", reason="the simulator of the example is not installed")
    example("fastsim_car")(["3"])
    out = capsys.readouterr().out
    assert out.startswith("effect: auxiliaries\n")
    size, sd = map(float, re.findall(r"^auxiliaries: P = 1.000, ([0-9.]+) ± ([0-9.]+) W$", out, re.M)[0])
    assert abs(size - 1500) < 3 * sd


def test_own_effect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = with_pump(drive("mixed", 25, 6), 1.5)
    example("own_effect")([str(written(recording, tmp_path / "drive.blf"))])
    verdict, *effects = capsys.readouterr().out.splitlines()
    assert verdict == "effect"
    assert [effect.split(":")[0] for effect in effects] == ["hydraulic_pump"]
    size = re.search(r"k = ([0-9.]+) ±", effects[0])
    assert size is not None
    assert float(size.group(1)) == pytest.approx(1.5, rel=0.2)


def test_own_vehicle(tmp_path: Path) -> None:
    """Its commands print what its page shows, and the truth that the page names is in the intervals."""
    import readme

    page = readme.OWN_VEHICLE.read_text(encoding="utf-8")
    shown, computed = readme.blocks(page), readme.own_vehicle(tmp_path)
    assert shown.keys() == computed.keys() == {"init", "check", "estimate"}
    for name, text in shown.items():
        assert_same(computed[name], text, rtol=SAMPLED)
    truth = re.search(r"The truth is ([\d,.]+) kg, ([\d,.]+) N and ([\d,.]+) N s²/m²", page)
    intervals = re.findall(r"^ (?:mass|A|C) .*?([\d,.]+) \.\. ([\d,.]+) ", computed["estimate"], re.MULTILINE)
    assert truth is not None
    for value, (low, high) in zip(truth.groups(), intervals, strict=True):
        assert number(low) < number(value) < number(high)


def number(text: str) -> float:
    return float(text.replace(",", ""))


def test_the_log_of_the_own_vehicle_is_what_its_script_writes(tmp_path: Path) -> None:
    """But for the last bit of a signal, which may round to the other side on another machine."""
    example("own_vehicle/make_log")([str(tmp_path)])
    made, kept = (Frames.concatenate(list(open_log(path))) for path in (tmp_path / "van.blf", VAN_LOG))
    assert np.array_equal(made.ident, kept.ident)
    assert np.array_equal(made.t, kept.t)
    assert np.mean(made.data == kept.data) > 0.999
    assert VAN_LOG.stat().st_size < 260_000
    tables = (np.loadtxt(folder / "van.csv", delimiter=",", skiprows=1) for folder in (tmp_path, VAN_LOG.parent))
    assert np.ptp(np.array(list(tables)), axis=0).max() < 0.011


def test_the_configuration_by_hand_is_that_of_init(tmp_path: Path) -> None:
    assert (
        main(["init", str(EXAMPLES / "own_vehicle" / "van.dbc"), str(VAN_LOG), "-o", str(tmp_path / "van.toml")]) == 0
    )
    assert load(tmp_path / "van.toml") == load(EXAMPLES / "own_vehicle" / "van.toml")
