"""What keeps a name from being given too easily: wrong signs, scatter that repeats, several effects of one kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltsim.adjust import adjust
from ltsim.adjust.residual_space import ResidualSpace
from ltsim.diagnose.diagnosis import Estimate, Evidence, Finding, Where
from ltsim.diagnose.evidence import plausibility
from ltsim.diagnose.findings import doubted
from ltsim.diagnose.repeats import deciding_repeats, repeats
from ltsim.effects import find_effect
from ltsim.model.construction import misalignment
from ltsim.randomness import stream
from tests.networks import network


def test_a_negative_thickness_is_no_explanation():
    thickness = find_effect("window").parameters
    assert plausibility(thickness, np.array([3e-3])) == 0.0
    assert plausibility(thickness, np.array([-3e-3])) < -10.0
    drift = find_effect("range-offset").parameters
    assert plausibility(drift, np.array([-1e-6])) == plausibility(drift, np.array([1e-6]))


@pytest.fixture(scope="module")
def repeated():
    """The residual space of a recording with three repeats, and which pointings are of one pair."""
    recording, truth = network(repeats=3, seed=6)
    space = ResidualSpace.of(adjust(recording, misalignment(), start=truth.state))
    return space, recording.station * len(recording.targets) + recording.target


@pytest.mark.parametrize("shared", [True, False])
def test_scatter_that_repeats_is_told_from_noise(repeated, shared):
    space, pair = repeated
    rng = stream(1, "scatter")
    count = int(space.use.sum())
    own, common = rng.standard_normal((len(pair), 3)), rng.standard_normal((pair.max() + 1, 3))[pair]
    more = np.zeros((space.size, 1))
    more[:count, 0] = 1.5 * (common if shared else own)[space.use]
    residual = space.residual + space.project(more)[:, 0]
    ratio = repeats(space, np.full(space.use.shape, 1.0 + 1.5**2), residual)
    assert ratio > 20.0 if shared else ratio < -20.0


def test_how_often_to_measure_again_is_computed(repeated):
    space, _ = repeated
    recording, truth = network(repeats=1, seed=6)
    single = ResidualSpace.of(adjust(recording, misalignment(), start=truth.state))
    quiet, loud = (deciding_repeats(single, np.full(single.use.shape, factor)) for factor in (1.1, 3.0))
    assert loud.startswith("measure each target once more")
    assert "more times" in quiet
    assert "from 0 to" in loud
    assert deciding_repeats(space, np.full(space.use.shape, 1.001)).startswith("the repeats there are")


def test_less_noise_than_stated_does_not_repeat(repeated):
    space, _ = repeated
    assert repeats(space, np.full(space.use.shape, 0.4), space.residual) == 0.0


def test_without_repeats_nothing_is_said():
    recording, truth = network(repeats=1, seed=6)
    space = ResidualSpace.of(adjust(recording, misalignment(), start=truth.state))
    assert repeats(space, np.full(space.use.shape, 3.0), space.residual) == 0.0


def finding(effect: str, station: str, observables: tuple[str, ...] = (), *, known: bool = True) -> Finding:
    where = Where(observables, (station,))
    told = (Estimate("thickness", 3.0, 0.5, "mm"),)
    return Finding(effect, known, where, told, Evidence(100.0, 1, 1e-9, 0.99), "A sentence.", (("range-step", 0.01),))


def test_several_effects_of_one_kind_are_no_name():
    found = doubted([(finding("window", "S1"), ("distance",)), (finding("window", "S2"), ())])
    assert [f.effect for f in found] == ["unknown", "unknown"]
    assert found[0].where.observables == ("distance",)
    assert found[0].equivalents[0][0] == "window"
    assert "window" in found[0].sentence


@pytest.mark.parametrize("effect", ["target-moved", "nest-lift", "outlier"])
def test_several_bad_targets_do_occur(effect):
    bad = replace(finding(effect, ""), where=Where((), (), ("T01",)))
    found = doubted([(bad, ()), (replace(bad, where=Where((), (), ("T02",))), ())])
    assert [f.effect for f in found] == [effect, effect]


def test_a_name_that_needs_a_flexible_term_beside_it_is_none():
    step, term = finding("range-step", "S1", ("distance",)), finding("unknown", "", ("distance",), known=False)
    found = doubted([(step, ("distance",)), (term, ())])
    assert [f.effect for f in found] == ["unknown", "unknown"]
    assert found[0].equivalents[0][0] == "range-step"
    elsewhere = finding("unknown", "", ("azimuth",), known=False)
    assert doubted([(step, ("distance",)), (elsewhere, ())])[0].effect == "range-step"
