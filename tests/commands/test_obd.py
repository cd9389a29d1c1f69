"""Cars that answer the OBD-II requests of a logger: recognised, read by the shipped configuration, bound to one ECU."""

from pathlib import Path

import can
import msgspec
import numpy as np
import pytest

from estimator import config
from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.can_io.obd2_encoder import EPOCH, frames_of
from estimator.commands.main import main
from estimator.daemon.reception.filters import input_filters
from estimator.errors import ConfigError
from estimator.estimates import Estimate
from estimator.signals import Role, Series
from estimator.simulation.polling import polled
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck, draw_car
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import RowStream

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
        assert "OBD2.VehicleSpeed 0xE8 0.0 % 60 .. 60 km/h" in text


def test_what_the_logger_did_not_ask_for_is_named_by_its_pid(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.write_text("".join(ANSWERS.splitlines(keepends=True)[:4]))
    assert main(["estimate", str(log), "--config", "obd2"]) == 2
    assert "the logger has to ask for PID 0x62, 0x63; found: OBD2.EngineSpeed" in capsys.readouterr().err


def test_shipped_configurations_have_names_and_files_come_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert config.load("obd2").bus.match == "obd"
    with pytest.raises(ConfigError, match=r"^obd3: No such file or directory; .* shipped: obd2; roadload"):
        config.load("obd3")
    with pytest.raises(ConfigError, match=r"^obd2\.toml: No such file or directory; roadload init"):
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


def car(period: float, minutes: float = 15.0, seed: int = 3) -> tuple[Frames, Truck]:
    """A drive on level roads, polled."""
    rng = np.random.default_rng(seed)
    truck = draw_car(rng)
    recording = record(truck, generate_route("mixed", 2000.0 * minutes, rng), 60.0 * minutes, rng)
    return frames_of(polled(recording.signals, period, rng)), truck


def estimate(frames: Frames) -> Estimate:
    settings = config.load("obd2")
    once = msgspec.structs.replace(settings.gate, interval_s=3600.0)  # one conclusion, at the end
    pipeline, final = Pipeline(config.replace(settings, gate=once)), None
    for item in pipeline.traffic.feed_all([frames]):
        for final in pipeline.take(item):  # noqa: B007
            pass
    for final in pipeline.finish():  # noqa: B007
        pass
    assert final is not None
    return final


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.25, 1.0])
def test_the_mass_of_a_polled_car(period: float) -> None:
    frames, truck = car(period)
    found = estimate(frames)
    assert found.mass is not None, found.reason
    assert abs(found.mass.mean - truck.mass) < 3 * found.mass.sd
    assert abs(found.mass.mean / truck.mass - 1) < 0.05
    assert found.mass.sd < 0.1 * truck.mass


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.2, 0.7, 1.9])
def test_rows_of_polled_signals_are_the_same_live_and_at_once(period: float) -> None:
    frames, _ = car(period, 3.0)

    def rows(size: int) -> tuple[np.ndarray, np.ndarray]:
        stream, parts = RowStream(config.load("obd2")), []
        for item in stream.feed_all(frames[k : k + size] for k in range(0, len(frames), size)):
            parts += list(getattr(item, "rows", ()))
        return np.concatenate([part.speed for part in parts]), np.concatenate([part.power for part in parts])

    for live, at_once in zip(rows(7), rows(len(frames)), strict=True):
        np.testing.assert_array_equal(live, at_once)
        assert np.isfinite(live).mean() > 0.9


def test_torque_and_engine_speed_count_at_their_own_times() -> None:
    """An engine that speeds up steadily: its speed is not that of the answer before the torque's."""
    t = np.arange(0.0, 60.0, 1.0)
    signals = {
        Role.SPEED: Series(t + 0.1, np.full(60, 20.0)),
        Role.ENGINE_SPEED: Series(t + 0.2, 100.0 + 2.0 * (t + 0.2)),
        Role.TORQUE_FRACTION: Series(t + 0.9, np.full(60, 0.5)),
        Role.REFERENCE_TORQUE: Series(t + 0.95, np.full(60, 400.0)),
    }
    stream = RowStream(config.load("obd2"))
    parts = [rows for item in stream.feed_all([frames_of(signals)]) for rows in getattr(item, "rows", ())]
    power = np.concatenate([rows.power for rows in parts])
    at = np.concatenate([rows.t for rows in parts]) - EPOCH
    known = np.isfinite(power)
    assert known.sum() > 500
    np.testing.assert_allclose(power[known], 200.0 * (100.0 + 2.0 * at[known]), rtol=1e-3)


def test_a_lone_reading_far_from_its_neighbours_in_time_is_kept() -> None:
    t = np.arange(0.0, 60.0, 1.0)
    torque = np.where(np.arange(60) % 10 == 5, 0.8, 0.2)
    signals = {
        Role.SPEED: Series(t, np.full(60, 20.0)),
        Role.ENGINE_SPEED: Series(t, np.full(60, 200.0)),
        Role.TORQUE_FRACTION: Series(t, torque),
        Role.REFERENCE_TORQUE: Series(t, np.full(60, 400.0)),
    }
    stream = RowStream(config.load("obd2"))
    parts = [rows for item in stream.feed_all([frames_of(signals)]) for rows in getattr(item, "rows", ())]
    assert np.nanmax(np.concatenate([rows.power for rows in parts])) > 0.75 * 400.0 * 200.0
