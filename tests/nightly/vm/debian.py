"""Debian parts of the machine: a stock kernel with its modules, busybox, can-utils.

They are downloaded by apt and unpacked into the user's cache; nothing is installed and no root is needed. A whole
system, with systemd, is made by mmdebstrap from the same sources.
"""

import os
import platform
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

KERNEL = "linux-image-amd64"  # depends on the newest kernel of the release
OTHERS = ("busybox-static", "can-utils")
SYSTEM_PACKAGES = ("systemd-sysv", "libnss-systemd", "python3", "libstdc++6", "iproute2", "can-utils", "procps")
SOURCES = Path("/etc/apt")
ALL_MODULES = "lib/modules/**/*.ko"
MODULES = (
    *("virtio_pci", "9pnet_virtio", "9p"),
    *("can", "can_raw", "can_bcm", "can_j1939", "vcan"),
)


class VmError(Exception):
    """The machine is not available: a part is not installed, was not downloaded, or did not start."""


@dataclass(frozen=True, slots=True)
class Parts:
    """Paths of the unpacked parts."""

    root: Path

    @property
    def kernel(self) -> Path:
        """The compressed kernel image."""
        return next(self.root.glob("boot/vmlinuz-*"))

    @property
    def busybox(self) -> Path:
        """A static busybox."""
        return self.root / "bin" / "busybox"

    @property
    def programs(self) -> Path:
        """The folder of can-utils and of ``ip``."""
        return self.root / "usr" / "bin"

    def modules(self) -> list[Path]:
        """The wanted kernel modules and their dependencies, in the order of insertion."""
        files = {path.stem.replace("-", "_"): path for path in self.root.glob(ALL_MODULES)}
        ordered: dict[str, Path] = {}

        def need(name: str) -> None:
            if name in ordered or name not in files:  # a module without a file is built into the kernel
                return
            depends = re.search(rb"\0depends=([^\0]*)\0", files[name].read_bytes())
            for other in depends.group(1).decode().split(",") if depends else []:
                need(other.replace("-", "_"))
            ordered[name] = files[name]

        for module in MODULES:
            need(module)
        return list(ordered.values())


def cache() -> Path:
    """The user's cache folder for this machine."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "roadload" / "vm"


def parts() -> Parts:
    """The unpacked parts; downloads them the first time.

    Raises
    ------
    VmError
        apt is missing, or the download failed.
    """
    folder = cache() / "debian"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
            unpacked = Parts(Path(scratch) / "root")
            _download(Path(scratch), unpacked.root)
            for module in set(unpacked.root.glob(ALL_MODULES)) - set(unpacked.modules()):
                module.unlink()  # hundreds of MiB
            unpacked.root.rename(folder)
    return Parts(folder)


def system() -> Path:
    """A Debian system with systemd and Python, of the host's release, as a tar archive; made the first time.

    Raises
    ------
    VmError
        apt is missing, the host is no Debian, or mmdebstrap failed: without root it needs user name spaces.
    """
    archive = cache() / "system.tar"
    if not archive.exists():
        archive.parent.mkdir(parents=True, exist_ok=True)
        release = platform.freedesktop_os_release().get("VERSION_CODENAME", "")
        sources = [*SOURCES.glob("sources.list"), *SOURCES.glob("sources.list.d/*.list")]
        sources += SOURCES.glob("sources.list.d/*.sources")
        with tempfile.TemporaryDirectory(dir=archive.parent) as scratch:
            folder, made = Path(scratch), Path(scratch) / archive.name
            _require("apt-get", "dpkg-deb", "perl")
            _run(["apt-get", "download", "--quiet", "mmdebstrap"], folder)
            (package,) = folder.glob("mmdebstrap*.deb")
            _run(["dpkg-deb", "--extract", str(package), scratch], folder)
            program = ["perl", str(folder / "usr/bin/mmdebstrap"), "--quiet", "--variant=apt"]
            wanted = f"--include={','.join(SYSTEM_PACKAGES)}"
            _run([*program, wanted, release, str(made), *map(str, sources)], folder)
            made.rename(archive)
    return archive


def _require(*programs: str) -> None:
    for program in programs:
        if shutil.which(program) is None:
            raise VmError(f"{program} is not here: the machine is made of Debian packages")


def _download(scratch: Path, unpacked: Path) -> None:
    _require("apt-get", "apt-cache", "dpkg-deb")
    depends = _run(["apt-cache", "depends", KERNEL], scratch)
    kernel = re.search(r"Depends: (linux-image-\S+)", depends)
    if kernel is None:
        raise VmError(f"apt knows no {KERNEL}: run `apt-get update` on a Debian amd64 host")
    _run(["apt-get", "download", "--quiet", kernel.group(1), *OTHERS], scratch)
    for package in sorted(scratch.glob("*.deb")):
        _run(["dpkg-deb", "--extract", str(package), str(unpacked)], scratch)
    (unpacked / "usr" / "bin" / "ip").symlink_to("../../bin/busybox")


def _run(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        complaint = done.stderr.strip().splitlines()
        raise VmError(f"{' '.join(command)}: {complaint[-1] if complaint else 'failed'}")
    return done.stdout
