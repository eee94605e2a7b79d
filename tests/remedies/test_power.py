"""What is told as detectable is found: the tool's own search, simulated at the minimal detectable sizes."""

from __future__ import annotations

import importlib
from collections.abc import Iterator

import numpy as np
import pytest

from ltsim.adjust import adjust
from ltsim.adjust.residual_space import ResidualSpace
from ltsim.arrays import Floats
from ltsim.diagnose.detect import Detection, _statistic, detect, noise_prior
from ltsim.effects.effect import Effect
from ltsim.model.construction import misalignment
from ltsim.randomness import stream
from ltsim.remedies.detectability import LEVEL, examine, thinned
from tests.networks import drawn, network


class Search:
    """The search of a diagnosis on one network, with the threshold of its simulated null."""

    def __init__(self, faces: int) -> None:
        recording, _ = network(values=drawn(misalignment(), 1), seed=1, faces=faces)
        diagnose = importlib.import_module("ltsim.diagnose.diagnose")
        self.space: ResidualSpace
        self.space, self.searcher, self.noise = diagnose._prepare(adjust(recording, misalignment()))
        self.detection: Detection = detect(self.searcher, self.noise, 0)

    def families(self) -> Iterator[list[Effect]]:
        """All places and shapes of each effect."""
        found: dict[str, list[Effect]] = {}
        for hypothesis in self.searcher.bank.hypotheses:
            if hypothesis.known:
                found.setdefault(hypothesis.effect.name, []).append(hypothesis.effect)
        yield from found.values()

    def shift(self, places: list[Effect]) -> Floats | None:
        """Residual (m,) of the effect at its minimal detectable size and a middling place; None if it leaves none."""
        seen = examine(self.space, places)
        assert seen is not None
        row = min(seen.table(), key=lambda r: r.typical / r.prior_sigma)
        if not np.isfinite(row.typical):
            return None
        for effect, sizes in zip(thinned(places), seen.sizes, strict=True):
            names = [p.name for p in effect.parameters]
            if row.parameter in names and sizes[names.index(row.parameter)] == row.typical:
                column = self.space.signature(effect)[:, names.index(row.parameter)]
                return self.space.project(column * row.typical)
        return None

    def share_found(self, shift: Floats, trials: int) -> float:
        """Share of recordings with it whose search is above the threshold."""
        white = stream(11, "power").standard_normal((self.space.size, trials))
        residual = self.space.project(white) + shift[:, None]
        mean = self.searcher.bank.simulated_evidence(residual) + self.searcher.prior[:, None]
        ratio = self.noise.log_likelihood_ratio(residual)
        noise = self.noise.family_evidence(ratio) + noise_prior(self.noise)[:, None]
        return float(np.mean(_statistic(mean, noise) > self.detection.threshold(LEVEL)))


@pytest.fixture(scope="module")
def search() -> Search:
    return Search(1)


def test_an_effect_of_the_minimal_detectable_size_is_found_by_the_search_as_often_as_is_said(search: Search) -> None:
    """One effect without a place, one of a station, one of a target, one of a reading."""
    chosen = {"gauge-scale", "station-weather", "target-moved", "smr-dihedral"}
    shares = {}
    for places in search.families():
        if places[0].name in chosen:
            shift = search.shift(places)
            assert shift is not None
            shares[places[0].name] = search.share_found(shift, 100)
    assert len(shares) == 4
    assert all(0.65 < share < 0.95 for share in shares.values()), shares
    assert np.mean(list(shares.values())) == pytest.approx(0.8, abs=0.07)


def test_nothing_is_found_where_there_is_nothing(search: Search) -> None:
    assert search.share_found(np.zeros(search.space.size), 300) == pytest.approx(LEVEL, abs=0.04)


@pytest.mark.long
@pytest.mark.parametrize("faces", [1, 2])
def test_every_effect_of_its_minimal_detectable_size_is_found_in_about_four_of_five(faces: int) -> None:
    """Over all effects of the catalogue that leave a trace."""
    search = Search(faces)
    shifts = {places[0].name: search.shift(places) for places in search.families()}
    shares = {name: search.share_found(shift, 400) for name, shift in shifts.items() if shift is not None}
    assert len(shares) > 28
    assert np.mean(list(shares.values())) == pytest.approx(0.82, abs=0.05), shares
    assert min(shares.values()) > 0.65, shares
