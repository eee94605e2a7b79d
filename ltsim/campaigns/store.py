"""Folder of a campaign: a manifest and shards of rows, written so that no finished shard can be lost.

    manifest.json                          settings, seed, versions, commit; written before the first row, anew to grow
    campaign.toml                          the file as it was given
    rows/cell-0000/shard-000000.parquet    a fixed run of trials of one cell, all methods

    rows.sha256                            digest of each shard, as `sha256sum --check` reads it

A shard gets its name only when it is complete and on the disk (temporary file, fsync, rename). Its bytes depend on
settings and versions alone. Every reader compares its digest first; for a shard without digest, after a kill, the
checksums of its pages and its metadata are compared.
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

from ltsim.campaigns.schema import SUMMARY, ManifestFile
from ltsim.core.errors import RecordError, SetupError
from ltsim.core.storage import place_in, settle, write_files
from ltsim.recordings.result_file import read_result

MANIFEST = ManifestFile.FILE
SOURCE = "campaign.toml"
ROWS = "rows"
LOCK = ".lock"
DIGESTS = "rows.sha256"
DIGEST_LINE = re.compile(r"^(?P<digest>[0-9a-f]{64})  (?P<name>rows/cell-\d+/shard-\d+\.parquet)\n", re.MULTILINE)
"""Pattern of a complete line in the file of digests."""


def encoded(table: pa.Table, key: Mapping[str, str]) -> bytes:
    """Bytes of a table as a Parquet file; `key` is stored as its metadata."""
    labelled = table.replace_schema_metadata({"ltsim": json.dumps(dict(key), sort_keys=True)})
    words = [f.name for f in labelled.schema if pa.types.is_string(f.type) or f.name.startswith("sigma:")]
    sink = pa.BufferOutputStream()
    pq.write_table(
        labelled,
        sink,
        version="2.6",
        data_page_version="2.0",
        compression="zstd",
        compression_level=3,
        use_dictionary=words,
        write_statistics=True,
        write_page_checksum=True,
        row_group_size=max(len(labelled), 1),
    )
    return sink.getvalue().to_pybytes()


def table_of(path: Path) -> pa.Table:
    """Rows of a shard with verified checksums; raises `pyarrow.ArrowException` or OSError."""
    return pq.ParquetFile(path, page_checksum_verification=True).read()


def interruption(folder: Path, reason: object, cure: str = "") -> SetupError:
    """Error of a campaign that ends early and can be continued; `cure` is what to do before."""
    action = f"{cure} and continue" if cure else "continue"
    return SetupError(f"{folder}: {reason}; complete shards remain in the folder: {action} with --resume")


@dataclass(frozen=True)
class Store:
    """Folder of a campaign, with its manifest, shards and digests."""

    folder: Path

    def shard_path(self, cell: int, shard: int) -> Path:
        """Path of a shard's file."""
        return self.folder / ROWS / f"cell-{cell:04d}" / f"shard-{shard:06d}.parquet"

    def shards(self, below: int | None = None) -> list[Path]:
        """Paths of the finished shards in order; only those with numbers `below` a limit."""
        paths = sorted(self.folder.glob(f"{ROWS}/cell-*/shard-*.parquet"))
        return [path for path in paths if below is None or path.name < self.shard_path(0, below).name]

    def rows(self, cell: int, shard: int) -> pa.Table:
        """Rows of a finished shard; raises SetupError for a damaged one."""
        path = self.shard_path(cell, shard)
        try:
            return table_of(path)
        except (pa.ArrowException, OSError) as problem:
            raise SetupError(f"{path}: cannot be read ({problem}); continue with --resume to repair it") from None

    def verify(self, shards: Iterable[Path], marks: Mapping[int, str]) -> None:
        """Check that shards are as they were written for their cells.

        Raises OSError, ValueError or pyarrow.ArrowException.
        """
        digests = self.digests()
        for path in shards:
            name = path.relative_to(self.folder).as_posix()
            if name in digests:
                if _digest(path) != digests[name]:
                    raise ValueError(f"{name} was changed since it was written")
                continue
            label = _label(table_of(path))
            if label.get("campaign") != marks.get(int(label.get("cell", -1))):
                raise ValueError(f"{name} belongs to another campaign")

    def digests(self) -> dict[str, str]:
        """Recorded digests of shards, by their path in the folder."""
        try:
            text = (self.folder / DIGESTS).read_text(encoding="ascii", errors="replace")
        except OSError:
            return {}
        return {match["name"]: match["digest"] for match in DIGEST_LINE.finditer(text)}

    @property
    def begun(self) -> bool:
        """True if the folder contains a campaign."""
        return (self.folder / MANIFEST).exists()

    def manifest(self) -> ManifestFile:
        """Manifest of the campaign; raises SetupError if there is none or it is damaged."""
        if not self.begun:
            raise SetupError(f"{self.folder}: the folder holds no campaign (no {MANIFEST})")
        try:
            return read_result(self.folder, ManifestFile)
        except RecordError as problem:
            raise SetupError(f"{problem}; start again in another folder; the rows in this folder are kept") from None

    def begin(self, manifest: ManifestFile, sources: Mapping[str, bytes]) -> None:
        """Writing of the campaign's input files and then its manifest; written again when the campaign is extended."""
        with self._writing():
            self.folder.mkdir(parents=True, exist_ok=True)
            write_files(self.folder, {**sources, MANIFEST: manifest.text().encode()}, durable=True)

    def write_shard(self, cell: int, shard: int, content: bytes) -> None:
        """Atomic writing of a shard; raises SetupError if the disk is full or not writable."""
        name = self.shard_path(cell, shard).relative_to(self.folder).as_posix()
        with self._writing():
            write_files(self.folder, {name: content}, durable=True)
            self._note(name, hashlib.sha256(content).hexdigest())

    def note(self, cell: int, shard: int) -> None:
        """Recording of the digest of a complete shard for which a kill prevented it."""
        path = self.shard_path(cell, shard)
        with self._writing():
            self._note(path.relative_to(self.folder).as_posix(), _digest(path))

    def _note(self, name: str, digest: str) -> None:
        with place_in(self.folder, DIGESTS).open("a", encoding="ascii") as stream:
            stream.write(f"{digest}  {name}\n")

    def taken(self, sources: Mapping[str, bytes]) -> list[str]:
        """Names of files in the folder that a new campaign with some sources would overwrite with other content."""
        others = [name for name in (ROWS, DIGESTS, SUMMARY) if (self.folder / name).exists()]
        there = {name: self.folder / name for name in sources if (self.folder / name).exists()}
        return others + [n for n, path in there.items() if not path.is_file() or path.read_bytes() != sources[n]]

    def clear(self) -> None:
        """Removal of manifest, rows and derived files; raises RecordError for rows in another folder."""
        place_in(self.folder, ROWS)
        with self._writing():
            for name in (MANIFEST, DIGESTS, SUMMARY):
                (self.folder / name).unlink(missing_ok=True)
            if (self.folder / ROWS).exists():
                shutil.rmtree(self.folder / ROWS)

    def shard_status(self, cell: int, shard: int, key: Mapping[str, str], rows: int, digests: Mapping[str, str]) -> str:
        """Status of a shard: `whole`, `missing`, `damaged`, or `short` of rows or columns.

        `digests` are the recorded digests.
        """
        path = self.shard_path(cell, shard)
        if not path.exists():
            return "missing"
        try:
            table = table_of(path)
            noted, label = digests.get(path.relative_to(self.folder).as_posix()), _label(table)
            same = noted in (None, _digest(path)) and all(label[k] == key[k] for k in ("campaign", "cell", "shard"))
            short = len(table) < rows or not set(key["statistics"].split()) <= {*statistics_of(table)}
        except (pa.ArrowException, OSError, ValueError, KeyError):
            return "damaged"
        if not same or len(table) > rows:
            return "damaged"
        return "short" if short else "whole"

    def quarantine(self, cell: int, shard: int) -> Path:
        """Path of a damaged shard after it was renamed for inspection."""
        path = self.shard_path(cell, shard)
        aside = path.with_suffix(".damaged")
        place_in(self.folder, aside.relative_to(self.folder).as_posix())
        with self._writing():
            os.replace(path, aside)
        return aside

    def sweep(self) -> None:
        """Removal of unfinished files of a killed run: temporary files, and an incomplete line of the digests."""
        with self._writing():
            for folder in (self.folder, *self.folder.glob(f"{ROWS}/cell-*")):
                settle(place_in(self.folder, folder.relative_to(self.folder).as_posix()))
            lines = "".join(f"{digest}  {name}\n" for name, digest in self.digests().items()).encode()
            file = self.folder / DIGESTS
            if file.exists() and file.read_bytes() != lines:
                write_files(self.folder, {DIGESTS: lines}, durable=True)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Context that excludes other processes from the folder; the lock ends with the process in any case."""
        with self._writing():
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.folder / LOCK, blocking=False)
            try:
                lock.acquire()
            except Timeout:
                raise SetupError(f"{self.folder}: another campaign runs in this folder; wait until it ends") from None
        try:
            yield
        finally:
            lock.release()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as problem:
            full = problem.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            reason = "the disk is full" if full else f"cannot be written ({problem.strerror or problem})"
            cure = "free some space" if full else "make it writable"
            raise interruption(self.folder, reason, cure) from None


def statistics_of(table: pa.Table) -> list[str]:
    """Statistics in the rows of a shard, from the metadata of its file."""
    return _label(table)["statistics"].split()


def _label(table: pa.Table) -> dict[str, str]:
    return json.loads((table.schema.metadata or {}).get(b"ltsim", b"{}"))


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def literal(path: Path) -> str:
    """Path for SQL, with brackets and asterisks not interpreted as patterns."""
    plain = "".join(f"[{c}]" if c in "[*?" else c for c in str(path))
    return "'" + plain.replace("'", "''") + "'"
