"""Pictures on disk: whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from ltsim.errors import RecordError


def write_bytes(path: Path, content: bytes) -> None:
    """Write one file at once: to a temporary sibling that then takes its place.

    Raises
    ------
    RecordError
        When the folder cannot be made or written to; nothing half-written stays behind.
    """
    temporary = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
        temporary = ""
    except OSError as problem:
        raise RecordError(f"cannot be written ({problem.strerror})", file=path) from None
    finally:
        if temporary:
            Path(temporary).unlink(missing_ok=True)
