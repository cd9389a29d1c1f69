"""What the publisher says: layout, saturation, withheld values; all decoded with the shipped DBC."""

import logging
import math
from dataclasses import replace

import can
import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_estimates import made_estimate

from estimator.can_io.counter_crc import crc8, verify
from estimator.can_io.publisher import Publisher, output_database
from estimator.config import from_dict
from estimator.errors import ConfigError
from estimator.estimates import Convergence, Coverage, Estimate, Marginal, Slope, Status
from estimator.settings import Publish

PUBLISHED = {"mean": "Mean", "q05": "Q05", "q95": "Q95", "sd": "Deviation"}

marginals = st.builds(Marginal, mean=st.floats(), sd=st.floats(), q05=st.floats(), q50=st.floats(), q95=st.floats())
estimates = st.builds(
    Estimate,
    t=st.floats(-1e9, 2e9),
    status=st.sampled_from(Status),
    reason=st.just(""),
    coverage=st.builds(Coverage, st.integers(0, 500), st.integers(0, 400)),
    admitted=st.integers(0, 10**12),
    mass=st.none() | marginals,
    A=st.none() | marginals,
    C=st.none() | marginals,
    convergence=st.none()
    | st.builds(
        Convergence,
        r_hat=st.floats(),
        ess_bulk=st.floats(),
        acceptance=st.floats(),
        draws=st.just(9),
        chains=st.just(3),
    ),
)


def decoded(frames: list[can.Message]) -> dict[str, float | str]:
    """All signals of the frames by name, raw codes with a meaning as text."""
    result: dict[str, float | str] = {}
    for frame in frames:
        ident = frame.arbitration_id & 0x03FFFF00 | 6 << 26 | 0xFB
        for name, value in output_database().decode_message(ident, bytes(frame.data)).items():
            result[name] = value if isinstance(value, (int, float)) else str(value)
    return result


def signal(name: str) -> cantools.database.can.Signal:
    return next(s for m in output_database().messages for s in m.signals if s.name == name)


def assert_sent(name: str, sent: float | str, value: float) -> None:
    if math.isnan(value):
        assert sent == "not available"
        return
    layout = signal(name)
    clamped = min(max(value, layout.minimum), layout.maximum)
    assert sent == pytest.approx(clamped, abs=layout.scale * 0.5000001)


def test_database_loads_without_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    output_database.cache_clear()
    with caplog.at_level(logging.WARNING):
        messages = output_database().messages
    assert not caplog.records
    for message in messages:
        assert message.protocol == "j1939"
        assert message.length == 8
        assert all(s.comment for s in message.signals)
        for s in message.signals:
            if s.length == 16 and message.name not in ("DM1", "DM2"):  # J1939-71: valid up to 0xFAFF
                assert s.scaled_to_raw(s.maximum) == 0xFAFF
                assert s.choices is not None
                assert set(s.choices) == {0xFE00, 0xFFFF}


@given(estimates, st.floats(0, 7200))
def test_any_estimate_survives_the_wire(given_estimate: Estimate, age: float) -> None:
    t = given_estimate.t + age
    frames = Publisher(Publish(cvw=True)).poll(t, given_estimate)
    assert len(frames) == 7
    assert all(len(frame.data) == 8 and frame.timestamp == t for frame in frames)
    assert all(verify(frame) for frame in frames[:6])
    sent = decoded(frames)
    stale = t - given_estimate.t > 3600
    assert sent["EstimateStatus"] == ("stale" if stale else given_estimate.status.value)
    assert_sent("EstimateAge", sent["EstimateAge"], t - given_estimate.t)
    chains = given_estimate.convergence
    assert_sent("Coverage", sent["Coverage"], math.nan if stale else 100 * given_estimate.coverage.fraction)
    assert_sent("SampleCount", sent["SampleCount"], math.nan if stale else given_estimate.admitted)
    assert_sent("RHat", sent["RHat"], math.nan if stale or chains is None else chains.r_hat)
    for name, marginal in {"Mass": given_estimate.mass, "A": given_estimate.A, "C": given_estimate.C}.items():
        beyond = marginal and any(getattr(marginal, f) > signal(name + s).maximum for f, s in PUBLISHED.items())
        withheld = stale or (beyond and given_estimate.status is Status.ESTIMATED)
        for field, suffix in PUBLISHED.items():
            value = sent[name + suffix]
            if withheld or given_estimate.status is Status.UNESTIMATED:
                assert value == "not available"
            elif given_estimate.status is Status.INVALID:
                assert value == "error"
            else:
                assert_sent(name + suffix, value, getattr(marginal, field, math.nan))


def test_frame_bytes() -> None:
    """A frame written out by hand: 2 kg/bit little endian, counter 0, status 1, CRC."""
    mass = Publisher(Publish()).poll(0.0, made_estimate())[2]
    assert mass.arbitration_id == 0x18FF61FB
    assert mass.is_extended_id
    body = (13595).to_bytes(2, "little") + (13350).to_bytes(2, "little") + (13850).to_bytes(2, "little") + b"\x10"
    assert bytes(mass.data) == body + bytes([crc8(bytes.fromhex("FB61FF18") + body)])


def test_withheld_values_are_the_raw_codes_of_j1939() -> None:
    assert bytes(Publisher(Publish()).poll(0.0, None)[2].data[:6]) == b"\xff" * 6
    assert bytes(Publisher(Publish()).poll(0.0, made_estimate(status=Status.INVALID))[2].data[:6]) == b"\x00\xfe" * 3


def test_without_an_estimate_nothing_is_available() -> None:
    sent = decoded(Publisher(Publish(cvw=True)).poll(5.0, None))
    assert sent.pop("EstimateStatus") == "unestimated"
    assert sent.pop("AliveCounter") == 0
    sent.pop("Checksum")
    assert set(sent.values()) == {"not available"}


def test_cvw_is_off_by_default_and_carries_the_mass() -> None:
    assert all(
        frame.arbitration_id >> 8 & 0xFFFF != 0xFE70 for frame in Publisher(Publish()).poll(0.0, made_estimate())
    )
    frame = Publisher(Publish(cvw=True)).poll(0.0, made_estimate())[-1]
    assert frame.arbitration_id == 0x18FE70FB
    assert bytes(frame.data) == b"\xff\xff" + (2719).to_bytes(2, "little") + b"\xff" * 4


@given(st.integers(0, 253), st.integers(0, 7))
def test_source_address_and_priority_are_in_the_id(address: int, priority: int) -> None:
    publisher = Publisher(Publish(source_address=address, priority=priority))
    for frame in publisher.poll(0.0, made_estimate()):
        unpacked = cantools.j1939.frame_id_unpack(frame.arbitration_id)
        assert (unpacked.priority, unpacked.pdu_format, unpacked.source_address) == (priority, 0xFF, address)
        assert verify(frame)
    publisher.source_address = 0x80
    assert all(verify(f) and f.arbitration_id & 0xFF == 0x80 for f in publisher.poll(10.0, made_estimate()))


@pytest.mark.parametrize(
    "wrong",
    [
        {"source_address": 254},
        {"priority": 8},
        {"status_period_s": 0},
        {"value_period_s": math.nan},
        {"stale_after_s": -1},
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"publish.{next(iter(wrong))}"):
        from_dict({"publish": wrong})


def test_crc_check_value() -> None:
    assert crc8(b"123456789") == 0x4B


@given(estimates)
def test_checksum_detects_every_flipped_bit_and_a_foreign_id(given_estimate: Estimate) -> None:
    frame = Publisher(Publish()).poll(given_estimate.t, given_estimate)[1]
    data, ident = bytes(frame.data), frame.arbitration_id
    for bit in range(64):
        damaged = (int.from_bytes(data, "big") ^ 1 << bit).to_bytes(8, "big")
        assert not verify(can.Message(arbitration_id=ident, data=damaged))
    for bit in range(29):
        assert not verify(can.Message(arbitration_id=ident ^ 1 << bit, data=data))
    assert not verify(can.Message(arbitration_id=ident, data=data[:7]))
    assert not verify(can.Message(arbitration_id=ident, is_remote_frame=True, dlc=8))


def test_a_parameter_beyond_its_signal_is_not_sent_as_the_limit() -> None:
    heavy = Marginal(mean=140e3, sd=1e3, q05=138e3, q50=140e3, q95=142e3)
    usual = Marginal(mean=1700.0, sd=20.0, q05=1660.0, q50=1700.0, q95=1740.0)
    frames = Publisher(Publish(cvw=True)).poll(0.0, replace(made_estimate(), mass=heavy, A=usual))
    sent = decoded(frames)
    assert sent["MassMean"] == sent["MassQ95"] == sent["GrossCombinationVehicleWeight"] == "not available"
    assert sent["AMean"] == 1700.0
    (mass,) = [f for f in frames if f.arbitration_id >> 8 & 0xFFFF == 0xFF61]
    assert bytes(mass.data)[6] >> 4 == 0  # unestimated


slopes = st.builds(
    Slope,
    t=st.just(0.0),
    sine=st.floats(-0.5, 0.5),
    sd=st.floats(0, 0.1),
    height=st.just(math.nan) | st.floats(-4000, 4000),
    height_sd=st.floats(0, 500),
)


@given(slopes)
def test_any_slope_survives_the_wire(slope: Slope) -> None:
    """The grade is the tangent of the slope; what the signals cannot say is not sent as their limit."""
    road = Publisher(Publish()).poll(0.0, made_estimate(), slope)[1]
    assert road.arbitration_id == 0x18FF65FB
    assert verify(road)
    sent = decoded([road])
    angle = math.asin(slope.sine)
    sd = 100 * slope.sd / math.cos(angle) ** 3
    if sd > 5:
        assert sent["EstimateStatus"] == "unestimated"
        assert {value for name, value in sent.items() if name.startswith("Road")} == {"not available"}
        return
    assert sent["EstimateStatus"] == "estimated"
    assert_sent("RoadGrade", sent["RoadGrade"], 100 * math.tan(angle))
    assert_sent("RoadGradeDeviation", sent["RoadGradeDeviation"], sd)
    is_lost = math.isnan(slope.height) or abs(slope.height) > 3212.75 or slope.height_sd > 250
    assert_sent("RoadHeight", sent["RoadHeight"], math.nan if is_lost else slope.height)
    assert_sent("RoadHeightDeviation", sent["RoadHeightDeviation"], math.nan if is_lost else slope.height_sd)


@pytest.mark.parametrize(
    ("status", "age", "shown", "value"),
    [
        (Status.UNESTIMATED, 0.0, "unestimated", "not available"),
        (Status.INVALID, 0.0, "invalid", "error"),
        (Status.ESTIMATED, 4000.0, "stale", "not available"),
    ],
)
def test_without_a_present_estimate_no_slope_is_sent(status: Status, age: float, shown: str, value: str) -> None:
    slope = Slope(t=age, sine=0.02, sd=0.001, height=3.0, height_sd=1.0)
    sent = decoded([Publisher(Publish()).poll(age, made_estimate(0.0, status), slope)[1]])
    assert sent["EstimateStatus"] == shown
    assert sent["RoadGrade"] == sent["RoadGradeDeviation"] == sent["RoadHeight"] == value


def test_on_request_the_slope_is_that_of_the_newest_turn() -> None:
    slope = Slope(t=0.0, sine=0.03, sd=0.001, height=math.nan, height_sd=math.nan)
    frame = Publisher(Publish()).answer(0xFF65, 0.0, made_estimate(), slope)
    assert frame is not None
    assert decoded([frame])["RoadGrade"] == pytest.approx(3.0, abs=0.006)
