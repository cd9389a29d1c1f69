"""File systems that turn read-only, buses closed in the wrong instant, datagrams that are no frames: it runs on."""

import errno
import logging
import os
import shutil
from pathlib import Path

import can
import pytest
from can.interfaces.udp_multicast import UdpMulticastBus
from daemon_bench import Bench, FakeBus, frame

from estimator.checkpoint.store import StateStore
from estimator.daemon.reception.reader import MAX_BATCH, MessageReader
from estimator.daemon.service import folders
from estimator.daemon.service.folder_lock import LockedStore, alone
from estimator.errors import ConfigError, RoadloadError

READ_ONLY = OSError(errno.EROFS, os.strerror(errno.EROFS))


def refuse(*arguments, **keywords):
    raise READ_ONLY


# Folders and files


def test_a_state_folder_on_a_read_only_file_system_does_not_stop_the_daemon(tmp_path: Path, monkeypatch, caplog):
    monkeypatch.setattr(Path, "mkdir", refuse)
    with caplog.at_level(logging.WARNING), alone(tmp_path / "state"):
        pass
    assert "Read-only file system; nothing is kept there until it can be written" in caplog.text


def test_a_folder_that_waiting_does_not_mend_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="choose another folder"):
        folders.make(tmp_path / "file" / "state", 0o700)


def test_two_daemons_do_not_share_a_folder(tmp_path: Path):
    with alone(tmp_path), pytest.raises(ConfigError, match="another daemon"), alone(tmp_path):
        pass
    with alone(tmp_path):
        pass


@pytest.fixture
def file_system(monkeypatch):
    """A file system that can be written, or cannot."""
    read_only, opened, made = [False], os.open, Path.mkdir

    def open_(path, flags, *rest, **keywords):
        if read_only[0] and flags & (os.O_RDWR | os.O_WRONLY | os.O_CREAT):
            raise READ_ONLY
        return opened(path, flags, *rest, **keywords)

    def mkdir(path, *rest, **keywords):
        if read_only[0] and not path.is_dir():
            raise READ_ONLY
        made(path, *rest, **keywords)

    monkeypatch.setattr(os, "open", open_)
    monkeypatch.setattr(Path, "mkdir", mkdir)
    return read_only


def test_two_daemons_do_not_share_a_folder_that_cannot_be_written(tmp_path: Path, file_system):
    with alone(tmp_path):
        pass
    file_system[0] = True
    with alone(tmp_path), pytest.raises(ConfigError, match="another daemon"), alone(tmp_path):
        pass


def test_of_two_daemons_that_found_no_folder_one_saves(tmp_path: Path, file_system):
    file_system[0] = True
    folder = tmp_path / "state"
    with alone(folder) as first, alone(folder) as second:
        one, other = (LockedStore(StateStore(folder), lock) for lock in (first, second))
        with pytest.raises(RoadloadError, match="cannot be locked"):
            one.save({"a": 1}, "key")
        file_system[0] = False
        other.save({"a": 2}, "key")
        with pytest.raises(ConfigError, match="another daemon"):
            one.save({"a": 1}, "key")
    assert StateStore(folder).load("key") == ({"a": 2}, "")


def test_a_folder_that_was_replaced_is_locked_again(tmp_path: Path):
    folder = tmp_path / "state"
    with alone(folder) as lock:
        shutil.rmtree(folder)
        lock.require()
        with pytest.raises(ConfigError, match="another daemon"), alone(folder):
            pass


class Disk:
    """A place for states that can be written, or cannot."""

    def __init__(self) -> None:
        self.is_read_only = True
        self.saved = 0

    def save(self, state: object, key: str) -> None:
        if self.is_read_only:
            raise RoadloadError("state: not saved: Read-only file system")
        self.saved += 1


def test_saving_is_tried_again_until_it_works_and_the_reason_is_shown():
    disk = Disk()
    bench = Bench(store=disk)  # type: ignore[arg-type]
    bench.turn()
    bench.traffic(30.0, frame(0x18FEF100, bytes([0xFF, 0, 60, *[0xFF] * 5])))
    bench.worker.save()
    assert "Read-only" in bench.daemon.status(bench.now).estimator.state_problem
    assert bench.worker.saves["failed"] >= 1
    disk.is_read_only = False
    bench.worker.save()
    assert disk.saved == 1
    assert bench.daemon.status(bench.now).estimator.state_problem == ""


def test_status_and_metrics_that_cannot_be_written_do_not_stop_the_loop(tmp_path: Path, monkeypatch, caplog):
    bench = Bench(tmp_path)
    bench.turn()
    assert (tmp_path / "status.json").exists()
    with monkeypatch.context() as patch:
        for call in ("unlink", "replace"):
            patch.setattr(Path, call, refuse)
        patch.setattr(os, "open", refuse)
        bench.traffic(3.0)
        bench.daemon.close()
    assert "Read-only file system" in caplog.text


def test_a_leftover_that_cannot_be_removed_does_not_hide_the_state(tmp_path: Path, monkeypatch):
    store = StateStore(tmp_path)
    store.save({"a": 1}, "key")
    (tmp_path / "state.1.part").write_bytes(b"")
    monkeypatch.setattr(Path, "unlink", refuse)
    assert StateStore(tmp_path).load("key") == ({"a": 1}, "")


# Buses


def test_a_bus_closed_while_sending_is_a_failure_to_send():
    bench = Bench()
    bench.turn()
    bench.bus.send_failures += [can.CanOperationError("gone"), ValueError("file descriptor cannot be negative (-1)")]
    with pytest.raises(can.CanOperationError, match="was closed"):
        bench.link.send(frame(0x18FF60FB))


class Datagrams(UdpMulticastBus):
    """A multicast bus without a network: hands out what it is given, frames or malformed datagrams."""

    def __init__(self, *items: can.Message | Exception) -> None:
        self.items = list(items)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        item = self.items.pop(0) if self.items else None
        if isinstance(item, Exception):
            raise can.CanOperationError("could not unpack received message") from item
        return item

    def shutdown(self) -> None:
        self.items = []

    def __del__(self) -> None:
        pass


def test_malformed_datagrams_are_counted_and_passed_over():
    good = frame(0x18FEF100)
    reader = MessageReader(Datagrams(TypeError("x"), good, ValueError("y"), good, KeyError("z")))
    batch = reader.read(0.0)
    assert len(batch.frames) == 2
    assert batch.malformed == 3


def test_a_flood_of_malformed_datagrams_does_not_hold_the_reader():
    reader = MessageReader(Datagrams(*[ValueError("x")] * (2 * MAX_BATCH)))
    assert reader.read(0.0).malformed == MAX_BATCH


def test_a_bus_that_has_gone_is_still_an_error():
    reader = MessageReader(Datagrams(OSError(errno.ENETDOWN, "Network is down")))
    with pytest.raises(can.CanOperationError):
        reader.read(0.0)
    broken = MessageReader(Broken())  # type: ignore[arg-type]
    with pytest.raises(can.CanOperationError):
        broken.read(0.0)


class Broken(FakeBus):
    def recv(self, timeout: float | None = None) -> can.Message | None:
        raise can.CanOperationError("gone") from ValueError("anything")
