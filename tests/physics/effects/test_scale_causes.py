"""A difference of scale is reported with the errors of temperature that explain it."""

from ltsim.physics.effects.air import temperature_errors_text


def test_a_scale_difference_is_given_in_kelvin_of_steel_and_of_air() -> None:
    text = temperature_errors_text(-46e-6)
    assert "steel lengths that is wrong by 4.0 K" in text
    assert "air temperature that is wrong by 4" in text
    assert "steel" not in temperature_errors_text(9.5e-6, is_of_distances=True)
