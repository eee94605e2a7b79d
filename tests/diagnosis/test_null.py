"""The false-alarm rate is what it says, also where what an adjustment leaves is only sampled."""

from __future__ import annotations

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.catalogue_designs import FamilyEvidenceSums
from ltsim.diagnosis.evidence import log_mean_exp_by_group
from ltsim.diagnosis.global_test import GlobalTestResult
from ltsim.diagnosis.search import Searcher
from ltsim.physics.model.construction import misalignment_construction
from tests.diagnosis.ensembles import with_trials
from tests.networks import network

DRAWS, SEEDS = 300, 3


def clean(searcher: Searcher, seed: int) -> np.ndarray:
    """The statistic (DRAWS,) of clean recordings that have no part in how the search judges."""
    white = random_stream(seed, "clean").standard_normal((searcher.residual_space.n_equations, DRAWS))
    others = searcher.residual_space.project(white)
    rest = Searcher(searcher.residual_space, seed, 1, catalogue_designs=searcher.catalogue_designs)
    rest.null_ensemble = with_trials(searcher.null_ensemble, others)
    return rest._screening(rest.empty_model).null_test_statistics


@pytest.mark.long
@pytest.mark.parametrize("most", [0, 500], ids=["sampled", "exact"])
def test_clean_recordings_alarm_at_the_declared_rate(most, monkeypatch):
    monkeypatch.setattr("ltsim.diagnosis.null_ensemble.MAX_DENSE_UNKNOWNS", most)
    space = ResidualSpace.from_adjustment(adjust(network(seed=2, stations=3)[0], misalignment_construction()))
    chances = []
    for seed in range(SEEDS):
        searcher = Searcher(space, seed, 300)
        assert searcher.is_large_network == (most == 0)
        null = GlobalTestResult(0.0, 1.0, searcher.empty_model_screening.null_test_statistics)
        chances += [null.p_value_of(float(value)) for value in clean(searcher, seed)]
    for level, spread in ((0.05, 0.025), (0.2, 0.05), (0.5, 0.08)):
        assert np.mean(np.array(chances) <= level) == pytest.approx(level, abs=spread)


def test_family_means_do_not_depend_on_the_batches() -> None:
    rng = random_stream(7, "families")
    family, values = rng.integers(0, 4, 50), 30.0 * rng.standard_normal((50, 6))
    family[:4] = np.arange(4)
    means = FamilyEvidenceSums.empty(family, 4, 6)
    for members in np.split(rng.permutation(50), [3, 20, 21]):
        means = means.with_effects(members, values[members])
    np.testing.assert_allclose(
        means.log_mean_evidence_over_variants, log_mean_exp_by_group(values, family, 4), rtol=1e-12
    )
