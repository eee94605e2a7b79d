"""Reader of CAD files: triangles in metres with z up.

Unit and vertical axis follow from the format, unless the user declares them. glTF defines metres and y up. STEP and
IGES files declare their unit. STL, OBJ and PLY declare nothing and are read in millimetres with z up. The assumed unit
and vertical axis are reported. If the size or position of a body is implausible, an error asks the user to declare
both.
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
"""Suffixes of all CAD files that can be read."""
UNIT_NAMES = {"mm": "millimetres", "m": "metres", "in": "inches"}
"""Full names of the units of CAD files, for messages."""
MAX_COORDINATE_SPACING_MM = 1.0
"""Limit of the spacing [mm] of single-precision numbers at the position of a body. Above it the CAD file is refused as
too coarse: halls are planned to the millimetre, and lines of sight pass bodies at a few centimetres."""
SINGLE_PRECISION_SUFFIXES = (".stl", *GLTF_SUFFIXES)
"""Suffixes of files whose coordinates may be single-precision numbers."""
MIN_BODY_TO_HALL_LENGTH_RATIO = SI_PER_UNIT["mm"] / SI_PER_UNIT["in"]
"""Limit of the length of a body, divided by the length of the hall. Below it an error asks for the unit of the CAD
file. It is 1 / 25.4: the ratio of a body as long as the hall if a file in inches is read in millimetres."""
MAX_BODY_OVERHANG = 0.05
"""Largest part [m] of a body that may be beyond the walls of the hall or below its floor."""
GRID_POINTS_PER_METRE = 1e5
"""Number of grid points per metre to which corners of triangles are rounded (a grid of 10 um). The single precision of
STL and glTF has no finer resolution over 40 m."""
TRIANGLES_PER_BATCH = 1 << 16
"""Number of triangles whose corners are rounded at a time, to limit the memory."""
Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation matrix from axes with y up to axes with z up: x stays, y becomes z, z becomes -y."""


@dataclass(frozen=True)
class CadFile:
    """Triangles of a CAD file, with the unit and the vertical axis with which the file was read."""

    path: Path
    """Path of the CAD file."""
    triangles: Floats
    """Corners (m, 3, 3) [m] of the m triangles of the body, z up."""
    unit: str
    """Unit of the coordinates in the file: `mm`, `m` or `in`; empty for a format that declares its unit."""
    vertical_axis: str
    """Vertical axis of the coordinates in the file: `y` or `z`."""
    has_declared_unit: bool
    """True if the format or the user declares the unit; False if it is assumed."""

    @property
    def interpretation_text(self) -> str:
        """Text for users on the unit and vertical axis with which the file was read."""
        kind = self.path.suffix[1:].upper()
        unit = f"coordinates read as {UNIT_NAMES[self.unit]}" if self.unit else f"in the unit that {kind} declares"
        return f"{unit}, {self.vertical_axis} up"

    @property
    def triangles_with_other_vertical_axis(self) -> Floats:
        """Corners (m, 3, 3) [m] of the m triangles for the other vertical axis: z in place of y, or y in place of z."""
        return self.triangles @ (Y_UP_TO_Z_UP if self.vertical_axis == "y" else Y_UP_TO_Z_UP.T)


def read_cad_file(path: Path, unit: str | None = None, vertical_axis: str | None = None) -> CadFile:
    """CAD file converted to metres with z up.

    `unit` (`mm`, `m`, `in`) and `vertical_axis` (`y`, `z`) replace the convention of the format. Raises InputError for
    a file that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix not in CAD_SUFFIXES:
        raise InputError(f"{path}: the suffix is '{path.suffix}', expected one of {', '.join(CAD_SUFFIXES)}")
    if suffix in EXACT_SURFACE_SUFFIXES and unit is not None:
        raise InputError(f"{path}: {suffix[1:].upper()} files declare their unit; give no other unit")
    file_axis = vertical_axis or ("y" if suffix in GLTF_SUFFIXES else "z")
    file_unit = "" if suffix in EXACT_SURFACE_SUFFIXES else unit or ("m" if suffix in GLTF_SUFFIXES else "mm")
    try:
        status = path.stat()
        if status.st_size > MAX_CAD_BYTES:
            raise InputError(
                f"{path}: the file is larger than {MAX_CAD_BYTES // BYTES_PER_MIB} MiB, the limit for reading"
            )
        triangles = _read_triangles(path, status.st_mtime_ns, SI_PER_UNIT[file_unit or "m"], file_axis)
    except OSError as problem:
        raise InputError(f"{path}: the file cannot be read ({problem.strerror or 'not a usable file'})") from None
    return CadFile(path, triangles, file_unit, file_axis, suffix in EXACT_SURFACE_SUFFIXES or unit is not None)


@lru_cache(maxsize=8)
def _read_triangles(path: Path, _modification_time: int, metres_per_unit: float, vertical_axis: str) -> Floats:
    """Corners (m, 3, 3) [m] of the m triangles, z up, of a CAD file whose unit has `metres_per_unit` [m].

    `_modification_time` only makes the cache read a changed file again.
    """
    triangles = _triangles_in_file_units(path, metres_per_unit)
    if triangles.shape[1:] != (3, 3):
        raise InputError(f"{path}: the file has points without three coordinates; export it again")
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
            f"{path}: the file has no triangle larger than {1e6 / GRID_POINTS_PER_METRE:g} um if its unit of length is "
            f"{metres_per_unit:g} m; set its unit, or export it again"
        )
    rounded_triangles: Floats = np.unique(corners, axis=0).reshape(-1, 3, 3) / GRID_POINTS_PER_METRE
    rounded_triangles.flags.writeable = False
    return rounded_triangles


def _grid_coordinates(triangles: Floats, vertical_axis: str) -> Ints:
    """Integer grid coordinates (k, 9) of the corners of the k triangles with three distinct corners on the grid.

    `triangles` (m, 3, 3) [m] are m triangles, some possibly degenerate. The corners of each result begin with the
    lexicographically first one, so that equal triangles have equal rows.
    """
    corners = np.round(
        GRID_POINTS_PER_METRE * (triangles @ Y_UP_TO_Z_UP.T if vertical_axis == "y" else triangles)
    ).astype(np.int64)
    first_corner = np.lexsort(np.moveaxis(corners, 2, 0)[::-1], axis=1)[:, :1]
    corners = np.take_along_axis(corners, ((first_corner + np.arange(3)) % 3)[..., None], axis=1)
    is_complete = (corners != np.roll(corners, 1, axis=1)).any(axis=2).all(axis=1)
    return corners[is_complete].reshape(-1, 9)


def _triangles_in_file_units(path: Path, metres_per_unit: float) -> Floats:
    """Corners (m, 3, 3) of the m triangles in the axes and unit of a CAD file; in metres for exact surfaces.

    `metres_per_unit` is the length [m] of the unit. Raises InputError for a file that cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in EXACT_SURFACE_SUFFIXES and not is_installed("cascadio"):
        raise InputError(
            f'{path}: the file has exact surfaces, which need the library cascadio: pip install "ltsim[step]", or '
            "export it from the CAD system as STL, OBJ or GLB"
        )
    if suffix == ".gltf" and (others := re.findall(rb'"uri"\s*:\s*"(?!data:)([^"]*)"', read_whole_file(path))):
        raise InputError(
            f"{path}: the file stores its surfaces in other files "
            f"({safe_excerpt(others[0].decode(errors='replace'))}); export it as "
            ".glb, or as .gltf with embedded data"
        )
    triangles = read_triangles(path)
    _require_single_precision(path, triangles, metres_per_unit)
    return triangles


def _require_single_precision(path: Path, triangles: Floats, metres_per_unit: float) -> None:
    """Check that single-precision coordinates of m triangles (m, 3, 3) have a spacing of at most 1 mm.

    `metres_per_unit` [m] is the unit of the coordinates. Raises InputError for a larger spacing
    (`MAX_COORDINATE_SPACING_MM`).
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
    """Text for users with the size along x, y, z and the limits of the coordinates of m triangles (m, 3, 3) [m]."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    extents = " x ".join(f"{v:.3g}" for v in high - low)
    return (
        f"{extents} m, " + ", ".join(f"{k} {a:.2f} to {b:.2f}" for k, a, b in zip("xyz", low, high, strict=True)) + " m"
    )


def implausible_size_question(cad_file: CadFile, hall_size: Floats) -> str:
    """Message that asks for the unit of a CAD file whose body is implausibly large or small for the hall.

    `hall_size` (3,) [m] is the size of the hall. The message is empty for a plausible size or a declared unit.
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
    """True if m triangles (m, 3, 3) [m] are inside a hall of size (3,) [m] with a corner at the origin.

    They may extend beyond it by `MAX_BODY_OVERHANG`.
    """
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    return bool(np.all(low >= -MAX_BODY_OVERHANG) and np.all(high <= hall_size + MAX_BODY_OVERHANG))
