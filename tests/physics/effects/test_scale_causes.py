"""A difference of scale is reported with the errors of temperature that explain it."""

from ltsim.physics.effects.scale_causes import has_temperature_cause, temperature_errors_text, unit_error_text
from ltsim.recordings.references import common_expansion_per_k
from ltsim.recordings.setup import LengthGauge


def test_a_scale_difference_is_given_in_kelvin_of_steel_and_of_air() -> None:
    text = temperature_errors_text(-46e-6)
    assert "steel lengths that is wrong by 4.0 K" in text
    assert "air temperature that is wrong by 4" in text
    assert "steel" not in temperature_errors_text(9.5e-6, is_of_distances=True)


def test_kelvin_of_reference_lengths_are_those_of_their_declared_expansion() -> None:
    assert "lengths with 23.2 ppm/K that is wrong by 2.0 K" in temperature_errors_text(46e-6, expansion_per_k=23.2e-6)
    lengths = tuple({"from": "A", "to": "B", "length_mm": 1000, "sigma_mm": 0.01, "material": m} for m in ("x", None))
    for expansion, common in ((23.2e-6, 23.2e-6), (12e-6, 0.0)):
        materials = {"x": {"expansion_per_k": expansion}}
        gauge = {"expansion_per_k": 23.2e-6, "materials": materials, "distance": lengths}
        assert common_expansion_per_k(LengthGauge.model_validate(gauge)) == common


def test_no_temperature_is_named_that_no_thermometer_has() -> None:
    """A scale error of 10 % was an air temperature that is wrong by 104761 K."""
    assert temperature_errors_text(0.1, is_of_distances=True) == "no error of a temperature causes such a scale error"
    assert "steel" in temperature_errors_text(4e-4)
    assert "air" not in temperature_errors_text(4e-4)
    assert not has_temperature_cause(0.1)


def test_a_unit_is_named_by_its_factor() -> None:
    assert unit_error_text(1.0 / 0.3048 - 1.0) == "feet were recorded as metres"
    assert unit_error_text(-0.1) == ""
