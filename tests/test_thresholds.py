"""The diagnosis decides by the thresholds that it is given."""

import numpy as np
import pytest
from simulated_logs import drive, written

from estimator.answers.diagnosis import Verdict
from estimator.blas_threads import one_blas_thread
from estimator.config import Config
from estimator.diagnosis.model import fit, select
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.outcome import Outcome
from estimator.diagnosis.search import search
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import BY_NAME
from estimator.simulation.effects.effect import Effect
from estimator.streaming.drive_extraction import drives


def outcome(plain: tuple[Drive, ...], thresholds: Thresholds) -> Outcome:
    effects = [BY_NAME["cornering"], BY_NAME["viscous_drag"]]
    result = search(plain, effects, thresholds)
    return Outcome(result=result, plain=plain, effects=effects, rng=np.random.default_rng(1), thresholds=thresholds)


@pytest.mark.slow
@one_blas_thread()
def test_an_effect_is_named_where_its_evidence_exceeds_the_threshold(tmp_path):
    recording = drive("mixed", 25, 1, Effect(name="cornering", magnitude=900.0))
    (record,) = drives(written(recording, tmp_path / "log.blf"), Config(), lambda share: None)
    model = fit(record.samples[select(record.samples)])
    assert model is not None
    plain = (Drive(record, model),)

    named = outcome(plain, Thresholds())
    assert [found.joint.name for found in named.result.chosen] == ["cornering"]
    assert named.verdict is Verdict.EFFECT

    evidence = named.result.chosen[0].joint.log_bayes_factor
    unnamed = outcome(plain, Thresholds(min_log_bf_effect=evidence + 1.0))
    assert unnamed.result.chosen == ()
    assert unnamed.verdict is not Verdict.EFFECT


@pytest.mark.parametrize(
    ("is_timed", "others", "field"),
    [
        (False, 0, "min_log_bf_effect"),
        (True, 0, "min_log_bf_timed"),
        (False, 2, "min_log_bf_further"),
        (True, 1, "min_log_bf_further_timed"),
    ],
)
def test_each_kind_of_effect_has_its_own_threshold(is_timed, others, field):
    assert Thresholds(**{field: 99.0}).min_log_bf(is_timed, others) == 99.0
