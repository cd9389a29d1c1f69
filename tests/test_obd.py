"""Cars that answer the OBD-II requests of a logger: recognised, read by the shipped configuration, bound to one ECU."""

from pathlib import Path

import can
import msgspec
import pytest

from estimator import config
from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.commands.main import main
from estimator.daemon.reception.filters import input_filters
from estimator.errors import ConfigError

# A request and its answer for speed, engine speed, torque and reference torque.
ANSWERS = """\
(1760000000.000000) can0 7DF#02010D5555555555
(1760000000.020000) can0 7E8#03410D3CAAAAAAAA
(1760000000.100000) can0 7DF#02010C5555555555
(1760000000.120000) can0 7E8#04410C166CAAAAAA
(1760000000.200000) can0 7DF#0201625555555555
(1760000000.220000) can0 7E8#0341629BAAAAAAAA
(1760000000.300000) can0 7DF#0201635555555555
(1760000000.320000) can0 7E8#0441630190AAAAAA
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "answers.log"
    path.write_text(ANSWERS)
    return path


def read(rows: list[tuple[int, str]], **addresses: int) -> dict[str, list[float]]:
    """Values by role of frames a tenth of a second apart."""
    settings = config.load("obd2")
    settings = config.replace(settings, bus=msgspec.structs.replace(settings.bus, source_addresses=addresses))
    decoder = Decoder(bind(settings, load_database(settings.bus.dbc)), settings.bus)
    frames = Frames.from_messages(
        can.Message(timestamp=0.1 * k, arbitration_id=ident, is_extended_id=ident > 0x7FF, data=bytes.fromhex(data))
        for k, (ident, data) in enumerate(rows)
    )
    return {role.value: series.value.tolist() for role, (series,) in decoder.decode(frames).items() if len(series.t)}


@pytest.mark.parametrize("ident", [0x7E8, 0x7EB, 0x18DAF110, 0x18DAF1FE])
def test_the_shipped_configuration_reads_answers_of_any_ecu(ident: int) -> None:
    lines = [line.split()[2] for line in ANSWERS.splitlines()]
    found = read([(ident, line[4:]) for line in lines if line.startswith("7E8")])
    assert found["speed"] == pytest.approx([60 / 3.6])
    assert found["engine_speed"] == pytest.approx([1435 * 3.14159265 / 30])
    assert found["torque_fraction"] == pytest.approx([0.30])
    assert found["reference_torque"] == [400.0]


def test_short_answers_other_services_refusals_and_segments_are_told_apart() -> None:
    rows = [
        (0x7E8, "03410D3C"),  # not filled up to 8 bytes
        (0x7E8, "03420D50AAAAAAAA"),  # a frozen frame of a fault, service 2
        (0x7E8, "037F0112AAAAAAAA"),
        (0x7E8, "1014410D50AAAAAA"),  # the beginning of a longer answer
        (0x7E8, "21410D50AAAAAAAA"),  # a part of one
        (0x7E0, "03410D50AAAAAAAA"),
        (0x18DB33F1, "03410D50AAAAAAAA"),
    ]
    assert read(rows) == {"speed": pytest.approx([60 / 3.6])}


def test_each_signal_is_taken_from_one_ecu() -> None:
    """The gearbox at 7E9 answers too, with a speed of its own rounding."""
    rows = [(0x7E8 + k % 2, f"03410D{60 + k % 2:02X}AAAAAAAA") for k in range(41)]
    assert set(read(rows)["speed"]) == {60 / 3.6}
    assert read(rows, OBD2=0xE9)["speed"] == pytest.approx([61 / 3.6] * 20)


@pytest.mark.parametrize("command", ["estimate", "inspect"])
def test_a_log_of_answers_is_recognised_and_the_advice_works(
    log: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(log)]) == (2 if command == "estimate" else 0)
    said = capsys.readouterr()
    text = " ".join((said.err or said.out).split())
    assert "4 frames are answers to OBD-II requests: give --config obd2" in text
    main([command, str(log), "--config", "obd2"])
    said = capsys.readouterr()
    text = " ".join((said.err or said.out).split())
    assert "missing inputs" not in text
    if command == "inspect":
        assert "OBD2.VehicleSpeed 0xE8 0.0 % 16.67" in text


def test_what_the_logger_did_not_ask_for_is_named_by_its_pid(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.write_text("".join(ANSWERS.splitlines(keepends=True)[:4]))
    assert main(["estimate", str(log), "--config", "obd2"]) == 2
    assert "the logger has to ask for PID 0x62, 0x63; found: OBD2.EngineSpeed" in capsys.readouterr().err


def test_shipped_configurations_have_names_and_files_come_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert config.load("obd2").bus.match == "obd"
    with pytest.raises(ConfigError, match=r"^obd3: No such file or directory; .* bmw_i3, bmw_i3_battery, obd2$"):
        config.load("obd3")
    with pytest.raises(ConfigError, match=r"^obd2\.toml: No such file or directory$"):
        config.load("obd2.toml")
    (tmp_path / "obd2").write_text('effects = ["grade"]')
    assert config.load("obd2").effects == ["grade"]


def test_the_kernel_lets_all_answers_through() -> None:
    settings = config.load("obd2")
    filters = input_filters(bind(settings, load_database(settings.bus.dbc)))

    def passes(ident: int) -> bool:
        is_extended = ident > 0x7FF
        return any((ident ^ f["can_id"]) & f["can_mask"] == 0 and f["extended"] == is_extended for f in filters)  # type: ignore[typeddict-item]

    assert all(map(passes, (0x7E8, 0x7EF, 0x18DAF100, 0x18DAF1FF)))
    assert not any(map(passes, (0x7E7, 0x7F0, 0x7DF, 0x18DB33F1, 0x18DA10F1)))


def test_a_logger_may_change_its_rate_on_the_move() -> None:
    """Every 0.56 s and every 0.28 s in turn, each for a minute: no rate is the sender's own."""
    settings = config.load("obd2")
    decoder = Decoder(bind(settings, load_database(settings.bus.dbc)), settings.bus)
    t, count = 0.0, 0
    for block in range(60):
        rows = []
        while t < 5.0 * (block + 1):
            rows.append(can.Message(timestamp=t, arbitration_id=0x7E8, is_extended_id=False, data=b"\x03\x41\x0d\x3c"))
            t += 0.56 if int(t / 60) % 2 else 0.14
        count += len(rows)
        decoder.decode(Frames.from_messages(rows), 5.0 * (block + 1))
    assert not decoder.contested
    assert decoder.used == count
