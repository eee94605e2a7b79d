"""Archives of workbooks that do not hold what they declare: no part is unpacked beyond its size."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import pytest

from ltsim.core.errors import RecordError
from ltsim.recordings import Hints, read
from tests.recordings.test_tables import workbook

HIDDEN_BYTES = 100_000_000
"""Size of what a part unpacks to, a thousand times its packed size."""


def with_part(path: Path, content: bytes, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Workbook with a further part."""
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(zipfile.ZipInfo("xl/more.xml"), content, method)
    return path.read_bytes()


@pytest.mark.parametrize("is_forged", [False, True])
@pytest.mark.parametrize("declared", [0, 1000])
def test_a_part_that_unpacks_to_more_than_it_declares_takes_no_memory(
    declared: int, is_forged: bool, tmp_path: Path
) -> None:
    """Its checksum may be that of the declared beginning, so that only the size is wrong."""
    content = b"<a>" + b" " * HIDDEN_BYTES + b"</a>"
    packed = with_part(workbook(tmp_path / "a.xlsx"), content)
    sizes = struct.pack("<I", declared)
    packed = packed.replace(struct.pack("<I", len(content)), sizes)
    if is_forged:
        packed = packed.replace(
            struct.pack("<I", zlib.crc32(content)), struct.pack("<I", zlib.crc32(content[:declared]))
        )
    (tmp_path / "a.xlsx").write_bytes(packed)
    tracemalloc.start()
    with pytest.raises(RecordError, match="damaged"):
        read(tmp_path / "a.xlsx", hints=Hints(azimuth="clockwise"))
    assert tracemalloc.get_traced_memory()[1] < HIDDEN_BYTES / 2
    tracemalloc.stop()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_part_that_no_spreadsheet_packs_so_is_refused(method: int, tmp_path: Path) -> None:
    with_part(workbook(tmp_path / "a.xlsx"), b"<a/>", method)
    with pytest.raises(RecordError, match="packed in a way that spreadsheets do not use"):
        read(tmp_path / "a.xlsx")


def test_of_parts_with_equal_name_the_last_is_read(tmp_path: Path) -> None:
    file = workbook(tmp_path / "a.xlsx")
    whole = read(file, hints=Hints(azimuth="clockwise"))
    with zipfile.ZipFile(io.BytesIO(file.read_bytes())) as archive:
        sheet = archive.read("xl/worksheets/sheet1.xml")
    with zipfile.ZipFile(file, "a") as archive:
        for content in (b"<worksheet/>", sheet):
            with pytest.warns(UserWarning, match="Duplicate name"):
                archive.writestr("xl/worksheets/sheet1.xml", content)
    assert len(read(file, hints=Hints(azimuth="clockwise"))) == len(whole)
