"""Set-ups and targets in surveyors' tables: different names of one target, occupations, heights above survey marks.

The name of a target may differ between set-ups (`P 01` and `p1`, `S1_P01` and `S2_P01`). Set-ups may be over survey
marks that are also targets. The horizontal circle may be rotated between rounds.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.notation import names_text
from ltsim.recordings.circle_orientations import circle_orientation_numbers, circle_rotation_note
from ltsim.recordings.files import MAX_RECORDING_NAME_LENGTH
from ltsim.recordings.pointings import numbered_names
from ltsim.recordings.recording import OCCUPATION_COLUMNS
from ltsim.recordings.setup import EXACT_LEVELLING_SIGMA_ARCSEC, Setup, Station
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.tables.heights import reciprocal_lines_agree
from ltsim.recordings.tables.pointing_table import PointingTable, UnconvertedPointings, distinct_with_indices

SPELLING_DIFFERENCES_TEXT = "case, blanks or leading zeros"
"""Differences of spelling between two names of one point, as text for notes."""
MAX_NAMES_IN_SETUP_NOTE = 4
"""Largest number of names in a note on set-ups."""
OCCUPATION_NAMES_BY_ROLE = (
    ("instrument_setup", "set-up"),
    ("date", "day"),
    ("instrument_height_mm", "height of the instrument"),
)
"""Roles (contents) of the columns that can distinguish occupations, in order of priority, each with its name in notes.
"""
MIN_ROWS_OF_OCCUPATION = 3
"""Smallest number of rows with one height of the instrument that makes this height an occupation; in fewer rows the
height may be a mistake."""
MIN_CIRCLE_ROTATION_BETWEEN_ROUNDS = 1e-3
"""Limit of the median difference [rad] between the directions of two rounds to common targets. If it is exceeded, the
circle was rotated."""
MIN_CIRCLE_ROTATION_SIGMAS = 6.0
"""Limit of the median difference between the directions of two rounds to common targets, in standard deviations. If it
is exceeded, the circle was rotated."""
_TARGET_NAME_AFTER_STATION = re.compile(r"[\s._:/-]+(.+)")
"""Pattern of a target name after the name of its set-up: a separator, then group 1 ("P01" in "S1_P01")."""
_TARGET_NAME_BEFORE_STATION = re.compile(r"(.+?)[\s._:/-]+")
"""Pattern of a target name before the name of its set-up: group 1 ("P01" in "P01_S1"), then a separator."""
OccupationKey = tuple[str, ...]
"""Key of a set-up: station and occupation; if the circle was rotated also the round or the number of the orientation.
"""


def common_target_names(pointings: UnconvertedPointings) -> tuple[list[str], list[str]]:
    """Name of the target of each pointing, equal for all set-ups, and notes on changed names.

    If the names of all targets contain the name of their set-up, this part is removed, provided that set-ups then have
    common targets. Names that differ only in case, blanks or leading zeros become one name, if no set-up uses both.
    """
    sightings, row = distinct_with_indices(zip(pointings.station, pointings.target, strict=True))
    stations, targets = (list(names) for names in zip(*sightings, strict=True))
    notes = []
    plain_names = [_without_station_name(station, target) for station, target in sightings]
    if (
        all(plain_names)
        and len({*stations}) > 1
        and not _stations_share_targets(stations, targets)
        and _stations_share_targets(stations, plain_names)
    ):
        notes.append(
            f"the name of the set-up is removed from the names of its targets: '{targets[0]}' is '{plain_names[0]}'"
        )
        targets = plain_names
    plain_by_name = {target: normalised_name(target) for target in targets}
    n_spellings = Counter(plain_by_name.values())
    stations_of: dict[str, set[str]] = {}
    spellings_by_name: dict[str, list[str]] = {}
    for station, target in zip(stations, targets, strict=True):
        if n_spellings[plain_by_name[target]] > 1:
            stations_of.setdefault(target, set()).add(station)
    for target in stations_of:
        spellings_by_name.setdefault(plain_by_name[target], []).append(target)
    spelling_by_name = {
        name: spellings[0]
        for spellings in spellings_by_name.values()
        if sum(len(stations_of[s]) for s in spellings) == len(set().union(*(stations_of[s] for s in spellings)))
        for name in spellings[1:]
    }
    if spelling_by_name:
        examples = names_text(
            [f"'{name}' and '{first}'" for name, first in spelling_by_name.items()], MAX_NAMES_IN_SETUP_NOTE
        )
        notes.append(f"names that differ only in {SPELLING_DIFFERENCES_TEXT} are the same target: {examples}")
    names = [spelling_by_name.get(target, target) for target in targets]
    return [names[i] for i in row.tolist()], notes


def _without_station_name(station: str, target: str) -> str:
    """Name of a target without the name of its set-up at the beginning or end; empty if it is not there."""
    if len(target) > MAX_RECORDING_NAME_LENGTH:  # which is refused later
        return ""
    match = None
    if target.startswith(station):
        match = _TARGET_NAME_AFTER_STATION.fullmatch(target, len(station))
    if match is None and target.endswith(station):
        match = _TARGET_NAME_BEFORE_STATION.fullmatch(target, 0, len(target) - len(station))
    return match[1] if match else ""


def _stations_share_targets(stations: Sequence[str], targets: Sequence[str]) -> bool:
    """True if a target name occurs at more than one station."""
    return len({*zip(stations, targets, strict=True)}) > len({*targets})


def normalised_name(name: str) -> str:
    """Name of a target in lower case, without blanks and leading zeros."""
    plain_name = re.sub(r"(?<=[^\W\d_])[\s_-]+(?=\d)", "", name.casefold())
    return re.sub(r"(?<!\d)0+(?=\d)", "", re.sub(r"[\s_-]+", "_", plain_name))


def marks_with_other_spelling(stations: Sequence[str], targets: Sequence[str]) -> dict[str, str]:
    """Name of the target under a set-up, by name of the set-up, if both names differ only in spelling.

    Spelling means case, blanks and leading zeros. `stations` and `targets` are the names in n pointings. A set-up is
    not over a target that it measured.
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


def spelling_notes(mark_by_setup: Mapping[str, str]) -> list[str]:
    """Note, in a list, on set-ups over targets whose names have another spelling; empty if there are none."""
    examples = names_text([f"'{name}' and '{mark}'" for name, mark in mark_by_setup.items()], MAX_NAMES_IN_SETUP_NOTE)
    text = f"a set-up and a target whose names differ only in {SPELLING_DIFFERENCES_TEXT} are one mark: {examples}"
    return [text] if mark_by_setup else []


def split_occupations(
    table: PointingTable, readings: Floats, sigma: Floats, *, has_circle: bool
) -> tuple[dict[str, str], list[str]]:
    """Division, in place, of set-ups with several occupations or with a rotated circle into separate set-ups.

    A column of set-ups or dates, or the heights of the instrument, distinguish occupations. `readings` (n, 3) [m, rad,
    rad] are those of n pointings; `sigma` (n,) [rad] are the standard deviations of the azimuths, NaN if not given.
    Without a column of rounds, the directions of an instrument with a horizontal circle (`has_circle`) show rotations
    of the circle.

    The results are the first set-up of the same occupation, by name of those set-ups that share an occupation, and thus
    position and height, with another set-up, and notes.
    """
    pointings = table.pointings
    occupations: Sequence[OccupationKey]
    occupations, occupation_index = distinct_with_indices(
        zip(pointings.station, _occupation_labels(table), strict=True)
    )
    distinct, code = occupations, occupation_index
    is_rotated, orientations = False, None
    if table.column_with_role(("round",)) is not None:
        by_round, round_index = distinct_with_indices(
            zip(occupation_index.tolist(), pointings.round_label, strict=True)
        )
        is_rotated = _has_rotated_circle(table, occupation_index, round_index, readings[:, 1], sigma)
        if is_rotated:
            distinct, code = [(*occupations[i], name) for i, name in by_round], round_index
    elif has_circle:
        _, sight = distinct_with_indices(zip(occupation_index.tolist(), pointings.target, pointings.face, strict=True))
        orientations = circle_orientation_numbers(occupation_index, sight, readings)
        if orientations is not None:
            by_number, code = distinct_with_indices(zip(occupation_index.tolist(), orientations.tolist(), strict=True))
            distinct = [(*occupations[i], str(number)) for i, number in by_number]
    marks = {station for station, *_ in distinct}
    if len(distinct) == len(marks):
        return {}, []
    names = numbered_names(station for station, *_ in distinct)
    table.mark_by_setup = {
        name: table.mark_by_setup.get(key[0], key[0]) for key, name in zip(distinct, names, strict=True)
    }
    pointings.station = [names[i] for i in code.tolist()]
    notes = []
    if len(occupations) > len(marks):
        column_name = next(
            (name for role, name in OCCUPATION_NAMES_BY_ROLE if table.column_with_role((role,)) is not None), ""
        )
        occupations_text = f"{len(occupations)} occupations of {len(marks)} marks"
        notes.append(f"{occupations_text}, distinguished by {column_name}, are separate set-ups")
    if is_rotated:
        of = f" of {len(occupations)} occupations" if len(occupations) > len(marks) else ""
        notes.append(
            f"the circle was rotated between rounds: {len(names)} rounds{of} are separate set-ups over their marks"
        )
    if orientations is not None:
        notes.append(circle_rotation_note(len(names), len(occupations)))
    setups_by_occupation: dict[OccupationKey, list[str]] = {}
    for key, name in zip(distinct, names, strict=True):
        setups_by_occupation.setdefault(key[:2], []).append(name)
    return {name: setups[0] for setups in setups_by_occupation.values() if len(setups) > 1 for name in setups}, notes


def _occupation_labels(table: PointingTable) -> list[str]:
    """Text for each pointing that distinguishes its occupation from other occupations of its survey mark."""
    pointings, column = table.pointings, table.column_with_role(("instrument_setup",))
    if column is not None:
        return pointings.additional_cell_texts(column.title)
    if table.column_with_role(("date",)) is None:
        return _occupation_labels_by_height(table)
    days = {moment: "" if cells.has_time_of_day(moment) else moment for moment in {*pointings.date_and_time}}
    return [days[moment] for moment in pointings.date_and_time]


def _occupation_labels_by_height(table: PointingTable) -> list[str]:
    """Number, as text, of the occupation of each pointing, from the height of the instrument.

    The height is constant during an occupation. If a height occurs in few rows of a survey mark, or occurs again later,
    it may be wrong, and the mark has one occupation.
    """
    column = table.column_with_role(("instrument_height_mm",))
    setup_numbers = [""] * len(table.pointings)
    rows_by_mark: dict[str, list[int]] = {}
    for row, mark in enumerate(table.mark_names if column is not None else ()):
        rows_by_mark.setdefault(mark, []).append(row)
    heights = table.pointings.additional_cell_texts(column.title) if column is not None else []
    for rows in rows_by_mark.values():
        runs = [list(run) for _, run in groupby((row for row in rows if heights[row]), key=heights.__getitem__)]
        is_occupation = len({heights[run[0]] for run in runs}) == len(runs) > 1
        if is_occupation and min(map(len, runs)) >= MIN_ROWS_OF_OCCUPATION:
            for number, run in enumerate(runs, start=1):
                for row in run:
                    setup_numbers[row] = str(number)
    return setup_numbers


def _has_rotated_circle(
    table: PointingTable, occupation_index: Ints, round_index: Ints, azimuth: Floats, sigma: Floats
) -> bool:
    """True if the directions in a round differ from those in earlier rounds of its occupation to common targets.

    `occupation_index` and `round_index` (n,) number the occupation and the round of each of n pointings. `azimuth` (n,)
    and its standard deviation `sigma` (n,) are in rad. The median difference, which a single outlier does not change,
    is compared with the smaller limit: `MIN_CIRCLE_ROTATION_BETWEEN_ROUNDS`, or `MIN_CIRCLE_ROTATION_SIGMAS` standard
    deviations.
    """
    pointings = table.pointings
    first_reading: dict[tuple[object, ...], tuple[int, float, float]] = {}
    differences: dict[int, list[tuple[float, float]]] = {}
    reading_columns = (occupation_index.tolist(), round_index.tolist(), azimuth.tolist(), sigma.tolist())
    for target, face, stay, key, direction, noise in zip(
        pointings.target, pointings.face, *reading_columns, strict=True
    ):
        other, before, before_noise = first_reading.setdefault((stay, target, face), (key, direction, noise))
        if other != key and np.isfinite(direction - before):
            difference = float(np.remainder(direction - before + np.pi, 2 * np.pi) - np.pi)
            differences.setdefault(key, []).append((difference, np.hypot(noise, before_noise)))
    for pairs in differences.values():
        difference, noise = np.median(np.array(pairs), axis=0).tolist()
        limit = MIN_CIRCLE_ROTATION_BETWEEN_ROUNDS if np.isnan(noise) else MIN_CIRCLE_ROTATION_SIGMAS * noise
        if abs(difference) > min(MIN_CIRCLE_ROTATION_BETWEEN_ROUNDS, limit):
            return True
    return False


def with_setups_over_marks(
    table: PointingTable, setup: Setup, readings: Floats, *, rounds: Iterable[str], levelled: bool
) -> tuple[Setup, list[str]]:
    """Prior knowledge `setup`, completed with stations that are levelled or over targets of their name, and notes.

    Stations with heights above survey marks are levelled. Without heights, `levelled` stations are over targets of
    their name if lines measured in both directions close. `rounds` are names of set-ups that share their position with
    other set-ups of one occupation. `readings` (n, 3) [m, rad, rad] are those of n pointings.
    """
    heights = table.column_with_role(("instrument_height_mm",)) is not None
    targets = {*table.pointings.target}
    names = dict.fromkeys(table.pointings.station)
    marks = {name: table.mark_by_setup.get(name, name) for name in names}
    over_mark = Counter(marks.values())
    if heights or (levelled and reciprocal_lines_agree(table, readings)):
        shared = {mark for mark in marks.values() if mark in targets or over_mark[mark] > 1}
    else:
        shared = {marks[name] for name in rounds}
    levelling_sigma = EXACT_LEVELLING_SIGMA_ARCSEC if heights else Station().levelling_sigma_arcsec
    stations = {
        name: Station(
            levelled=heights or levelled, over=mark if mark in shared else None, levelling_sigma_arcsec=levelling_sigma
        )
        for name, mark in marks.items()
        if name not in setup.stations and (heights or levelled or mark in shared)
    }
    if not stations:
        return setup, []
    targets_text = f", {len(shared)} marks are also targets" if shared & targets else ""
    kind = "set-ups with heights over their marks" if heights else "set-ups of a total station"
    note = f"{kind} are assumed levelled{targets_text} (otherwise set levelled = false in setup.toml)"
    setup = setup.model_copy(update={"stations": {**setup.stations, **stations}})
    notes = [note] if heights or levelled else []
    spelled = {
        name: mark
        for name, mark in marks.items()
        if mark in shared and name != mark and not name.startswith(f"{mark}#")
    }
    notes += spelling_notes(spelled)
    return setup, notes


def occupation_columns(table: PointingTable) -> dict[str, list[str]]:
    """Columns with the names of the occupations by the instrument and by the reflector in each pointing.

    The columns are for tables that lack them: mark and day distinguish occupations of a survey mark.
    """
    pointings = table.pointings
    days = pointings.date_and_time if table.column_with_role(("time",)) is None else [""] * len(pointings)
    setups = [f"{mark} {day}".strip() for mark, day in zip(table.mark_names, days, strict=True)]
    targets = [f"to {target} {day}".strip() for target, day in zip(pointings.target, days, strict=True)]
    return dict(zip(OCCUPATION_COLUMNS, (setups, targets), strict=True))
