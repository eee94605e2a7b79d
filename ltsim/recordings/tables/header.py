"""Meaning of a header: roles of columns from English and German titles, units in brackets, faces by number."""

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from ltsim.core.errors import RecordError
from ltsim.core.units import ANGLES, LENGTHS, NAMED, SMALL_ANGLES
from ltsim.recordings.files import shown

HORIZONTAL = ("horizontal", "azimuth")
VERTICAL = ("vertical", "zenith", "elevation")
DISTANCE = ("distance", "flat")
PLACE = ("x", "y", "z")
READINGS = (*HORIZONTAL, *VERTICAL, *DISTANCE, *PLACE)
HEIGHTS = ("instrument_height_mm", "target_height_mm")
SIGMA_OF = {
    **dict.fromkeys(DISTANCE, "sigma_distance_mm"),
    **dict.fromkeys(HORIZONTAL, "sigma_azimuth_arcsec"),
    **dict.fromkeys(VERTICAL, "sigma_elevation_arcsec"),
    **{axis: f"sigma_{axis}_mm" for axis in PLACE},
}
"""Role of the column with the standard deviation of another column, by the role of that column."""
SIGMA = "sigma_mm"
"""Role of a column with one standard deviation for all three coordinates."""
WORDS = {
    "station": "station stn st setup standpunkt stp stand standort stationname stationid from fromstn fromstation von "
    "instrument tracker stationsname setupname",
    "target": "target point pt name punkt pkt punktnummer punktname pnr pointname pointid pointnumber targetname "
    "targetid feature featurename id to tostn tostation nach reflector smr zielpunkt ziel nest nr nummer no",
    "face": "face f lage kreislage circlelage visierlage",
    "repeat": "repeat repetition rep wiederholung",
    "round": "round obsset satz setnumber satznummer",
    "horizontal": "hz ha hor horizontal horizontalangle hzangle horizontalrichtung hzrichtung richtung direction "
    "horizontalwinkel hzwinkel hcircle hzcircle horizontalcircle",
    "azimuth": "azimuth az azimut azi azimuthangle azimutwinkel",
    "vertical": "v va vertical verticalangle vertikalwinkel vwinkel vangle vcircle verticalcircle",
    "zenith": "zenith za zd zen zenithangle zenit zenitwinkel zenitdistanz zenithdistance",
    "elevation": "elevation el elev elevationangle hohenwinkel hoehenwinkel altitudeangle",
    "distance": "distance dist d sd slopedist slopedistance slope range r schragdistanz schraegdistanz schragstrecke "
    "schraegstrecke strecke distanz raumstrecke distance3d sdist",
    "flat": "hd horizontaldistance horizontaldist horizontalstrecke horizontaldistanz hdist",
    "x": "x xactual actualx xmeas measx xist istx e east easting rechtswert rw ost ostwert xcoordinate xkoordinate",
    "y": "y yactual actualy ymeas measy yist isty n north northing hochwert hw nord nordwert ycoordinate ykoordinate",
    "z": "z zactual actualz zmeas measz zist istz h height hohe hoehe zcoordinate zkoordinate",
    SIGMA: "sigma stddev std sigmaxyz",
    "time": "time zeit timestamp zeitstempel zeitpunkt datetime utc uhrzeit clock clocktime times measuredat",
    "date": "date datum day",
    "instrument_height_mm": "instrumentheight insthgt insthgtm ih hi fromhgt stationheight instrumentenhohe "
    "instrumentenhoehe instrumenthohe geratehohe geraetehoehe kippachshohe standpunkthohe",
    "target_height_mm": "targetheight tohgt th ht hr reflectorheight prismheight rodheight zielhohe zielhoehe "
    "zielpunkthohe reflektorhohe prismenhohe tafelhohe",
    "instrument_setup": "isetupid instrumentsetup instrumentsetupid",
    "target_setup": "tsetupid targetsetup targetsetupid",
    "air_temperature_c": "airtemperature airtemp lufttemperatur",
    "air_pressure_hpa": "airpressure pressure luftdruck",
    "relative_humidity_pct": "relativehumidity humidity luftfeuchte luftfeuchtigkeit",
}
ROLE_OF = {word: role for role, words in WORDS.items() for word in words.split()}
ROLE_UNITS = {
    **dict.fromkeys((*HORIZONTAL, *VERTICAL), ANGLES),
    **dict.fromkeys((*DISTANCE, *PLACE, *HEIGHTS, SIGMA, "sigma_distance_mm"), LENGTHS),
    **dict.fromkeys((f"sigma_{axis}_mm" for axis in PLACE), LENGTHS),
    **dict.fromkeys(("sigma_azimuth_arcsec", "sigma_elevation_arcsec"), SMALL_ANGLES),
    "time": ("s", "ms", "min", "h"),
    "air_temperature_c": ("c", "deg"),
    "air_pressure_hpa": ("hpa",),
    "relative_humidity_pct": ("%",),
}
"""Permitted units by role; a column in another unit does not have the role."""
FALLBACK_TARGET_TITLES = ("nr", "nummer", "no", "id")
"""Titles that mean the target if no other title does."""
MAPPED = tuple(dict.fromkeys((*WORDS, *SIGMA_OF.values())))
MAX_TITLE_LENGTH = 80
"""Largest number of characters of a cell that is a possible title."""
_BRACKET = re.compile(r"(.*?)\s*[\[({]\s*([^\])}]*?)\s*[\])}]?\s*")
_FACED = re.compile(r"(.*?)[\s._-]*(?:(?:face|lage|f|l)[\s._-]*)?(1|2|ii|i)", re.IGNORECASE)
_SIGMAS = (re.compile(r"(?:sigma|stddev|std|sd|s)([a-z]+)"), re.compile(r"([a-z]+?)(?:error|err|sigma|stddev|std|sd)"))
MARKS = ("°", "'", '"')
PART_ROLE = "part"
"""Role of a column with the minutes or seconds of an angle whose degrees are in an earlier column."""
_PARTS = tuple(
    re.compile(rf"(.*?)[\s_.-]*[\[({{]?\s*(?:{words})\s*[\])}}]?", re.IGNORECASE)
    for words in (
        "d|deg|degrees?|grad|°|º",
        "m|min|minutes?|minuten|'|′|’",
        "s|sec|seconds?|sek|sekunden|\"|″|”|''",
    )
)
_VALUE = re.compile(r"([a-z0-9]+?)(?:value|reading|obs|raw)")


@dataclass(frozen=True)
class TableColumn:
    """Column of a table: position, title, role ('' for none), unit ('' if not given) and face (0: any)."""

    place: int
    title: str
    role: str = ""
    unit: str = ""
    face: int = 0
    parts: tuple[int, ...] = ()
    """Positions of the columns with minutes and seconds of an angle whose degrees are in this column."""

    def texts(self, table: Sequence[Sequence[str]]) -> Sequence[str]:
        """Cells of the column in a table by column; degrees, minutes and seconds of several columns are joined."""
        if not self.parts:
            return table[self.place]
        parts = zip(*(table[place] for place in (self.place, *self.parts)), strict=True)
        return [" ".join(cell + mark for cell, mark in zip(row, MARKS, strict=False) if cell) for row in parts]

    @property
    def is_further(self) -> bool:
        """True for an additional column that is retained: it has a title and is not part of a pointing."""
        return bool(self.title) and (not self.role or "_" in self.role or self.role == "round")


def columns_of(fields: Sequence[str]) -> list[TableColumn]:
    """Columns of a header (cached), each with the role and unit of its title; see `_columns_of`."""
    return list(_columns_of(tuple(fields)))


@lru_cache(maxsize=64)
def _columns_of(fields: tuple[str, ...]) -> list[TableColumn]:
    """Columns of a header, each with the role and unit of its title.

    If two columns have one role, the first one gets it. Faces are distinguished if every reading has two columns.
    Coordinates in a table of polar readings are further columns.
    """
    candidates = _with_parts([_column(place, title) for place, title in enumerate(fields)])
    both = {c.role for c in candidates if c.face == 1} & {c.role for c in candidates if c.face == 2}
    polar = _kinds_in(candidates) > 1
    named = {words_of(c.title)[0] for c in candidates if c.role == "target"}
    columns: list[TableColumn] = []
    taken: set[tuple[str, int]] = set()
    for column in candidates:
        assigned = column
        if assigned.face and assigned.role not in both:
            assigned = _column(assigned.place, assigned.title, faced=False)
        if (
            assigned.role == "target"
            and words_of(assigned.title)[0] in FALLBACK_TARGET_TITLES
            and not named <= {*FALLBACK_TARGET_TITLES}
        ):
            assigned = replace(assigned, role="")
        if assigned.role and ((assigned.role, assigned.face) in taken or (polar and assigned.role in (*PLACE, SIGMA))):
            assigned = replace(assigned, role="", face=0)
        if assigned.role != PART_ROLE:
            taken.add((assigned.role, assigned.face))
        columns.append(assigned)
    return distinct_titles(columns)


def distinct_titles(columns: Sequence[TableColumn]) -> list[TableColumn]:
    """Columns with a number added to each repeated title, because titles are the keys of additional columns."""
    before: Counter[str] = Counter()
    distinct = []
    for column in columns:
        before[column.title] += 1
        again = column.title and before[column.title] > 1
        distinct.append(replace(column, title=f"{column.title} ({before[column.title]})") if again else column)
    return distinct


def _part(form: re.Pattern[str], title: str) -> re.Match[str] | None:
    """Match of a title that ends with a unit; None if there is none or the title is too long."""
    return form.fullmatch(title) if len(title) <= MAX_TITLE_LENGTH else None


def _with_parts(columns: list[TableColumn]) -> list[TableColumn]:
    """Columns in which degrees, minutes and (optionally) seconds of one angle in adjacent columns are joined."""
    joined = list(columns)
    for place, column in enumerate(columns):
        stem = _part(_PARTS[0], column.title)
        names = [stem[1] if stem is not None else column.title]
        for form, after in zip(_PARTS[1:], columns[place + 1 : place + 3], strict=False):
            part = _part(form, after.title)
            whole_word = part is not None and not part[1] and not (len(after.title) == 1 and after.title.isalpha())
            if part is None or not (whole_word or _folded(part[1]) == _folded(names[0])):
                break
            names.append(part[1])
        role = role_of(names[0])
        if len(names) > 1 and role in (*HORIZONTAL, *VERTICAL):
            places = tuple(range(place + 1, place + len(names)))
            joined[place] = TableColumn(place, column.title, role, "deg", parts=places)
            for other in places:
                joined[other] = TableColumn(other, columns[other].title, PART_ROLE)
    return joined


def _kinds_in(columns: Sequence[TableColumn]) -> int:
    roles = {column.role for column in columns}
    return sum(bool(roles.intersection(kind)) for kind in (HORIZONTAL, VERTICAL, DISTANCE))


def count_of_roles(fields: Sequence[str]) -> int:
    """Number of fields that have a role as a title: a quick test, since a header has at least two."""
    return sum(map(_has_role, fields))


@lru_cache(maxsize=65_536)
def _has_role(title: str) -> bool:
    degrees = _part(_PARTS[0], title)
    return bool(_column(0, title).role) or (degrees is not None and bool(role_of(degrees[1])))


def is_header(columns: Sequence[TableColumn]) -> bool:
    """True for a header: two of direction, vertical angle and distance, or all three coordinates."""
    return _kinds_in(columns) > 1 or has_named_coordinates(columns)


def has_named_coordinates(columns: Sequence[TableColumn]) -> bool:
    """True if the columns include x, y, z of named targets."""
    return {"target", *PLACE} <= {column.role for column in columns}


@lru_cache(maxsize=8192)
def words_of(title: str) -> tuple[str, str]:
    """Words of a title without punctuation and accents, and its unit ('' if it has none)."""
    if len(title) > MAX_TITLE_LENGTH:
        return "", ""
    name, unit = _titled(title)
    if not unit:
        parts = re.split(r"[\s_]+", title.strip())
        if len(parts) > 1 and parts[-1].lower() in NAMED and role_of("".join(parts[:-1])):
            name, unit = " ".join(parts[:-1]), NAMED[parts[-1].lower()]
    return _folded(name), unit


def role_of(name: str) -> str:
    """Role of a title, such as `haerror` for the sigma of a direction; '' for none."""
    name = _folded(name)
    if name in ROLE_OF:
        return ROLE_OF[name]
    value = _VALUE.fullmatch(name)
    if value is not None and value[1] in ROLE_OF:
        return ROLE_OF[value[1]]
    stems = [match[1] for form in _SIGMAS if (match := form.fullmatch(name))]
    return next((SIGMA_OF[ROLE_OF[stem]] for stem in stems if ROLE_OF.get(stem) in SIGMA_OF), "")


def _folded(text: str) -> str:
    bare = "".join(c for c in unicodedata.normalize("NFKD", text.casefold()) if not unicodedata.combining(c))
    return re.sub(r"[^a-z0-9]", "", bare)


def _column(place: int, title: str, *, faced: bool = True) -> TableColumn:
    name, unit = words_of(title)
    role, face = role_of(name), 0
    numbered = _FACED.fullmatch(name) if faced and not role else None
    if numbered is not None:
        role = role_of(numbered.group(1))
        face = {"1": 1, "i": 1, "2": 2, "ii": 2}[numbered.group(2).lower()] if role else 0
    if role in ROLE_UNITS and unit and unit not in ROLE_UNITS[role]:
        # surveyors' lists have heights in a column called elevation
        role, face = ("z" if role == "elevation" and unit in LENGTHS else ""), 0
    return TableColumn(place, title, role, unit, face)


def mapped(fields: Sequence[str], wanted: str, file: object) -> list[TableColumn] | None:
    """Columns of a header by ``role=Header[unit],...``; None if a named title is missing.

    A title that is a number counts columns from 1; ``role=Degrees+Minutes+Seconds`` joins columns. Other roles follow
    from the titles.

    Raises RecordError for a role or a unit that is not known.
    """
    columns = columns_of(fields)
    assigned: dict[int, TableColumn] = {}
    for role, face, title, unit in assignments(wanted, file):
        place, *parts = _places(fields, title) or (None,)
        if place is None:
            return None
        assigned[place] = TableColumn(place, fields[place], role, unit or columns[place].unit, face, tuple(parts))
        assigned |= {part: TableColumn(part, fields[part], PART_ROLE) for part in parts}
    kinds = {_kind(column.role) for column in assigned.values()}
    rest = [c if _kind(c.role) not in kinds else replace(c, role="", face=0) for c in columns]
    return [assigned.get(c.place, c) for c in rest]


def assignments(wanted: str, file: object = None) -> list[tuple[str, int, str, str]]:
    """Role, face (0: any), title and unit ('': not given) of every ``role=Header[unit]``."""
    roles = []
    for part in filter(None, (p.strip() for p in wanted.split(","))):
        role, equals, title = part.partition("=")
        stem, face = role.strip().lower(), 0
        if stem[-1:] in ("1", "2"):
            stem, face = stem[:-1], int(stem[-1])
        if not equals or stem not in MAPPED or not title.strip():
            message = f"--columns {shown(part, 60)}: expected ROLE=HEADER[UNIT] with a role among {', '.join(MAPPED)}"
            raise RecordError(message, file=file)
        name, unit = _titled(title.strip())
        if unit and unit not in ROLE_UNITS.get(stem, ()):
            units = ", ".join(ROLE_UNITS.get(stem, ("none",)))
            raise RecordError(f"--columns {shown(part, 60)}: a unit of {stem} can be {units}", file=file)
        roles.append((stem, face, name, unit))
    return roles


def _titled(text: str) -> tuple[str, str]:
    """Title without the unit in brackets at its end, and that unit."""
    bracket = _BRACKET.fullmatch(text)
    if bracket is None or not bracket[1]:
        return text, ""
    return bracket[1], NAMED.get(bracket[2].lower(), bracket[2])


def _places(fields: Sequence[str], title: str) -> tuple[int, ...] | None:
    """Position of a title, or positions of degrees, minutes and seconds that `title` joins by plus signs.

    It is None if missing.
    """
    place = _place(fields, title)
    if place is not None or "+" not in title:
        return None if place is None else (place,)
    places = [_place(fields, part) for part in title.split("+")[: len(MARKS)]]
    return None if None in places else tuple(p for p in places if p is not None)


def _place(fields: Sequence[str], title: str) -> int | None:
    """Position of a title, given with or without its unit or as a column number; None if missing."""
    for fold in (str.strip, lambda text: _titled(text)[0].casefold()):
        wanted = fold(title)
        for place, field in enumerate(fields):
            if fold(field) == wanted:
                return place
    return int(title) - 1 if title.isdigit() and 0 < int(title) <= len(fields) else None


def _kind(role: str) -> str:
    for kind in (HORIZONTAL, VERTICAL, DISTANCE):
        if role in kind:
            return kind[0]
    return role
