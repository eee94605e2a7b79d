"""Obstacles as triangle meshes: blocked lines of sight, positions inside bodies, positions of nests on surfaces.

The library Embree (extra `cad`) casts rays in single precision. Rays that pass close to an edge, for which its result
may be wrong, are cast again in double precision by this module. Without Embree this module casts all rays, which is
slow only for large CAD files. In a hall of boxes the rays of the library trimesh take 1.5 to 3.5 times as long.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b
from itertools import product

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.randomness import random_stream
from ltsim.geometry.rigid import perpendicular_vectors, rotation_about_z
from ltsim.scene.ray_caster import RayCaster

RAY_BUNDLE_RADIUS = 1e-4
"""Half-width [m] of a bundle of rays around a line of sight. If only some of these rays are blocked, the line passes
close to an edge and is tested again in double precision. Single precision has errors of 1e-6 m at 10 m."""
RAY_END_MARGIN = 1e-6
"""Length [m] at both ends of a ray that is not tested, so that a surface does not hide points on it."""
MAX_RAY_TRIANGLE_PAIRS = 2_000_000
"""Largest number of pairs of ray and triangle that are tested at a time, to limit the memory."""
INSIDE_TEST_RAY_DIRECTION = np.array([0.01234567, 0.02345678, 1.0]) / np.linalg.norm([0.01234567, 0.02345678, 1.0])
"""Direction of the upward rays that test whether a point is inside a body. It is slightly tilted, so that no ray runs
along an edge of an upright box."""
MAX_SMOOTH_SURFACE_ANGLE = np.radians(35.0)
"""Largest angle [rad] between the normals of adjacent triangles that approximate one curved surface."""
N_CYLINDER_SIDES = 64
"""Number of flat sides that represent a cylinder; their edges are 0.1 % of the radius outside it."""
NEST_FOOT_RADIUS = 0.025
"""Radius [m] of the foot of a nest."""
MAX_NEST_UNEVENNESS = 0.002
"""Largest permitted deviation [m] of a surface from a plane under the foot of a nest."""
MIN_NEST_NORMAL_Z = -0.5
"""Limit of the vertical component of the unit normal of a surface. Below it the surface faces down (60 deg or less from
straight down), and no nest is placed on it."""
N_RANDOM_POINTS_PER_NEST_AREA = 12.0
"""Number of random points drawn on a body for each area of a nest (smallest spacing of nests, squared). If points are
closer to each other than this spacing, only the first becomes a nest."""
MAX_RANDOM_SURFACE_POINTS = 20_000
"""Largest number of random points that are drawn on a body as possible positions of nests."""
CORNER_DECIMALS = 8
"""Number of decimals of coordinates [m] to which corners of triangles are rounded to merge equal corners."""
UNIT_CUBE_TRIANGLES = np.array(list(product((-0.5, 0.5), repeat=3)))[
    [1, 3, 0, 4, 1, 0, 0, 3, 2, 2, 4, 0, 1, 7, 3, 5, 1, 4, 5, 7, 1, 3, 7, 2, 6, 4, 2, 2, 7, 6, 6, 5, 4, 7, 5, 6]
].reshape(12, 3, 3)
"""Triangles (12, 3, 3) [m] of a cube of edge 1 m around the origin, with outward normals. Their order affects the
random points on a box."""


@dataclass(frozen=True)
class Obstacles:
    """Obstacles in the hall, as triangles in the network frame."""

    triangles: Floats
    """Corners (m, 3, 3) [m] of the m triangles of all bodies."""
    floor_height: float = 0.0
    """Height [m] of the floor on which tripods stand."""
    body_names_and_triangle_counts: tuple[tuple[str, int], ...] = ()
    """Name and number of triangles of each body, in the order of `triangles`; empty if the bodies have no names."""

    @cached_property
    def _ray_caster(self) -> RayCaster | None:
        """Ray caster of the library Embree; None if it is not installed, or if there are no triangles."""
        if not len(self.triangles):
            return None
        return RayCaster.from_triangles(self.triangles, _normals_and_areas(self.triangles)[0])

    def is_blocked(self, origins: Floats, end_points: Floats) -> Bools:
        """Flags (n,) of those of n straight lines, from origins to end points (n, 3) [m], that a triangle blocks.

        A line that touches an edge of a triangle is blocked.
        """
        hit = self._is_ray_blocked(origins, end_points)
        if self._ray_caster is None or not hit.size:
            return hit
        sight_lengths = np.linalg.norm(end_points - origins, axis=1)
        beam = (end_points - origins) / sight_lengths[:, None]
        side, other = (RAY_BUNDLE_RADIUS * way for way in perpendicular_vectors(beam))
        votes = [self._is_ray_blocked(origins + shift, end_points + shift) for shift in (side, -side, other, -other)]
        doubtful = np.flatnonzero(np.any(np.stack(votes) != hit, axis=0))
        hit[doubtful] = count_ray_hits(self.triangles, origins[doubtful], beam[doubtful], sight_lengths[doubtful]) > 0
        return hit

    def is_blocked_within_tolerance(self, origins: Floats, end_points: Floats, position_tolerance: float) -> Bools:
        """Flags (n,) of the end points (n, 3) [m] that a body may hide from an instrument not exactly at its origin.

        The instrument may be up to `position_tolerance` [m] from its origin (n, 3) [m]. Rays therefore start at the
        four corners of a square around the circle with this radius, perpendicular to the line of sight. The flag is set
        if any of the four rays is blocked.
        """
        sight = end_points - origins
        side, other = perpendicular_vectors(sight / np.linalg.norm(sight, axis=1, keepdims=True))
        hit = np.zeros(len(origins), dtype=bool)
        for across, up in product((-position_tolerance, position_tolerance), repeat=2):
            open_rows = np.flatnonzero(~hit)
            start = origins[open_rows] + across * side[open_rows] + up * other[open_rows]
            # At such a distance single precision is enough.
            hit[open_rows] = self._is_ray_blocked(start, end_points[open_rows])
        return hit

    def _is_ray_blocked(self, origins: Floats, end_points: Floats) -> Bools:
        """Flags (n,) of those of n straight lines, from origins to end points (n, 3) [m], that a triangle blocks.

        The precision is single with Embree, and double without it.
        """
        if not len(origins):
            return np.zeros(len(origins), dtype=bool)
        sight_lengths = np.linalg.norm(end_points - origins, axis=1)
        beam = (end_points - origins) / sight_lengths[:, None]
        if self._ray_caster is None:
            return np.asarray(count_ray_hits(self.triangles, origins, beam, sight_lengths) > 0)
        return self._ray_caster.first_hit_distances(origins, beam) < sight_lengths - RAY_BUNDLE_RADIUS

    def is_inside_body(self, points: Floats) -> Bools:
        """Flags (n,) of n points (n, 3) [m] inside a closed body: an upward ray crosses an odd number of triangles."""
        (west, south), (east, north) = self._triangle_bounding_rectangles
        flat = _plan_coordinates_along_test_ray(points)
        n_crossings = np.zeros(len(points), dtype=np.int64)
        step = max(1, MAX_RAY_TRIANGLE_PAIRS // max(len(self.triangles), 1))
        for start in range(0, len(points), step):
            x, y = flat[start : start + step].T[..., None]
            i, t = np.nonzero((west <= x) & (x <= east) & (south <= y) & (y <= north))
            met = _does_ray_hit_triangle(self.triangles[t], points[start + i], INSIDE_TEST_RAY_DIRECTION, np.inf)
            n_crossings[start : start + step] = np.bincount(i[met], minlength=len(x))
        return n_crossings % 2 == 1

    @cached_property
    def _triangle_bounding_rectangles(self) -> tuple[Floats, Floats]:
        """Smallest and largest x and y of m triangles, projected along the test rays: two arrays (2, m) [m]."""
        flat = _plan_coordinates_along_test_ray(self.triangles)
        return flat.min(axis=1).T - RAY_END_MARGIN, flat.max(axis=1).T + RAY_END_MARGIN

    @cached_property
    def _distances_to_curved_surface(self) -> Floats:
        """Largest distance (m,) [m] between each of m triangles and the curved surface that it approximates.

        It is the largest value, over the edges, of a third of the triangle's height over the edge times the angle to
        the adjacent triangle. This is exact for regular triangles on a sphere, and too large for strips on a cylinder.
        Sharp edges do not count.
        """
        points, place = np.unique(np.round(self.triangles.reshape(-1, 3), CORNER_DECIMALS), axis=0, return_inverse=True)
        faces = place.reshape(-1, 3)
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        _, kind, often = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(kind.ravel(), kind="stable")
        shared = order[often[kind.ravel()[order]] == 2].reshape(-1, 2)
        normal, area = _normals_and_areas(points[faces])
        angle = np.arccos(np.clip(_dot_products(*normal[shared // 3].transpose(1, 0, 2)), -1.0, 1.0))
        shared, angle = shared[angle < MAX_SMOOTH_SURFACE_ANGLE], angle[angle < MAX_SMOOTH_SURFACE_ANGLE]
        edge = np.linalg.norm(np.diff(points[edges[shared[:, 0]]], axis=1)[:, 0], axis=1)
        depth = np.zeros(len(faces))
        for side in (shared // 3).T:
            np.maximum.at(depth, side, 2.0 * area[side] * (angle / edge) / 3.0)
        return depth

    @cached_property
    def _moved_points_cache(self) -> dict[bytes, Floats]:
        """Cache of results of `moved_to_surface`, by the bytes of the array of points."""
        return {}

    def moved_to_surface(self, points: Floats) -> Floats:
        """Copy of n points (n, 3) [m] in which those slightly inside a body are moved just above its surface.

        A point is moved if its depth is below the distance between the triangle and the curved surface that the
        triangle approximates.
        """
        if (key := points.tobytes()) not in self._moved_points_cache:
            projected = points.copy()
            for i in np.flatnonzero(self.is_inside_body(points)):
                nearest = nearest_points_on_triangles(self.triangles, points[i])
                gap = np.linalg.norm(nearest - points[i], axis=1)
                best = int(gap.argmin())
                if RAY_END_MARGIN < gap[best] < self._distances_to_curved_surface[best] + RAY_BUNDLE_RADIUS:
                    projected[i] = nearest[best] + RAY_BUNDLE_RADIUS * (nearest[best] - points[i]) / gap[best]
            self._moved_points_cache[key] = projected
        return self._moved_points_cache[key]

    def is_setup_inside_body(self, points: Floats) -> Bools:
        """Flags (n,) of n instrument positions (n, 3) [m] with the instrument or its tripod inside a closed body."""
        if not len(self.triangles) or not len(points):
            return np.zeros(len(points), dtype=bool)
        feet = points.copy()
        feet[:, 2] = np.minimum(self.floor_height + RAY_BUNDLE_RADIUS, points[:, 2] - RAY_BUNDLE_RADIUS)
        return self.is_inside_body(points) | self.is_blocked(points, feet)

    def body_names_around(self, points: Floats, *, of_setups: bool = False) -> list[str]:
        """Names of the bodies that contain points (n, 3) [m] or, with `of_setups`, instruments there or tripods."""
        names, start = [], 0
        for name, n_triangles in self.body_names_and_triangle_counts:
            body = Obstacles(self.triangles[start : start + n_triangles], self.floor_height)
            start += n_triangles
            if (body.is_setup_inside_body(points) if of_setups else body.is_inside_body(points)).any():
                names.append(name)
        return names


def count_ray_hits(triangles: Floats, origins: Floats, ray_directions: Floats, ray_lengths: Floats) -> np.ndarray:
    """Number (n,) of triangles that each of n rays hits within its length, in double precision.

    `triangles` (m, 3, 3) [m] are m triangles. `ray_directions` (n, 3) are unit vectors, `ray_lengths` (n,) are in
    metres. A ray through an edge hits the triangle, a ray in its plane does not. Source: Moeller and Trumbore, Journal
    of Graphics Tools 2 (1997) 21-28.
    """
    n_hits = np.zeros(len(origins), dtype=np.int64)
    step = max(1, MAX_RAY_TRIANGLE_PAIRS // max(len(triangles), 1))
    for start in range(0, len(origins), step):
        rows = slice(start, start + step)
        met = _does_ray_hit_triangle(
            triangles, origins[rows, None], ray_directions[rows, None], ray_lengths[rows, None]
        )
        n_hits[rows] = met.sum(axis=1)
    return n_hits


def _does_ray_hit_triangle(triangles: Floats, origins: Floats, ray_directions: Floats, length: Floats | float) -> Bools:
    """Flags (...) of the rays that hit their triangle (..., 3, 3) [m] within `length` (...) [m].

    The leading dimensions pair rays with triangles. Rays have origins (..., 3) [m] and unit vectors (..., 3).
    """
    first, second, third = np.moveaxis(triangles, -2, 0)
    along, across = second - first, third - first
    edge_product = np.linalg.norm(along, axis=-1) * np.linalg.norm(across, axis=-1)
    cross = np.cross(ray_directions, across)
    determinant = _dot_products(cross, along)
    flat = np.abs(determinant) < 1e-12 * np.maximum(edge_product, 1e-300)
    inverse = 1.0 / np.where(flat, 1.0, determinant)
    gap = origins - first
    turned = np.cross(gap, along)
    u, v, way = (
        _dot_products(gap, cross) * inverse,
        _dot_products(ray_directions, turned) * inverse,
        _dot_products(turned, across) * inverse,
    )
    is_inside = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1.0 + 1e-12)
    return np.asarray(~flat & is_inside & (way > RAY_END_MARGIN) & (way < length - RAY_END_MARGIN))


def _normals_and_areas(triangles: Floats) -> tuple[Floats, Floats]:
    """Unit normals (m, 3) and areas (m,) [m2] of m triangles (m, 3, 3) [m]; zero normals for zero areas."""
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    cross_lengths = np.linalg.norm(cross, axis=1)
    return cross / np.where(cross_lengths > 0.0, cross_lengths, 1.0)[:, None], 0.5 * cross_lengths


def nearest_points_on_triangles(triangles: Floats, point: Floats) -> Floats:
    """Points (m, 3) [m] of m triangles (m, 3, 3) [m], edges included, that are nearest to `point` (3,) [m]."""
    edge, gap = np.roll(triangles, -1, axis=1) - triangles, point - triangles
    edge_fractions = np.clip(_dot_products(gap, edge) / np.maximum(_dot_products(edge, edge), 1e-300), 0.0, 1.0)
    on_edge = triangles + edge_fractions[..., None] * edge
    nearest_edge = np.linalg.norm(on_edge - point, axis=2).argmin(axis=1)
    normal, area = _normals_and_areas(triangles)
    is_over_interior = (_dot_products(np.cross(edge, gap), normal[:, None]) >= 0.0).all(axis=1) & (area > 0.0)
    under = point - _dot_products(gap[:, 0], normal)[:, None] * normal
    return np.where(is_over_interior[:, None], under, on_edge[np.arange(len(nearest_edge)), nearest_edge])


def _plan_coordinates_along_test_ray(points: Floats) -> Floats:
    """Coordinates x and y (..., 2) [m] of points (..., 3) projected along `INSIDE_TEST_RAY_DIRECTION` to z = 0."""
    return points[..., :2] - points[..., 2:] * INSIDE_TEST_RAY_DIRECTION[:2] / INSIDE_TEST_RAY_DIRECTION[2]


def _dot_products(first_vectors: Floats, second_vectors: Floats) -> Floats:
    """Dot products (...) of pairs of vectors (..., k)."""
    return np.asarray(np.einsum("...k,...k->...", first_vectors, second_vectors))


def rotate_and_shift_triangles(triangles: Floats, position: Floats, yaw: float) -> Floats:
    """Triangles (m, 3, 3) [m] turned counter-clockwise about z by `yaw` [rad], then shifted by `position` (3,) [m]."""
    return triangles @ rotation_about_z(yaw).T + position


def box_triangles(edge_lengths: Floats) -> Floats:
    """Triangles (12, 3, 3) [m] of a box with edges (3,) [m] along x, y, z, standing on z = 0 around the z axis."""
    return UNIT_CUBE_TRIANGLES * edge_lengths + [0.0, 0.0, 0.5 * edge_lengths[2]]


def cylinder_triangles(diameter: float, height: float) -> Floats:
    """Triangles (m, 3, 3) [m] of an upright cylinder that stands on z = 0 around the z axis; sizes in metres.

    The flat sides of the mesh touch the cylinder from outside.
    """
    radius, turn = (
        0.5 * diameter / np.cos(np.pi / N_CYLINDER_SIDES),
        np.linspace(0.0, 2.0 * np.pi, N_CYLINDER_SIDES + 1)[:-1],
    )
    low = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(N_CYLINDER_SIDES)])
    up, foot = np.array([0.0, 0.0, height]), np.zeros_like(low)
    then = np.roll(low, -1, axis=0)
    base, side, other_side = [low, foot, then], [low, then, low + up], [low + up, then, then + up]
    return np.stack([*base, *side, *other_side, low + up, then + up, foot + up], axis=1).reshape(-1, 3, 3)


def wall_triangles(hall_size: Floats) -> Floats:
    """Triangles (8, 3, 3) [m] of the walls of a hall of size (3,) [m] with a corner at the origin; inward normals."""
    body = (UNIT_CUBE_TRIANGLES + 0.5) * hall_size
    return body[np.ptp(body[..., 2], axis=1) > 0.0][:, ::-1]


def join_obstacles(triangle_sets: Iterable[Floats], *, body_names: Sequence[str] = ()) -> Obstacles:
    """Obstacles from several sets of m triangles, each (m, 3, 3) [m], above a floor at height zero.

    `body_names` are the names of the sets. If triangles and names are those of the latest call, its object is
    returned again. This saves memory: the ray caster takes 600 bytes per triangle, which only garbage collection frees.
    """
    parts = list(triangle_sets)
    triangles = np.concatenate([np.zeros((0, 3, 3)), *parts])
    body_names_and_triangle_counts = tuple(zip(body_names, map(len, parts), strict=True)) if body_names else ()
    key = blake2b(triangles.ravel().data).digest(), body_names_and_triangle_counts
    latest = _LATEST_OBSTACLES.get(key)
    if latest is None:
        triangles.flags.writeable = False
        latest = Obstacles(triangles, body_names_and_triangle_counts=body_names_and_triangle_counts)
        _LATEST_OBSTACLES.clear()
        _LATEST_OBSTACLES[key] = latest
    return latest


_LATEST_OBSTACLES: dict[tuple[bytes, tuple[tuple[str, int], ...]], Obstacles] = {}
"""Obstacles of the latest call of `join_obstacles`, by digest of the triangles, and bodies."""


def candidate_nest_positions(
    body_triangles: Floats,
    surface_offset: float,
    min_spacing: float,
    obstacles: Obstacles | None = None,
    *,
    is_closed: bool = True,
) -> Floats:
    """Possible positions (P, 3) [m] of reflector centres over the surface of a body with m triangles (m, 3, 3) [m].

    The centres are `surface_offset` [m] above the surface, at least `min_spacing` [m] from each other, and outside all
    bodies of `obstacles`. With `is_closed` the triangles enclose the body, and its outer side does not depend on the
    order of their corners. Otherwise the normals of the triangles define the outer side.
    """
    drawn, normal = _random_surface_points(body_triangles, min_spacing)
    surface = Obstacles(body_triangles)
    if is_closed:
        normal[surface.is_inside_body(drawn + surface_offset * normal)] *= -1.0
    places = drawn + surface_offset * normal
    is_valid = normal[:, 2] > MIN_NEST_NORMAL_Z
    is_valid &= ~(is_closed & surface.is_inside_body(places))
    if obstacles is not None:
        is_valid &= ~obstacles.is_inside_body(places)
    is_valid[is_valid] = _is_flat_enough(surface, places[is_valid], normal[is_valid], surface_offset)
    return _thinned_positions(places[is_valid], min_spacing)


def _random_surface_points(body_triangles: Floats, mean_spacing: float) -> tuple[Floats, Floats]:
    """Random points (n, 3) [m], uniform over the area of m triangles (m, 3, 3) [m], and surface normals (n, 3) there.

    Each area of `mean_spacing` [m] squared gets `N_RANDOM_POINTS_PER_NEST_AREA` points; n is at least 200 and at most
    `MAX_RANDOM_SURFACE_POINTS`.
    """
    normal, area = _normals_and_areas(body_triangles)
    rng = random_stream(0, "nests")
    n_points = int(
        np.clip(N_RANDOM_POINTS_PER_NEST_AREA * area.sum() / mean_spacing**2, 200, MAX_RANDOM_SURFACE_POINTS)
    )
    face = rng.choice(len(body_triangles), size=n_points, p=area / area.sum())
    root, share = np.sqrt(rng.random(n_points))[:, None], rng.random(n_points)[:, None]
    a, b, c = np.moveaxis(body_triangles[face], 1, 0)
    return (1 - root) * a + root * (1 - share) * b + root * share * c, normal[face]


def _is_flat_enough(body_surface: Obstacles, places: Floats, surface_normals: Floats, surface_offset: float) -> Bools:
    """Flags (n,) of those of n positions (n, 3) [m] under which a surface is flat enough for the foot of a nest.

    `surface_normals` (n, 3) are the surface normals under the positions, `surface_offset` [m] is the height of the
    positions above the surface.
    """
    side, other = perpendicular_vectors(surface_normals)
    is_flat = np.ones(len(places), dtype=bool)
    for shift in (side, -side, other, -other):
        foot_edge = places + NEST_FOOT_RADIUS * shift
        is_flat &= body_surface.is_blocked(
            foot_edge, foot_edge - (surface_offset + MAX_NEST_UNEVENNESS) * surface_normals
        )
        is_flat &= ~body_surface.is_blocked(
            foot_edge, foot_edge - (surface_offset - MAX_NEST_UNEVENNESS) * surface_normals
        )
    return is_flat


def _thinned_positions(places: Floats, min_spacing: float) -> Floats:
    """Positions among `places` (n, 3) [m], each at least `min_spacing` [m] from all earlier ones in the result."""
    chosen: list[int] = []
    for i, place in enumerate(places):
        if not chosen or np.linalg.norm(places[chosen] - place, axis=1).min() >= min_spacing:
            chosen.append(i)
    return places[chosen]
