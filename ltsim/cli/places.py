"""Places that a verb writes to, checked before it begins: whether they can be written, and what they would replace.

Without --force a verb writes to a folder that is new, empty or ltsim's own, and there over nothing but what the verb
wrote itself and nobody changed. An option or argument that names such a place has an `OutputPlace` in its annotation;
`command_of` applies its rule before it calls the verb.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltsim.core.errors import RecordError, SetupError
from ltsim.core.notation import listing
from ltsim.core.storage import is_device, place_in, settle

if TYPE_CHECKING:
    from ltsim.recordings.result_file import ResultFile

Force = Annotated[bool, typer.Option("--force", help="Replace what is there, also what this command did not write.")]
GENERATOR = '<meta name="generator" content="ltsim'
"""Mark of a page that can be made again."""
HEAD = 4096
OWN = re.compile(rf'"?format"? ?[:=] ?"ltsim-|{re.escape(GENERATOR)}')
"""Mark at the beginning of a file that ltsim wrote, or that a person wrote for it."""


@dataclass(frozen=True)
class OutputPlace:
    """Mark of an option or argument that names a place to write to."""

    rule: Callable[[Path, bool], None]
    """Raises RecordError where the place cannot be written, or, without `force`, would replace something else."""


def check_outputs(outputs: Iterable[tuple[str, Path, OutputPlace]], *, force: bool) -> None:
    """Apply the rules of options, by name; raises RecordError, and SetupError for two that name the same place."""
    names: dict[str, str] = {}
    for name, path, output in outputs:
        output.rule(path, force)
        place = os.path.realpath(path)
        if place in names and not is_device(path):
            raise SetupError(f"{names[place]} and {name} both name {path}; each needs a place of its own")
        names[place] = name
    for place, name in names.items():
        folder = str(Path(place).parent)
        if folder in names and Path(place).name in _names_of_results():
            raise SetupError(f"{name} names {place}, which {names[folder]} may write; give another name")


def _names_of_results() -> set[str]:
    """Names that verbs give to files of their own choice; a truth is named by its option."""
    from ltsim.recordings.native import OBSERVATIONS
    from ltsim.reports.schemas import FILES, TABLES

    truth = "truth.json"
    tables = {table.file for file, beside in TABLES.items() if file != truth for table in beside}
    return {OBSERVATIONS, *FILES, *tables} - {truth}


def check_writable(path: Path, *, folder: bool) -> None:
    """Raise RecordError where no file, or no `folder`, can be written at a path; folders above it may be missing."""
    try:
        if path.is_dir() != folder and path.exists():
            wrong = "this is a file, expected a folder" if folder else "this is a folder, expected a file"
            raise RecordError(f"{wrong} to write to", file=path)
        if is_device(path):
            if not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return
        above = path if folder else path.parent
        while not os.path.lexists(above):
            above = above.parent
        with suppress(FileNotFoundError):
            os.lstat(path)
        for part in path.parts:  # a name may be too long for the file system
            with suppress(FileNotFoundError):
                os.lstat(above / part)
        TemporaryFile(dir=above).close()
    except OSError as problem:
        raise RecordError(f"cannot be written ({problem.strerror})", file=path) from None
    if not folder:
        place_in(path.parent, path.name)


def claim(
    folder: Path | None,
    model: type[ResultFile],
    names: Iterable[str] = (),
    *,
    force: bool,
    own: Callable[[Any], bool] = lambda found: True,
) -> None:
    """Make sure that a result and the files beside it replace nothing but an older result of the same verb.

    The folder (None where nothing is to be written) is new, empty or holds what commands of ltsim wrote, and folders;
    `force` replaces whatever is there. `own` says whether a result that is there comes from this verb, where several
    verbs write the same file. Raises RecordError.
    """
    if folder is None:
        return
    taken = _taken(folder, (model.FILE, *names))
    if force:
        return
    if taken and not _is_own(folder, model, taken, own):
        _refuse(folder, taken)
    _refuse_foreign(folder)


def _is_own(folder: Path, model: type[ResultFile], taken: list[str], own: Callable[[Any], bool]) -> bool:
    from ltsim.recordings.result_file import read_result

    try:
        found = read_result(folder, model)
        written = bool(found.files or found.recording) and own(found)
        return written and all(found.owns(folder, name) for name in taken if name != model.FILE)
    except RecordError:
        return False


def _taken(folder: Path, names: Iterable[str]) -> list[str]:
    """Names in a folder that are there already; raises RecordError where one cannot be written.

    What a killed process had begun to write is finished, and counts for nothing: nobody was told of it.
    """
    check_writable(folder, folder=True)
    finished = settle(folder) if folder.is_dir() else set()
    for name in names:
        place_in(folder, name)
    return [name for name in names if os.path.lexists(folder / name) and name not in finished]


def claim_recording(folder: Path, force: bool) -> None:
    """Make sure that a recording replaces none and lies among nothing foreign; raises RecordError."""
    from ltsim.recordings.native import OBSERVATIONS, SETUP

    taken = _taken(folder, (OBSERVATIONS, SETUP))
    if force:
        return
    if taken:
        _refuse(folder, taken)
    _refuse_foreign(folder)


def claim_empty(folder: Path, force: bool) -> None:
    """Make sure that a folder for many results is new or empty; raises RecordError."""
    check_writable(folder, folder=True)
    if folder.is_dir() and not force:
        taken = sorted(p.name for p in folder.iterdir())
        if taken:
            _refuse(folder, taken)


def claim_file(file: Path, force: bool) -> None:
    """Make sure that a file replaces none, but for a page that ltsim made; raises RecordError."""
    check_writable(file, folder=False)
    if force or not os.path.lexists(file) or is_device(file):
        return
    if file.is_file() and file.suffix == ".html":
        with file.open("rb") as stream:
            if GENERATOR.encode() in stream.read(HEAD):
                return
    raise RecordError("is there already; give another name, or replace it with --force", file=file)


def _refuse_foreign(folder: Path) -> None:
    """Raise RecordError where a folder holds files that no command of ltsim wrote; hidden ones and folders aside."""
    from ltsim.recordings.native import OBSERVATIONS, SETUP

    files = [p for p in folder.iterdir() if not (p.name.startswith(".") or p.is_dir())] if folder.is_dir() else []
    own = {OBSERVATIONS, SETUP}.union(*map(_answered_for, files))
    foreign = sorted({p.name for p in files} - own)
    if foreign:
        raise RecordError(
            f"holds {listing(foreign, 3)}, which ltsim did not write: it is somebody's own folder; "
            "name another place, or write into it with --force",
            file=folder,
        )


def _answered_for(file: Path) -> set[str]:
    """A file that says it is ltsim's, with those that it says were written beside it."""
    from ltsim.recordings.result_file import read_json

    try:
        with file.open("rb") as stream:
            if not OWN.search(stream.read(HEAD).decode("latin-1")):
                return set()
        beside = read_json(file, "result").get("files") if file.suffix == ".json" else None
    except (OSError, RecordError):
        return set()
    return {file.name, *(beside if isinstance(beside, dict) else ())}


def _refuse(folder: Path, taken: list[str]) -> None:
    raise RecordError(
        f"holds {listing(taken, 3)}, which this command did not write or which was changed since; "
        "name another place, or replace them with --force",
        file=folder,
    )


FILE, RECORDING, EMPTY = OutputPlace(claim_file), OutputPlace(claim_recording), OutputPlace(claim_empty)
FOLDER = OutputPlace(lambda folder, force: check_writable(folder, folder=True))
"""A folder whose verb knows which files it replaces there, and claims them."""
ANYWHERE = OutputPlace(lambda path, force: check_writable(path, folder=path.is_dir()))
"""A file or a folder, as other options say."""
