"""Work in several processes of this machine that end with the one that started them, however that ends."""

import os
import struct
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ltsim.core.arguments import check_bounds
from ltsim.core.errors import WorkerError, option

LOOK = 0.3
"""[s] between two looks how far the work is."""
WATCH = 1.0
"""[s] between two looks whether the parent is there."""
SAFE_PATH = "PYTHONSAFEPATH"
"""Variable of the environment that keeps Python from putting the working folder on its path."""
Result = TypeVar("Result")


def parallel(
    function: Callable[..., Result],
    calls: Iterable[tuple[Any, ...]],
    jobs: int,
    *,
    ordered: bool = True,
    batch: int = 1,
) -> Iterator[Result]:
    """Results of a function, call by call, from `jobs` processes; in this one where that is one.

    The function is one of a module: it travels by name. Results come in the order of the calls, or where they are not
    to be `ordered` as they are ready; `batch` calls travel together. Raises WorkerError when a process ends before its
    work, SetupError for fewer jobs than one.
    """
    check_bounds(jobs=jobs)
    if jobs == 1:
        yield from (function(*arguments) for arguments in calls)
        return
    from joblib import Parallel, delayed, parallel_config  # most runs need one process
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    how = "generator" if ordered else "generator_unordered"
    watching = {"initializer": _watch, "initargs": (os.getpid(),)}
    with parallel_config(backend="loky", inner_max_num_threads=1, **watching):
        pool = Parallel(n_jobs=jobs, return_as=how, batch_size=batch)
    with _safe_path():
        results = pool(delayed(function)(*arguments) for arguments in calls)
    try:
        with _safe_path():
            for result in results:  # noqa: UP028 - `yield from` would close `results`, with a warning
                yield result
    except TerminatedWorkerError:
        raise WorkerError(
            f"a worker process was ended from outside, perhaps for want of memory; take fewer {option('jobs')}"
        ) from None
    finally:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # joblib warns of results that a caller has no use for
            results.close()


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let processes begin without the working folder on their path: a `numpy.py` there would run in place of numpy."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[SAFE_PATH]
        else:
            os.environ[SAFE_PATH] = before


@dataclass(frozen=True)
class ProgressNotes:
    """Progress of pieces of work, each written by the process that does it."""

    path: Path
    """A file of shares."""

    def write(self, piece: int, share: float) -> None:
        """Note the share of a piece that is done."""
        with self.path.open("r+b") as file:
            file.seek(8 * piece)
            file.write(struct.pack("d", share))

    def mean(self) -> float:
        """Share of the whole."""
        shares = [share for (share,) in struct.iter_unpack("d", self.path.read_bytes())]
        return sum(shares) / max(len(shares), 1)


@contextmanager
def followed(count: int, tell: Callable[[float], None]) -> Iterator[ProgressNotes]:
    """Notes of so many pieces of work; `tell` hears the share of the whole now and then, from a thread of its own.

    What `tell` raises there is raised here, when the work is done.
    """
    done, problems = threading.Event(), []
    with tempfile.TemporaryDirectory() as folder:
        notes = ProgressNotes(Path(folder) / "shares")
        notes.path.write_bytes(bytes(8 * count))

        def look() -> None:
            try:
                while not done.wait(LOOK):
                    tell(notes.mean())
            except Exception as problem:
                problems.append(problem)

        thread = threading.Thread(target=look, daemon=True)
        thread.start()
        try:
            yield notes
        finally:
            done.set()
            thread.join()
        if problems:
            raise problems[0]
        tell(notes.mean())


def _watch(parent: int) -> None:
    """End this process as soon as its parent is gone, from its start on."""

    def look() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH)
        os._exit(1)

    threading.Thread(target=look, daemon=True).start()
