"""Campaigns end to end: the same bytes whatever happens, one sentence for whatever goes wrong."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from ltsim.campaigns import statistics, store, trial_calibrators
from ltsim.campaigns.campaign import WorkerSettings, run_campaign
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.schema import SOLVER_DIFFERENCE_COLUMN
from ltsim.campaigns.shard_rows import ShardTask, make_shard_rows
from ltsim.campaigns.spec import load_campaign
from ltsim.campaigns.statistics import QUANTILE_LEVELS
from ltsim.campaigns.store import CampaignFolder, read_shard
from ltsim.core.errors import InputError, NetworkError
from ltsim.core.randomness import random_stream
from ltsim.simulation.scenario import load_scenario, scenario_to_toml
from tests.campaigns.small import FILE


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted((folder / "rows").rglob("*.parquet"))}


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The shards of an undisturbed run in one process."""
    folder = tmp_path_factory.mktemp("reference")
    (folder / "noise.toml").write_text(FILE)
    outcome = run_campaign(folder / "noise.toml", folder / "out")
    assert (outcome.n_computed_shards, outcome.n_existing_shards) == (6, 0)
    return contents(folder / "out")


def test_rows_hold_what_the_file_asks_for(reference: dict[str, bytes], tmp_path: Path) -> None:
    assert len(reference) == 6
    path = tmp_path / "shard.parquet"
    path.write_bytes(reference["rows/cell-0001/shard-000002.parquet"])
    table = read_shard(path)
    assert table["trial"].to_pylist() == list(range(512, 600))
    assert set(table["cell"].to_pylist()) == {1}
    assert set(table["status"].to_pylist()) == {"converged"}
    checked = table[SOLVER_DIFFERENCE_COLUMN].drop_null().to_pylist()
    assert len(checked) == 1 and 0 < checked[0] < 1e-3
    assert "z:beam-tilt" in table.column_names and "estimate:beam-tilt" not in table.column_names


def test_rows_carry_the_settings_of_their_cell_and_units(reference: dict[str, bytes], tmp_path: Path) -> None:
    path = tmp_path / "shard.parquet"
    path.write_bytes(reference["rows/cell-0001/shard-000002.parquet"])
    schema = pq.read_schema(path)
    assert schema.names[:3] == ["cell", "noise_factor", "method"]
    assert schema.field("noise_factor").metadata == {b"unit": b"", b"keys": b"instrument.noise_factor"}
    metadata = schema.field("target_error_um").metadata
    assert metadata[b"unit"] == b"um" and b"it includes the noise of the adjusted readings" in metadata[b"meaning"]
    assert set(read_shard(path)["noise_factor"].to_pylist()) == {2.0}


def test_estimates_and_truth_carry_the_units_of_their_parameters(file: Path) -> None:
    text = FILE.replace("trials = 600", 'trials = 2\nstatistics = ["estimates", "truth", "z-scores"]')
    file.write_text(text + '[scenario_changes]\neffects = [{name = "range-cyclic", draw = true}]\n')
    campaign, scenarios = load_campaign(file)
    rows = make_shard_rows(ShardTask(campaign, scenarios[0], "", 0, 0))
    units = {field.name: (field.metadata or {})[b"unit"].decode() for field in rows.schema}
    assert units["estimate:beam-tilt"] == units["sigma:beam-tilt"] == units["true:beam-tilt"] == "urad"
    assert units["z:beam-tilt"] == units["chi2"] == ""
    assert {unit for name, unit in units.items() if name.startswith("true:range-cyclic")} == {"um"}


def test_two_workers_give_the_same_bytes(file: Path, tmp_path: Path, reference: dict[str, bytes]) -> None:
    run_campaign(file, tmp_path / "out", workers=WorkerSettings(n_processes=2))
    assert contents(tmp_path / "out") == reference


def test_interrupted_and_resumed_gives_the_same_bytes(file: Path, tmp_path: Path, reference: dict[str, bytes]) -> None:
    done: list[int] = []

    def stop(trials: int) -> None:
        done.append(trials)
        if len(done) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(file, tmp_path / "out", progress=stop)
    assert len(contents(tmp_path / "out")) == 2
    outcome = run_campaign(file, tmp_path / "out", resume=True)
    assert (outcome.n_computed_shards, outcome.n_existing_shards) == (4, 2)
    assert contents(tmp_path / "out") == reference


def test_killed_at_any_moment_loses_nothing_finished(
    file: Path, tmp_path: Path, reference: dict[str, bytes], root: Path
) -> None:
    out = tmp_path / "out"
    code = (
        "import sys; from pathlib import Path; from ltsim.campaigns.campaign import run_campaign\n"
        f"run_campaign(Path({str(file)!r}), Path({str(out)!r}))"
    )
    worker = subprocess.Popen([sys.executable, "-c", code], cwd=root)
    deadline = time.monotonic() + 120
    while not contents(out) and worker.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    finished = contents(out)
    assert finished
    assert all(reference[name] == content for name, content in finished.items())
    run_campaign(file, out, resume=True)
    assert contents(out) == reference
    assert not list(out.rglob("*.tmp"))


KILLS, LATEST = 10, 0.2
"""Resumed runs that are killed, and the latest moment [s] after a shard, which takes about as long."""
RESUMED = """import sys
from pathlib import Path
from ltsim.campaigns.campaign import WorkerSettings, run_campaign

if __name__ == "__main__":
    print("begun", flush=True)
    workers = WorkerSettings(n_processes=int(sys.argv[3]))
    progress = lambda trials: print(trials, flush=True)
    run_campaign(Path(sys.argv[1]), Path(sys.argv[2]), resume=True, workers=workers, progress=progress)
"""


@pytest.mark.long
@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_at_random_moments_of_resumed_runs_the_next_completes_with_the_same_rows(
    jobs: int, file: Path, tmp_path: Path, root: Path
) -> None:
    file.write_text(FILE.replace("trials_per_shard = 256", "trials_per_shard = 32"))
    whole, out, script = tmp_path / "whole", tmp_path / "out", tmp_path / "resumed.py"
    assert run_campaign(file, whole).n_computed_shards == 38
    script.write_text(RESUMED)
    killed, present = 0, set[str]()
    for number, moment in enumerate(random_stream(7, "moments").uniform(0.0, LATEST, KILLS)):
        command = [sys.executable, str(script), str(file), str(out), str(jobs)]
        with subprocess.Popen(command, cwd=root, env={**os.environ, "PYTHONPATH": str(root)}, stdout=-1) as worker:
            assert worker.stdout is not None
            for _ in range(1 + number % 4):  # as it begins, then after up to three shards
                worker.stdout.readline()
            time.sleep(float(moment))
            worker.kill()
        killed += worker.returncode == -signal.SIGKILL
        finished = contents(out)
        assert present <= {*finished}
        assert {name: (whole / name).read_bytes() for name in finished} == finished
        present = {*finished}
    assert killed and present
    run_campaign(file, out, resume=True)
    assert contents(out) == contents(whole)
    assert (out / "rows.sha256").read_bytes() == (whole / "rows.sha256").read_bytes()
    assert not [path for path in out.rglob("*") if path.suffix == ".damaged" or path.name.startswith(".ltsim-")]


def test_finished_campaign_is_not_begun_again_by_mistake(file: Path, tmp_path: Path) -> None:
    run_campaign(file, tmp_path / "out")
    with pytest.raises(InputError, match=r"holds a campaign.*resume=True"):
        run_campaign(file, tmp_path / "out")
    assert run_campaign(file, tmp_path / "out", resume=True).n_computed_shards == 0


@pytest.mark.parametrize("how", ["cut", "flipped", "of another campaign"])
def test_damaged_shard_is_set_aside_and_done_again(
    how: str, file: Path, tmp_path: Path, reference: dict[str, bytes]
) -> None:
    out = tmp_path / "out"
    run_campaign(file, out)
    name = "rows/cell-0000/shard-000001.parquet"
    whole = (out / name).read_bytes()
    if how == "cut":
        (out / name).write_bytes(whole[: len(whole) // 2])
    elif how == "flipped":
        middle = len(whole) // 2
        (out / name).write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    else:
        (out / name).write_bytes((out / "rows/cell-0001/shard-000001.parquet").read_bytes())
    outcome = run_campaign(file, out, resume=True)
    assert outcome.n_computed_shards == 1
    assert len([note for note in outcome.notes if "is damaged" in note]) == 1
    assert contents(out) == reference
    assert (out / name).with_suffix(".damaged").exists()


def test_changed_file_is_refused_and_rows_stay(file: Path, tmp_path: Path, reference: dict[str, bytes]) -> None:
    out = tmp_path / "out"
    run_campaign(file, out)
    file.write_text(FILE.replace("seed = 5", "seed = 6"))
    with pytest.raises(InputError, match=r"changed since this campaign started \(seed\)"):
        run_campaign(file, out, resume=True)
    assert contents(out) == reference
    assert run_campaign(out / "campaign.toml", out, resume=True).n_existing_shards == 6


def test_a_campaign_of_a_users_scenario_continues_from_its_copy(file: Path, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    text = scenario_to_toml(load_scenario("paper-laboratory"))
    (tmp_path / "sub" / "mine.toml").write_text(text)
    file.write_text(FILE.replace("paper-workshop", "sub/mine.toml").replace("trials = 600", "trials = 300"))
    out = tmp_path / "out"
    run_campaign(file, out)
    shard = CampaignFolder(out).shard_path(0, 1)
    before = shard.read_bytes()
    shard.unlink()
    file.unlink()
    assert run_campaign(out / "campaign.toml", out, resume=True).n_computed_shards == 1
    assert shard.read_bytes() == before


def test_other_versions_are_refused(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_campaign(file, out)
    manifest = json.loads((out / "manifest.json").read_text())
    manifest["versions"]["numpy"] = "1.0"
    (out / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"started with numpy 1\.0"):
        run_campaign(file, out, resume=True)


def test_another_type_of_processor_is_remarked_on(file: Path, tmp_path: Path) -> None:
    run_campaign(file, tmp_path / "out")
    path = tmp_path / "out" / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["processor"], here = "z80", manifest["processor"]
    path.write_text(json.dumps(manifest))
    notes = run_campaign(file, tmp_path / "out", resume=True).notes
    assert len(notes) == 1 and f"started on a processor of type z80, continued on {here}" in notes[0]


def test_full_disk_is_a_sentence_and_finished_shards_stay(
    file: Path, tmp_path: Path, reference: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, synced, real = tmp_path / "out", [0], os.fsync

    def full(handle: int) -> None:
        synced[0] += 1
        if synced[0] > 8:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    monkeypatch.setattr(store.os, "fsync", full)
    with pytest.raises(InputError, match="the disk is full; complete files of rows remain in the folder"):
        run_campaign(file, out)
    before = contents(out)
    assert 0 < len(before) < 6
    assert not list(out.rglob("*.tmp"))
    monkeypatch.undo()
    run_campaign(file, out, resume=True)
    assert contents(out) == reference


def test_folder_that_cannot_be_written_is_a_sentence(file: Path, tmp_path: Path) -> None:
    (tmp_path / "blocked").write_text("a file, not a folder")
    with pytest.raises(InputError, match="cannot be written"):
        run_campaign(file, tmp_path / "blocked" / "out")


def test_two_campaigns_in_a_folder_stay_separate(file: Path, tmp_path: Path) -> None:
    with (
        CampaignFolder(tmp_path / "out").lock(),
        pytest.raises(InputError, match="another campaign runs in this folder"),
    ):
        run_campaign(file, tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (('trials = 600', 'trails = 600'), "did you mean trials"),
        (('"instrument.noise_factor" = [1.0, 2.0]', '"instrument.nois_factor" = [1.0]'), "noise_factor"),
        (('"instrument.noise_factor" = [1.0, 2.0]', '"instrument.noise_factor" = [-1.0]'), "noise_factor"),
        (('"instrument.noise_factor" = [1.0, 2.0]', '"title.more" = [1]'), "which is not a table"),
        (('scenario = "paper-workshop"', 'scenario = "paper-workshp"'), "paper-workshop"),
        (('[grid]', '[[methods]]\nmethod = "distance"\neffects = [{name = "head-sag"}]\n[grid]'), "should be empty"),
        (('[grid]', '[[methods]]\neffects = [{name = "head-sagg"}]\n[grid]'), "head-sag"),
        (('[grid]', '[[methods]]\n[[methods]]\n[grid]'), "different names"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_a_sentence(change: tuple[str, str], says: str, file: Path, tmp_path: Path) -> None:
    file.write_text(FILE.replace(*change))
    with pytest.raises(InputError) as raised:
        run_campaign(file, tmp_path / "out")
    assert says in str(raised.value) and "\n" not in str(raised.value)
    assert not (tmp_path / "out" / "manifest.json").exists()


def test_a_trial_depends_on_its_number_alone(file: Path) -> None:
    """Other shards, more trials, another method beside: the same rows."""
    campaign, scenarios = load_campaign(file)
    long = campaign.model_copy(update={"trials": 900, "trials_per_shard": 700})
    table = make_shard_rows(ShardTask(campaign, scenarios[0], "", 0, 1))
    other = make_shard_rows(ShardTask(long, scenarios[0], "", 0, 0))
    same = other.slice(256, 256)
    for name in ("trial", "chi2", "z:range-scale", "distance_after_mean_um", "error_calibrated_um"):
        assert table[name].to_pylist() == same[name].to_pylist()


def test_methods_see_the_same_draws(file: Path) -> None:
    file.write_text(
        FILE.replace("trials = 600", "trials = 12").replace(
            "[grid]", '[[methods]]\n[[methods]]\nname = "one by one"\nsolver = "single"\n[grid]'
        )
    )
    campaign, scenarios = load_campaign(file)
    rows = make_shard_rows(ShardTask(campaign, scenarios[0], "", 0, 0))
    batch, alone = rows.slice(0, 12), rows.slice(12, 12)
    assert set(alone["method"].to_pylist()) == {"one by one"}
    assert batch["error_raw_um"].to_pylist() == alone["error_raw_um"].to_pylist()
    gap = np.array(batch["z:beam-tilt"].to_pylist()) - np.array(alone["z:beam-tilt"].to_pylist())
    assert 0 < np.abs(gap).max() < 1e-3
    assert alone[SOLVER_DIFFERENCE_COLUMN].null_count == 12


def test_geometry_may_vary_per_trial(file: Path) -> None:
    file.write_text(
        FILE.replace("trials = 600", 'trials = 3\ngeometry = "per-trial"\nstatistics = ["errors", "truth"]')
    )
    campaign, scenarios = load_campaign(file)
    rows = make_shard_rows(ShardTask(campaign, scenarios[0], "", 0, 0))
    assert rows["trial"].to_pylist() == list(range(3))
    assert set(rows["status"].to_pylist()) == {"converged"}
    assert max(rows[SOLVER_DIFFERENCE_COLUMN].drop_null().to_pylist()) < 1e-3
    assert len(set(rows["true:beam-tilt"].to_pylist())) == 3


def test_failed_trials_are_rows(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(
        FILE.replace("trials = 600", "trials = 4").replace("[grid]", '[[methods]]\nsolver = "single"\n[grid]')
    )
    campaign, scenarios = load_campaign(file)
    real: Callable[..., object] = trial_calibrators.adjust
    calls = [0]

    def sometimes(*args: object, **settings: object) -> object:
        calls[0] += 1
        if calls[0] == 2:
            raise NetworkError("lost")
        return real(*args, **settings)

    monkeypatch.setattr(trial_calibrators, "adjust", sometimes)
    rows = make_shard_rows(ShardTask(campaign, scenarios[0], "", 0, 0))
    assert rows["status"].to_pylist() == ["converged", "failed", "converged", "converged"]
    for name in ("chi2", "z:beam-tilt", "distance_after_mean_um", "error_calibrated_um", "target_error_um"):
        assert rows[name].null_count == 1 and rows[name][1].as_py() is None
    assert rows["distance_before_mean_um"].null_count == 0


def test_statistics_are_those_of_the_rows(file: Path, tmp_path: Path) -> None:
    run_campaign(file, tmp_path / "out")
    results = CampaignResults(tmp_path / "out")
    whole = pq.read_table(tmp_path / "out" / "rows" / "cell-0001").to_pydict()
    before, after = (np.array(whole[f"distance_{when}_mean_um"]) for when in ("before", "after"))
    improvement = 100 * (1 - after / before)
    spread = results.statistic_summaries("distance_improvement_percent")[1]
    assert (spread.cell, spread.method, spread.trials) == (1, "network", 600)
    assert spread.mean == pytest.approx(improvement.mean(), rel=1e-5)
    assert spread.standard_deviation == pytest.approx(improvement.std(ddof=1), rel=1e-5)
    assert spread.quantiles == pytest.approx(np.quantile(improvement, QUANTILE_LEVELS), rel=1e-4)
    assert spread.low < spread.mean < spread.high
    z = np.array(whole["z:transit-tilt"])
    score = next(s for s in results.z_score_summaries() if s.cell == 1 and s.parameter == "transit-tilt")
    assert (score.mean, score.standard_deviation) == pytest.approx((z.mean(), z.std(ddof=1)), rel=1e-4, abs=1e-6)
    assert [c.verified_trials for c in results.solver_comparisons()] == [3, 3]
    assert all((c.largest_difference_sigma or 1) < 1e-3 for c in results.solver_comparisons())
    assert json.dumps(results.summary().model_dump(mode="json"), allow_nan=False)


def test_quantiles_of_very_many_rows_come_from_a_digest(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_campaign(file, tmp_path / "out")
    results = CampaignResults(tmp_path / "out")
    exact = results.statistic_summaries("target_error_um")[0]
    monkeypatch.setattr(statistics, "MAX_ROWS_FOR_EXACT_QUANTILES", 1000)
    rough = results.statistic_summaries("target_error_um")[0]
    assert rough.mean == exact.mean and rough.quantiles != exact.quantiles
    assert np.abs(np.subtract(rough.quantiles, exact.quantiles)).max() < 0.15 * exact.standard_deviation


def test_paired_comparison_of_methods(file: Path, tmp_path: Path) -> None:
    file.write_text(FILE.replace("[grid]", '[[methods]]\n[[methods]]\nname = "none"\nconstruction = "ideal"\n[grid]'))
    run_campaign(file, tmp_path / "out")
    results = CampaignResults(tmp_path / "out")
    gap = results.paired_differences("target_error_um", method=("none", "network")).entries
    assert [g.trials for g in gap] == [600, 600] and [g.shared_levels for g in gap] == results.levels
    means = {(s.cell, s.method): s.mean for s in results.statistic_summaries("target_error_um")}
    assert gap[0].difference == pytest.approx(means[0, "none"] - means[0, "network"], rel=1e-4)
    assert gap[0].low > 0  # an uncalibrated network errs more
