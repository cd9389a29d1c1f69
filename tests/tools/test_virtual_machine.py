"""The machine with systemd: what it is started with, what runs in it, and what is said where it cannot be."""

import gzip
import shutil
import subprocess
import sys
from pathlib import Path

import package_vm
import pytest
from project_paths import TESTS
from vm import initramfs
from vm.debian import Parts, VmError
from vm.machine import CONSOLE, shown_console

NIGHTLY = TESTS / "nightly"
CONTROL = "Package: small\nVersion: 1.2\nArchitecture: all\nMaintainer: nobody <n@localhost>\nDescription: small\n"


def archive(folder: Path, system: Path | None) -> str:
    (folder / "bin").mkdir(exist_ok=True)
    (folder / "bin" / "busybox").write_bytes(b"busybox")
    initramfs.write(Parts(folder), folder / "archive", system)
    return gzip.decompress((folder / "archive").read_bytes()).decode(errors="replace")


def test_a_system_of_its_own_is_unpacked_and_started(tmp_path: Path) -> None:
    with_system, without = archive(tmp_path, Path("/cache/system.tar")), archive(tmp_path, None)
    assert "tar -xf /host/cache/system.tar -C /system\n" in with_system
    assert "exec switch_root /system /lib/systemd/systemd\n" in with_system
    assert 'ExecStart=/bin/sh -c "/bin/sh /share/command; echo $$? > /share/status; sync"\n' in with_system
    assert "switch_root" not in without
    assert "exec chroot . /bin/busybox" not in with_system


@pytest.mark.parametrize("program", ["package_trial", "attack_trial"])
def test_programs_in_the_machine_need_nothing_but_python(program: str) -> None:
    code = f"import sys; sys.path.insert(0, {str(NIGHTLY)!r}); import vm.{program}"
    done = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_successor_of_a_package_is_newer_and_otherwise_the_same(tmp_path: Path) -> None:
    if shutil.which("dpkg-deb") is None:
        pytest.skip("no dpkg-deb here")
    tree = tmp_path / "tree"
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "DEBIAN" / "control").write_text(CONTROL)
    (tree / "file").write_text("content")
    old, new, unpacked = tmp_path / "old.deb", tmp_path / "new.deb", tmp_path / "unpacked"
    subprocess.run(["dpkg-deb", "-Znone", "--build", str(tree), str(old)], check=True, stdout=subprocess.DEVNULL)
    package_vm.successor(old, new)
    version = subprocess.check_output(["dpkg-deb", "--field", str(new), "Version"], text=True).strip()
    subprocess.run(["dpkg", "--compare-versions", version, "gt", "1.2"], check=True)
    subprocess.run(["dpkg-deb", "--raw-extract", str(new), str(unpacked)], check=True)
    assert (unpacked / "file").read_text() == "content"


def test_without_qemu_the_tool_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(sys, "argv", ["package_vm.py"])
    assert package_vm.main() == 1
    assert capsys.readouterr().err == "error: qemu-system-x86_64 is not installed\n"


def test_the_console_is_shown_when_the_machine_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / CONSOLE).write_bytes(b"no init found\xff\n")
    with pytest.raises(VmError), shown_console(tmp_path):
        raise VmError("not done after 10 s")
    assert capsys.readouterr().out.startswith("no init found")


def test_a_machine_that_did_not_start_has_no_console_to_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with shown_console(tmp_path):
        pass
    assert capsys.readouterr().out == ""
