"""Reading of CAD files in a separate process with limits of memory and time.

A small file may contain a very large number of triangles (repeated bodies, polygons with many corners, exact surfaces).
A damaged file may crash the libraries. The process returns only the triangles.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError
from ltsim.core.limits import (
    BYTES_PER_MIB,
    MAX_CAD_MEMORY_BYTES,
    MAX_CAD_SECONDS,
    MAX_FILE_BYTES,
    MAX_IN_PROCESS_CAD_BYTES,
    MAX_OBSTACLE_TRIANGLES,
)
from ltsim.core.storage import open_for_reading, read_whole_file
from ltsim.recordings.files import safe_excerpt

EXACT_SURFACE_SUFFIXES = (".step", ".stp", ".iges", ".igs")
"""Suffixes of CAD files with exact surfaces."""
FACET_SUFFIXES = (".stl", ".obj", ".ply")
"""Suffixes of CAD files with triangles or plane polygons."""
MAX_TESSELLATION_DEVIATION_MM = 1.0
"""Largest distance [mm] of triangles from the curved surface that they represent. A smaller distance would not change
which lines of sight are free."""
_CHILD_PROCESS_CODE = "from ltsim.scene.cad_process import run_reader_process; run_reader_process()"
"""Python code of the separate process."""
_LIBRARY_ERROR_EXIT_STATUS = 3
"""Exit status of the separate process if a library raised an error, whose name is then on standard error."""


def read_triangles(path: Path) -> Floats:
    """Corners (m, 3, 3) of the m triangles in the axes and unit of a CAD file; in metres for exact surfaces.

    Raises InputError for a damaged file, for too many triangles, and for a file without triangles.
    """
    content = read_whole_file(path)
    suffix = path.suffix.lower()
    if suffix == ".stl":
        _require_few_triangles(path, max_stl_triangle_count(content))
    if suffix == ".stl" or (suffix in FACET_SUFFIXES and len(content) <= MAX_IN_PROCESS_CAD_BYTES):
        try:
            triangles = parse_triangles(content, suffix)
        except Exception as problem:  # the readers of these formats raise many kinds of errors
            raise _incomplete_file_error(path, type(problem).__name__) from None
    else:
        triangles = _read_in_process(path, len(content))
    _require_few_triangles(path, len(triangles))
    if not len(triangles) or not np.all(np.isfinite(triangles)):
        raise InputError(f"{path}: the file contains no surface of triangles with finite coordinates")
    return triangles


def max_stl_triangle_count(file_content: bytes) -> int:
    """Upper limit of the number of triangles in an STL file, from its length (binary) or its keywords (text)."""
    n_facets = (len(file_content) - 84) // 50
    if len(file_content) >= 84 and int.from_bytes(file_content[80:84], "little") == n_facets:
        return n_facets
    return file_content.lower().count(b"vertex") // 3


def _require_few_triangles(path: Path, n_triangles: int) -> None:
    """Check of the number of triangles against `MAX_OBSTACLE_TRIANGLES`; raises InputError."""
    if n_triangles > MAX_OBSTACLE_TRIANGLES:
        raise InputError(
            f"{path}: the file has {n_triangles} triangles, but at most {MAX_OBSTACLE_TRIANGLES} are read; "
            "export it with a coarser mesh"
        )


def _incomplete_file_error(path: Path, reason: str) -> InputError:
    """InputError for an incomplete file."""
    return InputError(
        f"{path}: the file is not a complete {path.suffix[1:]} file ({safe_excerpt(reason)}); export it again"
    )


def _read_in_process(path: Path, file_size: int) -> Floats:
    """Corners (m, 3, 3) of the m triangles of a CAD file of `file_size` [bytes], read in a separate process.

    Raises InputError if the process refuses the file, crashes, or exceeds its limits of memory and time.
    """
    limit_factor = max(1.0, file_size / MAX_FILE_BYTES)
    limits = [str(int(limit_factor * MAX_CAD_MEMORY_BYTES)), str(int(limit_factor * MAX_CAD_SECONDS))]
    process_arguments = [sys.executable, "-P", "-c", _CHILD_PROCESS_CODE, str(path.resolve()), *limits]
    thread_limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    completed_process = subprocess.run(
        process_arguments, capture_output=True, check=False, env={**os.environ, **thread_limits}
    )
    if completed_process.returncode == _LIBRARY_ERROR_EXIT_STATUS:
        reason = completed_process.stderr.decode(errors="replace").strip()
        if reason not in (MemoryError.__name__, ""):  # without memory the reason may not be written either
            raise _incomplete_file_error(path, reason)
    if completed_process.returncode:
        most = (
            f"{limit_factor * MAX_CAD_MEMORY_BYTES / BYTES_PER_MIB:.0f} MiB and {limit_factor * MAX_CAD_SECONDS:.0f} s"
        )
        what = f"is damaged, or needs more than {most} of memory and time"
        raise InputError(f"{path}: {what}; export it as STL with a coarser mesh")
    return np.frombuffer(completed_process.stdout, dtype=np.float64).reshape(-1, 3, 3)


def run_reader_process() -> None:
    """Main function of the separate process: reads a CAD file and writes its triangles to standard output.

    The command-line arguments are the path of the file, the limit of memory [bytes] and the limit of processor time
    [s].
    """
    path, memory_bytes, processor_seconds = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    limit_process_resources(memory_bytes, processor_seconds)
    try:
        with open_for_reading(path) as stream, without_library_output():
            triangles = parse_triangles(stream.read(), path.suffix.lower())
        if len(triangles) > MAX_OBSTACLE_TRIANGLES:
            raise MemoryError
    except Exception as problem:  # the libraries raise many kinds of errors
        sys.stderr.write(type(problem).__name__)
        sys.exit(_LIBRARY_ERROR_EXIT_STATUS)
    sys.stdout.buffer.write(np.ascontiguousarray(triangles).tobytes())


def limit_process_resources(memory_bytes: int, processor_seconds: int) -> None:
    """Limitation of the memory and processor time of this process, if the operating system supports limits.

    `memory_bytes` [bytes] is permitted in addition to the memory of the imported libraries. `processor_seconds` is in
    seconds.
    """
    with suppress(ImportError, ValueError, OSError):
        import resource

        import trimesh  # noqa: F401  # its libraries reserve 300 MB of addresses and use a third of them

        resource.setrlimit(resource.RLIMIT_CPU, (processor_seconds, processor_seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        status = Path("/proc/self/status").read_text(encoding="ascii")
        reserved = next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmData"))
        resource.setrlimit(resource.RLIMIT_DATA, (reserved + memory_bytes, reserved + memory_bytes))


def parse_triangles(file_content: bytes, suffix: str) -> Floats:
    """Corners (m, 3, 3) of the m triangles in the bytes of a CAD file with this suffix.

    The unit is that of the file, or the metre for exact surfaces. Errors of the libraries are not caught.
    """
    import trimesh  # takes 0.3 s to import and is rarely needed

    if suffix in EXACT_SURFACE_SUFFIXES:
        import cascadio

        kind = cascadio.FileType.STEP if suffix in EXACT_SURFACE_SUFFIXES[:2] else cascadio.FileType.IGES
        file_content, suffix = (
            cascadio.to_glb_bytes(file_content, kind, tol_linear=MAX_TESSELLATION_DEVIATION_MM),
            ".glb",
        )
    mesh: Any = trimesh.load(
        BytesIO(file_content),
        file_type=suffix[1:],
        force="mesh",
        skip_materials=True,
        process=False,  # the caller merges equal corners
    )
    return np.asarray(mesh.triangles, dtype=np.float64)


@contextmanager
def without_library_output() -> Iterator[None]:
    """Context manager that discards the output of compiled libraries to standard output and standard error."""
    before = [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as nowhere:
        try:
            for number in (1, 2):
                os.dup2(nowhere.fileno(), number)
            yield
        finally:
            for number, stream in zip((1, 2), before, strict=True):
                os.dup2(stream, number)
                os.close(stream)
