"""Safety check of the archive of a workbook before a library reads it."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from ltsim.core.errors import RecordError
from ltsim.core.limits import BYTES_PER_MIB, MAX_WORKBOOK_BYTES, MAX_WORKBOOK_PARTS
from ltsim.recordings.xml import check_workbook_xml


def checked_workbook_archive(file: Path, workbook_archive: io.BytesIO) -> io.BytesIO:
    """New archive with the parts of a workbook, after checks of their number, unpacked size and XML; or RecordError.

    The parts are packed again, because the library would unpack them without regard to the declared size.
    """
    checked = io.BytesIO()
    with zipfile.ZipFile(workbook_archive) as archive, zipfile.ZipFile(checked, "w") as copy:
        parts = archive.infolist()
        if len(parts) > MAX_WORKBOOK_PARTS:
            raise RecordError(f"the file holds more than {MAX_WORKBOOK_PARTS} parts, the limit for reading", file=file)
        if sum(part.file_size for part in parts) > MAX_WORKBOOK_BYTES:
            most = f"{MAX_WORKBOOK_BYTES // BYTES_PER_MIB} MiB"
            raise RecordError(
                f"the file unpacks to more than {most}, the limit for reading; save the table as CSV", file=file
            )
        for part in {part.filename: part for part in parts}.values():
            if part.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise RecordError("the file is packed in a way that spreadsheets do not use; save it again", file=file)
            with archive.open(part) as stream:
                content = stream.read(part.file_size + 1)
            if part.filename.lower().endswith(".xml") or b"<" in content.lstrip()[:4]:  # after any byte-order mark
                check_workbook_xml(content, file)
            copy.writestr(part.filename, content)
    checked.seek(0)
    return checked
