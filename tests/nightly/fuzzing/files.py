"""Spoilt files of one format, read in processes that a crash or a hang may end."""

import json
import multiprocessing
import re
import resource
import time
import traceback
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

import numpy as np

from estimator.errors import RoadloadError
from fuzzing.formats import FORMATS, Format
from fuzzing.mutation import spoilt

BATCH = 250  # files that a process reads
LONGEST, MOST = 10.0, 500  # s and MB for a file
MAX_KEPT = 30  # different refusals of a format
KEPT_BYTES = 4096  # of a file of the corpus that is no fault
PATIENCE = 5.0  # s for what a process does beside reading
PROCESSES = multiprocessing.get_context("fork")


@dataclass(kw_only=True)
class Found:
    """What became of the files; ``faults`` name the reason and the file of the corpus."""

    files: int = 0
    read: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    memory_MB: float = 0.0  # beyond that of the process before
    faults: list[str] = field(default_factory=list)


def fuzz_format(name: str, count: int, seed: int, corpus: Path, scratch: Path) -> Found:
    """Read ``count`` spoilt files of a format, keep what is new in the folder ``corpus``."""
    kind, found = FORMATS[name], Found()
    corpus.mkdir(parents=True, exist_ok=True)
    sound = [*kind.sound(), *(path.read_bytes() for path in sorted(corpus.iterdir()))]
    known = {refusal_of(kind, path) for path in sorted(corpus.iterdir())}
    current, answers = scratch / f"spoilt{kind.suffix}", scratch / "answers"
    for batch in range(-(-count // BATCH)):
        answers.write_text("")
        size = min(BATCH, count - batch * BATCH)
        process = PROCESSES.Process(target=_read_batch, args=(kind, sound, (seed, batch), size, current, answers))
        process.start()
        _wait(process, answers)
        for line in answers.read_text().splitlines():
            _note(found, json.loads(line), kind, corpus, known)
        if process.exitcode:
            path = _kept(corpus, kind, current.read_bytes())
            found.faults.append(f"{path}: the process ended or hung (exit code {process.exitcode})")
    return found


def refusal_of(kind: Format, path: Path) -> str:
    """Why a file is refused, without numbers, names and quotations; empty where it is read."""
    path.chmod(0o600)
    try:
        kind.read(path)
    except RoadloadError as error:
        if "\n" in str(error):
            raise ValueError("refused in several lines") from error
        return _general(str(error).replace(str(path), ""))
    return ""


def _general(message: str) -> str:
    return re.sub(r"'[^']*'|\"[^\"]*\"|[\d.,+-]*\d|found .*", "#", message)[:100]


def _wait(process: "multiprocessing.context.ForkProcess", answers: Path) -> None:
    """Wait as long as files are being read; a process that reads one too long is ended."""
    done, since = -1, time.monotonic()
    while process.is_alive():
        process.join(0.2)
        size = answers.stat().st_size
        if size != done:
            done, since = size, time.monotonic()
        elif time.monotonic() - since > LONGEST + PATIENCE:
            process.kill()
            process.join()


def _read_batch(
    kind: Format, sound: list[bytes], seed: tuple[int, int], count: int, current: Path, answers: Path
) -> None:
    """Read spoilt files, and write a line about each before the next."""
    rng = np.random.default_rng(seed)
    before = _memory()
    resource.setrlimit(resource.RLIMIT_CPU, (int(count * LONGEST), int(count * LONGEST)))
    with answers.open("w", buffering=1) as lines:
        for _ in range(count):
            data = spoilt(sound[int(rng.integers(len(sound)))], sound, rng)
            current.write_bytes(data)
            began, reason, fault = time.process_time(), "", ""
            try:
                reason = refusal_of(kind, current)
            except Exception as error:  # of any kind: that is what is looked for
                place = traceback.extract_tb(error.__traceback__)[-1]
                fault = f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}"
            seconds, memory = time.process_time() - began, _memory() - before
            if not fault and (seconds > LONGEST or memory > MOST):
                fault = f"took {seconds:.1f} s and {memory:.0f} MB"
            answer = {"reason": reason, "fault": fault, "s": seconds, "MB": memory, "data": data.hex()}
            lines.write(json.dumps(answer) + "\n")


def _memory() -> float:
    """Peak of the resident memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _note(found: Found, answer: dict[str, object], kind: Format, corpus: Path, known: set[str]) -> None:
    """Count an answer; keep its file where the fault or the refusal is new."""
    data, reason, fault = bytes.fromhex(str(answer["data"])), str(answer["reason"]), str(answer["fault"])
    found.files += 1
    found.slowest_s = max(found.slowest_s, float(str(answer["s"])))
    found.memory_MB = max(found.memory_MB, float(str(answer["MB"])))
    if fault:
        if fault not in known:
            found.faults.append(f"{_kept(corpus, kind, data)}: {fault}")
            known.add(fault)
        return
    found.refused += bool(reason)
    found.read += not reason
    if reason not in known and len(data) <= KEPT_BYTES and len(known) < MAX_KEPT:
        known.add(reason)
        _kept(corpus, kind, data)


def _kept(corpus: Path, kind: Format, data: bytes) -> Path:
    path = corpus / f"{blake2b(data, digest_size=6).hexdigest()}{kind.suffix}"
    path.write_bytes(data)
    return path
