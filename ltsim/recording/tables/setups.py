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
from ltsim.recording.tables.header import HEIGHTS
from ltsim.recording.tables.rows import PointingTable, Printed

MOST_SHOWN = 4
LEAST_LINES = 4
CLEARLY = 0.5
"""Lines seen to and fro close without the heights within this share of their misses with them."""
TURNED = 1e-3
"""[rad] By which a round's directions differ from another's where the circle was turned between them."""


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


def split_rounds(table: PointingTable, readings: Floats) -> list[str]:
    """Rounds of one station whose circle was turned become set-ups of their own, in place; what is said of it."""
    if table.column(("round",)) is None:
        return []
    keys = [(p.station, p.round) for p in table.pointings]
    first: dict[tuple[str, str, int | None], tuple[str, float]] = {}
    gaps = []
    for p, (_, key), azimuth in zip(table.pointings, keys, readings[:, 1].tolist(), strict=True):
        other, before = first.setdefault((p.station, p.target, p.face), (key, azimuth))
        if other != key and np.isfinite(azimuth - before):
            gaps.append(abs(np.remainder(azimuth - before + np.pi, 2 * np.pi) - np.pi))
    if not gaps or max(gaps) < TURNED:
        return []
    names: dict[tuple[str, str], str] = {}
    for both in dict.fromkeys(keys):
        names[both] = numbered(both[0], sum(station == both[0] for station, _ in names))
    table.marks = {name: both[0] for both, name in names.items()}
    table.pointings = [replace(p, station=names[both]) for p, both in zip(table.pointings, keys, strict=True)]
    return [f"the circle was turned between rounds: {len(names)} rounds are set-ups of their own over their marks"]


def over_marks(table: PointingTable, setup: Setup) -> tuple[Setup, list[str]]:
    """Stations of a table that states their heights: levelled, and over the target of their name."""
    if table.column(("instrument_height_mm",)) is None:
        return setup, []
    targets = {p.target for p in table.pointings}
    names = dict.fromkeys(p.station for p in table.pointings)
    marks = {name: table.marks.get(name, name) for name in names}
    shared = {mark for mark in marks.values() if mark in targets or list(marks.values()).count(mark) > 1}
    stations = {
        name: Station(levelled=True, levelling_sigma_arcsec=EXACT_LEVEL_ARCSEC, over=mark if mark in shared else None)
        for name, mark in marks.items()
        if name not in setup.stations
    }
    if not stations:
        return setup, []
    over = f", {len(shared)} marks are targets too" if shared else ""
    said = f"set-ups with heights over their marks are taken as levelled{over} (setup.toml can say otherwise)"
    return setup.model_copy(update={"stations": {**setup.stations, **stations}}), [said]


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
