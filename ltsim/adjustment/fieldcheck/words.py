"""Sentences of a check, with a unit on every number."""

from collections.abc import Sequence
from datetime import datetime, time as clock, timedelta

import numpy as np

from ltsim.adjustment.fieldcheck.occupation import ColumnsFit, StationOccupation, TwoFaceDifferences
from ltsim.core.arrays import Ints
from ltsim.core.notation import listing, with_sigma
from ltsim.core.units import ARCSECOND, MICROMETRE, MICRORADIAN, MILLIMETRE
from ltsim.recordings.recording import OBSERVABLES, Recording

ZERO_NAMES_AND_MAX_SIGMAS = (
    ("range", "um", MICROMETRE, 100 * MICROMETRE),
    ("vertical index", "arcsec", ARCSECOND, 100 * ARCSECOND),
)
"""Zeros of an instrument, with the standard deviation above which a recording does not determine them."""
TRANSLATION_COMPONENTS = slice(0, 3)
"""Components of a station's motion that are translations."""
TILT_COMPONENTS = slice(3, 5)
"""Components of a station's motion that are tilts of the standing axis."""
AZIMUTH_COMPONENT = slice(5, 6)
"""Component of a station's motion that is a rotation about the standing axis."""
MAX_LEVEL_SIGMA = 100 * MICRORADIAN
"""Standard deviation of a level [rad] above which a recording does not determine it."""
MIN_REPORTED_SIGMAS = 2.0
"""Smallest size of a component of a motion, in standard deviations, that is reported."""


def time_text(recording: Recording, time: float) -> str:
    """Time [s] of a recording as text: the clock time if its start is known, otherwise seconds or rows."""
    if not recording.has_clock:
        return f"pointing {time + 1:.0f}"
    started = recording.setup.started
    try:
        return f"{datetime.fromisoformat(started) + timedelta(seconds=time):%Y-%m-%d %H:%M:%S}"
    except ValueError:
        pass
    try:
        start = datetime.combine(datetime(2000, 1, 1), clock.fromisoformat(started))
    except ValueError:
        return f"{time:.1f} s"
    return f"{start + timedelta(seconds=time):%H:%M:%S}"


def face_sentence(
    differences: TwoFaceDifferences, recording: Recording, limit: str
) -> tuple[str, tuple[str, ...], Ints]:
    """Sentence on the two-face differences, targets beyond the limit, and rows of the worst pair there."""
    name, pairs = recording.stations[0], differences.motion_corrected_pairs
    if not differences.exceeds_limit.any():
        sizes = f"{pairs.rms[0] / MICROMETRE:.1f} um, {pairs.rms[1] / ARCSECOND:.2f} and {pairs.rms[2] / ARCSECOND:.2f}"
        sentence = (
            f"{name}: half two-face differences of {len(pairs)} pairs within {limit}, rms {sizes} arcsec "
            "(range, across the beam, elevation)"
        )
        return sentence, (), np.zeros(0, dtype=np.int64)
    targets = [recording.targets[t] for t in recording.target[pairs.rows[:, 0]]]
    ratio = np.abs(pairs.half_differences) / differences.max_half_differences
    k, column = (int(i) for i in np.unravel_index(int(ratio.argmax()), ratio.shape))
    unit, factor = ("um", MICROMETRE) if column == 0 else ("arcsec", ARCSECOND)
    over = np.flatnonzero(differences.exceeds_limit.any(axis=1))
    what = (OBSERVABLES[0], "azimuth across the beam", OBSERVABLES[2])[column]
    sentence = (
        f"{name}: the two faces differ beyond {limit} at {len(over)} of {len(pairs)} pairs, most at {targets[k]}: "
        f"half the difference in {what} is {number_text(pairs.half_differences[k, column] / factor)} {unit}, "
        f"the limit {number_text(differences.max_half_differences[k, column] / factor)} {unit}"
    )
    return sentence, tuple(dict.fromkeys(targets[i] for i in over)), pairs.rows[k]


def gross_sentence(occupation: StationOccupation, gross: Sequence[int], rows: Ints) -> str:
    """Sentence on the outliers among the pointings of a set-up."""
    recording, name = occupation.recording, occupation.recording.stations[0]
    if not gross:
        return f"{name}: no outlier"
    first = recording.targets[recording.target[gross[0]]]
    again = np.flatnonzero(recording.target == recording.target[gross[0]])
    others = listing([str(rows[i]) for i in gross[1:]])
    more = f"; {len(gross)} such pointings in all, with row {others}" if others else ""
    miss = occupation.distance_from_mean(gross[0])
    if not np.isfinite(miss):
        return f"{name} to {first}, row {rows[gross[0]]}: its readings do not fit the others{more}: measure again"
    if len(again) == 2:
        pair = f"rows {rows[again[0]]} and {rows[again[1]]} are {length_text(miss)} apart, one of them is wrong"
        return f"{name} to {first}: {pair}{more}: measure again"
    away = f"{length_text(miss)} from the other pointings to it"
    return f"{name} to {first}, row {rows[gross[0]]}: {away}{more}: measure again"


def bump_sentence(
    recording: Recording, time_interval: tuple[float, float], rows: tuple[int, int], fit: ColumnsFit
) -> str:
    """Sentence on a sudden motion of a station: time and size."""
    when = f"between {time_text(recording, time_interval[0])} and {time_text(recording, time_interval[1])}"
    return f"{recording.stations[0]} moved {when} (rows {rows[0]} and {rows[1]}){_motion_text(fit)}"


def drift_sentence(recording: Recording, fit: ColumnsFit, passed: bool) -> str:
    """Sentence on the drift of a station during its occupation: its level with a standard deviation."""
    name = recording.stations[0]
    minutes = float(np.ptp(recording.time)) / 60
    within = f"in {minutes:.3g} min" if recording.has_clock else f"over {len(recording)} pointings"
    if not passed:
        return f"{name} drifts {within}{_motion_text(fit)}"
    lean, sigma = fit.length_and_sigma(TILT_COMPONENTS)
    if not sigma < MAX_LEVEL_SIGMA:
        return f"{name}: no drift of the station detected {within}; the repeated pointings hardly determine its level"
    level = with_sigma(lean / MICRORADIAN, sigma / MICRORADIAN, "urad")
    return f"{name}: no drift of the station {within} (level {level})"


def instrument_sentence(recording: Recording, fit: ColumnsFit, passed: bool) -> str:
    """Sentence on the drift of the instrument's zeros during an occupation."""
    duration = float(np.ptp(recording.time))
    spread = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    parts = [
        f"{what} by {with_sigma(value * duration / unit, sigma * duration / unit, name)}"
        for value, sigma, (what, name, unit, most) in zip(fit.estimates, spread, ZERO_NAMES_AND_MAX_SIGMAS, strict=True)
        if sigma * duration < most
    ]
    end = f" ({', '.join(parts)} over the occupation)" if parts else "; the repeated pointings hardly determine it"
    return f"{recording.stations[0]}: {'no drift of the instrument' if passed else 'the instrument drifts'}{end}"


def target_sentence(occupation: StationOccupation, scatter_ratios: Ints) -> tuple[str, tuple[str, ...]]:
    """Sentence on targets with large scatter (k,), the largest first, and the names of the upper half."""
    recording = occupation.recording
    names = [recording.targets[t] for t in scatter_ratios]
    sizes = [length_text(occupation.target_point_sigma(int(t))) for t in scatter_ratios]
    low, high = (f"{sizes[i]} at {names[i]}" for i in (-1, 0))
    sentence = f"the targets cause it ({low} to {high} along each axis), not range or air"
    return sentence, tuple(names[: (len(names) + 1) // 2])


def _motion_text(fit: ColumnsFit) -> str:
    """Text of a motion of a station, from the targets that were measured again."""
    kinds = (
        ("shifted", TRANSLATION_COMPONENTS, "um", MICROMETRE),
        ("turned", AZIMUTH_COMPONENT, "urad", MICRORADIAN),
        ("leaning", TILT_COMPONENTS, "urad", MICRORADIAN),
    )
    sizes = [(what, *fit.length_and_sigma(which), unit, factor) for what, which, unit, factor in kinds]
    parts = [
        f"{what} by {with_sigma(size / factor, sigma / factor, unit)}"
        for what, size, sigma, unit, factor in sizes
        if size > MIN_REPORTED_SIGMAS * sigma
    ]
    return f": {', '.join(parts)}" if parts else ""


def length_text(metres: float) -> str:
    """Length as text in a suitable unit."""
    unit, factor = ("mm", MILLIMETRE) if metres > MILLIMETRE else ("um", MICROMETRE)
    return f"{number_text(metres / factor)} {unit}"


def number_text(value: float, digits: int = 3) -> str:
    """Number with `digits` significant digits, large ones without exponent: 2710 and not 2.71e+03."""
    return f"{float(f'{value:.{digits}g}'):.6g}"
