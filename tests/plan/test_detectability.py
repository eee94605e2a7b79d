"""Minimal detectable sizes: the power they promise, a table of a like network, and pairs that are known to be alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ltsim.effects.elevation_eccentricity import ElevationEccentricity
from ltsim.effects.head_sag import HeadSag
from ltsim.effects.noise_level import NoiseLevel
from ltsim.effects.range_step import RangeStep
from ltsim.effects.station_weather import StationWeather
from ltsim.effects.transit_offset import TransitOffset
from ltsim.model.construction import misalignment
from ltsim.plan.detectability import (
    ALPHA,
    POWER,
    ResidualRoom,
    detectability,
    examine,
    likeness,
    noncentrality,
)
from ltsim.plan.information import LayoutInformation
from tests.plan.fixtures import survey

INFORMATION = LayoutInformation.of(survey())
ROOM = ResidualRoom.of(INFORMATION.adjustment)


def test_noncentrality_of_one_parameter_is_the_classical_one() -> None:
    assert noncentrality(1) == pytest.approx((stats.norm.isf(ALPHA / 2) + stats.norm.ppf(POWER)) ** 2, rel=1e-3)
    assert [noncentrality(q) for q in (1, 2, 6)] == sorted(noncentrality(q) for q in (1, 2, 6))


@pytest.mark.parametrize("effect", [StationWeather(stations=("S2",)), RangeStep(stations=("S4",))])
def test_an_effect_of_the_minimal_size_is_found_with_the_stated_power(effect) -> None:  # type: ignore[no-untyped-def]
    seen = examine(ROOM, [effect])
    assert seen is not None
    rows = ROOM.signature(effect)
    trials = np.random.default_rng(7).normal(size=(len(rows), 4000)) + rows @ seen.sizes[0][:, None]
    fitted = seen.columns[0].T @ ROOM.project(trials)
    found = (fitted**2).sum(axis=0) > stats.chi2.isf(ALPHA, seen.columns[0].shape[1])
    assert found.mean() == pytest.approx(POWER, abs=0.02)


def test_a_noise_change_of_the_minimal_size_is_found_with_the_stated_power() -> None:
    """Score test of a variance factor, simulated: its statistic is normal only nearly, hence the wide band."""
    effect = NoiseLevel.candidates(INFORMATION.adjustment.sightings)[0]
    seen = examine(ROOM, [effect])
    assert seen is not None
    problem = INFORMATION.adjustment.problem
    size = np.zeros(len(effect.parameters))
    size[0] = seen.sizes[0][0]
    variance = effect.variance(INFORMATION.adjustment.sightings, problem.sigma, size)
    factor = np.ones(ROOM.size)
    factor[: int(problem.use.sum())] = (variance / problem.sigma**2)[problem.use]
    rng = np.random.default_rng(2)
    score = []
    for scale in (np.ones(len(factor)), np.sqrt(factor)):
        left = ROOM.project(rng.normal(size=(len(factor), 3000)) * scale[:, None])
        score.append(((factor - 1.0)[:, None] * left**2).sum(axis=0))
    level = np.quantile(score[0], 1 - 0.5 * ALPHA)
    assert np.mean(score[1] > level) > 0.5
    assert np.mean(score[1] < score[0].mean()) < 0.01


def test_sizes_agree_with_the_reference_table_of_the_catalogue() -> None:
    """Two faces, joint: 3-sigma amplitudes of a like network; minimal sizes are 4.13 sigma."""
    found = detectability(INFORMATION.adjustment, [TransitOffset, StationWeather, RangeStep])
    size = {row.parameter: 3 / np.sqrt(noncentrality(1)) * row.typical for row in found.table()}
    assert size["transit-offset"] == pytest.approx(0.8e-6, rel=0.25)
    assert size["station-weather"] == pytest.approx(0.82e-6, rel=0.25)
    assert size["range-step"] == pytest.approx(3.8e-6, rel=0.25)


def test_head_sag_hides_behind_the_eccentricity_of_upright_stations() -> None:
    """Sag and the cosine of the elevation circle are one for upright stations."""
    sag = examine(ROOM, [HeadSag()])
    assert sag is not None
    assert sag.visible[0] < 1e-3
    from ltsim.effects import BASELINE

    others = misalignment(e for e in BASELINE if not isinstance(e, ElevationEccentricity))
    room = ResidualRoom.of(LayoutInformation.of(survey(), others).adjustment)
    first, second = examine(room, [HeadSag()]), examine(room, [ElevationEccentricity()])
    assert first is not None
    assert second is not None
    assert likeness(first, second) > 0.999


def test_likeness_is_whole_for_itself_and_small_for_strangers() -> None:
    sightings = INFORMATION.adjustment.sightings
    weather = examine(ROOM, StationWeather.candidates(sightings))
    step = examine(ROOM, [RangeStep(stations=("S1",))])
    assert weather is not None
    assert step is not None
    assert likeness(weather, weather) == pytest.approx(1.0, abs=1e-9)
    assert 0.5 < likeness(step, weather) < 1.0
    found = detectability(INFORMATION.adjustment, [StationWeather, HeadSag])
    assert found.names == tuple(s.name for s in found.effects if any(c.size for c in s.columns))
    assert all(share > 0.9 for _, _, share in found.confusable())
