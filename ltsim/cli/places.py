"""Where a verb may write without --force.

A folder that is new, empty or ltsim's own; and there over nothing but what the verb wrote itself and nobody changed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltsim.errors import RecordError
from ltsim.notation import listing
from ltsim.recording.files import is_device

if TYPE_CHECKING:
    from ltsim.recording.result_file import ResultFile

Force = Annotated[bool, typer.Option("--force", help="Replace what is there, also what this command did not write.")]
GENERATOR = '<meta name="generator" content="ltsim'
"""How a page says that it can be made again."""
HEAD = 4096
OWN = re.compile(rf'"?format"? ?[:=] ?"ltsim-|{re.escape(GENERATOR)}')
"""What the beginning of a file says that ltsim wrote, or that a person wrote for it."""


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
    if folder is None or force:
        return
    taken = [name for name in (model.FILE, *names) if os.path.lexists(folder / name)]
    if taken and not _is_own(folder, model, taken, own):
        _refuse(folder, taken)
    _refuse_foreign(folder)


def _is_own(folder: Path, model: type[ResultFile], taken: list[str], own: Callable[[Any], bool]) -> bool:
    from ltsim.recording.result_file import read_result

    try:
        found = read_result(folder, model)
        written = bool(found.files or found.recording) and own(found)
        return written and all(found.owns(folder, name) for name in taken if name != model.FILE)
    except RecordError:
        return False


def claim_recording(folder: Path, *, force: bool) -> None:
    """Make sure that a recording replaces none and lies among nothing foreign; raises RecordError."""
    from ltsim.recording.native import OBSERVATIONS, SETUP

    taken = [name for name in (OBSERVATIONS, SETUP) if os.path.lexists(folder / name)]
    if force:
        return
    if taken:
        _refuse(folder, taken)
    _refuse_foreign(folder)


def claim_empty(folder: Path, *, force: bool) -> None:
    """Make sure that a folder for many results is new or empty; raises RecordError."""
    if folder.is_dir() and not force:
        taken = sorted(p.name for p in folder.iterdir())
        if taken:
            _refuse(folder, taken)


def claim_file(file: Path | None, *, force: bool) -> None:
    """Make sure that a file replaces none, but for a page that ltsim made; raises RecordError."""
    if file is None or force or not os.path.lexists(file) or is_device(file):
        return
    if file.is_file() and file.suffix == ".html":
        with file.open("rb") as stream:
            if GENERATOR.encode() in stream.read(HEAD):
                return
    raise RecordError("is there already; give another name, or replace it with --force", file=file)


def _refuse_foreign(folder: Path) -> None:
    """Raise RecordError where a folder holds files that no command of ltsim wrote; hidden ones and folders aside."""
    from ltsim.recording.native import OBSERVATIONS, SETUP

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
    from ltsim.recording.result_file import read_json

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
