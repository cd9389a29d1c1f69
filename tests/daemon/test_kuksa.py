"""The estimate as VSS signals on a databroker that speaks kuksa.val.v2."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_estimates import MARGINAL, made_estimate

from estimator import config
from estimator.answers.published import PublishedAnswer
from estimator.answers.status import State
from estimator.daemon.outputs.output import Output, Trouble
from estimator.daemon.outputs.vss import WEIGHT, signals
from estimator.daemon.service.status import published

pytest.importorskip("kuksa.val.v2.val_pb2_grpc")
from kuksa_stand_in import Databroker

from estimator.daemon.outputs.kuksa import KuksaChannel


def report(is_valid: bool = True, age: float = 20.0) -> PublishedAnswer:
    estimate = made_estimate()
    return published(estimate, estimate if is_valid else None, State.RECEIVING, age, 1.7e9, 3600.0)


ALL = {signal.path for signal in signals(None, overlay=True)}


@pytest.fixture
def broker() -> Iterator[Databroker]:
    broker = Databroker(ALL)
    yield broker
    broker.stop()


class Sender:
    """An output whose thread and clock are the test's."""

    def __init__(self, port: int, **settings: object) -> None:
        self.now = 0.0
        table = config.from_dict({"kuksa": {"host": "127.0.0.1", "port": port, **settings}}).kuksa
        assert table is not None
        rng = np.random.default_rng(1)
        self.output = Output(KuksaChannel(table), table.period_s, rng, lambda: self.now, lambda: 0.0)

    def offer(self, content: PublishedAnswer, seconds: float = 1.0) -> None:
        self.now += seconds
        self.output.offer(content)
        self.output.step(0.0)

    def end(self) -> None:
        self.output.stop()
        self.output._run()


def test_a_databroker_gets_mass_interval_and_status_with_the_time_of_the_conclusion(broker: Databroker) -> None:
    sender = Sender(broker.port)
    sender.offer(report(age=20.0))
    assert broker.values[WEIGHT] == round(MARGINAL.mean)
    assert broker.values["Vehicle.RoadLoad.Mass.Low"] == pytest.approx(MARGINAL.q05)
    assert broker.values["Vehicle.RoadLoad.Drag.Status"] == "ESTIMATED"
    assert set(broker.times.values()) == {1.7e9 - 20.0}
    sender.end()


def test_a_databroker_has_no_value_once_the_estimate_is_not_valid_or_the_daemon_stops(broker: Databroker) -> None:
    sender = Sender(broker.port)
    sender.offer(report())
    sender.offer(report(is_valid=False))
    assert {broker.values[path] for path in ALL} == {None, "UNESTIMATED"}
    sender.offer(report())
    assert broker.values[WEIGHT] == round(MARGINAL.mean)
    sender.end()
    assert {broker.values[path] for path in ALL} == {None, "UNESTIMATED"}


def test_a_databroker_is_called_for_a_change_and_every_period(broker: Databroker) -> None:
    sender = Sender(broker.port)
    for second in range(25):
        sender.offer(report(age=second))
    assert broker.calls == 3 * len(ALL)
    sender.end()


def test_a_databroker_without_the_overlay_is_told_of_or_gets_the_standard_signal() -> None:
    broker = Databroker({WEIGHT})
    sender = Sender(broker.port)
    sender.offer(report())
    assert sender.output.failed == {Trouble.REFUSED: 1}
    assert "load roadload.vspec into the broker" in sender.output.problem
    plain = Sender(broker.port, overlay=False)
    plain.offer(report())
    assert broker.values == {WEIGHT: round(MARGINAL.mean)}
    plain.end()
    broker.stop()


def test_a_databroker_that_comes_back_gets_the_newest_report_once() -> None:
    broker = Databroker(ALL)
    sender = Sender(broker.port)
    sender.offer(report())
    port = broker.port
    broker.stop()
    for age in range(30):
        sender.offer(report(is_valid=False, age=age), seconds=11.0)
    assert not sender.output.is_open
    assert set(sender.output.failed) == {Trouble.UNREACHABLE}
    broker = Databroker(ALL, port)
    sender.offer(report(), seconds=61.0)
    assert broker.values[WEIGHT] == round(MARGINAL.mean)
    assert broker.calls == len(ALL)
    sender.end()
    broker.stop()


def test_a_token_is_taken_from_its_file(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("wrong\n")
    token.chmod(0o600)
    broker = Databroker(ALL, token="right")
    sender = Sender(broker.port, token_file=str(token))
    sender.offer(report())
    assert sender.output.problem == "the broker refuses the connection: UNAUTHENTICATED: no valid token"
    token.write_text("right\n")
    sender.offer(report(), seconds=61.0)
    assert broker.values[WEIGHT] == round(MARGINAL.mean)
    sender.end()
    broker.stop()
