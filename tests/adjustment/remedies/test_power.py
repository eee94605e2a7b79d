"""What is told as detectable is found: the tool's own search, simulated at the minimal detectable sizes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.remedies.detectability import detectability_of_variants, subsample_evenly
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.adjustment.significance import GLOBAL_TEST_LEVEL
from ltsim.calibration.evidence import log_sum_exp
from ltsim.core.arrays import Floats
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.global_test import GlobalTestResult, run_global_test
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.null_ensemble import MIN_SIMULATED_RECORDINGS, NullEnsemble
from ltsim.diagnosis.search import Searcher
from ltsim.physics.effects import CATALOGUE, ORDINARY_CALIBRATION_EFFECTS
from ltsim.physics.effects.effect import Effect, NoiseEffect
from ltsim.physics.model.construction import misalignment_construction
from tests.diagnosis.ensembles import with_trials
from tests.networks import drawn, network


class Search:
    """The search of a diagnosis on one network, with the threshold of its simulated null."""

    def __init__(self, faces: int) -> None:
        recording, _ = network(values=drawn(misalignment_construction(), 1), seed=1, faces=faces)
        self.space = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction()))
        self.noise = NoiseHypothesisSet.from_residual_space(self.space, noise_hypotheses(self.space.sightings))
        self.detection: GlobalTestResult = run_global_test(
            Searcher(self.space, 0, MIN_SIMULATED_RECORDINGS), self.noise
        )

    def families(self) -> Iterator[list[Effect]]:
        """All places and shapes of each effect beyond the ordinary calibration that shifts readings."""
        ordinary = {type(effect) for effect in ORDINARY_CALIBRATION_EFFECTS}
        for kind in CATALOGUE:
            shifts = kind not in ordinary and not issubclass(kind, NoiseEffect)
            places = list(kind.candidates(self.space.sightings)) if shifts else []
            if places:
                yield places

    def shift(self, places: list[Effect]) -> Floats | None:
        """Residual (m,) of the effect at its minimal detectable size and a middling place; None if it leaves none.

        The same holds for an effect on data that the network lacks.
        """
        detectability = detectability_of_variants(self.space, places)
        if detectability is None:
            return None
        row = min(detectability.table(), key=lambda r: r.median_size / r.plausible_size)
        if not np.isfinite(row.median_size):
            return None
        acting = [effect for effect in subsample_evenly(places) if self.space.whitened_design(effect).any()]
        for effect, sizes in zip(acting, detectability.minimal_detectable_sizes, strict=True):
            names = [p.name for p in effect.parameters]
            if row.parameter in names and sizes[names.index(row.parameter)] == row.median_size:
                column = self.space.whitened_design(effect)[:, names.index(row.parameter)]
                return self.space.project(column * row.median_size)
        return None

    def detected_fraction(self, shift: Floats, trials: int) -> float:
        """Share of recordings with it whose search is above the threshold."""
        white = random_stream(11, "power").standard_normal((self.space.n_equations, trials))
        residual = self.space.project(white) + shift[:, None]
        usual = NullEnsemble.from_residual_space
        with pytest.MonkeyPatch.context() as patch:  # The search scores these recordings in place of clean ones.
            patch.setattr(
                NullEnsemble,
                "from_residual_space",
                staticmethod(lambda *given, **how: with_trials(usual(*given, **how), residual)),
            )
            scored = Searcher(self.space, 0).empty_model_screening.null_test_statistics
        statistic = np.logaddexp(
            log_sum_exp(self.noise.log_evidence_by_family(residual, self.space.redundancy)), scored
        )
        return float(np.mean(statistic > self.detection.critical_value(GLOBAL_TEST_LEVEL)))


@pytest.fixture(scope="module")
def search() -> Search:
    return Search(1)


@pytest.mark.long
def test_an_effect_of_the_minimal_detectable_size_is_detected_by_the_search_as_often_as_reported(
    search: Search,
) -> None:
    """One effect without a place, one of a station, one of a target, one of a reading."""
    chosen = {"gauge-scale", "station-weather", "target-moved", "smr-dihedral"}
    shares = {}
    for places in search.families():
        if places[0].name in chosen:
            shift = search.shift(places)
            assert shift is not None
            shares[places[0].name] = search.detected_fraction(shift, 100)
    assert len(shares) == 4
    assert all(0.65 < share < 0.95 for share in shares.values()), shares
    assert np.mean(list(shares.values())) == pytest.approx(0.8, abs=0.07)


def test_nothing_is_detected_without_an_effect(search: Search) -> None:
    assert search.detected_fraction(np.zeros(search.space.n_equations), 300) == pytest.approx(
        GLOBAL_TEST_LEVEL, abs=0.04
    )


@pytest.mark.long
@pytest.mark.parametrize("faces", [1, 2])
def test_every_effect_of_its_minimal_detectable_size_is_detected_in_about_four_of_five(faces: int) -> None:
    """Over all effects of the catalogue that leave a trace."""
    search = Search(faces)
    shifts = {places[0].name: search.shift(places) for places in search.families()}
    shares = {name: search.detected_fraction(shift, 400) for name, shift in shifts.items() if shift is not None}
    assert len(shares) > 28
    assert np.mean(list(shares.values())) == pytest.approx(0.82, abs=0.05), shares
    assert min(shares.values()) > 0.65, shares
