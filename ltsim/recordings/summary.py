"""Summary of a recording, for a check against the field book before any computation."""

from collections.abc import Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.notation import listing
from ltsim.core.units import DEGREE
from ltsim.recordings.recording import HEIGHT_COLUMNS, SIGMA_COLUMNS, Recording
from ltsim.recordings.setup import Noise

MAX_NAMES_IN_SUMMARY = 6
"""Largest number of names that a topic of the summary lists."""


def recording_summary(recording: Recording) -> dict[str, str]:
    """Set-ups, rounds, faces, readings, heights, time, noise and reference values of a recording, as text by topic."""
    topics = {
        "set-ups": _setups_text(recording),
        "pointings": _pointings_text(recording),
        "faces": _faces_text(recording),
        "readings": _readings_text(recording),
        "heights": _heights_text(recording),
        "time": _time_text(recording),
        "noise": _noise_text(recording),
        "known": _reference_values_text(recording),
    }
    return {topic: words for topic, words in topics.items() if words}


def _setups_text(recording: Recording) -> str:
    setups = {name: recording.station_setup(name) for name in recording.stations}
    over_mark = [s.over for s in setups.values() if s.over is not None]
    some = "" if len(over_mark) == len(setups) else f", {len(over_mark)} of them"
    over = f"{some} over {len({*over_mark})} marks" if over_mark else ""
    level = sum(s.levelled for s in setups.values())
    levelled = f"; {'all' if level == len(setups) else level or 'none'} levelled"
    return f"{len(setups)}{over} ({listing(list(setups), MAX_NAMES_IN_SUMMARY)}){levelled}"


def _pointings_text(recording: Recording) -> str:
    per_station = np.bincount(recording.station, minlength=len(recording.stations))
    each = _range_text(per_station.astype(np.float64), "d")
    rounds = int(recording.repeat.max(initial=1))
    repeated = f", up to {rounds} of a target in one face" if rounds > 1 else ""
    return f"{len(recording)} to {len(recording.targets)} targets, {each} per set-up{repeated}"


def _faces_text(recording: Recording) -> str:
    sights = {face: {*_n_sighted(recording, face)} for face in (1, 2)}
    every, both = len(sights[1] | sights[2]), len(sights[1] & sights[2])
    if not both:
        return f"face {1 if sights[1] else 2} only"
    return "every target in both" if both == every else f"{both} of {every} sights in both"


def _n_sighted(recording: Recording, face: int) -> list[tuple[int, int]]:
    rows = recording.face == face
    return list(zip(recording.station[rows].tolist(), recording.target[rows].tolist(), strict=True))


def _readings_text(recording: Recording) -> str:
    counts = recording.is_measured.sum(axis=0)
    suffix = " (horizontal ones)" if recording.is_horizontal.any() else ""
    distances = (
        f"{counts[0]} distances{suffix} of {_range_text(recording.readings[:, 0], '.4g')} m"
        if counts[0]
        else "no distances"
    )
    elevations = np.where(recording.face == 2, np.pi - recording.readings[:, 2], recording.readings[:, 2]) / DEGREE
    angles = f"{counts[2]} elevations of {_range_text(elevations, '.3g')} deg" if counts[2] else "no elevations"
    return f"{distances}, {counts[1]} azimuths, {angles}"


def _heights_text(recording: Recording) -> str:
    instrument, target = recording.heights()
    if not instrument.any() and not target.any():
        given = recording.setup.heads_sigma_mm
        return "none" if given is None else f"between heads, each known to {given:g} mm"
    origin = " (by row)" if any(name in recording.covariates for name in HEIGHT_COLUMNS) else ""
    return (
        f"instruments {_range_text(instrument, '.4g')} m, targets {_range_text(target, '.4g')} m over their "
        f"marks{origin}"
    )


def _time_text(recording: Recording) -> str:
    if not recording.has_clock or not np.isfinite(recording.time).any():
        return "no clock: the order of the rows replaces the time"
    seconds = float(np.nanmax(recording.time) - np.nanmin(recording.time))
    hours, rest = divmod(round(seconds), 3600)
    began = f"from {recording.setup.started} on, " if recording.setup.started else ""
    return f"{began}{hours} h {rest // 60:02d} min {rest % 60:02d} s"


def _noise_text(recording: Recording) -> str:
    by_name = {recording.instrument_of(name).noise: name for name in reversed(recording.stations)}
    words = [noise_text(noise) for noise in by_name]
    if len(words) > 1:
        words = [f"{text} ({by_name[noise]})" for noise, text in zip(by_name, words, strict=True)]
    shares = [np.isfinite(recording.covariates[name]).mean() for name in SIGMA_COLUMNS if name in recording.covariates]
    by_row = ["declared per row"] if shares else []
    return "; ".join([*by_row, *words][:MAX_NAMES_IN_SUMMARY])


def noise_text(noise: Noise) -> str:
    """Noise of an instrument as text, in the form of a data sheet."""
    constant = f"{1e3 * noise.distance_mm:.3g} um" if noise.distance_mm < 0.1 else f"{noise.distance_mm:.3g} mm"
    return (
        f"{constant} + {noise.distance_ppm:.3g} ppm, {noise.azimuth_arcsec:.3g} arcsec across, "
        f"{noise.elevation_arcsec:.3g} arcsec in elevation"
    )


def _reference_values_text(recording: Recording) -> str:
    setup = recording.setup
    counts = {
        "control points": sum(t.known_mm is not None for t in setup.targets.values()),
        "lengths": len(recording.gauge.distance),
        "differences": len(setup.differences),
        "rough places of set-ups": sum(s.position_mm is not None for s in setup.stations.values()),
    }
    return ", ".join(f"{count} {what}" for what, count in counts.items() if count) or "nothing"


def _range_text(values: Floats | Sequence[float], form: str) -> str:
    """Smallest and largest of some numbers, as text."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    low, high = (format(int(v) if form == "d" else v, form) for v in (finite.min(), finite.max()))
    return low if low == high else f"{low} to {high}"
