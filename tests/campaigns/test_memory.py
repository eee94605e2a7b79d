"""Memory of campaigns: nothing outlives its trials, and batches are small where networks are large."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from ltsim.campaigns.batch_network import MAX_DISTANCE_TO_OPTIMUM
from ltsim.campaigns.campaign import run_campaign
from ltsim.campaigns.design import require_few_cells, shared_json_values
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.row_queries import rows_sql
from ltsim.campaigns.schema import ManifestFile
from ltsim.campaigns.shard_rows import load_cell_context
from ltsim.campaigns.spec import load_campaign
from ltsim.campaigns.store import CampaignFolder
from ltsim.campaigns.summary_output import (
    SummariesByColumn,
    first_summary_rows,
    summary_csv_text,
    summary_json_parts,
)
from ltsim.campaigns.true_network import TrialBatch, TrueNetwork
from ltsim.core.errors import InputError
from ltsim.core.limits import POINTINGS_LIMIT_VARIABLE
from ltsim.core.randomness import TRIALS_PER_STREAM, standard_normal_trials
from ltsim.recordings.result_file import read_result
from tests.campaigns.small import FILE
from tests.families import family

FEW = FILE.replace("trials = 600", "trials = 12").replace("[1.0, 2.0]", "[1.0]")


@pytest.mark.parametrize("geometry", family(["per-trial", "shared"]))
def test_no_geometry_of_a_trial_outlives_its_batch(geometry: str, file: Path, tmp_path: Path) -> None:
    """Each geometry kept itself alive through a cached function: 4,096 trials took 900 MB."""
    file.write_text(FEW.replace("trials = 12", f'trials = 12\ngeometry = "{geometry}"'))
    gc.collect()
    before = living_truths()
    gc.disable()
    try:
        run_campaign(file, tmp_path / "out")
        assert len(living_truths()) == len(before)
    finally:
        gc.enable()
    assert not load_cell_context.cache_info().currsize


def living_truths() -> list[object]:
    """Truths and batches of trials that exist; the type is compared, because a dead weak reference has no class."""
    return [item for item in gc.get_objects() if type(item) in (TrueNetwork, TrialBatch)]


@pytest.mark.parametrize("geometry", family(["shared", "per-trial"]))
def test_a_large_network_is_calibrated_in_small_batches(
    geometry: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch of 256 trials of 28,000 pointings took 1.9 GB, 64 geometries of them 11 GB."""
    file.write_text(FEW.replace("trials = 12", f'trials = 12\ngeometry = "{geometry}"'))
    sizes, draw = [], TrueNetwork.batch_from_draw
    monkeypatch.setattr(
        TrueNetwork, "batch_from_draw", lambda self, drawn, gap: sizes.append(gap.shape[2]) or draw(self, drawn, gap)
    )
    run_campaign(file, tmp_path / "whole")
    assert max(sizes) == (TRIALS_PER_STREAM if geometry == "shared" else 1)
    sizes.clear()
    monkeypatch.setattr("ltsim.campaigns.shard_rows.MAX_BATCH_ARRAY_VALUES", 200_000)
    run_campaign(file, tmp_path / "parts")
    assert max(sizes) == (32 if geometry == "shared" else 1)
    assert_equal_rows(tmp_path / "whole", tmp_path / "parts", MAX_DISTANCE_TO_OPTIMUM)


def test_a_sparse_design_gives_the_same_rows(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three dense matrices of all readings and unknowns took 260 MB for 28,000 pointings."""
    file.write_text(FEW)
    run_campaign(file, tmp_path / "dense")
    monkeypatch.setattr("ltsim.campaigns.nominal_network.MAX_DENSE_NETWORK_ENTRIES", 0)
    monkeypatch.setattr("ltsim.solve.design.MAX_DENSE_ENTRIES", 0)
    run_campaign(file, tmp_path / "sparse")
    assert_equal_rows(tmp_path / "dense", tmp_path / "sparse", 1e-6)


def assert_equal_rows(first: Path, second: Path, tolerance: float) -> None:
    tables = [pq.read_table(next(folder.rglob("*.parquet"))) for folder in (first, second)]
    assert tables[0].column_names == tables[1].column_names and len(tables[0]) == len(tables[1])
    for name in tables[0].column_names:
        if name != "full_difference_sigma":
            values = [table[name].to_numpy() for table in tables]
            if values[0].dtype.kind == "f":
                np.testing.assert_allclose(values[1], values[0], rtol=tolerance, atol=tolerance)
            else:
                assert (values[0] == values[1]).all()


def test_numbers_of_a_trial_do_not_depend_on_how_they_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = np.concatenate([standard_normal_trials(3, np.arange(k, k + 256), 50, "noise") for k in (0, 256)], axis=1)
    monkeypatch.setattr("ltsim.core.randomness.VALUES_PER_TRIAL_AND_BATCH", 7)
    for trials in ([0], [5], [0, 1, 2], [300, 7, 0, 256], range(10, 500)):
        assert np.array_equal(standard_normal_trials(3, np.array(trials), 50, "noise"), whole[:, list(trials)])


@pytest.mark.parametrize(("limit", "word"), [("MAX_CAMPAIGN_POINTINGS", "pointings"), ("MAX_CAMPAIGN_UNKNOWNS", "coo")])
def test_a_network_that_takes_too_much_memory_is_refused_with_the_way_to_permit_it(
    limit: str, word: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text(FEW)
    monkeypatch.setattr(f"ltsim.campaigns.true_network.{limit}", 20)
    with pytest.raises(
        InputError, match=rf"the network has \d+ {word}.* takes at most 20: .*{POINTINGS_LIMIT_VARIABLE}"
    ):
        run_campaign(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv(POINTINGS_LIMIT_VARIABLE, "5000")
    assert run_campaign(file, tmp_path / "out").n_computed_shards == 1


def test_cells_share_what_they_have_in_common(file: Path) -> None:
    """Scenarios of 4,096 cells took 270 MB."""
    file.write_text(FILE)
    _, (first, second) = load_campaign(file)
    assert first.targets is second.targets and first.stations is second.stations
    assert first.instrument.noise_factor != second.instrument.noise_factor


def test_cells_whose_scenarios_no_reader_takes_are_refused_before_the_work(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rows of 4,096 cells were computed, and then the manifest was refused."""
    file.write_text(FILE)
    monkeypatch.setattr("ltsim.campaigns.design.MAX_MANIFEST_VALUES", 500)
    with pytest.raises(
        InputError, match=r"the scenarios of 2 cells have \d+ values together, expected at most 500: div"
    ):
        run_campaign(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


VERB = "import sys; from ltsim.cli.main import run; sys.exit(run(sys.argv[1:]))"
LARGE = {
    "4,096 geometries": 'trials = 4096\ngeometry = "per-trial"\n',
    "50 rounds in two faces": 'trials = 256\n[scenario_changes]\n"work.repeats" = 50\n"work.faces" = 2\n',
    "50 rounds in two faces, 4 geometries": (
        'trials = 4\nverified_trials_per_shard = 1\ngeometry = "per-trial"\n'
        '[scenario_changes]\n"work.repeats" = 50\n"work.faces" = 2\n'
    ),
    "all statistics": (
        'trials = 65536\ntrials_per_shard = 65536\nstatistics = ["criteria", "errors", "z-scores", "estimates"]\n'
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", LARGE)
def test_a_large_campaign_takes_500_mb(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(f'format = "ltsim-campaign/1"\nseed = 5\n{LARGE[name]}')
    words = [VERB, "campaign", str(tmp_path / "a.toml"), "--out", str(tmp_path / "out")]
    with subprocess.Popen([sys.executable, "-c", *words], stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    assert used.ru_maxrss < 500 * 1024


FIRST_CELLS = """
import os, sys
class WithoutPandas:
    def find_spec(self, name, *given):
        if name == "pandas":
            raise ImportError(name)
sys.meta_path.insert(0, WithoutPandas())
from ltsim.campaigns import campaign
from ltsim.cli.main import run
left, real = [5], campaign.run_shard_task
def task(*given):
    left[0] -= 1
    return real(*given) if left[0] else os._exit(0)
campaign.run_shard_task = task
run(sys.argv[1:])
sys.exit(1)
"""
"""Program that ends at the fifth cell; the others take the same memory one after the other. pyarrow imports pandas
where it is installed, which takes 24 MB."""


@pytest.mark.long
def test_a_campaign_of_most_cells_and_most_pointings_takes_500_mb(tmp_path: Path) -> None:
    """It took 630 MB: the scenarios of all cells were in memory as values, as their copy and as text."""
    levels = [[round(1 + 0.001 * k, 3) for k in range(count)] for count in (61, 60)]
    (tmp_path / "a.toml").write_text(
        'format = "ltsim-campaign/1"\ntrials = 1\ntrials_per_shard = 1\nverified_trials_per_shard = 0\n'
        'statistics = ["errors"]\n[scenario_changes]\n"work.repeats" = 50\n"work.faces" = 2\n[grid]\n'
        f'"instrument.noise_factor" = {levels[0]}\n"instrument.noise.azimuth_arcsec" = {levels[1]}\n'
        '[[methods]]\nmethod = "network"\n'
    )
    words = [FIRST_CELLS, "campaign", str(tmp_path / "a.toml"), "--out", str(tmp_path / "out"), "--jobs", "1", "-q"]
    with subprocess.Popen([sys.executable, "-c", *words], stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    assert used.ru_maxrss < 500 * 1024


def test_metadata_of_files_of_rows_are_no_cyclic_garbage(file: Path, tmp_path: Path) -> None:
    """The metadata of 3,660 files, 70 kB each, stayed in memory until the next collection of cyclic garbage."""
    file.write_text(FILE.replace("trials = 600", "trials = 12"))
    run_campaign(file, tmp_path / "out")
    shards = CampaignFolder(tmp_path / "out").shard_paths()
    gc.collect()
    gc.disable()
    try:
        rows_sql(shards)
        assert not [part for part in gc.get_objects() if type(part) in (pq.FileMetaData, pq.ParquetSchema)]
    finally:
        gc.enable()


def test_shared_json_values_leave_no_cyclic_garbage() -> None:
    """The parts of all scenarios stayed in memory with the function that shared them."""
    gc.collect()
    gc.disable()
    try:
        first, second = shared_json_values([{"a": [{"b": 1}]}, {"a": [{"b": 1}]}])
        assert first["a"] is second["a"]
        assert not gc.collect()
    finally:
        gc.enable()


def test_the_manifest_has_the_text_that_json_gives(file: Path, tmp_path: Path) -> None:
    """Its scenarios are converted one by one."""
    file.write_text(FILE)
    run_campaign(file, tmp_path / "out")
    text = (tmp_path / "out" / "manifest.json").read_text()
    assert len(json.loads(text)["scenarios"]) == 2
    assert text == json.dumps(json.loads(text), indent=1) + "\n"
    assert read_result(tmp_path / "out", ManifestFile).text() == text


def test_files_with_equal_columns_are_not_united_by_names(file: Path, tmp_path: Path) -> None:
    """3,660 files of 40 columns took 370 MB: the database kept a description of each."""
    file.write_text(FILE.replace("trials = 600", "trials = 12"))
    run_campaign(file, tmp_path / "out")
    shards = CampaignFolder(tmp_path / "out").shard_paths()
    sql, n_values = rows_sql(shards)
    table = pq.read_table(shards[0])
    assert len(shards) > 1 and sql.count("read_parquet") == 1 and "union_by_name" not in sql
    assert n_values == len(shards) * len(table) * len(table.column_names)


def test_the_statistics_that_are_written_column_by_column_are_those_of_the_whole(file: Path, tmp_path: Path) -> None:
    """All statistics of 3,660 cells together took 200 MB as objects."""
    file.write_text(FILE.replace("trials = 600", "trials = 12"))
    run_campaign(file, tmp_path / "out")
    results = CampaignResults(tmp_path / "out")
    whole = results.table("summary")
    assert summary_csv_text(results) == whole.csv_text()
    assert "".join(summary_json_parts(results)) == json.dumps(results.summary().model_dump(mode="json"), indent=1)
    for n_rows in (0, 3, 10_000):
        table, n_all = first_summary_rows(results, n_rows)
        assert n_all == len(whole.rows) and table.rows == whole.rows[:n_rows]
    by_column = SummariesByColumn(results)
    assert "target_error_um" in by_column and "z:beam-tilt" not in by_column and len(by_column) == len([*by_column])
    assert by_column["target_error_um"] == results.statistic_summaries("target_error_um")


def test_z_scores_of_blocks_of_cells_are_those_of_all(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text(FILE.replace("trials = 600", "trials = 12"))
    run_campaign(file, tmp_path / "out")
    whole = CampaignResults(tmp_path / "out").z_score_summaries()
    monkeypatch.setattr("ltsim.campaigns.statistics.MAX_Z_SCORE_BLOCK_CELLS", 1)
    assert CampaignResults(tmp_path / "out").z_score_summaries() == whole
    monkeypatch.setattr("ltsim.campaigns.statistics.MAX_COPIED_VALUES", 0)
    assert CampaignResults(tmp_path / "out").z_score_summaries() == whole
    assert len(whole) == 32 and [*dict.fromkeys(s.cell for s in whole)] == [0, 1]


def test_scenarios_that_are_read_share_their_equal_parts(file: Path, tmp_path: Path) -> None:
    file.write_text(FILE.replace("trials = 600", "trials = 12"))
    run_campaign(file, tmp_path / "out")
    first, second = (entry.model_extra for entry in CampaignFolder(tmp_path / "out").manifest().scenarios)
    assert first and second and any(isinstance(v, list | dict) and v and v is second[k] for k, v in first.items())


def test_a_campaign_with_too_many_statistics_is_refused() -> None:
    require_few_cells(4096, [0])
    with pytest.raises(ValueError, match="at most 150000 statistics, but 4096 cells with 2 methods have about 294912"):
        require_few_cells(4096, [0, 0])
    with pytest.raises(ValueError, match="at most 4096 cells"):
        require_few_cells(4097, [0])
