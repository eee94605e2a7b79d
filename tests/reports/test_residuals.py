"""Residuals from an adjustment and from its file are the same; broken files get one sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.calibration.arrays import residuals_table
from ltsim.core.errors import RecordError
from ltsim.reports.residuals import Residuals
from tests.reports import samples


def test_file_and_adjustment_agree(tmp_path: Path) -> None:
    direct = Residuals.from_adjustment(samples.after())
    file = tmp_path / "residuals.csv"
    file.write_text(residuals_table(samples.after()).csv_text())
    read = Residuals.read(file)
    assert read.data_row_numbers.tolist() == direct.data_row_numbers.tolist()
    assert read.stations == direct.stations
    assert read.displayed_residual == pytest.approx(direct.displayed_residual, abs=1e-4)
    assert read.normalised_residual == pytest.approx(direct.normalised_residual, abs=1e-3)
    borrowed = read.with_covariates(direct)
    assert borrowed.covariates["elevation"] == pytest.approx(direct.covariates["elevation"])


def test_residuals_of_the_calibrated_network_are_white() -> None:
    residuals = Residuals.from_adjustment(samples.after())
    assert np.std(residuals.normalised_residual) == pytest.approx(1.0, abs=0.1)


def test_other_noise_is_no_change_of_the_residuals() -> None:
    declared = Residuals.from_adjustment(samples.after())
    louder = replace(
        declared, normalised_residual=0.5 * declared.normalised_residual
    )  # as if the noise had been found twice as large
    assert louder.normalised_by_noise_of(declared).normalised_residual == pytest.approx(declared.normalised_residual)
    assert np.isnan(
        louder.normalised_by_noise_of(
            replace(declared, data_row_numbers=declared.data_row_numbers + 10_000)
        ).normalised_residual
    ).all()


def test_without_a_clock_the_row_stands_for_the_time() -> None:
    made = samples.recording()
    assert set(Residuals.from_adjustment(adjust(made)).covariates) & {"time", "row"} == {"time"}
    timeless = Residuals.from_adjustment(adjust(made.replace(has_clock=False)))
    assert set(timeless.covariates) & {"time", "row"} == {"row"}
    assert timeless.covariates["row"] == pytest.approx(timeless.data_row_numbers)


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
