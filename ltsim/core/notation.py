"""Notation of numbers with standard deviations and with expanded uncertainties, the same in all texts.

`a +- b` is always a value and **one standard deviation** (standard uncertainty of JCGM 100). An uncertainty with 95 %
coverage is written as an expanded uncertainty with its coverage factor, `U = b (k = 2)`, or as an interval with its
coverage probability.
Pages show `+-` and `um` as symbols.
"""

import math
from collections.abc import Sequence

from ltsim.core.errors import ModelError

MISSING_TEXT = "-"
"""Text for a missing number, in place of `nan`."""
MAX_LISTED_ITEMS = 6
"""Largest number of names or numbers that a sentence lists; a sentence gives only the number of all others."""
MAX_LISTED_SENTENCES = 4
"""Largest number of sentences of one kind that are displayed; of all others only the number is displayed."""
MAX_SIGMA_DECIMALS = 12
"""Largest number of decimals in a displayed standard deviation; standard deviations below 1e-12 are displayed as 0."""
INTERPRETED_START_CHARACTERS = ("=", "+", "-", "@", "'", "#")
"""Characters at the start of a text that a spreadsheet may take for a formula, or a reader for a comment (#); the CSV
file has an apostrophe before them."""


def number_text(value: float | None, n_digits: int = 3) -> str:
    """Number as text with `n_digits` significant digits, with an exponent outside 1e-4 to 1e6; a dash if missing."""
    if value is None or not math.isfinite(value):
        return MISSING_TEXT
    if value == 0:
        return "0"
    absolute_value = abs(value)
    if not 1e-4 <= absolute_value < 1e6:
        return f"{value:.{max(n_digits - 1, 0)}e}"
    return fixed_point_text(value, max(n_digits - 1 - math.floor(math.log10(absolute_value)), 0))


def with_sigma(value: float | None, sigma: float | None, unit: str = "") -> str:
    """Text of a value and its standard deviation in `unit`, to the second digit of `sigma`: `1.23 +- 0.10 um`."""
    if value is None or not math.isfinite(value):
        return MISSING_TEXT
    if sigma is None or not (math.isfinite(sigma) and sigma > 0):
        return f"{number_text(value)} {unit}".rstrip()
    n_decimals = decimals_of_sigma(sigma)
    return f"{fixed_point_text(value, n_decimals)} +- {fixed_point_text(sigma, n_decimals)} {unit}".rstrip()


def with_expanded_uncertainty(
    value: float | None, expanded_uncertainty: float | None, unit: str = "", coverage_factor: float = 2.0
) -> str:
    """Value and expanded uncertainty with its coverage factor as text: `1.23 um, U = 0.20 um (k = 2)`."""
    if expanded_uncertainty is None or not (math.isfinite(expanded_uncertainty) and expanded_uncertainty > 0):
        return with_sigma(value, None, unit)
    if value is None or not math.isfinite(value):
        return MISSING_TEXT
    n_decimals = decimals_of_sigma(expanded_uncertainty)
    measured, half = (f"{fixed_point_text(v, n_decimals)} {unit}".rstrip() for v in (value, expanded_uncertainty))
    return f"{measured}, U = {half} (k = {coverage_factor:.3g})"


def decimals_of_sigma(sigma: float) -> int:
    """Number of decimals at which a standard deviation has two significant digits: 2 for 0.10, 0 for 10 and above."""
    rounded_sigma = float(f"{sigma:.1e}")  # 0.0996 is 0.10
    return min(max(1 - math.floor(math.log10(rounded_sigma)), 0), MAX_SIGMA_DECIMALS)


def align_columns(header: Sequence[str], table_rows: Sequence[Sequence[str]], n_text_columns: int = 1) -> str:
    """Table as text with aligned columns: the first `n_text_columns` columns flush left, the others flush right.

    ModelError is raised if a row is not as long as the header.
    """
    if any(len(row) != len(header) for row in table_rows):
        raise ModelError("a row of a table is not as long as its header")
    lines = [header, *table_rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i < n_text_columns else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def count_text(n_items: int, singular: str) -> str:
    """Text of a number and its noun: `1 station`, `5 stations`."""
    return f"{n_items} {singular}{'' if n_items == 1 else 's'}"


def names_text(names: Sequence[str], max_items: int = MAX_LISTED_ITEMS) -> str:
    """Text of a list of names, `a, b and 3 more`; names after the first `max_items` are only counted."""
    if len(names) <= max_items:
        return ", ".join(names)
    return ", ".join(names[:max_items]) + f" and {len(names) - max_items} more"


def fixed_point_text(value: float | None, n_decimals: int) -> str:
    """Number as text with `n_decimals` decimals and without thousands separators; a dash if it is missing."""
    if value is None or not math.isfinite(value):
        return MISSING_TEXT
    return unsigned_zero(f"{value:.{n_decimals}f}")


def unsigned_zero(decimal_text: str) -> str:
    """Decimal number as text, without the minus sign of `-0.00`."""
    return decimal_text if decimal_text.strip("-0.") else decimal_text.removeprefix("-")


def escape_cell_text(text: str) -> str:
    """Text for a CSV cell, with an apostrophe before a text that would be interpreted as a formula or comment."""
    return f"'{text}" if text.startswith(INTERPRETED_START_CHARACTERS) else text


def unescape_cell_text(text: str) -> str:
    """Text of a CSV cell without the apostrophe that `escape_cell_text` adds."""
    return text[1:] if text.startswith("'") and text[1:].startswith(INTERPRETED_START_CHARACTERS) else text
