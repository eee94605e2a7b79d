"""One way to write a value with its uncertainty."""

from __future__ import annotations

import pytest

from ltsim.core.notation import number_text, with_expanded_uncertainty, with_sigma


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (1.2345, 0.0996, "1.23 +- 0.10"),
        (12.13, 1.84, "12.1 +- 1.8"),
        (1234.6, 12.3, "1235 +- 12"),
        (-0.04, 1.2, "0.0 +- 1.2"),
        (5.0, float("nan"), "5.00"),
        (float("nan"), 1.0, "-"),
        (None, None, "-"),
        (2.5e-7, 1.1e-8, "0.000000250 +- 0.000000011"),
    ],
)
def test_value_and_sigma_end_at_the_second_digit_of_sigma(value: float, sigma: float, text: str) -> None:
    assert with_sigma(value, sigma) == text


def test_expanded_uncertainty_says_its_factor() -> None:
    assert with_expanded_uncertainty(1.2345, 0.2, "um") == "1.23 um, U = 0.20 um (k = 2)"


def test_number_has_no_exponent_where_it_can_be_avoided() -> None:
    assert [number_text(v) for v in (0.0, 12345.6, 1.23456, 1.5e7, None)] == ["0", "12346", "1.23", "1.50e+07", "-"]
