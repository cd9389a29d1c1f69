"""Every example of the README is run, and prints what the README shows."""

import re
import shlex
import time
import tomllib
from pathlib import Path

import can
import pytest
from played_bus import PlayedBus
from printed_text import assert_same
from simulated_logs import TRUCK, drive

from estimator.can_io.j1939_encoder import frames_of
from estimator.commands.main import main
from estimator.config import Config, from_dict, load
from estimator.errors import RoadloadError
from estimator.roles import Role

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "README.md").read_text(encoding="utf-8")
SAMPLED = 0.002  # relative difference of sampled numbers between machines
ON_FILES = ("inspect", "estimate", "replay", "diagnose", "simulate")
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


@pytest.fixture(autouse=True)
def tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))


def block(language: str, word: str) -> str:
    """The block of the page in ``language`` that holds ``word``."""
    return next(text for text in re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL) if word in text)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["demo", "hills"])
def test_outputs_are_those_of_the_program(name: str, tmp_path: Path) -> None:
    import readme

    assert readme.blocks(PAGE).keys() == readme.EXAMPLES.keys() == {"demo", "hills"}
    assert_same(readme.EXAMPLES[name](tmp_path), readme.blocks(PAGE)[name], rtol=SAMPLED)


@pytest.mark.slow
def test_commands_on_logs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those on the demonstration's drive, on a short one; that in hills is run with its output."""
    import readme

    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    assert main(["simulate", "out/drive.blf", "--minutes", "8", "--seed", "1"]) == 0
    written = set()
    for words in readme.commands(PAGE):
        if words[0] in ON_FILES and "out/hills.blf" not in words:
            assert main(words) == 0, words
            written |= {word for word in words if word.startswith("out/")}
    assert {path for path in written if Path(path).stat().st_size > 0} == written
    assert capsys.readouterr().err == ""


def test_commands_on_a_bus_or_a_fleet_are_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import readme

    from estimator.commands import main as program

    monkeypatch.chdir(tmp_path)
    calls = [words for words in readme.commands(PAGE) if words[0] not in ON_FILES]
    assert {words[0] for words in calls} >= {*ON_A_BUS}
    for words in calls:
        assert program._parser(words).parse_args(words).command == words[0]
    service = next(line for line in PAGE.splitlines() if line.endswith("# all settings in force"))
    words = shlex.split(service, comments=True)[1:]
    at = words.index("/etc/roadload/roadload.toml")
    words[at] = str(ROOT / "tools" / "systemd" / "roadload.toml")
    assert main(words) == 0
    assert isinstance(from_dict(tomllib.loads(capsys.readouterr().out)), Config)


def test_files_that_the_page_names_exist() -> None:
    links = {link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", PAGE)}
    named = set(re.findall(r"`((?:tools|docs|dbc|estimator|examples)/[\w./-]+\w)`", PAGE))
    assert {path for path in links | named if path and not (ROOT / path).exists()} == set()


def test_headings_that_the_page_links_to_exist() -> None:
    headings = {re.sub(r"[^\w -]", "", line.lstrip("# ").lower()).replace(" ", "-") for line in PAGE.splitlines()}
    assert {anchor for anchor in re.findall(r"\]\(#([^)]+)\)", PAGE) if anchor not in headings} == set()


def test_settings_that_the_page_names_exist() -> None:
    defaults = {name: getattr(Config(), name) for name in Config.__struct_fields__}
    named = re.findall(r"`(\w+)\.(\w+)(?: = ([^`]+))?`", PAGE)
    settings = [(table, key, value) for table, key, value in named if hasattr(defaults.get(table), "__struct_fields__")]
    assert len(settings) >= 8
    for table, key, value in settings:
        assert key in defaults[table].__struct_fields__, f"{table}.{key}"
        if value:
            from_dict({table: tomllib.loads(f"{key} = {value}")})


def test_the_configuration_of_a_vehicle_loads(tmp_path: Path) -> None:
    (tmp_path / "truck.toml").write_text(block("toml", "my_truck.dbc"))
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
    recording = drive("mixed", 12, 4)
    buses: list[PlayedBus] = []

    def open_bus(interface: str, channel: str) -> PlayedBus:
        assert (interface, channel) == ("socketcan", "can0")
        buses.append(PlayedBus(frames_of(recording.signals).messages()))
        return buses[-1]

    monkeypatch.chdir(tmp_path)
    Path("truck.toml").touch()
    monkeypatch.setattr(can, "Bus", open_bus)
    monkeypatch.setattr(time, "sleep", lambda duration: buses[0].has_failed.wait())
    code = compile(block("python", "import can"), "README.md", "exec")
    with pytest.raises(RoadloadError, match="Network is down"):
        exec(code, {"__name__": "__main__"})
    mass = re.search(r"mass=Marginal\(mean=([0-9.]+)", capsys.readouterr().out)
    assert mass is not None
    assert float(mass.group(1)) == pytest.approx(TRUCK.mass, rel=0.03)
