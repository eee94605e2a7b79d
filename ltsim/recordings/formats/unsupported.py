"""Formats that are recognised but cannot be read, with advice on what to export instead."""

import re
from dataclasses import dataclass

FIELD_BOOK_ADVICE = (
    "export GSI, SDR or a table of the observations (station, point, horizontal circle, zenith, distance)"
)
"""Advice on what to export instead of a total station's field book in an unsupported format."""
NUMERICAL_PROGRAM_ADVICE = "write its arrays to a table, as docs/how-to/own-tracker.md shows in a few lines"
"""Advice on what to write instead of a file of a numerical program, such as MATLAB."""
METROLOGY_DATABASE_ADVICE = (
    "export the observations from its program as a table (SpatialAnalyzer, PolyWorks: reports as text)"
)
"""Advice on what to export instead of the database in which a metrology program stores its jobs."""
UNSUPPORTED_WORKBOOK_ADVICE = "save it as xlsx or CSV"
"""Advice on what to save instead of a workbook in an unsupported format."""


@dataclass(frozen=True)
class UnsupportedFormat:
    """Format that cannot be read: name, pattern of the beginning of its files, advice on what to export instead."""

    name: str
    pattern: re.Pattern[str]
    export_advice: str = FIELD_BOOK_ADVICE


_XML_PROLOGUE = r"\s*+(?:<\?xml[^>]*+>\s*+)?+(?:(?><!--.*?-->)\s*+)*+"
"""Pattern of the text before the root element of an XML file: declaration and comments."""


def _make_format(name: str, pattern: str, export_advice: str = FIELD_BOOK_ADVICE) -> UnsupportedFormat:
    """Unsupported format whose files begin with the regular expression `pattern`."""
    return UnsupportedFormat(name, re.compile(pattern, re.DOTALL), export_advice)


UNSUPPORTED_FORMATS = (
    _make_format("a field book in the format M5 or Rec (Trimble, Zeiss)", r"\s*+For[ _](?:M5|REC|R[45E])\|Adr"),
    _make_format("a job in the format JobXML (Trimble)", rf"{_XML_PROLOGUE}<JOBFile\b"),
    _make_format("a job in the format LandXML", rf"{_XML_PROLOGUE}<LandXML\b"),
    _make_format("a file of Leica in the format HeXML", rf"{_XML_PROLOGUE}<HexagonXML\b"),
    _make_format(
        "a field book in the format RW5 (Carlson)",
        r"(?:\s*+--[^\n]*+\n)*+\s*+(?:JB,NM|MO,AD|OC,OP|BK,OP|LS,H[IR]|SS,OP)",
    ),
    _make_format("a raw file of Nikon", r"(?:\s*+CO,[^\n]*+\n)+?\s*+(?:CO,(?:Dist Units|Angle Units)|ST,|MP,|UP,)"),
    _make_format(
        "a raw file of Topcon or Ruide",
        r"\s*+(?:(?:GTS|GPT)-\d|_'[^\n]{0,40}_\(|JOB(?=\s)[^\n]*+\n(?:[^\n]*+\n){0,8}?\s*+STN\s)",
    ),
    _make_format("a field book in the format Geodimeter (JOB, ARE)", r"\s*+50=[^\n]*+\n(?:\d{1,3}=[^\n]*+\n){3}"),
    _make_format(
        "input of STAR*NET",
        r"(?:\s*+(?:#|\.[A-Za-z]|C\s)[^\n]*+\n)*+\s*+"
        r"(?:M\s++\S[^\s-]*+-\S[^\s-]*+-\S++\s|DB\s++\S++[^\S\n]*+\n\s*+D[MN]\s)",
    ),
    _make_format("a field book in the format GEO (GeoEasy)", r"\s*+\{\s*+\d++\s[^}]*+\}\s*+\{\s*+\d++\s"),
    _make_format("a file of MATLAB", r"MATLAB 5\.0 MAT-file", NUMERICAL_PROGRAM_ADVICE),
    _make_format("a JSON array", r"\s*+\[\s*+[\[{\d\"-]", NUMERICAL_PROGRAM_ADVICE),
    _make_format("a JSON object", r"\s*+\{\s*+\"[^\"\n]*+\"\s*+:", NUMERICAL_PROGRAM_ADVICE),
    _make_format("a database", r"SQLite format 3|\x00\x01\x00\x00Standard (?:Jet|ACE) DB", METROLOGY_DATABASE_ADVICE),
    _make_format("a workbook of Excel 97 (xls)", r"\xd0\xcf\x11\xe0", UNSUPPORTED_WORKBOOK_ADVICE),
    _make_format(
        "a workbook of OpenDocument (ods)", r"PK.{28}mimetypeapplication/vnd\.oasis", UNSUPPORTED_WORKBOOK_ADVICE
    ),
)
"""Formats that cannot be read, in the order in which a file is tested for them. Their patterns need a time proportional
to the length of the tested text."""
