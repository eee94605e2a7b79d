"""What a header means: roles of columns by the words of five languages, units in brackets, faces by number."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ltsim.errors import RecordError
from ltsim.recording.files import shown

WORDS = {
    "station": "station stn st setup standpunkt stp stand standort stazione estacion stationname stationid from von "
    "instrument tracker stationsname",
    "target": "target point pt name punkt pkt punktnummer punktname pnr pointname pointid pointnumber targetname "
    "targetid id to nach reflector smr cible punto zielpunkt ziel pointvise nombre nom puntoid nest",
    "face": "face f lage kreislage cercle faccia cara cerchio circlelage visierlage",
    "repeat": "repeat repetition rep wiederholung ripetizione repeticion",
    "horizontal": "hz ha hor horizontal horizontalangle hzangle horizontalrichtung hzrichtung richtung direction ah "
    "anglehorizontal angolorizzontale angoloorizzontale angulohorizontal horizontalwinkel hzwinkel direccion "
    "direzione hcircle hzcircle horizontalcircle",
    "azimuth": "azimuth az azimut azi azimuthangle azimutwinkel",
    "vertical": "v va vertical verticalangle vertikalwinkel vwinkel vangle anglevertical angoloverticale "
    "angulovertical vcircle verticalcircle",
    "zenith": "zenith za zen zenithangle zenit zenitwinkel zenitdistanz zenithdistance distancezenithale "
    "anglezenithal angulocenital angolozenitale cenit zenital zenithal",
    "elevation": "elevation el elev elevationangle hohenwinkel hoehenwinkel site anglesite angledesite elevacion "
    "elevazione altitudeangle",
    "distance": "distance dist d sd slopedist slopedistance slope range r di schragdistanz schraegdistanz "
    "schragstrecke schraegstrecke strecke distanz distanceinclinee distancia distanza distanciainclinada "
    "distanzainclinata raumstrecke distance3d sdist",
    "flat": "hd horizontaldistance horizontaldist horizontalstrecke horizontaldistanz dh hdist distancehorizontale",
    "time": "time zeit timestamp zeitstempel zeitpunkt datetime heure ora hora tempo temps utc uhrzeit clock "
    "clocktime times measuredat",
    "date": "date datum fecha data jour dia day",
    "sigma_distance_mm": "sigmadistance sigmad sd_distance sdd sdist stddevdistance sigmas sigmarange",
    "sigma_azimuth_arcsec": "sigmaazimuth sigmahz shz sigmaaz sigmahorizontal stddevhz",
    "sigma_elevation_arcsec": "sigmaelevation sigmav sv sigmael sigmazenith sigmavertical stddevv",
    "air_temperature_c": "airtemperature airtemp lufttemperatur",
    "air_pressure_hpa": "airpressure pressure luftdruck",
    "relative_humidity_pct": "relativehumidity humidity luftfeuchte luftfeuchtigkeit",
}
ROLE_OF = {word: role for role, words in WORDS.items() for word in words.split()}
UNITS = {
    **dict.fromkeys(("deg", "degree", "degrees", "°", "grad°", "degres", "gradi", "grados"), "deg"),
    **dict.fromkeys(("gon", "gons", "grad", "grads", "g", "gr", "neugrad"), "gon"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("dms", "ddmmss", "d m s", "° ' \"", "°'\"", "dd mm ss"), "dms"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("in", "inch", "inches", '"', "zoll"), "in"),
    **dict.fromkeys(("s", "sec", "second", "seconds", "sek"), "s"),
    **dict.fromkeys(("arcsec", "cc", "mgon", "um", "urad", "cm", "ft", "ms", "min", "h", "c", "°c", "hpa", "%"), ""),
}
UNITS |= {word: word for word, unit in UNITS.items() if not unit}
ALLOWED = {
    **dict.fromkeys(("horizontal", "azimuth", "vertical", "zenith", "elevation"), ("deg", "gon", "rad", "dms")),
    **dict.fromkeys(("distance", "flat"), ("mm", "m", "in", "cm", "ft", "um")),
    "time": ("s", "ms", "min", "h"),
    **dict.fromkeys(("sigma_azimuth_arcsec", "sigma_elevation_arcsec"), ("arcsec", "cc", "mgon", "urad", "deg", "gon")),
    "sigma_distance_mm": ("mm", "um", "m"),
    "air_temperature_c": ("c", "°c", "deg"),
    "air_pressure_hpa": ("hpa",),
    "relative_humidity_pct": ("%",),
}
HORIZONTAL = ("horizontal", "azimuth")
VERTICAL = ("vertical", "zenith", "elevation")
DISTANCE = ("distance", "flat")
MAPPED = (*(role for role in WORDS if "_" not in role),)
_BRACKET = re.compile(r"(.*?)\s*[\[({]\s*([^\])}]*?)\s*[\])}]?\s*")
_FACED = re.compile(r"(.*?)[\s._-]*(?:(?:face|lage|f|l)[\s._-]*)?(1|2|ii|i)", re.IGNORECASE)


@dataclass(frozen=True)
class Column:
    """One column: its place, header, role ('' for none), unit ('' where it states none) and face (0: any)."""

    place: int
    title: str
    role: str = ""
    unit: str = ""
    face: int = 0


def columns_of(fields: Sequence[str]) -> list[Column]:
    """Columns of a header, each with the role and unit that its words have.

    Of two columns for one role the first has it. Faces are told apart where every reading stands there twice.
    """
    found = [_column(place, title) for place, title in enumerate(fields)]
    both = {c.role for c in found if c.face == 1} & {c.role for c in found if c.face == 2}
    kept: list[Column] = []
    taken: set[tuple[str, int]] = set()
    for column in found:
        one = column
        if one.face and one.role not in both:
            one = replace(_column(one.place, one.title, faced=False))
        if one.role and (one.role, one.face) in taken:
            one = replace(one, role="", face=0)
        taken.add((one.role, one.face))
        kept.append(one)
    return kept


def is_header(columns: Sequence[Column]) -> bool:
    """Whether a direction, a vertical angle or a distance are among the columns: two of them at least."""
    roles = {column.role for column in columns}
    kinds = [bool(roles.intersection(kind)) for kind in (HORIZONTAL, VERTICAL, DISTANCE)]
    return sum(kinds) > 1


def words_of(title: str) -> tuple[str, str]:
    """The words of a header without marks and accents, and its unit ('' where it states none)."""
    name, unit = title, ""
    bracket = _BRACKET.fullmatch(title)
    if bracket is not None and bracket.group(1):
        name, unit = bracket.groups()
    else:
        parts = re.split(r"[\s_]+", title.strip())
        if len(parts) > 1 and parts[-1].lower() in UNITS and ROLE_OF.get(_folded("".join(parts[:-1]))):
            name, unit = " ".join(parts[:-1]), parts[-1]
    return _folded(name), UNITS.get(unit.strip().lower(), unit.strip())


def _folded(text: str) -> str:
    bare = "".join(c for c in unicodedata.normalize("NFKD", text.casefold()) if not unicodedata.combining(c))
    return re.sub(r"[^a-z0-9]", "", bare)


def _column(place: int, title: str, *, faced: bool = True) -> Column:
    name, unit = words_of(title)
    role, face = ROLE_OF.get(name, ""), 0
    numbered = _FACED.fullmatch(name) if faced and not role else None
    if numbered is not None:
        role = ROLE_OF.get(numbered.group(1), "")
        face = {"1": 1, "i": 1, "2": 2, "ii": 2}[numbered.group(2).lower()] if role else 0
    if role in ALLOWED and unit and unit not in ALLOWED[role]:
        role, face = "", 0
    return Column(place, title, role, unit, face)


def mapped(fields: Sequence[str], wanted: str, file: object) -> list[Column] | None:
    """Columns of a header by ``role=Header[unit],...``; None where the header lacks one that is named.

    A header that is a number counts columns from 1. Roles that are not named go by the words of the header.

    Raises
    ------
    RecordError
        For a role or a unit that is not known.
    """
    columns = columns_of(fields)
    said: dict[int, Column] = {}
    for role, face, title, unit in assignments(wanted, file):
        place = _place(fields, title)
        if place is None:
            return None
        said[place] = Column(place, fields[place], role, unit or columns[place].unit, face)
    kinds = {_kind(column.role) for column in said.values()}
    rest = [c if _kind(c.role) not in kinds else replace(c, role="", face=0) for c in columns]
    return [said.get(c.place, c) for c in rest]


def assignments(wanted: str, file: object = None) -> list[tuple[str, int, str, str]]:
    """Role, face (0: any), header and unit ('': not said) of every ``role=Header[unit]``."""
    found = []
    for part in filter(None, (p.strip() for p in wanted.split(","))):
        role, equals, title = part.partition("=")
        stem, face = role.strip().lower(), 0
        if stem[-1:] in ("1", "2"):
            stem, face = stem[:-1], int(stem[-1])
        if not equals or stem not in MAPPED or not title.strip():
            message = f"--columns {shown(part, 60)}: expected ROLE=HEADER[UNIT] with a role among {', '.join(MAPPED)}"
            raise RecordError(message, file=file)
        name, unit = _titled(title.strip())
        if unit and unit not in ALLOWED.get(stem, ()):
            known = ", ".join(ALLOWED.get(stem, ("none",)))
            raise RecordError(f"--columns {shown(part, 60)}: a unit of {stem} can be {known}", file=file)
        found.append((stem, face, name, unit))
    return found


def _titled(text: str) -> tuple[str, str]:
    bracket = _BRACKET.fullmatch(text)
    if bracket is None or not bracket.group(1):
        return text, ""
    return bracket.group(1), UNITS.get(bracket.group(2).lower(), bracket.group(2))


def _place(fields: Sequence[str], title: str) -> int | None:
    """Place of a header by its text with or without a unit, or by its number."""
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
