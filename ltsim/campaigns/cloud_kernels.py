"""Compiled functions on the measured points of many trials: means, rigid fits, disagreement, distance objective.

`ltsim.adjustment.evaluation` computes the same quantities for single recordings. The last axis of each array is the
trial. A rigid fit starts from frames that already agree within the size of the errors, so that three Newton steps for
the rotation reach rounding error. They replace a singular value decomposition.
"""

import numpy as np

from ltsim.campaigns.compilation import compile_function, value_of_trial
from ltsim.core.arrays import Bools, Floats, Ints

N_ROTATION_NEWTON_STEPS = 3
"""Number of Newton steps for the rotation of a rigid fit, which starts near its result."""
MICROMETRES_PER_METRE = 1e6
"""Number of micrometres in a metre, for disagreements of stations in um."""


@compile_function
def add_weighted_points(points: Floats, station: Ints, target: Ints, weights: Floats, clouds: Floats) -> None:
    """Addition of measured points (pointings, 3, trials), times weights (pointings,), to point clouds, in place.

    `clouds` (stations, targets, 3, trials) receives the mean point of each target as measured from each station (or
    other set of pointings). `station` and `target` (pointings,) are the indices of cloud and target of each point.
    """
    for i in range(len(points)):
        cloud = clouds[station[i], target[i]]
        for c in range(3):
            source, goal = points[i, c], cloud[c]
            for t in range(len(source)):
                goal[t] += weights[i] * source[t]


@compile_function
def transform_to_network(clouds: Floats, rotation: Floats, position: Floats) -> None:
    """Transformation of the points of each station from its instrument frame to the network frame, in place.

    `clouds` (stations, targets, 3, trials) [m] are the points. `rotation` (stations, 3, 3) and `position` (stations, 3)
    [m] are the nominal poses of the stations.
    """
    for s in range(len(clouds)):
        r, place = rotation[s], position[s]
        r00, r01, r02, p0 = r[0, 0], r[0, 1], r[0, 2], place[0]
        r10, r11, r12, p1 = r[1, 0], r[1, 1], r[1, 2], place[1]
        r20, r21, r22, p2 = r[2, 0], r[2, 1], r[2, 2], place[2]
        for k in range(clouds.shape[1]):
            x, y, z = clouds[s, k, 0], clouds[s, k, 1], clouds[s, k, 2]
            for t in range(len(x)):
                a, b, c = x[t], y[t], z[t]
                x[t] = (
                    value_of_trial(p0, t)
                    + value_of_trial(r00, t) * a
                    + value_of_trial(r01, t) * b
                    + value_of_trial(r02, t) * c
                )
                y[t] = (
                    value_of_trial(p1, t)
                    + value_of_trial(r10, t) * a
                    + value_of_trial(r11, t) * b
                    + value_of_trial(r12, t) * c
                )
                z[t] = (
                    value_of_trial(p2, t)
                    + value_of_trial(r20, t) * a
                    + value_of_trial(r21, t) * b
                    + value_of_trial(r22, t) * c
                )


@compile_function
def _centre_cloud(cloud: Floats, is_used_target: Bools, centred_cloud: Floats) -> None:
    """Points (targets, 3, trials) minus their mean over the used targets, written to `centred_cloud`."""
    centred_cloud[:] = 0.0
    n_points = 0
    for k in range(len(cloud)):
        if is_used_target[k]:
            n_points += 1
            for c in range(3):
                for t in range(centred_cloud.shape[1]):
                    centred_cloud[c, t] += cloud[k, c, t]
    for c in range(3):
        for t in range(centred_cloud.shape[1]):
            centred_cloud[c, t] /= n_points


@compile_function
def align_rigidly(cloud: Floats, reference_cloud: Floats, is_used_target: Bools, aligned_cloud: Floats) -> None:
    """Rigid least-squares alignment of points (targets, 3, trials) to `reference_cloud`, written to `aligned_cloud`.

    Only the targets in the mask `is_used_target` (targets,) are fitted.
    """
    trials = cloud.shape[2]
    middle, aim = np.empty((3, trials)), np.empty((3, trials))
    _centre_cloud(cloud, is_used_target, middle)
    _centre_cloud(reference_cloud, is_used_target, aim)
    k = np.zeros((3, 3, trials))
    for i in range(len(cloud)):
        if is_used_target[i]:
            for a in range(3):
                for b in range(3):
                    for t in range(trials):
                        k[a, b, t] += (cloud[i, a, t] - middle[a, t]) * (reference_cloud[i, b, t] - aim[b, t])
    turn, more = np.zeros((3, 3, trials)), np.empty((3, 3, trials))
    for a in range(3):
        turn[a, a, :] = 1.0
    for _ in range(N_ROTATION_NEWTON_STEPS):
        _rotation_step(k, more)
        _rotate_columns(more, k)
        _rotate_columns(more, turn)
    for i in range(len(cloud)):
        for a in range(3):
            for t in range(trials):
                x = cloud[i, 0, t] - middle[0, t]
                y = cloud[i, 1, t] - middle[1, t]
                z = cloud[i, 2, t] - middle[2, t]
                aligned_cloud[i, a, t] = aim[a, t] + (turn[a, 0, t] * x + turn[a, 1, t] * y + turn[a, 2, t] * z)


@compile_function
def _rotation_step(correlation: Floats, step: Floats) -> None:
    """Newton step (3, trials) of the rotation that maximises the trace of a correlation matrix, written to `step`.

    The correlation matrix (3, 3, trials) is the sum over the fitted targets of the outer product of a centred point and
    the centred reference point to which it is fitted.
    """
    for t in range(correlation.shape[2]):
        trace = correlation[0, 0, t] + correlation[1, 1, t] + correlation[2, 2, t]
        m00, m11, m22 = trace - correlation[0, 0, t], trace - correlation[1, 1, t], trace - correlation[2, 2, t]
        m01 = -0.5 * (correlation[0, 1, t] + correlation[1, 0, t])
        m02 = -0.5 * (correlation[0, 2, t] + correlation[2, 0, t])
        m12 = -0.5 * (correlation[1, 2, t] + correlation[2, 1, t])
        g0, g1, g2 = (
            correlation[1, 2, t] - correlation[2, 1, t],
            correlation[2, 0, t] - correlation[0, 2, t],
            correlation[0, 1, t] - correlation[1, 0, t],
        )
        c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        c11, c12, c22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
        scale = 1.0 / (m00 * c00 + m01 * c01 + m02 * c02)
        u = scale * (c00 * g0 + c01 * g1 + c02 * g2)
        v = scale * (c01 * g0 + c11 * g1 + c12 * g2)
        w = scale * (c02 * g0 + c12 * g1 + c22 * g2)
        size = u * u + v * v + w * w
        # The Cayley transform is a rotation for any angle, and equals the exponential map to third order.
        f = 1.0 / (1.0 + 0.25 * size)
        d = 1.0 - 0.25 * size
        step[0, 0, t] = f * (d + 0.5 * u * u)
        step[0, 1, t] = f * (0.5 * u * v - w)
        step[0, 2, t] = f * (0.5 * u * w + v)
        step[1, 0, t] = f * (0.5 * u * v + w)
        step[1, 1, t] = f * (d + 0.5 * v * v)
        step[1, 2, t] = f * (0.5 * v * w - u)
        step[2, 0, t] = f * (0.5 * u * w - v)
        step[2, 1, t] = f * (0.5 * v * w + u)
        step[2, 2, t] = f * (d + 0.5 * w * w)


@compile_function
def _rotate_columns(rotations: Floats, columns: Floats) -> None:
    """Product of a rotation matrix and a matrix in each trial, both (3, 3, trials), written to `columns`."""
    for b in range(3):
        for t in range(rotations.shape[2]):
            x, y, z = columns[0, b, t], columns[1, b, t], columns[2, b, t]
            columns[0, b, t] = rotations[0, 0, t] * x + rotations[0, 1, t] * y + rotations[0, 2, t] * z
            columns[1, b, t] = rotations[1, 0, t] * x + rotations[1, 1, t] * y + rotations[1, 2, t] * z
            columns[2, b, t] = rotations[2, 0, t] * x + rotations[2, 1, t] * y + rotations[2, 2, t] * z


@compile_function
def add_squared_errors(
    aligned_cloud: Floats, reference_cloud: Floats, is_used_target: Bools, square_sum: Floats
) -> int:
    """Number of targets in the mask `is_used_target`; their squared errors are added to `square_sum` (trials,).

    The error of a target is its distance between `aligned_cloud` and `reference_cloud`, both (targets, 3, trials) [m].
    """
    n_points = 0
    for i in range(len(aligned_cloud)):
        if is_used_target[i]:
            n_points += 1
            for c in range(3):
                for t in range(len(square_sum)):
                    gap = aligned_cloud[i, c, t] - reference_cloud[i, c, t]
                    square_sum[t] += gap * gap
    return n_points


@compile_function
def distance_criterion(clouds: Floats, is_visible: Bools, mean_criterion: Floats, max_criterion: Floats) -> None:
    """Disagreement of stations in distances [um] (Sensors 2021, 21, 7479): mean and maximum over pairs of targets.

    The distance of a pair of targets is measured from each station. Its disagreement is the mean absolute deviation
    from the mean over stations. Mean and maximum are written to `mean_criterion` and `max_criterion` (trials,).
    `clouds` (stations, targets, 3, trials) [m] are the points measured from each station, `is_visible` (stations,
    targets) is the mask of the measured targets.
    """
    stations, targets, _, trials = clouds.shape
    length, middle, spread = np.empty((stations, trials)), np.empty(trials), np.empty(trials)
    mean_criterion[:], max_criterion[:] = 0.0, 0.0
    n_pairs = 0
    for i in range(targets):
        for j in range(i + 1, targets):
            count = 0
            middle[:] = 0.0
            for s in range(stations):
                if is_visible[s, i] and is_visible[s, j]:
                    a, b, row = clouds[s, i], clouds[s, j], length[count]
                    count += 1
                    for t in range(trials):
                        x, y, z = a[0, t] - b[0, t], a[1, t] - b[1, t], a[2, t] - b[2, t]
                        row[t] = np.sqrt(x * x + y * y + z * z)
                        middle[t] += row[t]
            if count < 2:
                continue
            n_pairs += 1
            spread[:] = 0.0
            part = 1.0 / count
            for s in range(count):
                for t in range(trials):
                    spread[t] += abs(length[s, t] - part * middle[t])
            for t in range(trials):
                value = MICROMETRES_PER_METRE * part * spread[t]
                mean_criterion[t] += value
                max_criterion[t] = max(max_criterion[t], value)
    for t in range(trials):
        mean_criterion[t] /= n_pairs


@compile_function
def coordinate_criterion(
    aligned_clouds: Floats, is_visible: Bools, mean_criterion: Floats, max_criterion: Floats
) -> None:
    """Disagreement of stations in coordinates [um] (Sensors 2021, 21, 7479): mean and maximum over targets.

    The disagreement on a target is the mean distance between its positions from two stations, over all pairs of
    stations. Mean and maximum are written to `mean_criterion` and `max_criterion` (trials,). `aligned_clouds`
    (stations, targets, 3, trials) [m] are the points measured from each station, in one frame; `is_visible` (stations,
    targets) is the mask of the measured targets.
    """
    stations, targets, _, trials = aligned_clouds.shape
    spread = np.empty(trials)
    mean_criterion[:], max_criterion[:] = 0.0, 0.0
    n_used = 0
    for i in range(targets):
        count = 0
        spread[:] = 0.0
        for m in range(stations):
            for n in range(m + 1, stations):
                if is_visible[m, i] and is_visible[n, i]:
                    count += 1
                    a, b = aligned_clouds[m, i], aligned_clouds[n, i]
                    for t in range(trials):
                        x, y, z = a[0, t] - b[0, t], a[1, t] - b[1, t], a[2, t] - b[2, t]
                        spread[t] += np.sqrt(x * x + y * y + z * z)
        if count == 0:
            continue
        n_used += 1
        for t in range(trials):
            value = MICROMETRES_PER_METRE * spread[t] / count
            mean_criterion[t] += value
            max_criterion[t] = max(max_criterion[t], value)
    for t in range(trials):
        mean_criterion[t] /= n_used


@compile_function
def _add_distance_gradient(
    first_point: Floats,
    second_point: Floats,
    first_gradient: Floats,
    second_gradient: Floats,
    derivative_size: Floats,
    distance: Floats,
) -> None:
    """Addition of the contribution of one distance to the gradient of an objective, at both end points of the distance.

    `first_gradient` and `second_gradient` (3, trials) are the gradients by the end points. `derivative_size` (trials,)
    is the derivative of the objective by the distance between `first_point` and `second_point` (3, trials) [m].
    `distance` (trials,) [m] is this distance.
    """
    for c in range(3):
        for t in range(len(derivative_size)):
            part = derivative_size[t] / distance[t] * (first_point[c, t] - second_point[c, t])
            first_gradient[c, t] += part
            second_gradient[c, t] -= part


@compile_function
def _point_distances(first_point: Floats, second_point: Floats, distances: Floats) -> None:
    """Distances (trials,) [m] between two points (3, trials) in each trial, written to `distances`."""
    for t in range(len(distances)):
        x, y, z = (
            first_point[0, t] - second_point[0, t],
            first_point[1, t] - second_point[1, t],
            first_point[2, t] - second_point[2, t],
        )
        distances[t] = np.sqrt(x * x + y * y + z * z)


@compile_function
def _reference_length_index(gauge_pairs: Ints, first_target: int, second_target: int) -> int:
    """Index of the reference length between two targets in `gauge_pairs` (lengths, 2); -1 if they have none."""
    for g in range(len(gauge_pairs)):
        if (gauge_pairs[g, 0] == first_target and gauge_pairs[g, 1] == second_target) or (
            gauge_pairs[g, 0] == second_target and gauge_pairs[g, 1] == first_target
        ):
            return g
    return -1


@compile_function
def distance_gradient(
    clouds: Floats, is_visible: Bools, gauge_pairs: Ints, gauge_lengths: Floats, point_gradient: Floats, cost: Floats
) -> None:
    """Half of the derivative of the distance objective by the points, added to `point_gradient`.

    The objective is the sum of the squared differences between the distances of a pair of targets in two sets of
    pointings (one station and face each), and between each distance and its reference length.

    `clouds` (sets, targets, 3, trials) [m] are the mean points of each target in each set; `point_gradient` has the
    same shape. `is_visible` (sets, targets) is the mask of the measured targets. `gauge_lengths` (lengths, trials) [m]
    are the reference lengths between the pairs of targets `gauge_pairs` (lengths, 2). The value of the objective is
    added to `cost` (trials,).
    """
    sets, targets, _, trials = clouds.shape
    lengths, middle = np.empty((sets, trials)), np.empty(trials)
    distances = np.empty(trials)
    for i in range(targets):
        for j in range(i + 1, targets):
            count = 0
            middle[:] = 0.0
            for s in range(sets):
                if is_visible[s, i] and is_visible[s, j]:
                    _point_distances(clouds[s, i], clouds[s, j], lengths[s])
                    count += 1
                    for t in range(trials):
                        middle[t] += lengths[s, t]
            gauge_index = _reference_length_index(gauge_pairs, i, j)
            for s in range(sets):
                if not (is_visible[s, i] and is_visible[s, j]):
                    continue
                for t in range(trials):
                    gap = lengths[s, t] - middle[t] / count
                    distances[t] = count * gap
                    cost[t] += count * gap * gap
                if gauge_index >= 0:
                    for t in range(trials):
                        gap = lengths[s, t] - gauge_lengths[gauge_index, t]
                        distances[t] += gap
                        cost[t] += gap * gap
                _add_distance_gradient(
                    clouds[s, i], clouds[s, j], point_gradient[s, i], point_gradient[s, j], distances, lengths[s]
                )
