"""Campaigns that grow take only what is missing, and their rows are those of one that began so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from ltsim.campaigns.campaign import run_campaign
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.spec import load_campaign
from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.trial_evaluation import TrialEvaluator
from ltsim.cli.main import run
from ltsim.core.errors import InputError
from ltsim.reports.sections.campaign import MAX_CELL_ROWS

FILE = """
format = "ltsim-campaign/1"
seed = 5
trials = 24
trials_per_shard = 16
verified_trials_per_shard = 1
statistics = ["errors"]

[grid]
"instrument.noise_factor" = [1.0, 2.0]
"""


@pytest.fixture
def begun(tmp_path: Path) -> tuple[Path, Path]:
    """A finished campaign: its file and its folder."""
    (tmp_path / "sweep.toml").write_text(FILE)
    run_campaign(tmp_path / "sweep.toml", tmp_path / "out")
    return tmp_path / "sweep.toml", tmp_path / "out"


def rows(folder: Path, columns: str = "trial, error_raw_um") -> set[tuple[object, ...]]:
    return set(CampaignResults(folder).query(f"SELECT noise_factor, {columns} FROM rows"))


@pytest.mark.parametrize(
    ("change", "shards", "retained", "trials", "repeated", "judged"),
    [
        (("[1.0, 2.0]", "[1.0, 1.5, 2.0]"), 2, 4, 24, 2, 2),
        (("trials = 24", "trials = 40"), 4, 2, 2 * 16, 2, 4),
        (('["errors"]', '["errors", "z-scores", "truth"]'), 4, 0, 2 * 24, 0, 0),
        pytest.param(("[1.0, 2.0]", "[0.5, 2.0, 1.0]"), 2, 4, 24, 2, 2, marks=pytest.mark.long),
        pytest.param(('["errors"]', '["truth", "errors"]'), 4, 0, 0, 0, 0, marks=pytest.mark.long),
    ],
)
def test_a_grown_campaign_takes_what_is_missing(
    change: tuple[str, str],
    shards: int,
    retained: int,
    trials: int,
    repeated: int,
    judged: int,
    begun: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file, out = begun
    before = rows(out)
    file.write_text(FILE.replace(*change))
    calls = {name: list[int]() for name in ("calibrate", "largest_solver_difference", "method_columns")}
    with monkeypatch.context() as counted:
        for owner, name, size in (
            (BatchCalibrator, "calibrate", len),
            (BatchCalibrator, "largest_solver_difference", int),
            (TrialEvaluator, "method_columns", id),
        ):
            plain = getattr(owner, name)

            def noted(*given: Any, plain: Any = plain, done: list[int] = calls[name], size: Any = size) -> Any:
                done.append(size(given[2]))
                return plain(*given)

            counted.setattr(owner, name, noted)
        outcome = run_campaign(file, out, resume=True)
    assert (outcome.n_computed_shards, outcome.n_existing_shards, outcome.notes) == (shards, retained, ())
    assert (sum(calls["calibrate"]), len(calls["largest_solver_difference"]), len(calls["method_columns"])) == (
        trials,
        repeated,
        judged,
    )
    run_campaign(file, tmp_path / "anew")
    assert before <= rows(out) == rows(tmp_path / "anew")
    for name in () if change[0] == "[1.0, 2.0]" else [p.relative_to(out) for p in out.rglob("*.parquet")]:
        anew, grown = tmp_path / "anew" / name, out / name
        assert pq.read_table(grown).select(pq.read_table(anew).column_names).equals(pq.read_table(anew))
        assert anew.read_bytes() == grown.read_bytes() or '["truth' in change[1]  # whose order is another
    assert run_campaign(file, out, resume=True).n_computed_shards == 0


def test_a_smaller_file_loses_nothing(begun: tuple[Path, Path]) -> None:
    file, out = begun
    file.write_text(FILE.replace("trials = 24", "trials = 8"))
    before = rows(out)
    assert run_campaign(file, out, resume=True).n_computed_shards == 0 and rows(out) == before


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[1.0, 2.0]", "[1.0, 3.0]"), "changed since"),
        (("[1.0, 2.0]", '[1.0, 2.0]\n"work.faces" = [1, 2]'), "a different factor needs another out"),
    ],
)
def test_rows_that_would_change_stay(change: tuple[str, str], says: str, begun: tuple[Path, Path]) -> None:
    file, out = begun
    before = {p: p.read_bytes() for p in out.rglob("*.parquet")}
    file.write_text(FILE.replace(*change))
    with pytest.raises(InputError, match=says):
        run_campaign(file, out, resume=True)
    assert {p: p.read_bytes() for p in out.rglob("*.parquet")} == before


def test_values_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "sweep.toml", tmp_path / "sweep"
    file.write_text(FILE)
    command = ["campaign", str(file), "-q", "--set"]
    assert run([*command, "work.faces=2", "--set", "trials=8", "--set", "instrument.noise_factor=1.0"]) == 0
    results = CampaignResults(out)
    assert results.manifest.trials == 8 and [level["noise_factor"] for level in results.levels] == [1.0]
    assert results.manifest.scenarios[0].model_dump()["work"]["faces"] == 2
    assert run_campaign(out / "campaign.toml", out, resume=True).n_computed_shards == 0
    for wrong in ("work.faces", "work.faces=3", "work.face=2"):
        assert run([*command, wrong, "--out", str(tmp_path / "no")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and "expected KEY=VALUE" in lines[0]
    assert load_campaign(file, {"instrument.noise_factor": 3.0})[0].grid == {"instrument.noise_factor": [3.0]}


@pytest.mark.long
def test_many_cells_are_listed_by_their_factors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "many.toml"
    levels = [1 + k / 100 for k in range(MAX_CELL_ROWS // 2 + 1)]
    grid = f'[grid]\n"instrument.noise_factor" = {levels}\n"work.faces" = [1, 2]\n'
    file.write_text(FILE.partition("[grid]")[0].replace("trials = 24", "trials = 2") + grid)
    assert run(["campaign", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:2] == ["faces", "2"] for line in lines)
    assert len(lines) < 2 * (len(levels) + 2) + 10


def test_exit_status_1_names_the_cell_even_when_quiet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "sweep.toml"
    file.write_text(
        FILE.replace("verified_trials_per_shard = 0", "verified_trials_per_shard = 1").replace("[1.0, 2.0]", "[2.0]")
    )
    monkeypatch.setattr("ltsim.campaigns.trial_calibrators.BatchCalibrator.largest_solver_difference", lambda *_: 0.01)
    assert run(["campaign", str(file), "--quiet"]) == 1
    error_text = capsys.readouterr().err
    assert (
        "cell 1 (noise_factor = 2)" in error_text and "up to 0.01 sigma" in error_text and "limit 0.001" in error_text
    )


def test_damaged_shards_of_a_grown_campaign_are_done_again(begun: tuple[Path, Path]) -> None:
    file, out = begun
    shard = out / "rows/cell-0001/shard-000000.parquet"
    whole = pq.read_table(shard)
    shard.write_bytes(shard.read_bytes()[:500])
    file.write_text(FILE.replace("trials = 24", "trials = 32"))
    outcome = run_campaign(file, out, resume=True)
    assert outcome.n_computed_shards == 3 and "is damaged" in outcome.notes[0]
    assert pq.read_table(shard).equals(whole)
