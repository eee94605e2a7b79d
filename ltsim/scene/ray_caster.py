"""First triangle that a ray hits, computed in single precision by the library Embree (extra `cad`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltsim.core.arrays import Floats

EMBREE_SCENE_DIAGONAL = 100.0
"""Diagonal, in units of Embree, to which the box around all triangles is scaled; Embree's tolerances suit this size."""
MIN_INCIDENCE_COSINE = 1e-12
"""Limit of the cosine between a ray and the normal of a triangle. Below it the ray is parallel to the triangle and does
not hit it."""


@dataclass(frozen=True)
class RayCaster:
    """Triangles prepared for the library Embree, which finds the first triangle that a ray hits."""

    triangles: Floats
    """Corners (m, 3, 3) [m] of m triangles."""
    normals: Floats
    """Unit normals (m, 3) of m triangles; zero for a triangle without area."""
    low_corner: Floats
    """Smallest coordinates (3,) [m] of all triangles: origin of Embree's coordinates."""
    embree_units_per_metre: float
    """Number of Embree's units of length in a metre."""
    embree_scene: Any
    """Object of Embree with the scaled triangles."""

    @classmethod
    def from_triangles(cls, triangles: Floats, normals: Floats) -> RayCaster | None:
        """Ray caster for m triangles (m, 3, 3) [m] with unit normals (m, 3); None if Embree is not installed."""
        try:
            from embreex import rtcore_scene
            from embreex.mesh_construction import TriangleMesh
        except ImportError:
            return None
        low_corner, high_corner = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        extent = float(np.linalg.norm(high_corner - low_corner))
        scale = EMBREE_SCENE_DIAGONAL / extent if extent else 1.0
        scene = rtcore_scene.EmbreeScene()
        TriangleMesh(scene, vertices=((triangles - low_corner) * scale).astype(np.float32))
        return cls(triangles, normals, low_corner, scale, scene)

    def first_hit_distances(self, origins: Floats, directions: Floats) -> Floats:
        """Distances (n,) [m] from n origins (n, 3) along unit vectors (n, 3) to the first triangle; inf without hit.

        Embree determines the triangle; the distance to its plane is computed in double precision.
        """
        start = np.ascontiguousarray((origins - self.low_corner) * self.embree_units_per_metre, dtype=np.float32)
        triangle = np.asarray(self.embree_scene.run(start, np.ascontiguousarray(directions, dtype=np.float32)))
        ray = np.flatnonzero(triangle >= 0)
        normal, corner = self.normals[triangle[ray]], self.triangles[triangle[ray], 0]
        cosine = np.einsum("ij,ij->i", normal, directions[ray])
        height = np.einsum("ij,ij->i", normal, corner - origins[ray])
        distances = np.full(len(origins), np.inf)
        is_hit = np.abs(cosine) > MIN_INCIDENCE_COSINE
        distances[ray[is_hit]] = height[is_hit] / cosine[is_hit]
        return distances
