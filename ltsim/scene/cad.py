"""Reader of CAD files: triangles in metres with z up, by the convention of each format.

glTF defines metres and y up. STEP and IGES files declare their unit. STL, OBJ and PLY declare nothing and are read in
millimetres with z up. The assumed unit and vertical axis are reported. If a body has an implausible size or position,
an error asks the user to declare unit and vertical axis.
"""

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import InputError, is_installed
from ltsim.core.limits import BYTES_PER_MIB, MAX_CAD_BYTES
from ltsim.core.storage import read_whole_file
from ltsim.core.units import SI_PER_UNIT
from ltsim.recordings.files import safe_excerpt
from ltsim.scene.cad_process import EXACT_SURFACE_SUFFIXES, FACET_SUFFIXES, read_triangles

GLTF_SUFFIXES = (".glb", ".gltf")
"""Suffixes of glTF files."""
CAD_SUFFIXES = (*FACET_SUFFIXES, *GLTF_SUFFIXES, *EXACT_SURFACE_SUFFIXES)
"""Suffixes of all CAD files that are read."""
UNIT_NAMES = {"mm": "millimetres", "m": "metres", "in": "inches"}
"""Full names of the units of CAD files, for messages."""
MAX_COORDINATE_SPACING_MM = 1.0
"""Spacing [mm] between neighbouring single-precision numbers at the position of a body, above which a CAD file is
refused because its coordinates are too coarse. Halls are planned to the millimetre, and lines of sight pass bodies at a
few centimetres.
"""
SINGLE_PRECISION_SUFFIXES = (".stl", *GLTF_SUFFIXES)
"""Suffixes of files whose coordinates may be in single precision."""
MIN_BODY_TO_HALL_LENGTH_RATIO = SI_PER_UNIT["mm"] / SI_PER_UNIT["in"]
"""Length of a body divided by the length of the hall, below which the unit of a CAD file is questioned: 1 / 25.4. A
body as long as the hall has this ratio if a file in inches is read in millimetres."""
MAX_BODY_OVERHANG = 0.05
"""Largest distance [m] by which a body may extend beyond the hall or below its floor."""
GRID_POINTS_PER_METRE = 1e5
"""Grid points per metre to which corners of triangles are rounded: a grid of 10 um. Single precision, as in STL and
glTF, has no finer resolution over 40 m.
"""
TRIANGLES_PER_BATCH = 1 << 16
"""Number of triangles whose corners are rounded to the grid at a time, to limit the memory for intermediate results."""
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation matrix from y up to z up: x stays, y becomes z, z becomes -y."""


@dataclass(frozen=True)
class CadFile:
    """Contents of a CAD file, with the unit and vertical axis used to read it."""

    path: Path
    """Path of the CAD file."""
    triangles: Floats
    """Corners of the m triangles of the body, (m, 3, 3) [m], z up."""
    unit: str
    """Unit in which coordinates were read, `mm`, `m` or `in`; empty for a format that declares its unit."""
    vertical_axis: str
    """Vertical axis of the coordinates in the file, `y` or `z`."""
    has_declared_unit: bool
    """True if the format of the file or the user declares the unit; False if the unit is assumed."""

    @property
    def interpretation_text(self) -> str:
        """Description for users of the unit and the vertical axis with which the file was read."""
        kind = self.path.suffix[1:].upper()
        unit = f"coordinates read as {UNIT_NAMES[self.unit]}" if self.unit else f"in the unit that {kind} declares"
        return f"{unit}, {self.vertical_axis} up"

    @property
    def triangles_with_other_vertical_axis(self) -> Floats:
        """The m triangles (m, 3, 3) [m] of the file, read with z in place of y as vertical axis, or the reverse."""
        return self.triangles @ (Y_UP_TO_Z_UP if self.vertical_axis == "y" else Y_UP_TO_Z_UP.T)


def read_mesh(path: Path, unit: str | None = None, vertical_axis: str | None = None) -> CadFile:
    """Contents of a CAD file, converted to metres with z up.

    `unit` (`mm`, `m`, `in`) and `vertical_axis` (`y`, `z`) replace the convention of the format. Raises InputError for
    a file that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix not in CAD_SUFFIXES:
        raise InputError(f"{path}: the suffix is '{path.suffix}', expected one of {', '.join(CAD_SUFFIXES)}")
    if suffix in EXACT_SURFACE_SUFFIXES and unit is not None:
        raise InputError(f"{path}: {suffix[1:].upper()} declares its own unit; leave out unit")
    file_axis = vertical_axis or ("y" if suffix in GLTF_SUFFIXES else "z")
    file_unit = "" if suffix in EXACT_SURFACE_SUFFIXES else unit or ("m" if suffix in GLTF_SUFFIXES else "mm")
    try:
        status = path.stat()
        if status.st_size > MAX_CAD_BYTES:
            raise InputError(f"{path}: is larger than {MAX_CAD_BYTES // BYTES_PER_MIB} MiB, the limit for reading")
        triangles = _read_triangles(path, status.st_mtime_ns, SI_PER_UNIT[file_unit or "m"], file_axis)
    except OSError as problem:
        raise InputError(f"{path}: cannot be read ({problem.strerror or 'not a usable file'})") from None
    return CadFile(path, triangles, file_unit, file_axis, suffix in EXACT_SURFACE_SUFFIXES or unit is not None)


@lru_cache(maxsize=8)
def _read_triangles(path: Path, _modification_time: int, metres_per_unit: float, vertical_axis: str) -> Floats:
    """The m triangles (m, 3, 3) [m], z up, of a CAD file of any format whose length unit is `metres_per_unit` [m].

    `_modification_time` is part of the cache key only, so that a changed file is read again.
    """
    triangles = _triangles_in_file_units(path, metres_per_unit)
    if triangles.shape[1:] != (3, 3):
        raise InputError(f"{path}: has points without three coordinates; export it again")
    batch_starts = range(0, len(triangles), TRIANGLES_PER_BATCH)
    corners = np.concatenate(
        [
            _grid_coordinates(metres_per_unit * triangles[start : start + TRIANGLES_PER_BATCH], vertical_axis)
            for start in batch_starts
        ]
    )
    del triangles  # each array of a large file takes a tenth of the permitted memory
    if not len(corners):
        raise InputError(
            f"{path}: has no triangle larger than {1e6 / GRID_POINTS_PER_METRE:g} um if its unit of length is "
            f"{metres_per_unit:g} m; set its unit, or export it again"
        )
    rounded_triangles: Floats = np.unique(corners, axis=0).reshape(-1, 3, 3) / GRID_POINTS_PER_METRE
    rounded_triangles.flags.writeable = False
    return rounded_triangles


def _grid_coordinates(triangles: Floats, vertical_axis: str) -> Ints:
    """Integer grid coordinates (k, 9) of the corners of the k non-degenerate triangles among m triangles (m, 3, 3) [m].

    A triangle is degenerate if two of its rounded corners coincide. Each triangle starts with its lexicographically
    first corner, so that equal triangles have equal rows.
    """
    corners = np.round(
        GRID_POINTS_PER_METRE * (triangles @ Y_UP_TO_Z_UP.T if vertical_axis == "y" else triangles)
    ).astype(np.int64)
    first_corner = np.lexsort(np.moveaxis(corners, 2, 0)[::-1], axis=1)[:, :1]
    corners = np.take_along_axis(corners, ((first_corner + np.arange(3)) % 3)[..., None], axis=1)
    is_complete = (corners != np.roll(corners, 1, axis=1)).any(axis=2).all(axis=1)
    return corners[is_complete].reshape(-1, 9)


def _triangles_in_file_units(path: Path, metres_per_unit: float) -> Floats:
    """The m triangles (m, 3, 3) in the axes and unit of a CAD file, or in metres for a format with exact surfaces.

    `metres_per_unit` is the length [m] of the file's unit. Raises InputError for a file that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in EXACT_SURFACE_SUFFIXES and not is_installed("cascadio"):
        raise InputError(
            f'{path}: has exact surfaces, which need the library cascadio: pip install "ltsim[step]", or export it '
            "from the CAD system as STL, OBJ or GLB"
        )
    if suffix == ".gltf" and (others := re.findall(rb'"uri"\s*:\s*"(?!data:)([^"]*)"', read_whole_file(path))):
        raise InputError(
            f"{path}: stores its surfaces in other files "
            f"({safe_excerpt(others[0].decode(errors='replace'))}); export it as "
            ".glb, or as .gltf with embedded data"
        )
    triangles = read_triangles(path)
    _require_precision(path, triangles, metres_per_unit)
    return triangles


def _require_precision(path: Path, triangles: Floats, metres_per_unit: float) -> None:
    """Check that single precision resolves the coordinates of m triangles (m, 3, 3) to `MAX_COORDINATE_SPACING_MM`.

    The unit of the coordinates is `metres_per_unit` [m]. Raises InputError if the resolution is coarser.
    """
    single_precision = triangles.astype(np.float32)
    if path.suffix.lower() not in SINGLE_PRECISION_SUFFIXES or not np.array_equal(single_precision, triangles):
        return
    step = float(np.spacing(np.abs(single_precision).max())) * metres_per_unit / SI_PER_UNIT["mm"]
    if step > MAX_COORDINATE_SPACING_MM:
        raise InputError(
            f"{path}: its coordinates are in single precision and reach {np.abs(triangles).max():.4g}, where their "
            f"resolution is {step:.4g} mm; export it with its origin near the body, or as OBJ"
        )


def extent_text(triangles: Floats) -> str:
    """Size of m triangles (m, 3, 3) [m] along x, y, z and the limits of their coordinates, as text for users."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    extents = " x ".join(f"{v:.3g}" for v in high - low)
    return (
        f"{extents} m, " + ", ".join(f"{k} {a:.2f} to {b:.2f}" for k, a, b in zip("xyz", low, high, strict=True)) + " m"
    )


def implausible_size_question(cad_file: CadFile, hall_size: Floats) -> str:
    """Message that asks for the unit of a CAD file whose body has an implausible size for a hall of size (3,) [m].

    The message is empty for a plausible size or a declared unit.
    """
    length, least, most = (
        np.ptp(cad_file.triangles, axis=(0, 1)),
        MIN_BODY_TO_HALL_LENGTH_RATIO * hall_size.max(),
        1.5 * hall_size.max(),
    )
    if cad_file.has_declared_unit or least <= length.max() <= most:
        return ""
    size_by_unit = {
        unit: length.max() * SI_PER_UNIT[unit] / SI_PER_UNIT[cad_file.unit]
        for unit in UNIT_NAMES
        if unit != cad_file.unit
    }
    fitting = [unit for unit, size in size_by_unit.items() if least <= size <= most] or list(size_by_unit)
    size, other = " x ".join(f"{v:.3g}" for v in length), " or ".join(f'"{unit}"' for unit in fitting)
    return (
        f"{cad_file.path}: is {size} m large if its coordinates are {UNIT_NAMES[cad_file.unit]}, a unit that it does "
        f'not declare; set unit = {other}, or unit = "{cad_file.unit}" if this is correct'
    )


def is_inside_hall(triangles: Floats, hall_size: Floats) -> bool:
    """True if m triangles (m, 3, 3) [m] lie within a hall of size (3,) [m] with a corner at the origin.

    They may extend beyond the hall by `MAX_BODY_OVERHANG`.
    """
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    return bool(np.all(low >= -MAX_BODY_OVERHANG) and np.all(high <= hall_size + MAX_BODY_OVERHANG))
