"""Datum of a network by inner constraints over selected points.

No observation determines the free rigid motions of a network. Inner constraints fix them: on average the selected
points do not move. If approximate coordinates of these points are declared, the network is first moved to them. With
this datum the covariance of the selected points has the smallest trace.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ltsim.adjustment.problem import NetworkProblem
from ltsim.adjustment.reference_values import ReferenceValue
from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.errors import ModelError, unknown_name_error
from ltsim.core.rounding import SQRT_MACHINE_EPSILON
from ltsim.core.units import MILLIMETRE
from ltsim.geometry.rigid import matrix_from_rotation_vector, rigid_motion_jacobian
from ltsim.physics.model.measurement import NetworkState
from ltsim.solve.design import NORMAL_RANK_TOLERANCE, scale_to_unit_diagonal
from ltsim.solve.elimination import FactorisedNormals
from ltsim.solve.gauss_newton import MAX_ITERATIONS, Solution, solve


@dataclass(frozen=True)
class DatumPoints:
    """Points that define the datum of a network, k in number."""

    coordinate_columns: Ints
    """Indices (k, 3) of the coordinates of the k points in the vector of unknowns."""
    points: Floats
    """Present coordinates (k, 3) [m] of the k points in the network."""
    approximate_points: Floats
    """Declared approximate coordinates (k, 3) [m] of the k points; NaN if not declared, or for coordinates outside the
    datum."""
    defines_datum: Bools
    """Flags (k, 3), True for those coordinates of the k points that define the datum."""

    @classmethod
    def from_names(cls, problem: NetworkProblem, state: NetworkState, names: Sequence[str]) -> DatumPoints:
        """Datum points `names`, which are targets or marks under set-ups; raises ModelError for an unknown name."""
        recording, unknowns, marks = problem.model.recording, problem.unknowns, problem.marks
        targets = {name: i for i, name in enumerate(recording.targets)}
        stations = {name: i for i, name in reversed(list(enumerate(marks.mark_names))) if name and name not in targets}
        columns, places, approximate, axes = [], [], [], []
        for name in names:
            if name in targets:
                columns.append(unknowns.target_columns[targets[name]])
                places.append(state.target_points[targets[name]])
            elif name in stations:
                columns.append(unknowns.pose_columns[stations[name], :3])
                places.append(state.station_positions[stations[name]] - marks.instrument_offsets[stations[name]])
            else:
                raise unknown_name_error("target of the datum", name, [*targets, *stations])
            setup = recording.target_setup(name)
            approximate.append(setup.approximate_mm or setup.known_mm or (np.nan,) * 3)
            axes.append([axis in setup.datum_axes for axis in "xyz"])
        counts = np.array(axes)
        goal = np.where(counts, np.array(approximate) * MILLIMETRE, np.nan)
        return cls(np.array(columns), np.array(places), goal, counts)


def selected_datum_names(problem: NetworkProblem) -> tuple[str, ...]:
    """Names of the measured targets and occupied marks that `setup.toml` selects for the datum (`datum = true`)."""
    recording = problem.model.recording
    valid_names = dict.fromkeys([*recording.targets, *filter(None, problem.marks.mark_names)])
    return tuple(name for name in valid_names if recording.target_setup(name).datum)


def move_to_datum(problem: NetworkProblem, state: NetworkState, names: Sequence[str]) -> tuple[NetworkState, float]:
    """State moved rigidly to the declared coordinates of the datum points `names`, and angle [rad] of the rotation.

    The angle is the sum over all iterations. If no observation determines the scale, the scale is adapted too, and the
    angle includes the relative change of scale.
    """
    rotation_angle = 0.0
    for _ in range(MAX_ITERATIONS):
        tied = DatumPoints.from_names(problem, state, names)
        has_goal = np.isfinite(tied.approximate_points)
        if not has_goal.any():
            break
        centre = tied.points[has_goal.any(axis=1)].mean(axis=0)
        free, grown = motions_about_centre(problem.free_motions, centre), _scale_displacement_function(problem)
        motion = np.hstack([rigid_motion_jacobian(tied.points, centre) @ free, grown(tied.points - centre)])[
            has_goal.ravel()
        ]
        gap = (tied.approximate_points - tied.points)[has_goal]
        amount = np.linalg.lstsq(motion, gap, rcond=1e-9)[0]
        shift, turn = (free @ amount[: free.shape[1]]).reshape(2, 3)
        rotation, more = matrix_from_rotation_vector(turn), amount[free.shape[1] :]
        position, points = (
            arm @ rotation.T + (grown(arm) @ more).reshape(-1, 3) + centre + shift
            for arm in (state.station_positions - centre, state.target_points - centre)
        )
        state = replace(
            state,
            station_positions=position,
            station_rotations=rotation @ state.station_rotations,
            target_points=points,
        )
        moved = float(np.linalg.norm([*turn, *more]))
        rotation_angle += moved
        if moved < 1e-12:
            break
    return state, rotation_angle


def solution_near_excluded_points(
    problem: NetworkProblem, solution: Solution[NetworkState], excluded_values: Sequence[ReferenceValue]
) -> Solution[NetworkState]:
    """Solution moved along the free motions of a problem as near as possible to excluded points.

    Without the excluded point, the remaining points may not define the frame: two points leave a rotation undetermined.
    A free motion is therefore chosen for which the misclosure of the excluded point is smallest. `excluded_values` are
    the excluded reference values of all kinds.
    """
    names = [value.name for value in excluded_values if value.kind == "point" and value.declared_axes == "xyz"]
    if not names or not problem.free_motions.shape[1]:
        return solution
    for _ in range(MAX_ITERATIONS):  # a finite motion is free only to first order: the other points are fitted again
        moved, rotation_angle = move_to_datum(problem, solution.x, names)
        solution = solve(problem, moved)
        if solution.factor is None or rotation_angle < SQRT_MACHINE_EPSILON:
            break
    return solution


@dataclass(frozen=True)
class InnerConstraintDatum:
    """S-transformation of covariances to a datum by inner constraints.

    The columns of G (u, f) are the free motions of u unknowns, B contains the rows of G of the datum points and zeros
    elsewhere. The covariance C becomes C' = S C S^T with S = I - G (B^T G)^-1 B^T. It is computed as
    C' = C - G U^T - U G^T + G M G^T from the matrices U (`motion_cross_covariance`) and M (`motion_covariance`).

    References
    ----------
    Baarda, S-transformations and criterion matrices (1973); Koch, Parameter Estimation and Hypothesis Testing
    in Linear Models (1999), 3.3.
    """

    free_motions: Floats
    """Matrix G, (u, f): changes of the u unknowns by the f rigid motions that no observation determines."""
    motion_cross_covariance: Floats
    """Covariance U = C B (G^T B)^-1, (u, f), of the u unknowns with the amounts of the f free motions. C (u, u) is the
    covariance of the unknowns, G (u, f) contains the free motions, B the rows of G of the datum points and zeros
    elsewhere."""
    motion_covariance: Floats
    """Covariance M = (B^T G)^-1 B^T C B (G^T B)^-1, (f, f), of the amounts of the f free motions. C (u, u) is the
    covariance of the u unknowns, G (u, f) contains the free motions, B the rows of G of the datum points and zeros
    elsewhere."""
    point_names: tuple[str, ...] = ()
    """Names of the datum points."""

    @classmethod
    def from_columns(
        cls, free_motions: Floats, columns: Ints, multiply_covariance: Callable[[Floats], Floats]
    ) -> InnerConstraintDatum:
        """Datum in which the unknowns with the indices `columns` fix the motions that no observation determines.

        `free_motions` (u, f) contains the changes of all u unknowns by the f free motions. `multiply_covariance`
        multiplies a matrix from the left by the covariance (u, u) of the unknowns. Raises ModelError if the selected
        unknowns do not fix the free motions.
        """
        constraints = np.zeros_like(free_motions)
        constraints[columns.ravel()] = free_motions[columns.ravel()]
        square = constraints.T @ free_motions
        if not np.linalg.eigvalsh(scale_to_unit_diagonal(square, np.diag(square))[0])[0] > NORMAL_RANK_TOLERANCE:
            raise ModelError("the given targets do not define a datum: choose at least three that are not on one line")
        inverse = np.linalg.inv(square)
        response = multiply_covariance(constraints)
        return cls(free_motions, response @ inverse.T, inverse @ (constraints.T @ response) @ inverse.T)

    @classmethod
    def from_points(
        cls, problem: NetworkProblem, state: NetworkState, normal_equations: FactorisedNormals, names: Sequence[str]
    ) -> InnerConstraintDatum | None:
        """Datum defined by the points `names` of a network; None if the observations determine all rigid motions.

        Raises ModelError if these points do not fix the motions that no observation determines.
        """
        if not problem.free_motions.shape[1]:
            return None
        tied, unknowns = DatumPoints.from_names(problem, state, names), problem.unknowns
        centre = tied.points.mean(axis=0)
        free, grown = motions_about_centre(problem.free_motions, centre), _scale_displacement_function(problem)
        turn = np.hstack([free[3:], np.zeros((3, len(problem.undetermined_unknowns.scale_defining_target)))])
        motion = np.zeros((unknowns.n_columns, turn.shape[1]))
        motion[unknowns.pose_columns[:, 3:].ravel()] = np.tile(turn, (len(unknowns.pose_columns), 1))
        for columns, places in (
            (unknowns.target_columns, state.target_points),
            (unknowns.pose_columns[:, :3], state.station_positions),
        ):
            motion[columns.ravel()] = np.hstack([rigid_motion_jacobian(places, centre) @ free, grown(places - centre)])
        return replace(
            cls.from_columns(
                motion, tied.coordinate_columns[tied.defines_datum], normal_equations.multiply_by_covariance
            ),
            point_names=tuple(names),
        )

    def transform_covariance(self, covariance: Floats, columns: Ints) -> Floats:
        """Covariances (c, k, k) of c sets of k unknowns, with indices `columns` (c, k), transformed to this datum."""
        motion, carried = self.free_motions[columns], self.motion_cross_covariance[columns]
        cross_covariance = motion @ np.swapaxes(carried, 1, 2)
        transformed = np.asarray(covariance - cross_covariance)
        transformed -= np.swapaxes(cross_covariance, 1, 2)
        del cross_covariance  # this matrix is as large as the covariance
        transformed += motion @ self.motion_covariance @ np.swapaxes(motion, 1, 2)
        return transformed


def _scale_displacement_function(problem: NetworkProblem) -> Callable[[Floats], Floats]:
    """Function for the displacements of k points by a unit change of scale, from their vectors (k, 3) from the centre.

    The displacements have the shape (3 k, 1), or (3 k, 0) if the observations determine the scale. Heights of a network
    without elevations do not change.
    """
    axes = np.array([1.0, 1.0, float(problem.is_used_reading[:, 2].any())])
    return lambda arm: np.tile(
        (arm * axes).reshape(-1, 1), (1, len(problem.undetermined_unknowns.scale_defining_target))
    )


def motions_about_centre(free_motions: Floats, centre: Floats) -> Floats:
    """Orthonormal basis (6, f) of the rigid motions `free_motions` (6, f), with rotations about `centre` (3,) [m]."""
    about = free_motions.copy()
    about[:3] += np.cross(free_motions[3:].T, centre).T
    return np.linalg.qr(about)[0]
