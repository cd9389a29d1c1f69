"""Real recordings: what the program says of them is known, as far as it can be."""

from pathlib import Path

import numpy as np
import pytest
from project_paths import ROOT

from estimator import config
from estimator.config import Config
from estimator.estimates import Status
from estimator.settings import Bus
from estimator.streaming import inspection
from estimator.streaming.replay import Run, estimate_logs, replay

KENWORTH = {"normal.log": 19_957, "tsc1.log": 21_568, "address_claim_attack.log": 15_723}
PAYLOAD = {"TripB22", "TripB24", "TripB34"}  # +80, +60, +160 kg


def silent(share: float) -> None:
    assert 0 <= share <= 1


@pytest.mark.parametrize("name", KENWORTH)
def test_kenworth_is_read_whole_and_not_over_interpreted(recordings: Path, name: str) -> None:
    run = replay([recordings / "j1939_trucks/kenworth_t270" / name], Config(), silent)
    assert run.pipeline.traffic.frames == KENWORTH[name]
    assert run.final.status == Status.UNESTIMATED
    assert "usable samples" in run.final.reason
    assert run.final.mass is None


def test_kenworth_inputs_and_reference_torque(recordings: Path) -> None:
    found = inspection.inspect(recordings / "j1939_trucks/kenworth_t270/normal.log", Config(), silent)
    torque, speed = found.inputs["reference_torque"], found.inputs["speed"]
    assert torque.minimum == torque.maximum == 1109
    assert speed.minimum * 3.6 == pytest.approx(23.6, abs=0.5)
    assert speed.maximum * 3.6 == pytest.approx(54.9, abs=0.1)
    # Engine and cab controller both send CCVS1; each signal comes from the node that knows it.
    assert found.sources["CCVS1.WheelBasedVehicleSpeed"] == 0x00
    assert found.sources["CCVS1.BrakeSwitch"] == 0x31


def test_kenworth_drop_out_is_a_gap(recordings: Path) -> None:
    run: Run = estimate_logs([recordings / "j1939_trucks/kenworth_t270/address_claim_attack.log"], Config(), silent)
    start, end = max(run.pipeline.traffic.rows.gaps, key=lambda gap: gap[1] - gap[0])
    assert start - run.start == pytest.approx(15.5, abs=0.3)
    assert end - run.start > 29
    assert run.pipeline.estimator.rejected["speed stale"] > 50


@pytest.mark.slow
@pytest.mark.parametrize("name", ["css_truck_idle_11111111.MF4", "paccar_mx.trc"])
def test_standing_trucks(recordings: Path, name: str) -> None:
    run = estimate_logs([recordings / "j1939_trucks/stationary_format_samples" / name], Config(), silent)
    assert run.final.status == Status.UNESTIMATED
    assert run.final.admitted == 0


@pytest.fixture(scope="module")
def bmw(recordings: Path) -> Config:
    settings = config.load(ROOT / "dbc" / "bmw_i3.toml")
    return config.replace(settings, bus=Bus(dbc=[str(recordings / "bmw_i3/bmw_i3.dbc")]))


@pytest.mark.slow
def test_a_trip_without_an_altimeter_is_read_to_its_end(recordings: Path, bmw: Config):
    """Updates that are withheld, because its parts contradict each other, do not end the run."""
    signals = {role: signal for role, signal in bmw.signals.items() if role != "altitude"}
    settings = config.replace(bmw, signals=signals)
    run = estimate_logs([recordings / "bmw_i3/TripB02.blf"], settings, silent)
    contradictory = [update for update in run.updates if "contradict each other" in update.reason]
    assert {update.status for update in contradictory} <= {Status.UNESTIMATED}
    assert run.updates[-1].t > 600
    assert run.pipeline.estimator.failed_updates == 0


@pytest.fixture(scope="module")
def trips(recordings: Path, bmw: Config) -> dict[str, Run]:
    folder, settings = recordings / "bmw_i3", bmw
    every = [path for path in sorted(folder.glob("*.blf")) if path.stem not in PAYLOAD]
    chosen = [*every[::4], *(folder / f"{name}.blf" for name in sorted(PAYLOAD))]
    return {path.stem: estimate_logs([path], settings, silent) for path in chosen}


@pytest.mark.slow
def test_bmw_masses_agree_between_trips(trips: dict[str, Run]) -> None:
    mass = {name: run.final.mass.mean for name, run in trips.items() if run.final.mass is not None}
    assert len(trips) == 10
    assert len(mass) >= 8
    empty = np.array([m for name, m in mass.items() if name not in PAYLOAD])
    assert empty.std(ddof=1) < 0.04 * empty.mean()
    assert max(mass, key=lambda name: mass[name]) == "TripB34"
