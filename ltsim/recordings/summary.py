"""Summary of the content of a recording, which the user compares with the field book."""

from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.notation import names_text
from ltsim.core.units import DEGREE
from ltsim.recordings.recording import HEIGHT_COLUMNS, SIGMA_COLUMNS, Recording
from ltsim.recordings.setup import Noise

MAX_NAMES_IN_SUMMARY = 6
"""Largest number of names of set-ups, or of different noises, in a line of the summary."""


def recording_summary(recording: Recording) -> dict[str, str]:
    """Summary of a recording, one text by topic (set-ups, pointings, faces, readings, heights, time, noise, ...)."""
    topics = {
        "set-ups": _setups_text(recording),
        "pointings": _pointings_text(recording),
        "faces": _faces_text(recording),
        "readings": _readings_text(recording),
        "heights": _heights_text(recording),
        "time": _time_text(recording),
        "noise": recording_noise_text(recording),
        "known": _reference_values_text(recording),
    }
    return {topic: words for topic, words in topics.items() if words}


def _setups_text(recording: Recording) -> str:
    """Text on the set-ups: number, names, survey marks under them, levelling."""
    setups = {name: recording.station_setup(name) for name in recording.stations}
    marks_of_setups = [s.over for s in setups.values() if s.over is not None]
    part_text = "" if len(marks_of_setups) == len(setups) else f", {len(marks_of_setups)} of them"
    over_marks = f"{part_text} over {len({*marks_of_setups})} marks" if marks_of_setups else ""
    n_levelled = sum(s.levelled for s in setups.values())
    levelled_text = f"; {'all' if n_levelled == len(setups) else n_levelled or 'none'} levelled"
    return f"{len(setups)}{over_marks} ({names_text(list(setups), MAX_NAMES_IN_SUMMARY)}){levelled_text}"


def _pointings_text(recording: Recording) -> str:
    """Text on the pointings: number, targets, pointings per set-up, repeats."""
    per_station = np.bincount(recording.station, minlength=len(recording.stations))
    per_station_text = _range_text(per_station.astype(np.float64), "d")
    n_rounds = int(recording.repeat.max(initial=1))
    repeats_text = f", up to {n_rounds} of a target in one face" if n_rounds > 1 else ""
    return f"{len(recording)} to {len(recording.targets)} targets, {per_station_text} per set-up{repeats_text}"


def _faces_text(recording: Recording) -> str:
    """Text on the faces: one face only, or the number of sights in both faces."""
    sights = {face: {*_station_target_pairs_on_face(recording, face)} for face in (1, 2)}
    n_sights, n_two_face_sights = len(sights[1] | sights[2]), len(sights[1] & sights[2])
    if not n_two_face_sights:
        return f"face {1 if sights[1] else 2} only"
    return (
        "every target in both" if n_two_face_sights == n_sights else f"{n_two_face_sights} of {n_sights} sights in both"
    )


def _station_target_pairs_on_face(recording: Recording, face: int) -> list[tuple[int, int]]:
    """Index pairs (station, target) with a pointing in this face."""
    is_on_face = recording.face == face
    return list(zip(recording.station[is_on_face].tolist(), recording.target[is_on_face].tolist(), strict=True))


def _readings_text(recording: Recording) -> str:
    """Text on the readings: number and span of distances, azimuths and elevations."""
    counts = recording.is_measured.sum(axis=0)
    n_horizontal = int((recording.is_horizontal_distance & recording.is_measured[:, 0]).sum())
    horizontal_text = ""
    if n_horizontal:
        horizontal_text = " (horizontal)" if n_horizontal == counts[0] else f" ({n_horizontal} of them horizontal)"
    distances = (
        f"{counts[0]} distances{horizontal_text} of {_range_text(recording.readings[:, 0], '.4g')} m"
        if counts[0]
        else "no distances"
    )
    elevations = np.where(recording.face == 2, np.pi - recording.readings[:, 2], recording.readings[:, 2]) / DEGREE
    angles = f"{counts[2]} elevations of {_range_text(elevations, '.3g')} deg" if counts[2] else "no elevations"
    return f"{distances}, {counts[1]} azimuths, {angles}"


def _heights_text(recording: Recording) -> str:
    """Text on the heights of instruments and targets above survey marks; empty without heights."""
    instrument, target = recording.heights_above_marks()
    if not instrument.any() and not target.any():
        given = recording.setup.height_above_mark_sigma_mm
        return "none" if given is None else f"of the heads over their marks: not applied, sigma {given:g} mm"
    origin = " (by row)" if any(name in recording.covariates for name in HEIGHT_COLUMNS) else ""
    return (
        f"instruments {_range_text(instrument, '.4g')} m, targets {_range_text(target, '.4g')} m over their "
        f"marks{origin}"
    )


def _time_text(recording: Recording) -> str:
    """Text on the time: start and duration, or that there is no clock."""
    if not recording.has_clock or not np.isfinite(recording.time).any():
        return "no clock: the order of the rows replaces the time"
    seconds = float(np.nanmax(recording.time) - np.nanmin(recording.time))
    hours, rest_s = divmod(round(seconds), 3600)
    start_text = f"from {recording.setup.started} on, " if recording.setup.started else ""
    return f"{start_text}{hours} h {rest_s // 60:02d} min {rest_s % 60:02d} s"


def recording_noise_text(recording: Recording) -> str:
    """Text on the declared standard deviations of each instrument, or "declared per row" for columns of them."""
    instrument_by_noise = {recording.instrument_of(name).noise: name for name in reversed(recording.stations)}
    words = [noise_text(noise) for noise in instrument_by_noise]
    if len(words) > 1:
        words = [
            f"{text} ({instrument_by_noise[noise]})" for noise, text in zip(instrument_by_noise, words, strict=True)
        ]
    row_fractions = [
        np.isfinite(recording.covariates[name]).mean() for name in SIGMA_COLUMNS if name in recording.covariates
    ]
    row_texts = ["declared per row"] if row_fractions else []
    return "; ".join([*row_texts, *words][:MAX_NAMES_IN_SUMMARY])


def noise_text(noise: Noise) -> str:
    """Standard deviations of an instrument's readings as text, in the form of data sheets ("3 um + 0.3 ppm, ...")."""
    constant = f"{1e3 * noise.distance_mm:.3g} um" if noise.distance_mm < 0.1 else f"{noise.distance_mm:.3g} mm"
    return (
        f"{constant} + {noise.distance_ppm:.3g} ppm, {noise.azimuth_arcsec:.3g} arcsec across, "
        f"{noise.elevation_arcsec:.3g} arcsec in elevation"
    )


def _reference_values_text(recording: Recording) -> str:
    """Text on the known values: control points, lengths, differences, rough positions of set-ups."""
    setup = recording.setup
    counts = {
        "control points": sum(t.known_mm is not None for t in setup.targets.values()),
        "lengths": len(recording.gauge.distance),
        "differences": len(setup.differences),
        "rough positions of set-ups": sum(s.position_mm is not None for s in setup.stations.values()),
    }
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count) or "nothing"


def _range_text(values: Floats | Sequence[float], number_format: str) -> str:
    """Text with the smallest and largest finite value, such as "3 to 8"; `number_format` is "d" or like ".4g"."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    low, high = (format(int(v) if number_format == "d" else v, number_format) for v in (finite.min(), finite.max()))
    return low if low == high else f"{low} to {high}"
