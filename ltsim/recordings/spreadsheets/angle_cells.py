"""Parsers for angles in degrees, minutes and seconds, in one cell or in separate cells."""

import re
from collections.abc import Sequence
from decimal import Decimal

MAX_VALUE_TEXT_LENGTH = 60
"""Largest number of characters of a cell that is tested as a number or an angle."""
ANGLE_SYMBOLS = ("°", "'", '"')
"""Symbols of degrees, minutes and seconds, used to join cells of separate columns to one angle."""
MINUS_SIGNS = ("-", "\u2212")
"""Hyphen and minus sign, which begin a negative number."""
_DEGREES_PATTERN = r"°|º|˚|\^|\*|deg|d"
"""Pattern of a symbol for degrees."""
_MINUTES_PATTERN = r"'|′|’|‘|´|`|ʹ|min|m"
"""Pattern of a symbol for minutes of arc."""
_SECONDS_PATTERN = rf"\"|″|”|“|ʺ|(?:{_MINUTES_PATTERN})(?:{_MINUTES_PATTERN})|sec|s"
"""Pattern of a symbol for seconds of arc."""
_ANGLE_SEPARATOR_PATTERN = r":|-|_|\s"
"""Pattern of a separator between degrees, minutes and seconds without symbols."""
_SEXAGESIMAL_PART_PATTERN = r"\d{1,2}(?:[.,]\d+)?"
"""Pattern of a number of minutes or seconds, with or without decimals."""
_SEXAGESIMAL_PATTERN = re.compile(
    rf"([+-]?)\s*(\d{{1,3}})\s*(?:{_DEGREES_PATTERN}|{_ANGLE_SEPARATOR_PATTERN})\s*(\d{{1,2}})\s*(?:{_MINUTES_PATTERN}|{_ANGLE_SEPARATOR_PATTERN})\s*({_SEXAGESIMAL_PART_PATTERN})\s*(?:{_SECONDS_PATTERN})?",
    re.IGNORECASE,
)
"""Pattern of degrees, minutes and seconds, with symbols or separators."""
_SYMBOL_BEFORE_DECIMALS_PATTERN = re.compile(rf"(.*\d)(?:{_SECONDS_PATTERN})[.,]?(\d+)", re.IGNORECASE)
"""Pattern of an angle whose symbol of seconds is before their decimals, such as 33°12'07"5."""
_POINT_SEPARATED_PATTERN = re.compile(r"([+-]?)(\d{1,3})\.(\d{2})\.(\d{2}[.,]\d+)")
"""Pattern of degrees, minutes and seconds with points between them. The seconds have decimals, because three whole
numbers with points may be a date or the name of a point."""
_DEGREES_AND_MINUTES_PATTERN = re.compile(
    rf"([+-]?)\s*(\d{{1,3}})\s*(?:{_DEGREES_PATTERN})\s*({_SEXAGESIMAL_PART_PATTERN})\s*(?:{_MINUTES_PATTERN})()",
    re.IGNORECASE,
)
"""Pattern of degrees and minutes, each with its symbol."""
_PACKED_DEGREES_PATTERN = re.compile(r"([+-]?)(\d{1,3})(?:[.,](\d*))?")
"""Pattern of degrees whose decimals contain minutes and seconds, such as 33.120747."""
_PACKED_INTEGER_PATTERN = re.compile(r"([+-]?)(\d{1,3})(\d{2})(\d{2}(?:[.,]\d+)?)")
"""Pattern of degrees, minutes and seconds without separators, such as 331207.47."""
_THREE_PARTS_PATTERN = re.compile(
    r"[+-]?\s*(?P<degrees>\d{1,3})(?P<separator>\D{1,5}?)(?P<minutes>\d{1,2})\D{1,5}?(?P<seconds>\d{1,2})(?:[.,](?P<decimals>\d+))?\D{0,5}"
)
"""Pattern of three numbers with any marks between them, such as 355g40'14"."""
_CENTESIMAL_SEPARATOR_PATTERN = re.compile(r"\s*g(?:on|r|rd)?\s*", re.IGNORECASE)
"""Pattern of a symbol for gon, which some programs write also for degrees (Grad, grados)."""
MAX_MINUTES = 60
"""Number of minutes in a degree and of seconds in a minute; parts of an angle are below it."""


def unreadable_angle_sentence(text: str) -> str:
    """Sentence on what a cell looks like that is no readable angle, and how to write it; '' for any other cell.

    The cell has three numbers with marks between them that may be degrees, minutes and seconds.
    """
    match = _THREE_PARTS_PATTERN.fullmatch(text.strip()) if len(text) <= MAX_VALUE_TEXT_LENGTH else None
    if match is None or parse_sexagesimal(text) is not None:
        return ""
    degrees, minutes, seconds = match["degrees"], match["minutes"].zfill(2), match["seconds"].zfill(2)
    decimals = f".{match['decimals']}" if match["decimals"] else ""
    sign = "-" * text.strip().startswith("-")
    sexagesimal = f"{sign}{degrees}°{minutes}'{seconds}{decimals}\""
    centesimal = f"{sign}{degrees}.{minutes}{seconds}{match['decimals'] or ''}"
    has_gon_symbol = _CENTESIMAL_SEPARATOR_PATTERN.fullmatch(match["separator"]) is not None
    if max(int(minutes), int(seconds)) >= MAX_MINUTES:
        what = f"it has minutes or seconds of {MAX_MINUTES} or more, which are no parts of a degree"
        return f"{what}; write an angle in gon as {centesimal}"
    if has_gon_symbol:
        return (
            "it looks like an angle of three parts with the symbol of gon before minutes and seconds; write "
            f"{sexagesimal} if the parts are degrees, minutes and seconds, or {centesimal} if they are gon"
        )
    return f"it looks like an angle in degrees, minutes and seconds; write {sexagesimal}"


def parse_sexagesimal(text: str) -> Decimal | None:
    """Degrees from a cell with degrees, minutes and possibly seconds; None for any other cell."""
    if len(text) > MAX_VALUE_TEXT_LENGTH:
        return None
    text = text.strip().replace("\u2212", "-").replace("\u00a0", " ")
    symbol_match = _SYMBOL_BEFORE_DECIMALS_PATTERN.fullmatch(text)
    if symbol_match is not None and not symbol_match[1].isdigit():
        text = f"{symbol_match[1]}.{symbol_match[2]}"
    patterns = (_SEXAGESIMAL_PATTERN, _POINT_SEPARATED_PATTERN, _DEGREES_AND_MINUTES_PATTERN)
    match = next((match for pattern in patterns if (match := pattern.fullmatch(text))), None)
    return None if match is None else _degrees_from_parts(*(part.replace(",", ".") for part in match.groups()))


def parse_packed_degrees(text: str) -> Decimal | None:
    """Degrees from a cell whose decimals contain minutes and seconds: 33.120747 is 33° 12' 07.47".

    Degrees, minutes and seconds with symbols, or without a point after the degrees, are accepted too. None for any
    other cell.
    """
    match = _PACKED_DEGREES_PATTERN.fullmatch(text.strip()) if len(text) <= MAX_VALUE_TEXT_LENGTH else None
    if match is None:
        angle = parse_sexagesimal(text)
        return parse_packed_integer_degrees(text) if angle is None else angle
    sign, degrees, rest = match.groups(default="")
    digits = rest.ljust(4, "0")
    return _degrees_from_parts(sign, degrees, digits[:2], f"{digits[2:4]}.{digits[4:] or 0}")


def parse_packed_integer_degrees(text: str) -> Decimal | None:
    """Degrees from a cell with degrees, minutes and seconds without separators: 331207.47 is 33° 12' 07.47".

    Leading zeros may be missing. None for any other cell.
    """
    if len(text) > MAX_VALUE_TEXT_LENGTH:
        return None
    sign, digits = text[: text[:1] in ("+", "-")], text[text[:1] in ("+", "-") :]
    whole, point, decimals = digits.strip().replace(",", ".").partition(".")
    match = _PACKED_INTEGER_PATTERN.fullmatch(f"{sign}{whole.zfill(5)}{point}{decimals}")
    return None if match is None else _degrees_from_parts(*match.groups())


def joined_angle_text(cell_texts: Sequence[str]) -> str:
    """Angle in one text, from the cells of its degrees, minutes and possibly seconds; '' for empty cells.

    The sign of a negative angle is before its first part that is not zero, before all parts, or before a zero as the
    number of degrees. Parts with other signs remain unchanged, so that the text is no angle.
    """
    texts = [text.strip() for text in cell_texts]
    magnitudes = [text.lstrip("".join(MINUS_SIGNS)) for text in texts]
    signs = [text.startswith(MINUS_SIGNS) for text in texts]
    first = next((i for i, text in enumerate(magnitudes) if text.strip("0.,")), 0)
    is_negative = any(signs[: first + 1])
    if is_negative or not any(signs):
        texts = ["-" * (is_negative and i == 0) + text for i, text in enumerate(magnitudes)]
    return " ".join(text + symbol for text, symbol in zip(texts, ANGLE_SYMBOLS, strict=False) if text)


def _degrees_from_parts(sign: str, degrees: str, minutes: str, seconds: str) -> Decimal | None:
    """Degrees from texts of degrees, minutes and seconds; None for minutes of 60 or more, or seconds above 60."""
    minutes_and_seconds = Decimal(minutes), Decimal(seconds or 0)
    if minutes_and_seconds[0] >= MAX_MINUTES or minutes_and_seconds[1] > MAX_MINUTES:
        return None
    magnitude = Decimal(degrees) + (minutes_and_seconds[0] * 60 + minutes_and_seconds[1]) / 3600
    return -magnitude if sign == "-" else magnitude
