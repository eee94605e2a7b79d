"""Minimal detectable sizes: the power they promise, a table of a like network, and pairs that are known to be alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ltsim.adjustment.reliability import level_of_single_test, noncentrality
from ltsim.adjustment.remedies.detectability import (
    catalogue_detectability,
    detectability_of_variants,
    explained_fraction,
    search_noncentrality,
)
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL, TEST_POWER
from ltsim.physics.effects import CATALOGUE, ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.effect import Blunder
from ltsim.physics.effects.elevation_eccentricity import ElevationEccentricity
from ltsim.physics.effects.head_sag import HeadSag
from ltsim.physics.effects.noise_level import NoiseLevel
from ltsim.physics.effects.range_step import RangeStep
from ltsim.physics.effects.station_weather import StationWeather
from ltsim.physics.effects.transit_offset import TransitOffset
from ltsim.physics.model.construction import misalignment_construction
from ltsim.planning.expected_precision import ExpectedPrecision
from tests.planning.fixtures import survey

INFORMATION = ExpectedPrecision.from_survey(survey())
SPACE = ResidualSpace.from_adjustment(INFORMATION.adjustment)

SINGLE = level_of_single_test(len(CATALOGUE) - len(ORDINARY_CALIBRATION_EFFECTS) + 1, GLOBAL_TEST_LEVEL)
"""Level of one effect at one place in a search."""


def test_noncentrality_of_a_single_parameter_is_the_classical_value() -> None:
    assert noncentrality(1) == pytest.approx((stats.norm.isf(0.0005) + stats.norm.ppf(TEST_POWER)) ** 2, rel=1e-3)
    assert noncentrality(1) == pytest.approx(17.07, abs=0.01)
    assert [noncentrality(q) for q in (1, 2, 6)] == sorted(noncentrality(q) for q in (1, 2, 6))
    searched = [noncentrality(1, n_tests=n) for n in (1, 10, 1000)]
    assert searched == sorted(searched)


@pytest.mark.parametrize("effect", [StationWeather(stations=("S2",)), RangeStep(stations=("S4",))])
def test_an_effect_of_the_minimal_size_is_detected_with_the_declared_power(effect) -> None:  # type: ignore[no-untyped-def]
    detectability = detectability_of_variants(SPACE, [effect])
    assert detectability is not None
    rows = SPACE.whitened_design(effect)
    trials = (
        np.random.default_rng(7).normal(size=(len(rows), 4000))
        + rows @ detectability.minimal_detectable_sizes[0][:, None]
    )
    fitted = detectability.projected_basis[0].T @ SPACE.project(trials)
    is_detected = (fitted**2).sum(axis=0) > stats.chi2.isf(SINGLE, detectability.projected_basis[0].shape[1])
    assert is_detected.mean() == pytest.approx(TEST_POWER, abs=0.02)


def test_a_noise_change_of_the_minimal_size_is_detected_with_the_declared_power() -> None:
    """Score test of a variance factor, simulated: its statistic is normal only nearly, hence the wide band."""
    effect = NoiseLevel.candidates(INFORMATION.adjustment.sightings)[0]
    detectability = detectability_of_variants(SPACE, [effect])
    assert detectability is not None
    problem = INFORMATION.adjustment.problem
    size = np.zeros(len(effect.parameters))
    size[0] = detectability.minimal_detectable_sizes[0][0]
    variance = effect.variance(INFORMATION.adjustment.sightings, problem.reading_sigmas, size)
    factor = np.ones(SPACE.n_equations)
    factor[: int(problem.is_used_reading.sum())] = (variance / problem.reading_sigmas**2)[problem.is_used_reading]
    rng = np.random.default_rng(2)
    score = []
    for scale in (np.ones(len(factor)), np.sqrt(factor)):
        residuals = SPACE.project(rng.normal(size=(len(factor), 3000)) * scale[:, None])
        score.append(((factor - 1.0)[:, None] * residuals**2).sum(axis=0))
    level = np.quantile(score[0], 1 - 0.5 * SINGLE)
    assert np.mean(score[1] > level) > 0.5
    assert np.mean(score[1] < score[0].mean()) < 0.01


def test_sizes_agree_with_the_reference_table_of_the_catalogue() -> None:
    """Two faces, joint: 3-sigma amplitudes of a like network; minimal sizes are 4.13 sigma."""
    detectability = catalogue_detectability(INFORMATION.adjustment, [TransitOffset, StationWeather, RangeStep])
    sightings = INFORMATION.adjustment.sightings
    needed = {
        "transit-offset": noncentrality(1),
        "station-weather": search_noncentrality(1, len(StationWeather.candidates(sightings))),
        "range-step": search_noncentrality(1, len(RangeStep.candidates(sightings))),
    }
    size = {row.parameter: 3 / np.sqrt(needed[row.parameter]) * row.median_size for row in detectability.table()}
    assert size["transit-offset"] == pytest.approx(0.8e-6, rel=0.25)
    assert size["station-weather"] == pytest.approx(0.82e-6, rel=0.25)
    assert size["range-step"] == pytest.approx(3.8e-6, rel=0.25)


def test_head_sag_hides_behind_the_eccentricity_of_upright_stations() -> None:
    """Sag and the cosine of the elevation circle are one for upright stations."""
    sag = detectability_of_variants(SPACE, [HeadSag()])
    assert sag is not None
    assert sag.visible_fractions[0] < 1e-3
    others = misalignment_construction(
        e for e in ORDINARY_CALIBRATION_EFFECTS if not isinstance(e, ElevationEccentricity)
    )
    space = ResidualSpace.from_adjustment(ExpectedPrecision.from_survey(survey(), others).adjustment)
    first, second = (
        detectability_of_variants(space, [HeadSag()]),
        detectability_of_variants(space, [ElevationEccentricity()]),
    )
    assert first is not None
    assert second is not None
    assert explained_fraction(first, second) > 0.999


def test_likeness_is_whole_for_itself_and_small_for_strangers() -> None:
    sightings = INFORMATION.adjustment.sightings
    weather = detectability_of_variants(SPACE, StationWeather.candidates(sightings))
    step = detectability_of_variants(SPACE, [RangeStep(stations=("S1",))])
    assert weather is not None
    assert step is not None
    assert explained_fraction(weather, weather) == pytest.approx(1.0, abs=1e-9)
    assert 0.5 < explained_fraction(step, weather) < 1.0
    detectability = catalogue_detectability(INFORMATION.adjustment, [StationWeather, HeadSag])
    assert detectability.detectable_effects == tuple(
        s.name for s in detectability.effects if any(c.size for c in s.projected_basis)
    )
    assert all(share > 0.9 for _, _, share in detectability.confusable_pairs())


def test_blunders_are_not_called_undetectable() -> None:
    """A plan listed exchanged names as undetectable, although `check` identifies them."""
    report = catalogue_detectability(INFORMATION.adjustment, CATALOGUE)
    blunders = {kind.name for kind in CATALOGUE if issubclass(kind, Blunder)}
    assert blunders == {"target-swap", "wrong-unit", "face-confusion"}
    assert "dead-path" in report.undetectable_effects
    assert not blunders & {*report.undetectable_effects, *(entry.name for entry in report.effects)}
