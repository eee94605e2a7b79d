"""Columns of drivers that are more than a function of a covariate, against what they are by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.laws.columns import lagging, late, near, past, through
from ltsim.scene.sightings import Sightings
from tests.networks import network


@pytest.fixture(scope="module")
def sightings() -> Sightings:
    return adjust(network(faces=1, seed=1)[0]).sightings


def shape(column: np.ndarray) -> np.ndarray:
    return column / column[np.argmax(np.abs(column))]


def test_sights_that_pass_a_target_are_those_within_the_angle(sightings):
    target = sightings.target_names[3]
    bell, left, up = near(sightings, target, 0.2).T
    there = sightings.points[3] - sightings.position[sightings.station]
    cosine = np.sum(there * sightings.arm, axis=1) / np.linalg.norm(there, axis=1) / sightings.range_
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    np.testing.assert_allclose(shape(bell), np.exp(-0.5 * (angle / 0.2) ** 2), atol=1e-6)
    np.testing.assert_allclose(np.hypot(left, up), bell * np.sin(angle) / 0.2, atol=1e-6)
    there /= np.linalg.norm(there, axis=1)[:, None]
    some = bell > 0.1
    above = np.sum(there * sightings.unit_vectors[2], axis=1)
    assert some.sum() > 5
    np.testing.assert_array_equal(np.sign(up[some]), np.sign(above[some]))  # the target lies above such a sight


def test_what_lies_far_is_in_one_direction_from_all_stations(sightings):
    bell = near(sightings, sightings.target_names[3], 0.2, far=True)[:, 0]
    way = sightings.points[3] - sightings.position[sightings.station].mean(axis=0)
    angle = np.arccos(np.clip(sightings.unit_vectors[0] @ way / np.linalg.norm(way), -1.0, 1.0))
    np.testing.assert_allclose(
        shape(bell) / shape(bell).max(), (e := np.exp(-0.5 * (angle / 0.2) ** 2)) / e.max(), atol=1e-6
    )


def test_the_length_of_a_sight_beyond_a_plane_is_that_of_its_points(sightings):
    plane = float(np.quantile(sightings.points[:, 1], 0.8))
    steps = np.linspace(0.0, 1.0, 2001)
    here = sightings.position[sightings.station, 1][:, None]
    along = here + steps * (sightings.points[sightings.target, 1][:, None] - here)
    expected = (along > plane).mean(axis=1) * sightings.range_
    found = past(sightings, "y", plane)[:, 0]
    assert 0.0 < (expected > 0).mean() < 1.0
    np.testing.assert_allclose(found / np.linalg.norm(found), expected / np.linalg.norm(expected), atol=1e-3)


def test_the_length_of_a_sight_in_a_curtain_is_what_lies_beyond_one_side_and_not_the_other(sightings):
    plane, half = float(np.quantile(sightings.points[:, 0], 0.6)), 1e-4
    here, there = sightings.position[sightings.station, 0], sightings.points[sightings.target, 0]
    beyond = [
        np.clip((np.maximum(here, there) - p) / np.abs(there - here), 0.0, 1.0) for p in (plane - half, plane + half)
    ]
    expected = (beyond[0] - beyond[1]) * sightings.range_
    found = through(sightings, "x", plane)[:, 0]
    steep = np.abs(there - here) > 0.5
    assert 0.0 < (found > 0).mean() < 1.0
    scale = found[steep].max() / expected[steep].max()
    np.testing.assert_allclose(found[steep], scale * expected[steep], atol=1e-6)


def test_what_lags_comes_to_a_step_by_an_exponential_of_the_time(sightings):
    n = len(sightings)
    time = np.cumsum(np.linspace(5.0, 40.0, n))
    warm = (np.arange(n) >= n // 3).astype(np.float64)
    moved = replace(sightings, time=time, covariates={"hall": 20.0 + warm})
    slow, behind = lagging(moved, "hall", 600.0).T
    since = time - time[n // 3 - 1]
    expected = np.where(warm > 0, 1.0 - np.exp(-since / 600.0), 0.0)
    swing = np.ptp(slow) / np.ptp(expected)
    np.testing.assert_allclose(slow - slow[0], swing * expected, atol=1e-9)
    swing = np.ptp(behind) / np.ptp(warm - expected)
    np.testing.assert_allclose(behind - behind[0], swing * (warm - expected), atol=1e-9)


def test_a_list_that_is_one_row_late_has_the_target_before(sightings):
    order = np.random.default_rng(3).permutation(len(sightings)).astype(np.float64)
    shuffled = replace(sightings, time=order)
    amount = np.arange(len(sightings.target_names), dtype=np.float64)
    found = late(shuffled) @ amount
    rows = np.argsort(order)
    at = amount[shuffled.target]
    np.testing.assert_allclose(found[rows[1:]], at[rows[:-1]] - at[rows[1:]])
    assert found[rows[0]] == 0.0


def test_a_station_at_a_target_and_a_direction_in_which_nobody_looks_have_columns(sightings):
    position = sightings.position.copy()
    position[1] = sightings.points[3]
    found = near(replace(sightings, position=position), sightings.target_names[3], 0.2)
    assert np.isfinite(found).all()
    assert np.abs(found[sightings.station == 1]).max() < 1e-6
    assert np.abs(near(sightings, sightings.target_names[3], 1e-4, far=True)).max() < 1e-3
