"""Lists of points: numbers that no list may contain."""

from __future__ import annotations

from pathlib import Path

import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings.coordinates import read_points


@pytest.mark.parametrize(
    ("header", "row", "column"),
    [
        ("target;x_mm;y_mm;z_mm;sigma_mm", "T1;1000;2000;3000;-1", "sigma_mm"),
        ("target;x_mm;y_mm;z_mm;sigma_x_mm;sigma_y_mm;sigma_z_mm", "T1;1000;2000;3000;1;-0.5;1", "sigma_y_mm"),
    ],
)
def test_a_negative_standard_deviation_is_refused(tmp_path: Path, header: str, row: str, column: str) -> None:
    (tmp_path / "points.csv").write_text(f"{header}\nT0;0;0;0;{';'.join('1' * (header.count(';') - 3))}\n{row}\n")
    with pytest.raises(RecordError, match=f"row 3, column {column}: the standard deviation -.* is negative"):
        read_points(tmp_path / "points.csv")
