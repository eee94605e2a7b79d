"""CAD files of exact surfaces (STEP, IGES) as triangles, by OpenCASCADE: the extra `step`."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from ltsim.errors import SetupError

SUFFIXES = (".step", ".stp", ".iges", ".igs")
DEVIATION = 1.0
"""[mm] that a triangle may lie off the surface: enough to know what hides what."""


def as_glb(content: bytes, suffix: str) -> bytes:
    """The GLB file, in metres, of a STEP or IGES file; empty for one that cannot be read.

    Raises
    ------
    SetupError
        Where the library that reads them is not installed.
    """
    try:
        import cascadio
    except ImportError:
        raise SetupError(
            'holds exact surfaces, which needs the library cascadio: pip install "ltsim[step]", or export it from the '
            "CAD system as STL, OBJ or GLB"
        ) from None
    kind = cascadio.FileType.STEP if suffix in (".step", ".stp") else cascadio.FileType.IGES
    with _unheard():
        found: bytes = cascadio.to_glb_bytes(content, kind, tol_linear=DEVIATION)
    return found


@contextmanager
def _unheard() -> Iterator[None]:
    """OpenCASCADE writes what it thinks of a file to the terminal, below Python; it goes nowhere."""
    kept = [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as nowhere:
        try:
            for number in (1, 2):
                os.dup2(nowhere.fileno(), number)
            yield
        finally:
            for number, own in zip((1, 2), kept, strict=True):
                os.dup2(own, number)
                os.close(own)
