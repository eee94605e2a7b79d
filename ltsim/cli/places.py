"""Where a verb may write: it replaces what it wrote itself and nobody changed since, anything else with --force."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltsim.errors import RecordError
from ltsim.recording.files import is_device

if TYPE_CHECKING:
    from ltsim.recording.result_file import ResultFile

Force = Annotated[bool, typer.Option("--force", help="Replace what is there, also what this command did not write.")]
GENERATOR = '<meta name="generator" content="ltsim'
"""How a page says that it can be made again."""
HEAD = 4096


def claim(
    folder: Path | None,
    model: type[ResultFile],
    names: Iterable[str] = (),
    *,
    force: bool,
    own: Callable[[Any], bool] = lambda found: True,
) -> None:
    """Make sure that a result and the files beside it replace nothing but an older result of the same verb.

    Parameters
    ----------
    folder : Path or None
        None where nothing is to be written.
    model : type of ResultFile
    names : iterable of str
        Of the files beside the result.
    force : bool
        Replace whatever is there.
    own : callable
        Whether a result that is there comes from this verb, where several verbs write the same file.

    Raises
    ------
    RecordError
    """
    if folder is None or force:
        return
    taken = [name for name in (model.FILE, *names) if os.path.lexists(folder / name)]
    if taken and not _is_own(folder, model, taken, own):
        _refuse(folder, taken)


def _is_own(folder: Path, model: type[ResultFile], taken: list[str], own: Callable[[Any], bool]) -> bool:
    from ltsim.recording.result_file import read_result

    try:
        found = read_result(folder, model)
        written = bool(found.files or found.recording) and own(found)
        return written and all(found.owns(folder, name) for name in taken if name != model.FILE)
    except RecordError:
        return False


def claim_recording(folder: Path, *, force: bool) -> None:
    """Make sure that a recording replaces none; raises RecordError."""
    from ltsim.recording.native import OBSERVATIONS, SETUP

    taken = [name for name in (OBSERVATIONS, SETUP) if os.path.lexists(folder / name)]
    if taken and not force:
        _refuse(folder, taken)


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


def _refuse(folder: Path, taken: list[str]) -> None:
    listed = ", ".join(taken[:3]) + (f" and {len(taken) - 3} more" if len(taken) > 3 else "")
    raise RecordError(
        f"holds {listed}, which this command did not write or which was changed since; "
        "name another place, or replace them with --force",
        file=folder,
    )
