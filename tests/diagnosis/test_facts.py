"""The advice for the streaming estimator holds all effects that were found, or none."""

import pytest
from diagnoses import finding

from estimator.diagnosis.facts import beyond_streaming, streaming_effects
from estimator.diagnosis.result import Magnitude, Span
from estimator.model.effects import BY_NAME


def found(name, span=()):
    return finding(name, 1.0, magnitude=Magnitude(BY_NAME[name].symbol, 1.0, 0.1, ""), span=span)


WIND, SHOWN_FAN = found("headwind"), found("auxiliary_cycling")
TIMED_FAN, BRAKE = (found(name, (Span(60.0, 90.0),)) for name in ("auxiliary_cycling", "brake_use"))
LAG, STEP = found("time_lag"), found("mass_step", (Span(60.0, 90.0),))


@pytest.mark.parametrize(
    ("named", "configured", "beyond"),
    [
        ((WIND,), ("headwind",), ()),
        ((SHOWN_FAN, WIND), ("auxiliary_cycling", "headwind"), ()),
        ((TIMED_FAN, WIND), (), ("auxiliary_cycling",)),
        ((WIND, BRAKE), (), ("brake_use",)),
        ((LAG, WIND), ("headwind",), ()),  # the streaming model has a lag anyway
        ((STEP, WIND), ("headwind",), ()),  # and judges changes of the load
        ((LAG,), (), ()),
        ((STEP,), (), ()),
    ],
)
def test_effects_are_configured_where_the_estimator_can_have_all_of_them(named, configured, beyond):
    assert streaming_effects(named, ()) == configured
    assert beyond_streaming(named) == beyond
    if configured:
        assert streaming_effects(named, (BY_NAME["grade"], BY_NAME["air_density"])) == ("air_density", *configured)
