"""A lock that keeps other daemons out of a folder: two would overwrite each other's state."""

import errno
import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from estimator.daemon.service import folders
from estimator.daemon.service.worker import Store
from estimator.errors import ConfigError, RoadloadError

LOCK_FILE = "lock"
NOT_THERE_YET = (*folders.TEMPORARY_ERRORS, errno.ENOENT)


class FolderLock:
    """The lock of ``folder``, taken when there is something to lock, and again if that was removed or covered."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._file = folder, folder / LOCK_FILE
        self._descriptor: int | None = None
        self._threads = threading.Lock()

    def take(self) -> bool:
        """Lock the folder unless that has been done; False where it does not exist and cannot be written for now.

        Raises
        ------
        ConfigError
            Another process has it, or the lock cannot be opened.
        """
        with self._threads:
            if not self._is_held():
                self._close()
                self._descriptor = self._locked()
            return self._descriptor is not None

    def require(self) -> None:
        """Lock the folder before something is written there.

        Raises
        ------
        RoadloadError
            It cannot be locked.
        """
        if not self.take():
            raise RoadloadError(f"{self._folder}: cannot be locked, so nothing is saved there")

    def release(self) -> None:
        """Let other processes have the folder."""
        with self._threads:
            self._close()

    def _is_held(self) -> bool:
        try:
            return self._descriptor is not None and os.path.samestat(os.fstat(self._descriptor), os.lstat(self._file))
        except OSError:
            return False

    def _locked(self) -> int | None:
        import fcntl  # which Windows has not; `watch` imports this module there, and locks nothing

        try:
            descriptor = self._open()
        except OSError as error:
            if error.errno in NOT_THERE_YET:
                return None
            raise ConfigError(f"{self._file}: {error.strerror}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            reason = "another daemon keeps its state there" if isinstance(error, BlockingIOError) else error.strerror
            raise ConfigError(f"{self._folder}: {reason}; give each its own service.state_directory") from error
        return descriptor

    def _open(self) -> int:
        """A new file, or the one from before the file system turned read-only."""
        safe = os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            return os.open(self._file, os.O_RDWR | os.O_CREAT | safe, 0o600)
        except OSError as error:
            if error.errno not in folders.TEMPORARY_ERRORS:
                raise
            return os.open(self._file, os.O_RDONLY | safe)

    def _close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


class LockedStore:
    """A store that saves only while the lock is held."""

    def __init__(self, store: Store, lock: FolderLock) -> None:
        self._store, self._lock = store, lock

    def save(self, state: Mapping[str, Any], key: str) -> None:
        """Keep a state.

        Raises
        ------
        RoadloadError
            The folder cannot be locked, or the state cannot be written.
        """
        self._lock.require()
        self._store.save(state, key)


@contextmanager
def alone(folder: Path) -> Iterator[FolderLock]:
    """Lock a folder for this process, at once where that can be done, else before the first file is written.

    Raises
    ------
    ConfigError
        Another process has it, or it cannot be used.
    """
    folders.make(folder, 0o700)
    lock = FolderLock(folder)
    lock.take()
    try:
        yield lock
    finally:
        lock.release()
