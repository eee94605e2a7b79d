"""Sentences for the user on the results of the tests of a field check."""

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment.fieldcheck.setup_model import AddedColumnsFit, SetupModel, TwoFaceDifferences
from ltsim.adjustment.significance import MIN_SIGNIFICANT_SIGMAS
from ltsim.core.arrays import Ints
from ltsim.core.notation import names_text, with_sigma
from ltsim.core.units import ARCSECOND, MICROMETRE, MICRORADIAN, MILLIMETRE
from ltsim.recordings.recording import OBSERVABLES, Recording
from ltsim.recordings.specification import noise_origin

ZERO_DRIFT_UNITS_AND_MAX_SIGMAS = (
    ("range", "um", MICROMETRE, 100 * MICROMETRE),
    ("vertical index", "arcsec", ARCSECOND, 100 * ARCSECOND),
)
"""Zeros of an instrument that may drift: name, unit, size of the unit [SI], and limit [SI] of the standard deviation of
the drift over the occupation. A sentence reports the drift if its standard deviation is smaller."""
TRANSLATION_COMPONENTS = slice(0, 3)
"""Slice with the translation [m] among the six components of a station's motion."""
TILT_COMPONENTS = slice(3, 5)
"""Slice with both tilts of the standing axis [rad] among the six components of a station's motion."""
AZIMUTH_COMPONENT = slice(5, 6)
"""Slice with the rotation about the standing axis [rad] among the six components of a station's motion."""
MAX_REPORTED_TILT_SIGMA = 100 * MICRORADIAN
"""Limit of the standard deviation [rad] of a station's tilt. A sentence reports the tilt only if its standard deviation
is smaller."""


def estimated_noise_text(recording: Recording, declared_recording: Recording) -> str:
    """Text on the estimated noise of a recording relative to the declared noise, by observable; empty if equal.

    `declared_recording` is the same recording with the declared noise.
    """
    if not len(recording):
        return ""
    ratios = recording.reading_sigmas() / declared_recording.reading_sigmas()
    names_by_size: dict[str, list[str]] = {}
    origin = noise_origin(declared_recording.notes)
    for name, low, high in zip(OBSERVABLES, np.nanmin(ratios, axis=0), np.nanmax(ratios, axis=0), strict=True):
        sizes = list(dict.fromkeys(number_text(ratio, 2) for ratio in (low, high)))
        if sizes != ["1"]:
            names_by_size.setdefault(" to ".join(sizes), []).append(name)
    if len(names_by_size) == 1 and set(*names_by_size.values()) == set(OBSERVABLES):
        return f"the estimated noise is {next(iter(names_by_size))} times the {origin} noise"
    parts = [f"{size} times the {origin} noise of {' and '.join(names)}" for size, names in names_by_size.items()]
    return f"the estimated noise is {' and '.join(parts)}" if parts else ""


def two_face_sentence(
    differences: TwoFaceDifferences, recording: Recording, limit_text: str
) -> tuple[str, tuple[str, ...], Ints]:
    """Sentence on the two-face differences, names of targets with differences beyond the limit, and pointing indices.

    The indices (2,) are those of the pair with the largest ratio of difference to limit; they are empty without a
    difference beyond the limit. `limit_text` names the limit, such as "noise and specification".
    """
    name, pairs = recording.stations[0], differences.motion_corrected_pairs
    if not differences.exceeds_limit.any():
        rms = pairs.rms_half_differences
        sizes = f"{rms[0] / MICROMETRE:.1f} um, {rms[1] / ARCSECOND:.2f} and {rms[2] / ARCSECOND:.2f}"
        sentence = (
            f"{name}: the half two-face differences of {len(pairs)} pairs are within {limit_text}, rms {sizes} arcsec "
            "(range, across the beam, elevation)"
        )
        return sentence, (), np.zeros(0, dtype=np.int64)
    targets = [recording.targets[t] for t in recording.target[pairs.pointing_indices[:, 0]]]
    ratio = np.abs(pairs.half_differences) / differences.half_difference_limits
    k, column = (int(i) for i in np.unravel_index(int(ratio.argmax()), ratio.shape))
    unit, factor = ("um", MICROMETRE) if column == 0 else ("arcsec", ARCSECOND)
    beyond = np.flatnonzero(differences.exceeds_limit.any(axis=1))
    observable = (OBSERVABLES[0], "azimuth across the beam", OBSERVABLES[2])[column]
    sentence = (
        f"{name}: the two faces differ beyond {limit_text} at {len(beyond)} of {len(pairs)} pairs, "
        f"most at {targets[k]}: half the difference in {observable} is "
        f"{number_text(pairs.half_differences[k, column] / factor)} {unit}, "
        f"the limit {number_text(differences.half_difference_limits[k, column] / factor)} {unit}"
    )
    return sentence, tuple(dict.fromkeys(targets[i] for i in beyond)), pairs.pointing_indices[k]


def gross_pointing_sentence(setup_model: SetupModel, outlier_indices: Sequence[int], row_numbers: Ints) -> str:
    """Sentence on the outliers among the n pointings of a set-up.

    `outlier_indices` are the indices of the outliers, the largest first. `row_numbers` (n,) are the row numbers of all
    pointings of the set-up in the whole recording, from 1.
    """
    recording, name = setup_model.recording, setup_model.recording.stations[0]
    if not outlier_indices:
        return f"{name}: no outlier"
    first_target = recording.targets[recording.target[outlier_indices[0]]]
    rows_of_target = np.flatnonzero(recording.target == recording.target[outlier_indices[0]])
    other_rows = names_text([str(row_numbers[i]) for i in outlier_indices[1:]])
    others_text = (
        f", and so is row {other_rows}"
        if len(outlier_indices) == 2
        else f", and so are rows {other_rows}"
        if other_rows
        else ""
    )
    distance = setup_model.distance_from_mean_of_others(outlier_indices[0])
    row_text = f"{name} to {first_target}: row {row_numbers[outlier_indices[0]]}"
    if not np.isfinite(distance):
        return f"{row_text} does not fit the other readings and is an outlier{others_text}: measure again"
    if len(rows_of_target) == 2:
        both = " and ".join(str(row_numbers[i]) for i in rows_of_target)
        pair = f"rows {both} are {length_text(distance)} apart"
        return f"{name} to {first_target}: {pair}, one of them is an outlier{others_text}: measure again"
    return (
        f"{row_text} is {length_text(distance)} from the other pointings to this target "
        f"and is an outlier{others_text}: measure again"
    )


def bump_sentence(recording: Recording, motion_interval_text: str, fit: AddedColumnsFit) -> str:
    """Sentence on a sudden motion of a station: `motion_interval_text` and the sizes from the fit of the motion."""
    return f"{recording.stations[0]} moved {motion_interval_text}{_motion_text(fit)}"


def station_drift_sentence(recording: Recording, fit: AddedColumnsFit, passed: bool) -> str:
    """Sentence on the drift of a station during its occupation, or on its tilt if the test passed."""
    name = recording.stations[0]
    minutes = float(np.ptp(recording.time)) / 60
    within = f"in {minutes:.3g} min" if recording.has_clock else f"over {len(recording)} pointings"
    if not passed:
        return f"{name} drifts {within}{_motion_text(fit)}"
    tilt, sigma = fit.estimate_length_and_sigma(TILT_COMPONENTS)
    if not sigma < MAX_REPORTED_TILT_SIGMA:
        return f"{name}: no drift of the station detected {within}; the repeated pointings hardly determine its tilt"
    tilt_text = with_sigma(tilt / MICRORADIAN, sigma / MICRORADIAN, "urad")
    return f"{name}: no drift of the station detected {within} (change of its tilt {tilt_text})"


def zero_drift_sentence(recording: Recording, fit: AddedColumnsFit, passed: bool) -> str:
    """Sentence on the drift of range zero and vertical index of an instrument during its occupation.

    The estimates of the fit are corrections (true value minus reading); the sentence states the change of the readings,
    or no drift if the test `passed`.
    """
    duration = float(np.ptp(recording.time))
    drift_sigmas = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    change_texts = [
        f"{zero_name} by {with_sigma(-value * duration / unit, sigma * duration / unit, unit_name)}"
        for value, sigma, (zero_name, unit_name, unit, max_sigma) in zip(
            fit.estimates, drift_sigmas, ZERO_DRIFT_UNITS_AND_MAX_SIGMAS, strict=True
        )
        if duration > 0.0 and sigma * duration < max_sigma
    ]
    unknown_drift_text = "; the repeated pointings hardly determine its size"
    change_text = f" ({', '.join(change_texts)} over the occupation; positive: the readings grow with time)"
    drift_text = change_text if change_texts else unknown_drift_text
    verdict = "no drift of the instrument detected" if passed else "the instrument drifts"
    return f"{recording.stations[0]}: {verdict}{drift_text}"


def target_scatter_sentence(setup_model: SetupModel, target_indices: Ints) -> tuple[str, tuple[str, ...]]:
    """Sentence on the scatter of the pointings to k targets, and the names of the noisier half of these targets.

    `target_indices` (k,) are the indices of the targets, those with the largest scatter first.
    """
    recording = setup_model.recording
    names = [recording.targets[t] for t in target_indices]
    sigma_texts = [length_text(setup_model.target_repeatability(int(t))) for t in target_indices]
    low, high = (f"{sigma_texts[i]} at {names[i]}" for i in (-1, 0))
    sentence = f"the targets cause this scatter ({low} to {high} along each axis), not distance or air"
    return sentence, tuple(names[: (len(names) + 1) // 2])


def _motion_text(fit: AddedColumnsFit) -> str:
    """Text of the significant parts of a station's motion (shift, turn, tilt); empty if none is significant."""
    kinds = (
        ("shifted", TRANSLATION_COMPONENTS, "um", MICROMETRE),
        ("turned", AZIMUTH_COMPONENT, "urad", MICRORADIAN),
        ("tilted", TILT_COMPONENTS, "urad", MICRORADIAN),
    )
    motion_sizes = [
        (verb, *fit.estimate_length_and_sigma(columns), unit, factor) for verb, columns, unit, factor in kinds
    ]
    motion_texts = [
        f"{verb} by {with_sigma(size / factor, sigma / factor, unit)}"
        for verb, size, sigma, unit, factor in motion_sizes
        if size > MIN_SIGNIFICANT_SIGMAS * sigma
    ]
    return f": {', '.join(motion_texts)}" if motion_texts else ""


def length_text(length_m: float) -> str:
    """Length with its unit as text, in mm above 1 mm and otherwise in um."""
    unit, factor = ("mm", MILLIMETRE) if length_m > MILLIMETRE else ("um", MICROMETRE)
    return f"{number_text(length_m / factor)} {unit}"


def number_text(value: float, digits: int = 3) -> str:
    """Number as text with `digits` significant digits and without exponent, such as 2710 instead of 2.71e+03."""
    return f"{float(f'{value:.{digits}g}'):.6g}"
