"""Power goes at any instant: killed processes, writes cut off at every byte, bits that turned."""

import json
import subprocess
import sys

import numpy as np
import pytest
from project_paths import TESTS

from estimator.can_io.j1939_encoder import frames_of
from estimator.checkpoint.store import CURRENT, StateStore, pack
from estimator.config import Config
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

pytestmark = pytest.mark.slow

TOOL = TESTS / "nightly" / "power_loss.py"
KILLS = 12


def test_killed_at_any_instant_it_goes_on():
    command = [sys.executable, str(TOOL), "--kills", str(KILLS), "--minutes", "10", "--seed", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["kills"] == KILLS
    assert found["failed"] == found["lost"] == found["corrupt"] == 0
    assert found["longest_loss_s"] <= 15.0
    assert found["while_saving"] >= KILLS // 2
    assert abs(found["mass_error"]) < 0.05


@pytest.fixture(scope="module")
def written() -> bytes:
    """A file with the state of a pipeline that has driven for ten minutes."""
    rng = np.random.default_rng(1)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    pipeline = Pipeline(Config())
    list(pipeline.feed(frames_of(record(truck, generate_route("mixed", 15_000, rng), 600.0, rng).signals)))
    assert len(pipeline.estimator.window) > 1000
    return pack({"pipeline": pipeline.state()}, "k")


def prefixes(content: bytes, every: int) -> list[bytes]:
    return [content[:n] for n in range(0, len(content), every)]


@pytest.mark.parametrize("kind", ["small", "large"])
def test_a_write_cut_off_at_any_byte_leaves_the_older_state(tmp_path, written, kind):
    """Where rename went ahead of the data, as on file systems that do not honour fsync."""
    StateStore(tmp_path).save({"n": 1}, "k")
    (tmp_path / CURRENT).rename(tmp_path / "state.previous")
    small = pack({"n": 2, "window": np.arange(20.0)}, "k")
    torn = prefixes(small, 1) if kind == "small" else prefixes(written, 997)
    assert len(torn) > 30
    for content in torn:
        (tmp_path / CURRENT).write_bytes(content)
        state, reason = StateStore(tmp_path).load("k")
        assert state == {"n": 1}
        assert reason.endswith("the previous state is used")


def test_a_write_that_was_cut_off_is_swept_away(tmp_path):
    StateStore(tmp_path).save({"n": 1}, "k")
    for n, content in enumerate(prefixes(pack({"n": 2}, "k"), 1)):
        (tmp_path / f"state.{n}.part").write_bytes(content)
    assert StateStore(tmp_path).load("k") == ({"n": 1}, "")
    assert [path.name for path in tmp_path.iterdir()] == [CURRENT]


@pytest.mark.parametrize("page", [512, 2048])
def test_pages_that_never_reached_the_disk(tmp_path, written, page):
    StateStore(tmp_path).save({"n": 1}, "k")
    (tmp_path / CURRENT).rename(tmp_path / "state.previous")
    rng = np.random.default_rng(page)
    for start in rng.choice(np.arange(0, len(written) - page, page), 25, replace=False).tolist():
        if not any(written[start : start + page]):
            continue
        (tmp_path / CURRENT).write_bytes(written[:start] + bytes(page) + written[start + page :])
        assert StateStore(tmp_path).load("k")[0] == {"n": 1}


def test_a_bit_that_turned_anywhere_is_noticed(tmp_path):
    StateStore(tmp_path).save({"n": 1}, "k")
    (tmp_path / CURRENT).rename(tmp_path / "state.previous")
    content = pack({"n": 2, "window": np.arange(10.0)}, "k")
    for i in range(len(content)):
        turned = bytearray(content)
        turned[i] ^= 1 << i % 8
        (tmp_path / CURRENT).write_bytes(turned)
        assert StateStore(tmp_path).load("k")[0] == {"n": 1}
