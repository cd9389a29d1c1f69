"""Where the daemon's files are: as configured, as systemd says, or the user's own folders (XDG)."""

import errno
import logging
import os
from pathlib import Path

from estimator.daemon.service.file_permissions import refuse_if_writable_by_all
from estimator.errors import ConfigError
from estimator.settings import Service

log = logging.getLogger(__name__)

NAME = "roadload"
TEMPORARY_ERRORS = (
    errno.EROFS,
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EIO,
)  # of a file system; it may be mended while we run
STATUS_FILE = "status.json"
SYSTEM_RUNTIME = Path("/run") / NAME


def _is_root() -> bool:
    return hasattr(os, "geteuid") and os.geteuid() == 0


def state_directory(service: Service) -> Path:
    """Folder of the saved state."""
    if service.state_directory:
        return Path(service.state_directory)
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if _is_root():
        return Path("/var/lib") / NAME
    return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / NAME


def runtime_directory(service: Service) -> Path:
    """Folder of the status of a running daemon."""
    if service.runtime_directory:
        return Path(service.runtime_directory)
    if given := os.environ.get("RUNTIME_DIRECTORY"):
        return Path(given.split(":")[0])
    if _is_root():
        return SYSTEM_RUNTIME
    own = os.environ.get("XDG_RUNTIME_DIR")
    return Path(own) / NAME if own else state_directory(service)


def status_places(service: Service) -> list[Path]:
    """Files in which the status of a daemon may stand, the likeliest first."""
    own = runtime_directory(service) / STATUS_FILE
    return [own] if service.runtime_directory else list(dict.fromkeys([own, SYSTEM_RUNTIME / STATUS_FILE]))


def make(folder: Path, mode: int) -> Path:
    """Create a folder where there is none, with ``mode``; one that cannot be written for now may be so later.

    Raises
    ------
    ConfigError
        It cannot be created or written, and waiting does not help; or every user may write it.
    """
    try:
        folder.mkdir(mode=mode, parents=True, exist_ok=True)
        if os.statvfs(folder).f_flag & os.ST_RDONLY:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
    except OSError as error:
        if error.errno not in TEMPORARY_ERRORS:
            raise ConfigError(f"{folder}: {error.strerror}; choose another folder in [service]") from error
        log.warning("%s: %s; nothing is kept there until it can be written", folder, error.strerror)
        return folder
    refuse_if_writable_by_all(folder)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"{folder}: cannot be written; choose another folder in [service]")
    return folder
