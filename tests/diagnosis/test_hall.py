"""Causes that stand in the hall, groups that move as one, joint responses, and noise with a heavy tail."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.noise_estimation import with_estimated_sizes
from ltsim.diagnosis.schema import Finding
from ltsim.physics.effects.heat_plume import HeatPlume
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings import Recording
from ltsim.scene.regions import HallRegion
from tests.networks import network


@pytest.fixture(scope="module")
def clean() -> tuple[Recording, Adjustment]:
    """A recording of a network with noise alone, and its adjustment."""
    recording, _ = network(faces=2, seed=3)
    return recording, adjust(recording, misalignment_construction())


def changed(clean: tuple[Recording, Adjustment], change: Floats, strength: float) -> tuple[Finding, float]:
    """First finding with a change (n, 3) of the readings at a noncentrality, and the factor on the change."""
    recording, adjustment = clean
    space = ResidualSpace.from_adjustment(adjustment)
    design_columns = np.zeros((space.n_equations, 1))
    design_columns[: int(space.is_used_reading.sum()), 0] = (change / recording.reading_sigmas())[space.is_used_reading]
    factor = np.sqrt(strength) / np.linalg.norm(space.project(design_columns))
    diagnosis = diagnose(recording.with_readings(recording.readings + factor * change))
    assert diagnosis.verdict == "mismatch"
    return diagnosis.findings[0], float(factor)


def centre(finding: Finding) -> dict[str, tuple[float, float]]:
    """Coordinates of a place of the hall with their standard deviations [m]."""
    return {p.name[-1]: (p.value, p.sigma) for p in finding.parameters if p.name.startswith("centre-")}


def middle_of_the_lines(adjustment: Adjustment, axes: str) -> tuple[float, ...]:
    """A place near the middle of the hall that many lines of sight pass."""
    sightings = adjustment.sightings
    middle = sightings.station_positions[sightings.station] + 0.5 * sightings.sight_vectors
    return tuple(np.median(middle, axis=0)[["xyz".index(axis) for axis in axes]].tolist())


def test_a_heat_plume_that_stands_in_the_hall_is_named_and_placed(clean) -> None:
    place = middle_of_the_lines(clean[1], "xyz")
    plume = HeatPlume((), (), place, 0.4)
    finding, kelvin = changed(clean, plume.reading_change(clean[1].sightings, np.array([1.0])), 300.0)
    assert finding.effect == "heat-plume" and not finding.where.stations and not finding.where.targets
    for (value, sigma), true in zip(centre(finding).values(), place, strict=True):
        assert abs(value - true) < min(0.5, 4.0 * sigma + 0.1)
    warmer = next(p for p in finding.parameters if p.name == "plume-temperature")
    assert warmer.value == pytest.approx(kelvin, rel=0.5)


@pytest.mark.long
def test_ranges_that_are_longer_through_a_column_are_placed(clean) -> None:
    column = HallRegion("xy", middle_of_the_lines(clean[1], "xy"), 0.5)
    change = np.zeros_like(clean[0].readings)
    change[:, 0] = column.path_lengths(clean[1].sightings)
    finding, _ = changed(clean, change, 300.0)
    assert finding.where.observables == ("distance",) and finding.where.covariates == ("place",)
    assert "the path through" in finding.driver
    for axis, true in zip("xy", column.centre, strict=True):
        assert centre(finding)[axis][0] == pytest.approx(true, abs=0.5)


@pytest.mark.long
def test_two_observables_that_follow_the_same_quantity_are_a_single_finding(clean) -> None:
    distance = clean[1].sightings.range_
    change = np.stack([0.0 * distance, *[np.tanh(4.0 * (distance - np.median(distance)))] * 2], axis=1)
    change[clean[1].sightings.face == 2, 2] *= -1.0
    finding, _ = changed(clean, change, 400.0)
    assert finding.carrier == "azimuth and elevation"
    assert set(finding.where.observables) == {"azimuth", "elevation"} and finding.where.covariates == ("distance",)


@pytest.mark.long
def test_a_gauge_that_moves_once_is_a_single_group() -> None:
    recording, _ = network(faces=2, seed=3)
    adjustment = adjust(recording, misalignment_construction())
    names = sorted({name for d in recording.gauge.distance for name in (d.from_, d.to)})
    sightings = adjustment.sightings
    group = np.isin(sightings.target, [sightings.target_names.index(name) for name in names])
    later = group & (recording.time > np.median(recording.time))
    change = reading_change_by_displacement(sightings, np.outer(later, [1e-6, -1e-6, 0.0])) * 1e6
    finding, _ = changed((recording, adjustment), change, 400.0)
    assert finding.carrier == "position of targets" and set(finding.where.targets) == set(names)
    assert finding.evidence.parameters <= 6


def test_the_weight_of_a_reading_in_a_heavy_tail_is_its_expected_weight(clean) -> None:
    space = ResidualSpace.from_adjustment(clean[1])
    rng = random_stream(5, "tail")
    ranges = np.flatnonzero(np.nonzero(space.is_used_reading)[1] == 0)
    worse = rng.choice(ranges, len(ranges) // 10, replace=False)
    noise = np.zeros((space.n_equations, 1))
    noise[worse, 0] = 5.0 * rng.standard_normal(len(worse))
    heavy = space.whitened_residuals + space.project(noise)[:, 0]
    bank = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(space.sightings))
    best = bank.ranked_noise_hypotheses(heavy, space.redundancy, np.zeros((space.n_equations, 0)))[0][1]
    assert getattr(best.effect, "group_kind", "") == "reading" and best.effect.observables == ("distance",)
    fitted = with_estimated_sizes(replace(space, whitened_residuals=heavy), space.reading_sigmas, best)
    added = np.array(fitted.sizes)[np.nonzero(space.is_used_reading)[0][ranges]]
    is_worse = np.isin(ranges, worse) & (np.abs(heavy[ranges]) > 3.0)
    assert added[is_worse].min() > 1.0
    assert np.median(added[~np.isin(ranges, worse)]) < 0.2
