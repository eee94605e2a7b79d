"""Residuals from an adjustment and from its file are the same; broken files get one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.calibration.calibration import residuals_table
from ltsim.errors import RecordError
from ltsim.pages.residuals import Residuals
from tests.pages import samples


def test_file_and_adjustment_agree(tmp_path: Path) -> None:
    direct = Residuals.from_adjustment(samples.after())
    file = tmp_path / "residuals.csv"
    file.write_text(residuals_table(samples.after()).csv())
    read = Residuals.read(file)
    assert read.row.tolist() == direct.row.tolist()
    assert read.stations == direct.stations
    assert read.residual == pytest.approx(direct.residual, abs=1e-4)
    assert read.w == pytest.approx(direct.w, abs=1e-3)
    borrowed = read.with_covariates(direct)
    assert borrowed.covariates["elevation"] == pytest.approx(direct.covariates["elevation"])


def test_residuals_of_the_calibrated_network_are_white() -> None:
    residuals = Residuals.from_adjustment(samples.after())
    assert np.std(residuals.w) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("row,station\n1,S1\n", "target"),
        ("row,station,target,observable,residual,unit,redundancy,w\n1,S1,T1,range,1,mm,1,1\n", "observable"),
        ("row,station,target,observable,residual,unit,redundancy,w\n1,S1,T1,distance,1,furlong,1,1\n", "unit"),
        ("row,station,target,observable,residual,unit,redundancy,w\n1,S1,T1,distance,x,mm,1,1\n", "residual"),
    ],
)
def test_broken_file_is_named(text: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "residuals.csv"
    file.write_text(text)
    with pytest.raises(RecordError, match=words):
        Residuals.read(file)
