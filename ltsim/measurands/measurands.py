"""Measurands: results of each kind of task from points, in units of display, for one or many sets of points."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import ModelError, NetworkError, unknown_name
from ltsim.core.units import DEGREE, MILLIMETRE, PPM
from ltsim.core.values import ValueEquality
from ltsim.geometry.alignment import best_fit
from ltsim.measurands.features import Feature, fit
from ltsim.measurands.spec import Task

STEP = 1e-5
"""Half the step [m] of central differences; errors by rounding and curvature are far below a nanometre."""


@dataclass(frozen=True)
class Output:
    """Result of a task: name, unit, and the unit in SI."""

    name: str
    unit: str
    factor: float


def _mm(*names: str) -> list[Output]:
    return [Output(name, "mm", MILLIMETRE) for name in names]


def _deg(*names: str) -> list[Output]:
    return [Output(name, "deg", DEGREE) for name in names]


@dataclass(frozen=True)
class Measurand(ValueEquality):
    """Measurand: a task applied to points of a network."""

    task: Task
    at: Ints
    """Indices of its targets among the network's points, (k,)."""
    near: Feature | None = field(default=None, repr=False)
    """Feature fitted to the estimated points, the start of all further fits and the reference for signs."""

    @classmethod
    def of(cls, task: Task, targets: Sequence[str], points: Floats) -> Self:
        """Measurand of a task on targets at points (T, 3) [m].

        Raises ModelError for an unknown or undetermined target, and if the points do not determine the feature.
        """
        for name in task.targets:
            if name not in targets:
                raise unknown_name("target", name, targets)
        at = np.array([targets.index(name) for name in task.targets])
        lost = [task.targets[i] for i in np.flatnonzero(~np.isfinite(points[at]).all(axis=1))]
        if lost:
            raise ModelError(f"task {task.name}: the readings do not determine target {lost[0]}")
        try:
            near = fit(task.kind, points[at]) if task.kind in _PARTS else None
            measurand = cls(task, at, near)
            measurand.values(points)
        except (ModelError, NetworkError) as problem:
            raise ModelError(f"task {task.name}: {problem}") from None
        wrong = [name for name in task.tolerances if name not in {o.name for o in measurand.outputs}]
        if wrong:
            raise ModelError(
                f"task {task.name}: {unknown_name('result', wrong[0], [o.name for o in measurand.outputs])}"
            )
        return measurand

    @property
    def outputs(self) -> list[Output]:
        """Results of the task in order: name and unit."""
        kind = self.task.kind
        if kind in _OUTPUTS:
            return _OUTPUTS[kind]
        if kind == "deviation":
            return _mm(*(f"{name}.{part}" for name in self.task.targets for part in ("dx", "dy", "dz", "distance")))
        scale = [Output("scale", "ppm", PPM)] if self.task.scale else []
        return [*_mm("x", "y", "z"), *_deg("turn-x", "turn-y", "turn-z"), *scale]

    def values(self, points: Floats, stretch: Floats | float = 1.0) -> Floats:
        """Results (..., k) [SI] for points (..., T, 3) [m], each set scaled about its centre by its `stretch` (...)."""
        chosen = points[..., self.at, :]
        middle = chosen.mean(axis=-2, keepdims=True)
        chosen = middle + (chosen - middle) / np.asarray(stretch)[..., None, None]
        kind = self.task.kind
        if kind == "point":
            return chosen[..., 0, :]
        if kind == "rod":
            way = chosen[..., 1, :] - chosen[..., 0, :]
            along = way / np.linalg.norm(way, axis=-1, keepdims=True)
            return chosen[..., 1, :] + self.task.beyond_mm * MILLIMETRE * along
        if kind == "distance":
            return np.linalg.norm(chosen[..., 1, :] - chosen[..., 0, :], axis=-1)[..., None]
        if kind == "angle":
            return _angle(chosen)[..., None]
        if kind in _PARTS:
            return self._feature(chosen)
        return self._fitted(chosen)

    def by_points(self, points: Floats, stretch: float = 1.0) -> Floats:
        """Derivative (k, 3 T) of the results with respect to points (T, 3), by central differences."""
        count = 3 * len(self.at)
        columns = (3 * self.at[:, None] + np.arange(3)).ravel()
        steps = np.zeros((2 * count, points.size))
        steps[np.arange(count), columns] = STEP
        steps[count + np.arange(count), columns] = -STEP
        values = self.values(points + steps.reshape(2 * count, *points.shape), stretch)
        change = np.zeros((values.shape[1], points.size))
        change[:, columns] = (values[:count] - values[count:]).T / (2 * STEP)
        return change

    def by_stretch(self, points: Floats, stretch: float = 1.0) -> Floats:
        """Derivative (k,) of the results with respect to the stretch."""
        both = np.array([stretch + STEP, stretch - STEP])
        values = self.values(np.broadcast_to(points, (2, *points.shape)), both)
        return (values[0] - values[1]) / (2 * STEP)

    def _feature(self, chosen: Floats) -> Floats:
        task, near = self.task, self.near
        feature = fit(task.kind, chosen, near)
        normal = feature.normal
        if near is not None and task.kind != "sphere":
            normal = normal * np.sign(np.einsum("...i,i->...", normal, near.normal))[..., None]
        # The zone that holds all deviations: a diameter for a line, peak to valley for the others.
        form = 2.0 * feature.deviations.max(axis=-1) if task.kind == "line" else np.ptp(feature.deviations, axis=-1)
        diameter = 2.0 * (feature.radius + task.radius_offset_mm * MILLIMETRE)
        parts = {
            "centre": feature.centre,
            "normal": normal,
            "diameter": diameter[..., None],
            "form": form[..., None],
            "offset": np.einsum("...i,...i->...", normal, feature.centre)[..., None],
        }
        return np.concatenate([parts[name] for name in _PARTS[task.kind]], axis=-1)

    def _fitted(self, chosen: Floats) -> Floats:
        task = self.task
        nominal = np.array([task.nominal_mm[name] for name in task.targets]) * MILLIMETRE
        if task.kind == "deviation" and not task.fit:
            return _gaps(chosen - nominal)
        rotation, shift, scale = best_fit(nominal, chosen, scaled=task.scale)
        if task.kind == "deviation":
            back = np.einsum("...ji,...nj->...ni", rotation, chosen - shift[..., None, :]) / scale[..., None, None]
            return _gaps(back - nominal)
        from scipy.spatial.transform import Rotation  # slow to load

        turn = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(shift.shape)
        ratio = [scale[..., None] - 1.0] if task.scale else []
        return np.concatenate([shift, turn, *ratio], axis=-1)


def _angle(chosen: Floats) -> Floats:
    first, second = chosen[..., 0, :] - chosen[..., 1, :], chosen[..., 2, :] - chosen[..., 1, :]
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    if not np.all(np.linalg.norm(first, axis=-1) * np.linalg.norm(second, axis=-1) > 0):
        raise ModelError("an arm of the angle has length 0")
    return np.arctan2(across, np.einsum("...i,...i->...", first, second))


def _gaps(gap: Floats) -> Floats:
    rows = np.concatenate([gap, np.linalg.norm(gap, axis=-1, keepdims=True)], axis=-1)
    return rows.reshape(*gap.shape[:-2], -1)


_PARTS = {
    "line": ("normal", "form"),
    "plane": ("normal", "offset", "form"),
    "circle": ("centre", "diameter", "normal", "form"),
    "sphere": ("centre", "diameter", "form"),
    "cylinder": ("normal", "diameter", "form"),
}
_DIRECTION = [Output(f"direction-{axis}", "", 1.0) for axis in "xyz"]
_NORMAL = [Output(f"normal-{axis}", "", 1.0) for axis in "xyz"]
_OUTPUTS = {
    "point": _mm("x", "y", "z"),
    "rod": _mm("x", "y", "z"),
    "distance": _mm("distance"),
    "angle": _deg("angle"),
    "line": [*_DIRECTION, *_mm("straightness")],
    "plane": [*_NORMAL, *_mm("offset", "flatness")],
    "circle": [*_mm("x", "y", "z", "diameter"), *_NORMAL, *_mm("roundness")],
    "sphere": _mm("x", "y", "z", "diameter", "sphericity"),
    "cylinder": [*_DIRECTION, *_mm("diameter", "cylindricity")],
}
