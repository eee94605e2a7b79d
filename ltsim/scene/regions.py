"""Regions of the hall that lines of sight pass (ball, column, height band, slab), fixed in the network frame.

A region is Gaussian in the axes that confine it, w(r) = exp(-|A (r - c)|^2 / (2 width^2)), so that the integral of w
along a line of sight is closed: with a = |A b|^2 of the unit vector b, the nearest approach at s0 and its distance rho,
integral = exp(-rho^2 / (2 width^2)) width sqrt(2 pi / a) [Phi((d - s0) sqrt(a) / width) - Phi(-s0 sqrt(a) / width)].
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ltsim.core.arrays import Bools, Floats
from ltsim.scene.sightings import Sightings

REGION_SHAPES = {
    "xyz": "ball",
    "xy": "column",
    "yz": "bar along x",
    "xz": "bar along y",
    "z": "height band",
    "x": "slab across x",
    "y": "slab across y",
}
"""Names of the shapes by the axes in which they are bounded."""
MIN_CENTRE_STEP = 0.5
"""Smallest distance [m] between the centres of the coarsest grid (limits the cost)."""
MAX_CENTRES_PER_AXIS = 10
"""Largest number of centres along an axis of the coarsest grid (limits the cost)."""
GRID_SUBDIVISIONS = {1: (1, 4), 2: (1, 2), 3: (1,)}
"""Divisors of that distance in the grids of regions that are bounded in one, two and three axes: a region several times
as wide as the cause has a tenth of its evidence.
"""
MIN_PASSING_LINES = 6
"""Smallest number of lines of sight through a candidate region: fewer lines indicate an error of single readings."""
MAX_PASSING_FRACTION = 0.8
"""Largest fraction of the lines of sight through a candidate region: if almost all lines pass it, the error belongs to
the whole recording."""
MIN_TARGETS_BEHIND = 2
"""Smallest number of targets behind a region: an error on the lines to one target alone is an error of that target."""
REFINED_CENTRE_STEPS = (0.5, 0.15)
"""Steps of a centre, in widths, in the refinement of a region."""
REFINED_WIDTH_FACTORS = (0.5, 0.7, 1.4, 2.0)
"""Factors of the width in the refinement of a region."""
MAX_REGION_LINE_PAIRS = 300_000
"""Largest number of pairs of region and line of sight in memory at a time, some tens of MB."""
MAX_PARALLEL_SINE_SQUARED = 1e-9
"""Squared sine of the angle between line and region axis below which the line counts as parallel and stays in the
region.
"""


@dataclass(frozen=True)
class HallRegion:
    """Gaussian region of the hall.

    Attributes
    ----------
    bounded_axes : str
        Axes in which the region is bounded, a key of `REGION_SHAPES`.
    centre : tuple of float
        Coordinates [m] along these axes, network frame.
    width : float
        Standard deviation [m].
    """

    bounded_axes: str
    """Axes in which the region is bounded, such as `xy` for a column."""
    centre: tuple[float, ...]
    """Centre along these axes [m]."""
    width: float
    """Standard deviation [m] of its Gaussian weight."""

    def path_lengths(self, sightings: Sightings) -> Floats:
        """Length (n,) [m] of each line of sight in the region: the integral of w."""
        if self not in sightings.derived_cache:
            sightings.derived_cache[self] = region_paths(
                sightings, self.bounded_axes, np.array([self.centre]), self.width
            )[0]
        path: Floats = sightings.derived_cache[self]
        return path

    def levers(self, sightings: Sightings) -> Floats:
        """Integral (n,) [m] along the line of sight of w times the remaining fraction of the line.

        Along the line w is a Gaussian about the nearest approach s0: the integral of (d - s) w is (d - s0) times the
        path less the first moment about s0.
        """
        key = self, "lever"
        if key not in sightings.derived_cache:
            path = self.path_lengths(sightings)[None]
            sightings.derived_cache[key] = region_levers(
                sightings, self.bounded_axes, np.array([self.centre]), self.width, path
            )[0]
        lever: Floats = sightings.derived_cache[key]
        return lever

    def n_effective_targets(self, sightings: Sightings) -> float:
        """Effective number of targets in the region, (sum of w)^2 over the sum of w^2."""
        near = self.target_weights(sightings)[np.unique(sightings.target, return_index=True)[1]]
        return float(near.sum() ** 2 / max(np.sum(near**2), 1e-300))

    def target_weights(self, sightings: Sightings) -> Floats:
        """Weight w (n,) of the region at the target of each pointing."""
        indices = ["xyz".index(axis) for axis in self.bounded_axes]
        gap = sightings.target_points[:, indices] - np.asarray(self.centre)
        near: Floats = np.exp(-0.5 * np.sum(gap**2, axis=1) / self.width**2)[sightings.target]
        return near

    def path_and_bending(self, sightings: Sightings) -> tuple[Floats, Floats]:
        """Path (n,) [m] in a ball, and the integral (n, 3) [m] of (d - s) times the gradient of w across the line.

        The component of r - c perpendicular to a straight line is constant, rho, so that the second is -rho / width^2
        times the integral of (d - s) w.
        """
        beam, length, width = sightings.beam_vectors[0], sightings.range_, self.width
        start = sightings.station_positions[sightings.station] - np.asarray(self.centre)
        nearest, rho = _nearest_approach(start, beam, np.ones(len(beam)))
        path = _line_integral(nearest, rho, length, np.full(len(beam), width), width)
        ends = np.exp(-0.5 * (nearest / width) ** 2) - np.exp(-0.5 * ((length - nearest) / width) ** 2)
        lever = (length - nearest) * path - width**2 * ends * np.exp(-0.5 * np.sum(rho**2, axis=1) / width**2)
        return path, -rho * (lever / width**2)[:, None]

    def neighbours(self) -> Iterator["HallRegion"]:
        """Regions in the neighbourhood of this one: centre moved along each axis, width changed."""
        for i, move, sign in product(range(len(self.bounded_axes)), REFINED_CENTRE_STEPS, (1.0, -1.0)):
            centre = list(self.centre)
            centre[i] = round(centre[i] + sign * move * self.width, 6)
            yield replace(self, centre=tuple(centre))
        for factor in REFINED_WIDTH_FACTORS:
            yield replace(self, width=round(self.width * factor, 6))


def region_paths(sightings: Sightings, bounded_axes: str, region_centres: Floats, width: float) -> Floats:
    """Lengths (r, n) [m] of the lines of sight in regions of one shape and width, with centres (r, k)."""
    beam, length, start, a, crossing = _lines_relative_to_centres(sightings, bounded_axes, region_centres)
    path = length * np.exp(-0.5 * np.einsum("rni,rni->rn", start, start) / width**2)
    nearest, rho = _nearest_approach(start[:, crossing], beam[crossing], a[crossing])
    path[:, crossing] = _line_integral(nearest, rho, length[crossing], width / np.sqrt(a[crossing]), width)
    return path


def region_levers(
    sightings: Sightings, bounded_axes: str, region_centres: Floats, width: float, path_lengths: Floats
) -> Floats:
    """Integrals (r, n) [m] of w (d - s) / d along the lines of sight, whose paths (r, n) are known."""
    beam, length, start, a, crossing = _lines_relative_to_centres(sightings, bounded_axes, region_centres)
    lever = 0.5 * path_lengths  # a line along a region is in it all the way
    nearest, rho = _nearest_approach(start[:, crossing], beam[crossing], a[crossing])
    d, variance = length[crossing], width**2 / a[crossing]
    ends = np.exp(-0.5 * nearest**2 / variance) - np.exp(-0.5 * (d - nearest) ** 2 / variance)
    moment = variance * ends * np.exp(-0.5 * np.sum(rho**2, axis=-1) / width**2)
    lever[:, crossing] = ((d - nearest) * path_lengths[:, crossing] - moment) / d
    return lever


def _lines_relative_to_centres(
    sightings: Sightings, bounded_axes: str, region_centres: Floats
) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """Lines of sight in the coordinates `bounded_axes`, relative to the centres of regions.

    Unit vectors (n, k), lengths (n,), starts less centres (r, n, k), |A b|^2 (n,), and flags (n,).

    The flags mark the lines that cross a region and do not run along it.
    """
    indices = ["xyz".index(axis) for axis in bounded_axes]
    beam = sightings.beam_vectors[0][:, indices]
    a = np.einsum("ni,ni->n", beam, beam)
    start = sightings.station_positions[sightings.station][:, indices] - region_centres[:, None]
    return beam, sightings.range_, start, a, a > MAX_PARALLEL_SINE_SQUARED


def _nearest_approach(start_points: Floats, beam: Floats, squared_beam_length: Floats) -> tuple[Floats, Floats]:
    """Distance (..., n) along each line to its nearest approach to the centre, and the vector (..., n, k) to it."""
    nearest = -np.sum(start_points * beam, axis=-1) / squared_beam_length
    return nearest, start_points + nearest[..., None] * beam


def _line_integral(
    approach_distance: Floats, perpendicular_distance: Floats, length: Floats, sigma_along_line: Floats, width: float
) -> Floats:
    """Integral (..., n) of w over lines of length (n,), with standard deviations (n,) of w along them."""
    from scipy.special import ndtr

    share = ndtr((length - approach_distance) / sigma_along_line) - ndtr(-approach_distance / sigma_along_line)
    integral: Floats = (
        np.sqrt(2.0 * np.pi)
        * sigma_along_line
        * share
        * np.exp(-0.5 * np.sum(perpendicular_distance**2, axis=-1) / width**2)
    )
    return integral


def coordinate_extent(sightings: Sightings) -> tuple[Floats, Floats]:
    """Lowest and highest coordinates (3,) [m] of all stations and targets with a pointing."""
    ends = np.vstack([sightings.station_positions[sightings.station], sightings.target_points[sightings.target]])
    return ends.min(axis=0, initial=np.inf), ends.max(axis=0, initial=-np.inf)


def candidate_regions(sightings: Sightings, region_shapes: Sequence[str] = tuple(REGION_SHAPES)) -> list[HallRegion]:
    """Regions of the given shapes on a grid over the hall; some, but not almost all, lines of sight pass each."""
    regions: list[HallRegion] = []
    for axes in region_shapes if len(sightings) else ():
        key = "regions", axes
        if key not in sightings.derived_cache:
            sightings.derived_cache[key] = _regions_of_shape(sightings, axes)
        regions += sightings.derived_cache[key]
    return regions


def _regions_of_shape(sightings: Sightings, axes: str) -> list[HallRegion]:
    """Regions of one shape on its grids over the hall."""
    low, high = coordinate_extent(sightings)
    coarsest = max(MIN_CENTRE_STEP, float((high - low).max()) / MAX_CENTRES_PER_AXIS)
    return [r for parts in GRID_SUBDIVISIONS[len(axes)] for r in _regions_on_grid(sightings, axes, coarsest / parts)]


def _regions_on_grid(sightings: Sightings, bounded_axes: str, grid_spacing: float) -> list[HallRegion]:
    """Regions of one shape on a grid with a distance `grid_spacing` [m] between the centres."""
    low, high = coordinate_extent(sightings)
    width, regions = round(0.5 * grid_spacing, 6), list[HallRegion]()
    grids = [
        np.arange(low[i] + 0.5 * grid_spacing, high[i], grid_spacing).round(6).tolist()
        for i in map("xyz".index, bounded_axes)
    ]
    centres = np.array(list(product(*grids))).reshape(-1, len(bounded_axes))
    for part in np.array_split(centres, 1 + len(centres) * len(sightings) // MAX_REGION_LINE_PAIRS):
        inside = region_paths(sightings, bounded_axes, part, width)
        chosen = np.flatnonzero(is_distinctive(inside > width, sightings))
        beyond = region_levers(sightings, bounded_axes, part[chosen], width, inside[chosen])
        for i, lever in zip(chosen.tolist(), beyond, strict=True):
            regions.append(region := HallRegion(bounded_axes, tuple(part[i].tolist()), width))
            sightings.derived_cache[region], sightings.derived_cache[region, "lever"] = inside[i].copy(), lever.copy()
    return regions


def is_distinctive(is_crossed: Bools, sightings: Sightings) -> Bools:
    """Flags (r,) of the regions that enough lines of sight (r, n) to several targets pass, but not almost all."""
    count = is_crossed.sum(axis=1)
    is_sufficient = (count >= MIN_PASSING_LINES) & (count <= MAX_PASSING_FRACTION * len(sightings))
    of_target = (sightings.target[:, None] == np.arange(len(sightings.target_points))).astype(np.float32)
    by_target = is_crossed[is_sufficient].astype(np.float32) @ of_target
    is_sufficient[is_sufficient] = (by_target > 0.0).sum(axis=1) >= MIN_TARGETS_BEHIND
    distinctive: Bools = is_sufficient
    return distinctive
