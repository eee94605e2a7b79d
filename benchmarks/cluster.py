"""Cost of a trial in processes of one computer and on a dask cluster with killed workers; estimate for 10^9 trials.

    python -m benchmarks.cluster            # --trials N for a number of trials other than 262144

A campaign of the paper's workshop is run three times: by processes of joblib, by a dask scheduler with workers that
connect through a cluster file, and by such workers of which one is killed and replaced during the run. All three must
write the same rows. Times are processor times of all processes together, because the wall-clock time also depends on
other programs on the computer; both are printed.
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
    """Processor time [s] of a process and its children so far; 0 if the process has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    except OSError:
        return 0.0
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return sum(map(int, fields[11:13])) / TICK + sum(processor_seconds(int(child)) for child in children)


@contextmanager
def command(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Process of a dask command, which is terminated at the end of the `with` block."""
    code = f"import sys; sys.argv = {['dask', *arguments]!r}; from distributed.cli import dask_scheduler, dask_worker; "
    code += f"(dask_scheduler if {arguments[0]!r} == 'scheduler' else dask_worker).main({list(arguments[1:])!r})"
    quiet = subprocess.DEVNULL
    running = subprocess.Popen([sys.executable, "-c", code], stdout=quiet, stderr=quiet)
    try:
        yield running
    finally:
        running.terminate()
        running.wait(timeout=30)


def digest(folder: Path) -> str:
    """First 12 digits of the sha256 of all rows."""
    whole = hashlib.sha256()
    for path in sorted(folder.glob("rows/*/*.parquet")):
        whole.update(path.read_bytes())
    return whole.hexdigest()[:12]


def run_and_measure(
    name: str,
    file: Path,
    out: Path,
    workers: WorkerSettings,
    trials: int,
    after_shard: Callable[[], None] = lambda: None,
) -> float:
    """Processor time [s] per trial of a campaign; a table row is printed."""
    before, begun = processor_seconds(os.getpid()), time.perf_counter()
    run_campaign(file, out, workers=workers, progress=lambda _: after_shard())
    wall, spent = time.perf_counter() - begun, processor_seconds(os.getpid()) - before
    size = sum(path.stat().st_size for path in out.glob("rows/*/*.parquet")) / trials
    print(
        f"| {name} | {1e6 * spent / trials:.0f} us | {1e6 * wall / trials:.0f} us | {size:.0f} | {digest(out)} |",
        flush=True,
    )
    return spent / trials


def measure_on_cluster(folder: Path, file: Path, trials: int, *, kill: bool) -> None:
    """Run the campaign with a scheduler and workers.

    With `kill`, one worker is killed after a quarter of the shards, and replaced.
    """
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

        def after_shard() -> None:
            done[0] += 1
            if kill and done[0] == trials // SHARD // 4:
                doomed.kill()
                stack.enter_context(command(*worker))

        name = f"dask, {JOBS} workers" + (", one killed and replaced" if kill else "")
        out = folder / f"dask-{kill}"
        run_and_measure(name, file, out, WorkerSettings(backend="dask", scheduler=str(cluster)), trials, after_shard)


def main() -> None:
    """Run the campaigns, and print the table."""
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
            "| workers | processor time per trial | wall time per trial | bytes per trial | digest of the rows |\n"
            + "|---" * 5
            + "|"
        )
        spent = run_and_measure(f"joblib, {JOBS} processes", file, folder / "local", WorkerSettings(JOBS), trials)
        measure_on_cluster(folder, file, trials, kill=False)
        measure_on_cluster(folder, file, trials, kill=True)
        size = sum(path.stat().st_size for path in (folder / "local").glob("rows/*/*.parquet")) / trials
    print(
        f"\n10^9 trials: {HUGE * spent / 3600:.0f} core hours, {HUGE * spent / 3600 / 64:.1f} h on 64 cores, "
        f"{HUGE * size / 1e9:.0f} GB of rows in {HUGE // 65536 + 1} shards of 65536"
    )


if __name__ == "__main__":
    main()
