"""Regions of the hall that change lines of sight passing through them, such as a ball or column of warm air.

A region is fixed in the network frame, and bounded in some of the axes x, y, z. It has the Gaussian weight w(r) =
exp(-|A (r - c)|^2 / (2 width^2)), with the position r, the centre c, and the matrix A that selects the bounded axes.

The integral of w along a line of sight of length d and direction b (unit vector) has a closed form. Let a = |A b|^2. In
the bounded axes, let rho be the distance from the centre to the nearest point of the line, and s0 the distance along
the line to this point. With the standard normal distribution function Phi the integral is exp(-rho^2 / (2 width^2))
width sqrt(2 pi / a) [Phi((d - s0) sqrt(a) / width) - Phi(-s0 sqrt(a) / width)].
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
"""Name of the shape of a region, by the axes in which the region is bounded."""
MIN_REGION_CENTRE_SPACING = 0.5
"""Smallest spacing [m] of region centres on the coarsest grid, to limit the number of candidate regions (regions that a
diagnosis tests as places of a disturbance).
"""
MAX_REGION_CENTRES_PER_AXIS = 10
"""Largest number of region centres along an axis of the coarsest grid, to limit the number of candidate regions
(regions that a diagnosis tests as places of a disturbance).
"""
GRID_SUBDIVISIONS_BY_N_AXES = {1: (1, 4), 2: (1, 2), 3: (1,)}
"""Divisors of the spacing of the coarsest grid that give the grids of candidate regions, by the number of bounded axes.
A disturbance narrower than the spacing needs a finer grid: a region several times wider than the disturbance has only a
tenth of the log evidence (logarithm of the marginal likelihood) of a region of the right width.
"""
MIN_LINES_THROUGH_REGION = 6
"""Smallest number of lines of sight through a candidate region (possible place of a disturbance); fewer lines show an
error of single readings.
"""
MAX_LINE_FRACTION_THROUGH_REGION = 0.8
"""Largest fraction of all lines of sight that may pass through a candidate region (possible place of a disturbance); if
almost all do, the error belongs to the whole recording.
"""
MIN_TARGETS_BEHIND_REGION = 2
"""Smallest number of targets whose lines of sight pass through a candidate region (possible place of a disturbance);
with a single target the error belongs to this target.
"""
LOCAL_SEARCH_CENTRE_SHIFTS = (0.5, 0.15)
"""Shifts of a region's centre, divided by the width of the region, that a diagnosis tries to find a region that
explains the readings better.
"""
LOCAL_SEARCH_WIDTH_FACTORS = (0.5, 0.7, 1.4, 2.0)
"""Factors of the width of a region that a diagnosis tries to find a region that explains the readings better."""
MIN_REGION_WIDTH = 0.005
"""Smallest width [m] of a region that a diagnosis tries: the width of a tracker's beam. A narrower region would contain
single lines of sight.
"""
MAX_REGION_LINE_PAIRS = 300_000
"""Largest number of pairs of region and line of sight that are processed at a time; they take some tens of MB of
memory."""
MAX_PARALLEL_SINE_SQUARED = 1e-9
"""Limit of the squared sine of the angle between a line of sight and the unbounded axes of a region. Below it the line
is parallel to these axes, so that the weight is constant along it."""


@dataclass(frozen=True)
class HallRegion:
    """Region of the hall that changes lines of sight, such as a column of warm air, with a Gaussian weight.

    Attributes
    ----------
    bounded_axes : str
        Axes in which the region is bounded, a key of `REGION_SHAPES`.
    centre : tuple of float
        Coordinates [m] of the centre along these axes, in the network frame.
    width : float
        Standard deviation [m] of the Gaussian weight.
    """

    bounded_axes: str
    """Axes in which the region is bounded, such as `xy` for a column."""
    centre: tuple[float, ...]
    """Coordinates [m] of the centre along the bounded axes, in the network frame."""
    width: float
    """Standard deviation [m] of the Gaussian weight."""

    def path_lengths(self, sightings: Sightings) -> Floats:
        """Length (n,) [m] of n lines of sight inside the region: integral of the region's weight along each line."""
        if self not in sightings.derived_cache:
            sightings.derived_cache[self] = path_lengths_in_regions(
                sightings, self.bounded_axes, np.array([self.centre]), self.width
            )[0]
        path: Floats = sightings.derived_cache[self]
        return path

    def lever_weighted_path_lengths(self, sightings: Sightings) -> Floats:
        """Length (n,) [m] of n lines of sight inside the region, each part weighted by its lever to the line's end.

        It is the integral of w (d - s) / d over the distance s from the station, with the region's weight w and the
        length d of the line. A deflection at s in proportion to w moves the end of the line in proportion to the
        remaining length d - s. The integral is therefore proportional to the change of the measured direction. Along
        the line w is a Gaussian about s0, the distance to the point nearest to the centre. The integral of (d - s) w is
        (d - s0) times the path length minus the first moment of w about s0.
        """
        key = self, "lever"
        if key not in sightings.derived_cache:
            path = self.path_lengths(sightings)[None]
            sightings.derived_cache[key] = lever_weighted_path_lengths_in_regions(
                sightings, self.bounded_axes, np.array([self.centre]), self.width, path
            )[0]
        lever: Floats = sightings.derived_cache[key]
        return lever

    def n_effective_targets(self, sightings: Sightings) -> float:
        """Effective number of targets inside the region: (sum of w)^2 / (sum of w^2) over the targets' weights w."""
        target_weights = self.target_weights(sightings)[np.unique(sightings.target, return_index=True)[1]]
        return float(target_weights.sum() ** 2 / max(np.sum(target_weights**2), 1e-300))

    def target_weights(self, sightings: Sightings) -> Floats:
        """Weight (n,) of the region, from 0 to 1, at the target of each of n pointings."""
        indices = ["xyz".index(axis) for axis in self.bounded_axes]
        gap = sightings.target_points[:, indices] - np.asarray(self.centre)
        near: Floats = np.exp(-0.5 * np.sum(gap**2, axis=1) / self.width**2)[sightings.target]
        return near

    def path_lengths_and_bending(self, sightings: Sightings) -> tuple[Floats, Floats]:
        """Path lengths (n,) [m] of n lines of sight in a region bounded in x, y and z, and their bending (n, 3) [m].

        The weight at the point r is w = exp(-|r - c|^2 / (2 width^2)), with the centre c. A line of sight has the
        length d, and s is the distance along it. The path length is the integral of w over s. The bending is the
        integral over s of (d - s) times the gradient of w across the line. The component rho of r - c across a straight
        line is constant. Therefore the bending is -rho / width^2 times the integral of (d - s) w.
        """
        beam, length, width = sightings.beam_vectors[0], sightings.range_, self.width
        start = sightings.station_positions[sightings.station] - np.asarray(self.centre)
        nearest, rho = _nearest_approach(start, beam, np.ones(len(beam)))
        path = _line_integral(nearest, rho, length, np.full(len(beam), width), width)
        ends = np.exp(-0.5 * (nearest / width) ** 2) - np.exp(-0.5 * ((length - nearest) / width) ** 2)
        lever = (length - nearest) * path - width**2 * ends * np.exp(-0.5 * np.sum(rho**2, axis=1) / width**2)
        return path, -rho * (lever / width**2)[:, None]

    def local_search_variants(self) -> Iterator["HallRegion"]:
        """Iterator over similar regions, which may explain the readings better: with another centre or width."""
        for i, move, sign in product(range(len(self.bounded_axes)), LOCAL_SEARCH_CENTRE_SHIFTS, (1.0, -1.0)):
            centre = list(self.centre)
            centre[i] = round(centre[i] + sign * move * self.width, 6)
            yield replace(self, centre=tuple(centre))
        for factor in LOCAL_SEARCH_WIDTH_FACTORS:
            if self.width * factor >= MIN_REGION_WIDTH:
                yield replace(self, width=round(self.width * factor, 6))


def path_lengths_in_regions(sightings: Sightings, bounded_axes: str, region_centres: Floats, width: float) -> Floats:
    """Path lengths (r, n) [m] of n lines of sight in r regions with a common shape and width.

    `bounded_axes` is a key of `REGION_SHAPES`. `region_centres` (r, k) [m] are the centres in these k axes. `width` [m]
    is the standard deviation of the weight.
    """
    beam, length, start, a, crossing = _lines_relative_to_centres(sightings, bounded_axes, region_centres)
    path = length * np.exp(-0.5 * np.einsum("rni,rni->rn", start, start) / width**2)
    nearest, rho = _nearest_approach(start[:, crossing], beam[crossing], a[crossing])
    path[:, crossing] = _line_integral(nearest, rho, length[crossing], width / np.sqrt(a[crossing]), width)
    return path


def lever_weighted_path_lengths_in_regions(
    sightings: Sightings, bounded_axes: str, region_centres: Floats, width: float, path_lengths: Floats
) -> Floats:
    """Path lengths (r, n) [m] of n lines of sight in r regions, weighted by the lever to the end of each line.

    A part of the line, at the distance s from the station, has the weight (d - s) / d, with the length d of the line.
    `path_lengths` (r, n) [m] is the result of `path_lengths_in_regions` for these regions.
    """
    beam, length, start, a, crossing = _lines_relative_to_centres(sightings, bounded_axes, region_centres)
    lever = 0.5 * path_lengths  # w is constant along a parallel line
    nearest, rho = _nearest_approach(start[:, crossing], beam[crossing], a[crossing])
    d, variance = length[crossing], width**2 / a[crossing]
    ends = np.exp(-0.5 * nearest**2 / variance) - np.exp(-0.5 * (d - nearest) ** 2 / variance)
    moment = variance * ends * np.exp(-0.5 * np.sum(rho**2, axis=-1) / width**2)
    lever[:, crossing] = ((d - nearest) * path_lengths[:, crossing] - moment) / d
    return lever


def _lines_relative_to_centres(
    sightings: Sightings, bounded_axes: str, region_centres: Floats
) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """Lines of sight in the k bounded coordinates, relative to the centres (r, k) [m] of r regions.

    The first four results, in these coordinates, are the components (n, k) of the unit vectors of n lines, the lengths
    (n,) [m] of the lines, the start points minus the centres (r, n, k) [m], and the squared lengths (n,) of the
    components. The fifth result is True (n,) for each line that is not parallel to the unbounded axes.
    """
    indices = ["xyz".index(axis) for axis in bounded_axes]
    beam = sightings.beam_vectors[0][:, indices]
    a = np.einsum("ni,ni->n", beam, beam)
    start = sightings.station_positions[sightings.station][:, indices] - region_centres[:, None]
    return beam, sightings.range_, start, a, a > MAX_PARALLEL_SINE_SQUARED


def _nearest_approach(start_points: Floats, beam: Floats, squared_beam_length: Floats) -> tuple[Floats, Floats]:
    """Distance (..., n) [m] along each of n lines to its point nearest to a centre, and this point (..., n, k) [m].

    Start points (..., n, k) and nearest points are relative to the centre, in k bounded coordinates. `beam` (n, k) are
    the components of the unit vectors of the lines in them, `squared_beam_length` (n,) their squared lengths.
    """
    nearest = -np.sum(start_points * beam, axis=-1) / squared_beam_length
    return nearest, start_points + nearest[..., None] * beam


def _line_integral(
    approach_distance: Floats,
    perpendicular_distance: Floats,
    line_lengths: Floats,
    sigma_along_line: Floats,
    width: float,
) -> Floats:
    """Integral (..., n) [m] of the weight w of a region along n lines of lengths `line_lengths` (n,) [m].

    `approach_distance` (..., n) [m] and `perpendicular_distance` (..., n, k) [m] are the distance along the line to the
    point nearest to the centre, and the vector from the centre to this point in k bounded coordinates.
    `sigma_along_line` (n,) [m] is the standard deviation of w along each line.
    """
    from scipy.special import ndtr

    share = ndtr((line_lengths - approach_distance) / sigma_along_line) - ndtr(-approach_distance / sigma_along_line)
    integral: Floats = (
        np.sqrt(2.0 * np.pi)
        * sigma_along_line
        * share
        * np.exp(-0.5 * np.sum(perpendicular_distance**2, axis=-1) / width**2)
    )
    return integral


def coordinate_extent(sightings: Sightings) -> tuple[Floats, Floats]:
    """Smallest and largest coordinates x, y, z (3,) [m] of all measured targets and their stations."""
    ends = np.vstack([sightings.station_positions[sightings.station], sightings.target_points[sightings.target]])
    return ends.min(axis=0, initial=np.inf), ends.max(axis=0, initial=-np.inf)


def candidate_regions(sightings: Sightings, region_shapes: Sequence[str] = tuple(REGION_SHAPES)) -> list[HallRegion]:
    """Regions on grids over the hall through which many, but not almost all, lines of sight pass.

    `region_shapes` are keys of `REGION_SHAPES`, by default all.
    """
    regions: list[HallRegion] = []
    for axes in region_shapes if len(sightings) else ():
        key = "regions", axes
        if key not in sightings.derived_cache:
            sightings.derived_cache[key] = _candidate_regions_of_shape(sightings, axes)
        regions += sightings.derived_cache[key]
    return regions


def _candidate_regions_of_shape(sightings: Sightings, axes: str) -> list[HallRegion]:
    """Candidate regions bounded in `axes`, on the coarsest grid and on finer ones (`GRID_SUBDIVISIONS_BY_N_AXES`)."""
    low, high = coordinate_extent(sightings)
    coarsest_spacing = max(MIN_REGION_CENTRE_SPACING, float((high - low).max()) / MAX_REGION_CENTRES_PER_AXIS)
    return [
        r
        for parts in GRID_SUBDIVISIONS_BY_N_AXES[len(axes)]
        for r in _regions_on_grid(sightings, axes, coarsest_spacing / parts)
    ]


def _regions_on_grid(sightings: Sightings, bounded_axes: str, grid_spacing: float) -> list[HallRegion]:
    """Candidate regions bounded in `bounded_axes`, with centres on a grid of spacing `grid_spacing` [m]."""
    low, high = coordinate_extent(sightings)
    width, regions = round(0.5 * grid_spacing, 6), list[HallRegion]()
    grids = [
        np.arange(low[i] + 0.5 * grid_spacing, high[i], grid_spacing).round(6).tolist()
        for i in map("xyz".index, bounded_axes)
    ]
    centres = np.array(list(product(*grids))).reshape(-1, len(bounded_axes))
    for part in np.array_split(centres, 1 + len(centres) * len(sightings) // MAX_REGION_LINE_PAIRS):
        path_lengths = path_lengths_in_regions(sightings, bounded_axes, part, width)
        chosen = np.flatnonzero(is_passed_by_part_of_sights(path_lengths > width, sightings))
        lever_integrals = lever_weighted_path_lengths_in_regions(
            sightings, bounded_axes, part[chosen], width, path_lengths[chosen]
        )
        for i, lever in zip(chosen.tolist(), lever_integrals, strict=True):
            regions.append(region := HallRegion(bounded_axes, tuple(part[i].tolist()), width))
            sightings.derived_cache[region], sightings.derived_cache[region, "lever"] = (
                path_lengths[i].copy(),
                lever.copy(),
            )
    return regions


def is_passed_by_part_of_sights(is_crossed: Bools, sightings: Sightings) -> Bools:
    """Flags (r,) of the regions through which enough lines of sight, to several targets, but not almost all pass.

    `is_crossed` (r, n) flags the lines of sight of n pointings that pass through each of r regions.
    """
    n_crossed = is_crossed.sum(axis=1)
    is_sufficient = (n_crossed >= MIN_LINES_THROUGH_REGION) & (
        n_crossed <= MAX_LINE_FRACTION_THROUGH_REGION * len(sightings)
    )
    of_target = (sightings.target[:, None] == np.arange(len(sightings.target_points))).astype(np.float32)
    by_target = is_crossed[is_sufficient].astype(np.float32) @ of_target
    is_sufficient[is_sufficient] = (by_target > 0.0).sum(axis=1) >= MIN_TARGETS_BEHIND_REGION
    distinctive: Bools = is_sufficient
    return distinctive
