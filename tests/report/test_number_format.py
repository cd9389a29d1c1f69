"""Numbers as a person reads them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.report.number_format import MINUS, NOTHING, TIMES, number, with_interval, with_sd

numbers = st.floats(-1e200, 1e200) | st.sampled_from([float("nan"), float("inf"), -float("inf")])
units = st.sampled_from(["1", "1/h", "1/N", "W", "N m", "kg", ""])


@pytest.mark.parametrize(
    ("value", "sd", "unit", "words"),
    [
        (27_855.3, 536.2, "kg", "27,860 ± 540 kg"),
        (0.85, 0.15, "1", "85 ± 15 %"),  # a share is read in per cent
        (0.0726, 0.0031, "1/h", "7.26 ± 0.31 %/h"),
        (34_751.0, float("nan"), "W", "34.8 kW"),
        (640.0, 81.0, "W", "640 ± 81 W"),
        (5741.4, 583.6, "W", "5.74 ± 0.58 kW"),
        (7.26e-5, 1.1e-5, "1/N", f"73 ± 11 {TIMES}10⁻⁶ 1/N"),
        (1.26e-6, 2.1e-7, "1/N", f"1.26 ± 0.21 {TIMES}10⁻⁶ 1/N"),
        (69.75, 3.01, "N m", "69.8 ± 3.0 N m"),
        (-4.4, 0.02, "m/s", f"{MINUS}4.400 ± 0.020 m/s"),
        (2e-5, 0.4, "s", "0.00 ± 0.40 s"),  # as large as the uncertainty, not as small as the value
        (0.0, 0.0, "N", "0.00 N"),
        (float("nan"), 1.0, "kg", NOTHING),
    ],
)
def test_a_value_has_the_digits_that_its_sd_deserves(value, sd, unit, words):
    assert with_sd(value, sd, unit) == words


@pytest.mark.parametrize(
    ("values", "unit", "words"),
    [
        ((16_380.0, 3448.0, 30_480.0), "kg", "16,400 kg (3,400 .. 30,500)"),
        ((0.0726, 0.0651, 0.0801), "1", "7.26 % (6.51 .. 8.01)"),
        ((0.0, -3.1e-6, 3.3e-6), "1/N", f"0.00 {TIMES}10⁻⁶ 1/N ({MINUS}3.10 .. 3.30)"),
        ((5.0, 5.0, 5.0), "m/s", "5.00 m/s (5.00 .. 5.00)"),
    ],
)
def test_an_interval_is_told_to_a_hundredth_of_itself(values, unit, words):
    assert with_interval(*values, unit) == words


@given(numbers, numbers, units)
def test_whatever_the_numbers_are_they_can_be_read(value, sd, unit):
    for text in (with_sd(value, sd, unit), number(value), with_interval(value, min(value, sd), max(value, sd), unit)):
        assert text
        assert not text.startswith("-")
        assert not any(word in text for word in ("nan", "inf"))
