"""Reader of a joint covariance matrix of coordinates, the file `NAME.covariance.csv` of a list of coordinates.

A row has a field for each coordinate, so that neither the length of a line nor the number of fields is limited as in a
table. Rows are converted one by one, because a number takes 60 bytes as text and 8 in the matrix.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import RecordError
from ltsim.core.limits import MAX_TEXT_LINES, require_small_joint_covariance
from ltsim.core.notation import unescape_cell_text
from ltsim.recordings.files import SourceLocation, read_text, safe_excerpt, with_unix_line_ends
from ltsim.recordings.spreadsheets.cells import plain_numbers

MAX_COVARIANCE_ASYMMETRY = 1e-6
"""Largest difference of entries ij and ji of an accepted covariance matrix, relative to the largest variance."""
MATRIX_FIELD_SEPARATORS = ",;\t"
"""Possible separators of the numbers in a row of the file; the most frequent one in the first row is used."""
MAX_NUMBER_MAGNITUDE = 1e12
"""Largest magnitude of numbers in a row that are converted together; a row with a larger number is checked cell by
cell."""


def read_covariance_matrix(path: Path, coordinate_names: Sequence[str]) -> Floats:
    """Covariance (n, n) [mm^2] of the n coordinates `coordinate_names`, which the file may have in another order.

    Raises RecordError.
    """
    rows = _numbered_csv_rows(path)
    names = list(map(unescape_cell_text, next(rows, (0, [""]))[1][1:]))
    index_by_name = {name: i for i, name in enumerate(names)}
    missing = next((name for name in coordinate_names if name not in index_by_name), None)
    if missing is not None:
        raise RecordError(f"the file lacks the coordinate {safe_excerpt(missing)}", file=path)
    require_small_joint_covariance(len(names), path)
    matrix = np.zeros((len(names), len(names)))
    for i, (name, row) in enumerate(zip_longest(names, rows)):
        if name is None or row is None or unescape_cell_text(row[1][0]) != name:
            raise RecordError(
                "the file has other rows than columns, or another order; give one row per coordinate, in column order",
                file=path,
            )
        line, fields = row
        if len(fields) != 1 + len(names):
            raise RecordError("the file has rows whose length differs from the header", file=path)
        matrix[i] = _parse_numbers(fields[1:], SourceLocation(path, line))
    variance = np.abs(np.diag(matrix))
    if max(np.abs(row - column).max() for row, column in zip(matrix, matrix.T, strict=True)) > (
        MAX_COVARIANCE_ASYMMETRY * float(variance.max())
    ):
        raise RecordError("the covariance matrix is not symmetric", file=path)
    indices = [index_by_name[name] for name in coordinate_names]
    if indices != list(range(len(names))):
        matrix = matrix[np.ix_(indices, indices)]
    return 0.5 * (matrix + matrix.T)


def _numbered_csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of each row, without blank lines and comments; raises RecordError."""
    text = with_unix_line_ends(read_text(path))
    if text.count("\n") > MAX_TEXT_LINES:
        raise RecordError(f"the file has more than {MAX_TEXT_LINES} lines, the limit for reading", file=path)
    separator = ""
    for number, line in enumerate(io.StringIO(text), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        separator = separator or max(MATRIX_FIELD_SEPARATORS, key=line.count)
        try:
            yield number, [field.strip() for field in next(csv.reader([line], delimiter=separator, strict=True))]
        except csv.Error as problem:
            raise SourceLocation(path, number).error(f"is not CSV ({problem})") from None


def _parse_numbers(texts: Sequence[str], location: SourceLocation) -> Floats:
    """Numbers (n,) of the n texts of a row; raises RecordError."""
    numbers = plain_numbers(texts)
    if numbers is not None and (np.abs(numbers) <= MAX_NUMBER_MAGNITUDE).all():
        return numbers
    return np.array(list(map(location.parse_number, texts)))
