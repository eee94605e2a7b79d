"""The time of a sudden change: uniform between the pointings before and after, weighted by what the readings say."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.evidence_calculator import EvidenceCalculator
from ltsim.diagnosis.hypotheses import EffectModel
from ltsim.diagnosis.schema import ParameterEstimate
from ltsim.diagnosis.shape_parameters import estimates_averaged_over_shapes
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.effects.range_step import RangeStep
from ltsim.physics.effects.station_bump import StationBump
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import network

TRIALS = 60


@pytest.fixture(scope="module")
def calculator() -> EvidenceCalculator:
    recording, _ = network(faces=2, seed=1)
    return EvidenceCalculator(ResidualSpace.from_adjustment(adjust(recording, misalignment_construction())))


def posterior_of_time(
    calculator: EvidenceCalculator, effect: CandidateEffect, size: float, seed: int
) -> ParameterEstimate:
    """Estimate of the time of a change of `size` plausible sizes, from drawn readings."""
    space, draw = calculator.residual_space, random_stream(seed, "time of change")
    values = size * effect.plausible_sizes * draw.standard_normal(len(effect.plausible_sizes))
    noise = draw.standard_normal(len(space.whitened_residuals))
    residuals = space.project((noise + space.whitened_design(effect) @ values)[:, None])[:, 0]
    base = EffectModel((), (), (), residuals)
    every = effect.neighbours(space.sightings)
    best = every[int(np.argmax(calculator.log_evidence(every, base)))]
    return estimates_averaged_over_shapes(calculator, best, base, ())["time"]


@pytest.mark.parametrize(
    ("kind", "place"),
    [(TargetMoved, {"targets": ("T07",)}), (StationBump, {"stations": ("S2",)}), (RangeStep, {"stations": ("S3",)})],
)
@pytest.mark.parametrize("size", [0.3, 2.0])
def test_intervals_of_the_time_of_a_change_hold(
    calculator: EvidenceCalculator, kind: type, place: dict[str, tuple[str, ...]], size: float
) -> None:
    """Changes at times that are uniform between the first and the last pointing; 95 % intervals hold in 95 %."""
    sightings, draw, inside = calculator.residual_space.sightings, random_stream(5, "times"), []
    acts = kind(**{"stations": (), **place}, time=0.0).pointing_indicator(sightings) > 0
    ordered = np.unique(sightings.time[acts])
    for seed in range(TRIALS):
        time = float(draw.uniform(*ordered[[2, -3]]))
        estimate = posterior_of_time(calculator, kind(**{"stations": (), **place}, time=time), size, seed)
        inside.append(abs(estimate.value - time) <= 1.96 * estimate.sigma)
    assert np.mean(inside) >= 0.95 - 2 * np.sqrt(0.95 * 0.05 / TRIALS)


def test_a_large_motion_is_uniform_in_its_gap(calculator: EvidenceCalculator) -> None:
    sightings = calculator.residual_space.sightings
    ordered = np.unique(sightings.time[sightings.target == sightings.target_names.index("T07")])
    gap = int(np.argmax(np.diff(ordered)))
    time = float(ordered[gap] + 0.9 * (ordered[gap + 1] - ordered[gap]))
    estimate = posterior_of_time(calculator, TargetMoved((), ("T07",), time=time), 30.0, 1)
    assert estimate.value == pytest.approx(ordered[gap : gap + 2].mean())
    assert estimate.sigma == pytest.approx((ordered[gap + 1] - ordered[gap]) / np.sqrt(12), rel=1e-3)
