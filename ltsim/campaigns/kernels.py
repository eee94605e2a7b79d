"""Compiled kernels: exact kinematic chain and network residuals for a block of trials.

The last index of all arrays is the trial (B), so that every inner loop is vectorised. A geometry value is one number
for all trials or an array (B); kernels are compiled for both. Small angles use power series (exact to rounding below
0.01 rad). All kernels are in one file because the compiler's cache depends only on the file of the compiled function.
"""

from pathlib import Path

import numpy as np

from ltsim.campaigns.compiled import compile_function, compile_inlined, trial_value
from ltsim.campaigns.program import ChainProgram
from ltsim.core.arrays import Floats, Ints

NEWTON_STEP_TOLERANCE = 1e-9
"""Step [m, rad] of Newton's method below which it ends; the remaining error is smaller by a factor of 1e-4."""
MAX_BATCH_NEWTON_STEPS = 8
"""Largest number of Newton steps of an inversion."""


@compile_inlined
def _add_small_angle(cosine: float, sine: float, small_angle: float) -> tuple[float, float]:
    """Cosine and sine of the sum of an angle and a small one."""
    square = small_angle * small_angle
    s = small_angle * (1.0 - square * (1.0 / 6.0) * (1.0 - square * (1.0 / 20.0)))
    c = 1.0 - square * 0.5 * (1.0 - square * (1.0 / 12.0) * (1.0 - square * (1.0 / 30.0)))
    return cosine * c - sine * s, sine * c + cosine * s


@compile_inlined
def _rotate_by_small_vector(u: float, v: float, w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Vector rotated by a small rotation vector (u, v, w), by Rodrigues' formula."""
    size = u * u + v * v + w * w
    a = 1.0 - size * (1.0 / 6.0) * (1.0 - size * (1.0 / 20.0))
    b = 0.5 - size * (1.0 / 24.0) * (1.0 - size * (1.0 / 30.0))
    cx, cy, cz = v * z - w * y, w * x - u * z, u * y - v * x
    return (x + a * cx + b * (v * cz - w * cy), y + a * cy + b * (w * cx - u * cz), z + a * cz + b * (u * cy - v * cx))


@compile_function
def _motion_amounts(pointing: int, chain: ChainProgram, deviation: Floats, values: Floats, amounts: Floats) -> None:
    """Deviation (M, B) of the amount of each motion at pointing i, for reading deviations (3, B) and values (p, B)."""
    _, _, sign, driven, _, first, fed, varies, basis, slope = chain
    trials = amounts.shape[1]
    for m in range(len(driven)):
        row = amounts[m]
        if driven[m] >= 0:
            moved = deviation[driven[m]]
            for t in range(trials):
                row[t] = moved[t]
        else:
            for t in range(trials):
                row[t] = 0.0
        for j in range(first[m], first[m + 1]):
            k = fed[j]
            value = values[k]
            b = basis[k, pointing]
            if varies[k] == 0:
                for t in range(trials):
                    row[t] += value[t] * trial_value(b, t)
            else:
                b0, b1, b2 = slope[k, pointing, 0], slope[k, pointing, 1], slope[k, pointing, 2]
                d0, d1, d2 = deviation[0], deviation[1], deviation[2]
                for t in range(trials):
                    row[t] += value[t] * (
                        trial_value(b, t)
                        + trial_value(b0, t) * d0[t]
                        + trial_value(b1, t) * d1[t]
                        + trial_value(b2, t) * d2[t]
                    )
        if sign[m] != 1.0:
            for t in range(trials):
                row[t] *= sign[m]


@compile_function
def _forward_chain(pointing: int, chain: ChainProgram, amounts: Floats, path: Floats) -> None:
    """Point carried from the target inwards: path[m] (3, B) is the point behind motion m, path[0] the result."""
    turns, axis, _, _, amount, _, _, _, _, _ = chain
    trials = amounts.shape[1]
    last = len(turns)
    for c in range(3):
        for t in range(trials):
            path[last, c, t] = 0.0
    for m in range(last - 1, -1, -1):
        a = axis[m]
        b, c = (a + 1) % 3, (a + 2) % 3
        delta = amounts[m]
        along, across, above = path[m + 1, a], path[m + 1, b], path[m + 1, c]
        along2, across2, above2 = path[m, a], path[m, b], path[m, c]
        if turns[m] == 0:
            fixed = amount[m, pointing, 0]
            for t in range(trials):
                along2[t] = along[t] + (trial_value(fixed, t) + delta[t])
                across2[t] = across[t]
                above2[t] = above[t]
        else:
            c0, s0 = amount[m, pointing, 0], amount[m, pointing, 1]
            for t in range(trials):
                cosine, sine = _add_small_angle(trial_value(c0, t), trial_value(s0, t), delta[t])
                along2[t] = along[t]
                across2[t] = cosine * across[t] - sine * above[t]
                above2[t] = sine * across[t] + cosine * above[t]


@compile_function
def _backpropagate(
    pointing: int,
    chain: ChainProgram,
    deviation: Floats,
    moved_points: Floats,
    path: Floats,
    force: Floats,
    pull: Floats,
    gradient: Floats,
) -> None:
    """Subtraction of the generalised forces of a force (3, B) on the point from the gradient (p, B) (virtual work)."""
    turns, axis, sign, _, amount, first, fed, varies, basis, slope = chain
    trials = moved_points.shape[1]
    for m in range(len(turns)):
        a = axis[m]
        b, c = (a + 1) % 3, (a + 2) % 3
        along, across, above = force[a], force[b], force[c]
        if first[m + 1] > first[m]:
            if turns[m] == 0:
                for t in range(trials):
                    pull[t] = sign[m] * along[t]
            else:
                p1, p2 = path[m, b], path[m, c]
                for t in range(trials):
                    pull[t] = sign[m] * (p1[t] * above[t] - p2[t] * across[t])
            for j in range(first[m], first[m + 1]):
                k = fed[j]
                row = gradient[k]
                b_ = basis[k, pointing]
                if varies[k] == 0:
                    for t in range(trials):
                        row[t] -= pull[t] * trial_value(b_, t)
                else:
                    b0, b1, b2 = slope[k, pointing, 0], slope[k, pointing, 1], slope[k, pointing, 2]
                    d0, d1, d2 = deviation[0], deviation[1], deviation[2]
                    for t in range(trials):
                        row[t] -= pull[t] * (
                            trial_value(b_, t)
                            + trial_value(b0, t) * d0[t]
                            + trial_value(b1, t) * d1[t]
                            + trial_value(b2, t) * d2[t]
                        )
        if turns[m] != 0:
            c0, s0 = amount[m, pointing, 0], amount[m, pointing, 1]
            delta = moved_points[m]
            for t in range(trials):
                cosine, sine = _add_small_angle(trial_value(c0, t), trial_value(s0, t), delta[t])
                f1, f2 = across[t], above[t]
                across[t] = cosine * f1 + sine * f2
                above[t] = cosine * f2 - sine * f1


@compile_function
def compute_points(chain: ChainProgram, instrument: Ints, deviation: Floats, values: Floats, points: Floats) -> None:
    """Points (n, 3, B) [m] in the instruments' frames for reading deviations (n, 3, B) and values (I, p, B)."""
    motions, trials = len(chain[0]), deviation.shape[2]
    moved, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    for i in range(len(deviation)):
        parameters = values[instrument[i]]
        _motion_amounts(i, chain, deviation[i], parameters, moved)
        _forward_chain(i, chain, moved, path)
        for c in range(3):
            for t in range(trials):
                points[i, c, t] = path[0, c, t]


@compile_function
def compute_readings(
    chain: ChainProgram, instrument: Ints, local_points: Floats, by_point: Floats, values: Floats, deviation: Floats
) -> None:
    """Reading deviations (n, 3, B) for which the chain reaches the points `local_points` (n, 3), by Newton's method.

    `deviation` holds the start and receives the result; `point_derivatives` (n, 3, 3) is the ideal derivative, so that
    each step reduces the residual by a factor of the size of the instrument's errors.
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    moved, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    for i in range(len(deviation)):
        parameters = values[instrument[i]]
        for _ in range(MAX_BATCH_NEWTON_STEPS):
            _motion_amounts(i, chain, deviation[i], parameters, moved)
            _forward_chain(i, chain, moved, path)
            x, y, z = path[0, 0], path[0, 1], path[0, 2]
            largest = 0.0
            for c in range(3):
                j0, j1, j2 = by_point[i, c, 0], by_point[i, c, 1], by_point[i, c, 2]
                l0, l1, l2 = local_points[i, 0], local_points[i, 1], local_points[i, 2]
                row = deviation[i, c]
                for t in range(trials):
                    step = (
                        trial_value(j0, t) * (trial_value(l0, t) - x[t])
                        + trial_value(j1, t) * (trial_value(l1, t) - y[t])
                        + trial_value(j2, t) * (trial_value(l2, t) - z[t])
                    )
                    row[t] += step
                    largest = max(largest, abs(step))
            if not largest > NEWTON_STEP_TOLERANCE:
                break


@compile_function
def backpropagate_mean_forces(
    chain: ChainProgram,
    instrument: Ints,
    owner: Ints,
    target: Ints,
    share: Floats,
    deviation: Floats,
    values: Floats,
    forces: Floats,
    by_values: Floats,
) -> None:
    """Subtraction of the generalised forces of forces on mean points from by_values (I, p, B).

    Each pointing contributes to the mean of its owner (n,) and target (n,) with a weight (n,); forces are (O, T, 3, B).
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    moved, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    force, pull = np.empty((3, trials)), np.empty(trials)
    for i in range(len(deviation)):
        tracker = instrument[i]
        _motion_amounts(i, chain, deviation[i], values[tracker], moved)
        _forward_chain(i, chain, moved, path)
        for c in range(3):
            for t in range(trials):
                force[c, t] = share[i] * forces[owner[i], target[i], c, t]
        _backpropagate(i, chain, deviation[i], moved, path, force, pull, by_values[tracker])


@compile_function
def network_gradient(
    chain: ChainProgram,
    instrument: Ints,
    station: Ints,
    target: Ints,
    arm: Floats,
    rotation: Floats,
    by_point: Floats,
    weight: Floats,
    deviation: Floats,
    pose: Floats,
    points: Floats,
    values: Floats,
    predicted: Floats,
    residual: Floats,
    by_pose: Floats,
    by_points: Floats,
    by_values: Floats,
    cost: Floats,
) -> None:
    """Whitened residuals (n, 3, B) at a state and their gradients; a step solves N step = gradient.

    The chain is followed at the *predicted* readings, never at the measured ones: a derivative taken at a reading
    with noise is correlated with that noise, which would bias the range scale by chi2 times its sigma (5e-4 sigma).

    Of the nominal state are `arm` (n, 3), target less station, `rotation` (S, 3, 3) and `point_derivatives` (n, 3, 3),
    the ideal derivative of the readings by the local point; `weight` (n, 3) is one over sigma, zero for a reading not
    measured.
    `deviation` (n, 3, B) is measured readings less nominal ones, and less the shifts of further effects; `predicted`
    (n, 3, B) predicted ones less nominal ones: it holds those of the last state and receives one Newton step to this
    one. `pose` (S, 6, B), `points` (T, 3, B) and `values` (I, p, B) are increments of the state; outputs are added to.
    """
    motions, trials = len(chain[0]), deviation.shape[2]
    moved, path = np.empty((motions, trials)), np.empty((motions + 1, 3, trials))
    force, pull, work = np.empty((3, trials)), np.empty(trials), np.empty((6, trials))
    for i in range(len(deviation)):
        parameters, s = values[instrument[i]], station[i]
        _motion_amounts(i, chain, predicted[i], parameters, moved)
        _forward_chain(i, chain, moved, path)
        _station_to_target(arm[i], rotation[s], pose[s], points[target[i]], path[0], work)
        _reading_force(by_point[i], weight[i], work, deviation[i], predicted[i], residual[i], force, cost)
        _add_forces(rotation[s], pose[s], work, force, by_pose[s], by_points[target[i]])
        _backpropagate(i, chain, predicted[i], moved, path, force, pull, by_values[instrument[i]])


@compile_function
def _station_to_target(
    arm: Floats, rotation: Floats, pose: Floats, point: Floats, predicted: Floats, scratch: Floats
) -> None:
    """Vector from station to target in the network frame, and its difference from the reached point.

    They go to the rows 0 to 2 and 3 to 5 of `scratch`. Loops over few rows each: only then are they vector
    instructions.
    """
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    a0, a1, a2 = arm[0], arm[1], arm[2]
    tx, ty, tz, wx, wy, wz = pose[0], pose[1], pose[2], pose[3], pose[4], pose[5]
    px, py, pz = point[0], point[1], point[2]
    qx, qy, qz = predicted[0], predicted[1], predicted[2]
    ax, ay, az, mx, my, mz = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4], scratch[5]
    for t in range(len(px)):
        x, y, z = (
            trial_value(a0, t) + px[t] - tx[t],
            trial_value(a1, t) + py[t] - ty[t],
            trial_value(a2, t) + pz[t] - tz[t],
        )
        bx, by, bz = _rotate_by_small_vector(-wx[t], -wy[t], -wz[t], x, y, z)
        ax[t], ay[t], az[t] = x, y, z
        mx[t] = (trial_value(r00, t) * bx + trial_value(r10, t) * by + trial_value(r20, t) * bz) - qx[t]
        my[t] = (trial_value(r01, t) * bx + trial_value(r11, t) * by + trial_value(r21, t) * bz) - qy[t]
        mz[t] = (trial_value(r02, t) * bx + trial_value(r12, t) * by + trial_value(r22, t) * bz) - qz[t]


@compile_function
def _reading_force(
    by_point: Floats,
    weight: Floats,
    scratch: Floats,
    observed: Floats,
    predicted: Floats,
    residual: Floats,
    force: Floats,
    cost: Floats,
) -> None:
    """Gradient of the cost with respect to the displacement of the target, from one reading of each trial.

    Residual and gradient (`force`) are written; the squared weighted residual is added to `cost`.
    """
    j00, j01, j02 = by_point[0, 0], by_point[0, 1], by_point[0, 2]
    j10, j11, j12 = by_point[1, 0], by_point[1, 1], by_point[1, 2]
    j20, j21, j22 = by_point[2, 0], by_point[2, 1], by_point[2, 2]
    w0, w1, w2 = weight[0], weight[1], weight[2]
    mx, my, mz = scratch[3], scratch[4], scratch[5]
    y0, y1, y2 = observed[0], observed[1], observed[2]
    f0, f1, f2 = predicted[0], predicted[1], predicted[2]
    e0, e1, e2 = residual[0], residual[1], residual[2]
    fx, fy, fz = force[0], force[1], force[2]
    for t in range(len(cost)):
        n0 = f0[t] + (trial_value(j00, t) * mx[t] + trial_value(j01, t) * my[t] + trial_value(j02, t) * mz[t])
        n1 = f1[t] + (trial_value(j10, t) * mx[t] + trial_value(j11, t) * my[t] + trial_value(j12, t) * mz[t])
        n2 = f2[t] + (trial_value(j20, t) * mx[t] + trial_value(j21, t) * my[t] + trial_value(j22, t) * mz[t])
        f0[t], f1[t], f2[t] = n0, n1, n2
        d0, d1, d2 = (
            trial_value(w0, t) * (y0[t] - n0),
            trial_value(w1, t) * (y1[t] - n1),
            trial_value(w2, t) * (y2[t] - n2),
        )
        e0[t], e1[t], e2[t] = d0, d1, d2
        cost[t] += d0 * d0 + d1 * d1 + d2 * d2
        d0, d1, d2 = trial_value(w0, t) * d0, trial_value(w1, t) * d1, trial_value(w2, t) * d2
        fx[t] = trial_value(j00, t) * d0 + trial_value(j10, t) * d1 + trial_value(j20, t) * d2
        fy[t] = trial_value(j01, t) * d0 + trial_value(j11, t) * d1 + trial_value(j21, t) * d2
        fz[t] = trial_value(j02, t) * d0 + trial_value(j12, t) * d1 + trial_value(j22, t) * d2


@compile_function
def _add_forces(
    rotation: Floats, pose: Floats, scratch: Floats, force: Floats, by_pose: Floats, by_target: Floats
) -> None:
    """Addition of the force to the gradients of target and station."""
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    wx, wy, wz, ax, ay, az = pose[3], pose[4], pose[5], scratch[0], scratch[1], scratch[2]
    fx, fy, fz = force[0], force[1], force[2]
    gx, gy, gz, hx, hy, hz = by_pose[0], by_pose[1], by_pose[2], by_pose[3], by_pose[4], by_pose[5]
    kx, ky, kz = by_target[0], by_target[1], by_target[2]
    for t in range(len(fx)):
        nx = trial_value(r00, t) * fx[t] + trial_value(r01, t) * fy[t] + trial_value(r02, t) * fz[t]
        ny = trial_value(r10, t) * fx[t] + trial_value(r11, t) * fy[t] + trial_value(r12, t) * fz[t]
        nz = trial_value(r20, t) * fx[t] + trial_value(r21, t) * fy[t] + trial_value(r22, t) * fz[t]
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


def is_compiled() -> bool:
    """True if the machine code of these kernels is in the cache of this installation."""
    place = getattr(getattr(network_gradient, "stats", None), "cache_path", None)
    return place is not None and any(Path(place).glob(f"kernels.{network_gradient.__name__}*.nbi"))
