"""Geometric features fitted to points by orthogonal least squares, for many sets of points at once.

Line and plane have closed solutions. Circle, sphere and cylinder need Gauss-Newton iterations from algebraic start
values. Arrays of points (..., points, 3) [m] may have any leading dimensions, for example the draws of a Monte Carlo
simulation.

References
----------
Forbes, Least-squares best-fit geometric elements, NPL report DITC 140/89 (1989).
Shakarji, J. Res. NIST 103 (1998) 633: objective functions and Gauss-Newton iterations of the same elements.
"""

from dataclasses import astuple, dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.core.errors import ModelError
from ltsim.solve.gauss_newton import MAX_ITERATIONS

FEATURE_STEP_TOLERANCE = 1e-11
"""Gauss-Newton step, relative to the extent of the points, at which the fit of a feature has converged."""
N_INITIAL_CYLINDER_AXES = 60
"""Number of initial directions for the axis of a cylinder, distributed over a half sphere."""


@dataclass(frozen=True)
class FittedFeature:
    """Line, plane, circle, sphere or cylinder fitted to points, with the deviations of the points from it."""

    reference_point: Floats
    """Point (..., 3) [m] of the feature: centre of a circle or sphere, or projection of the points' centroid onto the
    line, plane or cylinder axis."""
    direction: Floats
    """Unit vector (..., 3) along the line or cylinder axis, or normal to the plane or the plane of the circle; NaN for
    a sphere."""
    radius: Floats
    """Radius (...) [m] of a circle, sphere or cylinder; NaN for a line and a plane."""
    deviations: Floats
    """Signed orthogonal distance of each point from the feature, shape (..., points) [m]; unsigned for a line. For a
    circle the deviation is the radial or the axial one, whichever is larger."""


MIN_POINTS_BY_FEATURE = {"line": 2, "plane": 3, "circle": 3, "sphere": 4, "cylinder": 5}
"""Smallest number of points that determine each kind of feature."""


def fit_feature(feature_kind: str, points: Floats, start_feature: FittedFeature | None = None) -> FittedFeature:
    """Feature fitted to points (..., points, 3) [m] by least squares.

    `feature_kind` is `line`, `plane`, `circle`, `sphere` or `cylinder`. `start_feature` is an approximate feature;
    without it, a cylinder is fitted from many initial directions. Raises ModelError if the points do not determine the
    feature.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.shape[-2] < MIN_POINTS_BY_FEATURE[feature_kind]:
        raise ModelError(
            f"a {feature_kind} needs at least {MIN_POINTS_BY_FEATURE[feature_kind]} points, not {points.shape[-2]}"
        )
    middle = points.mean(axis=-2, keepdims=True)
    local = points - middle
    extent = np.sqrt(np.mean(np.sum(local**2, axis=-1), axis=-1))
    if not np.all(extent > 0):
        raise ModelError(f"the points of the {feature_kind} coincide")
    local = local / extent[..., None, None]
    place, scale = middle[..., 0, :], extent[..., None]
    if start_feature is not None:
        centre = (start_feature.reference_point - place) / scale
        start_feature = FittedFeature(
            centre,
            np.broadcast_to(start_feature.direction, centre.shape),
            start_feature.radius / extent,
            start_feature.deviations,
        )
    feature = _FIT_FUNCTION_BY_FEATURE[feature_kind](local, start_feature)
    return FittedFeature(
        feature.reference_point * scale + place, feature.direction, feature.radius * extent, feature.deviations * scale
    )


def _fit_line(centred_points: Floats, _start_feature: FittedFeature | None) -> FittedFeature:
    """Line through the origin along the first principal axis of centred points."""
    _, s, v = np.linalg.svd(centred_points, full_matrices=False)
    _require_determined("line", s[..., 0] - s[..., 1] > 1e-9 * s[..., 0], "do not define a direction")
    direction = v[..., 0, :]
    along = np.einsum("...ni,...i->...n", centred_points, direction)
    perpendicular_parts = centred_points - along[..., None] * direction[..., None, :]
    return _fitted_line_or_plane(direction, np.linalg.norm(perpendicular_parts, axis=-1))


def _fit_plane(centred_points: Floats, _start_feature: FittedFeature | None) -> FittedFeature:
    """Plane through the origin normal to the last principal axis of centred points."""
    _, s, v = np.linalg.svd(centred_points, full_matrices=False)
    _require_determined("plane", s[..., 1] > 1e-9 * s[..., 0], "lie on one line")
    normal = v[..., 2, :]
    return _fitted_line_or_plane(normal, np.einsum("...ni,...i->...n", centred_points, normal))


def _fitted_line_or_plane(unit_normal: Floats, deviations: Floats) -> FittedFeature:
    """Line or plane through the origin with the direction `unit_normal`, and deviations of the points from it."""
    return FittedFeature(np.zeros_like(unit_normal), unit_normal, np.full(unit_normal.shape[:-1], np.nan), deviations)


def _fit_sphere(centred_points: Floats, _start_feature: FittedFeature | None) -> FittedFeature:
    """Sphere by Gauss-Newton iterations from an algebraic fit."""
    centre, radius = _algebraic_fit(centred_points)
    for _ in range(MAX_ITERATIONS):
        arm = centred_points - centre[..., None, :]
        length = np.linalg.norm(arm, axis=-1)
        design = np.concatenate([-arm / length[..., None], -np.ones((*length.shape, 1))], axis=-1)
        step = _least_squares_step(design, length - radius[..., None], "sphere")
        centre, radius = centre + step[..., :3], radius + step[..., 3]
        if np.abs(step).max(initial=0.0) < FEATURE_STEP_TOLERANCE * (1 + np.abs(radius).max()):
            break
    deviations = np.linalg.norm(centred_points - centre[..., None, :], axis=-1) - radius[..., None]
    return FittedFeature(centre, np.full_like(centre, np.nan), radius, deviations)


def _fit_circle(centred_points: Floats, _start_feature: FittedFeature | None) -> FittedFeature:
    """Circle in space by Gauss-Newton iterations from an algebraic fit in the plane of the points."""
    normal = _fit_plane(centred_points, None).direction
    centre, radius = _projected_circle(centred_points, normal)
    for _ in range(MAX_ITERATIONS):
        (first, second), height, x, y = _axis_coordinates(centred_points, centre, normal)
        reach = np.hypot(x, y)
        c, s, zero = x / reach, y / reach, np.zeros_like(x)
        # A rotation (a, b) of the normal n gives n + a first + b second. It changes the height of a point by
        # a x + b y, and its distance from the axis by minus the height times (a x + b y) / distance.
        radial = np.stack([-c, -s, zero, -height * c, -height * s, -np.ones_like(x)], axis=-1)
        axial = np.stack([zero, zero, -np.ones_like(x), x, y, zero], axis=-1)
        gap = np.concatenate([reach - radius[..., None], height], axis=-1)
        step = _least_squares_step(np.concatenate([radial, axial], axis=-2), gap, "circle")
        shift = step[..., :1] * first + step[..., 1:2] * second + step[..., 2:3] * normal
        centre, radius = centre + shift, radius + step[..., 5]
        normal = _unit_vectors(normal + step[..., 3:4] * first + step[..., 4:5] * second)
        if np.abs(step).max(initial=0.0) < FEATURE_STEP_TOLERANCE * (1 + np.abs(radius).max()):
            break
    _, height, x, y = _axis_coordinates(centred_points, centre, normal)
    radial = np.hypot(x, y) - radius[..., None]
    return FittedFeature(centre, normal, radius, np.where(np.abs(radial) >= np.abs(height), radial, height))


def _fit_cylinder(centred_points: Floats, initial_feature: FittedFeature | None) -> FittedFeature:
    """Least-squares cylinder, from `initial_feature` or from the axis direction whose algebraic circle fits best."""
    if initial_feature is not None:
        return _refine_cylinder(
            centred_points, initial_feature.direction, initial_feature.reference_point, initial_feature.radius
        )
    features = []
    for points in centred_points.reshape(-1, *centred_points.shape[-2:]):
        axes = np.concatenate(
            [np.linalg.svd(points, full_matrices=False)[2], _half_sphere_directions(N_INITIAL_CYLINDER_AXES)]
        )
        many = np.broadcast_to(points, (len(axes), *points.shape))
        centre, radius = _projected_circle(many, axes, raises_if_undetermined=False)
        gap = np.hypot(*_axis_coordinates(many, centre, axes)[2:]) - radius[:, None]
        cost = np.where(np.isfinite(radius), np.sum(gap**2, axis=-1), np.inf)
        best = np.argsort(cost)[:6]
        tried = _refine_cylinder(many[best], axes[best], centre[best], radius[best], raises_if_undetermined=False)
        size = np.nan_to_num(np.sum(tried.deviations**2, axis=-1), nan=np.inf)
        k = int(np.argmin(size))
        _require_determined("cylinder", np.isfinite(size[k]), "determine no axis")
        features.append(
            FittedFeature(tried.reference_point[k], tried.direction[k], tried.radius[k], tried.deviations[k])
        )
    stacked_fields = (np.stack(part) for part in zip(*map(astuple, features), strict=True))
    return FittedFeature(*(part.reshape((*centred_points.shape[:-2], *part.shape[1:])) for part in stacked_fields))


def _refine_cylinder(
    centred_points: Floats,
    axis_direction: Floats,
    centre: Floats,
    radius: Floats,
    *,
    raises_if_undetermined: bool = True,
) -> FittedFeature:
    """Cylinder after Gauss-Newton iterations from an approximate axis direction, centre and radius.

    If the points do not determine it, the result is NaN, or ModelError is raised with `raises_if_undetermined`.
    """
    for _ in range(MAX_ITERATIONS):
        (first, second), along, x, y = _axis_coordinates(centred_points, centre, axis_direction)
        reach = np.maximum(np.hypot(x, y), 1e-300)
        c, s = x / reach, y / reach
        design = np.stack([-c, -s, -along * c, -along * s, -np.ones_like(x)], axis=-1)
        step = _least_squares_step(
            design, reach - radius[..., None], "cylinder", raises_if_undetermined=raises_if_undetermined
        )
        size = np.abs(step).max(axis=-1, keepdims=True)
        step = step / np.maximum(size / 0.3, 1.0)  # A poor start must not reverse the axis.
        centre = centre + step[..., :1] * first + step[..., 1:2] * second
        axis_direction = _unit_vectors(axis_direction + step[..., 2:3] * first + step[..., 3:4] * second)
        radius = radius + step[..., 4]
        if np.nanmax(size, initial=0.0) < FEATURE_STEP_TOLERANCE:
            break
    centre = centre - np.einsum("...i,...i->...", centre, axis_direction)[..., None] * axis_direction
    return FittedFeature(
        centre,
        axis_direction,
        radius,
        np.hypot(*_axis_coordinates(centred_points, centre, axis_direction)[2:]) - radius[..., None],
    )


def _axis_coordinates(
    centred_points: Floats, centre: Floats, axis_direction: Floats
) -> tuple[tuple[Floats, Floats], Floats, Floats, Floats]:
    """Two unit vectors (..., 3) perpendicular to an axis through `centre`, and coordinates of points in this system.

    The coordinates, each (..., points) [m], are the height along the axis and the coordinates along the two unit
    vectors.
    """
    sides = _perpendicular_vectors(axis_direction)
    arm = centred_points - centre[..., None, :]
    height, x, y = (np.einsum("...ni,...i->...n", arm, axis) for axis in (axis_direction, *sides))
    return sides, height, x, y


def _projected_circle(
    centred_points: Floats, axis_direction: Floats, *, raises_if_undetermined: bool = True
) -> tuple[Floats, Floats]:
    """Centre (..., 3) and radius (...) [m] of an algebraic circle through points that are projected along an axis.

    If the points do not determine it, the result is NaN, or ModelError is raised with `raises_if_undetermined`.
    """
    (first, second), _, x, y = _axis_coordinates(centred_points, np.zeros_like(axis_direction), axis_direction)
    middle, radius = _algebraic_fit(np.stack([x, y], axis=-1), raises_if_undetermined=raises_if_undetermined)
    return middle[..., :1] * first + middle[..., 1:] * second, radius


def _algebraic_fit(centred_points: Floats, *, raises_if_undetermined: bool = True) -> tuple[Floats, Floats]:
    """Centre (..., 2 or 3) and radius (...) [m] of a circle or sphere by linear least squares, without start values.

    Centre c and radius r minimise the sum over all points p of (|p - c|^2 - r^2)^2. If the points do not determine
    them, they are NaN, or ModelError is raised with `raises_if_undetermined`.
    """
    design = np.concatenate([2.0 * centred_points, np.ones((*centred_points.shape[:-1], 1))], axis=-1)
    squared_norms = np.sum(centred_points**2, axis=-1)
    solution = -_least_squares_step(
        design,
        squared_norms,
        "sphere" if centred_points.shape[-1] == 3 else "circle",
        raises_if_undetermined=raises_if_undetermined,
    )
    centre = solution[..., :-1]
    with np.errstate(invalid="ignore"):
        return centre, np.sqrt(solution[..., -1] + np.sum(centre**2, axis=-1))


def _least_squares_step(
    design: Floats, misclosure: Floats, feature_kind: str, *, raises_if_undetermined: bool = True
) -> Floats:
    """Least-squares step (..., unknowns) for a design matrix (..., rows, unknowns) and a misclosure (..., rows).

    If the design matrix is singular, the step is NaN, or ModelError is raised with `raises_if_undetermined`.
    """
    q, r = np.linalg.qr(design)
    pivots = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    is_determined = pivots.min(axis=-1) > 1e-10 * pivots.max(axis=-1)
    if raises_if_undetermined:
        _require_determined(feature_kind, is_determined, "do not determine it")
    r = np.where(is_determined[..., None, None], r, np.eye(r.shape[-1]))
    normal_right_side = -np.einsum("...mk,...m->...k", q, misclosure)
    step = np.linalg.solve(r, normal_right_side[..., None])[..., 0]
    return np.where(is_determined[..., None], step, np.nan)


def _require_determined(feature_kind: str, is_determined: Bools | np.bool_, reason: str) -> None:
    """Check that points determine a feature; raises ModelError with the `reason` if they do not."""
    if not np.all(is_determined):
        raise ModelError(f"the points of the {feature_kind} {reason}")


def _unit_vectors(vectors: Floats) -> Floats:
    """Vectors (..., 3) divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _perpendicular_vectors(unit_normal: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (..., 3) that form a right-handed frame with a normal and depend on it smoothly."""
    least = (
        np.argmin(np.abs(unit_normal.reshape(-1, 3)).mean(axis=0))
        if unit_normal.ndim > 1
        else int(np.argmin(np.abs(unit_normal)))
    )
    helper = np.eye(3)[least]
    parallel = np.abs(unit_normal @ helper)[..., None] > 0.95
    helper = np.where(parallel, np.eye(3)[(least + 1) % 3], helper)
    first_vector = _unit_vectors(np.cross(helper, unit_normal))
    return first_vector, np.cross(unit_normal, first_vector)


def _half_sphere_directions(n_directions: int) -> Floats:
    """Unit vectors (n_directions, 3) that are distributed evenly over a half sphere (Fibonacci spiral)."""
    i = np.arange(n_directions) + 0.5
    z = i / n_directions
    turn = i * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


_FIT_FUNCTION_BY_FEATURE = {
    "line": _fit_line,
    "plane": _fit_plane,
    "circle": _fit_circle,
    "sphere": _fit_sphere,
    "cylinder": _fit_cylinder,
}
"""Function that fits each kind of feature to centred points, with an approximate feature or None as second argument."""
