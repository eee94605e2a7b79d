"""Gross errors explained: swapped reflectors, wrong units, mixed-up faces, single bad readings.

A pointing that lands elsewhere by millimetres or more is no matter of statistics. Each is tried against the mistakes
people make; what a mistake explains is mended for the adjustment that follows, the rest stays out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltsim.adjust.adjustment import Adjustment
from ltsim.arrays import Bools, Floats, Ints
from ltsim.effects.face_confusion import FaceConfusion
from ltsim.effects.wrong_unit import WrongUnit
from ltsim.geometry.polar import wrap
from ltsim.recording.recording import OBSERVABLES, Recording
from ltsim.recording.slips import FACE_SLIPS, UNIT_SLIPS, Slip

CLOSE = 1e-3
"""[m] how near a mended pointing must land."""


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
    recording = adjustment.recording
    use = np.ones((len(recording), 3), dtype=bool)
    if not adjustment.gross.any():
        return recording, use, []
    open_rows = adjustment.gross.copy()
    readings, target = recording.readings.copy(), recording.target.copy()
    findings: list[GrossFinding] = []
    for explain in (_swaps, _units, _faces):
        for finding, mended in explain(adjustment, open_rows):
            findings.append(finding)
            open_rows[finding.rows] = False
            if isinstance(mended, dict):
                for row, other in mended.items():
                    target[row] = other
            else:
                readings[finding.rows] = mended
    for finding in _outliers(adjustment, open_rows):
        findings.append(finding)
        columns = [OBSERVABLES.index(o) for o in finding.observables] or [0, 1, 2]
        for column in columns:
            use[finding.rows, column] = False
    return recording.replace(readings=readings, target=target), use, findings


def _placed(adjustment: Adjustment, readings: Floats, rows: Ints) -> Floats:
    """Points (k, 3) in the network frame that readings (k, 3) in place of those of some rows (k,) describe."""
    station, instrument = adjustment.recording.station[rows], adjustment.recording.instrument[rows]
    local = adjustment.construction.point(readings, adjustment.state.instrument[instrument])
    turned = np.einsum("nij,nj->ni", adjustment.state.rotation[station], local)
    placed: Floats = turned + adjustment.state.position[station]
    return placed


def _swaps(adjustment: Adjustment, rows: Bools) -> list[tuple[GrossFinding, dict[int, int]]]:
    """Pairs of targets that were exchanged at a station (or one that was taken for another)."""
    recording, found = adjustment.recording, []
    at = np.flatnonzero(rows & recording.measured.all(axis=1))
    if not len(at):
        return []
    placed = _placed(adjustment, recording.readings[at], at)
    gaps = np.linalg.norm(placed[:, None] - adjustment.state.points[None], axis=2)
    nearest = np.argmin(gaps, axis=1)
    lands = gaps[np.arange(len(at)), nearest] < CLOSE
    pairs: dict[tuple[int, int, int], list[int]] = {}
    for i in np.flatnonzero(lands & (nearest != recording.target[at])):
        a, b = sorted((int(recording.target[at[i]]), int(nearest[i])))
        pairs.setdefault((int(recording.station[at[i]]), a, b), []).append(int(i))
    for (s, a, b), members in pairs.items():
        names = (recording.targets[a], recording.targets[b])
        gap = float(np.linalg.norm(adjustment.state.points[a] - adjustment.state.points[b]))
        sentence = (
            f"At station {recording.stations[s]} the reflectors {names[0]} and {names[1]}, {gap:.2f} m apart, "
            f"were exchanged in {len(members)} pointings."
        )
        finding = GrossFinding("target-swap", at[members], (recording.stations[s],), names, (), gap, sentence)
        found.append((finding, {int(at[i]): int(nearest[i]) for i in members}))
    return found


def _mended_rows(adjustment: Adjustment, rows: Bools, readings: Floats) -> Ints:
    """Rows among `rows` that land on their target with other readings (n, 3)."""
    recording = adjustment.recording
    at = np.flatnonzero(rows & np.isfinite(readings).all(axis=1))
    if not len(at):
        return at
    placed = _placed(adjustment, readings[at], at)
    miss = np.linalg.norm(placed - adjustment.state.points[recording.target[at]], axis=1)
    hit: Ints = at[miss < CLOSE]
    return hit


def _finding(adjustment: Adjustment, effect: str, rows: Ints, observables: tuple[str, ...], cause: str) -> GrossFinding:
    recording = adjustment.recording
    stations = tuple(sorted({recording.stations[s] for s in recording.station[rows]}))
    targets = tuple(sorted({recording.targets[t] for t in recording.target[rows]}))
    miss = np.linalg.norm(
        _placed(adjustment, recording.readings[rows], rows) - adjustment.state.points[recording.target[rows]],
        axis=1,
    )
    sentence = f"{len(rows)} pointings at station {', '.join(stations)} to {', '.join(targets[:6])} hold {cause}."
    return GrossFinding(effect, rows, stations, targets, observables, float(miss.max()), sentence)


def _slips(
    adjustment: Adjustment, rows: Bools, slips: Sequence[Slip], effect: str
) -> list[tuple[GrossFinding, Floats]]:
    """Pointings that land on their target once a slip is mended."""
    found, left = [], rows.copy()
    for slip in slips:
        readings = slip.mended(adjustment.recording.readings)
        hit = _mended_rows(adjustment, left, readings)
        if len(hit):
            left[hit] = False
            observables = tuple(OBSERVABLES[c] for c in slip.columns)
            found.append((_finding(adjustment, effect, hit, observables, slip.cause), readings[hit]))
    return found


def _units(adjustment: Adjustment, rows: Bools) -> list[tuple[GrossFinding, Floats]]:
    return _slips(adjustment, rows, UNIT_SLIPS, WrongUnit.name)


def _faces(adjustment: Adjustment, rows: Bools) -> list[tuple[GrossFinding, Floats]]:
    return _slips(adjustment, rows, FACE_SLIPS, FaceConfusion.name)


def _outliers(adjustment: Adjustment, rows: Bools) -> list[GrossFinding]:
    """Pointings that nothing explains: which reading is off, where it is one only."""
    recording, found = adjustment.recording, []
    for row in np.flatnonzero(rows):
        station, target = recording.station[[row]], recording.target[[row]]
        local = np.einsum(
            "nji,nj->ni",
            adjustment.state.rotation[station],
            adjustment.state.points[target] - adjustment.state.position[station],
        )
        own = adjustment.state.instrument[recording.instrument[row]]
        expected = adjustment.construction.readings(local, recording.face[[row]], own)[0]
        gap = recording.readings[row] - expected
        gap[1:] = wrap(gap[1:])
        length = np.abs(gap * [1.0, expected[0] * np.cos(expected[2]), expected[0]])
        large = np.nan_to_num(length) > CLOSE
        observables = tuple(OBSERVABLES[j] for j in np.flatnonzero(large)) if large.sum() == 1 else ()
        size = float(np.nanmax(length))
        where = f"{recording.stations[station[0]]} to {recording.targets[target[0]]}"
        what = observables[0] if observables else "pointing"
        found.append(
            GrossFinding(
                "outlier",
                np.array([row]),
                (recording.stations[station[0]],),
                (recording.targets[target[0]],),
                observables,
                size,
                f"The {what} from {where} (row {row + 1}) is off by {size * 1e3:.1f} mm.",
            )
        )
    return found
