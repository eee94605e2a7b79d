"""A bench recording read and evaluated, as `ltsim bench` does it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from experiments.virtual_bench import MIDDLE, BenchTest, measure_bench
from ltsim.adjustment.evaluation.bench import BENCH_TABLE
from ltsim.cli.main import run
from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE, MICROMETRE
from ltsim.physics.effects.smr_incidence import PAPER_INCIDENCE_RANGE_ERRORS
from tests.conftest import ROOT

SAMPLE = ROOT / "docs" / "how-to" / "reflector.csv"


def written(path: Path, bench: BenchTest, seed: int) -> Path:
    """A test done once, as a table; lengths from 250 um."""
    record = measure_bench(bench, seed)
    lengths = dict(
        zip(np.round(record.table_angles_of_lengths / DEGREE, 3), record.lengths / MICROMETRE + 250.0, strict=True)
    )
    rows = zip(np.round(record.table_angles_of_probe / DEGREE, 3), record.probe_displacements / MICROMETRE, strict=True)
    path.write_text(BENCH_TABLE.with_rows([a, lengths.get(a, np.nan), p] for a, p in rows).csv_text())
    return path


def test_the_table_comes_back_within_its_uncertainty(tmp_path: Path) -> None:
    turns = np.arange(-30.0, 330.0, 7.5) * DEGREE
    bench = BenchTest(eccentricity=np.array([4e-6, -11e-6]), probe_angles=turns)
    true = (np.array(PAPER_INCIDENCE_RANGE_ERRORS) - PAPER_INCIDENCE_RANGE_ERRORS[MIDDLE]) / MICROMETRE
    estimates = lt.bench(written(tmp_path / "reflector.csv", bench, 5))
    error = np.array([row.error_um for row in estimates.range_errors]) - true
    sigma = np.array([row.sigma_um for row in estimates.range_errors])
    assert np.all(np.abs(error) <= 4 * sigma)
    assert abs(estimates.eccentricity_side.value_um + 11.0) < 4 * estimates.eccentricity_side.sigma_um
    assert np.abs([row.uncorrected_length_um for row in estimates.range_errors] - true).max() > 4.0


def test_the_command_writes_what_it_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", str(SAMPLE), "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "range_error_table_um = [10.27" in shown
    content = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert content["table"][0]["error_um"] == pytest.approx(10.27, abs=0.005)
    assert run(["bench", str(SAMPLE), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == content


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,1,2\n", "length_um has values at 1 angles, expected 3"),
        ("0,1,2\n5,1,2\n10,1,2\n", "probe_um has values at 3 angles, expected 4"),
        ("0,1,2\n,1,2\n", "row 2: an angle is missing"),
        ("0,wide,2\n", "'wide' is not a number"),
    ],
)
def test_wrong_input_is_refused_in_a_sentence(rows: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.csv"
    file.write_text("angle_deg,length_um,probe_um\n" + rows)
    with pytest.raises(RecordError, match=message):
        lt.bench(file)


def test_a_table_of_very_many_rows_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    """499,000 rows took 675 MB, and a result that no reader takes."""
    (tmp_path / "a.csv").write_text("angle_deg,length_um,probe_um\n" + "1,2,3\n" * 10_001)
    with pytest.raises(RecordError, match="has more rows than the limit of 10000"):
        lt.bench(tmp_path / "a.csv")
