"""The machine wakes up: what the daemon says within two seconds is valid, with its true age, or "not available"."""

import can
import pytest
from daemon_bench import EPOCH, Bench, frame
from made_estimates import MARGINAL, made_estimate

from estimator import config
from estimator.can_io.publisher import output_database
from estimator.daemon.reception import uptime
from estimator.daemon.service.worker import Knowledge

TRANSMIT = config.from_dict({"transmit": {"enabled": True}})
WITHIN = 2.0  # s
LAYOUTS = {message.frame_id >> 8 & 0x3FFFF: message for message in output_database().messages}


def turn(bench: Bench, seconds: float, *messages: can.Message) -> None:
    """Traffic, with an estimator that concludes nothing new."""
    for _ in range(round(seconds / 0.1)):
        bench.now += 0.1
        bench.put(frame(0x18FEF100), *messages)
        bench.link.step(0)
        bench.daemon.turn()


def said(messages: list[can.Message], group: str) -> list[dict[str, object]]:
    """Contents of a group of ours, in order."""
    found = [m for m in messages if getattr(LAYOUTS.get(m.arbitration_id >> 8 & 0x3FFFF), "name", "") == group]
    return [LAYOUTS[m.arbitration_id >> 8 & 0x3FFFF].decode(bytes(m.data)) for m in found]  # type: ignore[misc]


@pytest.mark.slow
@pytest.mark.parametrize("leaves_frames", [False, True])
@pytest.mark.parametrize(
    ("asleep", "status"),
    [(10.0, "estimated"), (250.0, "estimated"), (600.0, "unestimated"), (7200.0, "stale"), (3 * 86400.0, "stale")],
)
def test_the_broadcast_after_waking_up_is_valid_or_not_available(
    asleep: float, status: str, leaves_frames: bool
) -> None:
    bench = Bench(config=TRANSMIT, transmit=True)
    bench.turn()
    bench.traffic(3.0)
    concluded = EPOCH + bench.now
    bench.worker.knowledge = Knowledge(t=concluded, load_until=concluded + 300.0, estimate=made_estimate(concluded))
    turn(bench, 20.0)
    assert said(bench.bus.sent, "RoadloadMass")[-1]["MassMean"] == MARGINAL.mean
    if leaves_frames:
        bench.put(*[frame(0x18FEF100)] * 20)
    sent, woken = len(bench.bus.sent), bench.now + asleep
    bench.now = woken
    turn(bench, WITHIN)
    after = bench.bus.sent[sent:]
    states, masses = said(after, "RoadloadStatus"), said(after, "RoadloadMass")
    assert states
    for state in states:
        assert (
            state["EstimateStatus"] in (status, "unestimated")
            if status == "stale"
            else state["EstimateStatus"] == status
        )
        if state["EstimateStatus"] == "estimated":
            assert state["EstimateAge"] == pytest.approx(asleep + 20.0, abs=WITHIN + 1.0)
    if status == "stale":
        assert {str(mass["MassMean"]) for mass in masses} == {"not available"}
    assert bench.daemon.status(bench.now).clock_steps == 0


def test_the_watchdog_is_told_of_a_daemon_that_was_asleep() -> None:
    bench = Bench()
    bench.turn()
    bench.traffic(3.0)
    bench.now += 8 * 3600.0
    turn(bench, WITHIN)
    assert bench.daemon.is_healthy(bench.now)


def test_time_asleep_is_what_the_clocks_differ_by(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uptime.time, "clock_gettime", lambda clock: 5000.0)
    monkeypatch.setattr(uptime.time, "monotonic", lambda: 1400.0)
    assert uptime.since_start() == 5000.0
    assert uptime.asleep() == 3600.0
