"""Points and set-ups of a singular network that its observations do not determine, and how they can move."""

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.core.arrays import Bools, Floats
from ltsim.core.notation import names_text
from ltsim.core.rounding import NORMAL_EQUATIONS_TOLERANCE, SQRT_MACHINE_EPSILON
from ltsim.geometry.rigid import VERTICAL, rigid_motion_jacobian
from ltsim.physics.model.measurement import NetworkState
from ltsim.solve.design import MAX_DENSE_ENTRIES, to_dense
from ltsim.solve.gauss_newton import Solution, TerminationStatus

MIN_RELATIVE_EIGENVALUE = NORMAL_EQUATIONS_TOLERANCE * NORMAL_EQUATIONS_TOLERANCE
"""Limit of an eigenvalue of the normal matrix (columns of unit norm), divided by the largest eigenvalue. Below it, the
eigenvector is an undetermined combination of unknowns. The limit is the square of that for singular values of the
design matrix."""
MIN_RELATIVE_MOTION = float(np.sqrt(SQRT_MACHINE_EPSILON))
"""Limit of the motion of a point, divided by that of the farthest moving point. Points with a larger motion count as
undetermined; rounding errors of an eigenvector are smaller."""


def undetermined_points_sentence(problem: NetworkProblem, solution: Solution[NetworkState]) -> str:
    """Sentence on the points and set-ups that can move without a change of any observation; empty for none.

    The sentence is empty unless the system of the solution is singular, and for more unknowns than a dense normal
    matrix may have (`MAX_DENSE_ENTRIES`).
    """
    state, design = solution.x, solution.system.design
    if solution.status is not TerminationStatus.SINGULAR or design.shape[1] ** 2 > MAX_DENSE_ENTRIES:
        return ""
    null_vectors = _undetermined_combinations(np.asarray(to_dense(design)))
    if not null_vectors.shape[1]:
        return ""
    recording, unknowns = problem.model.recording, problem.unknowns
    point_motions, station_motions, rotations = (
        null_vectors[columns]
        for columns in (unknowns.target_columns, unknowns.pose_columns[:, :3], unknowns.pose_columns[:, 3:])
    )
    is_moving_target, is_moving_station = (_is_moving(m) for m in (point_motions, station_motions))
    is_rotating_station = _is_moving(rotations) & ~is_moving_station
    names = [
        *(name for name, moves in zip(recording.targets, is_moving_target, strict=True) if moves),
        *(name for name, moves in zip(recording.stations, is_moving_station, strict=True) if moves),
    ]
    rotating_names = [name for name, turns in zip(recording.stations, is_rotating_station, strict=True) if turns]
    texts = []
    if names:
        motion_text = ""
        if null_vectors.shape[1] == 1:
            places = np.concatenate([state.target_points, state.station_positions])
            motions = np.concatenate([point_motions, station_motions])[:, :, 0]
            is_moving = np.concatenate([is_moving_target, is_moving_station | is_rotating_station])
            motion_text = _common_motion_text(places[is_moving], motions[is_moving])
            if "rotate" in motion_text and len(rotating_names) == 1:
                motion_text = f"{motion_text.removesuffix(')')} through {rotating_names[0]})"
        texts.append(f"the positions of {names_text(list(dict.fromkeys(names)))}{motion_text}")
    if rotating_names:
        setups = "set-up" if len(rotating_names) == 1 else "set-ups"
        texts.append(f"the direction of {setups} {names_text(rotating_names)}")
    if not texts:
        return ""
    return (
        f"the observations with their declared noise do not determine {' and '.join(texts)}; measure common targets "
        "that connect them with the other points, or give further reference coordinates"
    )


def _undetermined_combinations(design: Floats) -> Floats:
    """Combinations (u, k) of u unknowns that change no observation, from the design matrix (m, u)."""
    norms = np.linalg.norm(design, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    scaled = design / norms
    eigenvalues, vectors = np.linalg.eigh(scaled.T @ scaled)
    return np.asarray(vectors[:, eigenvalues < MIN_RELATIVE_EIGENVALUE * eigenvalues[-1]] / norms[:, None])


def _is_moving(motions: Floats) -> Bools:
    """Flags (n,), True for those of n points that move with the combinations `motions` (n, 3, k) of unknowns."""
    sizes = np.linalg.norm(motions.reshape(len(motions), -1), axis=1)
    return np.asarray(sizes > MIN_RELATIVE_MOTION * max(float(sizes.max(initial=0.0)), np.finfo(float).tiny))


def _common_motion_text(places: Floats, motions: Floats) -> str:
    """Text, in brackets, on the rigid motion of n points (n, 3) [m] that have the `motions` (n, 3); otherwise empty."""
    centre = places.mean(axis=0)
    jacobian = rigid_motion_jacobian(places, centre).reshape(-1, 6)
    coefficients = np.linalg.lstsq(jacobian, motions.ravel(), rcond=NORMAL_EQUATIONS_TOLERANCE)[0]
    misfit = np.linalg.norm(jacobian @ coefficients - motions.ravel())
    if misfit > MIN_RELATIVE_MOTION**0.5 * np.linalg.norm(motions):
        return ""
    shift, rotation = coefficients[:3], coefficients[3:]
    extent = float(np.linalg.norm(places - centre, axis=1).max())
    if np.linalg.norm(rotation) * extent <= MIN_RELATIVE_MOTION * np.linalg.norm(shift) or extent == 0.0:
        return " (they can be shifted together)" if len(places) > 1 else ""
    is_vertical = abs(float(rotation @ VERTICAL)) > (1.0 - MIN_RELATIVE_MOTION) * float(np.linalg.norm(rotation))
    return f" (they can rotate together{' about a vertical axis' if is_vertical else ' about an axis'})"
