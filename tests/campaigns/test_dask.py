"""The dask backend: a real scheduler and two worker processes, found by a cluster file, one of them killed midway."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from ltsim.campaigns import campaign
from ltsim.campaigns.campaign import WorkerSettings, run_campaign
from ltsim.core.errors import InputError

FILE = """
format = "ltsim-campaign/1"
seed = 8
trials = 6144
trials_per_shard = 512
verified_trials_per_shard = 1
"""


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*.parquet"))}


@contextmanager
def process(*arguments: str, folder: Path, root: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A command of dask, ended with the test."""
    code = f"import sys; sys.path.insert(0, {str(root)!r}); sys.argv = {['dask', *arguments]!r}\n"
    code += "from distributed.cli import dask_scheduler, dask_worker\n"
    code += f"(dask_scheduler if {arguments[0]!r} == 'scheduler' else dask_worker).main({list(arguments[1:])!r})"
    log = (folder / f"{arguments[0]}.log").open("ab")
    running = subprocess.Popen([sys.executable, "-c", code], cwd=folder, stdout=log, stderr=log)
    try:
        yield running
    finally:
        running.terminate()
        running.wait(timeout=30)
        log.close()


@pytest.mark.long
def test_killed_worker_changes_nothing(tmp_path: Path, root: Path) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    file = tmp_path / "many.toml"
    file.write_text(FILE)
    run_campaign(file, tmp_path / "one")
    cluster = tmp_path / "cluster.json"
    options = ("--scheduler-file", str(cluster), "--no-dashboard")
    scheduler = ("scheduler", "--host", "127.0.0.1", "--port", "0", *options)
    worker = ("worker", "--nworkers", "1", "--nthreads", "1", "--no-nanny", *options)
    settings = {"folder": tmp_path, "root": root}
    with process(*scheduler, **settings):
        deadline = time.monotonic() + 60
        while not cluster.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        with process(*worker, **settings) as doomed, process(*worker, **settings) as survivor:
            finished: list[int] = []

            def kill_worker(trials: int) -> None:
                finished.append(trials)
                if len(finished) == 3:
                    doomed.kill()

            workers = WorkerSettings(backend="dask", scheduler=str(cluster))
            outcome = run_campaign(file, tmp_path / "cluster", workers=workers, progress=kill_worker)
            assert doomed.wait(timeout=30) != 0
            assert survivor.poll() is None
    assert outcome.n_computed_shards == 12
    assert contents(tmp_path / "cluster") == contents(tmp_path / "one")


def test_workers_that_end_at_the_same_shard_are_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

    @contextmanager
    def client(**_: object) -> Iterator[None]:
        yield

    def ended(**_: object) -> object:
        raise distributed.KilledWorker("shard", None, 3)

    monkeypatch.setattr(distributed, "Client", client)
    monkeypatch.setattr(campaign, "parallel_config", lambda **_: nullcontext())
    monkeypatch.setattr(campaign, "Parallel", ended)
    file = tmp_path / "many.toml"
    file.write_text(FILE)
    with pytest.raises(
        InputError,
        match=r"several workers were killed at the same shard.*remain in the folder: continue with resume=True",
    ):
        run_campaign(file, tmp_path / "out", workers=WorkerSettings(backend="dask", scheduler="tcp://127.0.0.1:1"))


def test_scheduler_that_does_not_answer_is_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    file = tmp_path / "many.toml"
    file.write_text(FILE)
    with pytest.raises(InputError, match="backend=dask needs scheduler"):
        run_campaign(file, tmp_path / "out", workers=WorkerSettings(backend="dask"))
    with pytest.raises(InputError, match="no dask scheduler answers"):
        run_campaign(file, tmp_path / "out2", workers=WorkerSettings(backend="dask", scheduler="nonsense://x"))
