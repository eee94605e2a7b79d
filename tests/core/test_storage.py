"""Files are whole or not there, whenever the process that writes them is killed; their permissions are the user's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ltsim.cli.main import run
from ltsim.core import storage
from ltsim.core.errors import RecordError
from ltsim.core.storage import check_writable, complete_interrupted_moves, path_in_folder, write_files
from ltsim.recordings.files import write_texts

KILLED = """
import os, signal, sys
from pathlib import Path
from ltsim.core import storage

count, real = int(sys.argv[2]), {call: getattr(os, call) for call in ("fsync", "replace", "open", "unlink")}

def killing(call):
    def step(*arguments, **options):
        global count
        count -= 1
        if not count:
            os.kill(os.getpid(), signal.SIGKILL)
        return real[call](*arguments, **options)
    return step

for call in real:
    setattr(storage.os, call, killing(call))
contents = {"a.csv": b"new a", "sub/b.csv": b"new b", "c.json": b"new c"}
storage.write_files(Path(sys.argv[1]), contents, flush_to_disk=True)
real["open"](sys.argv[1] + "-done", os.O_CREAT)
"""
"""A process that ends itself at one of the calls with which it writes."""
OLD = {"a.csv": b"old a", "sub/b.csv": b"old b", "c.json": b"old c"}
NEW = {name: content.replace(b"old", b"new") for name, content in OLD.items()}


def contents(folder: Path) -> dict[str, bytes]:
    """What a folder holds, hidden files too."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("before", [{}, OLD], ids=["new", "replaced"])
def test_killed_at_any_call_all_files_are_old_or_new(before: dict[str, bytes], tmp_path: Path, root: Path) -> None:
    outcomes = []
    for count in range(1, 40):
        folder = tmp_path / f"out{count}"
        folder.mkdir()
        write_files(folder, before)
        command = [sys.executable, "-c", KILLED, str(folder), str(count)]
        subprocess.run(command, cwd=root, check=False)
        complete_interrupted_moves(folder)
        assert contents(folder) in (before, NEW)
        outcomes.append(contents(folder) == NEW)
        if Path(f"{folder}-done").exists():
            break
    assert outcomes == sorted(outcomes)
    assert {False, True} == {*outcomes}


@pytest.fixture(params=[0o022, 0o027, 0o077, 0o002])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_permissions_are_those_of_the_umask(umask: int, tmp_path: Path) -> None:
    out = tmp_path / "made" / "rec"
    truth = str(tmp_path / "truth.json")
    assert run(["simulate", "paper-workshop", "--out", str(out), "--truth", truth, "-q"]) == 0
    assert run(["adjust", str(out), "--out", str(tmp_path / "net"), "-q"]) == 0
    for path in tmp_path.rglob("*"):
        assert path.stat().st_mode & 0o777 == (0o777 if path.is_dir() else 0o666) & ~umask


def test_a_link_inside_the_folder_stays_and_a_link_out_of_it_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "real.txt").write_text("old")
    (folder / "link.txt").symlink_to("real.txt")
    write_texts(folder, {"link.txt": "new"})
    assert (folder / "link.txt").is_symlink() and (folder / "real.txt").read_text() == "new"
    (tmp_path / "elsewhere").mkdir()
    (folder / "sub").symlink_to("../elsewhere")
    (folder / "away").symlink_to("../mine")
    for name in ("sub/x", "away"):
        with pytest.raises(RecordError, match="is a link out of the folder"):
            write_texts(folder, {"real.txt": "newer", name: "x"})
    assert (folder / "real.txt").read_text() == "new"
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["away", "elsewhere", "link.txt", "out", "real.txt", "sub"]
    (tmp_path / "named").symlink_to(folder)
    assert path_in_folder(tmp_path / "named", "real.txt") == folder / "real.txt"


def test_a_note_of_somebody_else_moves_nothing_out_of_or_into_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (tmp_path / ".ltsim-1-00000000-00000000.tmp").write_text("outside")
    (folder / "mine").write_text("mine")
    for moves in (
        '{"../.ltsim-1-00000000-00000000.tmp": "taken"}',
        '{"mine": "moved"}',
        '{"mine": 3}',
        "[1]",
        "{",
        "\xff",
        "[" * 100_000,
    ):
        note = folder / ".ltsim-999999999-00000000-00000000.moves"
        note.write_text(moves, encoding="latin-1")
        complete_interrupted_moves(folder)
        assert contents(folder) == {"mine": b"mine"}
    assert (tmp_path / ".ltsim-1-00000000-00000000.tmp").exists()


def test_nothing_behind_a_link_is_removed_or_written(tmp_path: Path) -> None:
    """What a killed process left in another folder stays; a device or a pipe there is no place to write to."""
    folder, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    temporary, note = ".ltsim-999999999-00000000-00000000.tmp", ".ltsim-999999999-00000000-00000000.moves"
    (elsewhere / temporary).write_text("theirs")
    (elsewhere / "note").write_text(json.dumps({temporary: "taken"}))
    (folder / "sub").symlink_to(elsewhere)
    (folder / note).symlink_to(elsewhere / "note")
    os.mkfifo(elsewhere / "pipe")
    (folder / "pipe").symlink_to(elsewhere / "pipe")
    reader = os.open(elsewhere / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_files(folder, {"mine": b"whole"})
    with pytest.raises(RecordError, match="is a link out of the folder"):
        write_files(folder, {"pipe": b"through"})
    with pytest.raises(RecordError, match="is a link out of the folder"):
        check_writable(folder / "pipe", is_folder=False)
    assert os.read(reader, 100) == b""
    os.close(reader)
    assert sorted(p.name for p in elsewhere.iterdir()) == [temporary, "note", "pipe"]


def test_a_pipe_or_device_is_neither_read_nor_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="pipe or a device"):
            storage.open_for_reading(path)
    with pytest.raises(RecordError, match="is a pipe or device"):
        storage.write_files(tmp_path, {"pipe": b""})
    with pytest.raises(OSError, match="no process reads from this pipe"):
        storage.write_to_device(tmp_path / "pipe", b"text")


def test_another_name_of_a_file_is_not_appended_to(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine\n")
    (tmp_path / "folder").mkdir()
    os.link(tmp_path / "mine", tmp_path / "folder" / "lines")
    for _ in range(2):
        storage.append_text(tmp_path / "folder", "lines", "more\n")
    assert (tmp_path / "mine").read_text() == "mine\n"
    assert (tmp_path / "folder" / "lines").read_text() == "mine\nmore\nmore\n"
    os.link(tmp_path / "mine", tmp_path / "folder" / "lock")
    with pytest.raises(RecordError, match="hard link"):
        storage.require_no_link(tmp_path / "folder", "lock")


def test_files_that_another_process_writes_are_not_removed(tmp_path: Path) -> None:
    theirs = tmp_path / f".ltsim-{os.getppid()}-00000000-00000000.tmp"
    theirs.write_text("half")
    write_files(tmp_path, {"mine": b"whole"})
    assert theirs.exists()
