"""Held-out readings as evidence against a model: size of the evidence, probabilities, coordinates, sentence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

import ltsim as lt
import ltsim.diagnosis.diagnose as steps
from ltsim.adjustment import adjust
from ltsim.diagnosis import search
from ltsim.diagnosis.cross_validation import HeldOutErrors, random_fold_row_indices
from ltsim.diagnosis.diagnose import diagnose
from ltsim.diagnosis.hypotheses import EffectModel, Hypothesis, HypothesisRanking
from ltsim.diagnosis.search import Searcher
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects import find_effect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import smooth_regressor
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from tests.networks import with_effect

CONTRADICTED = HeldOutErrors(1.2, 1.8, log_score_gain=-200.0, log_score_gain_sigma=20.0)


def ranking(unmodelled: float = -np.inf) -> HypothesisRanking:
    effect = find_effect("range-cyclic")()
    entries = tuple(Hypothesis(effect, 0.0, v, n) for v, n in ((30.0, "range-cyclic"), (28.0, "window")))
    return HypothesisRanking(entries, float(np.logaddexp(30.0, 28.0)), unmodelled)


def test_a_gain_within_its_scatter_is_no_evidence_against_a_model() -> None:
    """The scatter between the pointings decides: a gain of no more than chance contradicts nothing."""
    assert HeldOutErrors(1.2, 1.1, 50.0, 20.0).log_odds_of_model == 0.0
    assert HeldOutErrors(1.2, 1.21, -8.0, 11.0).log_odds_of_model == 0.0
    assert HeldOutErrors(1.2).log_odds_of_model == 0.0
    assert CONTRADICTED.log_odds_of_model == pytest.approx(-160.0)


@pytest.mark.parametrize("unmodelled", [-np.inf, 29.0])
def test_all_causes_together_have_at_most_the_odds_of_the_held_out_readings(unmodelled: float) -> None:
    before, after = ranking(unmodelled), ranking(unmodelled).with_held_out_evidence(-1.5)
    assert before.p_no_cause < 1e-9
    assert 1.0 - after.p_no_cause == pytest.approx(expit(-1.5))
    assert sum(after.probabilities_by_name().values()) == pytest.approx(expit(-1.5))
    names = before.probabilities_by_name()
    for name, p in after.probabilities_by_name().items():
        assert p / names[name] == pytest.approx(expit(-1.5))
    assert before.with_held_out_evidence(0.0) is before


def test_an_effect_that_held_out_readings_contradict_is_improbable_and_moves_no_target(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = with_effect(find_effect("range-cyclic")(wavelength=0.31), [4e-6, 4e-6])
    recording = recording.select(recording.target % 2 == 0)
    believed = diagnose(recording)
    assert believed.findings[0].evidence.p_real > 0.5
    monkeypatch.setattr(steps, "cross_validated_errors", lambda *_: CONTRADICTED)
    doubted = lt.diagnose(recording)  # as on the command line, by default in a small network
    assert doubted.findings
    assert all(f.evidence.p_real < 0.5 for f in doubted.findings)
    assert "predicted worse" in doubted.summary
    assert "predicted worse" not in believed.summary
    ordinary = doubted.arrays.baseline_adjustment.state.target_points
    assert np.allclose(doubted.arrays.targets.points, ordinary)
    assert not np.allclose(believed.arrays.targets.points, ordinary)


def test_a_search_without_a_fold_compares_a_curve_with_the_most_probable_simple_effect(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A curve that imitated two simple effects without a fold predicted this fold badly and contradicted both."""
    baseline = adjust(with_effect(find_effect("reflector-constant")(("S2",)), [50e-6]))
    case = SelectionState.from_adjustment(baseline, baseline.problem.is_used_reading, 0)
    searcher = case.searcher.without_rows(random_fold_row_indices(case.residual_space, 0)[0])
    law = EmpiricalLaw((), (), RESPONSE_AND_DESIGN_BY_NAME["elevation"][0], smooth_regressor("time"))
    curve = searcher.model_with([Hypothesis(law, 0.0, 0.0, "unknown")])
    monkeypatch.setattr(search, "MAX_COEFFICIENTS_OF_SIMPLE_EFFECT", len(curve.hypotheses[0].plausible_sizes) - 1)

    def search_that_ends_with_the_curve(_: Searcher, model: EffectModel, **__: object) -> EffectModel:
        return model if model.hypotheses else curve

    monkeypatch.setattr(Searcher, "_forward_selection", search_that_ends_with_the_curve)
    assert [h.name for h in searcher.select_effects(requires_effect=True).hypotheses] == ["reflector-constant"]
