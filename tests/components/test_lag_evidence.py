"""The evidence of a lag between power and speed, beside effects that were chosen."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimator.components.processes import LOW_PASS
from estimator.components.search_result import ChosenEffect, SearchResult
from estimator.diagnosis.lag import LAG_DOUBT, evidence_of_lag
from estimator.estimation.road_likelihood import LAG
from estimator.model.effects import BY_NAME

SD = 0.012  # s, of the fit


def result_with(lag: float, low_pass: float = 0.0, error_of_form: float = 0.0) -> Any:
    """Of one drive with a ``lag`` [s], and a log Bayes factor of a low-pass."""
    covariance = np.zeros((4, 4))
    covariance[LAG, LAG] = SD**2
    fit = SimpleNamespace(lag=lag, theta_covariance=lambda: covariance)
    process = SimpleNamespace(name=LOW_PASS if low_pass else "white force")
    nameless = SimpleNamespace(term_by_drive={0: process}, log_bayes_factor=low_pass)
    return SimpleNamespace(longest=SimpleNamespace(fit=fit), nameless=nameless, error_of_form=error_of_form)


def result_of(*chosen: ChosenEffect) -> SearchResult:
    """A result with these ``chosen`` effects, and nothing else known."""
    unknown: dict[str, Any] = dict.fromkeys(SearchResult.__dataclass_fields__)
    return SearchResult(**(unknown | {"chosen": chosen}))


def test_a_lag_has_the_evidence_of_its_distance_from_usual_ones():
    sd = np.hypot(SD, LAG_DOUBT)  # 0.013 s
    assert evidence_of_lag(result_with(0.12 + 5 * sd)) == pytest.approx(12.5)
    assert evidence_of_lag(result_with(-0.06 - 5 * sd)) == pytest.approx(12.5)
    assert evidence_of_lag(result_with(0.12 + 3.9 * sd)) is None
    assert evidence_of_lag(result_with(0.9)) is None


def test_a_low_pass_adds_to_it_and_is_no_lag_alone():
    sd = np.hypot(SD, LAG_DOUBT)
    assert evidence_of_lag(result_with(0.12 + 3 * sd, low_pass=20.0)) == pytest.approx(24.5)
    assert evidence_of_lag(result_with(0.1, low_pass=20.0)) is None


def test_it_is_more_than_errors_of_the_form_of_a_large_effect():
    late = 0.12 + 10 * np.hypot(SD, LAG_DOUBT)
    assert evidence_of_lag(result_with(late, error_of_form=49.0)) == pytest.approx(50.0)
    assert evidence_of_lag(result_with(late, error_of_form=51.0)) is None


def test_errors_of_form_are_those_of_the_largest_choice():
    def choice(name: str, log_bayes_factor: float) -> ChosenEffect:
        return ChosenEffect(
            effect=BY_NAME[name],
            probability=1.0,
            rival="",
            probability_with_rival=1.0,
            log_bayes_factor=log_bayes_factor,
            drive=0,
        )

    result = result_of(choice("mass_step", 90_000.0), choice("headwind", 200.0))
    assert result.error_of_form == pytest.approx(90.0)
    assert result_of().error_of_form == 0.0
