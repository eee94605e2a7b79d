"""Atomic replacement of files in a folder, by a process that may be killed at any moment.

Contents are written to temporary files first. A journal file then lists the final names, and the files are renamed. A
process that is killed before it writes the journal leaves the folder unchanged. If it is killed later, the next process
that writes there completes the renaming (`complete_interrupted_moves`). Files and folders have the permissions of the
user's umask.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping
from io import BufferedReader
from pathlib import Path
from tempfile import TemporaryFile

from ltsim.core.errors import RecordError
from ltsim.core.limits import BYTES_PER_MIB

NEW_FILE_PERMISSIONS = 0o666
"""Permissions of a new file, before the user's umask restricts them."""
MAX_JOURNAL_BYTES = BYTES_PER_MIB
"""Largest size [bytes] of a journal file (list of pending renamings) that is read: the size for 10,000 files."""
_PROCESS_TOKEN = secrets.token_hex(4)
"""Random identifier of this process in the names of its temporary files. The process number is not enough, because the
operating system reuses it."""
_TEMPORARY_NAME_PATTERN = re.compile(r"\.ltsim-(\d{1,9})-([0-9a-f]{8})-[0-9a-f]{8}\.(tmp|moves)")
"""Pattern of the names of temporary files and journals; its groups are process number and random process identifier."""


def write_files(folder: Path, content_by_name: Mapping[str, bytes], *, flush_to_disk: bool = False) -> None:
    """Atomic writing of files into a folder, which is created if necessary: all files are written, or none.

    A file name may contain subfolders. With `flush_to_disk`, the operating system must write the files to the disk
    before the function returns. OSError is raised if a file cannot be written, and RecordError for a link that leads
    out of the folder and for a pipe or device in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    complete_interrupted_moves(folder)
    moves: dict[str, str] = {}
    journal = folder / _temporary_name("moves")
    try:
        for name, content in content_by_name.items():
            final_path = path_in_folder(folder, name)
            final_path.parent.mkdir(parents=True, exist_ok=True)
            if final_path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(folder / name))
            temporary = final_path.parent / _temporary_name("tmp")
            moves[os.path.relpath(temporary, folder)] = name
            _create_file(temporary, content, flush_to_disk=flush_to_disk)
        if len(moves) > 1:
            _create_file(journal, json.dumps(moves).encode(), flush_to_disk=flush_to_disk)
        try:
            _rename_files(folder, moves, flush_to_disk=flush_to_disk)
        except KeyboardInterrupt:
            _rename_files(folder, moves, flush_to_disk=flush_to_disk)
            raise
    finally:
        for temporary in (*(folder / name for name in moves), journal):
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def write_to_device(path: Path, content: bytes) -> None:
    """Writing to a pipe or device that the user names.

    OSError is raised if the device cannot be written, and for a pipe from which no process reads, because writing to it
    would never end.
    """
    try:
        handle = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError as problem:
        if problem.errno == errno.ENXIO:
            raise OSError(errno.ENXIO, "no process reads from this pipe", str(path)) from None
        raise
    if hasattr(os, "O_NONBLOCK"):
        os.set_blocking(handle, True)  # a reader may be slow
    with os.fdopen(handle, "wb") as stream:
        stream.write(content)


def require_no_link(folder: Path, name: str) -> None:
    """Check that a file in a folder, if it exists, is neither a symbolic nor a hard link; raises RecordError."""
    path = path_in_folder(folder, name)
    if path.exists() and path.stat().st_nlink > 1:
        raise RecordError(
            "the file has another name elsewhere (hard link); remove it, or choose another folder", file=path
        )


def append_text(folder: Path, name: str, text: str) -> None:
    """Appending of ASCII text to a file in a folder; other names (hard links) of the file keep the old content.

    OSError is raised if the file cannot be written. RecordError is raised for a link that leads out of the folder, and
    for a pipe or device.
    """
    path = path_in_folder(folder, name)
    if path.exists() and path.stat().st_nlink > 1:
        write_files(folder, {name: path.read_bytes()})
    with path.open("a", encoding="ascii") as stream:
        stream.write(text)


def open_for_reading(path: Path) -> BufferedReader:
    """File, opened for reading in binary mode.

    OSError is raised if the path cannot be opened. It is also raised for a folder, a pipe or a device, because reading
    from these might never end.
    """
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(handle, "rb")
    os.close(handle)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "the path is a pipe or a device, expected a file", str(path))


def read_whole_file(path: Path) -> bytes:
    """Content of a file of any size; raises OSError if it cannot be opened, and for a folder, pipe or device."""
    with open_for_reading(path) as stream:
        return stream.read()


def complete_interrupted_moves(folder: Path) -> set[str]:
    """Completion of renamings that a killed process left unfinished; returns the final names of the renamed files.

    Temporary files of killed processes are removed. OSError is raised if the folder cannot be written.
    """
    finished_names: set[str] = set()
    for journal in _abandoned_temporary_files(folder, "moves"):
        try:
            with open_for_reading(journal) as stream:
                moves = json.loads(stream.read(MAX_JOURNAL_BYTES))
            valid = isinstance(moves, dict) and all(
                isinstance(name, str) and _TEMPORARY_NAME_PATTERN.fullmatch(Path(source).name)
                for source, name in moves.items()
            )
        except (ValueError, RecursionError, OSError):  # killed while it wrote the journal, or not written by ltsim
            valid = False
        if valid:
            moves = {source: name for source, name in moves.items() if _is_inside_folder(folder, source)}
            _rename_files(folder, moves, flush_to_disk=False)
            finished_names.update(moves.values())
        journal.unlink(missing_ok=True)
    for temporary in _abandoned_temporary_files(folder, "tmp"):
        temporary.unlink(missing_ok=True)
    return finished_names


def path_in_folder(folder: Path, file_name: str) -> Path:
    """Path of a file in a folder after resolution of symbolic links.

    RecordError is raised for a link that leads out of the folder, and for a pipe or device.
    """
    final_path = Path(os.path.realpath(folder / file_name))
    if not _is_inside_folder(folder, file_name):
        raise RecordError(
            f"the path is a link out of the folder, to {final_path}; remove the link, or choose another folder",
            file=folder / file_name,
        )
    if is_device_or_pipe(final_path):
        raise RecordError("the path is a pipe or device; remove it, or choose another folder", file=folder / file_name)
    return final_path


def with_digest_comment(text: str) -> str:
    """XML text with its SHA-256 digest in a comment at the end, which shows whether the file was modified later."""
    return f"{text}<!-- written by ltsim, sha256 {hashlib.sha256(text.encode()).hexdigest()} -->\n"


def is_unmodified_since_written(path: Path) -> bool:
    """True for a file that ltsim wrote with `with_digest_comment` and that has not been modified since."""
    n_bytes = len(with_digest_comment("").encode())
    with open_for_reading(path) as stream:
        stream.seek(-min(n_bytes, path.stat().st_size), os.SEEK_END)
        if not stream.read().startswith(b"<!-- written by ltsim"):
            return False
        stream.seek(0)
        content = stream.read()
    return content == with_digest_comment(content[:-n_bytes].decode("utf-8", "replace")).encode()


def is_device_or_pipe(path: Path) -> bool:
    """True for the path of a device or pipe, which is neither a file nor a folder."""
    return path.exists() and not path.is_file() and not path.is_dir()


def check_writable(path: Path, *, is_folder: bool) -> None:
    """Check that a file, or a folder if `is_folder` is true, can be written at a path; raises RecordError otherwise.

    Parent folders may be missing.
    """
    try:
        if path.is_dir() != is_folder and path.exists():
            wrong = "the path is a file, expected a folder" if is_folder else "the path is a folder, expected a file"
            raise RecordError(f"{wrong} to write to", file=path)
        if is_device_or_pipe(path):
            if not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        else:
            _check_nearest_folder_writable(path, path if is_folder else path.parent)
    except (OSError, ValueError) as problem:
        raise RecordError(f"the path cannot be written ({getattr(problem, 'strerror', problem)})", file=path) from None
    if not is_folder and not (is_device_or_pipe(path) and not path.is_symlink()):
        path_in_folder(path.parent, path.name)


def _check_nearest_folder_writable(path: Path, folder: Path) -> None:
    """Check that files can be created in the first existing folder from `folder` upwards; raises OSError otherwise."""
    while not os.path.lexists(folder):
        folder = folder.parent
    with contextlib.suppress(FileNotFoundError):
        os.lstat(path)
    for part in path.parts:  # a name may be too long for the file system
        with contextlib.suppress(FileNotFoundError):
            os.lstat(folder / part)
    TemporaryFile(dir=folder).close()


def _temporary_name(file_suffix: str) -> str:
    """Unique name of a temporary file of this process, with the suffix `file_suffix`."""
    return f".ltsim-{os.getpid()}-{_PROCESS_TOKEN}-{secrets.token_hex(4)}.{file_suffix}"


def _create_file(path: Path, content: bytes, *, flush_to_disk: bool) -> None:
    """Creation of a new file with `content`; the user's umask restricts its permissions."""
    with open(path, "xb", opener=lambda name, flags: os.open(name, flags, NEW_FILE_PERMISSIONS)) as stream:
        stream.write(content)
        if flush_to_disk:
            stream.flush()
            os.fsync(stream.fileno())


def _rename_files(folder: Path, final_name_by_temporary: Mapping[str, str], *, flush_to_disk: bool) -> None:
    """Renaming of temporary files in a folder to their final names; a file that is already renamed is skipped."""
    parents = set()
    for source, name in final_name_by_temporary.items():
        final_path = path_in_folder(folder, name)
        with contextlib.suppress(FileNotFoundError):
            os.replace(folder / source, final_path)
        parents.add(final_path.parent)
    for parent in parents if flush_to_disk else ():
        handle = os.open(parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _is_inside_folder(folder: Path, file_name: str) -> bool:
    return Path(os.path.realpath(folder / file_name)).is_relative_to(os.path.realpath(folder))


def _abandoned_temporary_files(folder: Path, file_suffix: str) -> Iterator[Path]:
    """Temporary files with the suffix `file_suffix` in a folder and its subfolders whose processes have ended.

    Files behind symbolic links are left out.
    """
    for path in [*folder.glob(f".ltsim-*.{file_suffix}"), *folder.glob(f"*/.ltsim-*.{file_suffix}")]:
        match = _TEMPORARY_NAME_PATTERN.fullmatch(path.name)
        name = path.relative_to(folder).as_posix()
        if match and _is_inside_folder(folder, name) and not _is_process_running(int(match[1]), match[2]):
            yield path


def _is_process_running(process_id: int, process_token: str) -> bool:
    """True if the process with this number and random identifier is still running, or if this cannot be determined."""
    if os.name == "nt":  # where `os.kill` would end the process
        return True
    if process_id == os.getpid():
        return process_token == _PROCESS_TOKEN
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True
