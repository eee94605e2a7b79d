"""Folder of a campaign: a manifest and files of rows (shards), written so that no finished shard can be lost.

    manifest.json                          settings, seed, versions, commit; written before the first row
    campaign.toml                          copy of the campaign file
    rows/cell-0000/shard-000000.parquet    rows of consecutive trials of one combination of factor levels (cell)
    rows.sha256                            digest of each shard, as `sha256sum --check` reads it; after a run in order

A shard gets its name only when it is complete and on the disk (temporary file, fsync, rename). Its bytes depend only on
settings and versions. Every reader first compares the digest. A shard has no digest if the process was killed between
writing the shard and writing its digest. In this case the reader checks the checksums of the Parquet pages and the
metadata.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from filelock import FileLock, Timeout

from ltsim.campaigns.schema import SUMMARY_FILE_NAME, ManifestFile
from ltsim.core.errors import InputError, RecordError, option_text
from ltsim.core.limits import MAX_READ_SHARD_ROWS
from ltsim.core.storage import (
    append_text,
    complete_interrupted_moves,
    open_for_reading,
    path_in_folder,
    read_whole_file,
    require_no_link,
    write_files,
)
from ltsim.recordings.result_file import read_result

MANIFEST_FILE_NAME = ManifestFile.FILE
"""Name of the file that defines a campaign, in its folder."""
CAMPAIGN_FILE_NAME = "campaign.toml"
"""Name of the copy of the campaign file, in the folder of the campaign."""
ROWS_FOLDER_NAME = "rows"
"""Name of the subfolder with the files of rows (shards)."""
LOCK_FILE_NAME = ".lock"
"""Name of the file that a running campaign locks, so that no second process writes to its folder."""
DIGESTS_FILE_NAME = "rows.sha256"
"""Name of the file with the SHA-256 digest of each shard."""
DIGEST_LINE_PATTERN = re.compile(
    r"^(?P<digest>[0-9a-f]{64})  (?P<name>rows/cell-\d+/shard-\d+\.parquet)\n", re.MULTILINE
)
"""Pattern of a complete line in the file of digests: SHA-256 digest and path of a file of rows."""


def parquet_bytes(table: pa.Table, metadata: Mapping[str, str]) -> bytes:
    """Bytes of a Parquet file with the rows of a table; `metadata` becomes metadata of the file."""
    table_with_key = table.replace_schema_metadata({"ltsim": json.dumps(dict(metadata), sort_keys=True)})
    words = [f.name for f in table_with_key.schema if pa.types.is_string(f.type) or f.name.startswith("sigma:")]
    sink = pa.BufferOutputStream()
    pq.write_table(
        table_with_key,
        sink,
        version="2.6",
        data_page_version="2.0",
        compression="zstd",
        compression_level=3,
        use_dictionary=words,
        write_statistics=True,
        write_page_checksum=True,
        row_group_size=max(len(table_with_key), 1),
    )
    return sink.getvalue().to_pybytes()


def read_shard(path: Path) -> pa.Table:
    """Rows of a file of rows (shard), after a check of its checksums.

    Raises `pyarrow.ArrowException` or OSError, also for more rows than a shard can have.
    """
    open_for_reading(path).close()  # the library would wait for a pipe
    file = pq.ParquetFile(path, page_checksum_verification=True)
    _check_number_of_rows(path, file.metadata)
    return file.read()


def _check_number_of_rows(path: Path, metadata: pq.FileMetaData) -> None:
    """Check of the number of rows in a file of rows (shard); raises `pyarrow.ArrowInvalid` for too many rows."""
    if metadata.num_rows > MAX_READ_SHARD_ROWS:
        raise pa.ArrowInvalid(f"{path.name} has {metadata.num_rows} rows, expected at most {MAX_READ_SHARD_ROWS}")


def interruption_error(folder: Path, reason: object, remedy: str = "") -> InputError:
    """InputError for a campaign that ended early, which tells the user how to continue.

    `reason` says why it ended; `remedy`, if given, is what to do first.
    """
    action = f"{f'{remedy} and ' if remedy else ''}continue with {option_text('resume=True')}"
    return InputError(f"{folder}: {reason}; complete files of rows remain in the folder: {action}")


@dataclass(frozen=True)
class CampaignFolder:
    """Folder of a campaign, with its manifest, files of rows (shards) and digests."""

    folder: Path

    def shard_path(self, cell: int, shard: int) -> Path:
        """Path of file of rows (shard) number `shard`, from 0, of a cell.

        `cell` is the index, from 0, of the combination of factor levels.
        """
        return self.folder / ROWS_FOLDER_NAME / f"cell-{cell:04d}" / f"shard-{shard:06d}.parquet"

    def shard_paths(self, max_shards: int | None = None) -> list[Path]:
        """Paths of the finished files of rows (shards), the first `max_shards` per combination of factor levels."""
        paths = sorted(self.folder.glob(f"{ROWS_FOLDER_NAME}/cell-*/shard-*.parquet"))
        return [path for path in paths if max_shards is None or path.name < self.shard_path(0, max_shards).name]

    def read_rows(self, cell: int, shard: int) -> pa.Table:
        """Rows of finished file `shard`, from 0, of the combination of factor levels `cell`; InputError if damaged."""
        path = self.shard_path(cell, shard)
        try:
            return read_shard(path)
        except (pa.ArrowException, OSError) as problem:
            repair = f"continue with {option_text('resume=True')} to repair it"
            raise InputError(f"{path}: the file cannot be read ({problem}); {repair}") from None

    def verify_shards(self, shards: Iterable[Path], cell_digests: Mapping[int, str]) -> None:
        """Check that files of rows (shards) are unchanged since they were written, and are in the folder of their cell.

        `cell_digests` holds the digest of each cell (combination of factor levels) by its number. OSError, ValueError
        or pyarrow.ArrowException is raised for a damaged shard.
        """
        digests = self.recorded_shard_digests()
        for path in shards:
            name = path.relative_to(self.folder).as_posix()
            if name in digests:
                if _file_digest(path) != digests[name]:
                    raise ValueError(f"{name} was changed since it was written")
                _check_number_of_rows(path, pq.read_metadata(path))
                continue
            label = _shard_metadata(read_shard(path))
            if label.get("campaign") != cell_digests.get(int(label.get("cell", -1))):
                raise ValueError(f"{name} belongs to another campaign")

    def recorded_shard_digests(self) -> dict[str, str]:
        """Recorded SHA-256 digest of each file of rows (shard), by its path in the folder."""
        try:
            text = read_whole_file(self.folder / DIGESTS_FILE_NAME).decode("ascii", "replace")
        except OSError:
            return {}
        return {match["name"]: match["digest"] for match in DIGEST_LINE_PATTERN.finditer(text)}

    @property
    def has_campaign(self) -> bool:
        """True if the folder contains a campaign."""
        return (self.folder / MANIFEST_FILE_NAME).exists()

    def manifest(self) -> ManifestFile:
        """Manifest of the campaign; raises InputError if there is none or it is damaged."""
        if not self.has_campaign:
            raise InputError(f"{self.folder}: the folder holds no campaign (no {MANIFEST_FILE_NAME})")
        try:
            return read_result(self.folder, ManifestFile)
        except RecordError as problem:
            raise InputError(f"{problem}; start again in another folder; the rows in this folder are kept") from None

    def manifest_to_continue(self, *, resume: bool) -> ManifestFile:
        """Manifest of the campaign; InputError if the campaign cannot be continued, or `resume` is false."""
        if not resume:
            raise InputError(
                f"{self.folder}: the folder holds a campaign; continue it with {option_text('resume=True')}, "
                f"name another {option_text('out')}, or start again with {option_text('force=True')}"
            )
        manifest = self.manifest()
        if not all(cell.digest for cell in manifest.cells):
            raise InputError(
                f"{self.folder}: the campaign was started by an earlier version of ltsim; start again with another "
                f"{option_text('out')}, or with {option_text('force=True')}"
            )
        return manifest

    def write_manifest(self, manifest: ManifestFile, input_files: Mapping[str, bytes]) -> None:
        """Writing of the campaign's input files (contents by name), then of its manifest; old files are replaced."""
        with self._storage_errors():
            self.folder.mkdir(parents=True, exist_ok=True)
            write_files(self.folder, {**input_files, MANIFEST_FILE_NAME: manifest.text().encode()}, flush_to_disk=True)

    def write_shard(self, cell: int, shard: int, content: bytes) -> None:
        """Atomic writing of a file of rows; raises InputError if the disk is full or not writable.

        `cell` and `shard` are the indices, from 0, of the combination of factor levels and of the file.
        """
        name = self.shard_path(cell, shard).relative_to(self.folder).as_posix()
        with self._storage_errors():
            write_files(self.folder, {name: content}, flush_to_disk=True)
            self._append_digest(name, hashlib.sha256(content).hexdigest())

    def record_digest(self, cell: int, shard: int) -> None:
        """Recording of the digest of a complete file of rows, which a killed process did not record.

        `cell` and `shard` are the indices, from 0, of the combination of factor levels and of the file.
        """
        path = self.shard_path(cell, shard)
        with self._storage_errors():
            self._append_digest(path.relative_to(self.folder).as_posix(), _file_digest(path))

    def _append_digest(self, name: str, digest: str) -> None:
        """Appending of one line, digest and name of a file of rows, to the file of digests."""
        append_text(self.folder, DIGESTS_FILE_NAME, f"{digest}  {name}\n")

    def conflicting_files(self, sources: Mapping[str, bytes]) -> list[str]:
        """Names of files in the folder that a new campaign with the input files `sources` would overwrite.

        `sources` holds the contents of input files by name; an existing file with the same content is no conflict.
        """
        remaining = [
            name for name in (ROWS_FOLDER_NAME, DIGESTS_FILE_NAME, SUMMARY_FILE_NAME) if (self.folder / name).exists()
        ]
        existing_paths = {name: self.folder / name for name in sources if (self.folder / name).exists()}
        return remaining + [
            n for n, path in existing_paths.items() if not path.is_file() or read_whole_file(path) != sources[n]
        ]

    def remove_campaign(self) -> None:
        """Removal of manifest, rows and derived files; RecordError if a link leads to rows outside the folder."""
        path_in_folder(self.folder, ROWS_FOLDER_NAME)
        with self._storage_errors():
            for name in (MANIFEST_FILE_NAME, DIGESTS_FILE_NAME, SUMMARY_FILE_NAME):
                (self.folder / name).unlink(missing_ok=True)
            if (self.folder / ROWS_FOLDER_NAME).exists():
                shutil.rmtree(self.folder / ROWS_FOLDER_NAME)

    def shard_status(
        self, cell: int, shard: int, required_metadata: Mapping[str, str], n_rows: int, digests: Mapping[str, str]
    ) -> str:
        """Status of a shard: `complete`, `missing`, `damaged`, or `incomplete` (rows or columns are missing).

        `required_metadata` and `n_rows` are metadata and number of rows of a complete file of rows (shard), `digests`
        the recorded digests by path.
        """
        path = self.shard_path(cell, shard)
        if not path.exists():
            return "missing"
        try:
            table = read_shard(path)
            recorded_digest, label = digests.get(path.relative_to(self.folder).as_posix()), _shard_metadata(table)
            is_same_shard = recorded_digest in (None, _file_digest(path)) and all(
                label[k] == required_metadata[k] for k in ("campaign", "cell", "shard")
            )
            is_incomplete = len(table) < n_rows or not set(required_metadata["statistics"].split()) <= {
                *stored_statistic_groups(table)
            }
        except (pa.ArrowException, OSError, ValueError, KeyError):
            return "damaged"
        if not is_same_shard or len(table) > n_rows:
            return "damaged"
        return "incomplete" if is_incomplete else "complete"

    def quarantine_shard(self, cell: int, shard: int) -> Path:
        """Renaming of a damaged file of rows, so that the user can inspect it; returns its new path.

        `cell` and `shard` are the indices, from 0, of the combination of factor levels and of the file.
        """
        path = self.shard_path(cell, shard)
        damaged_path = path.with_suffix(".damaged")
        path_in_folder(self.folder, damaged_path.relative_to(self.folder).as_posix())
        with self._storage_errors():
            os.replace(path, damaged_path)
        return damaged_path

    def remove_unfinished_files(self) -> None:
        """Removal of the remains of a killed run: temporary files, and an incomplete line in the file of digests."""
        with self._storage_errors():
            for folder in (self.folder, *self.folder.glob(f"{ROWS_FOLDER_NAME}/cell-*")):
                complete_interrupted_moves(path_in_folder(self.folder, folder.relative_to(self.folder).as_posix()))
        self.sort_digests()

    def sort_digests(self) -> None:
        """Digests in the order of their shards, one line each; during a run they are in the order of completion."""
        with self._storage_errors():
            lines = "".join(
                f"{digest}  {name}\n" for name, digest in sorted(self.recorded_shard_digests().items())
            ).encode()
            file = path_in_folder(self.folder, DIGESTS_FILE_NAME)
            if file.exists() and read_whole_file(file) != lines:
                write_files(self.folder, {DIGESTS_FILE_NAME: lines}, flush_to_disk=True)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Context in which no other process can write to the folder; the lock ends with this process in any case."""
        with self._storage_errors():
            self.folder.mkdir(parents=True, exist_ok=True)
            require_no_link(self.folder, LOCK_FILE_NAME)  # the library may empty the file
            lock = FileLock(self.folder / LOCK_FILE_NAME, blocking=False)
            try:
                lock.acquire()
            except Timeout:
                raise InputError(f"{self.folder}: another campaign runs in this folder; wait until it ends") from None
        try:
            yield
        finally:
            lock.release()

    @contextlib.contextmanager
    def _storage_errors(self) -> Iterator[None]:
        """Context that converts errors of the file system to an InputError that says how to continue."""
        try:
            yield
        except OSError as problem:
            full = problem.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            reason = "the disk is full" if full else f"the folder cannot be written ({problem.strerror or problem})"
            cure = "free some space" if full else "make it writable"
            raise interruption_error(self.folder, reason, cure) from None


def stored_statistic_groups(table: pa.Table) -> list[str]:
    """Names of the groups of result columns in a file of rows (shard), from its metadata."""
    return _shard_metadata(table)["statistics"].split()


def _shard_metadata(table: pa.Table) -> dict[str, str]:
    """Metadata of a file of rows (shard), as text by key."""
    return json.loads((table.schema.metadata or {}).get(b"ltsim", b"{}"))


def _file_digest(path: Path) -> str:
    """SHA-256 digest of a file, as hexadecimal text."""
    with open_for_reading(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def path_as_sql_text(path: Path) -> str:
    """Path as a quoted SQL text, in which brackets and asterisks are not interpreted as patterns."""
    escaped_path = "".join(f"[{c}]" if c in "[*?" else c for c in str(path))
    return "'" + escaped_path.replace("'", "''") + "'"
