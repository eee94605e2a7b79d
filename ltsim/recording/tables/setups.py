"""Set-ups and targets as surveyors' tables hold them.

One target has names that differ by set-up (`P 01` and `p1`, `S1_P01` and `S2_P01`); set-ups stand over marks that are
targets too, with a circle that each round turns anew.
"""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.arrays import Floats
from ltsim.notation import listing
from ltsim.recording.files import MAX_NAME, shown
from ltsim.recording.pointings import numbered
from ltsim.recording.recording import OCCUPATION_COLUMNS
from ltsim.recording.setup import EXACT_LEVEL_ARCSEC, Setup, Station
from ltsim.recording.tables import cells
from ltsim.recording.tables.header import HEIGHTS
from ltsim.recording.tables.rows import PointingTable, Printed
from ltsim.units import EARTH

MOST_SHOWN = 4
LEAST_LINES = 4
CLEARLY = 0.5
"""Lines seen to and fro close without the heights within this share of their misses with them."""
TURNED = 1e-3
"""[rad] By which a round's directions differ from another's where the circle was turned between them."""
BEYOND_NOISE = 6.0
"""Standard deviations that say the same where the noise of the directions is stated."""
CLOSES_M = 0.02
"""[m] Lines seen to and fro between heads on forced centring close so well; over marks they miss by decimetres."""
Key = tuple[str, ...]


def common_names(sightings: Sequence[tuple[str, str]]) -> tuple[list[str], list[str]]:
    """Target of each sighting (station, target) by one name for all set-ups, and what was changed.

    A set-up's own name before or after those of all its targets is taken away where set-ups then share targets that
    they did not share before. Names that differ in case, blanks or leading zeros are one where no set-up has both.
    """
    targets, notes = [target for _, target in sightings], []
    bare = [_without(station, target) for station, target in sightings]
    if all(bare) and len({station for station, _ in sightings}) > 1:
        stations = [station for station, _ in sightings]
        if not _shared(stations, targets) and _shared(stations, bare):
            notes.append(f"the set-up's name is taken from its targets' names: '{targets[0]}' is '{bare[0]}'")
            targets = bare
    places: dict[str, set[str]] = {}
    for (station, _), target in zip(sightings, targets, strict=True):
        places.setdefault(target, set()).add(station)
    alike: dict[str, list[str]] = {}
    for target in places:
        alike.setdefault(_folded(target), []).append(target)
    one = {
        name: spellings[0]
        for spellings in alike.values()
        if len(spellings) > 1
        and sum(len(places[s]) for s in spellings) == len(set().union(*(places[s] for s in spellings)))
        for name in spellings[1:]
    }
    if one:
        some = listing([f"'{name}' and '{first}'" for name, first in one.items()], MOST_SHOWN)
        notes.append(f"names that differ in case, blanks or leading zeros are taken as one target: {some}")
    return [one.get(target, target) for target in targets], notes


def _without(station: str, target: str) -> str:
    """The name of a target without that of its set-up; empty where it does not hold it."""
    if len(target) > MAX_NAME:  # which is refused later
        return ""
    found = re.fullmatch(rf"{re.escape(station)}[\s._:/-]+(.+)|(.+?)[\s._:/-]+{re.escape(station)}", target)
    return (found[1] or found[2]) if found else ""


def _shared(stations: Sequence[str], targets: Sequence[str]) -> bool:
    return len({*zip(stations, targets, strict=True)}) > len({*targets})


def _folded(name: str) -> str:
    bare = re.sub(r"(?<=[^\W\d_])[\s_-]+(?=\d)", "", name.casefold())
    return re.sub(r"(?<!\d)0+(?=\d)", "", re.sub(r"[\s_-]+", "_", bare))


def split_occupations(table: PointingTable, readings: Floats, sigma: Floats) -> tuple[set[str], list[str]]:
    """Occupations of one mark, and rounds whose circle was turned, become set-ups of their own, in place.

    An occupation is what has one identifier in a column of set-ups or, where there is none, one day in a column of
    dates without a clock. `sigma` (n,) [rad] are standard deviations of the azimuths, NaN where none is stated.

    Returns the names of set-ups that stand where others stand (rounds of one occupation), and what was done.
    """
    occupations = [(p.station, _occupation(table, p)) for p in table.pointings]
    rounds = [(*key, p.round) for key, p in zip(occupations, table.pointings, strict=True)]
    turned = table.column(("round",)) is not None and _is_turned(table, occupations, rounds, readings[:, 1], sigma)
    keys = rounds if turned else occupations
    distinct = list(dict.fromkeys(keys))
    marks = {station for station, *_ in distinct}
    if len(distinct) == len(marks):
        return set(), []
    names: dict[tuple[str, ...], str] = {}
    for key in distinct:
        names[key] = numbered(key[0], sum(station == key[0] for station, *_ in names))
    table.marks = {name: key[0] for key, name in names.items()}
    table.pointings = [replace(p, station=names[key]) for p, key in zip(table.pointings, keys, strict=True)]
    stays = list(dict.fromkeys(occupations))
    notes = []
    if len(stays) > len(marks):
        by = "set-up" if table.column(("instrument_setup",)) is not None else "day"
        notes.append(f"{len(stays)} occupations of {len(marks)} marks, by {by}, are set-ups of their own")
    if turned:
        of = f" of {len(stays)} occupations" if len(stays) > len(marks) else ""
        notes.append(
            f"the circle was turned between rounds: {len(names)} rounds{of} are set-ups of their own over their marks"
        )
    return (
        {name for key, name in names.items() if [k[:2] for k in names].count(key[:2]) > 1} if turned else set()
    ), notes


def _occupation(table: PointingTable, one: Printed) -> str:
    """Which occupation of its mark a pointing belongs to."""
    column = table.column(("instrument_setup",))
    if column is not None:
        return one.further.get(column.title, "")
    return one.moment if table.column(("date",)) is not None and not cells.has_clock(one.moment) else ""


def _is_turned(
    table: PointingTable, occupations: Sequence[Key], rounds: Sequence[Key], azimuth: Floats, sigma: Floats
) -> bool:
    """Whether the directions of a round differ from the first ones to the same targets in its occupation.

    By their median, so that no single wrong reading turns a circle; by more than `TURNED`, or than the noise that the
    table states makes likely.
    """
    first: dict[tuple[object, ...], tuple[Key, float, float]] = {}
    gaps: dict[Key, list[tuple[float, float]]] = {}
    for p, stay, key, turn, noise in zip(
        table.pointings, occupations, rounds, azimuth.tolist(), sigma.tolist(), strict=True
    ):
        other, before, before_noise = first.setdefault((stay, p.target, p.face), (key, turn, noise))
        if other != key and np.isfinite(turn - before):
            gap = float(np.remainder(turn - before + np.pi, 2 * np.pi) - np.pi)
            gaps.setdefault(key, []).append((gap, np.hypot(noise, before_noise)))
    for of_round in gaps.values():
        gap, noise = np.median(np.array(of_round), axis=0).tolist()
        if abs(gap) > min(TURNED, TURNED if np.isnan(noise) else BEYOND_NOISE * noise):
            return True
    return False


def over_marks(
    table: PointingTable, setup: Setup, readings: Floats, *, rounds: set[str], levelled: bool
) -> tuple[Setup, list[str]]:
    """Set-ups over the targets of their names, and levelled ones.

    Set-ups with heights over their marks are levelled. Without heights, set-ups stand over the targets of their names
    where lines seen to and fro close, or are seen in plan alone; those that are `rounds` of one occupation stand in one
    place.
    """
    heights = table.column(("instrument_height_mm",)) is not None
    targets = {p.target for p in table.pointings}
    names = dict.fromkeys(p.station for p in table.pointings)
    marks = {name: table.marks.get(name, name) for name in names}
    if heights or (levelled and _closes(table, readings)):
        shared = {mark for mark in marks.values() if mark in targets or list(marks.values()).count(mark) > 1}
    else:
        shared = {marks[name] for name in rounds}
    level = EXACT_LEVEL_ARCSEC if heights else Station().levelling_sigma_arcsec
    stations = {
        name: Station(
            levelled=heights or levelled,
            over=mark if mark in shared else None,
            levelling_sigma_arcsec=level,
        )
        for name, mark in marks.items()
        if name not in setup.stations and (heights or levelled or mark in shared)
    }
    if not stations:
        return setup, []
    over = f", {len(shared)} marks are targets too" if shared & targets else ""
    kind = "set-ups with heights over their marks" if heights else "set-ups of a total station"
    said = f"{kind} are taken as levelled{over} (setup.toml can say otherwise)"
    setup = setup.model_copy(update={"stations": {**setup.stations, **stations}})
    return setup, [said] if heights or levelled else []


def _closes(table: PointingTable, readings: Floats) -> bool:
    """Whether lines seen to and fro between marks close in length, and in height where heights were measured.

    By their median, without any heights of instruments and targets, on a round earth.
    """
    level = readings[:, 0] * np.cos(np.nan_to_num(readings[:, 2]))
    rises = readings[:, 0] * np.sin(readings[:, 2]) + level**2 / (2.0 * EARTH)
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for p, length, rise in zip(table.pointings, level.tolist(), rises.tolist(), strict=True):
        lines.setdefault((table.marks.get(p.station, p.station), p.target), []).append((length, rise))
    mean = {line: np.mean(both, axis=0) for line, both in lines.items()}
    misses = [mean[a, b] - mean[b, a] * [1.0, -1.0] for a, b in lines if a < b and (b, a) in lines]
    if not misses:
        return False
    length, rise = np.abs(np.array(misses)).T
    heights = rise[np.isfinite(rise)]
    return float(np.median(length)) < CLOSES_M and (not len(heights) or float(np.median(heights)) < CLOSES_M)


def occupied(table: PointingTable, one: Printed) -> dict[str, str]:
    """Which occupations of marks a pointing joins, where no column says so: those of one day, in one role."""
    day = one.moment if table.column(("time",)) is None else ""
    mark = table.marks.get(one.station, one.station)
    return dict(zip(OCCUPATION_COLUMNS, (f"{mark} {day}".strip(), f"to {one.target} {day}".strip()), strict=True))


def heights_not_applied(table: PointingTable, readings: Floats, height: Floats) -> list[str]:
    """What is said where the readings are those between the heads themselves, whatever heights stand beside them.

    Lines measured to and fro decide: their height differences cancel with the stated heights (n, 2) [m] of instrument
    and target, or without them.
    """
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    rise = readings[:, 0] * np.sin(readings[:, 2])
    for p, up, (own, other) in zip(table.pointings, rise, np.nan_to_num(height), strict=True):
        if np.isfinite(up):
            lines.setdefault((table.marks.get(p.station, p.station), p.target), []).append((up, up + own - other))
    mean = {line: np.mean(found, axis=0) for line, found in lines.items()}
    misses = np.abs([mean[a, b] + mean[b, a] for a, b in mean if a < b and (b, a) in mean]).reshape(-1, 2)
    if len(misses) < LEAST_LINES:
        return []
    for kind in (np.median, np.max):
        without, stated = kind(misses, axis=0)
        if not without < CLEARLY * stated:
            return []
    names = " and ".join(f"'{shown(c.title)}'" for c in table.columns if c.role in HEIGHTS)
    return [
        f"heights in {names} are not applied: {len(misses)} lines seen to and fro close within "
        f"{1e3 * misses[:, 0].max():.3g} mm without them, {1e3 * misses[:, 1].max():.4g} mm with them; "
        "coordinates are those of heads and reflectors, not of marks below; each head's height is an observation "
        "(heads_sigma_mm), plumb lines differ by place (curved)"
    ]
