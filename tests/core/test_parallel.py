"""Processes that work for another end with it, and one that dies is a sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ltsim.core.errors import WorkerError
from ltsim.core.parallel import run_parallel

SLEEPERS = """
import os, sys, time
from pathlib import Path
from ltsim.core.parallel import run_parallel

def sleep(name):
    (Path(sys.argv[1]) / name).write_text(str(os.getpid()))
    time.sleep(300)

if __name__ == "__main__":
    list(run_parallel(sleep, [("a",), ("b",)], 2))
"""


def test_results_come_in_order_and_as_they_come() -> None:
    calls = [(k, 2) for k in range(20)]
    assert list(run_parallel(pow, calls, 1)) == [k * k for k in range(20)]
    assert list(run_parallel(pow, calls, 2)) == [k * k for k in range(20)]
    assert sorted(run_parallel(pow, calls, 2, keeps_order=False)) == [k * k for k in range(20)]


def test_workers_end_when_their_parent_is_killed(tmp_path: Path, root: Path) -> None:
    (tmp_path / "sleepers.py").write_text(SLEEPERS)
    there = tmp_path / "pids"
    there.mkdir()
    parent = subprocess.Popen([sys.executable, str(tmp_path / "sleepers.py"), str(there)], cwd=root, env=_path(root))
    try:
        assert _until(lambda: len(_pids(there)) == 2)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    assert _until(lambda: not any(map(_lives, _pids(there))))


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the processes of a process are not listed here")
def test_workers_end_when_their_parent_is_killed_while_they_start(tmp_path: Path, root: Path) -> None:
    (tmp_path / "sleepers.py").write_text(SLEEPERS)
    there = tmp_path / "pids"
    there.mkdir()
    parent = subprocess.Popen([sys.executable, str(tmp_path / "sleepers.py"), str(there)], cwd=root, env=_path(root))
    children: set[int] = set()

    def started() -> bool:
        for file in Path(f"/proc/{parent.pid}/task").glob("*/children"):
            children.update(map(int, file.read_text().split()))
        return len(children) > 2  # two that work, and one that keeps account of what they share

    try:
        assert _until(started)
    finally:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    assert _until(lambda: not any(map(_lives, children)))


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the processes of a process are not listed here")
def test_workers_that_ctrl_c_reaches_while_they_start_print_nothing(tmp_path: Path, root: Path) -> None:
    """A terminal sends it to all processes of a command; those that imported their modules printed a traceback."""
    code = SLEEPERS.replace("    list(", "    try:\n        list(") + "    except KeyboardInterrupt:\n        pass\n"
    (tmp_path / "sleepers.py").write_text(code)
    words = [sys.executable, str(tmp_path / "sleepers.py"), str(tmp_path)]
    with subprocess.Popen(
        words, cwd=root, env=_path(root), stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as parent:

        def workers() -> list[int]:
            files = Path(f"/proc/{parent.pid}/task").glob("*/children")
            children = [int(word) for file in files for word in file.read_text().split()]
            return [child for child in children if b"loky.backend.popen" in Path(f"/proc/{child}/cmdline").read_bytes()]

        assert _until(lambda: len(workers()) == 2)
        children = workers()
        for _ in range(20):  # whatever they are doing
            for child in children:
                os.kill(child, signal.SIGINT)
            time.sleep(0.02)
        os.killpg(parent.pid, signal.SIGINT)
        assert parent.communicate(timeout=120)[1] == ""
    assert parent.returncode == 0
    assert _until(lambda: not any(map(_lives, children)))


def test_a_worker_that_is_killed_is_a_sentence() -> None:
    with pytest.raises(WorkerError, match="was killed"):
        list(run_parallel(_die, [(1,), (2,)], 2))


def _die(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _path(root: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(root)}


def _pids(folder: Path) -> list[int]:
    return [int(p.read_text()) for p in folder.iterdir() if p.read_text()]


def _lives(pid: int) -> bool:
    """Whether a process works; one that has ended and waits to be collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _until(done: object, seconds: float = 120.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if done():  # type: ignore[operator]
            return True
        time.sleep(0.05)
    return False
