"""Regions of the hall: the path of lines of sight in them in closed form, and the grid that is tried."""

import numpy as np
import pytest

from ltsim.scene.regions import (
    MAX_LINE_FRACTION_THROUGH_REGION,
    MIN_LINES_THROUGH_REGION,
    MIN_REGION_WIDTH,
    MIN_TARGETS_BEHIND_REGION,
    REGION_SHAPES,
    HallRegion,
    candidate_regions,
    coordinate_extent,
    path_lengths_in_regions,
)
from tests.physics.effects.scenes import scene

SCENE = scene()
REGIONS = [HallRegion(axes, tuple(1.0 + 0.3 * i for i in range(len(axes))), 0.4) for axes in REGION_SHAPES]


def _sampled(region: HallRegion) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, q, 3) along each line of sight, and w (n, q) there."""
    share = np.linspace(0.0, 1.0, 4001)
    start = SCENE.station_positions[SCENE.station][:, None]
    points = start + share[:, None] * (SCENE.range_[:, None, None] * SCENE.beam_vectors[0][:, None])
    off = points[:, :, ["xyz".index(axis) for axis in region.bounded_axes]] - np.array(region.centre)
    return points, np.exp(-0.5 * np.sum(off**2, axis=2) / region.width**2)


@pytest.mark.parametrize("region", REGIONS, ids=lambda region: REGION_SHAPES[region.bounded_axes])
def test_path_is_the_integral_along_the_line_of_sight(region: HallRegion) -> None:
    _, weight = _sampled(region)
    expected = np.trapezoid(weight, dx=1.0 / 4000, axis=1) * SCENE.range_
    assert region.path_lengths(SCENE) == pytest.approx(expected, abs=1e-6)
    assert expected.max() > 0.1


def test_bending_is_the_weighted_gradient_across_the_line_of_sight() -> None:
    ball = HallRegion("xyz", (1.0, 1.3, 1.6), 0.4)
    points, weight = _sampled(ball)
    gradient = -(points - np.array(ball.centre)) * (weight / ball.width**2)[:, :, None]
    beam = SCENE.beam_vectors[0][:, None]
    gradient = gradient - np.sum(gradient * beam, axis=2, keepdims=True) * beam
    rest = SCENE.range_[:, None, None] * (1.0 - np.linspace(0.0, 1.0, 4001)[:, None])
    expected = np.trapezoid(rest * gradient, dx=1.0 / 4000, axis=1) * SCENE.range_[:, None]
    path, pull = ball.path_lengths_and_bending(SCENE)
    assert path == pytest.approx(ball.path_lengths(SCENE), abs=1e-12)
    assert pull == pytest.approx(expected, abs=1e-5)


def test_every_region_of_the_grid_is_crossed_by_lines_and_lies_in_the_hall() -> None:
    low, high = coordinate_extent(SCENE)
    regions = candidate_regions(SCENE)
    assert regions and len(set(regions)) == len(regions)
    for region in regions:
        passing = region.path_lengths(SCENE) > region.width
        assert MIN_LINES_THROUGH_REGION <= passing.sum() <= MAX_LINE_FRACTION_THROUGH_REGION * len(SCENE)
        assert len(np.unique(SCENE.target[passing])) >= MIN_TARGETS_BEHIND_REGION
        at = ["xyz".index(axis) for axis in region.bounded_axes]
        assert np.all(np.array(region.centre) > low[at]) and np.all(np.array(region.centre) < high[at])


def test_neighbours_change_a_single_coordinate_or_the_width() -> None:
    region = HallRegion("xy", (2.0, 3.0), 0.5)
    for other in region.local_search_variants():
        changed = [a != b for a, b in zip((*other.centre, other.width), (*region.centre, region.width), strict=True)]
        assert sum(changed) == 1 and other.width > 0


def test_a_local_search_does_not_make_a_region_thinner_than_a_beam() -> None:
    widths, region = [], HallRegion("xy", (2.0, 3.0), 0.5)
    for _ in range(30):
        region = min(region.local_search_variants(), key=lambda other: other.width)
        widths.append(region.width)
    assert min(widths) >= MIN_REGION_WIDTH
    assert np.isfinite(path_lengths_in_regions(SCENE, "xy", np.array([region.centre]), region.width)).all()
