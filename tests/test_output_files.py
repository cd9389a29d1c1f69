"""Files appear whole or not at all, and a planted link is not followed."""

import errno
import os
from pathlib import Path

import pytest

from estimator import output_files
from estimator.errors import RoadloadError
from estimator.output_files import PART, create, whole, write


def test_a_file_appears_whole(tmp_path: Path):
    path = tmp_path / "page.html"
    with whole(path) as file:
        file.write(b"all of it")
        assert not path.exists()
    assert path.read_text() == "all of it"
    assert [entry.name for entry in tmp_path.iterdir()] == ["page.html"]


def test_a_file_that_is_being_written_has_not_its_suffix(tmp_path: Path):
    """The node exporter reads every *.prom of a folder, and others every log."""
    with whole(tmp_path / "roadload.prom") as file:
        file.write(b"half of")
        assert not list(tmp_path.glob("*.prom"))
    assert len(list(tmp_path.glob("*.prom"))) == 1


def test_what_was_there_stays_when_writing_fails(tmp_path: Path):
    path = tmp_path / "page.html"
    path.write_text("old")

    def write_half() -> None:
        with whole(path) as file:
            file.write(b"half")
            raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        write_half()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["page.html"]


@pytest.mark.parametrize("kind", ["link to a file", "link to nothing", "file"])
def test_a_link_planted_at_the_temporary_name_is_not_written_through(tmp_path: Path, kind: str):
    path, elsewhere = tmp_path / "status.json", tmp_path / "elsewhere"
    planted = tmp_path / f".{path.name}.{os.getpid()}{PART}"
    if kind == "file":
        planted.write_text("leftover")
    else:
        planted.symlink_to(elsewhere)
    if kind == "link to a file":
        elsewhere.write_text("of somebody else")
    with whole(path) as file:
        file.write(b"status")
    assert path.read_text() == "status"
    assert not path.is_symlink()
    assert not planted.exists()
    assert elsewhere.exists() == (kind == "link to a file")
    assert not elsewhere.exists() or elsewhere.read_text() == "of somebody else"


def test_bytes_are_written_with_their_mode_and_not_through_a_link(tmp_path: Path):
    path, elsewhere = tmp_path / "codes.json", tmp_path / "elsewhere"
    elsewhere.write_text("of somebody else")
    path.symlink_to(elsewhere)
    (tmp_path / f".{path.name}.{os.getpid()}{PART}").symlink_to(elsewhere)
    before = os.umask(0o077)
    try:
        write(path, b"all of it", 0o644)
    finally:
        os.umask(before)
    assert (path.read_text(), path.stat().st_mode & 0o777, path.is_symlink()) == ("all of it", 0o644, False)
    assert elsewhere.read_text() == "of somebody else"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["codes.json", "elsewhere"]


def test_a_link_put_in_the_place_of_a_file_that_is_being_written_is_not_written_through(tmp_path: Path, monkeypatch):
    path, elsewhere = tmp_path / "status.json", tmp_path / "elsewhere"
    elsewhere.write_text("of somebody else")

    def made_and_exchanged(temporary: Path, mode: int) -> int:
        descriptor = create(temporary, mode)
        temporary.unlink()
        temporary.symlink_to(elsewhere)
        return descriptor

    monkeypatch.setattr(output_files, "create", made_and_exchanged)
    write(path, b"status", 0o644)
    assert elsewhere.read_text() == "of somebody else"


@pytest.mark.parametrize("call", ["open", "replace", "unlink"])
def test_a_file_system_that_turned_read_only_is_one_error(tmp_path: Path, monkeypatch, call: str):
    path = tmp_path / "status.json"

    def refuse(*arguments, **keywords):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(output_files.os if call == "open" else Path, call, refuse)
    with pytest.raises(RoadloadError, match=r"status\.json: cannot write: Read-only file system"), whole(path):
        pass


def test_a_missing_folder_is_told(tmp_path: Path):
    with pytest.raises(RoadloadError, match="cannot write: No such file"), whole(tmp_path / "nowhere" / "x"):
        pass


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "No space left on device; free space on the disk and run again"),
        (errno.EFBIG, r"File too large; allow larger files \(ulimit -f\) and run again"),
        (errno.EACCES, "Permission denied; check the permissions"),
    ],
)
def test_a_file_that_cannot_be_written_says_what_to_do(tmp_path: Path, number: int, remedy: str):
    with pytest.raises(RoadloadError, match=f"cannot write: {remedy}$"), whole(tmp_path / "x"):
        raise OSError(number, os.strerror(number))
