"""Formats of field books that are recognised and not read, and what to export instead."""

import re
from dataclasses import dataclass

OBSERVATIONS = "export GSI, SDR or a table of the observations (station, point, horizontal circle, zenith, distance)"
"""Advice for programs of total stations."""
ARRAYS = "write its arrays to a table, as docs/how-to/own-tracker.md shows in a few lines"
"""Advice for files of numerical programs."""


@dataclass(frozen=True)
class UnreadFormat:
    """Format by a pattern of its first characters, and advice on what to export instead."""

    name: str
    pattern: re.Pattern[str]
    alternative: str = OBSERVATIONS


def _make_format(name: str, pattern: str, alternative: str = OBSERVATIONS) -> UnreadFormat:
    return UnreadFormat(name, re.compile(pattern, re.DOTALL), alternative)


UNREAD_FORMATS = (
    _make_format("a field book in the format M5 or Rec (Trimble, Zeiss)", r"\s*For (?:M5|REC|R[45E])\|Adr"),
    _make_format("a job in the format JobXML (Trimble)", r"\s*(?:<\?xml[^>]*>\s*)?(?:<!--.*?-->\s*)*<JOBFile\b"),
    _make_format("a field book in the format RW5 (Carlson)", r"\s*JB,NM|\s*--[^\n]*\n\s*JB,NM"),
    _make_format("a raw file of Topcon or Ruide", r"\s*(?:GTS-7|GPT-7)\b|\s*JOB\s+[^\n]*\n(?:[^\n]*\n){0,8}?\s*STN\s"),
    _make_format("a field book in the format GEO (GeoEasy)", r"\s*\{\s*\d+\s+[^}]*\}\s*\{\s*\d+\s"),
    _make_format("a file of MATLAB", r"MATLAB 5\.0 MAT-file", ARRAYS),
    _make_format("a JSON array", r"\s*\[\s*[\[{\d\"-]", ARRAYS),
)
"""Formats in the order in which they are tried."""
