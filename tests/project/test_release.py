"""What is released: wheel and source are whole, the wheel runs without a clone, and the pages beside them hold."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.metadata import Metadata
from project_paths import ROOT

from estimator import __version__
from estimator.commands.main import _parsed

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SOURCES = ("estimator", "dbc", "changes", "pyproject.toml", "MANIFEST.in", "constraints.txt")
PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "changes/README.md")
MAX_BYTES = 2_000_000  # of a wheel: one of twice the present size is a mistake
SCRIPTS = "Scripts" if os.name == "nt" else "bin"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the source distribution, and the wheel that was built from it."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for path in [*map(ROOT.joinpath, SOURCES), *ROOT.glob("[A-Z]*")]:  # and the pages, with LICENSE and CITATION.cff
        copy, ignored = source / path.name, shutil.ignore_patterns("__pycache__")
        shutil.copytree(path, copy, ignore=ignored) if path.is_dir() else shutil.copy(path, copy)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout
    return out


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (wheel,) = built.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the programs of a new environment that has the wheel and nothing else."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment)
    python = environment / SCRIPTS / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python), "install", "-qq"]
    subprocess.run([*pip, "--no-deps", "--no-index", str(wheel)], check=True)
    return environment / SCRIPTS


def files_of_the_program() -> set[str]:
    """What a wheel holds of the clone."""
    places = {"estimator": ROOT / "estimator", "estimator/dbc": ROOT / "dbc"}
    return {
        f"{name}/{path.relative_to(folder).as_posix()}"
        for name, folder in places.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_every_file_that_they_read(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert {name for name in names if name.startswith("estimator/")} == files_of_the_program()
    assert {Path(name).parts[0] for name in names} == {"estimator", f"roadload-{__version__}.dist-info"}
    assert wheel.stat().st_size < MAX_BYTES


@pytest.mark.slow
def test_the_metadata_are_valid_and_complete(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read(f"roadload-{__version__}.dist-info/METADATA")
    metadata = Metadata.from_email(text, validate=True)
    assert (metadata.name, str(metadata.version), metadata.license_expression) == ("roadload", __version__, "MIT")
    assert metadata.description == (ROOT / "README.md").read_text(encoding="utf-8")
    assert metadata.description_content_type == "text/markdown"
    assert set(metadata.provides_extra or []) == set(PROJECT["project"]["optional-dependencies"])


@pytest.mark.slow
def test_the_source_holds_what_the_wheel_is_built_from_and_the_pages(built: Path) -> None:
    (source,) = built.glob("*.tar.gz")
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    modules = {name for name in files_of_the_program() if not name.startswith("estimator/dbc/")}
    assert names >= {*modules, "dbc/j1939.dbc", "LICENSE", "CITATION.cff", "constraints.txt", *PAGES}
    assert not [name for name in names if "__pycache__" in name]


@pytest.mark.slow
def test_the_wheel_runs_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    """Its libraries are those of the environment of the tests; the program is that of the wheel."""
    import numpy

    libraries = str(Path(numpy.__file__).parents[1])
    (home := tmp_path / "home").mkdir()
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": libraries, "HOME": str(home)}

    def run(program: str, *arguments: str) -> str:
        command = [str(installed / program), *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    code = "import estimator; print(estimator.__file__)"
    assert Path(run("python", "-c", code).strip()).is_relative_to(installed.parent)
    assert run("roadload", "--version") == f"roadload {__version__}\n"
    assert "OUT.blf" in run("roadload", "demo", "--help")
    run("roadload", "simulate", "drive.blf", "--minutes", "6")
    assert "mass" in run("roadload", "estimate", "drive.blf")
    assert "OBD2.VehicleSpeed" in run("roadload", "check", "--config", "obd2")
    run("roadload", "diagnose", "drive.blf", "--report", "page.html")
    assert list(home.iterdir()) == []


def test_the_version_has_one_home() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == __version__
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    released = re.findall(r"^## (\S+) - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert released[0] == (__version__, str(citation["date-released"]))


def test_extras_that_messages_name_exist() -> None:
    modules = [path.read_text(encoding="utf-8") for path in (ROOT / "estimator").rglob("*.py")]
    named = {extra for text in modules for extra in re.findall(r"how_to_install\(['\"](\w+)['\"]\)", text)}
    assert named == set(PROJECT["project"]["optional-dependencies"]) - {"dev", "docs"}
    assert not [text for text in modules if "pip install 'roadload" in text]


@pytest.mark.parametrize("page", PAGES)
def test_links_of_the_pages_beside_the_manual_lead_somewhere(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    assert [link for link in links if not ((ROOT / page).parent / link).exists()] == []


def test_a_change_becomes_a_line_of_the_next_version(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "CHANGELOG.md"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / "changes", tmp_path / "changes")
    (tmp_path / "changes" / "+slope.added.md").write_text("The slope is told.\n", encoding="utf-8")
    command = [sys.executable, "-m", "towncrier", "build", "--yes", "--version", "9.0.0", "--date", "2030-01-01"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    page = (tmp_path / "CHANGELOG.md").read_text(encoding="utf-8")
    new, old = page.index("## 9.0.0 - 2030-01-01"), page.index(f"## {__version__}")
    assert new < page.index("- The slope is told.", new) < old
    assert [path.name for path in (tmp_path / "changes").iterdir()] == ["README.md"]


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_forms_and_workflows_are_whole(path: Path) -> None:
    found = yaml.safe_load(path.read_text(encoding="utf-8"))
    if path.parent.name == "workflows":
        matrix = found["jobs"]["check"]["strategy"]["matrix"]
        versions = {name.rpartition(" :: ")[2] for name in PROJECT["project"]["classifiers"] if ":: 3." in name}
        assert set(matrix["python"]) == versions
        assert {system.partition("-")[0] for system in matrix["os"]} == {"ubuntu", "macos", "windows"}
        for line in re.findall(r"run: roadload (.*)", path.read_text(encoding="utf-8")):
            assert _parsed(line.split()).command == line.split()[0]
    elif path.name != "config.yml":
        assert found.keys() == {"name", "description", "labels", "body"}
        identities = [element["id"] for element in found["body"]]
        assert len(set(identities)) == len(identities)
