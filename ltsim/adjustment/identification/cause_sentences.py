"""Sentences for the user on identified errors, with their sizes and usual causes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CentringChange,
    CoordinateExchange,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
    RowCorrection,
)
from ltsim.adjustment.identification.noise_sentences import noise_sentence
from ltsim.adjustment.identification.nominal_offsets import offset_cause_text, smr_exchange_text
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.identification.reference_misclosures import misclosure_estimate, reference_error_and_covariance
from ltsim.adjustment.reference_tests import is_in_height_alone, length_sigma
from ltsim.core.arrays import Floats
from ltsim.core.notation import names_text, number_text, with_sigma
from ltsim.core.units import ARCSECOND, MICROMETRE, MICRORADIAN, MILLIMETRE, PPM, SI_PER_UNIT
from ltsim.physics.effects.scale_causes import has_temperature_cause, temperature_errors_text, unit_error_text
from ltsim.physics.effects.station_settling import StationSettling
from ltsim.physics.effects.target_moved import TargetMoved, moved_coordinates_sentence
from ltsim.physics.laws.variance import shared_errors_sentence
from ltsim.recordings.references import common_expansion_per_k
from ltsim.recordings.times import interval_text


def estimate_sigma_and_unit(
    hypothesis: CauseHypothesis, shift_components: Floats, covariance: Floats
) -> dict[str, Any]:
    """Dictionary with the size of a shift of readings: `estimate`, `sigma` and `unit`.

    The size is the parameter, or the length of the first three of p parameters (of both tilts if a station settles):
    `shift_components` (p,) with the covariance `covariance` (p, p) [SI].
    """
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    unit, factor = ("mm", MILLIMETRE)
    if isinstance(hypothesis.model_change.effect, ReadingShift):
        unit, factor = ("ppm", PPM) if hypothesis.kind == "scale-error" else (unit, factor)
        unit, factor = ("arcsec", ARCSECOND) if hypothesis.acts_on in ("azimuth", "elevation") else (unit, factor)
    if hypothesis.kind == "reference-scale":
        unit, factor = "ppm", PPM
    n_components = 3
    if isinstance(hypothesis.model_change.effect, StationSettling):  # two tilts; the rise is in the sentence
        unit, factor, n_components = "urad", MICRORADIAN, 2
    part, spread = shift_components[:n_components], covariance[:n_components, :n_components]
    estimated_size = float(part[0]) if len(part) == 1 else float(np.linalg.norm(part))
    return {"estimate": estimated_size / factor, "sigma": length_sigma(part, spread) / factor, "unit": unit}


CAUSE_PHRASE_BY_REFERENCE_KIND = {
    "point": "The reference coordinates of",
    "difference": "The reference difference",
    "length": "The reference length",
    "level": "The level of",
    "yaw": "The azimuth zero of",
    "mark": "The set-up of",
    "scale": "The scale of",
}
"""First words of a sentence on a wrong reference value, by its kind; the name of the value follows them."""


def cause_sentence(fit: NetworkFit, hypothesis: CauseHypothesis, rival_names: Sequence[str] = ()) -> str:
    """Sentence for the user on an identified error (the selected hypothesis), with its size and usual causes.

    For a wrong reference value, `rival_names` are the names of other reference values that may be wrong in its place.
    """
    if isinstance(hypothesis.model_change, CentringChange):
        return _centring_sentence(fit, hypothesis)
    if isinstance(hypothesis.model_change, ReferenceOmission):
        return _reference_sentence(fit, hypothesis, rival_names)
    return _sentence_on_other_causes(fit, hypothesis)


def _reference_sentence(fit: NetworkFit, hypothesis: CauseHypothesis, rival_names: Sequence[str]) -> str:
    """Sentence for the user on a wrong reference value; `rival_names` are values that may be wrong in its place."""
    assert isinstance(hypothesis.model_change, ReferenceOmission)
    estimate, sigma, unit = misclosure_estimate(fit, hypothesis).values()
    size_text = f"{_number_text(estimate)} {unit}" if sigma is None else with_sigma(estimate, sigma, unit)
    plural = hypothesis.model_change.reference_value.kind == "point"
    verb, them = ("are", "them") if plural else ("is", "it")
    words = CAUSE_PHRASE_BY_REFERENCE_KIND[hypothesis.model_change.reference_value.kind]
    phrase = f"{words} {hypothesis.reference_name_or_sentence} {verb} off by {size_text}"
    if height_text := _mark_height_text(fit, hypothesis):
        return f"{phrase}, {height_text}."
    if scale_text := _equivalent_scale_text(fit, hypothesis):
        return f"{phrase}, or {scale_text}: check both."
    if rival_names:
        return f"{phrase}, or those of {names_text(rival_names)} are wrong: check each."
    return f"{phrase}: check {them}."


def _mark_height_text(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Clause on a set-up that is above or below its mark and at no other horizontal position; otherwise empty."""
    assert isinstance(hypothesis.model_change, ReferenceOmission)
    if hypothesis.model_change.reference_value.kind != "mark":
        return ""
    error_and_covariance = reference_error_and_covariance(fit, hypothesis)
    if error_and_covariance is None:
        return ""
    error, covariance = error_and_covariance
    if not is_in_height_alone(error, np.sqrt(np.diag(covariance))):
        return ""
    side, declared = ("above", "low") if error[-1] > 0 else ("below", "high")
    return f"{side} its mark: check the height of the instrument, which is declared too {declared}"


def _equivalent_scale_text(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Clause on the scale error of all distances that a wrong reference length may be; empty for other values.

    It is empty too if another length, or two points with reference coordinates, determine the scale.
    """
    n_reference_points = sum(fit.recording.target_setup(name).known_mm is not None for name in fit.recording.targets)
    if hypothesis.acts_on != "length" or fit.recording.gauge.distance or n_reference_points > 1:
        return ""
    assert isinstance(hypothesis.model_change, ReferenceOmission)
    value = hypothesis.model_change.reference_value
    declared = fit.fit_input.recording.gauge.distance
    length = next(d.length_mm * MILLIMETRE for d in declared if f"{d.from_}-{d.to}" == value.name)
    scale = -float(fit.misclosure_of(value)[0]) / length
    reason = f" ({text})" if (text := unit_error_text(scale)) else ""
    direction = "long" if scale > 0 else "short"
    return f"the distances from all stations are {_number_text(abs(scale) / PPM)} ppm too {direction}{reason}"


def _sentence_on_other_causes(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Sentence for the user on an identified shift of readings, noise other than declared, or a blunder.

    Centring errors have a separate function.
    """
    place_names = ", ".join((*hypothesis.stations, *hypothesis.targets))
    if isinstance(hypothesis.model_change, RowCorrection | CoordinateExchange):
        return hypothesis.reference_name_or_sentence
    if isinstance(hypothesis.model_change, NoiseFactorChange):
        return noise_sentence(fit, hypothesis)
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    values, covariance = fit.estimate_and_covariance(hypothesis)
    estimate = estimate_sigma_and_unit(hypothesis, values, covariance)
    if isinstance(hypothesis.model_change.effect, ReadingShift) and hypothesis.kind != "orientation":
        return _observable_sentence(fit, hypothesis, estimate)
    size_text = f"{with_sigma(abs(estimate['estimate']), estimate['sigma'], estimate['unit'])}"
    effect = hypothesis.model_change.effect
    if hypothesis.kind == "reference-scale":
        causes = "the declared temperature or expansion, or the scale of the distances, is wrong"
        expansion = common_expansion_per_k(fit.adjustment.recording.gauge)
        reason = temperature_errors_text(float(values[0]), expansion_per_k=expansion)
        return f"The reference lengths and the distances differ in scale by {size_text}: {causes} ({reason})."
    if hypothesis.kind == "reflector-radius":
        cause = smr_exchange_text(float(values[0]), float(np.sqrt(covariance[0, 0]))) or "another SMR radius"
        side = "away from" if values[0] > 0 else "towards"
        return (
            f"At {place_names} the centres of the SMRs are displaced by {size_text} "
            f"along the normals of their nests, {side} the nests: {cause}."
        )
    if hypothesis.kind == "reflector-seating":
        row_numbers = seating_row_numbers(fit, hypothesis)
        rows_text = f"row{'s' if len(row_numbers) > 1 else ''} {names_text([str(row) for row in row_numbers])}"
        return (
            f"The reflector at {hypothesis.targets[0]} was displaced by {size_text} while {hypothesis.stations[0]} "
            f"measured it ({rows_text}): dirt in the nest, or another nest."
        )
    if hypothesis.kind == "station-drift":
        return f"Station {place_names} moved at a constant rate during its occupation, by {size_text} in total."
    if isinstance(effect, StationSettling):
        rise_text = with_sigma(values[2] / MICROMETRE, float(np.sqrt(covariance[2, 2])) / MICROMETRE, "um")
        return (
            f"Station {place_names} settled after its set-up with a time constant of "
            f"{number_text(effect.time_constant / SI_PER_UNIT['min'], 2)} min: it tilted by {size_text} and rose by "
            f"{rise_text} in total."
        )
    interval = _interval_text(fit, hypothesis)
    if hypothesis.kind == "orientation":
        return f"The horizontal circle of {place_names} was turned by {size_text} {interval}."
    if hypothesis.kind == "station-bump":
        turn, sigma = values[3:], length_sigma(values[3:], covariance[3:, 3:])
        turned = with_sigma(float(np.linalg.norm(turn)) / MICRORADIAN, sigma / MICRORADIAN, "urad")
        return f"Station {place_names} moved {interval}, by {size_text} and {turned}."
    assert isinstance(effect, TargetMoved)
    components = (values / MILLIMETRE, np.sqrt(np.diag(covariance)) / MILLIMETRE)
    parts = (f"d{axis} {with_sigma(value, sigma)}" for axis, value, sigma in zip("xyz", *components, strict=True))
    state, first_station = fit.state, fit.recording.stations[0]
    is_frame_of_station = np.allclose(
        np.vstack([state.station_positions[:1], state.station_rotations[0] - np.eye(3)]), 0
    )
    axes = f" along the axes of {first_station}" if is_frame_of_station else ""
    seating = _equivalent_seating_text(fit, effect)
    motion = f"Target {place_names} moved {interval}, by {size_text} ({', '.join(parts)} mm{axes}){seating}."
    return f"{motion} {moved_coordinates_sentence(hypothesis.targets)}"


def _equivalent_seating_text(fit: NetworkFit, motion: TargetMoved) -> str:
    """Clause on a badly seated reflector, if all pointings before or after a motion are from one station; or empty.

    These readings do not distinguish a motion of the target from a reflector that was badly seated at this station.
    """
    sightings = fit.adjustment.sightings
    is_at_target, is_after = motion.pointing_indicator(sightings) > 0, sightings.time >= motion.time
    for is_on_side, consequence in ((is_after, ""), (~is_after, " (its coordinates are then those of the bad seat)")):
        stations = np.unique(sightings.station[is_at_target & is_on_side])
        if len(stations) == 1:
            name = sightings.station_names[stations[0]]
            return f", or the reflector was badly seated while {name} measured it{consequence}"
    return ""


def seating_row_numbers(fit: NetworkFit, hypothesis: CauseHypothesis) -> tuple[int, ...]:
    """Row numbers, from 1, of the pointings to the badly seated reflector of a hypothesis, from its station."""
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    is_affected = hypothesis.model_change.effect.pointing_indicator(fit.adjustment.sightings)
    return tuple((np.flatnonzero(is_affected) + 1).tolist())


OBSERVABLE_CAUSE_TEXTS = {
    ("constant-offset", "distance", "station"): "another SMR, or a wrong distance constant",
    ("constant-offset", "distance", "target"): "another SMR or prism",
    ("constant-offset", "elevation", "station"): "the vertical index differs at this set-up",
    ("constant-step", "distance", "station"): "another SMR, or the beam was interrupted",
    ("constant-step", "elevation", "station"): "the vertical index differs afterwards",
    ("constant-drift", "distance", "station"): "a drift of the range zero",
    ("constant-drift", "elevation", "station"): "a drift of the vertical index",
    ("constant-drift", "azimuth", "station"): "the horizontal circle or the tripod head turns",
    ("scale-error", "distance", "station"): "a wrong atmospheric correction or unit",
    ("scale-error", "distance", "all stations"): (
        "a wrong atmospheric correction or unit, or another temperature of the object with the reference values"
    ),
}
"""Text on the usual cause of a shift of one observable, by kind of the error, observable, and place: `station`,
`target` or `all stations`; for `all stations` without text the text for `station` applies."""


def _observable_sentence(fit: NetworkFit, hypothesis: CauseHypothesis, estimate: dict[str, Any]) -> str:
    """Sentence for the user on an identified shift of all readings of one observable at a station or target.

    `estimate` contains the size of the shift, its standard deviation and unit.
    """
    place_names = ", ".join((*hypothesis.stations, *hypothesis.targets))
    place, link = ("target", "to") if hypothesis.targets else ("station", "from")
    is_everywhere = not hypothesis.stations and not hypothesis.targets
    cause = OBSERVABLE_CAUSE_TEXTS[hypothesis.kind, hypothesis.acts_on, place]
    if is_everywhere:
        cause = OBSERVABLE_CAUSE_TEXTS.get((hypothesis.kind, hypothesis.acts_on, "all stations"), cause)
    what, number = f"The {hypothesis.acts_on}s {link} {place_names or 'all stations'}", estimate["estimate"]
    change_text, size_text = (with_sigma(x, estimate["sigma"], estimate["unit"]) for x in (number, abs(number)))
    if hypothesis.kind == "constant-step":
        direction = "larger" if number > 0 else "smaller"
        return (
            f"{what} changed by {change_text} {_interval_text(fit, hypothesis)} "
            f"(the readings are {direction} afterwards): {cause}."
        )
    if hypothesis.kind == "constant-drift":
        assert isinstance(hypothesis.model_change, ReadingShiftChange)
        assert isinstance(hypothesis.model_change.effect, ReadingShift)
        interval = "the measurement" if len(hypothesis.stations) == 1 else "the longest occupation"
        if hypothesis.model_change.effect.drift_interval == "recording":
            interval = "the recording"
        direction = "grow" if number > 0 else "decrease"
        return f"{what} drifted by {change_text} during {interval} (the readings {direction} with time): {cause}."
    if hypothesis.acts_on != "distance":
        return f"{what} are {size_text} too {'large' if number > 0 else 'small'}: {cause}."
    if hypothesis.kind == "constant-offset":
        values, covariance = fit.estimate_and_covariance(hypothesis)
        cause = offset_cause_text(float(values[0]), float(np.sqrt(covariance[0, 0]))) or cause
    if hypothesis.kind == "scale-error":
        scale = number * PPM
        reason = temperature_errors_text(scale, is_of_distances=not is_everywhere)
        cause = f"{cause} ({reason})" if has_temperature_cause(scale) else "another unit or a wrong factor"
        cause = unit_error_text(scale) or cause
    return f"{what} are {size_text} too {'long' if number > 0 else 'short'}: {cause}."


def _centring_sentence(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Sentence for the user on identified centring errors at a set-up, on a target, or everywhere, with their size."""
    assert isinstance(hypothesis.model_change, CentringChange)
    sigma = f"{_number_text(float(f'{hypothesis.model_change.centring_uncertainty.sigma_mm:.2g}'))} mm"
    size_text = f"{sigma} (standard deviation)"
    if hypothesis.targets:
        what = f"The reflector on target {hypothesis.targets[0]} was displaced at random at each set-up"
        return f"{what}, by {size_text} along each axis: check its centring."
    if not hypothesis.stations:
        return shared_errors_sentence(sigma)
    station = hypothesis.stations[0]
    common = fit.common_displacement_length(hypothesis)
    if common is None:
        return (
            f"The reflectors seen from {station} are displaced from their targets at random, "
            f"by {size_text} along each axis: "
            f"the reflectors were not centred, or readings from {station} have errors that repeat in all rounds."
        )
    text = with_sigma(abs(common.length) / MILLIMETRE, common.length_sigma / MILLIMETRE, "mm")
    direction_text = "away from" if common.length > 0 else "towards"
    cause = smr_exchange_text(common.length, common.length_sigma) or "another SMR or adaptor"
    return (
        f"At {station} the centres of the SMRs are all displaced by {text}, {direction_text} their nests: {cause}. "
        "Declare the normals of the nests (nest_normal), so that the displacement is estimated along these normals."
    )


def _interval_text(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Text with the times and row numbers of the two pointings between which the error of a hypothesis began."""
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    effect, s = hypothesis.model_change.effect, fit.adjustment.sightings
    since = effect.onset_time if isinstance(effect, ReadingShift) else getattr(effect, "time", -np.inf)
    is_acting = np.ones(len(s), dtype=bool)
    if hypothesis.stations:
        is_acting &= np.isin(s.station, [s.station_names.index(name) for name in hypothesis.stations])
    if hypothesis.targets:
        is_acting &= np.isin(s.target, [s.target_names.index(name) for name in hypothesis.targets])
    acting_rows = s.measurement_order[is_acting[s.measurement_order]]
    index = int(np.searchsorted(s.time[acting_rows], since))
    if not 0 < index < len(acting_rows):
        return "during its measurement"
    return interval_text(fit.recording, *acting_rows[index - 1 : index + 1].tolist())


def _number_text(value: float) -> str:
    """Number as text with four significant digits and without exponent."""
    return f"{float(f'{value:.4g}'):.12g}"
