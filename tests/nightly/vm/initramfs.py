"""The initial file system: busybox, modules and an init.

The init runs one command, in the host's file system or in a Debian system of its own under systemd.

The archive is written in cpio's "newc" format (Linux: Documentation/driver-api/early-userspace/buffer-format.rst),
which needs neither root nor device files on the host.
"""

import gzip
import stat
from pathlib import Path

from vm.debian import Parts

FOLDERS = ("bin", "dev", "proc", "sys", "lib", "host")
SHARE_OPTIONS = "trans=virtio,version=9p2000.L,cache=loose,msize=262144"
BEGIN = """#!/bin/busybox sh
export PATH=/applets
busybox=/bin/busybox
$busybox mkdir /applets
$busybox --install -s /applets
mount -t proc proc /proc
mount -t devtmpfs dev /dev
for module in {modules}; do insmod /lib/$module.ko; done
share=$(sed -n 's/.* share=\\([^ ]*\\).*/\\1/p' /proc/cmdline)
mount -t 9p -o ro,{options} root /host
"""
IN_HOST = """
mount -t proc proc /host/proc
mount -t sysfs sys /host/sys
mount -t devtmpfs dev /host/dev
mkdir -p /host/dev/shm
mount -t tmpfs shm /host/dev/shm
mount -t 9p -o {options} share /host$share
ip link set lo up
cd /host
mount --move . /
exec chroot . {busybox} sh -c "/bin/sh $share/command; echo \\$? > $share/status; sync; {busybox} poweroff -f"
"""
# systemd does what a system does at its start, then runs the command and powers off.
IN_SYSTEM = """
mkdir /system
mount -t tmpfs -o mode=755,size=75% system /system
tar -xf /host{system} -C /system
umount /host
mkdir /system/share
mount -t 9p -o {options} share /system/share
cat > /system/etc/systemd/system/command.service << 'end'
[Unit]
SuccessAction=poweroff-force
FailureAction=poweroff-force
[Service]
Type=oneshot
TimeoutStartSec=infinity
StandardOutput=tty
StandardError=tty
TTYPath=/dev/console
ExecStart=/bin/sh -c "/bin/sh /share/command; echo $$? > /share/status; sync"
[Install]
WantedBy=multi-user.target
end
mkdir -p /system/etc/systemd/system/multi-user.target.wants
ln -s ../command.service /system/etc/systemd/system/multi-user.target.wants/
ln -s /dev/null /system/etc/systemd/system/serial-getty@ttyS0.service
exec switch_root /system /lib/systemd/systemd
"""


class _Archive:
    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def add(self, name: str, mode: int, data: bytes = b"", device: tuple[int, int] = (0, 0)) -> None:
        path = name.encode() + b"\0"
        inode = len(self._parts) + 1
        fields = (inode, mode, 0, 0, 1, 0, len(data), 0, 0, *device, len(path), 0)
        header = b"070701" + b"".join(b"%08X" % field for field in fields) + path
        self._parts.append(header + bytes(-len(header) % 4) + data + bytes(-len(data) % 4))

    def bytes(self) -> bytes:
        self.add("TRAILER!!!", 0)
        return b"".join(self._parts)


def write(parts: Parts, path: Path, system: Path | None = None) -> None:
    """Write the archive, compressed.

    ``system`` is a Debian system in a tar archive on the host, which is unpacked into the machine's memory and started;
    None to run the command in the host's file system.
    """
    archive = _Archive()
    for folder in FOLDERS:
        archive.add(folder, stat.S_IFDIR | 0o755)
    archive.add("dev/console", stat.S_IFCHR | 0o600, device=(5, 1))
    archive.add("bin/busybox", stat.S_IFREG | 0o755, parts.busybox.read_bytes())
    modules = parts.modules()
    for module in modules:
        archive.add(f"lib/{module.name}", stat.S_IFREG | 0o644, module.read_bytes())
    script = (BEGIN + (IN_HOST if system is None else IN_SYSTEM)).format(
        modules=" ".join(module.stem for module in modules),
        options=SHARE_OPTIONS,
        busybox=parts.busybox,
        system=system,
    )
    archive.add("init", stat.S_IFREG | 0o755, script.encode())
    path.write_bytes(gzip.compress(archive.bytes(), compresslevel=1))
