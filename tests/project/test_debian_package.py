"""The Debian package: what is in it, that it runs without anything else, and that changed wheels are refused."""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from project_paths import ROOT

from estimator.commands.main import COMMANDS

pytestmark = pytest.mark.nightly

LONGEST = 600.0  # s to build it, with wheels to be downloaded
PRIVATE, OWN = "usr/lib/roadload", {"estimator"}  # the folder of project and libraries, and what is the project's
ALONE = ["-I", "-S"]  # Python without the environment's packages and variables


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with package and wheels."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("no dpkg-deb here")
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, str(ROOT / "deploy" / "build_deb.py"), "--output", str(folder), "--compression", "gzip"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST)
    if done.returncode and ("No module named pip" in done.stderr or "No matching distribution" in done.stderr):
        pytest.skip(f"the wheels cannot be had: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def package(built: Path) -> Path:
    (found,) = built.glob("*.deb")
    return found


@pytest.fixture(scope="module")
def tree(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package, unpacked."""
    folder = tmp_path_factory.mktemp("tree")
    subprocess.run(["dpkg-deb", "--raw-extract", str(package), str(folder)], check=True)
    return folder


def test_everything_is_where_debian_looks_for_it(package: Path, tree: Path) -> None:
    for path in (
        "usr/bin/roadload",
        "usr/lib/systemd/system/roadload.service",
        "usr/lib/sysctl.d/60-roadload.conf",
        "etc/roadload/roadload.toml",
        "usr/share/man/man1/roadload.1.gz",
        "usr/share/doc/roadload/copyright",
        "usr/share/doc/roadload/docs/trouble_codes.md",
        "usr/share/doc/roadload/examples/network.conf",
        "usr/share/doc/roadload/examples/roadload.dashboard.json",
        "usr/share/doc/roadload/examples/roadload.rules.yml",
        "usr/lib/roadload/estimator/dbc/j1939.dbc",
    ):
        assert (tree / path).is_file(), path
    assert (tree / "DEBIAN" / "conffiles").read_text() == "/etc/roadload/roadload.toml\n"
    listed = subprocess.run(["dpkg-deb", "--contents", str(package)], capture_output=True, text=True, check=True)
    for line in listed.stdout.splitlines():
        mode, owner = line.split()[:2]
        assert owner == "root/root"
        assert mode[8] == "-", line  # nobody else may write it


def test_the_checksums_are_those_of_the_files(tree: Path) -> None:
    sums = dict(reversed(line.split("  ", 1)) for line in (tree / "DEBIAN" / "md5sums").read_text().splitlines())
    files = {str(path.relative_to(tree)) for path in tree.rglob("*") if path.is_file()}
    assert set(sums) == {name for name in files if not name.startswith(("DEBIAN/", "etc/"))}
    for name in ("usr/bin/roadload", "usr/lib/roadload/estimator/config.py"):
        assert sums[name] == hashlib.md5((tree / name).read_bytes()).hexdigest()


def test_the_unit_of_the_package_calls_the_program_of_the_package(tree: Path) -> None:
    shipped = (ROOT / "deploy" / "systemd" / "roadload.service").read_text()
    unit = (tree / "usr/lib/systemd/system/roadload.service").read_text()
    assert re.search(r"^ExecStart=/usr/bin/roadload run .*--config /etc/roadload/roadload.toml$", unit, re.MULTILINE)
    assert unit == shipped.replace("/opt/roadload/bin/roadload", "/usr/bin/roadload")
    launcher = (tree / "usr/bin/roadload").read_text()
    assert launcher.startswith("#!/usr/bin/python3 -I\n")
    assert os.access(tree / "usr/bin/roadload", os.X_OK)


def run(tree: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The program of the package, at the place where it was unpacked."""
    program = (tree / "usr/bin/roadload").read_text().replace("/usr/lib/roadload", str(tree / "usr/lib/roadload"))
    command = [sys.executable, *ALONE, "-c", program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=tree, timeout=120)


def test_it_runs_with_nothing_but_itself(tree: Path, tmp_path: Path) -> None:
    log = tmp_path / "drive.blf"
    done = run(tree, "simulate", str(log), "--minutes", "2", "--seed", "1")
    assert done.returncode == 0, done.stderr
    inspected = run(tree, "inspect", str(log), "--json")
    assert '"usable": true' in inspected.stdout, inspected.stderr
    settings = run(
        tree, "run", "-i", "socketcan", "-c", "can0", "--config", "etc/roadload/roadload.toml", "--print-config"
    )
    assert 'channel = "can0"' in settings.stdout, settings.stderr


def test_the_man_page_has_every_command_and_no_error(tree: Path) -> None:
    page = ROOT / "deploy" / "debian" / "roadload.1"
    commands = page.read_text().split(".SH COMMANDS")[1].split(".SH EXIT")[0]
    assert sorted(re.findall(r"^\.B (\w+)$", commands, re.MULTILINE)) == sorted(COMMANDS)
    if shutil.which("groff") is None:
        pytest.skip("no groff here to read the man page")
    done = subprocess.run(["groff", "-man", "-Tutf8", "-ww", str(page)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_lintian_finds_no_error(tree: Path, tmp_path: Path) -> None:
    """Without the libraries, which are as their authors publish them: a minute and a half of lintian's time."""
    if shutil.which("lintian") is None:
        pytest.skip("no lintian here")
    own, package = tmp_path / "tree", tmp_path / "roadload.deb"
    shutil.copytree(tree, own, ignore=lambda folder, names: set(names) - OWN if folder.endswith(PRIVATE) else set())
    sums = (own / "DEBIAN" / "md5sums").read_text().splitlines(keepends=True)
    kept = "".join(line for line in sums if (own / line.split("  ", 1)[1].rstrip()).exists())
    (own / "DEBIAN" / "md5sums").write_text(kept)
    subprocess.run(["dpkg-deb", "--root-owner-group", "-Zgzip", "--build", str(own), str(package)], check=True)
    done = subprocess.run(
        ["lintian", "--fail-on", "error", str(package)], capture_output=True, text=True, timeout=LONGEST
    )
    assert done.returncode == 0, done.stdout


def test_a_wheel_that_was_changed_is_not_installed(built: Path, tmp_path: Path) -> None:
    wheels = tmp_path / "wheels"
    shutil.copytree(built / "wheels", wheels)
    pip = [sys.executable, "-m", "pip", "install", "-qq", "--require-hashes", "--no-index", "--no-deps"]
    lines = (wheels / "requirements.txt").read_text().splitlines()
    (tmp_path / "one.txt").write_text(next(line for line in lines if line.startswith("mdurl")))

    def install() -> subprocess.CompletedProcess[str]:
        target = ["--find-links", str(wheels), "--target", str(tmp_path / "there"), "-r", str(tmp_path / "one.txt")]
        return subprocess.run([*pip, *target], capture_output=True, text=True)

    assert install().returncode == 0
    (changed,) = wheels.glob("mdurl-*.whl")
    with changed.open("ab") as file:
        file.write(b"\0")
    shutil.rmtree(tmp_path / "there")
    refused = install()
    assert refused.returncode != 0
    assert "do not match the hashes" in refused.stderr.lower()
