"""Gross errors explained: swapped reflectors, wrong units, mixed-up faces, single bad readings.

A pointing that lands elsewhere by millimetres or more is no matter of statistics. Each is tried against the mistakes
people make; what a mistake explains can be mended, the rest is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.arrays import Bools, Floats, Ints
from ltsim.effects.face_confusion import FaceConfusion
from ltsim.effects.motions import exact_target_change
from ltsim.effects.wrong_unit import WrongUnit
from ltsim.model.measurement import verticals
from ltsim.recording.recording import OBSERVABLES, Recording
from ltsim.recording.slips import FACE_SLIPS, UNIT_SLIPS
from ltsim.units import MILLIMETRE

CLOSE = 1e-3
"""[m] how near a mended pointing must land."""
ASIDE = 0.002
"""Share of a height that a pointing may land aside: nothing else comes down so straight."""
MOST_ROWS = 6


@dataclass(frozen=True)
class GrossFinding:
    """A mistake found in some pointings.

    Attributes
    ----------
    effect : str
        target-swap, wrong-unit, face-confusion or outlier.
    rows : (k,) int
    stations, targets, observables : tuple of str
    size : float
        Displacement [m], or the reading's error for an outlier.
    sentence : str
    """

    effect: str
    rows: Ints
    stations: tuple[str, ...]
    targets: tuple[str, ...]
    observables: tuple[str, ...]
    size: float
    sentence: str


Mend = tuple[GrossFinding, Floats, Ints]
"""A mistake, and what the readings (k, 3) and targets (k,) of its rows should be."""


def explain_gross(adjustment: Adjustment) -> tuple[Recording, Bools, list[GrossFinding]]:
    """Explain the pointings that an adjustment screened out.

    Returns
    -------
    recording : Recording
        With mistakes mended where they are understood.
    use : (n, 3) bool
        Readings to use of it.
    findings : list of GrossFinding
    """
    recording, left = adjustment.recording, adjustment.gross.copy()
    use = np.ones((len(recording), 3), dtype=bool)
    if not left.any():
        return recording, use, []
    readings, target = recording.readings.copy(), recording.target.copy()
    mends = mistakes(adjustment)
    for finding, read, seen in mends:
        readings[finding.rows], target[finding.rows] = read, seen
        left[finding.rows] = False
    outliers = _outliers(adjustment, left)
    for finding in outliers:
        use[finding.rows[0], [OBSERVABLES.index(o) for o in finding.observables or OBSERVABLES]] = False
    return recording.replace(readings=readings, target=target), use, [*(one for one, *_ in mends), *outliers]


def mistakes(adjustment: Adjustment) -> list[Mend]:
    """Mistakes that explain pointings which an adjustment screened out: mended, they land on their target."""
    recording, left = adjustment.recording, adjustment.gross.copy()
    if not left.any():
        return []
    found = _swaps(adjustment, left)
    for finding, *_ in found:
        left[finding.rows] = False
    heights = _heights(adjustment, left)
    for finding, *_ in heights:
        left[finding.rows] = False
    found += heights
    kinds = (WrongUnit.name, UNIT_SLIPS), (FaceConfusion.name, FACE_SLIPS)
    for effect, slip in ((effect, slip) for effect, slips in kinds for slip in slips):
        readings = slip.mended(recording.readings)
        at = np.flatnonzero(left & np.isfinite(readings).all(axis=1))
        rows = at[_misses(adjustment, readings[at], at) < CLOSE]
        if len(rows):
            left[rows] = False
            stations = tuple(sorted({recording.stations[s] for s in recording.station[rows]}))
            targets = tuple(sorted({recording.targets[t] for t in recording.target[rows]}))
            size = float(_misses(adjustment, recording.readings[rows], rows).max())
            where = f"{', '.join(stations)} to {', '.join(targets[:6])}"
            sentence = f"{len(rows)} pointings at station {where} hold {slip.cause}."
            observables = tuple(OBSERVABLES[c] for c in slip.columns)
            finding = GrossFinding(effect, rows, stations, targets, observables, size, sentence)
            found.append((finding, readings[rows], recording.target[rows]))
    return found


def _placed(adjustment: Adjustment, readings: Floats, rows: Ints) -> Floats:
    """Points (k, 3) in the network frame that readings (k, 3) in place of those of some rows (k,) say of targets."""
    station, instrument = adjustment.recording.station[rows], adjustment.recording.instrument[rows]
    local = adjustment.construction.point(readings, adjustment.state.instrument[instrument])
    turned = np.einsum("nij,nj->ni", adjustment.state.rotation[station], local)
    placed: Floats = turned + adjustment.state.position[station]
    lift = adjustment.problem.model.geometry(adjustment.state).lift
    return placed if lift is None else placed - lift[rows]


def _misses(adjustment: Adjustment, readings: Floats, rows: Ints) -> Floats:
    """How far (k,) [m] such points lie from their targets."""
    goal = adjustment.state.points[adjustment.recording.target[rows]]
    miss: Floats = np.linalg.norm(_placed(adjustment, readings, rows) - goal, axis=1)
    return miss


def _swaps(adjustment: Adjustment, rows: Bools) -> list[Mend]:
    """Pairs of targets that were exchanged at a station (or one that was taken for another)."""
    recording, points = adjustment.recording, adjustment.state.points
    at = np.flatnonzero(rows & recording.measured.all(axis=1))
    if not len(at):
        return []
    gaps = np.linalg.norm(_placed(adjustment, recording.readings[at], at)[:, None] - points[None], axis=2)
    nearest = np.argmin(gaps, axis=1)
    lands = gaps[np.arange(len(at)), nearest] < CLOSE
    pairs: dict[tuple[int, int, int], list[int]] = {}
    for i in np.flatnonzero(lands & (nearest != recording.target[at])):
        a, b = sorted((int(recording.target[at[i]]), int(nearest[i])))
        pairs.setdefault((int(recording.station[at[i]]), a, b), []).append(int(i))
    found = []
    for (s, a, b), members in pairs.items():
        station, names = recording.stations[s], (recording.targets[a], recording.targets[b])
        gap = float(np.linalg.norm(points[a] - points[b]))
        booked = sorted(set(recording.target[at[members]].tolist()))
        if len(booked) == 2:
            sentence = (
                f"At station {station} the reflectors {names[0]} and {names[1]}, {gap:.2f} m apart, "
                f"were exchanged in {len(members)} pointings."
            )
        else:
            told, meant = names if booked[0] == a else names[::-1]
            numbers = ", ".join(str(at[i] + 1) for i in members[:MOST_ROWS])
            sentence = f"At station {station} what is booked as {told} (row {numbers}) is {meant}, {gap:.2f} m away."
        finding = GrossFinding("target-swap", at[members], (station,), names, (), gap, sentence)
        found.append((finding, recording.readings[at[members]], nearest[members]))
    return found


def _heights(adjustment: Adjustment, rows: Bools) -> list[Mend]:
    """Pointings that land right above or below their target: a height of target or instrument that is not that."""
    recording, model = adjustment.recording, adjustment.problem.model
    at = np.flatnonzero(rows & recording.measured.all(axis=1))
    if not len(at):
        return []
    off = _placed(adjustment, recording.readings[at], at) - adjustment.state.points[recording.target[at]]
    up = verticals(recording)[recording.station[at]]
    high = np.einsum("ni,ni->n", off, up)
    range_ = model.geometry(adjustment.state).range_[at]
    aside = np.linalg.norm(off - high[:, None] * up, axis=1)
    upright = (np.abs(high) > CLOSE) & (aside < np.maximum(CLOSE, ASIDE * np.abs(high))) & (aside < range_)
    lift = np.zeros((len(recording), 3))
    lift[at] = high[:, None] * up
    mended = recording.readings - exact_target_change(adjustment.sightings, lift)
    groups: dict[tuple[int, int, int], list[int]] = {}
    for i in np.flatnonzero(upright):
        key = int(recording.station[at[i]]), int(recording.target[at[i]]), round(high[i] / (2.0 * CLOSE))
        groups.setdefault(key, []).append(int(i))
    found: list[Mend] = []
    for (s, t, _), members in groups.items():
        station, target, size = recording.stations[s], recording.targets[t], float(np.mean(high[members]))
        numbers = ", ".join(str(at[i] + 1) for i in members[:MOST_ROWS])
        where = "above" if size > 0 else "below"
        sentence = (
            f"From station {station} the pointing to {target} (row {numbers}) lands {abs(size) / MILLIMETRE:.1f} mm "
            f"{where} it: a height of the target or the instrument that was not stated so."
        )
        rows_ = at[members]
        finding = GrossFinding("outlier", rows_, (station,), (target,), (), abs(size), sentence)
        found.append((finding, mended[rows_], recording.target[rows_]))
    return found


def _outliers(adjustment: Adjustment, rows: Bools) -> list[GrossFinding]:
    """Pointings that nothing explains: which reading is off, where it is one only."""
    recording, found = adjustment.recording, []
    expected = adjustment.problem.model.predict(adjustment.state)
    arms = np.stack([np.ones(len(rows)), expected[:, 0] * np.cos(expected[:, 2]), expected[:, 0]], axis=1)
    lengths = np.abs(adjustment.residuals * arms)
    for row in np.flatnonzero(rows):
        station, target = recording.stations[recording.station[row]], recording.targets[recording.target[row]]
        large = np.flatnonzero(np.nan_to_num(lengths[row]) > CLOSE)
        observables = (OBSERVABLES[large[0]],) if len(large) == 1 else ()
        size, what = float(np.nanmax(lengths[row])), observables[0] if observables else "pointing"
        sentence = f"The {what} from {station} to {target} (row {row + 1}) is off by {size * 1e3:.1f} mm."
        found.append(GrossFinding("outlier", np.array([row]), (station,), (target,), observables, size, sentence))
    return found
