"""Visibility between stations and targets: elevation limits and shadow cones, range, acceptance angles, obstacles.

All tables are stations by targets, analytic and vectorised; only obstacles need rays (`scene.meshes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ltsim.core.arrays import Bools, Floats, Ints, as_floats
from ltsim.core.errors import ModelError
from ltsim.core.units import DEGREE
from ltsim.scene.meshes import Obstacles

DOWNWARD = np.array([0.0, 0.0, -1.0])
"""Unit vector of the plumb line downwards."""
ANGLE_TOLERANCE = 1e-9
"""Tolerance of comparisons with the limits of angles [rad] and of distances [m]: rounding only."""


class InvisibilityReason(IntEnum):
    """Reason why a station does not see a target; the first one that applies."""

    VISIBLE = 0
    STATION_INSIDE = 1
    RANGE = 2
    BELOW = 3
    ABOVE = 4
    SHADOW = 5
    ACCEPTANCE = 6
    OBSTACLE = 7


REASON_TEXTS = (
    "",
    "station inside an obstacle",
    "out of range",
    "below the elevation limit",
    "above the elevation limit",
    "in the shadow cone",
    "turned beyond the reflector's acceptance",
    "hidden by an obstacle",
)
"""Text of each reason; empty for a visible pair."""


@dataclass(frozen=True)
class SightLimits:
    """Limits of visibility of an instrument and its reflectors [rad, m]."""

    elevation_min: float = -55.0 * DEGREE
    """Lowest elevation of the instrument [rad]."""
    elevation_max: float = 77.0 * DEGREE
    """Highest elevation of the instrument."""
    range_min: float = 0.5
    """Shortest range [m]."""
    range_max: float = 20.0
    """Longest range [m]."""
    max_incidence: float = 30.0 * DEGREE
    """Largest incidence angle on a reflector."""
    declared_cone_opening: float | None = None
    """Full angle of the shadow cone below the instrument; None: the one that follows from `min_elevation`."""

    @property
    def cone_opening(self) -> float:
        """Full angle [rad] of the shadow cone in effect: the declared one, or that of `min_elevation`."""
        return (
            shadow_cone_opening(self.elevation_min)
            if self.declared_cone_opening is None
            else self.declared_cone_opening
        )


@dataclass(frozen=True)
class Visibility:
    """Visibility of each target from each station of a layout."""

    reasons: NDArray[np.int8]
    """Values of `InvisibilityReason` for each pair, (S, T); 0 for a visible pair."""
    ranges: Floats
    """Distance of each pair, (S, T) [m]."""
    elevations: Floats
    """Elevation of each target in the instrument frame, (S, T) [rad]."""
    incidence_angles: Floats
    """Incidence angle on each reflector, (S, T) [rad]; 0 for a re-aimed reflector, NaN for an unknown nest."""
    limits: tuple[SightLimits, ...]
    """Limits of each station's instrument, S entries."""

    @property
    def is_visible(self) -> Bools:
        """Flags (S, T) of the pairs that see each other."""
        return np.asarray(self.reasons == InvisibilityReason.VISIBLE)

    def reason_texts(self) -> list[list[str]]:
        """Text of the reason for each pair, '' for a visible pair."""
        return [[self._reason_text(s, t) for t in range(self.reasons.shape[1])] for s in range(self.reasons.shape[0])]

    def reason_kinds(self) -> list[list[str]]:
        """Texts of the reasons, as `reason_texts`, but without the numbers of the pair."""
        return [[REASON_TEXTS[code] for code in line] for line in self.reasons.tolist()]

    def _reason_text(self, station: int, target: int) -> str:
        """Text of the reason of a pair: its value, the limit, and the key that states the limit, if any."""
        code, limits = self.reasons[station, target], self.limits[station]
        range_, elevation = self.ranges[station, target], self.elevations[station, target] / DEGREE
        key, number = {
            InvisibilityReason.RANGE: (
                "range_min_mm" if range_ < limits.range_min else "range_max_mm",
                f"{range_:.2f} m, expected {limits.range_min:g} to {limits.range_max:g} m",
            ),
            InvisibilityReason.BELOW: (
                "elevation_min_deg",
                f"{elevation:.1f} deg, the minimum is {limits.elevation_min / DEGREE:.4g} deg",
            ),
            InvisibilityReason.ABOVE: (
                "elevation_max_deg",
                f"{elevation:.1f} deg, the maximum is {limits.elevation_max / DEGREE:.4g} deg",
            ),
        }.get(code, ("", ""))
        return f"{REASON_TEXTS[code]} ({number}: instrument.limits.{key})" if key else REASON_TEXTS[code]

    def invisible_pair_sentences(self, stations: Sequence[str], targets: Sequence[str]) -> list[str]:
        """Sentences about the pairs that do not see each other, one per pair."""
        return [
            f"{stations[s]} does not see {targets[t]}: {self._reason_text(s, t)}"
            for s, t in np.argwhere(~self.is_visible).tolist()
        ]


def shadow_cone_opening(min_elevation: float) -> float:
    """Full angle [rad] of the shadow cone under an instrument by its lowest elevation [rad]: 70 deg for -55 deg."""
    return float(np.pi + 2.0 * min_elevation)


def shadow_radii(position: Floats, height: float, cone_angle: float) -> Floats:
    """Radius (S,) [m] of the shadow circles at `height` [m] under upright instruments at `position` (S, 3).

    The radius is zero for an instrument below `height`. The circles are centred under the positions.
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
    """Visibility tables from instrument origins (S, 3) [m] to points (T, 3) [m].

    Without `rotation` (S, 3, 3), instrument frame to network frame, the instruments are upright. `nest_normals` (T, 3)
    are the normals of the open faces; a row of NaN is unknown and accepts every beam. Reflectors with `is_reaimed` (T,)
    are turned to the station; by default all are.
    """
    position, points = as_floats(position, (-1, 3), "position"), as_floats(points, (-1, 3), "points")
    sight = points - position[:, None, :]
    range_ = np.linalg.norm(sight, axis=2)
    if np.any(range_ < ANGLE_TOLERANCE):
        raise ModelError("a target is at the origin of a station")
    beam = sight / range_[:, :, None]
    down = np.broadcast_to(DOWNWARD, position.shape) if rotation is None else rotation @ DOWNWARD
    elevation = -np.arcsin(np.clip(np.einsum("stk,sk->st", beam, down), -1.0, 1.0))
    incidence = _incidence_on_reflectors(beam, nest_normals, is_reaimed)
    reason = np.zeros(range_.shape, dtype=np.int8)
    shadow = 0.5 * limits.cone_opening - 0.5 * np.pi
    checks = (
        (InvisibilityReason.ACCEPTANCE, incidence > limits.max_incidence + ANGLE_TOLERANCE),
        (InvisibilityReason.SHADOW, elevation < shadow - ANGLE_TOLERANCE),
        (InvisibilityReason.ABOVE, elevation > limits.elevation_max + ANGLE_TOLERANCE),
        (InvisibilityReason.BELOW, elevation < limits.elevation_min - ANGLE_TOLERANCE),
        (InvisibilityReason.RANGE, (range_ < limits.range_min) | (range_ > limits.range_max)),
    )
    for code, holds in checks:
        reason[holds] = code
    if obstacles is not None:
        _add_obstacles(reason, position, points, obstacles)
    return Visibility(reason, range_, elevation, incidence, (limits,) * len(position))


def join_visibility_tables(tables: Sequence[Visibility], station_order: Ints) -> Visibility:
    """Joint table of several groups of stations.

    `station_order` gives for each station its row in the joined groups.
    """
    columns = [(t.reasons, t.ranges, t.elevations, t.incidence_angles) for t in tables]
    reason, range_, elevation, incidence = (
        np.concatenate(column)[station_order] for column in zip(*columns, strict=True)
    )
    limits = [limits for table in tables for limits in table.limits]
    return Visibility(reason, range_, elevation, incidence, tuple(limits[s] for s in station_order.tolist()))


def _incidence_on_reflectors(beam: Floats, nest_normals: Floats | None, is_reaimed: Bools | None) -> Floats:
    """Incidence angle (S, T) [rad] between the beam towards the station and the normal of the open face."""
    if nest_normals is None or is_reaimed is None:
        return np.zeros(beam.shape[:2])
    length = np.linalg.norm(nest_normals, axis=1, keepdims=True)
    cosine = -np.einsum("stk,tk->st", beam, nest_normals / length)
    return np.where(is_reaimed, 0.0, np.arccos(np.clip(cosine, -1.0, 1.0)))


def _add_obstacles(reason_table: NDArray[np.int8], position: Floats, points: Floats, obstacles: Obstacles) -> None:
    """Marking of the pairs that an obstacle hides; rays are cast only for pairs that no other reason excludes."""
    inside = obstacles.is_enclosed(position)
    pairs = np.argwhere((reason_table == InvisibilityReason.VISIBLE) & ~inside[:, None])
    hidden = pairs[obstacles.is_blocked(position[pairs[:, 0]], obstacles.moved_to_surface(points)[pairs[:, 1]])]
    reason_table[hidden[:, 0], hidden[:, 1]] = InvisibilityReason.OBSTACLE
    reason_table[inside] = InvisibilityReason.STATION_INSIDE


def aim_nest_normals(position: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Directions (T, 3) in which fixed reflectors serve all stations, and half-angles (T,) [rad] around them.

    The direction is the axis of the narrowest cone around the stations; a target can serve all of them when the
    reflector's acceptance is larger.
    """
    back = position - points[:, None, :]
    back /= np.linalg.norm(back, axis=2, keepdims=True)
    centre = narrowest_cone_axes(back)
    cosine = np.clip(np.einsum("tsk,tk->ts", back, centre), -1.0, 1.0)
    half_angle: Floats = np.arccos(cosine.min(axis=1))
    return centre, half_angle


def narrowest_cone_axes(directions: Floats, n_steps: int = 1000) -> Floats:
    """Axes (..., 3) of the narrowest cones around unit vectors (..., S, 3) of a half space.

    It is the smallest ball around the vectors. Badoiu and Clarkson's iteration, step 1/(i+1) to the farthest, converges
    as 1/i.
    """
    flattened = directions.reshape(-1, *directions.shape[-2:])
    centre, every = flattened.mean(axis=-2), np.arange(len(flattened))
    for i in range(1, n_steps + 1):
        farthest = np.argmin(np.einsum("tsk,tk->ts", flattened, centre), axis=-1)
        centre += (flattened[every, farthest] - centre) / (i + 1)
        centre /= np.sqrt(np.sum(centre**2, axis=1, keepdims=True))
    return centre.reshape(directions.shape[:-2] + directions.shape[-1:])
