"""One command in a virtual machine: QEMU runs the kernel, the command runs in the file system of the host.

The host's root is shared read-only (9p), so the project, its virtual environment and its Python have the
same paths as on the host; one folder is shared for writing. No root, no KVM, no network.
The command can run in a Debian system of its own instead, with systemd as its first process.

The machine's clock counts executed instructions, so the load of the host does not change how much the command computes
between two times. QEMU counts instructions with a single processor only.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from vm import initramfs
from vm.debian import VmError, parts

QEMU = "qemu-system-x86_64"
CPU = "Nehalem"  # enough for NumPy (x86-64-v2); with the emulated AVX2 of "max" NumPy and OpenBLAS crash
INSTRUCTION = 1  # log2 of the time of an instruction [ns]: 500 million a second, more than a busy host executes
MEMORY, SYSTEM_MEMORY = 1536, 3072  # MiB; a system of its own is in the memory
SHARES = "local,security_model=none,multidevs=remap"
CONSOLE = "console.txt"  # in the shared folder
# Settings of roadload for an emulated processor, a tenth as fast as a gateway's.
QUICK_SAMPLER = """
[sampler]
likelihood = "paper" # it takes a minute for the first search of the road's scales
"""
EARLY_GATE = """
[gate] # an estimate after a few minutes of driving
interval_s = 5.0
minimum_samples = 100
minimum_cells = 2
cell_count = 3
coverage = 0.01
relative_sd = [9.0, 9.0, 9.0]
"""


def run(
    command: Sequence[str],
    share: Path,
    *,
    timeout: float,
    environment: Mapping[str, str] | None = None,
    system: Path | None = None,
) -> int:
    """Boot, run ``command`` in the current directory as root, power off.

    Parameters
    ----------
    command
        Program and arguments. Its programs include can-utils and ``ip``; /dev/shm is its temporary folder.
    share
        A folder on the host that the command may write to, at the same path. The console output is written
        there as CONSOLE.
    timeout
        Longest time for all of it [s], by the clock of the host.
    environment
        Variables of the command, besides PATH, HOME and TMPDIR.
    system
        A Debian system (`vm.debian.system`) to start and to run the command in; it has no project and no can-utils but
        its own, ``share`` is its folder /share, which is the current directory.

    Returns
    -------
    int
        The command's exit status.

    Raises
    ------
    VmError
        The machine is not available, or did not end in time.
    """
    require_qemu()
    debian = parts()
    share = share.resolve()
    archive = share / "initramfs.gz"
    initramfs.write(debian, archive, system)
    programs = f"{debian.programs}:" if system is None else ""
    variables = {
        "PATH": f"{os.defpath}:{programs}/usr/sbin:/sbin",
        "HOME": "/dev/shm",
        "TMPDIR": "/dev/shm",
        "PYTHONDONTWRITEBYTECODE": "1",
        **(environment or {}),
    }
    exports = [f"export {name}={shlex.quote(value)}" for name, value in variables.items()]
    folder = os.getcwd() if system is None else "/share"
    script = [*exports, f"cd {shlex.quote(folder)}", shlex.join(command), ""]
    (share / "command").write_text("\n".join(script))
    status = share / "status"
    status.unlink(missing_ok=True)
    with (share / CONSOLE).open("wb") as console:
        try:
            machine = _qemu(debian.kernel, archive, share, system is not None)
            subprocess.run(machine, stdin=subprocess.DEVNULL, stdout=console, stderr=console, timeout=timeout)
        except subprocess.TimeoutExpired as error:
            raise VmError(f"not done after {timeout:g} s; see {console.name}") from error
    if not status.exists():
        raise VmError(f"the machine stopped before the command ended; see {console.name}")
    return int(status.read_text())


@contextmanager
def shown_console(share: Path) -> Iterator[None]:
    """Print what the machine has written to its console, when the block ends, with an error or without."""
    try:
        yield
    finally:
        console = share / CONSOLE
        if console.exists():
            sys.stdout.write(console.read_text(errors="replace"))


def require_qemu() -> None:
    """Refuse to go on where there is no QEMU.

    Raises
    ------
    VmError
        It is not installed.
    """
    if shutil.which(QEMU) is None:
        raise VmError(f"{QEMU} is not installed")


def _qemu(kernel: Path, archive: Path, share: Path, has_system: bool) -> list[str]:
    memory, idle = (SYSTEM_MEMORY, "off") if has_system else (MEMORY, "on")  # off: idle time passes at once
    boot = f"console=ttyS0 quiet panic=-1 mitigations=off systemd.show_status=no share={share} end"
    return [
        *(QEMU, "-accel", "tcg,thread=single", "-cpu", CPU, "-m", str(memory)),
        *("-icount", f"shift={INSTRUCTION},sleep={idle}"),
        *("-kernel", str(kernel), "-initrd", str(archive), "-append", boot),
        *("-virtfs", f"{SHARES},path=/,mount_tag=root,readonly=on"),
        *("-virtfs", f"{SHARES},path={share},mount_tag=share"),
        *("-nic", "none", "-display", "none", "-monitor", "none", "-serial", "stdio", "-no-reboot"),
    ]


def has_vcan() -> bool:
    """Whether the host's kernel allows virtual CAN interfaces, so that no machine is needed."""
    if sys.platform != "linux" or shutil.which("ip") is None:
        return False
    made = subprocess.run(["ip", "link", "add", "dev", "vcan9", "type", "vcan"], capture_output=True)
    if made.returncode == 0:
        subprocess.run(["ip", "link", "delete", "dev", "vcan9"], check=True)
    return made.returncode == 0
