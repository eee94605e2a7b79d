"""Approximate coordinates by fits: a pose or point from any readings, networks of ranges alone, horizontal networks.

These fits are used if there is no closed-form solution, for example for directions without ranges or ranges without
directions. The fit of a pose or point is iterated from many start values at once, and the best solution is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from ltsim.adjustment.fit_readings import FitReadings
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import cross_matrix, matrix_from_rotation_vector, rotation_about_z
from ltsim.solve.gauss_newton import MAX_ITERATIONS

MAX_DISTANCE_OF_EQUAL_SOLUTIONS = 1e-3
"""Largest difference of equal solutions for a pose or point: distance / extent of points + norm of rotation change."""
MIN_UNIQUE_SOLUTION_RATIO = 4.0
"""Smallest ratio of two sums of squares, second-best to best solution, for which a pose or point counts as unique."""
MAX_RMS_RESIDUAL_SIGMAS = 300.0
"""Largest rms residual of a usable solution for a pose or point, in standard deviations of the readings."""
N_ITERATED_STARTS = 150
"""Number of start values of a pose or point that are iterated: those with the smallest sums of squared residuals."""
MAX_START_POINTS = 400
"""Largest number of start values in the fit of a point, limited because of the computing time."""
START_AZIMUTHS = np.arange(8) * np.pi / 4
"""Evenly spaced azimuths [rad], used as start values of yaws and of directions to a point."""
START_POLAR_COORDINATE_GRIDS = np.geomspace(0.3, 300.0, 12), START_AZIMUTHS, np.array([-1.0, -0.3, 0.3, 1.0])
"""Grids of start values for the unmeasured polar coordinates of a point: range [m], azimuth [rad], elevation [rad]."""
MIN_TARGETS_OF_RANGE_NETWORK = 10
"""Smallest number of targets of a network of ranges alone: `multilaterate` needs nine differences to one target."""

ResidualFunction = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Function that evaluates b trial solutions at once, from positions (b, 3) [m] and rotations (b, 3, 3). It returns the
residuals (b, m) of m readings and their derivatives (b, m, q) with respect to the q free unknowns.
"""


def fit_pose(
    fit_readings: FitReadings, points: Floats, *, is_levelled: bool = False, position: Floats | None = None
) -> tuple[Floats, Floats] | None:
    """Position (3,) [m] and rotation (3, 3) of a station from readings to known points; None if not unique.

    Parameters
    ----------
    fit_readings, points
        Readings of k pointings from the station, and the known points (k, 3) [m] to which they belong.
    is_levelled : bool
        True if the standing axis is vertical in the network.
    position : (3,) float, optional, [m]
        Position of the station, if known.
    """
    rows, fit_readings = fit_readings.select_evenly()
    points = points[rows] + fit_readings.sight_vector_offsets
    azimuth, elevation = (bool(np.isfinite(fit_readings.readings[:, i]).any()) for i in (1, 2))
    is_tilted = not is_levelled and (azimuth or elevation)
    slope = bool(np.isfinite(fit_readings.readings[~fit_readings.has_horizontal_distance, 0]).any())
    height_free = position is None and (slope or elevation or not is_levelled)
    is_free = np.array([position is None] * 2 + [height_free] + [is_tilted] * 2 + [azimuth])
    if fit_readings.n_readings < is_free.sum():
        return None
    places = _candidate_positions(points) if position is None else position[None]
    turns = _candidate_rotations(not is_tilted) if azimuth or is_tilted else np.eye(3)[None]
    places = places if height_free or position is not None else places[:-2]

    def evaluate(x: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        arm = points[None] - x[:, None]
        gap, by_local = fit_readings.residuals(arm @ rotation)
        turned = by_local @ np.swapaxes(rotation, 1, 2)
        by_turn = (turned.reshape(len(x), -1, 3, 3) @ cross_matrix(arm)).reshape(len(x), -1, 3)
        return gap, np.concatenate([-turned, by_turn], axis=2)[:, :, is_free]

    starts = np.repeat(places, len(turns), axis=0), np.tile(turns, (len(places), 1, 1))
    return _unique_solution(fit_readings.n_readings, points, _iterate_best_starts(evaluate, is_free, *starts))


def fit_point(fit_readings: FitReadings, position: Floats, rotation: Floats) -> Floats | None:
    """Point (3,) [m] from the readings of k pointings of stations with known poses; None if not unique.

    `position` (k, 3) [m] and `rotation` (k, 3, 3) are the pose of the station of each pointing.
    """
    rows, fit_readings = fit_readings.select_evenly()
    rotation, lifted = rotation[rows], position[rows] - fit_readings.sight_vector_offsets
    if fit_readings.n_readings < 3:
        return None

    def evaluate(x: Floats, _: Floats) -> tuple[Floats, Floats]:
        local_points = np.einsum("kji,bkj->bki", rotation, x[:, None] - lifted[None])
        gap, by_local = fit_readings.residuals(local_points)
        point_derivatives = by_local.reshape(len(x), -1, 3, 3) @ np.swapaxes(rotation, 1, 2)[None]
        return gap, point_derivatives.reshape(len(x), -1, 3)

    starts = _start_points(fit_readings.readings, lifted, rotation)
    is_free = np.arange(6) < 3
    solutions = _iterate_best_starts(evaluate, is_free, starts, np.tile(np.eye(3), (len(starts), 1, 1)))
    pose = _unique_solution(fit_readings.n_readings, lifted, solutions)
    return None if pose is None else pose[0]


def _unique_solution(
    n_readings: int, points: Floats, solutions: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats] | None:
    """Position (3,) [m] and rotation (3, 3) of the best solution; None if it fits poorly or is not unique.

    `n_readings` are fitted to known `points` (k, 3) [m], whose extent is the unit of differences between solutions.
    `solutions` of b fits are sums of squares (b,) in ascending order, positions (b, 3) [m], rotations (b, 3, 3).
    """
    cost, x, rotation = solutions
    if not cost[0] < MAX_RMS_RESIDUAL_SIGMAS**2 * n_readings:
        return None
    distance = np.linalg.norm(x - x[0], axis=1) / (1 + np.abs(points - x[0]).max())
    other_costs = cost[distance + np.linalg.norm(rotation - rotation[0], axis=(1, 2)) > MAX_DISTANCE_OF_EQUAL_SOLUTIONS]
    is_unique = not len(other_costs) or float(other_costs[0]) > MIN_UNIQUE_SOLUTION_RATIO * float(cost[0]) + n_readings
    return (x[0], rotation[0]) if is_unique else None


def _iterate_best_starts(
    evaluate: ResidualFunction, is_free_unknown: Bools, start_positions: Floats, rotation: Floats
) -> tuple[Floats, Floats, Floats]:
    """Sums of squares (b,) in ascending order, positions (b, 3) and rotations (b, 3, 3) of b iterated solutions.

    Levenberg-Marquardt iterations start at the best of s start values: `start_positions` (s, 3) [m] and `rotation`
    (s, 3, 3). `is_free_unknown` (6,) flags the components of translation and rotation that are estimated.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.argsort(_sum_of_squares(evaluate(start_positions, rotation)[0]))[:N_ITERATED_STARTS]
        best_starts = start_positions[best], rotation[best]
        here: tuple[Floats, ...] = (*best_starts, *evaluate(*best_starts))
        cost, damping = _sum_of_squares(here[2]), np.full(len(best), 1e-3)
        step = np.zeros((len(best), 6))
        for _ in range(MAX_ITERATIONS):
            start_positions, rotation, gap, by = here
            normal = np.nan_to_num(np.swapaxes(by, 1, 2) @ by, posinf=0.0)
            weight = np.maximum(damping, SQRT_MACHINE_EPSILON)[:, None] * np.einsum("bii->bi", normal) + 1e-9
            lifted = normal + weight[:, :, None] * np.eye(normal.shape[1])
            right = np.nan_to_num(np.einsum("bmi,bm->bi", by, gap), posinf=0.0)
            step[:, is_free_unknown] = np.linalg.solve(lifted, right[..., None])[..., 0]
            there = start_positions + step[:, :3], matrix_from_rotation_vector(step[:, 3:]) @ rotation
            ahead = *there, *evaluate(*there)
            new_cost = _sum_of_squares(ahead[2])
            better = new_cost < cost
            slow = ~better | (new_cost > cost * (1 - 1e-9))
            here = tuple(_replace_where_better(better, new, old) for new, old in zip(ahead, here, strict=True))
            cost = np.where(better, new_cost, cost)
            damping = np.where(better, damping / 5, np.minimum(damping * 5, 1e9))
            if np.all(slow & (~better | (damping < 1e-6)) & ((damping > 1e3) | (damping < 1e-6))):
                break
    order = np.argsort(cost)
    return cost[order], here[0][order], here[1][order]


def _sum_of_squares(residuals: Floats) -> Floats:
    """Sums of squares (b,) of residuals (b, m); infinite if a residual is NaN."""
    return np.nan_to_num(np.sum(residuals**2, axis=1), nan=np.inf)


def _replace_where_better(is_better: Bools, new_values: Floats, old_values: Floats) -> Floats:
    return np.where(is_better.reshape(-1, *[1] * (new_values.ndim - 1)), new_values, old_values)


def _candidate_positions(points: Floats) -> Floats:
    """Start positions (19, 3) [m] for the fit of a station, between and around its measured points (k, 3) [m]."""
    centre = points.mean(axis=0)
    radius = max(float(np.linalg.norm(points - centre, axis=1).max()), 1.0)
    circle = radius * np.stack([np.cos(START_AZIMUTHS), np.sin(START_AZIMUTHS), np.zeros(len(START_AZIMUTHS))], axis=1)
    axis_points = np.outer([-radius, radius], [0.0, 0.0, 1.0])
    return np.concatenate([[centre], centre + 0.4 * circle, centre + 1.5 * circle, centre + axis_points])


def _candidate_rotations(is_levelled: bool) -> Floats:
    """Start rotations for the fit of a station: eight yaws (8, 3, 3), times six tilts (48, 3, 3) if not levelled."""
    yaws = np.stack([rotation_about_z(a) for a in START_AZIMUTHS])
    if is_levelled:
        return yaws
    euler_quarters = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [2, 0, 0], [0, 1, 0], [0, -1, 0]])
    return np.concatenate([tilt @ yaws for tilt in matrix_from_rotation_vector(0.5 * np.pi * euler_quarters)])


def _start_points(readings: Floats, position: Floats, rotation: Floats) -> Floats:
    """Start points (s, 3) [m] for the fit of a point: along k beams, or on spheres around stations with ranges."""
    starts = []
    for reading, place, turn in zip(readings, position, rotation, strict=True):
        if np.isfinite(reading).any():
            ways = (
                [value] if np.isfinite(value) else guess
                for value, guess in zip(reading, START_POLAR_COORDINATE_GRIDS, strict=True)
            )
            starts.append(from_polar(np.array(list(product(*ways)))) @ turn.T + place)
    return np.concatenate(starts)[:MAX_START_POINTS]


def multilaterate(ranges: Floats) -> tuple[Floats, Floats] | None:
    """Coordinates (S, 3) [m] of S stations and (T, 3) [m] of T targets from the ranges (S, T) [m] between all of them.

    The result is None unless at least four stations, not coplanar, and ten targets exist. The network may be mirrored.

    Notes
    -----
    Squared ranges, minus those of the first station and of the first target, are scalar products of coordinates. Their
    matrix has rank three and gives stations and targets up to an affine transformation. The squared ranges from the
    first station are linear in the coefficients of this transformation.
    """
    if ranges.shape[0] < 4 or ranges.shape[1] < MIN_TARGETS_OF_RANGE_NETWORK:
        return None
    squares = ranges**2
    product = -0.5 * (squares - squares[:1] - squares[:, :1] + squares[0, 0])
    u, singular, right = np.linalg.svd(product)
    if singular[2] < 1e-6 * singular[0]:
        return None
    stations, targets = u[:, :3] * singular[:3], right[:3].T
    x, y, z = targets.T
    quadratic = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    solution = np.linalg.lstsq(quadratic[1:], (squares[0] - squares[0, 0])[1:], rcond=None)[0]
    metric = solution[[0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(3, 3)
    size, axes = np.linalg.eigh(metric)
    if size[0] <= 0:
        return None
    root = np.sqrt(size)[:, None] * axes.T
    shift = np.linalg.solve(root.T, solution[6:])
    return stations @ np.linalg.inv(root), targets @ root.T + shift


MIN_BEAM_PROJECTOR_EIGENVALUE = 1e-5
"""Limit of the smallest eigenvalue of the mean projector perpendicular to several beams. Beams with a smaller
eigenvalue count as parallel."""


def beam_intersection(origin: Floats, beam_directions: Floats) -> Floats | None:
    """Point (3,) [m] nearest to k beams from `origin` (k, 3) [m] along unit vectors (k, 3); None if parallel."""
    projector = np.eye(3) - beam_directions[:, :, None] * beam_directions[:, None, :]
    normal = projector.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < MIN_BEAM_PROJECTOR_EIGENVALUE * len(beam_directions):
        return None
    return np.linalg.solve(normal, np.einsum("kij,kj->i", projector, origin))


@dataclass(frozen=True)
class HorizontalLengths:
    """Measured horizontal lengths of k lines between points of a horizontal network."""

    start_indices: Ints
    """Index (k,) of the start point of each of k lines."""
    end_indices: Ints
    """Index (k,) of the end point of each of k lines."""
    lengths: Floats
    """Horizontal length of each of k lines, (k,) [m]."""


def fit_horizontal_network(
    setup_indices: Ints,
    start_indices: Ints,
    end_indices: Ints,
    azimuths: Floats,
    control_coordinates: Floats,
    lengths: HorizontalLengths,
) -> tuple[Floats, Floats, bool] | None:
    """Coordinates (P, 2) [m] of P points, and yaws (S,) [rad] of S set-ups, from horizontal directions and lengths.

    The points are set-ups and targets. The third result is True if the network is aligned to two or more known points;
    otherwise its x axis is azimuth zero of the first set-up. All results are None if shape or scale are undetermined.

    Parameters
    ----------
    setup_indices, start_indices, end_indices : (n,) int
        Indices of the (upright) set-up of each of n directions, of the point of this set-up, and of the target's point.
    azimuths : (n,) float, [rad]
        Reading of the horizontal circle of each direction.
    control_coordinates : (P, 2) float, [m]
        Known coordinates of the P points; NaN for unknown ones.
    lengths : HorizontalLengths
        Measured lengths. A length is used if the direction of its line was measured from at least one end.
    """
    yaw = _setup_yaws(setup_indices, start_indices, end_indices, azimuths)
    is_oriented = np.isfinite(yaw[setup_indices])
    bearing = (yaw[setup_indices] + azimuths)[is_oriented]
    used, at = np.unique(np.concatenate([start_indices[is_oriented], end_indices[is_oriented]]), return_inverse=True)
    first, second = at.reshape(2, -1)
    along, length = _measured_lengths_of_directions(lengths, start_indices[is_oriented], end_indices[is_oriented])
    has_control = np.isfinite(control_coordinates[used]).all(axis=1)
    if has_control.sum() < 2 and not len(along):
        return None
    shape = _complex_xy_coordinates(first, second, bearing, along, length, len(used))
    if shape is None:
        return None
    places, is_in_frame = np.full(control_coordinates.shape, np.nan), bool(has_control.sum() > 1)
    turned = 1.0 + 0.0j
    if is_in_frame:
        basis = np.stack([shape, np.ones(len(shape))], axis=1)
        fitted = np.linalg.lstsq(basis[has_control], control_coordinates[used][has_control] @ [1.0, 1j], rcond=None)[0]
        shape, turned = basis @ fitted, fitted[0]
    places[used] = np.stack([shape.real, shape.imag], axis=1)
    return places, yaw + float(np.angle(turned)), is_in_frame


def _measured_lengths_of_directions(lines: HorizontalLengths, starts: Ints, ends: Ints) -> tuple[Ints, Floats]:
    """Indices (k,) of those directions, `starts` to `ends`, whose line has a measured length, and lengths (k,) [m]."""
    lengths: dict[tuple[int, int], float] = {}
    for start_place, end_place, length in zip(
        lines.start_indices.tolist(), lines.end_indices.tolist(), lines.lengths.tolist(), strict=True
    ):
        lengths.setdefault((start_place, end_place), length)
        lengths.setdefault((end_place, start_place), length)
    measured_pairs = list(zip(starts.tolist(), ends.tolist(), strict=True))
    measured_indices = np.flatnonzero([pair in lengths for pair in measured_pairs])
    return measured_indices, np.array([lengths[measured_pairs[i]] for i in measured_indices])


def lines_of_undetermined_length(
    setup: Ints, starts: Ints, end_indices: Ints, azimuths: Floats, lines: HorizontalLengths
) -> list[tuple[int, int]]:
    """Lines (pairs of point indices) whose length is undetermined in a horizontal network, for a message to the user.

    The list is empty if the network is determined, if a set-up is not oriented, and if more than one length would have
    to be measured. The arguments are those of `fit_horizontal_network`.
    """
    yaw = _setup_yaws(setup, starts, end_indices, azimuths)
    is_oriented = np.isfinite(yaw[setup])
    used, at = np.unique(np.concatenate([starts[is_oriented], end_indices[is_oriented]]), return_inverse=True)
    first, second = at.reshape(2, -1)
    along, _ = _measured_lengths_of_directions(lines, starts[is_oriented], end_indices[is_oriented])
    _, size, right = np.linalg.svd(_xy_design(first, second, (yaw[setup] + azimuths)[is_oriented], along, len(used)))
    if (
        not len(along)
        or not is_oriented.all()
        or size[-1] >= NORMAL_EQUATIONS_TOLERANCE * size[0]
        or size[-2] < NORMAL_EQUATIONS_TOLERANCE * size[0]
    ):
        return []
    motion = np.concatenate([np.zeros((1, 2)), right[-1].reshape(-1, 2)])
    moves = np.linalg.norm(motion[second] - motion[first], axis=1)
    loose_indices = np.flatnonzero(moves > NORMAL_EQUATIONS_TOLERANCE * moves.max())
    ends = {
        (min(pair), max(pair))
        for pair in zip(used[first[loose_indices]].tolist(), used[second[loose_indices]].tolist(), strict=True)
    }
    return sorted(ends)


def _xy_design(start_indices: Ints, end_indices: Ints, bearings: Floats, length_rows: Ints, n_points: int) -> Floats:
    """Design matrix of the equations for x and y of `n_points` points; the first point is fixed at the origin.

    Each direction gives an equation across its bearing, and directions with a measured length (indices `length_rows`)
    a second one along the bearing. Zero rows are added so that there are at least as many rows as columns.
    """
    design = np.zeros((len(bearings) + len(length_rows), n_points, 2))
    transverse = np.stack([-np.sin(bearings), np.cos(bearings)], axis=1)
    radial = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)[length_rows]
    every, behind = np.arange(len(bearings)), len(bearings) + np.arange(len(length_rows))
    np.add.at(design, (every, end_indices), transverse)
    np.add.at(design, (every, start_indices), -transverse)
    np.add.at(design, (behind, end_indices[length_rows]), radial)
    np.add.at(design, (behind, start_indices[length_rows]), -radial)
    n_coordinates = 2 * (n_points - 1)
    return np.concatenate([design[:, 1:].reshape(-1, n_coordinates), np.zeros((n_coordinates, n_coordinates))])


def _complex_xy_coordinates(
    start_indices: Ints, end_indices: Ints, bearings: Floats, length_rows: Ints, lengths: Floats, n_points: int
) -> np.ndarray[tuple[int], np.dtype[np.complex128]] | None:
    """Horizontal coordinates of points as complex numbers x + iy, the first at 0; None if the shape is undetermined.

    The directions lead from `start_indices` to `end_indices` with `bearings` [rad], counter-clockwise from x.
    `length_rows` are those with a measured length, `lengths` [m] these lengths. Without lengths the scale is arbitrary.
    """
    design = _xy_design(start_indices, end_indices, bearings, length_rows, n_points)
    right_side = np.zeros(len(design))
    right_side[len(bearings) : len(bearings) + len(length_rows)] = lengths
    u, size, rows = np.linalg.svd(design, full_matrices=False)
    if size[-1 if len(length_rows) else -2] < NORMAL_EQUATIONS_TOLERANCE * size[0]:
        return None
    plan = rows.T @ ((u.T @ right_side) / size) if len(length_rows) else rows[-1]
    shape = np.concatenate([[0.0], plan.reshape(-1, 2) @ [1.0, 1j]])
    forward = np.real((shape[end_indices] - shape[start_indices]) * np.exp(-1j * bearings))
    return np.asarray(shape if np.sum(np.sign(forward)) > 0.0 else -shape)


def _setup_yaws(setup: Ints, starts: Ints, ends: Ints, azimuths: Floats) -> Floats:
    """Yaws (S,) [rad] of S set-ups relative to the first set-up; NaN for set-ups that are not connected to it.

    Two set-ups are connected if they measured the direction of one line, from the same end or from opposite ends.
    """
    yaw = np.full(setup.max() + 1, np.nan)
    yaw[setup[0]] = 0.0
    bearings: dict[tuple[int, int], float] = {}
    lines = list(zip(setup.tolist(), starts.tolist(), ends.tolist(), azimuths.tolist(), strict=True))
    before = -1
    while before < (before := len(bearings)):
        for s, start_place, end_place, turned in lines:
            if np.isnan(yaw[s]) and (start_place, end_place) in bearings:
                yaw[s] = bearings[start_place, end_place] - turned
            if np.isfinite(yaw[s]):
                bearings.setdefault((start_place, end_place), yaw[s] + turned)
                bearings.setdefault((end_place, start_place), yaw[s] + turned + np.pi)
    return yaw
