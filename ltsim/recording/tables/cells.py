"""What one cell says: a number with point or comma, degrees with minutes and seconds, a face, a moment."""

import re
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from decimal import Decimal

from ltsim.errors import RecordError
from ltsim.recording.files import is_number

FACES = {
    **dict.fromkeys(("1", "1.0", "i", "f1", "face1", "f", "front", "direct", "d", "l", "left", "links", "cl", "a"), 1),
    **dict.fromkeys(("2", "2.0", "ii", "f2", "face2", "b", "back", "reverse", "r", "right", "rechts", "cr"), 2),
}
DAY = timedelta(days=1)
LONGEST = 60
"""Characters of a cell that can be a number or an angle."""
_SEXAGESIMAL = re.compile(
    r"([+-]?)(\d{1,3})\s*(?:°|d|:|-|\s)\s*(\d{1,2})\s*(?:'|′|’|m|:|-|\s)\s*(\d{1,2}(?:[.,]\d+)?)\s*(?:\"|″|”|''|s)?"
)
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d{1,9}))?)?(?:\s*([AaPp])\.?[Mm]\.?)?")
_DATE = re.compile(r"(\d{1,4})([-/.])(\d{1,2})\2(\d{1,4})")


def plain(text: str) -> str:
    """A number as Python writes it: comma or point as decimal sign, blanks and a degree sign gone."""
    text = text.strip().removesuffix("°").replace("\u2212", "-").replace("\u00a0", "").strip()
    comma, point = text.rfind(","), text.rfind(".")
    if comma < 0:
        return text
    grouping = "." if comma > point else ","
    return text.replace(grouping, "").replace(",", ".") if point >= 0 else text.replace(",", ".", 1)


_GROUPED = {mark: re.compile(rf"[+-]?\d{{1,3}}(?:\{mark}\d{{3}})+", re.ASCII) for mark in ".,"}
_BOTH = {mark: re.compile(_GROUPED[mark].pattern + rf"[{other}]\d+", re.ASCII) for mark, other in (".,", ",.")}


def grouping_of(rows: Iterable[Sequence[str]], file: object) -> str:
    """The mark that groups thousands in a sheet, as ``7.000,5`` shows it for the ``7.000`` beside; '' for none.

    Raises RecordError where one cell groups by points and another by commas.
    """
    shown = {mark: cell for row in rows for cell in row for mark, form in _BOTH.items() if form.fullmatch(cell)}
    if len(shown) > 1:
        raise RecordError(f"writes numbers both as {shown['.']} and as {shown[',']}: make them alike", file=file)
    return next(iter(shown), "")


def is_value(text: str) -> bool:
    """Whether a cell is a number or an angle in degrees, minutes and seconds."""
    return len(text) <= LONGEST and (is_number(plain(text)) or _SEXAGESIMAL.fullmatch(text.strip()) is not None)


def value(text: str, grouping: str = "") -> Decimal | None:
    """The number of a cell to its last digit (degrees for minutes and seconds); None where it is none.

    `grouping` is that of its sheet, by `grouping_of`.
    """
    text = text.strip()
    if len(text) > LONGEST:
        return None
    number = plain(text.replace(grouping, "") if grouping and _GROUPED[grouping].fullmatch(text) else text)
    if is_number(number):
        return Decimal(number)
    found = _SEXAGESIMAL.fullmatch(text)
    if found is None or int(found.group(3)) > 59:
        return None
    sign, degrees, minutes, seconds = found.groups()
    size = Decimal(degrees) + (Decimal(minutes) * 60 + Decimal(seconds.replace(",", "."))) / 3600
    return -size if sign == "-" else size


def face(text: str) -> int | None:
    """1 or 2; None where the cell names no face."""
    return FACES.get(re.sub(r"[\s._-]", "", text.casefold()) if text not in ("1.0", "2.0") else text)


def moments(texts: Sequence[str], order: str | None = None) -> tuple[list[float] | None, str]:
    """Seconds since the earliest of clocks, dates or dates with clocks, and that moment in ISO form.

    `order` is ``dmy`` or ``mdy`` for dates with strokes. None where a text is in no known form, or where
    strokes leave the order open (the text is "?" then).
    """
    clocks = [_clock(text) for text in texts]
    if None not in clocks:
        return _since([datetime.min + clock for clock in _unwrapped(clocks)], dated=False)  # type: ignore[arg-type]
    read = ([_stamp(text, letters, order) for text in texts] for letters in ("ymd", "dmy", "mdy"))
    found = [_since(stamps, dated=True) for stamps in read if None not in stamps]  # type: ignore[arg-type]
    if any(seconds != found[0][0] for seconds, _ in found):
        return None, "?"
    return found[0] if found else (None, "")


def _since(stamps: list[datetime], *, dated: bool) -> tuple[list[float], str]:
    first = min(stamps)
    said = first.isoformat() if dated else first.time().isoformat()
    return [(stamp - first).total_seconds() for stamp in stamps], said


def _unwrapped(clocks: list[timedelta]) -> list[timedelta]:
    """Clocks without a date: one that falls back by more than half a day has passed midnight."""
    days, last, found = timedelta(0), clocks[0], []
    for clock in clocks:
        if last - clock > DAY / 2:
            days += DAY
        last = clock
        found.append(clock + days)
    return found


def _clock(text: str) -> timedelta | None:
    found = _CLOCK.fullmatch(text.strip())
    if found is None:
        return None
    hours, minutes, seconds = (int(part or 0) for part in found.groups()[:3])
    half = (found.group(5) or "").lower()
    if hours > 23 or minutes > 59 or seconds > 60 or (half and not 1 <= hours <= 12):
        return None
    if half:
        hours = hours % 12 + (12 if half == "p" else 0)
    return timedelta(
        hours=hours, minutes=minutes, seconds=seconds, microseconds=float("0." + (found.group(4) or "0")) * 1e6
    )


def _stamp(text: str, letters: str, order: str | None) -> datetime | None:
    """A date with or without a clock; the zone of an ISO stamp is left aside (all are taken as of one zone)."""
    day, _, rest = re.sub(r"(?<=\d)T(?=\d)", " ", text.strip()).partition(" ")
    rest = re.sub(r"(Z|[+-]\d{2}:?\d{2})$", "", rest.strip())
    found, clock = _DATE.fullmatch(day), _clock(rest) if rest else timedelta(0)
    if found is None or clock is None or (len(found[1]) == 4) != (letters == "ymd"):
        return None
    excluded = letters == "mdy" if found[2] == "." else letters != "ymd" and order not in (None, letters)
    parts = {letter: int(part) for letter, part in zip(letters, found.group(1, 3, 4), strict=True)}
    year = parts["y"] + (2000 if parts["y"] < 100 else 0)
    if excluded or year < 1000:
        return None
    try:
        return datetime(year, parts["m"], parts["d"]) + clock
    except ValueError:
        return None
