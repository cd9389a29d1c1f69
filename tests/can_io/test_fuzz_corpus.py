"""Files that were a fault once, and files of different refusals: each is read, or refused in one line."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from fuzzing.bus import spoilt_traffic
from fuzzing.files import fuzz_format, refusal_of
from fuzzing.formats import FORMATS
from fuzzing.mutation import spoilt
from project_paths import TESTS

CORPUS = TESTS / "fuzz_corpus"
NAMES = [pytest.param(name, marks=[pytest.mark.slow] if kind.cost > 1 else []) for name, kind in FORMATS.items()]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_kept_file_is_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    kept = sorted((CORPUS / name).iterdir())
    assert kept
    for path in kept:
        refusal_of(FORMATS[name], Path(shutil.copy(path, tmp_path)))


@pytest.mark.parametrize("name", NAMES)
def test_sound_files_are_read(name: str, tmp_path: Path) -> None:
    for content in FORMATS[name].sound():
        path = tmp_path / f"sound{FORMATS[name].suffix}"
        path.write_bytes(content)
        assert refusal_of(FORMATS[name], path) == ""


def test_spoiling_is_that_of_the_seed() -> None:
    sound = FORMATS["toml"].sound()
    copies = [[spoilt(sound[0], sound, rng) for _ in range(50)] for rng in map(np.random.default_rng, (1, 1, 2))]
    assert copies[0] == copies[1] != copies[2]
    assert len(set(copies[0])) > 40


def test_a_fault_is_found_and_its_file_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(path: Path) -> None:
        if len(path.read_bytes()) < 500:
            raise ZeroDivisionError

    monkeypatch.setitem(FORMATS, "toml", FORMATS["toml"].__class__(".toml", FORMATS["toml"].sound, fails))
    found = fuzz_format("toml", 30, 1, tmp_path / "corpus", tmp_path)
    assert found.files == 30
    assert len(found.faults) == 1
    assert "ZeroDivisionError" in found.faults[0]
    assert any(len(path.read_bytes()) < 500 for path in (tmp_path / "corpus").iterdir())


def test_spoilt_traffic_does_not_end_the_daemon() -> None:
    assert "10,000 frames" in spoilt_traffic(10_000, 2)
