"""Turning a network that was put together in its own frame into the one that levels and known points define."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.adjustment.marks import Marks
from ltsim.arrays import Bools, Floats, Ints
from ltsim.errors import NetworkError
from ltsim.geometry.alignment import align
from ltsim.geometry.rotations import about_z, smallest_turn
from ltsim.recording.recording import Recording
from ltsim.units import DEGREE, MILLIMETRE

VERTICAL = np.array([0.0, 0.0, 1.0])
ROUGH_PLACE = 0.5
"""[m] How far a station may stand from its place on a floor plan."""


@dataclass(frozen=True)
class Frame:
    """What is known of the network's frame beforehand."""

    points: Floats
    """(T, 3) [m]: targets that define it: known ones, and approximate ones that were chosen for the datum; NaN
    elsewhere.
    """
    stations: Floats
    """(S, 3) [m]: the same for instruments over marks that are no targets."""
    level: Bools
    """(S,)."""
    marks: Marks
    plan: Floats
    """(S, 3) [m]: rough places of the stations on a floor plan, NaN where none is stated."""
    yaw: Floats
    """(S,) [rad]: where the zero of each circle points on that plan, NaN where it is not stated."""
    near: Floats
    """(T, 3) [m]: known or approximate places of the targets, NaN where none is stated."""

    @classmethod
    def of(cls, recording: Recording) -> Frame:
        """The frame of a recording."""
        marks = Marks.of(recording)
        setups = [recording.station_setup(name) for name in recording.stations]
        alone = [name if marks.target[i] < 0 else "" for i, name in enumerate(marks.names)]
        return cls(
            np.array([_stated(recording, name) for name in recording.targets]).reshape(-1, 3),
            np.array([_stated(recording, name) for name in alone]).reshape(-1, 3) + marks.offset,
            np.array([s.levelled for s in setups], dtype=bool),
            marks,
            np.array([s.position_mm or (np.nan,) * 3 for s in setups], dtype=np.float64).reshape(-1, 3) * MILLIMETRE,
            np.array([np.nan if s.yaw_deg is None else s.yaw_deg * DEGREE for s in setups]),
            np.array([_near(recording, name) for name in recording.targets]).reshape(-1, 3) * MILLIMETRE,
        )

    @property
    def is_stated(self) -> bool:
        """Whether any place is known."""
        return bool(np.isfinite(self.points).any() or np.isfinite(self.stations).any())

    def common(self, position: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Places (k, 3) of a network that the frame states too, and where it states them."""
        here, there = np.concatenate([position, points]), np.concatenate([self.stations, self.points])
        both = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
        return here[both], there[both]

    def motion(self, position: Floats, points: Floats, turn: Floats) -> tuple[Floats, Floats] | None:
        """Rotation and translation into the frame; None where the frame does not say.

        `turn` (3, 3) has turned the levels of the network upright already.
        """
        here, there = self.common(position, points)
        if len(here) >= 3 and not on_a_line(there):
            return align(here, there)
        if not self.level.any() or len(here) < 2:
            return None
        try:
            return upright_alignment(here @ turn.T, there, turn)
        except NetworkError:
            return None

    def plan_motion(self, position: Floats, rotation: Floats) -> tuple[Floats, Floats] | None:
        """Turn about the vertical and translation of a free network onto the floor plan; None where it has none.

        The rough places of two stations and more say it, or the place and yaw of one. Places that the network misses by
        more than `ROUGH_PLACE` belong to another frame and say nothing.
        """
        known = np.flatnonzero(np.isfinite(self.plan).all(axis=1) & np.isfinite(position).all(axis=1))
        if len(known) > 1:
            try:
                turn, shift = upright_alignment(position[known], self.plan[known])
            except NetworkError:
                return None
            miss = np.linalg.norm(position[known] @ turn.T + shift - self.plan[known], axis=1)
            return (turn, shift) if miss.max() < ROUGH_PLACE else None
        if not len(known) or not np.isfinite(self.yaw[known[0]]):
            return None
        ahead = rotation[known[0], :, 0]
        turn = about_z(float(self.yaw[known[0]] - np.arctan2(ahead[1], ahead[0])))
        return turn, self.plan[known[0]] - turn @ position[known[0]]

    def hand(self, stations: Ints, position: Floats, targets: Ints, points: Floats) -> tuple[Floats, bool]:
        """Factors (3,) that turn a network of ranges into its mirror image or leave it, and whether that is known.

        Ranges have no hand: rough places of stations and targets tell it when they are off one plane.
        """
        here, there = np.concatenate([position, points]), np.concatenate([self.plan[stations], self.near[targets]])
        stated = np.isfinite(there).all(axis=1)
        here, there = here[stated], there[stated]
        both = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])
        if len(here) < 4 or _thickness(there) < ROUGH_PLACE:
            return both[0], False
        misses = []
        for factors in both:
            rotation, shift = align(here * factors, there)
            misses.append(np.linalg.norm((here * factors) @ rotation.T + shift - there))
        return both[int(np.argmin(misses))], True

    def placed(self, stations: Ints, position: Floats, targets: Ints, points: Floats) -> tuple[Floats, bool]:
        """Targets (t, 3) of a network of ranges, in the hand and in the places that are stated roughly.

        And whether they are in these places: three off one line say so.
        """
        factors, _ = self.hand(stations, position, targets, points)
        here = np.concatenate([position, points]) * factors
        there = np.concatenate([self.plan[stations], self.near[targets]])
        stated = np.isfinite(there).all(axis=1)
        if stated.sum() < 3 or on_a_line(there[stated]):
            return points * factors, False
        rotation, shift = align(here[stated], there[stated])
        return (points * factors) @ rotation.T + shift, True

    def is_on_plan(self, position: Floats, rotation: Floats) -> bool:
        """Whether a network stands on the floor plan already, as well as the plan knows places."""
        motion = self.plan_motion(position, rotation)
        if motion is None:
            return False
        moved = position @ motion[0].T + motion[1] - position
        return bool(np.linalg.norm(moved, axis=1).max() < ROUGH_PLACE)

    def upright(self, rotation: Floats, joined: Bools) -> Floats:
        """The smallest turn (3, 3) that brings the axes of levelled stations to their plumb lines."""
        chosen = self.level & joined
        if not chosen.any():
            return np.eye(3)
        axis = (rotation[chosen] @ VERTICAL).mean(axis=0)
        goal = self.marks.vertical[chosen].mean(axis=0)
        return smallest_turn(axis / np.linalg.norm(axis), goal / np.linalg.norm(goal))


def _stated(recording: Recording, name: str) -> tuple[float, float, float]:
    target = recording.target_setup(name)
    nothing = (np.nan, np.nan, np.nan)
    if not name:
        return nothing
    if target.known_mm is not None and target.known_axes == "xyz":
        place = target.known_mm
    elif target.datum and target.approximate_mm is not None:
        place = target.approximate_mm
    else:
        return nothing
    return place[0] * MILLIMETRE, place[1] * MILLIMETRE, place[2] * MILLIMETRE


def _near(recording: Recording, name: str) -> tuple[float, float, float]:
    target = recording.target_setup(name)
    known = target.known_mm if target.known_axes == "xyz" else None
    return known or target.approximate_mm or (np.nan, np.nan, np.nan)


def _thickness(points: Floats) -> float:
    """How far points (k, 3) reach from their plane [m], root mean square."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(points)))


def on_a_line(points: Floats) -> bool:
    """Whether points (k, 3) lie on a line, or so nearly that it tells no turn about it."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 1e-3 * spread[0])


def upright_alignment(source: Floats, goal: Floats, before: Floats | None = None) -> tuple[Floats, Floats]:
    """Rotation and translation of points (k >= 2, 3) about the vertical alone; rotation after `before` if given.

    Raises
    ------
    NetworkError
        When the points lie above one another.
    """
    a, b = (source - source.mean(axis=0))[:, :2], (goal - goal.mean(axis=0))[:, :2]
    if not np.sum(a * a) > 1e-9 * np.sum((source - source.mean(axis=0)) ** 2):
        raise NetworkError("an alignment about the vertical needs points that are not above one another")
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    rotation = about_z(float(yaw))
    translation: Floats = goal.mean(axis=0) - rotation @ source.mean(axis=0)
    return rotation if before is None else rotation @ before, translation
