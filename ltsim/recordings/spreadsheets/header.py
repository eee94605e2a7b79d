"""Interpretation of a table's header: role (content), unit and face of each column, from titles in many languages."""

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from ltsim.core.units import ANGLE_UNITS, LENGTH_UNITS, SMALL_ANGLE_UNITS, UNIT_BY_SPELLING
from ltsim.recordings.spreadsheets.angle_cells import joined_angle_text
from ltsim.recordings.spreadsheets.title_words import (
    COMMON_SIGMA_ROLE,
    EAST_ASIAN_LETTERS,
    FALLBACK_TITLES,
    FOREIGN_TITLES_BY_LANGUAGE,
    FULL_WORDS_BY_ABBREVIATION,
    LETTERS_OF_HEIGHTS,
    NUMBER_TITLE_ENDINGS,
    ROLE_BY_HEIGHT_TITLE,
    STATION_TITLE_FIRST_WORDS,
    STATION_TITLE_LAST_WORDS,
    TITLES_BY_ROLE,
    axes_of_titles_with_common_word,
)

HORIZONTAL_ROLES = ("horizontal", "azimuth")
"""Roles (contents) of columns of horizontal angles: `horizontal` (readings of a horizontal circle) and `azimuth`."""
VERTICAL_ROLES = ("vertical", "zenith", "elevation")
"""Roles (contents) of columns of vertical angles: `vertical` (kind not given by the title), `zenith` and `elevation`.
"""
DISTANCE_ROLES = ("distance", "flat")
"""Roles (contents) of columns of slope distances (`distance`) and horizontal distances (`flat`)."""
COORDINATE_ROLES = ("x", "y", "z")
"""Roles (contents) of columns of coordinates of targets."""
READING_ROLES = (*HORIZONTAL_ROLES, *VERTICAL_ROLES, *DISTANCE_ROLES, *COORDINATE_ROLES)
"""Roles (contents) of columns of readings, or of coordinates in place of readings."""
HEIGHT_ROLES = ("instrument_height_mm", "target_height_mm")
"""Roles (contents) of columns of heights above survey marks."""
SIGMA_ROLES = {
    **dict.fromkeys(DISTANCE_ROLES, "sigma_distance_mm"),
    **dict.fromkeys(HORIZONTAL_ROLES, "sigma_azimuth_arcsec"),
    **dict.fromkeys(VERTICAL_ROLES, "sigma_elevation_arcsec"),
    **{axis: f"sigma_{axis}_mm" for axis in COORDINATE_ROLES},
}
"""Role of a column of standard deviations, by the role of the column of readings or coordinates to which it belongs.
The role of a column is its content, such as `azimuth`."""
ROLE_BY_TITLE = {
    **{instrument + place: "station" for instrument in STATION_TITLE_FIRST_WORDS for place in STATION_TITLE_LAST_WORDS},
    **ROLE_BY_HEIGHT_TITLE,
    **{
        word: role
        for words in (TITLES_BY_ROLE, *FOREIGN_TITLES_BY_LANGUAGE.values())
        for role, text in words.items()
        for word in text.split()
    },
}
"""Role of a column (its content, such as `azimuth`) that each known title denotes; titles are in the form of
`normalised_title`."""
UNITS_BY_ROLE = {
    **dict.fromkeys((*HORIZONTAL_ROLES, *VERTICAL_ROLES), ANGLE_UNITS),
    **dict.fromkeys(
        (*DISTANCE_ROLES, *COORDINATE_ROLES, *HEIGHT_ROLES, COMMON_SIGMA_ROLE, "sigma_distance_mm"),
        LENGTH_UNITS,
    ),
    **dict.fromkeys((f"sigma_{axis}_mm" for axis in COORDINATE_ROLES), LENGTH_UNITS),
    **dict.fromkeys(("sigma_azimuth_arcsec", "sigma_elevation_arcsec"), SMALL_ANGLE_UNITS),
    "time": ("s", "ms", "min", "h"),
    "air_temperature_c": ("c", "deg"),
    "air_pressure_hpa": ("hpa",),
    "relative_humidity_pct": ("%",),
}
"""Permitted units of a column by its role (content, such as `azimuth`); a column whose title has another unit does not
have this role."""
ROLES_OF_UNUSED_FALLBACK_TITLES = {"target": "", "station": "instrument_setup", "elevation": ""}
"""Second role ('' for none) of a column with a title in `FALLBACK_TITLES`, if another column already has its first
role. For example, a column of set-up numbers numbers the occupations if another column names the stations."""
MAX_TITLE_LENGTH = 80
"""Largest number of characters of a cell that can be the title of a column."""
_UNIT_IN_BRACKETS_PATTERN = re.compile(r"(.*?)\s*[\[({（【]\s*([^\])}）】]*?)\s*[\])}）】]?\s*")
"""Pattern of a title followed by its unit in brackets."""
_REMOVED_CHARACTERS_PATTERN = re.compile(f"[^a-z0-9{EAST_ASIAN_LETTERS}]")
"""Pattern of the characters that `normalised_title` removes from a title."""
_FACE_NUMBER_PATTERN = re.compile(r"(.*?)[\s._-]*(?:(?:face|lage|f|l)[\s._-]*)?(1|2|ii|i)", re.IGNORECASE)
"""Pattern of a title that ends with the number of the face."""
_SIGMA_TITLE_PATTERN = (
    re.compile(r"(?:sigma|stddev|std|sd|s)([a-z]+)"),
    re.compile(r"([a-z]+?)(?:error|err|sigma|stddev|std|sd)"),
)
"""Patterns of titles of standard deviations; group 1 is the title of the reading or coordinate."""
ANGLE_PART_UNITS = ("min", "sec", "'", '"', "m", "s")
"""Units in the titles of separate columns of minutes or seconds of an angle."""
ANGLE_PART_ROLE = "part"
"""Role of a column of minutes or seconds of an angle whose degrees are in another column."""
_ANGLE_PART_PATTERNS = tuple(
    re.compile(rf"(.*?)[\s_.-]*[\[({{]?\s*(?:{words})\s*[\])}}]?", re.IGNORECASE)
    for words in (
        "d|deg|degrees?|grad|°|º",
        "m|min|minutes?|minuten|'|′|’",
        "s|sec|seconds?|sek|sekunden|\"|″|”|''",
    )
)
"""Patterns of titles of columns of degrees, of minutes, and of seconds of an angle."""
_VALUE_ENDING_PATTERN = re.compile(r"([a-z0-9]+?)(?:value|reading|obs|raw)")
"""Pattern of a title that ends with a word for a measured value, such as "reading"."""
_NUMBER_ENDING_PATTERN = re.compile(rf"([a-z0-9]+?)(?:{'|'.join(NUMBER_TITLE_ENDINGS)})")
"""Pattern of a title that ends with a word for a number or a name, such as "no"."""
ROLES_WITH_NUMBER_ENDINGS = ("station", "round")
"""Roles (contents) of columns whose titles may end with a word for a number or a name, as in "station no". Such titles
of targets and instruments are listed separately."""


@dataclass(frozen=True)
class TableColumn:
    """Column of a table: position (from 0), title, role, unit, face.

    The role is the content of the cells, such as ``target``, ``azimuth`` or ``time``; '' if unknown. The unit is '' if
    not declared. The face is 1 or 2, or 0 for a column that applies to both faces.
    """

    position: int
    title: str
    role: str = ""
    unit: str = ""
    face: int = 0
    angle_part_positions: tuple[int, ...] = ()
    """Positions of the columns of minutes and seconds that belong to the degrees in this column."""

    def cell_texts(self, table: Sequence[Sequence[str]]) -> Sequence[str]:
        """Cells of this column, joined with the cells of minutes and seconds; `table` is the cells of all columns."""
        if not self.angle_part_positions:
            return table[self.position]
        cell_rows = zip(*(table[place] for place in (self.position, *self.angle_part_positions)), strict=True)
        return list(map(joined_angle_text, cell_rows))

    @property
    def is_additional(self) -> bool:
        """True if the column becomes a covariate or a label, because it has a title and no role in a pointing."""
        return bool(self.title) and (not self.role or "_" in self.role or self.role == "round")


def header_columns(fields: Sequence[str]) -> list[TableColumn]:
    """Columns with the titles `fields`, each with the role (content) and unit that its title implies, as a new list."""
    return list(_compute_header_columns(tuple(fields)))


@lru_cache(maxsize=64)
def _compute_header_columns(fields: tuple[str, ...]) -> list[TableColumn]:
    """Columns with the titles `fields`, each with the role and unit that its title implies; results are cached.

    If two titles denote one role, the first column gets it. Faces are distinguished if a reading has a column for each
    face. In a table of polar readings, columns of coordinates are additional columns.
    """
    candidates = _join_angle_parts([_column_from_title(place, title) for place, title in enumerate(fields)])
    roles = {c.role for c in candidates}
    if not roles & {*READING_ROLES}:
        axes = _axes_by_position(fields)
        candidates = [replace(c, role=axes.get(c.position, c.role)) for c in candidates]
    if roles & {*SIGMA_ROLES.values()} and sum(c.role == "distance" for c in candidates) > 1:
        candidates = [_with_distance_sigma_role(c) for c in candidates]
    if _count_reading_kinds(candidates) == 2 and not roles & {
        *VERTICAL_ROLES,
        "x",
        "y",
    }:  # Z beside Hz and D is no height
        candidates = [replace(c, role="vertical") if c.role == "z" and not c.unit else c for c in candidates]
    if _count_reading_kinds(candidates) == 2 and not roles & {*DISTANCE_ROLES, "x", "y"}:  # S beside Hz and V
        candidates = [replace(c, role="distance") if _is_titled_s(c) else c for c in candidates]
    two_face_roles = {c.role for c in candidates if c.face == 1} & {c.role for c in candidates if c.face == 2}
    is_polar = _count_reading_kinds(candidates) > 1
    titles_by_role = {
        role: {
            title_words_and_unit(c.title)[0]
            for c in candidates
            if c.role == role or {c.role, role} <= {*VERTICAL_ROLES}
        }
        for role in FALLBACK_TITLES
    }
    columns: list[TableColumn] = []
    used_roles: set[tuple[str, int]] = set()
    for column in candidates:
        assigned = column
        if assigned.face and assigned.role not in two_face_roles:
            assigned = _column_from_title(assigned.position, assigned.title, has_face=False)
        fallback = FALLBACK_TITLES.get(assigned.role, ())
        if title_words_and_unit(assigned.title)[0] in fallback and (
            not titles_by_role[assigned.role] <= {*fallback} or (assigned.role in VERTICAL_ROLES and not is_polar)
        ):
            assigned = replace(assigned, role=ROLES_OF_UNUSED_FALLBACK_TITLES[assigned.role])
        if assigned.role and (
            (assigned.role, assigned.face) in used_roles
            or (is_polar and assigned.role in (*COORDINATE_ROLES, COMMON_SIGMA_ROLE))
        ):
            assigned = replace(assigned, role="", face=0)
        if assigned.role != ANGLE_PART_ROLE:
            used_roles.add((assigned.role, assigned.face))
        columns.append(assigned)
    return distinct_titles(columns)


def _is_titled_s(column: TableColumn) -> bool:
    """True for a column with the title S and no unit other than that of a length."""
    return title_words_and_unit(column.title)[0] == "s" and column.unit in ("", *LENGTH_UNITS)


def _with_distance_sigma_role(column: TableColumn) -> TableColumn:
    """Column with the role of standard deviations of distances if its title is sD; any other column unchanged.

    The new role is for tables with another column of distances; elsewhere the title denotes slope distances (SD).
    """
    is_sigma = column.role == "distance" and title_words_and_unit(column.title)[0] == "sd"
    return replace(column, role=SIGMA_ROLES["distance"]) if is_sigma else column


def distinct_titles(columns: Sequence[TableColumn]) -> list[TableColumn]:
    """Columns with distinct titles, which are the keys of additional columns; repeated titles get a number."""
    counts: Counter[str] = Counter()
    distinct = []
    for column in columns:
        counts[column.title] += 1
        again = column.title and counts[column.title] > 1
        distinct.append(replace(column, title=f"{column.title} ({counts[column.title]})") if again else column)
    return distinct


def _match_unit_ending(pattern: re.Pattern[str], title: str) -> re.Match[str] | None:
    """Match of a title with a pattern for a unit at its end; None if the title does not match or is too long."""
    return pattern.fullmatch(title) if len(title) <= MAX_TITLE_LENGTH else None


def _join_angle_parts(columns: list[TableColumn]) -> list[TableColumn]:
    """Columns of a header; the columns of degrees, minutes and possibly seconds of one angle are joined.

    Minutes and seconds are in the next columns, or in other columns with the title of the degrees.
    """
    joined_columns = list(columns)
    for place, column in enumerate(columns):
        degrees_match = _match_unit_ending(_ANGLE_PART_PATTERNS[0], column.title)
        stem = column.title if degrees_match is None else degrees_match[1]
        role = title_role(stem)
        if degrees_match is not None and role == "z":  # a coordinate has no degrees
            role = "vertical"
        if role not in (*HORIZONTAL_ROLES, *VERTICAL_ROLES):
            continue
        places = _adjacent_angle_parts(columns, place, stem)
        if not places and degrees_match is not None:
            places = _angle_parts_with_stem(columns, stem)
        if places:
            joined_columns[place] = TableColumn(place, column.title, role, "deg", angle_part_positions=places)
            for other in places:
                joined_columns[other] = TableColumn(other, columns[other].title, ANGLE_PART_ROLE)
    return joined_columns


def _adjacent_angle_parts(columns: Sequence[TableColumn], place: int, stem: str) -> tuple[int, ...]:
    """Positions of the columns of minutes and seconds directly after the column of degrees at position `place`.

    `stem` is the title of the degrees without unit.
    """
    names, after = [stem], columns[place + 1 : place + 3]
    has_letters = [c.title.casefold() for c in after] == ["m", "s"]
    for form, column in zip(_ANGLE_PART_PATTERNS[1:], after, strict=False):
        part = _match_unit_ending(form, column.title)
        letter = len(column.title) == 1 and column.title.isalpha() and not has_letters
        whole_word = part is not None and not part[1] and not letter
        if part is None or not (whole_word or normalised_title(part[1]) == normalised_title(stem)):
            break
        names.append(part[1])
    return tuple(range(place + 1, place + len(names)))


def _angle_parts_with_stem(columns: Sequence[TableColumn], stem: str) -> tuple[int, ...]:
    """Positions of the columns of minutes and seconds with the title `stem` (without unit); empty without minutes."""
    positions: list[int] = []
    for form in _ANGLE_PART_PATTERNS[1:]:
        matches = ((c.position, _match_unit_ending(form, c.title)) for c in columns)
        matching_positions = [
            place for place, m in matches if m is not None and normalised_title(m[1]) == normalised_title(stem)
        ]
        if not matching_positions:
            break
        positions.append(matching_positions[0])
    return tuple(positions)


def _count_reading_kinds(columns: Sequence[TableColumn]) -> int:
    """Number of kinds of readings in the columns, from 0 to 3: direction, vertical angle, distance."""
    roles = {column.role for column in columns}
    return sum(bool(roles.intersection(kind)) for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES))


def count_recognised_titles(fields: Sequence[str]) -> int:
    """Number of `fields` that are known titles of columns, alone or together with two others (`Tracker X`)."""
    return max(sum(map(_is_recognised_title, fields)), len(_axes_by_position(fields)))


def _axes_by_position(fields: Sequence[str]) -> dict[int, str]:
    """Axis, by position, of the three `fields` that are a common word with an axis and possibly a unit of lengths."""
    names = [name if unit in ("", *LENGTH_UNITS) else "" for name, unit in map(title_words_and_unit, fields)]
    return axes_of_titles_with_common_word(names)


@lru_cache(maxsize=65_536)
def _is_recognised_title(title: str) -> bool:
    """True if a title, with or without unit, is a known title of a column."""
    degrees_match = _match_unit_ending(_ANGLE_PART_PATTERNS[0], title)
    return bool(_column_from_title(0, title).role) or (degrees_match is not None and bool(title_role(degrees_match[1])))


def is_header(columns: Sequence[TableColumn], *, allows_unnamed: bool = False) -> bool:
    """True for titles of two kinds of reading, of directions and names, or of coordinates x, y, z and names.

    With `allows_unnamed`, coordinates need no names.
    """
    roles = {column.role for column in columns}
    has_named_directions = {"station", "target"} <= roles and not roles.isdisjoint(HORIZONTAL_ROLES)
    has_coordinates = has_named_coordinates(columns) or (allows_unnamed and {*COORDINATE_ROLES} <= roles)
    return has_named_directions or has_coordinates or _count_reading_kinds(columns) > 1


def has_named_coordinates(columns: Sequence[TableColumn]) -> bool:
    """True if the columns include names of targets and coordinates x, y, z."""
    return {"target", *COORDINATE_ROLES} <= {column.role for column in columns}


@lru_cache(maxsize=8192)
def title_words_and_unit(title: str) -> tuple[str, str]:
    """Title without unit in the form of `normalised_title`, and its unit ('' if it has none)."""
    if len(title) > MAX_TITLE_LENGTH:
        return "", ""
    name, unit = split_title_and_unit(title)
    if not unit:
        parts = re.split(r"[\s_]+", title.strip())
        if len(parts) > 1 and parts[-1].lower() in UNIT_BY_SPELLING and title_role("".join(parts[:-1])):
            name, unit = " ".join(parts[:-1]), UNIT_BY_SPELLING[parts[-1].lower()]
    return normalised_title(name), unit


def title_role(name: str) -> str:
    """Role (content of the column) that a title without unit denotes, such as `sigma_azimuth_arcsec` for `haerror`.

    The result is '' for an unknown title.
    """
    name = normalised_title(name)
    if name in ROLE_BY_TITLE:
        return ROLE_BY_TITLE[name]
    value_match = _VALUE_ENDING_PATTERN.fullmatch(name)
    if value_match is not None and value_match[1] in ROLE_BY_TITLE:
        return ROLE_BY_TITLE[value_match[1]]
    number_match = _NUMBER_ENDING_PATTERN.fullmatch(name)
    if number_match is not None and ROLE_BY_TITLE.get(number_match[1]) in ROLES_WITH_NUMBER_ENDINGS:
        return ROLE_BY_TITLE[number_match[1]]
    for abbreviation, words in FULL_WORDS_BY_ABBREVIATION.items():
        if name.startswith(abbreviation):
            titles = (word + name.removeprefix(abbreviation) for word in words)
            if role := next((ROLE_BY_TITLE[title] for title in titles if title in ROLE_BY_TITLE), ""):
                return role
    stems = [match[1] for form in _SIGMA_TITLE_PATTERN if (match := form.fullmatch(name))]
    return next((SIGMA_ROLES[ROLE_BY_TITLE[stem]] for stem in stems if ROLE_BY_TITLE.get(stem) in SIGMA_ROLES), "")


def normalised_title(text: str) -> str:
    """Title in lower case, reduced to Latin letters without accents, East Asian letters, and digits."""
    letters = re.sub("[\u0300-\u036f]", "", unicodedata.normalize("NFKD", text.casefold()))
    return _REMOVED_CHARACTERS_PATTERN.sub("", unicodedata.normalize("NFC", letters))


def _column_from_title(position: int, title: str, *, has_face: bool = True) -> TableColumn:
    """Column at `position` with the role (content), unit and, if `has_face`, face that its title implies."""
    name, unit = title_words_and_unit(title)
    role, face = title_role(name) or (LETTERS_OF_HEIGHTS.get(name, "") if unit in LENGTH_UNITS else ""), 0
    face_match = _FACE_NUMBER_PATTERN.fullmatch(name) if has_face and not role else None
    if face_match is not None:
        role = title_role(face_match.group(1))
        face = {"1": 1, "i": 1, "2": 2, "ii": 2}[face_match.group(2).lower()] if role else 0
    if role == "round" and unit in UNITS_BY_ROLE["time"]:  # an epoch in seconds is a moment
        role = "time"
    if role in UNITS_BY_ROLE and unit and unit not in UNITS_BY_ROLE[role]:
        # surveyors' lists have heights in a column called elevation
        is_zenith = name == "z" and unit in ANGLE_UNITS
        role, face = "zenith" if is_zenith else "z" if role == "elevation" and unit in LENGTH_UNITS else "", 0
    return TableColumn(position, title, role, unit, face)


def split_title_and_unit(text: str) -> tuple[str, str]:
    """Title without the unit in brackets at its end, and this unit ('' if there is none)."""
    bracket_match = _UNIT_IN_BRACKETS_PATTERN.fullmatch(text)
    if bracket_match is None or not bracket_match[1]:
        return text, ""
    return bracket_match[1], UNIT_BY_SPELLING.get(bracket_match[2].lower(), bracket_match[2])


def reading_kind(role: str) -> str:
    """Kind of reading (``horizontal``, ``vertical``, ``distance``) of a role of columns; other roles unchanged."""
    for kind in (HORIZONTAL_ROLES, VERTICAL_ROLES, DISTANCE_ROLES):
        if role in kind:
            return kind[0]
    return role
