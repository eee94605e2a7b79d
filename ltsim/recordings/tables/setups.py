"""Set-ups and targets in surveyors' tables: names of one target that differ, occupations, heights above marks.

The name of one target may differ by set-up (`P 01` and `p1`, `S1_P01` and `S2_P01`). Set-ups may be over marks that are
targets too, with a circle that is rotated between rounds.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import listing
from ltsim.core.units import EARTH_RADIUS
from ltsim.recordings.circle_orientations import circle_orientations, zeroed_circle_note
from ltsim.recordings.files import MAX_RECORDING_NAME_LENGTH, quoted_text
from ltsim.recordings.pointings import numbered_name
from ltsim.recordings.recording import OCCUPATION_COLUMNS
from ltsim.recordings.setup import EXACT_LEVEL_ARCSEC, Setup, Station
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.header import HEIGHT_ROLES
from ltsim.recordings.tables.printed import PointingTable, PrintedPointings, indices_by_value

NAME_DIFFERENCES = "case, blanks or leading zeros"
"""Differences of spelling between names of one point."""
MAX_NAMES_IN_SETUP_NOTE = 4
"""Largest number of names that a note on set-ups lists."""
OCCUPATION_NAMES = (
    ("instrument_setup", "set-up"),
    ("date", "day"),
    ("instrument_height_mm", "height of the instrument"),
)
"""Columns that number occupations, in the order in which they are used, and their names in a note."""
MIN_ROWS_OF_OCCUPATION = 3
"""Smallest number of rows with one height of the instrument that is an occupation."""
MIN_CLOSED_LINES = 4
"""Smallest number of lines measured in both directions for a test of the heights over marks."""
MAX_CLOSURE_RATIO = 0.5
"""Largest ratio of the closure of lines measured to and fro without heights to that with heights from which the heights
are not applied.
"""
MIN_CIRCLE_ROTATION = 1e-3
"""Smallest difference [rad] between the directions of two rounds that counts as a rotated circle."""
MIN_ROTATION_SIGMAS = 6.0
"""Smallest difference of directions, in their standard deviations (if given), that counts as a rotation of the circle.
"""
MAX_UNAPPLIED_CLOSURE_M = 0.2
"""Largest median closure [m] without heights at which these can be left out: earth curvature of lines of 1.3 km."""
MAX_CLOSURE_M = 0.02
"""Largest closure [m] of lines measured to and fro between heads on forced centring; lines over marks differ by
decimetres.
"""
OccupationKey = tuple[str, ...]


def common_target_names(pointings: PrintedPointings) -> tuple[list[str], list[str]]:
    """Target name of each pointing, common to all set-ups, and notes on the changes.

    The name of the set-up as a prefix or suffix of all its targets is removed if set-ups then have more common targets.
    Names that differ in case, blanks or leading zeros are one name if no set-up has both.
    """
    sightings, row = indices_by_value(zip(pointings.station, pointings.target, strict=True))
    stations, targets = (list(names) for names in zip(*sightings, strict=True))
    notes = []
    plain_names = [_without_station_name(station, target) for station, target in sightings]
    if (
        all(plain_names)
        and len({*stations}) > 1
        and not _shared_names(stations, targets)
        and _shared_names(stations, plain_names)
    ):
        notes.append(
            f"the name of the set-up is removed from the names of its targets: '{targets[0]}' is '{plain_names[0]}'"
        )
        targets = plain_names
    places: dict[str, set[str]] = {}
    for station, target in zip(stations, targets, strict=True):
        places.setdefault(target, set()).add(station)
    spellings_of: dict[str, list[str]] = {}
    for target in places:
        spellings_of.setdefault(normalised_name(target), []).append(target)
    common = {
        name: spellings[0]
        for spellings in spellings_of.values()
        if len(spellings) > 1
        and sum(len(places[s]) for s in spellings) == len(set().union(*(places[s] for s in spellings)))
        for name in spellings[1:]
    }
    if common:
        examples = listing([f"'{name}' and '{first}'" for name, first in common.items()], MAX_NAMES_IN_SETUP_NOTE)
        notes.append(f"names that differ only in {NAME_DIFFERENCES} are the same target: {examples}")
    names = [common.get(target, target) for target in targets]
    return [names[i] for i in row.tolist()], notes


def _without_station_name(station: str, target: str) -> str:
    """Name of a target without the name of its set-up; empty if it does not contain it."""
    if len(target) > MAX_RECORDING_NAME_LENGTH:  # which is refused later
        return ""
    match = re.fullmatch(rf"{re.escape(station)}[\s._:/-]+(.+)|(.+?)[\s._:/-]+{re.escape(station)}", target)
    return (match[1] or match[2]) if match else ""


def _shared_names(stations: Sequence[str], targets: Sequence[str]) -> bool:
    return len({*zip(stations, targets, strict=True)}) > len({*targets})


def normalised_name(name: str) -> str:
    """Name of a target without differences of case, blanks and leading zeros."""
    plain_name = re.sub(r"(?<=[^\W\d_])[\s_-]+(?=\d)", "", name.casefold())
    return re.sub(r"(?<!\d)0+(?=\d)", "", re.sub(r"[\s_-]+", "_", plain_name))


def marks_with_other_spelling(stations: Sequence[str], targets: Sequence[str]) -> dict[str, str]:
    """Target over which a set-up stands if their names differ only in case, blanks or leading zeros, by set-up.

    `stations` and `targets` are those of the pointings. A set-up does not stand over a target that it sees.
    """
    sights = {*zip(stations, targets, strict=True)}
    names = dict.fromkeys(targets)
    spelling = {normalised_name(target): target for target in names}
    marks = {station: spelling.get(normalised_name(station), station) for station in dict.fromkeys(stations)}
    return {
        station: mark
        for station, mark in marks.items()
        if station not in names and station != mark and (station, mark) not in sights
    }


def spelling_note(mark_by_setup: Mapping[str, str]) -> list[str]:
    """Note on set-ups over targets with another spelling; none for an empty mapping."""
    examples = listing([f"'{name}' and '{mark}'" for name, mark in mark_by_setup.items()], MAX_NAMES_IN_SETUP_NOTE)
    text = f"a set-up and a target whose names differ only in {NAME_DIFFERENCES} are one mark: {examples}"
    return [text] if mark_by_setup else []


def split_occupations(
    table: PointingTable, readings: Floats, sigma: Floats, *, has_circle: bool
) -> tuple[set[str], list[str]]:
    """Separation (in place) of the occupations of one mark, and of rounds with a rotated circle, into separate set-ups.

    An occupation has one identifier in a column of set-ups or, without such a column, one day in a column of dates.
    `sigma` (n,) [rad] are standard deviations of the azimuths, NaN if not given. Without a column of rounds, the
    directions of an instrument that `has_circle` to set show where that was done.

    Returns the names of set-ups at the position of others (rounds of one occupation), and notes.
    """
    pointings = table.pointings
    occupations: Sequence[OccupationKey]
    occupations, of_occupation = indices_by_value(zip(pointings.station, _occupation_numbers(table), strict=True))
    distinct, code = occupations, of_occupation
    turned, orientations = False, None
    if table.column(("round",)) is not None:
        by_round, of_round = indices_by_value(zip(of_occupation.tolist(), pointings.round, strict=True))
        turned = _has_rotated_circle(table, of_occupation, of_round, readings[:, 1], sigma)
        if turned:
            distinct, code = [(*occupations[i], name) for i, name in by_round], of_round
    elif has_circle:
        _, sight = indices_by_value(zip(of_occupation.tolist(), pointings.target, pointings.face, strict=True))
        orientations = circle_orientations(of_occupation, sight, readings)
        if orientations is not None:
            by_number, code = indices_by_value(zip(of_occupation.tolist(), orientations.tolist(), strict=True))
            distinct = [(*occupations[i], str(number)) for i, number in by_number]
    marks = {station for station, *_ in distinct}
    if len(distinct) == len(marks):
        return set(), []
    counts: Counter[str] = Counter()
    names: list[str] = []
    for station, *_ in distinct:
        names.append(numbered_name(station, counts[station]))
        counts[station] += 1
    table.marks = {name: table.marks.get(key[0], key[0]) for key, name in zip(distinct, names, strict=True)}
    pointings.station = [names[i] for i in code.tolist()]
    notes = []
    if len(occupations) > len(marks):
        by = next((name for role, name in OCCUPATION_NAMES if table.column((role,)) is not None), "")
        notes.append(f"{len(occupations)} occupations of {len(marks)} marks, by {by}, are separate set-ups")
    if turned:
        of = f" of {len(occupations)} occupations" if len(occupations) > len(marks) else ""
        notes.append(
            f"the circle was turned between rounds: {len(names)} rounds{of} are separate set-ups over their marks"
        )
    if orientations is not None:
        notes.append(zeroed_circle_note(len(names), len(occupations)))
    rounds = Counter(key[:2] for key in distinct)
    is_split = turned or orientations is not None
    return {n for key, n in zip(distinct, names, strict=True) if rounds[key[:2]] > 1} if is_split else set(), notes


def _occupation_numbers(table: PointingTable) -> list[str]:
    """Occupation of the mark to which each pointing belongs."""
    printed, column = table.pointings, table.column(("instrument_setup",))
    if column is not None:
        return printed.texts(column.title)
    if table.column(("date",)) is None:
        return _numbers_by_height(table)
    days = {moment: "" if cells.has_clock(moment) else moment for moment in {*printed.moment}}
    return [days[moment] for moment in printed.moment]


def _numbers_by_height(table: PointingTable) -> list[str]:
    """Occupation of each pointing by the height of the instrument, which is constant within an occupation.

    A mark has one occupation if a height holds for few of its rows, or returns: a wrong height is no occupation.
    """
    column = table.column(("instrument_height_mm",))
    numbers = [""] * len(table.pointings)
    rows_by_mark: dict[str, list[int]] = {}
    for row, mark in enumerate(table.mark if column is not None else ()):
        rows_by_mark.setdefault(mark, []).append(row)
    heights = table.pointings.texts(column.title) if column is not None else []
    for rows in rows_by_mark.values():
        runs = [list(run) for _, run in groupby((row for row in rows if heights[row]), key=heights.__getitem__)]
        is_occupation = len({heights[run[0]] for run in runs}) == len(runs) > 1
        if is_occupation and min(map(len, runs)) >= MIN_ROWS_OF_OCCUPATION:
            for number, run in enumerate(runs, start=1):
                for row in run:
                    numbers[row] = str(number)
    return numbers


def _has_rotated_circle(
    table: PointingTable, of_occupation: Ints, of_round: Ints, azimuth: Floats, sigma: Floats
) -> bool:
    """True if the directions of a round differ from the first ones to the same targets in its occupation.

    The median difference counts, so that a single gross error has no effect. It must exceed `MIN_CIRCLE_ROTATION`, or
    `MIN_ROTATION_SIGMAS` times the noise in the table.
    """
    pointings = table.pointings
    first: dict[tuple[object, ...], tuple[int, float, float]] = {}
    gaps: dict[int, list[tuple[float, float]]] = {}
    numbers = (of_occupation.tolist(), of_round.tolist(), azimuth.tolist(), sigma.tolist())
    for target, face, stay, key, turn, noise in zip(pointings.target, pointings.face, *numbers, strict=True):
        other, before, before_noise = first.setdefault((stay, target, face), (key, turn, noise))
        if other != key and np.isfinite(turn - before):
            gap = float(np.remainder(turn - before + np.pi, 2 * np.pi) - np.pi)
            gaps.setdefault(key, []).append((gap, np.hypot(noise, before_noise)))
    for pairs in gaps.values():
        gap, noise = np.median(np.array(pairs), axis=0).tolist()
        if abs(gap) > min(MIN_CIRCLE_ROTATION, MIN_CIRCLE_ROTATION if np.isnan(noise) else MIN_ROTATION_SIGMAS * noise):
            return True
    return False


def with_setups_over_marks(
    table: PointingTable, setup: Setup, readings: Floats, *, rounds: set[str], levelled: bool
) -> tuple[Setup, list[str]]:
    """Set-up with stations over the targets of the same names, and levelled stations.

    Stations with heights above their marks are levelled. Without heights, stations are over the targets of their names
    if lines measured to and fro close, or are measured in plan alone; `rounds` of one occupation have the same
    position.
    """
    heights = table.column(("instrument_height_mm",)) is not None
    targets = {*table.pointings.target}
    names = dict.fromkeys(table.pointings.station)
    marks = {name: table.marks.get(name, name) for name in names}
    over_mark = Counter(marks.values())
    if heights or (levelled and _has_closed_lines(table, readings)):
        shared = {mark for mark in marks.values() if mark in targets or over_mark[mark] > 1}
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
    over = f", {len(shared)} marks are also targets" if shared & targets else ""
    kind = "set-ups with heights over their marks" if heights else "set-ups of a total station"
    note = f"{kind} are assumed levelled{over} (otherwise set levelled = false in setup.toml)"
    setup = setup.model_copy(update={"stations": {**setup.stations, **stations}})
    notes = [note] if heights or levelled else []
    spelled = {
        name: mark
        for name, mark in marks.items()
        if mark in shared and name != mark and not name.startswith(f"{mark}#")
    }
    notes += spelling_note(spelled)
    return setup, notes


def _has_closed_lines(table: PointingTable, readings: Floats) -> bool:
    """True if lines measured to and fro between marks agree in length, and in height if heights were measured.

    The median counts, without heights of instruments and targets, and with the curvature of the earth.
    """
    level = readings[:, 0] * np.cos(np.nan_to_num(readings[:, 2]))
    rises = readings[:, 0] * np.sin(readings[:, 2]) + level**2 / (2.0 * EARTH_RADIUS)
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for line, length, rise in zip(_mark_and_target(table), level.tolist(), rises.tolist(), strict=True):
        lines.setdefault(line, []).append((length, rise))
    mean = {line: np.mean(both, axis=0) for line, both in lines.items()}
    misses = [mean[a, b] - mean[b, a] * [1.0, -1.0] for a, b in lines if a < b and (b, a) in lines]
    if not misses:
        return False
    length, rise = np.abs(np.array(misses)).T
    heights = rise[np.isfinite(rise)]
    return float(np.median(length)) < MAX_CLOSURE_M and (not len(heights) or float(np.median(heights)) < MAX_CLOSURE_M)


def _mark_and_target(table: PointingTable) -> Iterator[tuple[str, str]]:
    """Mark and target of each pointing."""
    return zip(table.mark, table.pointings.target, strict=True)


def connecting_occupations(table: PointingTable) -> dict[str, list[str]]:
    """Occupations of marks that a pointing connects, for a table without a column of occupations.

    They apply to a table without a column of occupations.
    """
    pointings = table.pointings
    days = pointings.moment if table.column(("time",)) is None else [""] * len(pointings)
    setups = [f"{mark} {day}".strip() for mark, day in zip(table.mark, days, strict=True)]
    targets = [f"to {target} {day}".strip() for target, day in zip(pointings.target, days, strict=True)]
    return dict(zip(OCCUPATION_COLUMNS, (setups, targets), strict=True))


def heights_not_applied(table: PointingTable, readings: Floats, height: Floats) -> list[str]:
    """Note on readings that refer to the heads themselves, so that heights in the table are not applied.

    Lines measured to and fro decide: their height differences cancel either with the heights (n, 2) [m] of instrument
    and target, or without them.
    """
    heights = np.nan_to_num(height)
    if not heights.any():
        return []
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    rise = readings[:, 0] * np.sin(readings[:, 2])
    with_heights = rise + heights[:, 0] - heights[:, 1]
    for line, up, other in zip(_mark_and_target(table), rise.tolist(), with_heights.tolist(), strict=True):
        if up == up:
            lines.setdefault(line, []).append((up, other))
    mean = {line: np.mean(rises, axis=0) for line, rises in lines.items()}
    misses = np.abs([mean[a, b] + mean[b, a] for a, b in mean if a < b and (b, a) in mean]).reshape(-1, 2)
    if len(misses) < MIN_CLOSED_LINES:
        return []
    if np.median(misses[:, 0]) > MAX_UNAPPLIED_CLOSURE_M:
        return []
    for kind in (np.median, np.max):
        without, applied = kind(misses, axis=0)
        if not without < MAX_CLOSURE_RATIO * applied:
            return []
    names = " and ".join(f"'{quoted_text(c.title)}'" for c in table.columns if c.role in HEIGHT_ROLES)
    return [
        f"heights in {names} are not applied: {len(misses)} lines seen to and fro close within "
        f"{1e3 * misses[:, 0].max():.3g} mm without them, {1e3 * misses[:, 1].max():.4g} mm with them; "
        "coordinates are those of heads and reflectors, not of marks below; each head's height is an observation "
        "(heads_sigma_mm), plumb lines differ by place (curved)"
    ]
