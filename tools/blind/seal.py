"""The seal: hashes that prove that logs and truths have not changed.

Truths are plain JSON in OUT/sealed, logs are in OUT/logs. The manifest beside the logs holds the SHA-256 of every log
and of every truth, made when both were written; a truth starts with a random nonce, so that it cannot be guessed from
its hash.
The diagnosis is a process of its own that is given one log and works in a folder without the truths. Scoring refuses
truths or logs that differ from the manifest, so nothing can be changed after the answers are known. The seal does not
prevent reading OUT/sealed; for that, keep the folder on another machine until the score.
"""

import hashlib
from pathlib import Path

import msgspec

from blind.truth import Truth
from estimator.errors import InputError

MANIFEST = "manifest.json"


class SealError(InputError):
    """A log or truth is missing or is not the one that was sealed, e.g. edited after the answers were known."""


class Entry(msgspec.Struct, frozen=True):
    """Hashes of one drive."""

    log: str
    truth: str


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def log_of(folder: Path, drive: str) -> Path:
    """Path of the log of a drive."""
    return folder / "logs" / f"{drive}.blf"


def truth_of(folder: Path, drive: str) -> Path:
    """Path of the truth of a drive."""
    return folder / "sealed" / f"{drive}.json"


def seal(folder: Path, truth: Truth) -> Entry:
    """Write the truth of a drive after its log; returns its entry of the manifest."""
    path = truth_of(folder, truth.drive)
    path.write_bytes(msgspec.json.encode(truth))
    return Entry(digest(log_of(folder, truth.drive)), digest(path))


def publish(folder: Path, entries: dict[str, Entry]) -> None:
    """Write the manifest of all drives."""
    content = msgspec.json.format(msgspec.json.encode(entries), indent=1)
    (folder / "logs" / MANIFEST).write_bytes(content)


def drives(folder: Path) -> dict[str, Entry]:
    """Entries of the manifest.

    Raises
    ------
    SealError
        There is no manifest.
    """
    path = folder / "logs" / MANIFEST
    if not path.is_file():
        raise SealError(f"{path}: missing; generate drives into {folder} first")
    return msgspec.json.decode(path.read_bytes(), type=dict[str, Entry])


def unseal(folder: Path) -> dict[str, Truth]:
    """All truths by drive, after a check of truths and logs against the manifest.

    Raises
    ------
    SealError
        A log or a truth is missing or differs from the manifest.
    """
    truths = {}
    for drive, entry in drives(folder).items():
        for path, sealed in ((log_of(folder, drive), entry.log), (truth_of(folder, drive), entry.truth)):
            if not path.is_file() or digest(path) != sealed:
                raise SealError(f"{path}: is missing, or differs from the manifest; restore it, or generate anew")
        truths[drive] = msgspec.json.decode(truth_of(folder, drive).read_bytes(), type=Truth)
    return truths
