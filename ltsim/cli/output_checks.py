"""Checks of output files and folders before a command begins: write permission, and files that would be replaced.

Without --force a command writes only to a folder that is new, empty or written by ltsim, and replaces only unmodified
files of the same command. An existing recording, or a file that ltsim did not write, is never replaced by other
content. It stays unchanged if it already has the content to be written (`write_outputs`).

An option or argument that names an output has an `OutputKind` in its annotation; `typer_command` calls the check of
this `OutputKind` before the command.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, NoReturn

import typer

from ltsim.core.errors import InputError, RecordError
from ltsim.core.notation import names_text
from ltsim.core.storage import (
    check_writable,
    complete_interrupted_moves,
    is_device_or_pipe,
    is_unmodified_since_written,
    open_for_reading,
    path_in_folder,
    read_whole_file,
)

if TYPE_CHECKING:
    from ltsim.recordings.result_file import ResultFile

ForceOption = Annotated[
    bool, typer.Option("--force", help="Replace existing files, also those that this command did not write.")
]
PAGE_GENERATOR_TAG = '<meta name="generator" content="ltsim'
"""HTML text by which a page written by ltsim is recognised."""
N_BYTES_SEARCHED_FOR_FORMAT = 4096
"""Number of bytes at the beginning of a file that are searched for the text that identifies files of ltsim."""
LTSIM_FILE_PATTERN = re.compile(rf'"?format"? ?[:=] ?"ltsim-|{re.escape(PAGE_GENERATOR_TAG)}')
"""Regular expression for the beginning of a file in a format of ltsim, written by a command or by a user."""


@dataclass(frozen=True)
class OutputKind:
    """Kind of output file or folder, in the annotation of an option or argument, with the check before writing."""

    check: Callable[[Path, bool], None]
    """Function of a path and of `force`. It raises RecordError if the output cannot be written or, without `force`,
    would replace another file."""


def check_outputs(outputs: Iterable[tuple[str, Path, OutputKind]], *, force: bool) -> None:
    """Check of the outputs of a command, each given by its option, path and `OutputKind`.

    Raises RecordError if a check fails, and InputError if two options have the same path.
    """
    option_by_path: dict[str, str] = {}
    for name, path, output in outputs:
        output.check(path, force)
        real_path = os.path.realpath(path)
        if real_path in option_by_path and not is_device_or_pipe(path):
            raise InputError(f"{option_by_path[real_path]} and {name} both name {path}; choose different paths")
        option_by_path[real_path] = name
    for real_path, name in option_by_path.items():
        folder = str(Path(real_path).parent)
        if folder in option_by_path and Path(real_path).name in _result_file_names():
            raise InputError(
                f"{name}: a result of {option_by_path[folder]} could overwrite {real_path}; choose another name"
            )


def _result_file_names() -> set[str]:
    """Names of all result files with a fixed name, and of their tables; a file of true values has no fixed name."""
    from ltsim.recordings.native import OBSERVATIONS_FILE
    from ltsim.reports.schemas import COMPANION_TABLES_BY_RESULT_FILE, MODEL_BY_FILE_NAME

    truth = "truth.json"
    tables = {
        table.file
        for file, companions in COMPANION_TABLES_BY_RESULT_FILE.items()
        if file != truth
        for table in companions
    }
    return {OBSERVATIONS_FILE, *MODEL_BY_FILE_NAME, *tables} - {truth}


def check_overwrite(
    folder: Path | None,
    model: type[ResultFile],
    *,
    force: bool,
    is_of_same_command: Callable[[Any], bool] = lambda result: True,
) -> None:
    """Check that a result and its companion files replace only an older result of the same command.

    Raises RecordError. `model` is the class of the result. The folder (None for no output) must be new, empty or
    contain only folders and files written by ltsim; `force` permits any content.
    If several commands write the same file, `is_of_same_command` returns True for an existing result of this command.
    """
    if folder is None:
        return
    existing_names = _existing_file_names(folder, (model.FILE, *model.companion_file_names()))
    if force:
        return
    if existing_names:
        _check_replaceable(folder, model, existing_names, is_of_same_command)
    _check_no_foreign_files(folder)


def _check_replaceable(
    folder: Path, model: type[ResultFile], existing_names: list[str], is_of_same_command: Callable[[Any], bool]
) -> None:
    """Check that this command wrote all existing files and that none of them has been changed since.

    Raises RecordError, which names only the files that must not be replaced, and the reason.
    """
    from ltsim.recordings.result_file import read_result

    if model.FILE not in existing_names:
        _raise_occupied_folder(folder, existing_names, "which this command did not write")
    try:
        result = read_result(folder, model)
    except RecordError as problem:
        _raise_occupied_folder(folder, [model.FILE], f"which is not a valid result of this command ({problem})")
    if not (result.files or result.recording) or not is_of_same_command(result):
        _raise_occupied_folder(folder, [model.FILE], "which this command did not write")
    companion_names = [name for name in existing_names if name != model.FILE]
    if foreign_names := [name for name in companion_names if name not in result.files]:
        _raise_occupied_folder(folder, foreign_names, "which this command did not write")
    if changed_names := [name for name in companion_names if not _is_unchanged_companion(result, folder, name)]:
        verb, them = ("was", "it") if len(changed_names) == 1 else ("were", "them")
        _raise_occupied_folder(folder, changed_names, f"which {verb} changed after this command wrote {them}")


def _is_unchanged_companion(result: ResultFile, folder: Path, name: str) -> bool:
    """True if the companion file `name` of a result in `folder` is readable and has not been changed."""
    try:
        return result.is_unchanged_companion(folder, name)
    except RecordError:
        return False


def _existing_file_names(folder: Path, names: Iterable[str]) -> list[str]:
    """Names of the existing files among `names` in a folder; raises RecordError if one of these files is not writable.

    Interrupted writes of a killed process are completed and not counted, since they were never reported.
    """
    check_writable(folder, is_folder=True)
    finished_moves = complete_interrupted_moves(folder) if folder.is_dir() else set()
    for name in names:
        path_in_folder(folder, name)
    return [name for name in names if os.path.lexists(folder / name) and name not in finished_moves]


def check_recording_folder(folder: Path, force: bool) -> None:
    """Check that a new recording neither replaces another one nor is written among files of other programs.

    Raises RecordError.
    """
    from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE

    existing_names = _existing_file_names(folder, (OBSERVATIONS_FILE, SETUP_FILE))
    if force:
        return
    if len(existing_names) == 1:
        _raise_occupied_folder(folder, existing_names, "which is only a part of a recording")
    _check_no_foreign_files(folder)


def write_outputs(outputs: Mapping[Path, Callable[[Path], Any]], *, force: bool) -> list[Any]:
    """Return values of the functions in `outputs`; each function writes a recording or file to its path.

    An existing recording or file stays if it has the same content, and is replaced only with `force`. If an existing
    one has other content, nothing is written and RecordError is raised.
    """
    same_contents = {} if force else {path: _unchanged_output(path, write) for path, write in outputs.items()}
    return [
        write(path) if (same := same_contents.get(path)) is None else same.returned_value
        for path, write in outputs.items()
    ]


class _UnchangedOutput(NamedTuple):
    """Marker for an output that exists already with the content to be written, so that it is not written again."""

    returned_value: Any
    """Return value of the function that would have written the output."""


def _unchanged_output(path: Path, write: Callable[[Path], Any]) -> _UnchangedOutput | None:
    """Marker, with the return value of `write`, that the output exists with the same content; None for a new output.

    Raises RecordError if the output exists with other content.
    """
    if not os.path.lexists(path) or is_device_or_pipe(path):
        return None
    with TemporaryDirectory() as temporary_folder:
        copy = Path(temporary_folder) / path.name
        try:
            returned_value = write(copy)
        except RecordError as problem:
            raise RecordError(str(problem).replace(str(copy), str(path))) from None
        written = sorted(p.relative_to(copy) for p in (copy.rglob("*") if copy.is_dir() else [copy]) if p.is_file())
        existing = [name for name in written if os.path.lexists(path / name)]
        if not existing:
            return None
        try:
            if existing == written and all(read_whole_file(path / p) == read_whole_file(copy / p) for p in written):
                return _UnchangedOutput(returned_value)
        except OSError as problem:
            raise RecordError(f"the file cannot be read ({problem.strerror})", file=problem.filename) from None
    if path.is_file():
        raise RecordError(
            "the output exists with another content; choose another name, or replace it with --force", file=path
        )
    names = names_text([str(name) for name in existing], 3)
    raise RecordError(
        f"the folder contains {names} with another content; choose another folder, or replace them with --force",
        file=path,
    )


def check_empty_folder(folder: Path, force: bool) -> None:
    """Check that a folder is new or empty, or that `force` is given; raises RecordError."""
    check_writable(folder, is_folder=True)
    if folder.is_dir() and not force:
        existing_names = sorted(p.name for p in folder.iterdir())
        if existing_names:
            _raise_occupied_folder(folder, existing_names, "expected a new or empty folder")


def check_new_file(file: Path, force: bool) -> None:
    """Check that a file does not exist yet; a page or an unmodified XML file written by ltsim may exist.

    Raises RecordError.
    """
    check_writable(file, is_folder=False)
    if force or not os.path.lexists(file) or is_device_or_pipe(file):
        return
    if file.is_file() and is_unmodified_since_written(file):
        return
    if file.is_file() and file.suffix == ".html":
        with open_for_reading(file) as stream:
            if PAGE_GENERATOR_TAG.encode() in stream.read(N_BYTES_SEARCHED_FOR_FORMAT):
                return
    raise RecordError("the file exists already; choose another name, or replace it with --force", file=file)


def check_file_for_comparison(file: Path, force: bool) -> None:
    """Check that a file can be written and is not a broken link; raises RecordError.

    `write_outputs` compares its content later.
    """
    check_writable(file, is_folder=False)
    if os.path.lexists(file) and not file.exists() and not force:
        raise RecordError(
            "the path is a link that leads nowhere; choose another name, or replace it with --force", file=file
        )


def _check_no_foreign_files(folder: Path) -> None:
    """Check that a folder contains only files written by ltsim (hidden files and folders are ignored).

    Raises RecordError.
    """
    from ltsim.recordings.native import OBSERVATIONS_FILE, SETUP_FILE

    files = [p for p in folder.iterdir() if not (p.name.startswith(".") or p.is_dir())] if folder.is_dir() else []
    output_names = {OBSERVATIONS_FILE, SETUP_FILE}.union(*map(_result_and_companion_names, files))
    foreign = sorted({p.name for p in files} - output_names)
    if foreign:
        raise RecordError(
            f"the folder contains {names_text(foreign, 3)}, which ltsim did not create; "
            "choose another folder, or use --force",
            file=folder,
        )


def _result_and_companion_names(file: Path) -> set[str]:
    """Name of a result file of ltsim, and names of the companion files that it lists; empty for any other file."""
    from ltsim.recordings.result_file import read_json

    try:
        with open_for_reading(file) as stream:
            if not LTSIM_FILE_PATTERN.search(stream.read(N_BYTES_SEARCHED_FOR_FORMAT).decode("latin-1")):
                return set()
        companions = read_json(file, "result").get("files") if file.suffix == ".json" else None
    except (OSError, RecordError):
        return set()
    return {file.name, *(companions if isinstance(companions, dict) else ())}


def _raise_occupied_folder(folder: Path, existing_names: list[str], reason: str) -> NoReturn:
    """RecordError on files in a folder that a command must not replace; `reason` is a clause on these files."""
    raise RecordError(
        f"the folder contains {names_text(existing_names, 3)}, {reason}; choose another folder, or replace the files "
        "with --force",
        file=folder,
    )


COMPARED_FILE_OUTPUT = OutputKind(check_file_for_comparison)
"""Kind of output file whose content `write_outputs` compares with an existing file."""
NEW_FILE_OUTPUT = OutputKind(check_new_file)
"""Kind of output file that must be new, or replace a page or an unmodified XML file of ltsim."""
RECORDING_OUTPUT = OutputKind(check_recording_folder)
"""Kind of output folder for a recording, which must not contain files of other programs."""
EMPTY_FOLDER_OUTPUT = OutputKind(check_empty_folder)
"""Kind of output folder that must be new or empty."""
RESULT_FOLDER_OUTPUT = OutputKind(lambda folder, force: check_writable(folder, is_folder=True))
"""Kind of output folder of which ltsim checks only the write permission here; the command checks files to be replaced.
"""
FILE_OR_FOLDER_OUTPUT = OutputKind(lambda path, force: check_writable(path, is_folder=path.is_dir()))
"""Kind of output that is a file or a folder, depending on other options; only write permission is checked."""
