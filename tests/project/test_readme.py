"""Every example of the README and of the manual is run or understood, and prints what the README shows."""

import re
import shlex
import time
import tomllib
from pathlib import Path

import can
import numpy as np
import pytest
from played_bus import PlayedBus
from printed_text import assert_same
from project_paths import ROOT
from simulated_logs import TRUCK, drive

from estimator import read
from estimator.can_io.j1939_encoder import frames_of
from estimator.commands.main import main
from estimator.config import Config, from_dict, load
from estimator.errors import RoadloadError
from estimator.roles import Role
from estimator.samples import Rows
from estimator.streaming.replay import estimate_logs

PATHS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in PATHS}
PAGE = PAGES["README.md"]
RUN = ["README.md", "docs/logs.md", "docs/diagnosis.md"]  # pages whose commands on logs are run
SUFFIXES = ("npy", "parquet", "py")  # of files that are called as a table of the configuration is
ANSWERS = (("load", "probability"), ("transmit", "trouble_codes"))  # keys of JSON answers
MAX_LINES, MAX_WORDS = 150, 1_500
MAX_PICTURE = 40_000  # bytes
SAMPLED = 0.002  # relative difference of sampled numbers between machines
WRITING = ("simulate", "init")  # what other commands read
ON_FILES = ("inspect", "estimate", "replay", "diagnose")
MINUTES = "3"  # of drives that an example simulates
ON_A_BUS = ("run", "check", "status")
DBC = """\
BU_: X
BO_ 256 MOTION: 8 X
 SG_ VehicleSpeed : 0|16@1+ (0.01,0) [0|0] "km/h" X
BO_ 257 MOTOR: 8 X
 SG_ Torque : 0|16@1- (1,0) [0|0] "Nm" X
 SG_ Speed : 16|16@1+ (0.125,0) [0|0] "rpm" X
BO_ 258 BRAKE: 8 X
 SG_ Switch : 0|1@1+ (1,0) [0|0] "" X
BO_ 2364539904 EEC1: 8 X
 SG_ EngSpeed : 24|16@1+ (0.125,0) [0|0] "rpm" X
"""


def block(page: str, language: str, word: str) -> str:
    """The block of the page in ``language`` that holds ``word``."""
    return next(text for text in re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL) if word in text)


def anchors(text: str) -> set[str]:
    """What a link to a heading of ``text`` may name."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def table_of(log: Path) -> dict[str, np.ndarray]:
    """Times, speed and power of a log."""
    rows = Rows.concatenate(*read(log).pieces)
    return {"t": rows.t - rows.t[0], "v": 3.6 * rows.speed, "P": rows.power / 1e3}


def test_the_front_page_is_short() -> None:
    assert len(PAGE.splitlines()) <= MAX_LINES
    assert len(PAGE.split()) <= MAX_WORDS


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("demo", marks=pytest.mark.nightly), "hills"])
def test_outputs_are_those_of_the_program(name: str, tmp_path: Path) -> None:
    import readme

    assert readme.blocks(PAGE).keys() == readme.EXAMPLES.keys() == {"demo", "hills"}
    assert_same(readme.EXAMPLES[name](tmp_path), readme.blocks(PAGE)[name], rtol=SAMPLED)


@pytest.mark.slow
def test_the_first_table_is_that_of_the_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the virtual bus, over which the answer is the same (test_replay)."""
    import readme

    from estimator.commands import demo

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo, "replay", lambda logs, config, progress, output: estimate_logs(logs, config, progress))
    assert main(["demo"]) == 0
    printed = capsys.readouterr().out
    assert_same(readme.first_table(printed), readme.blocks(PAGE)["demo"], rtol=SAMPLED)


def test_pictures_say_what_the_outputs_say() -> None:
    """The numbers in them are those of the blocks, which the test above compares with the program."""
    import readme

    texts = {}
    for name in re.findall(r"\]\(docs/pictures/(\w+)\.svg\)", PAGE):
        content = (ROOT / "docs" / "pictures" / f"{name}.svg").read_text(encoding="utf-8")
        assert len(content.encode()) < MAX_PICTURE
        texts[name] = " ".join(re.findall(r"<text[^>]*>([^<]*)", content))
    assert texts.keys() == {"mass", "gap"}
    blocks = readme.blocks(PAGE)
    mean, interval, truth = re.findall(r"mass +([\d,]+ kg) +([\d,]+ \.\. [\d,]+) .* ([\d,]+)", blocks["demo"])[0]
    assert f"mass {mean} ({interval})" in texts["mass"]
    assert f"truth {truth} kg" in texts["mass"]
    before, effect, after = re.findall(r"plain model ([\d.]+ kW), \+ (\w+) ([\d.]+ kW)", blocks["hills"])[0]
    assert f"plain model: {before}" in texts["gap"]
    assert f"with {effect}: {after}" in texts["gap"]


@pytest.mark.slow
def test_commands_on_logs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those on the demonstration's drive and on others, on short ones; that in hills is run with its output."""
    import readme

    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    Path("examples").symlink_to(ROOT / "examples")
    assert main(["simulate", "out/drive.blf", "--minutes", "6", "--seed", "1"]) == 0
    data = table_of(Path("out/drive.blf"))
    shown = {tuple(words) for page in RUN for words in readme.commands(PAGES[page]) if "out/hills.blf" not in words}
    written = set()
    for words in sorted(shown, key=lambda words: words[0] not in WRITING):
        if words[0] in (*ON_FILES, *WRITING):
            is_length = (False, *(word == "--minutes" for word in words))
            assert main([MINUTES if minutes else word for word, minutes in zip(words, is_length, strict=False)]) == 0, (
                words
            )
            written |= {word for word in words if word.startswith("out/")}
    assert {path for path in written if Path(path).stat().st_size > 0} == written
    (note,) = capsys.readouterr().err.splitlines()
    assert note.startswith("note: out/van.toml is written")
    exec(block("README.md", "python", "from_table"))
    exec(block("docs/tables.md", "python", "from_table"), {"data": data})


def test_commands_on_a_bus_or_a_fleet_are_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import readme

    from estimator.commands import main as program

    monkeypatch.chdir(tmp_path)
    calls = [words for page in PAGES.values() for words in readme.commands(page)]
    assert {words[0] for words in calls} >= {*ON_A_BUS, *ON_FILES, *WRITING, "fleet", "watch"}
    for words in calls:
        assert program._parsed(words).command == words[0]
    service = next(line for line in PAGES["docs/gateway.md"].splitlines() if line.endswith("# all settings in force"))
    words = shlex.split(service, comments=True)[1:]
    at = words.index("/etc/roadload/roadload.toml")
    words[at] = str(ROOT / "deploy" / "systemd" / "roadload.toml")
    assert main(words) == 0
    assert isinstance(from_dict(tomllib.loads(capsys.readouterr().out)), Config)


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    """To a file of the project, and to a heading that is on the page."""
    for link in re.findall(r"\]\(([^)\s]+)\)", PAGES[name]):
        if not link.startswith(("http://", "https://")):
            place, _, anchor = link.partition("#")
            target = (ROOT / name).parent / place if place else ROOT / name
            assert target.exists(), link
            assert not anchor or anchor in anchors(target.read_text(encoding="utf-8")), link


@pytest.mark.parametrize("name", PAGES)
def test_files_that_a_page_names_exist(name: str) -> None:
    named = set(re.findall(r"`((?:tools|docs|dbc|estimator|examples)/[\w./-]+\w)`", PAGES[name]))
    assert {path for path in named if not (ROOT / path).exists()} == set()


def test_the_index_names_every_page() -> None:
    linked = set(re.findall(r"\]\(([\w/]+\.md)\)", PAGES["docs/README.md"]))
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in PATHS[1:]} - {"README.md"}
    assert linked == pages


def test_settings_that_the_pages_name_exist() -> None:
    defaults = {name: getattr(Config(), name) for name in Config.__struct_fields__}
    named = re.findall(r"`(\w+)\.(\w+)(?: = ([^`]+))?`", "\n".join(PAGES.values()))
    tables = {table for table, value in defaults.items() if hasattr(value, "__struct_fields__")}
    settings = [
        found for found in named if found[0] in tables and found[1] not in SUFFIXES and found[:2] not in ANSWERS
    ]
    assert len(settings) >= 20
    for table, key, value in settings:
        assert key in defaults[table].__struct_fields__, f"{table}.{key}"
        if value:
            from_dict({table: tomllib.loads(f"{key} = {value}")})


def test_the_configuration_of_a_vehicle_loads(tmp_path: Path) -> None:
    (tmp_path / "truck.toml").write_text(block("docs/configuration.md", "toml", "my_truck.dbc"))
    (tmp_path / "my_truck.dbc").write_text(DBC)
    found = load(tmp_path / "truck.toml")
    assert found.binding[Role.ENGINE_TORQUE] == "MOTOR.Torque"
    assert set(found.binding) == {Role.SPEED, Role.ENGINE_TORQUE, Role.ENGINE_SPEED, Role.BRAKE_SWITCH}
    assert found.bus.source_addresses == {"EEC1": 0}


@pytest.mark.slow
def test_the_listener_estimates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a drive of a plain J1939 truck instead of can0."""
    recording = drive("mixed", 8, 4)
    buses: list[PlayedBus] = []

    def open_bus(interface: str, channel: str) -> PlayedBus:
        assert (interface, channel) == ("socketcan", "can0")
        buses.append(PlayedBus(frames_of(recording.signals).messages()))
        return buses[-1]

    monkeypatch.chdir(tmp_path)
    Path("truck.toml").touch()
    monkeypatch.setattr(can, "Bus", open_bus)
    monkeypatch.setattr(time, "sleep", lambda duration: buses[0].has_failed.wait())
    code = compile(block("docs/gateway.md", "python", "import can"), "gateway.md", "exec")
    with pytest.raises(RoadloadError, match="Network is down"):
        exec(code, {"__name__": "__main__"})
    mass = re.search(r"mass=Marginal\(mean=([0-9.]+)", capsys.readouterr().out)
    assert mass is not None
    assert float(mass.group(1)) == pytest.approx(TRUCK.mass, rel=0.03)
