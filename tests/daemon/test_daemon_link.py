"""A bus that comes and goes: what the daemon does then, and what it calls it."""

import errno
import itertools
import logging

import can
import pytest
from daemon_bench import Bench, frame

from estimator import config
from estimator.answers.status import State
from estimator.can_io.j1939_node import FREE
from estimator.daemon.reception.buses import BusSpec, open_bus
from estimator.daemon.reception.device import Device
from estimator.daemon.reception.filters import node_filters
from estimator.daemon.reception.reader import Batch
from estimator.errors import ConfigError

GONE = can.CanOperationError("Failed to receive: No such device", errno.ENODEV)


def test_an_absent_interface_is_tried_again_with_growing_pauses() -> None:
    bench = Bench()
    bench.absent = 7
    began = bench.now
    attempts = []
    while not bench.buses:
        before = bench.absent
        bench.turn(0.1)
        if bench.absent != before or bench.buses:
            attempts.append(bench.now - began)
        if len(attempts) < 8 and not bench.buses:
            assert bench.daemon.state == State.WAITING
            assert "No such device" in bench.daemon.detail
    pauses = [round(b - a) for a, b in itertools.pairwise(attempts)]
    assert pauses == [1, 2, 4, 8, 16, 30, 30]
    assert bench.link.counts.attempts_failed == 7
    assert bench.link.counts.reopened == 0


def test_a_removed_interface_is_opened_anew_and_reception_goes_on() -> None:
    bench = Bench()
    bench.turn()
    bench.traffic(1.0)
    assert bench.daemon.state == State.RECEIVING
    bench.bus.failures.append(GONE)
    first = bench.bus
    bench.turn(0.1)
    assert first.closed
    assert bench.daemon.state == State.WAITING
    bench.turn(2.0)
    bench.traffic(1.0)
    assert bench.daemon.state == State.RECEIVING
    assert bench.link.counts.reopened == 1
    assert bench.link.counts.frames == 20


def test_an_interface_made_anew_is_noticed_although_its_old_socket_only_falls_silent() -> None:
    bench = Bench()
    bench.device = Device(3, True, 0)
    bench.turn()
    bench.traffic(1.0)
    bench.device = Device(4, True, 0)
    bench.turn(4.0)
    assert bench.link.counts.reopened == 1
    bench.device, bench.absent = None, 100
    bench.turn(2.0)
    assert bench.daemon.state == State.WAITING


def test_a_silent_bus_is_no_fault_and_is_not_opened_anew_while_its_device_is_the_same() -> None:
    bench = Bench()
    bench.device = Device(3, True, 0)
    bench.turn()
    bench.traffic(1.0)
    bench.turn(300.0, step=0.5)
    assert bench.daemon.state == State.SILENT
    assert bench.link.counts.reopened == 0
    assert bench.link.problem == ""


def test_without_a_device_to_look_at_a_silent_bus_is_opened_anew() -> None:
    bench = Bench(config=config.from_dict({"reception": {"reopen_s": 20}}))
    bench.turn()
    bench.turn(30.0)
    assert bench.link.counts.reopened == 1
    assert bench.daemon.state == State.SILENT


@pytest.mark.parametrize("device", [Device(3, False, 0), None], ids=["down", "gone"])
def test_an_interface_that_comes_up_is_heard_at_once_however_long_it_was_away(device: Device | None) -> None:
    bench = Bench()
    bench.device = device
    bench.absent = 1000 if device is None else 0
    bench.turn(200.0)
    assert bench.daemon.state == State.WAITING
    assert bench.daemon.detail == ("No such device" if device is None else "the interface is down")
    assert not bench.buses
    bench.device, bench.absent = Device(3, True, 0), 0
    bench.turn(1.2)
    assert bench.daemon.state == State.LISTENING
    assert bench.link.counts.reopened == 0
    bench.traffic(0.5)
    assert bench.daemon.state == State.RECEIVING


def test_a_driver_that_is_not_ready_when_its_device_comes_up_is_tried_again_soon() -> None:
    bench = Bench()
    bench.device = Device(3, False, 0)
    bench.turn(200.0)
    bench.device, bench.absent = Device(3, True, 0), 1
    bench.turn(2.5)
    assert bench.daemon.state == State.LISTENING


def test_an_open_bus_is_listening_until_it_is_heard_and_silent_when_it_is_not() -> None:
    bench = Bench()
    bench.turn()
    assert bench.daemon.state == State.LISTENING
    bench.turn(6.0)
    assert bench.daemon.state == State.SILENT


def test_error_frames_only_are_named_as_a_wrong_bit_rate() -> None:
    bench = Bench()
    bench.turn()
    for _ in range(50):
        bench.bus.waiting.append(Batch(errors=10))
        bench.turn(0.1)
    assert bench.daemon.state == State.FAULT
    assert "bit rate" in bench.daemon.detail
    assert bench.link.counts.errors == 500


def test_after_bus_off_the_bus_is_opened_anew() -> None:
    bench = Bench()
    bench.turn()
    bench.bus.waiting.append(Batch(errors=1, bus_off=1))
    bench.turn(6.0)
    assert bench.link.counts.bus_off == 1
    assert bench.link.counts.reopened == 1
    bench.traffic(0.5)
    assert bench.daemon.state == State.RECEIVING


def test_traffic_of_which_nothing_is_wanted_is_a_fault() -> None:
    bench = Bench()
    for i in range(200):
        bench.device = Device(3, True, 1000 * i)
        bench.turn(1.0)
    assert bench.daemon.state == State.FAULT
    assert "roadload check" in bench.daemon.detail


def test_an_address_taken_later_is_heard_too() -> None:
    filters = node_filters(0x21)
    for address in (0x21, *FREE):
        ident = 0x18F00400 | address
        assert any((ident ^ each["can_id"]) & each["can_mask"] == 0 for each in filters)
    assert not any((0x18F00400 ^ each["can_id"]) & each["can_mask"] == 0 for each in filters)


def test_kernel_drops_are_counted_over_all_sockets() -> None:
    bench = Bench()
    bench.turn()
    bench.bus.drops = 5
    bench.turn(1.5)
    bench.bus.failures.append(GONE)
    bench.turn(2.0)
    bench.bus.drops = 3
    bench.turn(2.0)
    assert bench.link.counts.kernel_drops == 8


def test_the_receive_buffer_that_was_got_is_told_once_with_the_remedy_where_it_is_small(caplog) -> None:
    caplog.set_level(logging.INFO)
    bench = Bench()
    bench.turn()
    assert "receive buffer of 8388608 bytes" in caplog.text
    assert "rmem_max" not in caplog.text
    opened = bench.link._opener

    def small(spec: BusSpec, filters: object) -> can.BusABC:
        bus = opened(spec, filters)  # type: ignore[arg-type]
        bus.buffer = 425_984  # type: ignore[attr-defined]
        return bus

    bench.link._opener = small
    for _ in range(3):
        bench.bus.failures.append(GONE)
        bench.turn(2.0)
    told = [record for record in caplog.records if "rmem_max" in record.message]
    assert [(record.levelname, record.message) for record in told] == [
        (
            "WARNING",
            "virtual bench: receive buffer of 425984 bytes, not 8388608: a full bus may lose frames; "
            "set net.core.rmem_max = 4194304",
        )
    ]


def test_a_full_queue_drops_the_newest_and_counts_them() -> None:
    bench = Bench(config=config.from_dict({"reception": {"queue_frames": 1000}}))
    bench.turn()
    for _ in range(11):
        bench.put(*(frame(0x18FEF100) for _ in range(100)))
        bench.link.step(0)
    assert bench.link.counts.queue_drops == 100
    assert sum(len(batch.frames) for _, batch in bench.link.take()) == 1000


@pytest.mark.parametrize(
    ("options", "fragment"),
    [
        ({"interface": "nonsense", "channel": "x"}, "nonsense"),
        ({"interface": "socketcan", "channel": "can/0"}, "cannot be the name"),
        ({"interface": "socketcan", "channel": "a-name-that-is-too-long"}, "cannot be the name"),
        ({"interface": "socketcan", "channel": "lo"}, "not a CAN interface"),
        ({"interface": "virtual", "channel": "x", "port": "a"}, "Port"),
        (
            {"interface": "socketcand", "channel": "can0"},
            "needs host and port; give --bus-kwargs host=... port=..., or",
        ),
        ({"interface": "udp_multicast", "channel": "can0"}, "'can0' is no multicast address"),
        ({"interface": "udp_multicast", "channel": "10.0.0.1"}, "'10.0.0.1' is no multicast address"),
    ],
)
def test_a_bus_that_can_never_be_opened_is_refused(options: dict[str, object], fragment: str) -> None:
    with pytest.raises(ConfigError, match=fragment):
        open_bus(BusSpec(options), None)


def test_what_can_never_be_opened_ends_the_daemon_at_the_start_only() -> None:
    def refuse(spec: BusSpec, filters: object) -> can.BusABC:
        raise ConfigError("no permission")

    bench = Bench(opener=refuse)
    bench.link.run_once()
    with pytest.raises(ConfigError, match="no permission"):
        bench.daemon.turn()


def test_messages_do_not_repeat_without_end(caplog: pytest.LogCaptureFixture) -> None:
    from estimator.daemon.service.logging_setup import Once

    once = Once()
    logger = logging.getLogger("estimator.daemon.reception.link")
    caplog.set_level(logging.INFO, logger="estimator.daemon.reception.link")
    record = logger.makeRecord(logger.name, logging.WARNING, __file__, 1, "%s: gone", ("can0",), None)
    passed = [once.filter(record) for _ in range(1000)]
    assert passed == [True] + [False] * 999
