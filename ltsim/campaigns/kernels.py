"""Compiled functions for a batch of trials: exact kinematic chain, and residuals of the network.

The last axis of all arrays is the trial, so that every inner loop is vectorised. A quantity of the network geometry is
a number that all trials share, or an array (trials,). Small angles use power series, which are exact to rounding below
0.01 rad. All functions are in one file because the compiler's cache depends only on the file of the compiled function.
"""

from pathlib import Path

import numpy as np

from ltsim.campaigns.compilation import compile_function, compile_inlined, value_of_trial
from ltsim.campaigns.kinematic_chain import ChainArrays
from ltsim.core.arrays import Floats, Ints

NEWTON_STEP_TOLERANCE = 1e-9
"""Step [m, rad] at which Newton's method for the inversion of the kinematic chain ends; the remaining error is at most
1e-4 of the step."""
MAX_BATCH_NEWTON_STEPS = 8
"""Largest number of Newton steps for the inversion of the kinematic chain (readings from target positions)."""


@compile_inlined
def _add_small_angle(cosine: float, sine: float, small_angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle plus `small_angle` [rad], from the cosine and sine of the angle."""
    square = small_angle * small_angle
    s = small_angle * (1.0 - square * (1.0 / 6.0) * (1.0 - square * (1.0 / 20.0)))
    c = 1.0 - square * 0.5 * (1.0 - square * (1.0 / 12.0) * (1.0 - square * (1.0 / 30.0)))
    return cosine * c - sine * s, sine * c + cosine * s


@compile_inlined
def _rotate_by_small_vector(u: float, v: float, w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Vector (x, y, z) after rotation by the small rotation vector (u, v, w) [rad] (Rodrigues' formula)."""
    squared_angle = u * u + v * v + w * w
    a = 1.0 - squared_angle * (1.0 / 6.0) * (1.0 - squared_angle * (1.0 / 20.0))
    b = 0.5 - squared_angle * (1.0 / 24.0) * (1.0 - squared_angle * (1.0 / 30.0))
    cx, cy, cz = v * z - w * y, w * x - u * z, u * y - v * x
    return (x + a * cx + b * (v * cz - w * cy), y + a * cy + b * (w * cx - u * cz), z + a * cz + b * (u * cy - v * cx))


@compile_function
def _motion_amounts(
    pointing: int, chain: ChainArrays, deviation: Floats, parameter_values: Floats, amounts: Floats
) -> None:
    """Angle or length of each motion of the kinematic chain minus its nominal value, written to `amounts`.

    `amounts` (motions, trials) [rad, m] belongs to one pointing. `deviation` (3, trials) are its readings minus nominal
    readings, `parameter_values` (parameters, trials) [SI] the instrument parameters.
    """
    _, _, sign, reading_indices, _, parameter_offsets, parameter_indices, depends_on_readings, basis, slope = chain
    n_trials = amounts.shape[1]
    for m in range(len(reading_indices)):
        row = amounts[m]
        if reading_indices[m] >= 0:
            reading_deviation = deviation[reading_indices[m]]
            for t in range(n_trials):
                row[t] = reading_deviation[t]
        else:
            for t in range(n_trials):
                row[t] = 0.0
        for j in range(parameter_offsets[m], parameter_offsets[m + 1]):
            k = parameter_indices[j]
            value = parameter_values[k]
            b = basis[k, pointing]
            if depends_on_readings[k] == 0:
                for t in range(n_trials):
                    row[t] += value[t] * value_of_trial(b, t)
            else:
                b0, b1, b2 = slope[k, pointing, 0], slope[k, pointing, 1], slope[k, pointing, 2]
                d0, d1, d2 = deviation[0], deviation[1], deviation[2]
                for t in range(n_trials):
                    row[t] += value[t] * (
                        value_of_trial(b, t)
                        + value_of_trial(b0, t) * d0[t]
                        + value_of_trial(b1, t) * d1[t]
                        + value_of_trial(b2, t) * d2[t]
                    )
        if sign[m] != 1.0:
            for t in range(n_trials):
                row[t] *= sign[m]


@compile_function
def _forward_chain(pointing: int, chain: ChainArrays, amounts: Floats, path: Floats) -> None:
    """Measured point [m] in the frame before each motion of the chain, written to `path` (motions + 1, 3, trials).

    `amounts` (motions, trials) are the angle [rad] or length [m] of each motion minus its nominal value.
    """
    is_rotation, axis, _, _, amount, _, _, _, _, _ = chain
    n_trials = amounts.shape[1]
    n_motions = len(is_rotation)
    for c in range(3):
        for t in range(n_trials):
            path[n_motions, c, t] = 0.0
    for m in range(n_motions - 1, -1, -1):
        a = axis[m]
        b, c = (a + 1) % 3, (a + 2) % 3
        delta = amounts[m]
        along, across, above = path[m + 1, a], path[m + 1, b], path[m + 1, c]
        along2, across2, above2 = path[m, a], path[m, b], path[m, c]
        if is_rotation[m] == 0:
            fixed = amount[m, pointing, 0]
            for t in range(n_trials):
                along2[t] = along[t] + (value_of_trial(fixed, t) + delta[t])
                across2[t] = across[t]
                above2[t] = above[t]
        else:
            c0, s0 = amount[m, pointing, 0], amount[m, pointing, 1]
            for t in range(n_trials):
                cosine, sine = _add_small_angle(value_of_trial(c0, t), value_of_trial(s0, t), delta[t])
                along2[t] = along[t]
                across2[t] = cosine * across[t] - sine * above[t]
                above2[t] = sine * across[t] + cosine * above[t]


@compile_function
def _backpropagate(
    pointing: int,
    chain: ChainArrays,
    deviation: Floats,
    amounts: Floats,
    path: Floats,
    point_grad: Floats,
    moment: Floats,
    gradient: Floats,
) -> None:
    """Product of the point gradient `point_grad` and the derivative by each parameter, subtracted from `gradient`.

    `point_grad` (3, trials) is the derivative of an objective by the measured point of one pointing; it is changed in
    place. `amounts` and `path` are the results of `_motion_amounts` and `_forward_chain`; `moment` is memory for
    intermediate results.
    """
    is_rotation, axis, sign, _, amount, parameter_offsets, parameter_indices, depends_on_readings, basis, slope = chain
    n_trials = amounts.shape[1]
    for m in range(len(is_rotation)):
        a = axis[m]
        b, c = (a + 1) % 3, (a + 2) % 3
        along, across, above = point_grad[a], point_grad[b], point_grad[c]
        if parameter_offsets[m + 1] > parameter_offsets[m]:
            if is_rotation[m] == 0:
                for t in range(n_trials):
                    moment[t] = sign[m] * along[t]
            else:
                p1, p2 = path[m, b], path[m, c]
                for t in range(n_trials):
                    moment[t] = sign[m] * (p1[t] * above[t] - p2[t] * across[t])
            for j in range(parameter_offsets[m], parameter_offsets[m + 1]):
                k = parameter_indices[j]
                row = gradient[k]
                b_ = basis[k, pointing]
                if depends_on_readings[k] == 0:
                    for t in range(n_trials):
                        row[t] -= moment[t] * value_of_trial(b_, t)
                else:
                    b0, b1, b2 = slope[k, pointing, 0], slope[k, pointing, 1], slope[k, pointing, 2]
                    d0, d1, d2 = deviation[0], deviation[1], deviation[2]
                    for t in range(n_trials):
                        row[t] -= moment[t] * (
                            value_of_trial(b_, t)
                            + value_of_trial(b0, t) * d0[t]
                            + value_of_trial(b1, t) * d1[t]
                            + value_of_trial(b2, t) * d2[t]
                        )
        if is_rotation[m] != 0:
            c0, s0 = amount[m, pointing, 0], amount[m, pointing, 1]
            delta = amounts[m]
            for t in range(n_trials):
                cosine, sine = _add_small_angle(value_of_trial(c0, t), value_of_trial(s0, t), delta[t])
                f1, f2 = across[t], above[t]
                across[t] = cosine * f1 + sine * f2
                above[t] = cosine * f2 - sine * f1


@compile_function
def compute_points(chain: ChainArrays, instrument: Ints, deviation: Floats, values: Floats, points: Floats) -> None:
    """Measured points (pointings, 3, trials) [m] in instrument frames, written to `points`.

    `deviation` (pointings, 3, trials) are readings minus nominal readings, `values` (instruments, parameters, trials)
    [SI] the instrument parameters.
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    amounts, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    for i in range(len(deviation)):
        parameters = values[instrument[i]]
        _motion_amounts(i, chain, deviation[i], parameters, amounts)
        _forward_chain(i, chain, amounts, path)
        for c in range(3):
            for t in range(trials):
                points[i, c, t] = path[0, c, t]


@compile_function
def compute_readings(
    chain: ChainArrays,
    instrument: Ints,
    local_points: Floats,
    point_derivatives: Floats,
    parameter_values: Floats,
    deviation: Floats,
) -> None:
    """Readings minus nominal readings (pointings, 3, trials) at which the chain gives `local_points`, by Newton steps.

    `local_points` (pointings, 3) [m] are targets in instrument frames. `deviation` contains the start values and
    receives the result. `point_derivatives` (pointings, 3, 3) is the derivative of an ideal tracker's readings by the
    point. Each step multiplies the error by the size of the instrument's errors.
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    amounts, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    for i in range(len(deviation)):
        parameters = parameter_values[instrument[i]]
        for _ in range(MAX_BATCH_NEWTON_STEPS):
            _motion_amounts(i, chain, deviation[i], parameters, amounts)
            _forward_chain(i, chain, amounts, path)
            x, y, z = path[0, 0], path[0, 1], path[0, 2]
            largest = 0.0
            for c in range(3):
                j0, j1, j2 = point_derivatives[i, c, 0], point_derivatives[i, c, 1], point_derivatives[i, c, 2]
                l0, l1, l2 = local_points[i, 0], local_points[i, 1], local_points[i, 2]
                row = deviation[i, c]
                for t in range(trials):
                    step = (
                        value_of_trial(j0, t) * (value_of_trial(l0, t) - x[t])
                        + value_of_trial(j1, t) * (value_of_trial(l1, t) - y[t])
                        + value_of_trial(j2, t) * (value_of_trial(l2, t) - z[t])
                    )
                    row[t] += step
                    largest = max(largest, abs(step))
            if not largest > NEWTON_STEP_TOLERANCE:
                break


@compile_function
def backpropagate_mean_gradients(
    chain: ChainArrays, instrument: Ints, station_face_indices: Ints, target: Ints, mean_weights: Floats,
    deviation: Floats, parameter_values: Floats, mean_gradients: Floats, parameter_gradient: Floats
) -> None:  # fmt: skip
    """Negative gradient of an objective by the instrument parameters, added to `parameter_gradient`.

    `mean_gradients` (sets, targets, 3, trials) is the derivative by the mean point of each set (one station and face)
    and target. `mean_weights` (pointings,) are the weights of the pointings in these mean points,
    `station_face_indices` (pointings,) their sets. `deviation` (pointings, 3, trials) are readings minus nominal
    readings.
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    amounts, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    point_grad, moment = np.empty((3, trials)), np.empty(trials)
    for i in range(len(deviation)):
        tracker = instrument[i]
        _motion_amounts(i, chain, deviation[i], parameter_values[tracker], amounts)
        _forward_chain(i, chain, amounts, path)
        for c in range(3):
            for t in range(trials):
                point_grad[c, t] = mean_weights[i] * mean_gradients[station_face_indices[i], target[i], c, t]
        _backpropagate(i, chain, deviation[i], amounts, path, point_grad, moment, parameter_gradient[tracker])


@compile_function
def network_gradient(
    chain: ChainArrays, instrument: Ints, station: Ints, target: Ints, station_to_target: Floats, rotation: Floats,
    point_derivatives: Floats, weight: Floats, deviation: Floats, pose: Floats, points: Floats, values: Floats,
    predicted: Floats, residual: Floats, pose_gradient: Floats, target_gradient: Floats, parameter_gradient: Floats,
    cost: Floats
) -> None:  # fmt: skip
    """Whitened residuals (pointings, 3, trials) of readings, and negative gradients of half their sum of squares.

    The negative gradient is the right side of the normal equations. The chain is evaluated at the *predicted* readings,
    never at the measured ones. The derivative at a measured reading is correlated with its noise, which would bias the
    range scale by chi-square times its variance (5e-4 sigma).

    Nominal quantities: `station_to_target` (pointings, 3) vectors [m], `rotation` (stations, 3, 3) of the stations,
    `point_derivatives` (pointings, 3, 3) of an ideal tracker's readings by the target in the instrument's frame.
    `weight` (pointings, 3) is one over the standard deviation, zero for an unmeasured reading. `deviation` (pointings,
    3, trials) is measured minus nominal readings, without the changes by additional effects. `predicted` (pointings, 3,
    trials) is predicted minus nominal readings, improved here by one Newton step. `pose` (stations, 6, trials),
    `points` (targets, 3, trials) and `values` (instruments, parameters, trials) are unknowns minus nominal values.
    Gradients and sum of squares are added to the last four arguments.
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    amounts, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    point_grad, moment, work = np.empty((3, trials)), np.empty(trials), np.empty((6, trials))
    for i in range(len(deviation)):
        parameters, s = values[instrument[i]], station[i]
        _motion_amounts(i, chain, predicted[i], parameters, amounts)
        _forward_chain(i, chain, amounts, path)
        _station_to_target(station_to_target[i], rotation[s], pose[s], points[target[i]], path[0], work)
        _target_gradient(
            point_derivatives[i], weight[i], work, deviation[i], predicted[i], residual[i], point_grad, cost
        )
        _add_network_gradients(rotation[s], pose[s], work, point_grad, pose_gradient[s], target_gradient[target[i]])
        _backpropagate(i, chain, predicted[i], amounts, path, point_grad, moment, parameter_gradient[instrument[i]])


@compile_function
def _station_to_target(
    station_to_target: Floats, rotation: Floats, pose: Floats, point: Floats, predicted: Floats, work_rows: Floats
) -> None:
    """Vector from station to target, and its difference from the point `predicted` that the predicted readings give.

    The vector [m] is written to rows 0 to 2 of `work_rows` in the network frame, the difference to rows 3 to 5 in the
    instrument frame. `pose` (6, trials) and `point` (3, trials) are unknowns minus nominal values, `station_to_target`
    (3,) and `rotation` (3, 3) nominal values. Few rows are compiled to vector instructions.
    """
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    a0, a1, a2 = station_to_target[0], station_to_target[1], station_to_target[2]
    tx, ty, tz, wx, wy, wz = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]
    px, py, pz = point[0], point[1], point[2]
    qx, qy, qz = predicted[0], predicted[1], predicted[2]
    ax, ay, az, mx, my, mz = work_rows[0], work_rows[1], work_rows[2], work_rows[3], work_rows[4], work_rows[5]
    for t in range(len(px)):
        x, y, z = (
            value_of_trial(a0, t) + px[t] - tx[t],
            value_of_trial(a1, t) + py[t] - ty[t],
            value_of_trial(a2, t) + pz[t] - tz[t],
        )
        bx, by, bz = _rotate_by_small_vector(-wx[t], -wy[t], -wz[t], x, y, z)
        ax[t], ay[t], az[t] = x, y, z
        mx[t] = (value_of_trial(r00, t) * bx + value_of_trial(r10, t) * by + value_of_trial(r20, t) * bz) - qx[t]
        my[t] = (value_of_trial(r01, t) * bx + value_of_trial(r11, t) * by + value_of_trial(r21, t) * bz) - qy[t]
        mz[t] = (value_of_trial(r02, t) * bx + value_of_trial(r12, t) * by + value_of_trial(r22, t) * bz) - qz[t]


@compile_function
def _target_gradient(
    point_derivatives: Floats, weight: Floats, work_rows: Floats, observed: Floats, predicted: Floats,
    residual: Floats, point_grad: Floats, cost: Floats
) -> None:  # fmt: skip
    """Negative gradient by the target, from one pointing of each trial, written to `point_grad` (3, trials).

    Whitened residuals are written to `residual` (3, trials), and their squares are added to `cost` (trials,).
    `work_rows` is the result of `_station_to_target`; `observed` and `predicted` (3, trials) are minus nominal
    readings.
    """
    j00, j01, j02 = point_derivatives[0, 0], point_derivatives[0, 1], point_derivatives[0, 2]
    j10, j11, j12 = point_derivatives[1, 0], point_derivatives[1, 1], point_derivatives[1, 2]
    j20, j21, j22 = point_derivatives[2, 0], point_derivatives[2, 1], point_derivatives[2, 2]
    w0, w1, w2 = weight[0], weight[1], weight[2]
    mx, my, mz = work_rows[3], work_rows[4], work_rows[5]
    y0, y1, y2 = observed[0], observed[1], observed[2]
    f0, f1, f2 = predicted[0], predicted[1], predicted[2]
    e0, e1, e2 = residual[0], residual[1], residual[2]
    fx, fy, fz = point_grad[0], point_grad[1], point_grad[2]
    for t in range(len(cost)):
        n0 = f0[t] + (value_of_trial(j00, t) * mx[t] + value_of_trial(j01, t) * my[t] + value_of_trial(j02, t) * mz[t])
        n1 = f1[t] + (value_of_trial(j10, t) * mx[t] + value_of_trial(j11, t) * my[t] + value_of_trial(j12, t) * mz[t])
        n2 = f2[t] + (value_of_trial(j20, t) * mx[t] + value_of_trial(j21, t) * my[t] + value_of_trial(j22, t) * mz[t])
        f0[t], f1[t], f2[t] = n0, n1, n2
        d0, d1, d2 = (
            value_of_trial(w0, t) * (y0[t] - n0),
            value_of_trial(w1, t) * (y1[t] - n1),
            value_of_trial(w2, t) * (y2[t] - n2),
        )
        e0[t], e1[t], e2[t] = d0, d1, d2
        cost[t] += d0 * d0 + d1 * d1 + d2 * d2
        d0, d1, d2 = value_of_trial(w0, t) * d0, value_of_trial(w1, t) * d1, value_of_trial(w2, t) * d2
        fx[t] = value_of_trial(j00, t) * d0 + value_of_trial(j10, t) * d1 + value_of_trial(j20, t) * d2
        fy[t] = value_of_trial(j01, t) * d0 + value_of_trial(j11, t) * d1 + value_of_trial(j21, t) * d2
        fz[t] = value_of_trial(j02, t) * d0 + value_of_trial(j12, t) * d1 + value_of_trial(j22, t) * d2


@compile_function
def _add_network_gradients(
    rotation: Floats, pose: Floats, work_rows: Floats, grad: Floats, pose_gradient: Floats, target_gradient: Floats
) -> None:
    """Addition of a pointing's negative gradient `grad` (3, trials) to the gradients of its target and station.

    `work_rows` is the result of `_station_to_target` for this pointing, and `pose` (6, trials) the pose minus nominal.
    """
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    wx, wy, wz, ax, ay, az = pose[3], pose[4], pose[5], work_rows[0], work_rows[1], work_rows[2]
    fx, fy, fz = grad[0], grad[1], grad[2]
    gx, gy, gz = pose_gradient[0], pose_gradient[1], pose_gradient[2]
    hx, hy, hz = pose_gradient[3], pose_gradient[4], pose_gradient[5]
    kx, ky, kz = target_gradient[0], target_gradient[1], target_gradient[2]
    for t in range(len(fx)):
        nx = value_of_trial(r00, t) * fx[t] + value_of_trial(r01, t) * fy[t] + value_of_trial(r02, t) * fz[t]
        ny = value_of_trial(r10, t) * fx[t] + value_of_trial(r11, t) * fy[t] + value_of_trial(r12, t) * fz[t]
        nz = value_of_trial(r20, t) * fx[t] + value_of_trial(r21, t) * fy[t] + value_of_trial(r22, t) * fz[t]
        vx, vy, vz = _rotate_by_small_vector(wx[t], wy[t], wz[t], nx, ny, nz)
        kx[t] += vx
        ky[t] += vy
        kz[t] += vz
        gx[t] -= vx
        gy[t] -= vy
        gz[t] -= vz
        hx[t] += vy * az[t] - vz * ay[t]
        hy[t] += vz * ax[t] - vx * az[t]
        hz[t] += vx * ay[t] - vy * ax[t]


def has_cached_machine_code() -> bool:
    """True if the machine code of the functions of this module is in the cache of this installation."""
    place = getattr(getattr(network_gradient, "stats", None), "cache_path", None)
    return place is not None and any(Path(place).glob(f"kernels.{network_gradient.__name__}*.nbi"))
