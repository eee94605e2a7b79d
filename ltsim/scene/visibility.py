"""Visibility of targets from stations: limits of elevation, range and incidence, shadow of the stand, obstacles.

Arrays have a row for each station and a column for each target. Only obstacles need ray casting (`ltsim.scene.meshes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ltsim.core.arrays import Bools, Floats, Ints, as_finite_floats
from ltsim.core.errors import ModelError
from ltsim.core.units import DEGREE
from ltsim.recordings.setup import ElevationLimits
from ltsim.scene.meshes import Obstacles

DOWNWARD_DIRECTION = np.array([0.0, 0.0, -1.0])
"""Unit vector straight down in the frame of an upright instrument."""
LIMIT_TOLERANCE = 1e-9
"""Tolerance [rad or m] for rounding errors in comparisons with limits of angles and distances."""


class InvisibilityReason(IntEnum):
    """Reason why a target is not visible from a station; if several apply, the first of them in this order."""

    VISIBLE = 0
    STATION_INSIDE_OBSTACLE = 1
    OUT_OF_RANGE = 2
    BELOW_MIN_ELEVATION = 3
    ABOVE_MAX_ELEVATION = 4
    IN_STAND_SHADOW = 5
    OUTSIDE_ACCEPTANCE_ANGLE = 6
    HIDDEN_BY_OBSTACLE = 7
    MARGINAL_SIGHT = 8


INVISIBILITY_REASON_TEXTS = (
    "",
    "station inside an obstacle",
    "out of range",
    "below the elevation limit",
    "above the elevation limit",
    "in the shadow cone of the instrument's stand",
    "outside the acceptance angle of the reflector",
    "hidden by an obstacle",
    "marginal, not free from all positions within stations.position_tolerance_mm of the planned one",
)
"""Text for users of each `InvisibilityReason`; empty for a visible target."""


@dataclass(frozen=True)
class SightLimits:
    """Limits within which an instrument measures a reflector: elevation, range, incidence, shadow of its stand."""

    elevation_min: float = ElevationLimits().elevation_min_deg * DEGREE
    """Lowest elevation [rad] of the instrument."""
    elevation_max: float = ElevationLimits().elevation_max_deg * DEGREE
    """Highest elevation [rad] of the instrument."""
    range_min: float = 0.5
    """Shortest measurable range [m]."""
    range_max: float = 20.0
    """Longest measurable range [m]."""
    max_incidence_angle: float = 30.0 * DEGREE
    """Largest angle of incidence [rad] on a reflector."""
    declared_shadow_cone_opening: float | None = None
    """Full opening angle [rad] of the shadow cone: the cone below the instrument in which its stand hides targets. If
    None, the angle is computed from `elevation_min`.
    """

    @property
    def shadow_cone_opening(self) -> float:
        """Full opening angle [rad] of the cone below the instrument in which its stand hides targets."""
        return (
            default_shadow_cone_opening(self.elevation_min)
            if self.declared_shadow_cone_opening is None
            else self.declared_shadow_cone_opening
        )


@dataclass(frozen=True)
class Visibility:
    """Visibility of each of T targets from each of S stations, with ranges and angles."""

    reason_codes: NDArray[np.int8]
    """Value of `InvisibilityReason` for each pair of S stations and T targets, (S, T); 0 for a visible target."""
    ranges: Floats
    """Distances between S stations and T targets, (S, T) [m]."""
    elevations: Floats
    """Elevations of T targets in the instrument frames of S stations, (S, T) [rad]."""
    incidence_angles: Floats
    """Angles of incidence of the beams from S stations on T reflectors, (S, T) [rad]: 0 for a reflector that is turned
    to the station before each pointing, NaN if the normal of the nest is unknown."""
    limits: tuple[SightLimits, ...]
    """Limits of the instrument at each of S stations."""

    @property
    def is_visible(self) -> Bools:
        """Flags (S, T) of the targets that are visible from each station."""
        return np.asarray(self.reason_codes == InvisibilityReason.VISIBLE)

    def reason_texts(self) -> list[list[str]]:
        """Reason why each target is not visible from each station, as S lists of T texts; '' for a visible target."""
        return [
            [self._reason_text(s, t) for t in range(self.reason_codes.shape[1])]
            for s in range(self.reason_codes.shape[0])
        ]

    def short_reason_texts(self) -> list[list[str]]:
        """Reason why each target is not visible from each station, without numbers: S lists of T texts."""
        return [[INVISIBILITY_REASON_TEXTS[code] for code in line] for line in self.reason_codes.tolist()]

    def _reason_text(self, station: int, target: int) -> str:
        """Reason, as text, why a target is invisible from a station; for range and elevation with the limit."""
        code, limits = self.reason_codes[station, target], self.limits[station]
        range_, elevation = self.ranges[station, target], self.elevations[station, target] / DEGREE
        key, number = {
            InvisibilityReason.OUT_OF_RANGE: (
                "range_min_mm" if range_ < limits.range_min else "range_max_mm",
                f"{range_:.2f} m, expected {limits.range_min:g} to {limits.range_max:g} m",
            ),
            InvisibilityReason.BELOW_MIN_ELEVATION: (
                "elevation_min_deg",
                f"{elevation:.1f} deg, the minimum is {limits.elevation_min / DEGREE:.4g} deg",
            ),
            InvisibilityReason.ABOVE_MAX_ELEVATION: (
                "elevation_max_deg",
                f"{elevation:.1f} deg, the maximum is {limits.elevation_max / DEGREE:.4g} deg",
            ),
        }.get(code, ("", ""))
        return (
            f"{INVISIBILITY_REASON_TEXTS[code]} ({number}: instrument.limits.{key})"
            if key
            else INVISIBILITY_REASON_TEXTS[code]
        )

    @property
    def is_marginal(self) -> Bools:
        """True (S, T) for lines of sight that are free from a station, but blocked from a position in its tolerance."""
        return np.asarray(self.reason_codes == InvisibilityReason.MARGINAL_SIGHT)

    def with_marginal_pairs(self, is_marginal: Bools) -> Visibility:
        """Copy in which pairs of station and target that are True in `is_marginal` (S, T) count as not visible.

        A pair is marginal if its line of sight is blocked from a position within the tolerance of the station.
        """
        codes = np.where(self.is_visible & is_marginal, np.int8(InvisibilityReason.MARGINAL_SIGHT), self.reason_codes)
        return replace(self, reason_codes=codes)

    def invisible_pair_sentences(self, stations: Sequence[str], targets: Sequence[str]) -> list[str]:
        """Sentences on all targets that are not visible from a station; `stations` and `targets` are the names."""
        return [
            f"{stations[s]} does not see {targets[t]}: {self._reason_text(s, t)}"
            for s, t in np.argwhere(~self.is_visible).tolist()
        ]


def default_shadow_cone_opening(min_elevation: float) -> float:
    """Full opening angle [rad] of the cone in which the stand hides targets, for a lowest elevation [rad].

    The cone contains all directions below the lowest elevation: 70 deg for a lowest elevation of -55 deg.
    """
    return float(np.pi + 2.0 * min_elevation)


def stand_shadow_radii(position: Floats, height: float, cone_angle: float) -> Floats:
    """Radii (S,) [m] of the circles in which the shadow cones of S upright instruments meet a horizontal plane.

    `position` (S, 3) [m] are the instruments, `height` [m] is the height of the plane. `cone_angle` [rad] is the full
    opening angle of the cones, in which the stands hide targets. The radius is 0 for an instrument below the plane.
    """
    above = np.maximum(position[:, 2] - height, 0.0)
    return above * np.tan(0.5 * cone_angle)


def compute_visibility(
    position: Floats,
    points: Floats,
    limits: SightLimits,
    *,
    rotation: Floats | None = None,
    nest_normals: Floats | None = None,
    is_reaimed: Bools | None = None,
    obstacles: Obstacles | None = None,
) -> Visibility:
    """Visibility of T points (T, 3) [m] from S instruments at `position` (S, 3) [m] with common limits.

    `rotation` (S, 3, 3) transforms the instrument frames to the network frame; by default the instruments are upright.
    `nest_normals` (T, 3) are the unit normals of the nests; a row of NaN is an unknown normal, for which every angle of
    incidence is permitted. `is_reaimed` (T,) flags the reflectors that are turned to the station before each pointing,
    by default all. Raises ModelError for a target at the origin of a station.
    """
    position, points = (
        as_finite_floats(position, (-1, 3), "position"),
        as_finite_floats(points, (-1, 3), "points"),
    )
    sight = points - position[:, None, :]
    range_ = np.linalg.norm(sight, axis=2)
    if np.any(range_ < LIMIT_TOLERANCE):
        raise ModelError("a target has the same position as a station; check the coordinates")
    beam = sight / range_[:, :, None]
    down = np.broadcast_to(DOWNWARD_DIRECTION, position.shape) if rotation is None else rotation @ DOWNWARD_DIRECTION
    elevation = -np.arcsin(np.clip(np.einsum("stk,sk->st", beam, down), -1.0, 1.0))
    incidence = _incidence_on_reflectors(beam, nest_normals, is_reaimed)
    reason = np.zeros(range_.shape, dtype=np.int8)
    shadow = 0.5 * limits.shadow_cone_opening - 0.5 * np.pi
    checks = (
        (InvisibilityReason.OUTSIDE_ACCEPTANCE_ANGLE, incidence > limits.max_incidence_angle + LIMIT_TOLERANCE),
        (InvisibilityReason.IN_STAND_SHADOW, elevation < shadow - LIMIT_TOLERANCE),
        (InvisibilityReason.ABOVE_MAX_ELEVATION, elevation > limits.elevation_max + LIMIT_TOLERANCE),
        (InvisibilityReason.BELOW_MIN_ELEVATION, elevation < limits.elevation_min - LIMIT_TOLERANCE),
        (InvisibilityReason.OUT_OF_RANGE, (range_ < limits.range_min) | (range_ > limits.range_max)),
    )
    for code, holds in checks:
        reason[holds] = code
    if obstacles is not None:
        _add_obstacles(reason, position, points, obstacles)
    return Visibility(reason, range_, elevation, incidence, (limits,) * len(position))


def join_visibility_tables(tables: Sequence[Visibility], station_order: Ints) -> Visibility:
    """Visibility of T targets from the stations of several `Visibility` objects, as one object.

    `station_order` (S,) is, for each of S stations of the result, its row in the concatenated arrays.
    """
    columns = [(t.reason_codes, t.ranges, t.elevations, t.incidence_angles) for t in tables]
    reason, range_, elevation, incidence = (
        np.concatenate(column)[station_order] for column in zip(*columns, strict=True)
    )
    limits = [limits for table in tables for limits in table.limits]
    return Visibility(reason, range_, elevation, incidence, tuple(limits[s] for s in station_order.tolist()))


def _incidence_on_reflectors(beam: Floats, nest_normals: Floats | None, is_reaimed: Bools | None) -> Floats:
    """Angles (S, T) [rad] between the directions to S stations and the normals of the nests of T targets.

    `beam` (S, T, 3) are the unit vectors from stations to targets. `nest_normals` (T, 3) are unit vectors, NaN if
    unknown. The angle is 0 for reflectors that are turned to the station before each pointing, `is_reaimed` (T,).
    """
    if nest_normals is None or is_reaimed is None:
        return np.zeros(beam.shape[:2])
    normal_lengths = np.linalg.norm(nest_normals, axis=1, keepdims=True)
    cosine = -np.einsum("stk,tk->st", beam, nest_normals / normal_lengths)
    return np.where(is_reaimed, 0.0, np.arccos(np.clip(cosine, -1.0, 1.0)))


def _add_obstacles(reason_table: NDArray[np.int8], position: Floats, points: Floats, obstacles: Obstacles) -> None:
    """Addition, in place, of the reasons due to obstacles to the reason codes (S, T) of S stations and T targets.

    `position` (S, 3) and `points` (T, 3) [m] are the instruments and the targets. Rays are cast only for pairs without
    another reason.
    """
    is_inside = obstacles.is_setup_inside_body(position)
    sight_pairs = np.argwhere((reason_table == InvisibilityReason.VISIBLE) & ~is_inside[:, None])
    hidden_pairs = sight_pairs[
        obstacles.is_blocked(position[sight_pairs[:, 0]], obstacles.moved_to_surface(points)[sight_pairs[:, 1]])
    ]
    reason_table[hidden_pairs[:, 0], hidden_pairs[:, 1]] = InvisibilityReason.HIDDEN_BY_OBSTACLE
    reason_table[is_inside] = InvisibilityReason.STATION_INSIDE_OBSTACLE


def nest_normals_of_smallest_incidence(position: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Normals (T, 3) of T fixed nests whose largest angle of incidence over S stations is minimal; this angle (T,).

    The nests are at `points` (T, 3) [m], the instruments at `position` (S, 3) [m]. The normal is the axis of the
    narrowest cone from the target that contains all stations, and the angle [rad] is half the opening angle of the
    cone. All stations see the reflector if its acceptance angle is at least this angle.
    """
    directions_to_stations = position - points[:, None, :]
    directions_to_stations /= np.linalg.norm(directions_to_stations, axis=2, keepdims=True)
    centre = narrowest_cone_axes(directions_to_stations)
    cosine = np.clip(np.einsum("tsk,tk->ts", directions_to_stations, centre), -1.0, 1.0)
    half_angle: Floats = np.arccos(cosine.min(axis=1))
    return centre, half_angle


def narrowest_cone_axes(directions: Floats, n_steps: int = 1000) -> Floats:
    """Axes (..., 3) of the narrowest cones around S unit vectors (..., S, 3), which must lie in a half space.

    The axis points to the centre of the smallest ball around the ends of the vectors. In step i of the iteration of
    Badoiu and Clarkson (`n_steps` steps) the centre moves by 1 / (i + 1) of the way to the farthest vector. The error
    of the centre decreases as 1 / i.
    """
    flattened = directions.reshape(-1, *directions.shape[-2:])
    centre, row_indices = flattened.mean(axis=-2), np.arange(len(flattened))
    for i in range(1, n_steps + 1):
        farthest = np.einsum("tsk,tk->ts", flattened, centre).argmin(axis=-1)
        centre += (flattened[row_indices, farthest] - centre) / (i + 1)
        centre /= np.sqrt(np.add.reduce(centre * centre, axis=1, keepdims=True))
    return centre.reshape(directions.shape[:-2] + directions.shape[-1:])
