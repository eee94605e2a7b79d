"""What a trial costs on this machine's processes and on a dask cluster, with workers killed, and what 10^9 would cost.

    python -m benchmarks.cluster            # --trials N for other than 262144

A campaign of the paper's workshop is run three times into the same rows: by joblib's processes, by a scheduler and
workers of their own that are found through a cluster file, and by such workers of which one is killed midway and
replaced. Times
are of the processor, of all processes together, since a wall clock measures the neighbours too; both are printed.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from ltsim.campaigns.campaign import WorkerSettings, run_campaign

JOBS, SHARD, HUGE = 2, 8192, 10**9
FILE = """
format = "ltsim-campaign/1"
scenario = "paper-workshop"
trials = {trials}
trials_per_shard = {shard}
seed = 1
"""
TICK = os.sysconf("SC_CLK_TCK")


def processor_seconds(pid: int) -> float:
    """[s] of the processor that a process and its children took so far; 0 for one that is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    except OSError:
        return 0.0
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return sum(map(int, fields[11:13])) / TICK + sum(processor_seconds(int(child)) for child in children)


@contextmanager
def command(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process of dask that ends with the block."""
    code = f"import sys; sys.argv = {['dask', *words]!r}; from distributed.cli import dask_scheduler, dask_worker; "
    code += f"(dask_scheduler if {words[0]!r} == 'scheduler' else dask_worker).main({list(words[1:])!r})"
    quiet = subprocess.DEVNULL
    running = subprocess.Popen([sys.executable, "-c", code], stdout=quiet, stderr=quiet)
    try:
        yield running
    finally:
        running.terminate()
        running.wait(timeout=30)


def digest(folder: Path) -> str:
    """Of all rows."""
    whole = hashlib.sha256()
    for path in sorted(folder.glob("rows/*/*.parquet")):
        whole.update(path.read_bytes())
    return whole.hexdigest()[:12]


def measured(
    name: str, file: Path, out: Path, workers: WorkerSettings, trials: int, each: Callable[[], None] = lambda: None
) -> float:
    """Run a campaign and print what a trial took; give its seconds of the processor."""
    before, begun = processor_seconds(os.getpid()), time.perf_counter()
    run_campaign(file, out, workers=workers, progress=lambda _: each())
    wall, spent = time.perf_counter() - begun, processor_seconds(os.getpid()) - before
    size = sum(path.stat().st_size for path in out.glob("rows/*/*.parquet")) / trials
    print(
        f"| {name} | {1e6 * spent / trials:.0f} us | {1e6 * wall / trials:.0f} us | {size:.0f} | {digest(out)} |",
        flush=True,
    )
    return spent / trials


def on_cluster(folder: Path, file: Path, trials: int, *, kill: bool) -> None:
    """The same on a scheduler with workers; with `kill` one is killed after a quarter of the shards and replaced."""
    cluster = folder / f"cluster-{kill}.json"
    worker = (
        "worker",
        "--scheduler-file",
        str(cluster),
        "--nworkers",
        "1",
        "--nthreads",
        "1",
        "--no-dashboard",
        "--no-nanny",
    )
    with ExitStack() as stack:
        stack.enter_context(command("scheduler", "--scheduler-file", str(cluster), "--port", "0", "--no-dashboard"))
        while not cluster.exists():
            time.sleep(0.1)
        doomed, *_ = [stack.enter_context(command(*worker)) for _ in range(JOBS)]
        done = [0]

        def each() -> None:
            done[0] += 1
            if kill and done[0] == trials // SHARD // 4:
                doomed.kill()
                stack.enter_context(command(*worker))

        name = f"dask, {JOBS} workers" + (", one killed and replaced" if kill else "")
        out = folder / f"dask-{kill}"
        measured(name, file, out, WorkerSettings(backend="dask", scheduler=str(cluster)), trials, each)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=2**18)
    trials = parser.parse_args().trials
    with TemporaryDirectory() as place:
        folder = Path(place)
        file = folder / "campaign.toml"
        file.write_text(FILE.format(trials=trials, shard=SHARD))
        warm = folder / "warm.toml"
        warm.write_text(FILE.format(trials=256, shard=256))
        run_campaign(warm, folder / "warm")
        print(
            "| who works | processor a trial | wall a trial | bytes a trial | digest of the rows |\n" + "|---" * 5 + "|"
        )
        spent = measured(f"joblib, {JOBS} processes", file, folder / "local", WorkerSettings(JOBS), trials)
        on_cluster(folder, file, trials, kill=False)
        on_cluster(folder, file, trials, kill=True)
        size = sum(path.stat().st_size for path in (folder / "local").glob("rows/*/*.parquet")) / trials
    print(
        f"\n10^9 trials: {HUGE * spent / 3600:.0f} core hours, {HUGE * spent / 3600 / 64:.1f} h on 64 cores, "
        f"{HUGE * size / 1e9:.0f} GB of rows in {HUGE // 65536 + 1} shards of 65536"
    )


if __name__ == "__main__":
    main()
