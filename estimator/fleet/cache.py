"""Cache of drive results on disk, keyed by the contents of their logs, the program and the settings."""

from dataclasses import dataclass
from hashlib import blake2b
from importlib.resources import files
from pathlib import Path

import msgspec

from estimator.config import Config, estimation_key
from estimator.errors import RoadloadError
from estimator.fleet.drive_result import DriveResult
from estimator.fleet.grouping import Drive
from estimator.output_files import whole

PROGRAM = Path(__file__).parents[1]  # its modules, which the results depend on


@dataclass(frozen=True)
class Cache:
    """Folder of results; an unreadable result counts as missing."""

    folder: Path
    settings: str

    @classmethod
    def of(cls, folder: Path, config: Config, with_diagnosis: bool) -> "Cache":
        """Return the cache for runs with these settings.

        Raises
        ------
        RoadloadError
            The folder cannot be made.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RoadloadError(f"{folder}: {error.strerror}") from error
        return cls(folder, f"{_program()} {with_diagnosis} {estimation_key(config)}")

    def get(self, drive: Drive) -> DriveResult | None:
        """Result of a drive; None if there is none."""
        try:
            return msgspec.json.decode(self._path(drive).read_bytes(), type=DriveResult)
        except (OSError, msgspec.DecodeError):
            return None

    def put(self, drive: Drive, result: DriveResult) -> None:
        """Store a result.

        Raises
        ------
        RoadloadError
            The result cannot be written.
        """
        with whole(self._path(drive)) as file:
            file.write(msgspec.json.encode(result))

    def _path(self, drive: Drive) -> Path:
        key = "\n".join([self.settings, *drive.contents])
        return self.folder / f"{blake2b(key.encode(), digest_size=16).hexdigest()}.json"


def _program() -> str:
    """Digest of the modules of the program and of its databases."""
    digest = blake2b(digest_size=16)
    databases = sorted((file for file in files("estimator.dbc").iterdir()), key=lambda file: file.name)
    for path in [*sorted(PROGRAM.rglob("*.py")), *(file for file in databases if file.name.endswith(".dbc"))]:
        digest.update(blake2b(path.read_bytes()).digest())
    return digest.hexdigest()
