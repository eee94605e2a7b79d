"""What a campaign's folder is safe from: flipped bits, other folders, changed inputs, sizes nobody could keep."""

from __future__ import annotations

import gc
import json
import subprocess
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh

from ltsim.campaigns import campaign
from ltsim.campaigns.campaign import git_commit_of_checkout, run_campaign
from ltsim.campaigns.results import CampaignResults
from ltsim.campaigns.schema import MAX_SHARDS
from ltsim.campaigns.statistics import CampaignStatistics, database_memory_limit
from ltsim.campaigns.store import CampaignFolder
from ltsim.core.errors import InputError, LtsimError, WorkerError
from ltsim.core.limits import MAX_FILE_BYTES, MAX_READ_SHARD_ROWS
from ltsim.core.randomness import random_stream
from ltsim.simulation.scenario import load_scenario, scenario_to_toml
from ltsim.simulation.sections import Obstacle
from tests.campaigns.small import FILE


def test_no_flipped_bit_reaches_a_figure(file: Path, tmp_path: Path) -> None:
    run_campaign(file, tmp_path / "out")
    shard = CampaignFolder(tmp_path / "out").shard_path(0, 1)
    whole = shard.read_bytes()
    before = CampaignResults(tmp_path / "out").summary()
    for place in random_stream(3, "flips").integers(0, 8 * len(whole), 25):
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << (place % 8)
        shard.write_bytes(flipped)
        with pytest.raises(InputError, match=r"shard\) cannot be read.*resume=True"):
            CampaignResults(tmp_path / "out")
    shard.write_bytes(whole)
    (tmp_path / "out" / "rows.sha256").unlink()
    assert CampaignResults(tmp_path / "out").summary() == before


def test_a_shard_of_another_campaign_is_refused_without_digests(file: Path, tmp_path: Path) -> None:
    run_campaign(file, tmp_path / "out")
    file.write_text(FILE.replace("seed = 5", "seed = 6"))
    run_campaign(file, tmp_path / "other")
    foreign = CampaignFolder(tmp_path / "other").shard_path(0, 0).read_bytes()
    CampaignFolder(tmp_path / "out").shard_path(0, 0).write_bytes(foreign)
    (tmp_path / "out" / "rows.sha256").unlink()
    with pytest.raises(InputError, match="belongs to another campaign"):
        CampaignResults(tmp_path / "out")


@pytest.mark.parametrize("with_digests", [True, False])
def test_a_small_file_of_very_many_rows_is_refused_before_it_is_read(
    with_digests: bool, file: Path, tmp_path: Path
) -> None:
    """30,000,000 equal rows in a file of 100 kB took 2 GB."""
    run_campaign(file, tmp_path / "out")
    store = CampaignFolder(tmp_path / "out")
    shard = store.shard_path(0, 0)
    table = pq.read_table(shard)
    rows = {f.name: np.repeat(table[f.name].to_numpy()[:1], MAX_READ_SHARD_ROWS + 1) for f in table.schema}
    pq.write_table(pa.table(rows, table.schema), shard, compression="zstd")
    assert shard.stat().st_size < 1e6
    (tmp_path / "out" / "rows.sha256").unlink()
    if with_digests:
        for number in range(2):
            store.record_digest(0, number)
    with pytest.raises(InputError, match=f"{MAX_READ_SHARD_ROWS + 1} rows, expected at most {MAX_READ_SHARD_ROWS}"):
        CampaignResults(tmp_path / "out")


@pytest.mark.parametrize("shard", [24, None])
def test_a_manifest_of_very_many_files_of_rows_is_refused(shard: int | None, file: Path, tmp_path: Path) -> None:
    """Their list took 3.5 GB."""
    few = FILE.replace("trials = 600", "trials = 8")
    file.write_text(few)
    run_campaign(file, tmp_path / "out")
    manifest = tmp_path / "out" / "manifest.json"
    content = {**json.loads(manifest.read_text()), "trials": 10**18, "trials_per_shard": shard}
    manifest.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    with pytest.raises(InputError, match=f"at most {MAX_SHARDS} files of rows"):
        run_campaign(file, tmp_path / "out", resume=True)


def test_the_database_takes_memory_in_proportion_to_its_files(tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(b"x")
    with (tmp_path / "large").open("wb") as stream:
        stream.truncate(2 * MAX_FILE_BYTES)
    assert database_memory_limit([tmp_path / "small"]) == "250MiB"
    assert database_memory_limit([tmp_path / "large"]) == "500MiB"


def test_a_folder_is_no_pattern(file: Path, tmp_path: Path) -> None:
    """The database took the name of a folder `noise_factor=3` for a column of the rows."""
    few = FILE.replace("trials = 600", "trials = 8")
    file.write_text(few)
    run_campaign(file, tmp_path / "run1")
    file.write_text(few.replace("seed = 5", "seed = 6"))
    others = ("run[1]", "run*", "it's", "noise_factor=3")
    for name in others:
        run_campaign(file, tmp_path / name)
    first, *means = (
        CampaignResults(tmp_path / name).statistic_summaries("target_error_um") for name in ("run1", *others)
    )
    assert all(mean == means[0] != first for mean in means)
    rows = CampaignResults(tmp_path / "noise_factor=3").query("SELECT DISTINCT cell, noise_factor FROM rows ORDER BY 1")
    assert rows == [(0, 1.0), (1, 2.0)]
    assert run_campaign(file, tmp_path / "run[1]", resume=True).n_existing_shards == 2


def test_tables_are_the_same_bytes_from_run_to_run(file: Path, tmp_path: Path) -> None:
    run_campaign(file, tmp_path / "out")
    texts = {CampaignResults(tmp_path / "out").table("summary").csv_text() for _ in range(3)}
    assert len(texts) == 1


def test_a_changed_cad_file_is_noticed_and_stored(file: Path, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    cad = tmp_path / "parts" / "box.stl"
    trimesh.creation.box([0.1, 0.1, 0.1]).export(cad)
    base = load_scenario("paper-workshop")
    stands = Obstacle(file="parts/box.stl", unit="m", position_mm=(1000.0, 3000.0, 100.0))
    room = base.workshop.model_copy(update={"obstacles": (stands,)})
    (tmp_path / "mine.toml").write_text(scenario_to_toml(base.model_copy(update={"workshop": room})))
    file.write_text(FILE.replace("paper-workshop", "mine.toml").replace("trials = 600", "trials = 4"))
    out = tmp_path / "out"
    run_campaign(file, out)
    assert (out / "parts" / "box.stl").read_bytes() == cad.read_bytes()
    trimesh.creation.box([0.2, 0.1, 0.1]).export(cad)
    with pytest.raises(InputError, match="changed since this campaign started"):
        run_campaign(file, out, resume=True)
    cad.unlink()
    assert run_campaign(out / "campaign.toml", out, resume=True).n_existing_shards == 2


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[1.0, 2.0]", str([1.0] * 5000)), "at most 4096 cells, but grid, design and cells give 5000"),
        (
            ("trials = 600\ntrials_per_shard = 256", "trials = 1000000000\ntrials_per_shard = 1"),
            "increase trials_per_shard",
        ),
        (
            (
                "trials_per_shard = 256\nverified_trials_per_shard = 1\n",
                'trials_per_shard = 600\n[[methods]]\n[[methods]]\nname = "b"\n',
            ),
            "at most 1000 rows, but trials_per_shard and methods give 1200: reduce trials_per_shard",
        ),
    ],
)
def test_a_campaign_that_nobody_could_keep_is_a_sentence(
    change: tuple[str, str], says: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ltsim.campaigns.spec.MAX_WRITTEN_SHARD_ROWS", 1000)
    file.write_text(FILE.replace(*change))
    with pytest.raises(InputError, match=says):
        run_campaign(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_beginning_anew_takes_a_word(file: Path, tmp_path: Path) -> None:
    file.write_text(FILE.replace("trials = 600", "trials = 8"))
    out = tmp_path / "out"
    run_campaign(file, out)
    file.write_text(FILE.replace("trials = 600", "trials = 8").replace("seed = 5", "seed = 6"))
    assert run_campaign(file, out, force=True).n_computed_shards == 2
    assert CampaignResults(out).manifest.seed == 6
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "campaign.toml").write_text("mine")
    with pytest.raises(InputError, match=r"contains campaign\.toml but no campaign.*force=True"):
        run_campaign(file, tmp_path / "mine")
    assert [p.name for p in (tmp_path / "mine").iterdir()] == ["campaign.toml"]


def test_a_manifest_without_cells_is_a_sentence(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    file.write_text(FILE.replace("trials = 600", "trials = 8"))
    run_campaign(file, out)
    manifest = json.loads((out / "manifest.json").read_text())
    del manifest["cells"]
    (out / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="cells: Field required"):
        CampaignResults(out)


def test_a_line_of_digests_that_was_cut_is_repaired(file: Path, tmp_path: Path) -> None:
    """A process that is killed while it notes a shard leaves half a line; the next line would be joined to it."""
    out, few = tmp_path / "out", FILE.replace("trials = 600", "trials = 300").replace("[1.0, 2.0]", "[1.0]")
    file.write_text(few)
    run_campaign(file, out)
    digests = out / "rows.sha256"
    whole = digests.read_text()
    assert whole.count("\n") == 2
    for cut in (whole[:-20], whole[:100], whole[:-1], whole + "abc", whole + whole, "\x00" + whole):
        digests.write_text(cut)
        assert run_campaign(file, out, resume=True).n_existing_shards == 2
        assert digests.read_text() == whole
        assert CampaignFolder(out).recorded_shard_digests().keys() == {
            f"rows/cell-0000/shard-00000{k}.parquet" for k in (0, 1)
        }
    assert not list(out.rglob(".ltsim-*"))


@pytest.mark.parametrize("interrupted", [False, True])
def test_file_of_digests_is_the_same_for_any_order_of_completion(
    interrupted: bool, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text(
        FILE.replace("trials_per_shard = 256", "trials_per_shard = 16").replace("trials = 600", "trials = 40")
    )
    in_order, other_order = tmp_path / "in-order", tmp_path / "other-order"
    run_campaign(file, in_order)

    def last_shard_first(
        function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], *_: Any, **__: Any
    ) -> Iterator[Any]:
        for count, values in enumerate(reversed([*arguments])):
            if interrupted and count == 3:
                raise WorkerError("a worker process was killed")
            yield function(*values)

    with monkeypatch.context() as patched:
        patched.setattr(campaign, "run_parallel", last_shard_first)
        with pytest.raises(InputError, match="was killed") if interrupted else nullcontext():
            run_campaign(file, other_order)
    if interrupted:
        assert run_campaign(file, other_order, resume=True).n_existing_shards == 3
    digests = (in_order / "rows.sha256").read_text()
    assert (other_order / "rows.sha256").read_text() == digests
    names = [line.split()[1] for line in digests.splitlines()]
    assert len(names) == 6 and names == sorted(names)


@pytest.mark.parametrize("name", ["rows", "rows.sha256", "manifest.json"])
def test_no_row_is_written_through_a_link_that_leaves_the_folder(name: str, file: Path, tmp_path: Path) -> None:
    file.write_text(FILE.replace("trials = 600", "trials = 8"))
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    place = tmp_path / "elsewhere" / "mine"
    place.mkdir() if name == "rows" else place.write_text("mine")
    (tmp_path / "out" / name).symlink_to(place)
    with pytest.raises(LtsimError):
        run_campaign(file, tmp_path / "out")
    assert list(place.iterdir()) == [] if name == "rows" else place.read_text() == "mine"


@pytest.mark.parametrize(("name", "option"), [("rows", "resume"), ("rows", "force"), ("rows/cell-0000", "resume")])
def test_rows_that_lie_in_another_folder_stay_as_they_are(name: str, option: str, file: Path, tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    file.write_text(FILE.replace("trials = 600", "trials = 8"))
    run_campaign(file, out)
    (out / name).rename(elsewhere)
    (out / name).symlink_to(elsewhere)
    shard = next(elsewhere.rglob("shard-000000.parquet"))
    shard.write_bytes(b"mine")
    with pytest.raises(LtsimError, match="is a link out of the folder"):
        run_campaign(file, out, **{option: True})  # type: ignore[arg-type]
    assert shard.read_bytes() == b"mine" and not list(elsewhere.rglob("*.damaged"))
    assert (out / "manifest.json").exists()


@pytest.mark.parametrize(
    ("place", "tracked", "is_checkout"),
    [("", True, True), ("vendor", True, False), (".venv/lib/site-packages", False, False), ("", False, False)],
)
def test_a_commit_is_of_the_checkout_of_ltsim_alone(
    place: str, tracked: bool, is_checkout: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> str:
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false", *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip()

    file = tmp_path / place / "ltsim" / "campaigns" / "campaign.py"
    file.parent.mkdir(parents=True)
    file.write_text("")
    (tmp_path / "readme").write_text("")
    git("init", "-q")
    git("add", *(["."] if tracked else ["readme"]))
    git("commit", "-q", "-m", "first")
    monkeypatch.setattr("ltsim.campaigns.campaign.__file__", str(file))
    monkeypatch.setenv("GIT_DIR", str(Path(__file__).parents[2] / ".git"))  # of no account
    monkeypatch.delenv("GIT_DIR" if is_checkout else "GIT_NOTHING", raising=False)
    assert git_commit_of_checkout() == (git("rev-parse", "HEAD") if is_checkout else None)


def test_a_campaign_says_which_ltsim_made_it(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_campaign(file, tmp_path / "out")
    content = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert content["versions"]["ltsim"] == version("ltsim")
    content["commit"] = None
    (tmp_path / "out" / "manifest.json").write_text(json.dumps(content))
    monkeypatch.setattr("ltsim.campaigns.campaign.git_commit_of_checkout", lambda: "0123abc")
    notes = run_campaign(file, tmp_path / "out", resume=True).notes
    assert any("started with an installed ltsim, continued with commit 0123abc of ltsim" in note for note in notes)


def test_what_exceeds_the_memory_of_the_database_leaves_no_trace(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was written to `.tmp` in the working folder, and stayed there."""
    run_campaign(file, tmp_path / "out")
    temporary, here = tmp_path / "temporary", tmp_path / "here"
    temporary.mkdir()
    here.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    monkeypatch.chdir(here)
    statistics = CampaignStatistics(tmp_path / "out")
    statistics.query("SET memory_limit = '60MiB'")
    statistics.query("CREATE TABLE big AS SELECT range AS a, hash(range) AS b FROM range(6000000) ORDER BY b")
    assert [*temporary.rglob("*.tmp")]
    del statistics
    gc.collect()
    assert [*temporary.iterdir(), *here.iterdir()] == []
