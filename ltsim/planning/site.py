"""Where stations may stand and reflectors may sit: floor, heights, obstacles, sight, spacing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltsim.arrays import Bools, Floats
from ltsim.planning.outlines import EDGE, Area, KeepOut
from ltsim.planning.placement import Placement
from ltsim.planning.survey import Survey
from ltsim.scene.visibility import Blocker, SightLimits, narrowest_cone, visibility
from ltsim.units import MILLIMETRE

FEWEST = 3
"""Targets in sight that a station needs."""
PLACES = 250
"""That cover the floor where no step is stated; stations are refined off the grid afterwards."""
NEST_STEPS = 60
NEST_MARGIN = 0.004
"""Steps of the iteration that aims fixed nests, and what is kept free for it [rad]."""


@dataclass(frozen=True)
class Site:
    """The freedom of a plan."""

    survey: Survey
    """The layout to start from: targets, gauge, noise, order of work."""
    areas: tuple[Area, ...]
    """Where tripods may stand: in one of them."""
    limits: SightLimits
    aimed: Bools
    """(T,): targets in fixed nests, which are aimed anew for every layout and must serve all its stations."""
    obstacles: Blocker | None = None
    keep_outs: tuple[KeepOut, ...] = ()
    """Where none may stand, whatever the areas say."""
    spacing: float = 1.0
    """[m]: least distance between stations."""
    play: float = 0.0
    """[m]: how far an instrument may stand off its place without losing a sight."""
    least: int = 1
    """Every target is seen from at least so many stations."""
    fixed: tuple[int, ...] = ()
    """Stations that stay where they are."""
    nests: Floats | None = None
    """(P, 3) [m]: candidate places of reflectors; none: reflectors stay."""
    nest_names: tuple[str, ...] = ()
    reflector_spacing: float = 0.3
    """[m]."""

    @property
    def heights(self) -> tuple[float, float]:
        """[m]: lowest and highest centre of the instrument in any area."""
        return min(area.heights[0] for area in self.areas), max(area.heights[1] for area in self.areas)

    def replace(self, **changes: Any) -> Site:
        """A copy with some fields changed."""
        return replace(self, **changes)

    def of_layout(self, survey: Survey) -> Site:
        """The site with a layout's stations and reflectors, those of its own choice in nests of the same kind."""
        aimed = np.full(len(survey.points), bool(self.aimed.any()))
        aimed[: len(self.aimed)] = self.aimed[: len(survey.points)]
        return self.replace(survey=survey, aimed=aimed)

    def allowed(self, position: Floats) -> Bools:
        """(N,): a tripod may stand there."""
        return may_stand(self.areas, self.keep_outs, self.obstacles, position)

    def seen(self, position: Floats, points: Floats | None = None) -> Bools:
        """(N, T): targets in sight, also with some play; nests left aside (they are aimed later)."""
        goal = self.survey.points if points is None else points
        table = visibility(position, goal, self.limits, obstacles=self.obstacles)
        turn = self.play / table.range_
        lowest = max(self.limits.elevation_min, 0.5 * (self.limits.cone_opening - np.pi))
        good: Bools = (
            table.visible & (table.elevation - turn >= lowest) & (table.elevation + turn <= self.limits.elevation_max)
        )
        return good & (table.range_ - self.play >= self.limits.range_min)

    def joined(self, position: Floats, seen: Bools) -> Bools:
        """(B,): layouts (B, S, 3) that keep stations apart, targets in sight and nests served; `seen` (B, S, T)."""
        good: Bools = (seen.sum(axis=1) >= self.least).all(axis=1)
        good &= (seen.sum(axis=2) >= FEWEST).all(axis=1)
        gap = np.linalg.norm(position[:, :, None, :2] - position[:, None, :, :2], axis=3)
        first, second = np.triu_indices(position.shape[1], k=1)
        good &= (gap[:, first, second] > self.spacing - 1e-9).all(axis=1)
        if self.aimed.any() and good.any():
            good[good] = self._served(position[good])
        return good

    def _served(self, position: Floats) -> Bools:
        """(B,): every fixed nest can be aimed so that all stations fall within the reflector's acceptance."""
        back = position[:, None] - self.survey.points[self.aimed][:, None, :]
        range_ = np.linalg.norm(back, axis=3, keepdims=True)
        cosine = np.einsum("btsk,btk->bts", back / range_, narrowest_cone(back / range_, NEST_STEPS))
        incidence = np.arccos(np.clip(cosine, -1.0, 1.0)) + self.play / range_[..., 0]
        return np.asarray(incidence.max(axis=(1, 2)) < self.limits.acceptance - NEST_MARGIN)

    def places(self, step: float, heights: int) -> Floats:
        """Places (N, 3) of a grid where a tripod may stand."""
        grid = np.concatenate([over(area, step, heights) for area in self.areas])
        return np.unique(grid[self.allowed(grid)], axis=0)

    def placement(self, step: float, heights: int) -> Placement:
        """The greedy placement on a grid, at places in sight of three targets; fixed stations stand already."""
        places, fixed = self.places(step, heights), self.survey.position[list(self.fixed)]
        seen = self.seen(places)
        enough = seen.sum(axis=1) >= FEWEST
        counted = self.seen(fixed).sum(axis=0) if len(fixed) else np.zeros(seen.shape[1], dtype=np.int64)
        return Placement(places[enough], seen[enough], self.spacing, fixed, counted)


def grid_step(areas: Sequence[Area], grid_mm: float | None) -> float:
    """[m]: of a grid of places; where none is stated `PLACES` of them cover the areas, half a metre apart or more."""
    if grid_mm is not None:
        return grid_mm * MILLIMETRE
    size = sum(float(np.prod(np.ptp(area.outline, axis=0))) for area in areas)
    return max(round(float(np.sqrt(size / PLACES)), 1), 0.5)


def may_stand(
    areas: Sequence[Area], keep_outs: Sequence[KeepOut], obstacles: Blocker | None, position: Floats
) -> Bools:
    """(N,): a tripod may stand under an instrument at positions (N, 3) [m]."""
    good = np.zeros(len(position), dtype=bool)
    for area in areas:
        good |= area.holds(position)
    for place in keep_outs:
        good &= ~place.holds(position[:, :2])
    if obstacles is not None and good.any():
        good[good] = ~obstacles.encloses(position[good])
    return good


def over(area: Area, step: float, heights: int) -> Floats:
    """Grid (N, 3) [m] over the rectangle around an area, at its heights."""
    low, high = area.outline.min(axis=0), area.outline.max(axis=0)
    count = np.maximum(np.ceil((high - low) / step).astype(int), 1)
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, count, strict=True)]
    bottom, top = area.heights
    levels = np.linspace(bottom, top, heights if top - bottom > EDGE else 1)
    return np.stack([g.ravel() for g in np.meshgrid(*axes, levels, indexing="ij")], axis=1)
