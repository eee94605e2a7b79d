"""Measurands: results of each kind of task in SI units, as functions of one or many sets of points."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.equality import ValueEquality
from ltsim.core.errors import ModelError, NetworkError, unknown_name_error
from ltsim.core.units import DEGREE, MILLIMETRE, PPM
from ltsim.geometry.rigid import align_with_scale
from ltsim.measurands.features import FittedFeature, fit_feature
from ltsim.measurands.spec import Task

CENTRAL_DIFFERENCE_STEP = 1e-5
"""Step [m] to each side in central differences; errors from rounding and curvature are far below a nanometre."""


@dataclass(frozen=True)
class TaskOutput:
    """Name and unit of one result of a task, such as `x` in mm."""

    name: str
    """Name of the result."""
    unit: str
    """Unit in which the result is displayed."""
    si_per_unit: float
    """Size of the display unit in SI units."""


def _outputs_in_mm(*names: str) -> list[TaskOutput]:
    """Definitions (name, unit) of results of a task with the given names and the unit mm."""
    return [TaskOutput(name, "mm", MILLIMETRE) for name in names]


def _outputs_in_degrees(*names: str) -> list[TaskOutput]:
    """Definitions (name, unit) of results of a task with the given names and the unit degree."""
    return [TaskOutput(name, "deg", DEGREE) for name in names]


@dataclass(frozen=True)
class Measurand(ValueEquality):
    """Function that computes the results of a task from the points of a network."""

    task: Task
    """Task of the task file, with its targets and options."""
    target_indices: Ints
    """Indices of the targets of the task among the points of the network."""
    reference_feature: FittedFeature | None = field(default=None, repr=False)
    """Feature fitted to the estimated points; None for a task without a feature. Fits to displaced points start from
    this feature, and their directions have the sign of its direction."""

    @classmethod
    def from_task(cls, task: Task, targets: Sequence[str], points: Floats) -> Self:
        """Measurand of a task in a network with the target names `targets` and the estimated points (targets, 3) [m].

        Raises ModelError if the points do not determine the results of the task.
        """
        for name in task.targets:
            if name not in targets:
                raise unknown_name_error("target", name, targets)
        target_indices = np.array([targets.index(name) for name in task.targets])
        undetermined = [task.targets[i] for i in np.flatnonzero(~np.isfinite(points[target_indices]).all(axis=1))]
        if undetermined:
            raise ModelError(f"task {task.name}: the readings do not determine target {undetermined[0]}")
        try:
            near = fit_feature(task.kind, points[target_indices]) if task.kind in _QUANTITIES_BY_FEATURE else None
            measurand = cls(task, target_indices, near)
            measurand.values(points)
        except (ModelError, NetworkError) as problem:
            raise ModelError(f"task {task.name}: {problem}") from None
        wrong = [name for name in task.tolerances if name not in {o.name for o in measurand.outputs}]
        if wrong:
            raise ModelError(
                f"task {task.name}: {unknown_name_error('result', wrong[0], [o.name for o in measurand.outputs])}"
            )
        return measurand

    @property
    def outputs(self) -> list[TaskOutput]:
        """Name and unit of each result of the task, in the order of the results."""
        kind = self.task.kind
        if kind in _OUTPUTS_BY_TASK_KIND:
            return _OUTPUTS_BY_TASK_KIND[kind]
        if kind == "deviation":
            return _outputs_in_mm(
                *(f"{name}.{part}" for name in self.task.targets for part in ("dx", "dy", "dz", "distance"))
            )
        scale = [TaskOutput("scale", "ppm", PPM)] if self.task.align_with_scale else []
        return [*_outputs_in_mm("x", "y", "z"), *_outputs_in_degrees("turn-x", "turn-y", "turn-z"), *scale]

    def values(self, points: Floats, length_ratio: Floats | float = 1.0) -> Floats:
        """Results (..., results) [SI] of the task for sets of points (..., points, 3) [m].

        Each set of points is first scaled about its centroid by 1 / `length_ratio`. The length ratio is the length of
        the part in the measurement divided by its length at the reference temperature.
        """
        scaled_points = points[..., self.target_indices, :]
        centre = scaled_points.mean(axis=-2, keepdims=True)
        scaled_points = centre + (scaled_points - centre) / np.asarray(length_ratio)[..., None, None]
        kind = self.task.kind
        if kind == "point":
            return scaled_points[..., 0, :]
        if kind == "rod":
            way = scaled_points[..., 1, :] - scaled_points[..., 0, :]
            along = way / np.linalg.norm(way, axis=-1, keepdims=True)
            return scaled_points[..., 1, :] + self.task.tip_distance_mm * MILLIMETRE * along
        if kind == "distance":
            return np.linalg.norm(scaled_points[..., 1, :] - scaled_points[..., 0, :], axis=-1)[..., None]
        if kind == "angle":
            return _angle_of_points(scaled_points)[..., None]
        if kind in _QUANTITIES_BY_FEATURE:
            return self._feature_values(scaled_points)
        return self._alignment_values(scaled_points)

    def point_derivatives(self, points: Floats, length_ratio: float = 1.0) -> Floats:
        """Derivatives (results, coordinates) of the results by the coordinates of the points (points, 3) [m].

        The derivatives are computed by central differences. `length_ratio` is the length of the part in the measurement
        divided by its length at the reference temperature.
        """
        n_coordinates = 3 * len(self.target_indices)
        columns = (3 * self.target_indices[:, None] + np.arange(3)).ravel()
        steps = np.zeros((2 * n_coordinates, points.size))
        steps[np.arange(n_coordinates), columns] = CENTRAL_DIFFERENCE_STEP
        steps[n_coordinates + np.arange(n_coordinates), columns] = -CENTRAL_DIFFERENCE_STEP
        stepped_values = self.values(points + steps.reshape(2 * n_coordinates, *points.shape), length_ratio)
        change = np.zeros((stepped_values.shape[1], points.size))
        change[:, columns] = (stepped_values[:n_coordinates] - stepped_values[n_coordinates:]).T / (
            2 * CENTRAL_DIFFERENCE_STEP
        )
        return change

    def length_ratio_derivatives(self, points: Floats, length_ratio: float = 1.0) -> Floats:
        """Derivatives (results,) [SI] of the results by the length ratio of the part.

        The length ratio is the length of the part in the measurement divided by its length at the reference
        temperature.
        """
        scales = np.array([length_ratio + CENTRAL_DIFFERENCE_STEP, length_ratio - CENTRAL_DIFFERENCE_STEP])
        stepped_values = self.values(np.broadcast_to(points, (2, *points.shape)), scales)
        return (stepped_values[0] - stepped_values[1]) / (2 * CENTRAL_DIFFERENCE_STEP)

    def _feature_values(self, feature_points: Floats) -> Floats:
        """Results (..., results) [SI] of a task that fits a feature to points (..., points, 3) [m]."""
        task, near = self.task, self.reference_feature
        feature = fit_feature(task.kind, feature_points, near)
        normal = feature.direction
        if near is not None and task.kind != "sphere":
            normal = normal * np.sign(np.einsum("...i,i->...", normal, near.direction))[..., None]
        # Size of the zone with all deviations: its diameter for a line, peak to valley for the other features.
        form = 2.0 * feature.deviations.max(axis=-1) if task.kind == "line" else np.ptp(feature.deviations, axis=-1)
        diameter = 2.0 * (feature.radius + task.radius_offset_mm * MILLIMETRE)
        values_by_quantity = {
            "centre": feature.reference_point,
            "normal": normal,
            "diameter": diameter[..., None],
            "form": form[..., None],
            "offset": np.einsum("...i,...i->...", normal, feature.reference_point)[..., None],
        }
        return np.concatenate([values_by_quantity[name] for name in _QUANTITIES_BY_FEATURE[task.kind]], axis=-1)

    def _alignment_values(self, feature_points: Floats) -> Floats:
        """Results (..., results) [SI] of a transformation, pose or deviation, from points (..., points, 3) [m]."""
        task = self.task
        nominal = np.array([task.nominal_mm[name] for name in task.targets]) * MILLIMETRE
        if task.kind == "deviation" and not task.align:
            return _difference_components(feature_points - nominal)
        rotation, shift, scale = align_with_scale(nominal, feature_points, estimates_scale=task.align_with_scale)
        if task.kind == "deviation":
            back = (
                np.einsum("...ji,...nj->...ni", rotation, feature_points - shift[..., None, :]) / scale[..., None, None]
            )
            return _difference_components(back - nominal)
        from scipy.spatial.transform import Rotation  # slow to load

        turn = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(shift.shape)
        ratio = [scale[..., None] - 1.0] if task.align_with_scale else []
        return np.concatenate([shift, turn, *ratio], axis=-1)


def _angle_of_points(three_points: Floats) -> Floats:
    """Angle [rad] at the second of three points (..., 3, 3) between the directions to the first and the third."""
    first, second = three_points[..., 0, :] - three_points[..., 1, :], three_points[..., 2, :] - three_points[..., 1, :]
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    if not np.all(np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1) > 0):
        raise ModelError("an arm of the angle has length 0")
    return np.arctan2(across, np.einsum("...i,...i->...", first, second))


def _difference_components(difference_vectors: Floats) -> Floats:
    """Components x, y, z and length [m] of each of n difference vectors (..., n, 3), in one row (..., 4 n)."""
    differences = np.concatenate(
        [difference_vectors, np.linalg.norm(difference_vectors, axis=-1, keepdims=True)], axis=-1
    )
    return differences.reshape(*difference_vectors.shape[:-2], -1)


_QUANTITIES_BY_FEATURE = {
    "line": ("normal", "form"),
    "plane": ("normal", "offset", "form"),
    "circle": ("centre", "diameter", "normal", "form"),
    "sphere": ("centre", "diameter", "form"),
    "cylinder": ("normal", "diameter", "form"),
}
"""Names of the quantities that a task reports on a fitted feature, by kind of feature."""
_DIRECTION_OUTPUTS = [TaskOutput(f"direction-{axis}", "", 1.0) for axis in "xyz"]
"""Names and units of the components of a unit vector along a line or axis, as results of a task."""
_NORMAL_OUTPUTS = [TaskOutput(f"normal-{axis}", "", 1.0) for axis in "xyz"]
"""Names and units of the components of a unit normal vector, as results of a task."""
_OUTPUTS_BY_TASK_KIND = {
    "point": _outputs_in_mm("x", "y", "z"),
    "rod": _outputs_in_mm("x", "y", "z"),
    "distance": _outputs_in_mm("distance"),
    "angle": _outputs_in_degrees("angle"),
    "line": [*_DIRECTION_OUTPUTS, *_outputs_in_mm("straightness")],
    "plane": [*_NORMAL_OUTPUTS, *_outputs_in_mm("offset", "flatness")],
    "circle": [*_outputs_in_mm("x", "y", "z", "diameter"), *_NORMAL_OUTPUTS, *_outputs_in_mm("roundness")],
    "sphere": _outputs_in_mm("x", "y", "z", "diameter", "sphericity"),
    "cylinder": [*_DIRECTION_OUTPUTS, *_outputs_in_mm("diameter", "cylindricity")],
}
"""Names and units of the results of a task, by kind of task, for kinds with the same results for all targets."""
