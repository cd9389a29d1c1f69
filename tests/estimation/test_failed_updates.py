"""An update that fails numerically gives no estimate, says so, is counted, and leaves everything as it was."""

from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from typing import Any

import numpy as np
import pytest
from daemon_bench import Bench
from simulated_logs import ask, drive, written

from estimator.can_io.j1939_encoder import frames_of
from estimator.checkpoint.store import pack, unpack
from estimator.commands.main import main
from estimator.config import from_dict
from estimator.daemon.service import metrics
from estimator.estimates import Coverage, Estimate, Status
from estimator.estimation import paper_inference, posterior, road_inference
from estimator.estimation.estimator import Estimator
from estimator.estimation.gain_changes import GainChanges
from estimator.estimation.gate import Gate
from estimator.estimation.load_segments import Loads
from estimator.estimation.road_posterior import RoadTarget
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.road_load import design
from estimator.samples import STEP, Rows

MASS = 27_190.0
ROWS, SEEN = 6000, 2500  # of a drive with three updates, and those before the update that fails
STEPS = {  # of an update, in order
    "window": (Loads, "carried_over"),
    "fit": (road_inference, "fitted_with_shapes"),
    "averaged over shapes": (road_inference, "averaged"),
    "gain changes": (road_inference, "gain_changes"),
    "averaged over gain changes": (GainChanges, "averaged"),
    "target": (RoadTarget, "of"),
    "drive against beliefs": (road_inference, "contradiction"),
    "coverage": (Gate, "coverage"),
    "limits": (road_inference, "_outside"),
    "misfit": (road_inference, "_misfit"),
    "sampling": (posterior, "sample"),
    "kernel": (posterior, "run"),
    "evidence": (road_inference, "Evidence"),
    "load": (Loads, "show"),
}


BY_DAY = ("window", "fit", "target", "sampling", "load")  # others by night


def driven(n: int = ROWS) -> Rows:
    """Rows of a level drive."""
    rng = np.random.default_rng(1)
    t = np.arange(n) * STEP
    v = 13 + 8 * np.sin(2 * np.pi * t / 90) + 4 * np.sin(2 * np.pi * t / 47) + np.sin(2 * np.pi * t / 17)
    power = design(v, np.gradient(v, STEP)) @ np.array([1739.0, 3.74, MASS]) + rng.normal(0, 3e3, n)
    fresh = np.ones((n, 2), dtype=bool)
    return Rows(index=np.arange(n), speed=v + rng.normal(0, 0.01, n), power=power, fresh=fresh, context={})


def new(likelihood: str = "road") -> Estimator:
    config = from_dict({"sampler": {"likelihood": likelihood}, "gate": {"interval_s": 180.0}})
    return Estimator(config, np.random.default_rng(1))


def fed(estimator: Estimator, rows: Rows) -> list[Estimate]:
    return [estimate for i in range(0, len(rows), 50) for estimate in estimator.feed(rows[i : i + 50])]


def raising(error: BaseException) -> Callable[..., Any]:
    def broken(*_: object, **__: object) -> Any:
        raise error

    return broken


@pytest.fixture(scope="module")
def rows() -> Rows:
    return driven()


@pytest.fixture(scope="module")
def before(rows: Rows) -> bytes:
    """The state after a first estimate, between two updates."""
    estimator = new()
    assert [estimate.status for estimate in fed(estimator, rows[:SEEN])] == [Status.ESTIMATED], estimator.latest
    return pack(estimator.state(), "k")


def restored(state: bytes) -> Estimator:
    estimator = new()
    estimator.restore(unpack(state, "k"))
    return estimator


def judge(estimator: Estimator, failed: Estimate, why: str, following: Rows) -> None:
    """The ``failed`` update says ``why``, the state can be stored, and the next update works from either."""
    assert failed.status is Status.UNESTIMATED
    assert failed.reason == f"this update failed numerically ({why}); the next one starts anew"
    assert failed.marginals == {"A": None, "C": None, "m": None}
    assert failed.coverage == Coverage(0, 0)
    assert failed.admitted == len(estimator.window)
    assert estimator.latest is failed
    assert estimator.evidence is None
    assert estimator.failed_updates == 1
    other = restored(pack(estimator.state(), "k"))
    waiting = list(other.resume(same_load=True))
    assert waiting == list(estimator.finish())
    later = fed(estimator, following)
    assert later == fed(other, following)
    for estimate in [*waiting, *later]:
        assert estimate.status is Status.ESTIMATED, estimate.reason
        assert estimate.mass is not None
        assert abs(estimate.mass.mean / MASS - 1) < 0.02
    assert later
    assert estimator.failed_updates == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "step", [step if step in BY_DAY else pytest.param(step, marks=pytest.mark.nightly) for step in STEPS]
)
def test_a_step_that_fails_costs_its_update_alone(
    rows: Rows, before: bytes, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = restored(before)
    with monkeypatch.context() as patch:
        patch.setattr(*STEPS[step], raising(np.linalg.LinAlgError("Singular matrix")))
        failed = list(estimator.resume(same_load=True))
    judge(estimator, failed[-1], "Singular matrix", rows[SEEN:])
    assert len(failed) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "error", [NotPositiveDefiniteError("not positive definite"), FloatingPointError("nan"), ZeroDivisionError("by 0")]
)
def test_each_numerical_error_costs_its_update_alone(
    rows: Rows, before: bytes, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = restored(before)
    with monkeypatch.context() as patch:
        patch.setattr(RoadTarget, "free_sd", property(raising(error)))
        (failed,) = estimator.resume(same_load=True)
    judge(estimator, failed, str(error), rows[SEEN:])


NOT_FINITE = {
    "averaged over shapes": ("covariance", np.nan, "the coefficients of the fit are not finite"),
    "averaged over gain changes": ("beta", np.inf, "the coefficients of the fit are not finite"),
    "kernel": ("draws", np.nan, "the draws are not finite"),
}


@pytest.mark.slow
@pytest.mark.parametrize("step", NOT_FINITE)
def test_what_is_not_finite_is_no_estimate(
    rows: Rows, before: bytes, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner, name = STEPS[step]
    attribute, value, why = NOT_FINITE[step]
    whole = getattr(owner, name)

    def spoilt(*arguments: Any) -> Any:
        result = whole(*arguments)
        return replace(result, **{attribute: np.full_like(getattr(result, attribute), value)})

    estimator = restored(before)
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, spoilt)
        (failed,) = estimator.resume(same_load=True)
    judge(estimator, failed, why, rows[SEEN:])


@pytest.mark.slow
def test_a_mistake_in_the_program_is_not_taken_for_a_numerical_failure(
    before: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posterior, "sample", raising(TypeError("a mistake")))
    with pytest.raises(TypeError, match="a mistake"):
        list(restored(before).resume(same_load=True))


@pytest.mark.slow
@pytest.mark.parametrize("likelihood", ["road", "paper"])
def test_an_update_that_is_interrupted_leaves_the_estimate_before_with_its_draws(
    rows: Rows, likelihood: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = new(likelihood)
    (latest,) = fed(estimator, rows[:SEEN])
    evidence, state = estimator.evidence, pack(estimator._inference.state(), "k")
    assert evidence is not None
    monkeypatch.setattr(posterior, "sample", raising(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        list(estimator.finish())
    assert estimator.latest is latest
    assert estimator.evidence is evidence
    assert pack(estimator._inference.state(), "k") == state


@pytest.mark.slow
@pytest.mark.parametrize("step", [(paper_inference, "ClippedGaussianTarget"), (posterior, "sample"), (Loads, "show")])
def test_the_likelihood_of_the_paper_outlives_a_failure_too(
    rows: Rows, step: tuple[object, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = new("paper")
    with monkeypatch.context() as patch:
        patch.setattr(*step, raising(np.linalg.LinAlgError("Singular matrix")))
        (failed,) = fed(estimator, rows[:SEEN])
    assert "failed numerically (Singular matrix)" in failed.reason
    assert estimator.failed_updates == 1
    assert {estimate.status for estimate in fed(estimator, rows[SEEN:])} == {Status.ESTIMATED}


@pytest.mark.slow
def test_the_failures_of_a_log_are_told(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = written(drive("mixed", 12, 1), tmp_path / "drive.blf")
    monkeypatch.setattr(posterior, "sample", raising(np.linalg.LinAlgError("Singular matrix")))
    config = tmp_path / "c.toml"
    config.write_text("[gate]\ninterval_s = 300\n")
    answer = ask("estimate", log, "--config", config)
    assert answer["status"] == "unestimated"
    assert "failed numerically (Singular matrix)" in answer["reason"]
    assert 1 <= answer["failed_updates"] <= len(answer["updates"])
    text = StringIO()
    with redirect_stdout(text):
        assert main(["estimate", str(log), "--config", str(config)]) == 0
    count, updates = answer["failed_updates"], len(answer["updates"])
    assert f"failed    {count} of {updates} updates, numerically" in text.getvalue()


@pytest.mark.slow
def test_a_daemon_goes_on_and_counts(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.turn()
    frames = frames_of(drive("mixed", 12, 1).signals)
    monkeypatch.setattr(posterior, "sample", raising(np.linalg.LinAlgError("Singular matrix")))
    bench.worker.offer(frames)
    bench.worker.turn()
    bench.turn()
    assert bench.worker.failure is None
    status = bench.daemon.status(bench.now)
    assert status.failed_updates >= 1
    assert status.estimate is not None
    assert "failed numerically (Singular matrix)" in status.estimate.reason
    assert f"roadload_failed_updates_total {status.failed_updates}\n" in metrics.exposition(status)
