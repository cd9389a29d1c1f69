"""What `estimate_logs` and `diagnose_logs` give to pandas and polars."""

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_logs import TRUCK

from estimator import diagnose_logs, estimate_logs, load_config
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.diagnosis.result import Diagnosis, Finding, GapClosed, Magnitude, Shift, Verdict
from estimator.simulation.recording import simulate
from estimator.streaming.log_frames import as_paths

MINUTES = 6


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Path of a log, as a text."""
    path = tmp_path_factory.mktemp("library") / "drive.blf"
    write_log(frames_of(simulate(TRUCK, "highway", 60.0 * MINUTES, np.random.default_rng(1)).signals), path)
    return str(path)


def frames(table: dict[str, Any]) -> Iterator[Any]:
    """The table as data frames of the libraries that are installed; python-can would load polars in each process."""
    modules = [find_spec(name) and import_module(name) for name in ("pandas", "polars")]
    yield from (module.DataFrame(table) for module in modules if module)


@pytest.mark.slow
def test_updates_are_a_table(log: str) -> None:
    run = estimate_logs(log, load_config())
    for frame in frames(run.table):
        assert len(frame) == len(run.updates)
        last = {name: frame[name][len(frame) - 1] for name in frame.columns}
        assert run.final.mass is not None
        assert last["mass_kg_mean"] == run.final.mass.mean
        assert last["status"] == "estimated"
        assert last["minutes"] == pytest.approx(MINUTES, abs=0.1)
        assert np.isnan(frame["mass_kg_mean"][0])  # not known yet


@pytest.mark.slow
def test_a_diagnosis_is_a_table(log: str) -> None:
    found = diagnose_logs([log], load_config())
    assert found.logs == (log,)
    for frame in frames(found.table):
        assert sorted(frame["effect"]) == sorted({each.name for each in (*found.effects, *found.candidates)})


def test_named_effects_come_first_with_the_size_that_they_were_named_with() -> None:
    def finding(name: str, value: float, gap: GapClosed | None = None, shift: Shift | None = None) -> Finding:
        return Finding(
            name=name, probability=0.9, log_bayes_factor=5.0, equivalent=(), gap_closed=gap, rms_before=1.0,
            magnitude=Magnitude("wind", value, 0.5, "m/s"), rms_after=0.5, shift=shift,
        )  # fmt: skip

    named = finding("headwind", 6.0, GapClosed(0.4, 0.3, 0.5), Shift(mass=-100.0, A=20.0, C=-1.0))
    table = Diagnosis(
        verdict=Verdict.EFFECT, effects=(named,), candidates=(finding("drafting", 1.0), finding("headwind", 7.0))
    ).table
    for frame in frames(table):
        assert [*frame["effect"]] == ["headwind", "drafting"]
        assert [*frame["status"]] == ["named", "candidate"]
        assert [*frame["value"]] == [6.0, 1.0]
        assert frame["mass_shift_kg"][0] == -100.0
        assert np.isnan([*frame["gap_closed"]]).tolist() == [False, True]


def test_paths_may_be_one_or_several_texts_or_paths() -> None:
    assert as_paths("a.blf") == as_paths(Path("a.blf")) == as_paths(["a.blf"]) == [Path("a.blf")]
    assert as_paths(("a.blf", Path("b.blf"))) == [Path("a.blf"), Path("b.blf")]
