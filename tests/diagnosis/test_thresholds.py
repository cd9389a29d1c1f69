"""The diagnosis decides by the thresholds that it is given, and says what it cannot tell apart."""

from types import SimpleNamespace

import numpy as np
import pytest
from simulated_logs import drive, written

from estimator.answers.diagnosis import Verdict
from estimator.config import Config
from estimator.diagnosis import decision, findings
from estimator.diagnosis.decision import Decision
from estimator.diagnosis.diagnose import diagnose
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import BY_NAME
from estimator.signals import Quantity
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


@pytest.mark.parametrize(("alone", "is_more"), [(300.0, True), (2.9, False)])
def test_processes_that_only_add_to_effects_do_not_speak_against_them(monkeypatch, alone, is_more):
    """Processes can imitate an effect and what it leaves together; then those found beside it are nothing alone."""
    monkeypatch.setattr(decision, "lag_finding", lambda *_: None)
    result = SimpleNamespace(
        log_bf_effects=504.0, log_bf_processes=602.0, log_bf_chosen_processes=alone, is_sloping=False, is_hilly=False
    )
    decided = Decision(result=result, budget=None, cases=(), start=(), thresholds=Thresholds())
    assert decided.nameless_explains_more is is_more


@pytest.mark.parametrize(("known", "alike"), [((), {"headwind"}), ((Quantity.HEADING,), set())])
def test_a_wind_from_ahead_is_not_told_from_viscous_drag_without_the_heading(known, alike):
    drive = SimpleNamespace(known_quantities=frozenset(known))
    decision = SimpleNamespace(cases=[SimpleNamespace(drive=drive)])
    assert findings._alike_unseen(decision, BY_NAME["viscous_drag"]) == alike
    assert findings._alike_unseen(decision, BY_NAME["auxiliary_load"]) == set()


def test_a_wind_from_ahead_all_the_time_has_the_power_of_viscous_drag_and_no_more():
    """To the plain columns A v and C v^3, a part that they take up left out."""
    v, w = np.linspace(5.0, 30.0, 200), 5.0
    wind = ((v + w) ** 2 - v**2) * v
    plain = np.column_stack([v, v**3])
    rest, drag = (x - plain @ np.linalg.lstsq(plain, x, rcond=None)[0] for x in (wind, v**2))
    assert np.corrcoef(rest, drag)[0, 1] == pytest.approx(1.0, abs=1e-9)
