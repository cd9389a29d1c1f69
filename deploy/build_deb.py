"""Build a Debian package, and wheels with hashes: python deploy/build_deb.py [--output dist] [--compression xz].

The wheels are those of the versions in constraints.txt; their SHA-256 are in ``requirements.txt`` beside them, for:

    pip install --require-hashes --no-index --find-links wheels -r wheels/requirements.txt

From the same wheels the package gets /usr/lib/roadload, which nothing else imports. It holds the service, which gets a
user of its own from systemd (DynamicUser), the size of receive buffers (sysctl), settings, man page and alert rules. It
is for the architecture and the minor version of Python that this tool runs on. Needs pip, and dpkg-deb for the package.
"""

import argparse
import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from email.utils import formatdate
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEBIAN = Path(__file__).with_name("debian")
SYSTEMD, PROMETHEUS = ROOT / "deploy" / "systemd", ROOT / "deploy" / "prometheus"
SOURCE = ("pyproject.toml", "README.md", "LICENSE", "estimator", "dbc")  # what the wheel is built from
PRIVATE = "usr/lib/roadload"
LAUNCHER = f"""#!/usr/bin/python3 -I
import sys

sys.path.insert(0, "/{PRIVATE}")
from estimator.commands.main import main

sys.exit(main())
"""
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-qq"]
LEVELS = {"xz": "6", "gzip": "1", "none": "0"}  # gzip for tests, which would rather be quick


def main() -> int:
    """Build both, print where they are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "dist")
    parser.add_argument("--compression", choices=LEVELS, default="xz")
    parser.add_argument("--maintainer", default="the roadload authors <roadload@localhost.localdomain>")
    options = parser.parse_args()
    wheels = build_wheels(options.output / "wheels")
    print(wheels / "requirements.txt")
    if shutil.which("dpkg-deb") is None:
        print("no dpkg-deb here: no package", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        tree = Path(scratch) / "tree"
        lay_out(tree, wheels, options.maintainer)
        print(pack(tree, options.output, options.compression))
    return 0


def build_wheels(folder: Path) -> Path:
    """The project and what it needs as wheels in a new folder, with their hashes in requirements.txt."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        for name in SOURCE:
            given, copy = ROOT / name, Path(scratch) / name
            ignored = shutil.ignore_patterns("__pycache__", "*.pyc")
            shutil.copytree(given, copy, ignore=ignored) if given.is_dir() else shutil.copy2(given, copy)
        command = [*PIP, "wheel", "--constraint", str(ROOT / "constraints.txt"), "--wheel-dir", str(folder), scratch]
        subprocess.run(command, check=True)
    lines = []
    for wheel in sorted(folder.glob("*.whl")):
        name, version = wheel.name.split("-")[:2]
        lines.append(f"{name}=={version} --hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}")
    (folder / "requirements.txt").write_text("\n".join(lines) + "\n")
    return folder


def lay_out(tree: Path, wheels: Path, maintainer: str) -> None:
    """Everything in the package at its place in ``tree``."""
    command = [*PIP, "install", "--require-hashes", "--no-index", "--find-links", str(wheels), "--no-compile"]
    private = tree / PRIVATE
    subprocess.run([*command, "--target", str(private), "-r", str(wheels / "requirements.txt")], check=True)
    shutil.rmtree(private / "bin", ignore_errors=True)  # scripts that name the Python of this machine
    for folder in [path for path in private.rglob("tests") if path.is_dir()]:  # of libraries; a fifth of the size
        shutil.rmtree(folder)
    # Compiled here: the processor of a gateway would take a minute at each start, or at the installation.
    compiled = ["-m", "compileall", "-q", "-j0", "--invalidation-mode", "unchecked-hash", "-s", str(tree), "-p", "/"]
    subprocess.run([sys.executable, *compiled, str(private)], check=True)
    documents = tree / "usr/share/doc/roadload"
    unit = (SYSTEMD / "roadload.service").read_text().replace("/opt/roadload/bin/roadload", "/usr/bin/roadload")
    write(tree / "usr/bin/roadload", LAUNCHER, 0o755)
    write(tree / "usr/lib/systemd/system/roadload.service", unit)
    write(tree / "usr/lib/sysctl.d/60-roadload.conf", (SYSTEMD / "60-roadload.conf").read_text())
    write(tree / "etc/roadload/roadload.toml", (SYSTEMD / "roadload.toml").read_text())
    write(tree / "usr/share/man/man1/roadload.1.gz", zipped((DEBIAN / "roadload.1").read_bytes()))
    write(documents / "copyright", (ROOT / "LICENSE").read_text())
    write(documents / "changelog.gz", zipped(changelog(maintainer).encode()))
    write(tree / "usr/share/lintian/overrides/roadload", (DEBIAN / "lintian-overrides").read_text())
    for page in (ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))):
        write(documents / page.relative_to(ROOT), page.read_text(encoding="utf-8"))
    write(documents / "examples/roadload.rules.yml", (PROMETHEUS / "roadload.rules.yml").read_text())
    dashboard = (PROMETHEUS / "roadload.dashboard.json").read_text(encoding="utf-8")
    write(documents / "examples/roadload.dashboard.json", dashboard)
    write(documents / "examples/network.conf", (SYSTEMD / "network.conf").read_text())
    for path in [*tree.rglob("*")]:
        path.chmod(0o755 if path.is_dir() or path == tree / "usr/bin/roadload" else 0o644)
    write_control(tree, maintainer)


def write_control(tree: Path, maintainer: str) -> None:
    """The folder DEBIAN: description, scripts, list of settings, checksums."""
    minor = sys.version_info.minor
    files = [path for path in sorted(tree.rglob("*")) if path.is_file()]
    fields = {
        "VERSION": version(),
        "ARCHITECTURE": subprocess.check_output(["dpkg", "--print-architecture"], text=True).strip(),
        "MAINTAINER": maintainer,
        "SIZE": str(sum(-(-path.stat().st_size // 1024) for path in files)),
        "PYTHON": f"python3 (>= 3.{minor}~), python3 (<< 3.{minor + 1}~)",
    }
    control = re.sub(r"@(\w+)@", lambda found: fields[found[1]], (DEBIAN / "control").read_text())
    sums = [f"{hashlib.md5(path.read_bytes()).hexdigest()}  {path.relative_to(tree)}" for path in files]
    write(tree / "DEBIAN/control", control)
    write(tree / "DEBIAN/conffiles", "/etc/roadload/roadload.toml\n")
    write(tree / "DEBIAN/md5sums", "\n".join(line for line in sums if "  etc/" not in line) + "\n")
    for script in ("postinst", "prerm", "postrm"):
        write(tree / "DEBIAN" / script, (DEBIAN / script).read_text(), 0o755)


def pack(tree: Path, output: Path, compression: str) -> Path:
    """The package; the same commit and wheels give the same bytes."""
    level = ["-z", LEVELS[compression]] if compression != "none" else []
    architecture = subprocess.check_output(["dpkg", "--print-architecture"], text=True).strip()
    package = output / f"roadload_{version()}_{architecture}.deb"
    unfinished = package.with_name(f".part-{package.name}")
    command = ["dpkg-deb", "--root-owner-group", f"-Z{compression}", *level, "--build", str(tree), str(unfinished)]
    subprocess.run(
        command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, "SOURCE_DATE_EPOCH": str(epoch())}
    )
    return unfinished.replace(package)


def version() -> str:
    """Version of the project."""
    found = re.search(r'^__version__ = "(.+)"$', (ROOT / "estimator" / "__init__.py").read_text(), re.MULTILINE)
    assert found is not None
    return found[1]


def epoch() -> int:
    """Time [s] that all files carry: SOURCE_DATE_EPOCH, else that of the commit, else now."""
    if given := os.environ.get("SOURCE_DATE_EPOCH"):
        return int(given)
    done = subprocess.run(["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True)
    return int(done.stdout) if done.returncode == 0 else int(time.time())


def changelog(maintainer: str) -> str:
    """The changelog that Debian asks for; what has changed is in CHANGELOG.md."""
    date = formatdate(epoch())
    return f"roadload ({version()}) unstable; urgency=low\n\n  * See CHANGELOG.md.\n\n -- {maintainer}  {date}\n"


def zipped(data: bytes) -> bytes:
    """Compressed as Debian asks: best, and without a time."""
    return gzip.compress(data, 9, mtime=0)


def write(path: Path, content: str | bytes, mode: int = 0o644) -> None:
    """Write a file and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    path.chmod(mode)


if __name__ == "__main__":
    sys.exit(main())
