"""Adjusted points for other programs: a table (CSV), a point cloud (PLY) or named markers (GLB, glTF in one file)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltsim.calibration.calibration import Calibration, targets_table
from ltsim.errors import RecordError
from ltsim.recording.files import write_text
from ltsim.units import MILLIMETRE

SUFFIXES = (".csv", ".ply", ".glb")
MARKER = 0.019
"""[m] Radius of a marker: a reflector of 1.5 inch."""


def write_points(calibration: Calibration, path: Path) -> None:
    """Write the adjusted targets, in the format that the suffix says.

    CSV is that of `targets.csv`; PLY holds millimetres in double precision with standard deviations and the names as
    comments; GLB holds one node a target, named, its place in metres (glTF knows no other unit) in double precision.
    Targets that the readings do not determine are left out.

    Raises
    ------
    RecordError
        When the suffix is another one, or the file cannot be written; nothing half-written stays behind.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RecordError(f"points are written as {', '.join(SUFFIXES)}: give a name that ends in one", file=path)
    if suffix == ".csv":
        table = targets_table(calibration.targets, calibration.points, calibration.target_covariance).csv()
        write_text(path, table)
    else:
        write_text(path, ply(calibration) if suffix == ".ply" else glb(calibration))


def ply(calibration: Calibration) -> bytes:
    """The points as an ASCII point cloud [mm]."""
    sigma = np.sqrt(np.einsum("tii->ti", calibration.target_covariance))
    known = np.flatnonzero(np.isfinite(sigma).all(axis=1))
    names = ["comment point " + " ".join([str(k), *calibration.targets[i].split()]) for k, i in enumerate(known)]
    fields = [f"property double {name}" for name in ("x", "y", "z", "sigma_x", "sigma_y", "sigma_z")]
    rows = np.concatenate([calibration.points, sigma], axis=1)[known] / MILLIMETRE
    head = ["ply", "format ascii 1.0", "comment unit mm", *names, f"element vertex {len(known)}", *fields, "end_header"]
    body = [" ".join(f"{value:.6f}" for value in row) for row in rows]
    return ("\n".join([*head, *body]) + "\n").encode()


def glb(calibration: Calibration) -> bytes:
    """The points as markers [m], one node a target; stations as boxes named ``station NAME``."""
    import trimesh  # it takes half a second to load, and only this needs it

    scene: Any = trimesh.Scene()
    ball, box = trimesh.creation.icosphere(1, MARKER), trimesh.creation.box([6 * MARKER] * 3)
    known = np.isfinite(calibration.target_covariance).all(axis=(1, 2))
    places = [(calibration.targets[i], calibration.points[i], "reflector", ball) for i in np.flatnonzero(known)]
    places += [(f"station {s.name}", s.position, "station", box) for s in calibration.stations]
    for name, place, kind, mesh in places:
        moved = np.eye(4)
        moved[:3, 3] = place
        scene.add_geometry(mesh, node_name=name, geom_name=kind, transform=moved)
    return scene.export(file_type="glb")
