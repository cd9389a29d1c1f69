"""The diagnosis decides by the thresholds that it is given."""

import numpy as np
import pytest
from simulated_logs import drive, written

from estimator.answers.diagnosis import Verdict
from estimator.config import Config
from estimator.diagnosis.diagnose import diagnose
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import BY_NAME
from estimator.simulation.effects.effect import Effect
from estimator.streaming.drive_extraction import drives_of


@pytest.mark.slow
def test_an_effect_is_named_where_its_probability_exceeds_the_threshold(tmp_path):
    recording = drive("mixed", 13, 42, Effect(name="cornering", magnitude=900.0))
    records = drives_of(written(recording, tmp_path / "log.blf"), Config(), lambda share: None)
    effects = [BY_NAME["cornering"], BY_NAME["viscous_drag"]]

    named = diagnose(records, (), np.random.default_rng(1), effects)
    assert named.verdict is Verdict.EFFECT
    assert [found.name for found in named.effects] == ["cornering"]
    assert named.effects[0].probability > Thresholds().min_probability

    never = diagnose(records, (), np.random.default_rng(1), effects, Thresholds(min_probability=1.1))
    assert never.verdict is not Verdict.EFFECT
