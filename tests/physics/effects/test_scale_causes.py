"""A difference of scale is reported with the errors of temperature that explain it."""

from ltsim.physics.effects.scale_causes import has_temperature_cause, temperature_errors_text, unit_error_text


def test_a_scale_difference_is_given_in_kelvin_of_steel_and_of_air() -> None:
    text = temperature_errors_text(-46e-6)
    assert "steel lengths that is wrong by 4.0 K" in text
    assert "air temperature that is wrong by 4" in text
    assert "steel" not in temperature_errors_text(9.5e-6, is_of_distances=True)


def test_no_temperature_is_named_that_no_thermometer_has() -> None:
    """A scale error of 10 % was an air temperature that is wrong by 104761 K."""
    assert temperature_errors_text(0.1, is_of_distances=True) == "no error of a temperature causes such a scale error"
    assert "steel" in temperature_errors_text(4e-4)
    assert "air" not in temperature_errors_text(4e-4)
    assert not has_temperature_cause(0.1)


def test_a_unit_is_named_by_its_factor() -> None:
    assert unit_error_text(1.0 / 0.3048 - 1.0) == "feet were recorded as metres"
    assert unit_error_text(-0.1) == ""
