"""Parsers for the text of one cell: numbers, angles with units, faces, dates and times."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timedelta
from decimal import Decimal
from functools import partial
from typing import TypeVar

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.recordings.files import MAX_NUMBER_TEXT_LENGTH, NUMBER_PATTERN, is_number
from ltsim.recordings.spreadsheets.angle_cells import MAX_VALUE_TEXT_LENGTH, parse_sexagesimal

FACE_WORDS = (
    "1 1.0 i f1 face1 facei lage1 lagei 1st f front direct d l left links cl a",
    "2 2.0 ii f2 face2 faceii lage2 lageii 2nd b back reverse r right rechts cr",
)
"""Words that denote face 1, and words that denote face 2, separated by blanks."""
FACE_BY_WORD = {word: face for face, words in enumerate(FACE_WORDS, start=1) for word in words.split()}
"""Face (1 or 2) that each word denotes."""
MISSING_VALUE_TEXTS = frozenset(("-", "--", "---", "----", "-----", "\u2013", "\u2014", "n/a", "N/A", "#N/A"))
"""Texts that programs write into cells without value."""
ValueType = TypeVar("ValueType")
"""Type of a parsed cell."""
DAY_DURATION = timedelta(days=1)
"""Duration of a day."""
_CENTESIMAL_PATTERN = re.compile(
    r"([+-]?)\s*(\d{1,3})\s*g\s*(\d{1,2})\s*c\s*(\d{1,2}(?:[.,]\d+)?)\s*(?:cc)?", re.IGNORECASE
)
"""Pattern of an angle in gon with its hundredths (c) and ten-thousandths (cc), such as 43g71c20cc."""
UNIT_BY_SYMBOL = {
    **dict.fromkeys(("g", "gon", "gr", "grd", "ᵍ"), "gon"),
    **dict.fromkeys(("°", "º", "deg"), "deg"),
    **{unit: unit for unit in ("rad", "mm", "cm", "m", "ft", "in")},
}
"""Unit that each symbol after a number denotes."""
_NUMBER_WITH_UNIT_PATTERN = re.compile(
    rf"([+-]?\d[\d.,]*)\s*({'|'.join(sorted(UNIT_BY_SYMBOL, key=len, reverse=True))})", re.IGNORECASE
)
"""Pattern of a number followed by a symbol in `UNIT_BY_SYMBOL`."""
_NUMBER_CHARACTERS_PATTERN = re.compile(r"[0-9.+eE-]*")
"""Pattern of the characters of decimal numbers that blanks separate."""
_TIME_OF_DAY_PATTERN = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9}))?)?(?:\s*([AaPp])\.?[Mm]\.?)?")
"""Pattern of a time of day with colons, of 24 or 12 hours: ``8:00:20.5``, ``8:00 pm``."""
_SPELLED_TIME_OF_DAY_PATTERN = re.compile(
    r"(\d{1,2})\s*h\s*(\d{1,2})(?:\s*m(?:in)?\s*(\d{1,2})(?:[.,](\d{1,9}))?\s*s?)?()", re.I
)
"""Pattern of a time of day with letters: ``8h00m20.5s``, ``8h00``."""
_MONTH_NAMES = (
    "jan january januar",
    "feb february februar",
    "mar march mär märz maerz mrz",
    "apr april",
    "may mai",
    "jun june juni",
    "jul july juli",
    "aug august",
    "sep sept september",
    "oct october okt oktober",
    "nov november",
    "dec december dez dezember",
)
"""English and German names of each month from January to December, separated by blanks."""
_MONTH_BY_NAME = {name: str(number) for number, names in enumerate(_MONTH_NAMES, start=1) for name in names.split()}
"""Number of the month, as text, that each name denotes."""
_MONTH_NAME_PATTERN = re.compile(r"(\d{1,2})[.\s-]*([^\W\d_]+)[.,\s-]+(\d{4})|([^\W\d_]+)\.?\s+(\d{1,2}),?\s+(\d{4})")
"""Pattern of a date with the name of its month: ``1-Mar-2026``, ``1. März 2026``, ``Mar 1, 2026``."""
_COMPACT_STAMP_PATTERN = re.compile(
    r"(\d{4})(\d{2})(\d{2})[T ](\d{2}):?(\d{2}):?(\d{2}(?:[.,]\d+)?)(Z|[+-]\d{2}:?\d{2})?"
)
"""Pattern of a date and time in the basic format of ISO 8601: ``20260301T080020``."""
_DATE_ORDERS = ("ymd", "dmy", "mdy")
"""Possible orders of year, month and day in dates, the most likely first."""
_DATE_ORDERS_12_HOURS = ("ymd", "mdy", "dmy")
"""Possible orders of year, month and day in dates with a 12-hour time (am, pm), the most likely first."""
_DATE_PATTERN = re.compile(r"(\d{1,4})([-/.])(\d{1,2})\2(\d{1,4})")
"""Pattern of a date of three numbers with the same separator twice."""


_POINT_GROUPS_PATTERN = re.compile(r"[+-]?\d+(?:\.\d{3})+,.*", re.ASCII)
"""Pattern of a number with decimal comma, and with points between groups of three digits."""


def python_number_text(text: str) -> str:
    """Number in Python's notation, from a text with decimal comma or point and possibly a degree symbol."""
    text = text.strip().removesuffix("°").replace("\u2212", "-").replace("\u00a0", "").strip()
    comma, point = text.rfind(","), text.rfind(".")
    if comma < 0:
        return text
    thousands_separator = "." if comma > point else ","
    if point >= 0 and comma > point and not _POINT_GROUPS_PATTERN.fullmatch(text):
        return text
    return text.replace(thousands_separator, "").replace(",", ".") if point >= 0 else text.replace(",", ".", 1)


_GROUPED_NUMBER_PATTERN_BY_MARK = {mark: re.compile(rf"[+-]?\d{{1,3}}(?:\{mark}\d{{3}})+", re.ASCII) for mark in ".,"}
"""Pattern of a number with separated groups of three digits, by their separator (point or comma)."""
_COMMA_AND_POINT_PATTERN_BY_MARK = {
    mark: re.compile(_GROUPED_NUMBER_PATTERN_BY_MARK[mark].pattern + rf"[{other}]\d+", re.ASCII)
    for mark, other in (".,", ",.")
}
"""Pattern of a number with a comma and a point, by the mark that separates groups of three digits."""


def detect_thousands_separator(sheet_rows: Iterable[Sequence[str]], file: object) -> str:
    """Thousands separator in the numbers of a sheet, point or comma; '' if there is none.

    For example, ``7.000,5`` in a cell shows that ``7.000`` in another cell is 7000. Raises RecordError, which names
    `file`, if both separators occur.
    """
    mixed_cells = (cell for row in sheet_rows for cell in row if "," in cell and "." in cell)
    cell_by_separator = {
        mark: cell
        for cell in mixed_cells
        for mark, form in _COMMA_AND_POINT_PATTERN_BY_MARK.items()
        if form.fullmatch(cell)
    }
    if len(cell_by_separator) > 1:
        raise RecordError(
            f"the file contains numbers written as {cell_by_separator['.']} and as {cell_by_separator[',']}; "
            "use one notation",
            file=file,
        )
    return next(iter(cell_by_separator), "")


def is_numeric(text: str) -> bool:
    """True if the text of a cell is a number, or an angle in degrees, minutes and seconds."""
    return len(text) <= MAX_VALUE_TEXT_LENGTH and (
        is_number(text)
        or is_number(python_number_text(text))
        or parse_sexagesimal(text) is not None
        or split_unit_symbol(text) is not None
    )


def is_number_or_angle_with_point(text: str) -> bool:
    """True if the text of a cell is a number without comma, or an angle in degrees, minutes and seconds."""
    return is_number(text) or (len(text) <= MAX_VALUE_TEXT_LENGTH and parse_sexagesimal(text) is not None)


def split_unit_symbol(text: str) -> tuple[str, str] | None:
    """Number and unit in a cell with a unit symbol (``43.71 gon``, ``43g71c20cc``, ``12.5 m``); otherwise None."""
    text = text.strip()
    if len(text) > MAX_VALUE_TEXT_LENGTH or text[-1:].isdigit():
        return None
    centesimal_match = _CENTESIMAL_PATTERN.fullmatch(text)
    if centesimal_match is not None:
        sign, gons, minutes, seconds = centesimal_match.groups()
        parts = Decimal(minutes) * 100 + Decimal(seconds.replace(",", "."))
        return f"{sign}{Decimal(gons) + parts / 10_000}", "gon"
    marked_match = _NUMBER_WITH_UNIT_PATTERN.fullmatch(text)
    return None if marked_match is None else (marked_match[1], UNIT_BY_SYMBOL[marked_match[2].casefold()])


def split_common_unit(texts: Sequence[str]) -> tuple[Sequence[str], str]:
    """Cells without their unit symbol, and the unit, if all have one unit; otherwise unchanged cells and ''."""
    filled = list(filter(None, texts))
    first_split = split_unit_symbol(filled[0]) if filled else None
    if first_split is None:
        return texts, ""
    split = [split_unit_symbol(text) if text else ("", first_split[1]) for text in texts]
    if any(pair is None or pair[1] != first_split[1] for pair in split):
        return texts, ""
    return [pair[0] for pair in split if pair is not None], first_split[1]


def is_sexagesimal(text: str) -> bool:
    """True if a cell is an angle in degrees, minutes and seconds, not a plain number."""
    return not is_number(python_number_text(text)) and parse_sexagesimal(text) is not None


def parse_number(text: str, thousands_separator: str = "") -> Decimal | None:
    """Exact value of a cell that is a plain number; None for any other cell.

    `thousands_separator` is the separator used in the sheet, '' for none.
    """
    text = text.strip()
    if len(text) > MAX_VALUE_TEXT_LENGTH:
        return None
    digits = python_number_text(
        text.replace(thousands_separator, "")
        if thousands_separator and _GROUPED_NUMBER_PATTERN_BY_MARK[thousands_separator].fullmatch(text)
        else text
    )
    return Decimal(digits) if is_number(digits) else None


def plain_numbers(texts: Sequence[str]) -> Floats | None:
    """Numbers (n,) in n cells, NaN for an empty cell; None if a cell is not a decimal number in ASCII."""
    joined_text = "".join(texts)
    if max(map(len, texts), default=0) > MAX_NUMBER_TEXT_LENGTH or not _NUMBER_CHARACTERS_PATTERN.fullmatch(
        joined_text
    ):
        return None
    if "e" in joined_text.lower() and not all(map(NUMBER_PATTERN.fullmatch, filter(None, texts))):
        return None
    try:
        return np.array([float(text or "nan") for text in texts], dtype=np.float64)
    except ValueError:
        return None


def exact_numbers(texts: Sequence[str], thousands_separators: Sequence[str]) -> Iterator[Decimal | None]:
    """Exact values of the numbers in cells, each with its thousands separator; None for other cells and for times."""
    return map(parse_number_or_angle_unless_time, texts, thousands_separators)


def parse_number_or_angle(text: str, thousands_separator: str = "") -> Decimal | None:
    """Exact value of a number, or of an angle in degrees, minutes and seconds [deg], in a cell; None for other cells.

    `thousands_separator` is the separator used in the sheet, '' for none.
    """
    plain_number = parse_number(text, thousands_separator)
    return parse_sexagesimal(text) if plain_number is None else plain_number


def parse_number_or_angle_unless_time(text: str, thousands_separator: str = "") -> Decimal | None:
    """Exact value of a number or angle [deg] in a cell; None for other cells, such as a date or a time.

    `thousands_separator` is the separator used in the sheet, '' for none.
    """
    return None if not is_number(text) and is_date_or_time(text) else parse_number_or_angle(text, thousands_separator)


def parse_face(text: str) -> int | None:
    """Face 1 or 2 that a cell denotes; None for any other cell."""
    return FACE_BY_WORD.get(re.sub(r"[\s._-]", "", text.casefold()) if text not in ("1.0", "2.0") else text)


def parse_times(texts: Sequence[str], date_order: str | None = None) -> tuple[list[float] | None, str]:
    """Seconds of dates or times after the earliest of them, and the earliest one in ISO format.

    `date_order` is the order of day and month in dates with slashes, ``dmy`` or ``mdy``. The result is (None, "") if a
    text is not a date or time, and (None, "?") if the order of day and month is ambiguous.
    """
    texts = [_without_apostrophe(text) for text in texts]
    clocks = _convert_texts(_parse_time_of_day, texts)
    if clocks is not None:
        return _seconds_since_first([datetime.min + clock for clock in _unwrap_midnight(clocks)], has_date=False)
    orders = _DATE_ORDERS_12_HOURS if texts and texts[0][-2:].casefold() in ("am", "pm") else _DATE_ORDERS
    stamps_by_order = (
        _convert_texts(partial(_parse_date_and_time, letters=letters, date_order=date_order), texts)
        for letters in orders
    )
    readings = [_seconds_since_first(stamps, has_date=True) for stamps in stamps_by_order if stamps is not None]
    if any(seconds != readings[0][0] for seconds, _ in readings):
        return None, "?"
    return readings[0] if readings else (None, "")


def _convert_texts(convert: Callable[[str], ValueType | None], texts: Sequence[str]) -> list[ValueType] | None:
    """Results of `convert` for all texts; None if one of them is None."""
    converted = []
    for text in texts:
        value_of_text = convert(text)
        if value_of_text is None:
            return None
        converted.append(value_of_text)
    return converted


def is_date_or_time(text: str) -> bool:
    """True if the text of a cell is a date, a time of day or both."""
    return has_time_of_day(text) or any(
        _parse_date_and_time(_without_apostrophe(text), letters, None) is not None for letters in _DATE_ORDERS
    )


def has_time_of_day(text: str) -> bool:
    """True if the text of a cell contains a time of day, with or without a date."""
    plain_text = _without_apostrophe(text)
    return (
        ":" in plain_text or "h" in plain_text.lower() or _COMPACT_STAMP_PATTERN.fullmatch(plain_text) is not None
    ) and (
        _parse_time_of_day(plain_text) is not None
        or any(_parse_date_and_time(plain_text, letters, None) is not None for letters in _DATE_ORDERS)
    )


def _without_apostrophe(text: str) -> str:
    """Date or time without the leading apostrophe that spreadsheets use to mark a text."""
    return text.strip().removeprefix("'").strip()


def _seconds_since_first(stamps: list[datetime], *, has_date: bool) -> tuple[list[float], str]:
    """Seconds of each of the `stamps` after the earliest, and the earliest in ISO format (with date if `has_date`)."""
    earliest = min(stamps)
    moment = earliest.isoformat() if has_date else earliest.time().isoformat()
    return [(stamp - earliest).total_seconds() for stamp in stamps], moment


def _unwrap_midnight(clocks: list[timedelta]) -> list[timedelta]:
    """Times since the first midnight, from times of day in order; a decrease by over half a day adds one day."""
    days, last, unwrapped = timedelta(0), clocks[0], []
    for clock in clocks:
        if last - clock > DAY_DURATION / 2:
            days += DAY_DURATION
        last = clock
        unwrapped.append(clock + days)
    return unwrapped


def _parse_time_of_day(text: str) -> timedelta | None:
    """Time of day in a text, as time since midnight; None for any other text."""
    match = _TIME_OF_DAY_PATTERN.fullmatch(text.strip()) or _SPELLED_TIME_OF_DAY_PATTERN.fullmatch(text.strip())
    if match is None:
        return None
    hours, minutes, seconds = (int(part or 0) for part in match.groups()[:3])
    day_half = (match.group(5) or "").lower()
    if hours > 23 or minutes > 59 or seconds > 60 or (day_half and not 1 <= hours <= 12):
        return None
    if day_half:
        hours = hours % 12 + (12 if day_half == "p" else 0)
    return timedelta(
        hours=hours, minutes=minutes, seconds=seconds, microseconds=float("0." + (match.group(4) or "0")) * 1e6
    )


def _with_numeric_month(text: str) -> str:
    """Date and time as text with the number of the month and with separators between all parts."""
    compact = _COMPACT_STAMP_PATTERN.fullmatch(text)
    if compact is not None:
        year, month, day, hours, minutes, seconds, _ = compact.groups()
        return f"{year}-{month}-{day} {hours}:{minutes}:{seconds}"
    match = _MONTH_NAME_PATTERN.match(text)
    if match is None:
        return text
    day, name, year = match.group(1, 2, 3) if match[1] else match.group(5, 4, 6)
    month = _MONTH_BY_NAME.get(name.casefold())
    return text if month is None else f"{year}-{month}-{day}{text[match.end() :].replace(',', ' ', 1)}"


def _parse_date_and_time(text: str, letters: str, date_order: str | None) -> datetime | None:
    """Date, with or without time of day, whose parts are in the order `letters` (such as "dmy"); None for other texts.

    If `date_order` is "dmy" or "mdy", dates in the other of these two orders are not accepted. The time zone is
    ignored, because all times of a file have the same one.
    """
    day, _, clock_text = re.sub(r"(?<=\d)T(?=\d)", " ", _with_numeric_month(text.strip())).partition(" ")
    clock_text = re.sub(r"(Z|[+-]\d{2}:?\d{2})$", "", clock_text.strip())
    match, clock_time = _DATE_PATTERN.fullmatch(day), _parse_time_of_day(clock_text) if clock_text else timedelta(0)
    if match is None or clock_time is None or (len(match[1]) == 4) != (letters == "ymd"):
        return None
    is_excluded = letters == "mdy" if match[2] == "." else letters != "ymd" and date_order not in (None, letters)
    number_by_letter = {letter: int(part) for letter, part in zip(letters, match.group(1, 3, 4), strict=True)}
    year = number_by_letter["y"] + (2000 if number_by_letter["y"] < 100 else 0)
    if is_excluded or year < 1000:
        return None
    try:
        return datetime(year, number_by_letter["m"], number_by_letter["d"]) + clock_time
    except ValueError:
        return None
