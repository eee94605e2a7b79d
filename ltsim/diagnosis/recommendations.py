"""Recommended next action of a user after a finding of a diagnosis."""

from ltsim.adjustment.identification.recommendations import (
    RECOMMENDATION_BY_REFERENCE_KIND,
    recommendation_at_place,
)
from ltsim.core.errors import ModelError
from ltsim.core.notation import names_text
from ltsim.diagnosis.schema import Finding
from ltsim.physics.effects import catalogue_entry, effect_title, find_effect

CAUSE_KIND_BY_EFFECT_NAME = {
    "reflector-constant": "constant-offset",
    "range-step": "constant-step",
    "range-drift": "constant-drift",
    "index-drift": "constant-drift",
    "azimuth-drift": "constant-drift",
    "station-weather": "scale-error",
    "smr-offset": "reflector-radius",
    "nest-lift": "reflector-seating",
    "target-moved": "target-moved",
    "station-bump": "station-bump",
    "station-settling": "station-settling",
    "target-swap": "names",
    "wrong-unit": "unit",
    "outlier": "outlier",
}
"""Kind of a simple cause (such as outliers or moved targets) by the name of a catalogue effect. The action that is
recommended after this cause is also recommended after a finding of the effect."""


def inspection_action(finding: Finding) -> str:
    """Sentence on the part of the set-up to inspect or to correct because of a finding."""
    scope = finding.where
    trackers = [f"instrument {name}" for name in scope.instruments]
    place = names_text([*trackers, *scope.stations, *scope.targets])
    if finding.effect == "noise-level":
        return "Set the noise in setup.toml to the estimated values."
    if finding.effect in CAUSE_KIND_BY_EFFECT_NAME and place:
        kind = CAUSE_KIND_BY_EFFECT_NAME[finding.effect]
        return recommendation_at_place(kind, [*trackers, *scope.stations], scope.targets)
    reference_kind = finding.carrier.removeprefix("reference ")
    if finding.concerns_reference_value and scope.stations and reference_kind in RECOMMENDATION_BY_REFERENCE_KIND:
        return RECOMMENDATION_BY_REFERENCE_KIND[reference_kind].format(place=place)
    if finding.concerns_reference_value:
        return f"Check the {finding.carrier} ({place or 'all of them'})."
    covariates_text = f" with {names_text(scope.covariates)}" if scope.covariates else ""
    change = f"change of the {finding.carrier or 'readings'}{covariates_text}"
    title = effect_title(finding.effect) if finding.is_catalogued else f"a {change}"
    action = f"Inspect {place} for the cause: {title}" if place else f"Look in all set-ups for the cause: {title}"
    return f"{action}{_confirmation_text(finding)}."


def _confirmation_text(finding: Finding) -> str:
    """Measurement that confirms the effect of a finding, as text after a semicolon.

    An empirical law describes an error as a function of covariates. The text is empty for an empirical law outside the
    catalogue, and if no measurement is needed.
    """
    if not finding.is_catalogued:
        return ""
    try:
        measurement = catalogue_entry(find_effect(finding.effect)).confirming_measurement
    except ModelError:  # an effect of another package, which is not installed here
        return ""
    return f"; confirmed by {measurement}" if measurement else ""


def is_name_exchange(finding: Finding) -> bool:
    """True if the finding is that the names of two reflectors were exchanged."""
    return finding.effect == "target-swap" and len(finding.where.targets) == 2
