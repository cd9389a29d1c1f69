"""Run ``roadload diagnose`` on every log, each in its own process with the log as the only input."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import msgspec

from blind import seal
from blind.answer import Run
from estimator.answers.answer import decode
from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.errors import RoadloadError

COMMAND = (sys.executable, "-m", "estimator", "diagnose")
TIMEOUT = 900.0  # s
ROOT = Path(__file__).resolve().parents[2]


def answer_of(folder: Path, drive: str) -> Path:
    """Path of the answer for a drive."""
    return folder / "answers" / f"{drive}.json"


def diagnose(folder: Path, drive: str, command: tuple[str, ...] = COMMAND) -> Run:
    """Diagnose one log; store the whole answer and its cost."""
    log = seal.log_of(folder, drive).resolve()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    configuration = log.with_suffix(".toml")
    settings = ["--config", configuration.name] if configuration.is_file() else []
    begin = time.perf_counter()
    with TemporaryFile("w+") as output, TemporaryFile("w+") as complaint:
        process = subprocess.Popen(
            [*command, log.name, *settings, "--json"], cwd=log.parent, env=environment, stdout=output, stderr=complaint
        )
        end = threading.Timer(TIMEOUT, process.kill)
        end.start()
        _, status, usage = os.wait4(process.pid, 0)
        end.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        text, said = _content(output), _content(complaint)
    seconds = time.perf_counter() - begin
    answer, error = None, " ".join(said.split())[-300:] or f"exit status {process.returncode}"
    if process.returncode == 0:
        try:
            answer, error = decode(text, DiagnosisAnswer), ""
        except msgspec.DecodeError as wrong:
            error = f"not the JSON of the contract: {wrong}"
    run = Run(drive, seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, answer, error)
    path = answer_of(folder, drive)
    path.parent.mkdir(exist_ok=True)
    path.with_suffix(".full.json").write_text(text)
    path.write_bytes(msgspec.json.encode(run))
    return run


def _content(file: IO[str]) -> str:
    file.seek(0)
    return file.read()


def diagnose_all(folder: Path, workers: int, command: tuple[str, ...] = COMMAND) -> Iterator[Run]:
    """Diagnose every log of the manifest, ``workers`` at a time; yield results in order of completion."""
    with ThreadPoolExecutor(workers) as pool:
        for future in as_completed(pool.submit(diagnose, folder, drive, command) for drive in seal.drives(folder)):
            yield future.result()


def answers(folder: Path) -> dict[str, Run]:
    """All answers so far, by drive.

    Raises
    ------
    RoadloadError
        An answer is of another version of the program.
    """
    paths = sorted((folder / "answers").glob("*.json"))
    try:
        runs = [msgspec.json.decode(p.read_bytes(), type=Run) for p in paths if not p.name.endswith(".full.json")]
    except msgspec.ValidationError as error:
        raise RoadloadError(f"{folder}: answers of another version; run `diagnose` again: {error}") from None
    return {run.drive: run for run in runs}
