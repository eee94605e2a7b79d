"""Output files and folders, checked before a verb begins: write permission, and files that would be replaced.

Without --force a command writes only to a folder that is new, empty or written by ltsim, and replaces only unmodified
files of the same command. An option or argument for an output has an `OutputPlace` in its annotation; `command_of`
applies its rule before it calls the command.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltsim.core.errors import RecordError, SetupError
from ltsim.core.notation import listing
from ltsim.core.storage import check_writable, complete_interrupted_moves, is_device, path_in_folder

if TYPE_CHECKING:
    from ltsim.recordings.result_file import ResultFile

Force = Annotated[
    bool, typer.Option("--force", help="Replace existing files, also those that this command did not write.")
]
GENERATOR = '<meta name="generator" content="ltsim'
"""Text by which a page written by ltsim is recognised."""
SEARCHED_BYTES = 4096
"""Bytes of a file that are searched for the mark of ltsim."""
LTSIM_FILE = re.compile(rf'"?format"? ?[:=] ?"ltsim-|{re.escape(GENERATOR)}')
"""Pattern at the beginning of a file of ltsim, written by it or for it."""


@dataclass(frozen=True)
class OutputPlace:
    """Annotation of an option or argument that names an output file or folder."""

    rule: Callable[[Path, bool], None]
    """Function (path, force) that raises RecordError if the output cannot be written or, without `force`, would replace
    another file."""


def check_outputs(outputs: Iterable[tuple[str, Path, OutputPlace]], *, force: bool) -> None:
    """Check of the outputs by their rules; raises RecordError, and SetupError for two options with the same path."""
    names: dict[str, str] = {}
    for name, path, output in outputs:
        output.rule(path, force)
        place = os.path.realpath(path)
        if place in names and not is_device(path):
            raise SetupError(f"{names[place]} and {name} both name {path}; choose different paths")
        names[place] = name
    for place, name in names.items():
        folder = str(Path(place).parent)
        if folder in names and Path(place).name in _names_of_results():
            raise SetupError(f"{name}: a result of {names[folder]} could overwrite {place}; choose another name")


def _names_of_results() -> set[str]:
    """Fixed names of result files; the name of a truth file is an option."""
    from ltsim.recordings.native import OBSERVATIONS_FILE
    from ltsim.reports.schemas import FILES, TABLES

    truth = "truth.json"
    tables = {table.file for file, companions in TABLES.items() if file != truth for table in companions}
    return {OBSERVATIONS_FILE, *FILES, *tables} - {truth}


def check_overwrite(
    folder: Path | None,
    model: type[ResultFile],
    names: Iterable[str] = (),
    *,
    force: bool,
    same_verb: Callable[[Any], bool] = lambda result: True,
) -> None:
    """Check that a result and its companion files replace only an older result of the same command; raises RecordError.

    The folder (None for no output) must be new, empty or contain only folders and files written by ltsim; `force`
    permits any content. `same_verb` tells whether an existing result is from this command, if several commands write
    the same file.
    """
    if folder is None:
        return
    taken = _taken(folder, (model.FILE, *names))
    if force:
        return
    if taken and not _is_replaceable(folder, model, taken, same_verb):
        _refuse(folder, taken)
    _refuse_foreign(folder)


def _is_replaceable(folder: Path, model: type[ResultFile], taken: list[str], same_verb: Callable[[Any], bool]) -> bool:
    from ltsim.recordings.result_file import read_result

    try:
        result = read_result(folder, model)
        written = bool(result.files or result.recording) and same_verb(result)
        return written and all(result.is_ltsim_file(folder, name) for name in taken if name != model.FILE)
    except RecordError:
        return False


def _taken(folder: Path, names: Iterable[str]) -> list[str]:
    """Names of existing files; raises RecordError if one cannot be written.

    Interrupted writes of a killed process are completed and not counted, since they were never reported.
    """
    check_writable(folder, folder=True)
    finished = complete_interrupted_moves(folder) if folder.is_dir() else set()
    for name in names:
        path_in_folder(folder, name)
    return [name for name in names if os.path.lexists(folder / name) and name not in finished]


def check_recording(folder: Path, force: bool) -> None:
    """Check that a recording neither replaces another one nor is written among other files; raises RecordError."""
    from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE

    taken = _taken(folder, (OBSERVATIONS_FILE, SETUP_FILE))
    if force:
        return
    if taken:
        _refuse(folder, taken)
    _refuse_foreign(folder)


def check_empty(folder: Path, force: bool) -> None:
    """Check that the folder is new or empty; raises RecordError."""
    check_writable(folder, folder=True)
    if folder.is_dir() and not force:
        taken = sorted(p.name for p in folder.iterdir())
        if taken:
            _refuse(folder, taken)


def check_file(file: Path, force: bool) -> None:
    """Check that a file does not exist, except for a page written by ltsim; raises RecordError."""
    check_writable(file, folder=False)
    if force or not os.path.lexists(file) or is_device(file):
        return
    if file.is_file() and file.suffix == ".html":
        with file.open("rb") as stream:
            if GENERATOR.encode() in stream.read(SEARCHED_BYTES):
                return
    raise RecordError("exists already; choose another name, or replace it with --force", file=file)


def _refuse_foreign(folder: Path) -> None:
    """Check that a folder contains only files written by ltsim (hidden files and folders are ignored).

    Raises RecordError.
    """
    from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE

    files = [p for p in folder.iterdir() if not (p.name.startswith(".") or p.is_dir())] if folder.is_dir() else []
    written = {OBSERVATIONS_FILE, SETUP_FILE}.union(*map(_answered_for, files))
    foreign = sorted({p.name for p in files} - written)
    if foreign:
        raise RecordError(
            f"the folder contains {listing(foreign, 3)}, which ltsim did not create; "
            "choose another folder, or use --force",
            file=folder,
        )


def _answered_for(file: Path) -> set[str]:
    """Names of a file of ltsim and of the companion files that it lists; empty for another file."""
    from ltsim.recordings.result_file import read_json

    try:
        with file.open("rb") as stream:
            if not LTSIM_FILE.search(stream.read(SEARCHED_BYTES).decode("latin-1")):
                return set()
        companions = read_json(file, "result").get("files") if file.suffix == ".json" else None
    except (OSError, RecordError):
        return set()
    return {file.name, *(companions if isinstance(companions, dict) else ())}


def _refuse(folder: Path, taken: list[str]) -> None:
    raise RecordError(
        f"the folder contains {listing(taken, 3)}, which this command did not write or which was changed since; "
        "choose another folder, or use --force",
        file=folder,
    )


FILE = OutputPlace(check_file)
RECORDING = OutputPlace(check_recording)
EMPTY = OutputPlace(check_empty)
FOLDER = OutputPlace(lambda folder, force: check_writable(folder, folder=True))
"""Output folder whose command checks the files that it replaces."""
ANYWHERE = OutputPlace(lambda path, force: check_writable(path, folder=path.is_dir()))
"""Output file or folder, depending on other options."""
