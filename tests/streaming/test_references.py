"""Mass and grade that another control unit estimates: shown beside ours, without any influence on it."""

import json
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from project_paths import ROOT
from simulated_logs import TRUCK, ask, drive

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands.main import main
from estimator.config import J1939_BINDING, Config, from_dict
from estimator.signals import Role, Series
from estimator.simulation.recording import Recording
from estimator.streaming.listener import InlineWorker
from estimator.streaming.references import References
from estimator.streaming.replay import Run, estimate_logs

SHIPPED = ROOT / "dbc" / "j1939.dbc"
IDENT, STEP_KG = 0x267, 32.0
DATABASE = f"""VERSION ""
BO_ {IDENT} ESTIMATES: 8 X
 SG_ Mass : 0|10@1+ ({STEP_KG:g},0) [0|32704] "kg" X
 SG_ Grade : 10|9@1- (0.1,0) [-25|25] "%" X
"""
OTHERS = {"mass_reference": "ESTIMATES.Mass", "grade_reference": "ESTIMATES.Grade"}
THEIR_MASS, THEIR_OFFSET = 28_000.0, 0.004  # kg, and what their grade lies above the true one


def configured(folder: Path, **more: str) -> Config:
    (folder / "others.dbc").write_text(DATABASE)
    return from_dict({"bus": {"dbc": [str(SHIPPED), str(folder / "others.dbc")]}, "signals": {**J1939_BINDING, **more}})


def estimates_of(recording: Recording) -> Frames:
    """What the other control unit sends, ten times a second from before the first other frame on."""
    t = np.arange(0.003, recording.truth.t[-1], 0.1)
    grade = np.interp(t, recording.truth.t, recording.truth.grade) + THEIR_OFFSET
    raw = np.round(THEIR_MASS / STEP_KG).astype(int) | (np.round(1000 * grade).astype(int) & 0x1FF) << 10
    data = raw.astype("<u8").view(np.uint8).reshape(-1, 8)
    return Frames(EPOCH + t, np.full(len(t), IDENT, np.uint32), np.full(len(t), 8, np.uint8), data)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recording = drive("highway", 8, 3)
    frames = Frames.concatenate([frames_of(recording.signals), estimates_of(recording)])
    path = tmp_path_factory.mktemp("others") / "drive.blf"
    write_log(frames[np.argsort(frames.t, kind="stable")], path)
    return path


@pytest.fixture(scope="module")
def with_others(log: Path) -> Run:
    return estimate_logs(log, configured(log.parent, **OTHERS))


@pytest.mark.slow
def test_the_estimate_has_the_same_bytes_without_them(log: Path, with_others: Run) -> None:
    alone = estimate_logs(log, configured(log.parent))
    assert msgspec.json.encode(alone.updates) == msgspec.json.encode(with_others.updates)
    one, other = alone.pipeline.estimator.evidence, with_others.pipeline.estimator.evidence
    assert one is not None
    assert other is not None
    assert one.posterior.draws.tobytes() == other.posterior.draws.tobytes()
    assert with_others.pipeline.traffic.seen[Role.MASS_REFERENCE] > 4500


@pytest.mark.slow
def test_they_stand_beside_ours(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "others.toml"
    table = "\n".join(f"{role} = {json.dumps(path)}" for role, path in {**J1939_BINDING, **OTHERS}.items())
    (tmp_path / "others.dbc").write_text(DATABASE)
    config.write_text(f'bus.dbc = ["{SHIPPED}", "others.dbc"]\n[signals]\n{table}\n')
    answer = ask("estimate", log, "--config", config)
    mass, grade = answer["references"]["mass_kg"], answer["references"]["grade_percent"]
    assert (mass["signal"], mass["newest"], mass["lowest"], mass["highest"]) == ("ESTIMATES.Mass", *[28_000.0] * 3)
    ours = answer["parameters"]["mass_kg"]["mean"]
    assert ours == pytest.approx(TRUCK.mass, rel=0.05)
    assert mass["difference"] == pytest.approx(28_000.0 - ours)
    assert mass["age_s"] < 1.0
    assert grade["difference"] == pytest.approx(100 * THEIR_OFFSET, abs=0.25)
    assert grade["difference_sd"] < 0.5
    assert main(["estimate", str(log), "--config", str(config)]) == 0
    out = capsys.readouterr().out
    assert re.search(
        r"others    mass 28,000 kg by ESTIMATES.Mass, [\d,]+ kg (above|below) ours; 28,000 \.\. 28,000", out
    )
    assert re.search(r"others    grade [+-][\d.]+ % by ESTIMATES.Grade; against our road \+0\.\d\d %", out)
    diagnosis = ask("diagnose", log, "--config", config)["references"]
    assert diagnosis["mass_kg"]["newest"] == 28_000.0
    assert abs(diagnosis["mass_kg"]["difference"]) < 2000.0
    inputs = ask("inspect", log, "--config", config)["inputs"]
    assert inputs["mass_reference"]["rate_Hz"] == pytest.approx(10.0, rel=0.01)


def test_a_value_that_stays_away_grows_old() -> None:
    references = References({Role.MASS_REFERENCE: "A.b"})
    one = Series(np.array([10.0, 10.5, 11.2, 12.0]), np.array([1.0, 2.0, np.nan, 4.0]))
    speed = [Series(np.array([10.0]), np.array([3.0]))]
    assert references.take({Role.MASS_REFERENCE: [one], Role.SPEED: speed}) == {Role.SPEED: speed}
    known = references.answer(100.0, (3.0, 0.5), None).mass_kg
    assert known is not None
    assert (known.age_s, known.newest, known.readings) == (88.0, 4.0, 3)
    assert (known.lowest, known.highest) == (1.0, 4.0)  # of one a second
    assert (known.difference, known.difference_sd) == (1.0, 0.5)


def test_another_recording_begins_anew() -> None:
    references = References({Role.MASS_REFERENCE: "A.b"})
    for start, value in ((5000.0, 7.0), (1.0, 9.0)):
        t = start + np.arange(4.0)
        references.take({Role.MASS_REFERENCE: [Series(t, np.full(4, value))]})
    known = references.answer(None, None, None).mass_kg
    assert known is not None
    assert (known.lowest, known.highest, known.difference) == (9.0, 9.0, None)


def test_a_daemon_tells_their_age(tmp_path: Path) -> None:
    """The worker's answer has the age at the newest frame, to which the status adds what has passed since."""
    from estimator.daemon.service.status import of_references
    from estimator.daemon.service.worker import Knowledge
    from estimator.report import summary

    worker = InlineWorker(configured(tmp_path, **OTHERS))
    data = np.tile(np.array([[100, 0, 0, 0, 0, 0, 0, 0]], np.uint8), (200, 1))
    t = EPOCH + np.arange(200) / 10
    worker.offer(Frames(t, np.full(200, IDENT, np.uint32), np.full(200, 8, np.uint8), data))
    references = summary.references(worker.pipeline, None)
    assert references.mass_kg is not None
    assert references.mass_kg.newest == 3200.0
    told = of_references(Knowledge(t=float(t[-1]), references=references), float(t[-1]) + 60.0)
    assert told.mass_kg is not None
    assert told.mass_kg.age_s == pytest.approx(references.mass_kg.age_s + 60.0)
